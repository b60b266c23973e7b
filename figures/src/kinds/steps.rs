//! Steps of the processing, one below the other: the paper's figure of measured response, temperature correction and
//! removal of direct sound.

use crate::canvas::colours::kind_colour;
use crate::canvas::drawing::{FigureDrawing, StrokeStyle, TextAnchor, ink_label, stroked_line};
use crate::canvas::frame::{PlotAxis, PlotFrame, draw_legend, legend_width};
use crate::canvas::notes::FigureNotes;

const ROW: f32 = 150.0;
const BETWEEN: f32 = 58.0;

/// A response over time.
#[derive(Debug, Clone, PartialEq)]
pub struct ResponseTrace {
    /// Its name.
    pub name: String,
    /// Samples.
    pub samples: Vec<f32>,
    /// Time between samples, ms.
    pub step_ms: f64,
}

/// A step: the responses after it.
#[derive(Debug, Clone, PartialEq)]
pub struct StepsRow {
    /// Its heading.
    pub title: String,
    /// The responses.
    pub traces: Vec<ResponseTrace>,
}

/// Steps of the processing of a pair's response.
#[derive(Debug, Clone, PartialEq)]
pub struct StepsFigure {
    /// The steps, the first on top.
    pub rows: Vec<StepsRow>,
    /// Time that is shown, ms.
    pub from_ms: f64,
    /// End of the time that is shown, ms.
    pub to_ms: f64,
    /// Width, px.
    pub width_px: f32,
}

impl StepsFigure {
    /// Lays out the figure.
    pub fn draw(&self, notes: &FigureNotes) -> FigureDrawing {
        let height = 58.0 + self.rows.len() as f32 * (ROW + BETWEEN) + 24.0;
        let mut drawing = FigureDrawing::new(self.width_px, height, notes);
        drawing.add_title();
        let samples = self.rows.iter().flat_map(|row| &row.traces).flat_map(|trace| &trace.samples);
        let (low, high) =
            samples.filter(|x| x.is_finite()).fold((0.0f32, 0.0f32), |(low, high), x| (low.min(*x), high.max(*x)));
        let y = PlotAxis::linear(f64::from(low) * 1.05, f64::from(high) * 1.05);
        let x = PlotAxis::linear(self.from_ms, self.to_ms);
        for (place, row) in self.rows.iter().enumerate() {
            let top = 58.0 + place as f32 * (ROW + BETWEEN);
            let frame = PlotFrame { left: 70.0, top, width: self.width_px - 86.0, height: ROW, x, y };
            frame.draw_grid(&mut drawing, &x.round_ticks(8), &y.round_ticks(4), true);
            for (kind, trace) in row.traces.iter().enumerate() {
                let time = |i: usize| i as f64 * trace.step_ms;
                let samples = trace.samples.iter().enumerate().filter(|(_, sample)| sample.is_finite());
                let shown = samples.filter(|(i, _)| (self.from_ms..=self.to_ms).contains(&time(*i)));
                let points = shown.map(|(i, sample)| frame.page_position(time(i), f64::from(*sample))).collect();
                drawing.add_shape(stroked_line(points, StrokeStyle::new(kind_colour(kind), 1.2)));
            }
            frame.draw_axes(&mut drawing);
            frame.draw_titles(&mut drawing, "", "Amplitude");
            drawing.add_shape(ink_label([70.0, top - 10.0], &row.title, TextAnchor::Start));
            let entries: Vec<_> =
                row.traces.iter().enumerate().map(|(i, t)| (kind_colour(i), t.name.clone())).collect();
            let width: f32 = entries.iter().map(|(_, name)| legend_width(name)).sum();
            draw_legend(&mut drawing, [self.width_px - 16.0 - width, top - 10.0], &entries);
        }
        drawing.add_shape(ink_label([self.width_px / 2.0, height - 28.0], "Time, ms", TextAnchor::Middle));
        drawing.add_origin();
        drawing
    }
}
