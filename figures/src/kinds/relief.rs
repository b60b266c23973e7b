//! Reliefs in oblique light, side by side, to one scale.

use crate::canvas::drawing::{
    FigureColour, FigureDrawing, SMALL_PX, StrokeStyle, TEXT_PX, TextAnchor, framed_rect, ink_label, picture_shape,
    sized_label, stroked_line,
};
use crate::canvas::font::fitted_text;
use crate::canvas::notes::FigureNotes;

/// The relief of a surface.
#[derive(Debug, Clone, PartialEq)]
pub struct ReliefPanel {
    /// Its heading.
    pub title: String,
    /// Brightness of its cells in oblique light, rows from the top.
    pub shaded: Vec<u8>,
    /// Cells in a row.
    pub cells: usize,
    /// Lowest and highest point, mm.
    pub extent_mm: [f64; 2],
}

/// Reliefs of one or more surfaces.
#[derive(Debug, Clone, PartialEq)]
pub struct ReliefFigure {
    /// The surfaces.
    pub panels: Vec<ReliefPanel>,
    /// Edge of the panel, mm.
    pub panel_mm: f64,
    /// Width of a relief, px.
    pub panel_px: f32,
    /// Reliefs in a row.
    pub columns: usize,
}

impl ReliefFigure {
    /// Lays out the figure.
    pub fn draw(&self, notes: &FigureNotes) -> FigureDrawing {
        let side = self.panel_px;
        let columns = self.columns.clamp(1, self.panels.len().max(1));
        let rows = self.panels.len().div_ceil(columns);
        let step = [side + 14.0, side + 46.0];
        let height = 36.0 + rows as f32 * step[1] + 40.0;
        let mut drawing = FigureDrawing::new(24.0 + columns as f32 * step[0] - 14.0, height, notes);
        drawing.add_title();
        for (place, panel) in self.panels.iter().enumerate() {
            let [x, y] = [12.0 + (place % columns) as f32 * step[0], 36.0 + (place / columns) as f32 * step[1]];
            drawing.add_shape(ink_label([x, y + 12.0], fitted_text(&panel.title, TEXT_PX, side), TextAnchor::Start));
            drawing.add_shape(picture_shape([x, y + 18.0], side, panel.shaded.clone(), panel.cells));
            drawing.add_shape(framed_rect([x, y + 18.0], [side, side], StrokeStyle::new(FigureColour::Quiet, 0.5)));
            let [low, high] = panel.extent_mm;
            let text = format!("{low:.1} to {high:.1} mm").replace('-', "\u{2212}");
            drawing.add_shape(sized_label(
                [x, y + side + 30.0],
                text,
                TextAnchor::Start,
                SMALL_PX,
                FigureColour::Quiet,
            ));
        }
        self.draw_scale(&mut drawing, height - 24.0);
        drawing.add_origin();
        drawing
    }

    fn draw_scale(&self, drawing: &mut FigureDrawing, y: f32) {
        let bar = self.panel_px * 100.0 / self.panel_mm as f32;
        drawing.add_shape(stroked_line(vec![[12.0, y], [12.0 + bar, y]], StrokeStyle::new(FigureColour::Ink, 2.0)));
        drawing.add_shape(sized_label([12.0, y + 14.0], "100 mm", TextAnchor::Start, SMALL_PX, FigureColour::Ink));
    }
}
