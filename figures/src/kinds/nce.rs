//! Cumulative energy of the bands over time, stacked.

use crate::canvas::colours::band_colour;
use crate::canvas::drawing::{
    FigureColour, FigureDrawing, StrokeStyle, TEXT_PX, TextAnchor, filled_area, ink_label, stroked_line,
};
use crate::canvas::font::fitted_text;
use crate::canvas::frame::{PlotAxis, PlotFrame, draw_legend};
use crate::canvas::notes::FigureNotes;

const LEFT: f32 = 62.0;
const BETWEEN: f32 = 26.0;
const BETWEEN_ROWS: f32 = 78.0;
const TOP: f32 = 64.0;

/// Curves of a surface.
#[derive(Debug, Clone, PartialEq)]
pub struct NcePanel {
    /// Its heading.
    pub title: String,
    /// By band, then by time: energy over Flat's total.
    pub bands: Vec<Vec<f32>>,
    /// Flat's total over time, drawn as a dashed line; empty for none.
    pub flat_total: Vec<f32>,
}

/// Stacked NCE curves of one or more surfaces side by side.
#[derive(Debug, Clone, PartialEq)]
pub struct NceFigure {
    /// Names of the bands.
    pub bands: Vec<String>,
    /// Times of the curves' values, ms.
    pub time_ms: Vec<f64>,
    /// The surfaces.
    pub panels: Vec<NcePanel>,
    /// Width of a panel, px.
    pub panel_px: f32,
    /// Panels in a row.
    pub columns: usize,
    /// Draws title and origin around the panels. Without it a page has them.
    pub with_caption: bool,
}

impl NceFigure {
    /// Returns the title of curves that are means over all pairs, or over those of a grid point.
    pub fn default_title(point: Option<&str>) -> String {
        let pairs = point.map_or_else(|| "all pairs".to_owned(), |point| format!("the pairs of point {point}"));
        format!("NCE stacked by band, mean over {pairs}")
    }

    /// Lays out the figure.
    pub fn draw(&self, notes: &FigureNotes) -> FigureDrawing {
        let columns = self.columns.clamp(1, self.panels.len().max(1));
        let rows = self.panels.len().div_ceil(columns).max(1);
        let (top, foot) = if self.with_caption { (TOP + 18.0, 62.0) } else { (30.0, 42.0) };
        let plot =
            [self.panel_px - LEFT + if columns > 1 { 20.0 } else { -12.0 }, (self.panel_px * 0.55).clamp(160.0, 320.0)];
        let step = [plot[0] + BETWEEN, plot[1] + BETWEEN_ROWS];
        let width = LEFT + columns as f32 * step[0] - BETWEEN + 14.0;
        let height = top + rows as f32 * step[1] - BETWEEN_ROWS + foot;
        let mut drawing = FigureDrawing::new(width, height, notes);
        if self.with_caption {
            drawing.add_title();
        }
        let legend_y = if self.with_caption { 44.0 } else { 14.0 };
        let mut entries: Vec<_> =
            self.bands.iter().enumerate().map(|(i, name)| (band_colour(i), name.clone())).collect();
        if self.panels.iter().any(|panel| !panel.flat_total.is_empty()) {
            entries.push((FigureColour::Ink, "Flat, total (dashed)".into()));
        }
        draw_legend(&mut drawing, [LEFT, legend_y], &entries);
        let stacks: Vec<_> = self.panels.iter().map(NcePanel::stack_bands).collect();
        let values = stacks.iter().flatten().chain(self.panels.iter().map(|panel| &panel.flat_total)).flatten();
        let highest = values.filter(|value| value.is_finite()).fold(0.0f32, |most, value| most.max(*value));
        let y = PlotAxis::linear(0.0, f64::from(highest) * 1.05);
        // To the end of the last sample, which is a round number.
        let step_ms = self.time_ms.last().copied().unwrap_or(1.0) / (self.time_ms.len().max(2) - 1) as f64;
        let x = PlotAxis::linear(0.0, self.time_ms.last().copied().unwrap_or(1.0) + step_ms);
        for (place, (panel, stack)) in self.panels.iter().zip(&stacks).enumerate() {
            let is_first = place % columns == 0;
            let left = LEFT + (place % columns) as f32 * step[0];
            let top = top + (place / columns) as f32 * step[1];
            let frame = PlotFrame { left, top, width: plot[0], height: plot[1], x, y };
            frame.draw_grid(&mut drawing, &x.round_ticks(5), &y.round_ticks(5), is_first);
            self.draw_stack(&mut drawing, &frame, stack);
            if !panel.flat_total.is_empty() {
                let dashed = StrokeStyle { dash_px: 5.0, ..StrokeStyle::new(FigureColour::Ink, 1.4) };
                drawing.add_shape(stroked_line(self.curve_points(&frame, &panel.flat_total), dashed));
            }
            frame.draw_axes(&mut drawing);
            frame.draw_titles(&mut drawing, "Time, ms", if is_first { "NCE over Flat\u{2019}s total" } else { "" });
            if self.with_caption {
                let title = fitted_text(&panel.title, TEXT_PX, plot[0]);
                drawing.add_shape(ink_label([left, top - 12.0], title, TextAnchor::Start));
            }
        }
        if self.with_caption {
            drawing.add_origin();
        }
        drawing
    }

    fn curve_points(&self, frame: &PlotFrame, values: &[f32]) -> Vec<[f32; 2]> {
        let known = self.time_ms.iter().zip(values).filter(|(_, value)| value.is_finite());
        known.map(|(time, value)| frame.page_position(*time, f64::from(*value))).collect()
    }

    fn draw_stack(&self, drawing: &mut FigureDrawing, frame: &PlotFrame, stack: &[Vec<f32>]) {
        let mut below = vec![0.0; self.time_ms.len()];
        for (band, sums) in stack.iter().enumerate() {
            let mut points = self.curve_points(frame, sums);
            points.extend(self.curve_points(frame, &below).into_iter().rev());
            drawing.add_shape(filled_area(points, band_colour(band)).with_data("band", band));
            below.clone_from(sums);
        }
    }
}

impl NcePanel {
    /// Returns each band on top of those below it.
    fn stack_bands(&self) -> Vec<Vec<f32>> {
        let mut sums: Vec<Vec<f32>> = Vec::new();
        for curve in &self.bands {
            let under = sums.last().map_or(&[][..], |last| last);
            let sum = curve.iter().enumerate().map(|(i, value)| value + under.get(i).copied().unwrap_or(0.0)).collect();
            sums.push(sum);
        }
        sums
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bands_are_on_top_of_each_other() {
        let panel =
            NcePanel { title: "a".into(), bands: vec![vec![0.0, 0.25], vec![0.0, 0.5]], flat_total: vec![0.0, 1.0] };
        assert_eq!(panel.stack_bands(), [[0.0, 0.25], [0.0, 0.75]]);
        let bands = vec!["2.5 kHz".into(), "5 kHz".into()];
        let time_ms = vec![0.0, 4.0];
        let mut figure =
            NceFigure { bands, time_ms, panels: vec![panel.clone()], panel_px: 400.0, columns: 2, with_caption: false };
        let svg = figure.draw(&FigureNotes::default()).to_svg();
        assert_eq!(svg.matches("data-band=").count(), 2);
        assert!(svg.contains("stroke-dasharray"), "Flat is dashed");
        figure.panels = vec![panel; 5];
        figure.panels[3].bands[1] = vec![f32::NAN, f32::INFINITY];
        let drawing = figure.draw(&FigureNotes::default());
        assert_eq!(drawing.to_svg().matches("data-band=").count(), 10);
        assert!(drawing.width_px < 900.0 && drawing.height_px > 700.0, "three rows of two");
        assert!(!drawing.to_svg().contains("NaN") && !drawing.to_svg().contains("inf"));
    }
}
