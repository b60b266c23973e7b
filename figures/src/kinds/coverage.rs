//! The surface that a layer's pairs see: first Fresnel zones on the panel, seen from above.

use crate::canvas::drawing::{
    FigureColour, FigureDrawing, StrokeStyle, TextAnchor, filled_ellipse, framed_rect, ink_label,
};
use crate::canvas::frame::number_text;
use crate::canvas::notes::FigureNotes;

/// The zones reach beyond the panel by this share of it at most.
const MARGIN: f32 = 0.12;

/// The first Fresnel zone of a pair: an ellipse on the panel, mm from its centre, y upwards.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CoverageZone {
    /// Its centre, mm.
    pub centre_mm: [f64; 2],
    /// Half its diameters: along its direction and across it, mm.
    pub radii_mm: [f64; 2],
    /// Its direction, degrees from x to y.
    pub angle_deg: f64,
}

/// Zones of the same pairs at several frequencies.
#[derive(Debug, Clone, PartialEq)]
pub struct CoverageFigure {
    /// Edge of the panel, mm.
    pub panel_mm: f64,
    /// The layer's points, mm.
    pub points_mm: Vec<[f64; 2]>,
    /// Frequency in Hz, and the zones at it.
    pub frequencies: Vec<(f64, Vec<CoverageZone>)>,
    /// Width of the drawing of a frequency, px.
    pub panel_px: f32,
}

impl CoverageFigure {
    /// Lays out the figure.
    pub fn draw(&self, notes: &FigureNotes) -> FigureDrawing {
        let side = self.panel_px;
        let width = 24.0 + self.frequencies.len() as f32 * (side + 16.0) - 16.0;
        let mut drawing = FigureDrawing::new(width, side + 92.0, notes);
        drawing.add_title();
        for (place, (frequency_hz, zones)) in self.frequencies.iter().enumerate() {
            self.draw_frequency(&mut drawing, [12.0 + place as f32 * (side + 16.0), 46.0], *frequency_hz, zones);
        }
        drawing.add_origin();
        drawing
    }

    fn draw_frequency(&self, drawing: &mut FigureDrawing, [left, top]: [f32; 2], hz: f64, zones: &[CoverageZone]) {
        let scale = self.panel_px * (1.0 - 2.0 * MARGIN) / self.panel_mm as f32;
        let middle = [left + self.panel_px / 2.0, top + self.panel_px / 2.0];
        let place = |[x, y]: [f64; 2]| [middle[0] + x as f32 * scale, middle[1] - y as f32 * scale];
        // Faint, so that overlaps show; not fainter, because viewers round each of them to whole steps of colour.
        let opacity = (20.0 / zones.len().max(1) as f32).clamp(0.04, 0.5);
        for zone in zones {
            let radii = zone.radii_mm.map(|r| r as f32 * scale);
            let shape = filled_ellipse(place(zone.centre_mm), radii, -zone.angle_deg as f32, FigureColour::Accent);
            drawing.add_shape(shape.with_opacity(opacity));
        }
        let edge = self.panel_mm as f32 * scale;
        let frame = StrokeStyle::new(FigureColour::Ink, 1.0);
        drawing.add_shape(framed_rect([middle[0] - edge / 2.0, middle[1] - edge / 2.0], [edge, edge], frame));
        for point in &self.points_mm {
            drawing.add_shape(filled_ellipse(place(*point), [1.6, 1.6], 0.0, FigureColour::Ink));
        }
        let extent = zones.iter().map(|zone| (2.0 * zone.radii_mm[0], 2.0 * zone.radii_mm[1]));
        let (least, most) =
            extent.fold((f64::MAX, 0.0f64), |(least, most), (along, across)| (least.min(across), most.max(along)));
        drawing.add_shape(ink_label([left, top - 6.0], format!("{} kHz", number_text(hz / 1e3)), TextAnchor::Start));
        if most > 0.0 {
            let text = format!("{} zones, diameters {least:.0} to {most:.0} mm", zones.len());
            drawing.add_shape(ink_label([left, top + self.panel_px + 18.0], text, TextAnchor::Start));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_zone_is_turned_on_the_page_as_on_the_panel() {
        let zone = CoverageZone { centre_mm: [100.0, 50.0], radii_mm: [40.0, 20.0], angle_deg: 30.0 };
        let frequencies = vec![(2e3, vec![zone])];
        let figure = CoverageFigure { panel_mm: 600.0, points_mm: Vec::new(), frequencies, panel_px: 200.0 };
        let svg = figure.draw(&FigureNotes::default()).to_svg();
        assert!(svg.contains("rotate(-30 "), "y is downwards on the page");
        assert!(svg.contains("diameters 40 to 80 mm"));
    }
}
