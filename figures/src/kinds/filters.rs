//! The filter bank: gains of the bands over frequency, and the sum of their squares, which is 1.

use echolake_dsp::filter_bank::band_gain;

use crate::canvas::colours::band_colour;
use crate::canvas::drawing::{FigureColour, FigureDrawing, StrokeStyle, stroked_line};
use crate::canvas::frame::{PlotAxis, PlotFrame, draw_legend};
use crate::canvas::notes::FigureNotes;

const POINTS: usize = 400;
const HEIGHT: f32 = 220.0;

/// The gains of a filter bank.
#[derive(Debug, Clone, PartialEq)]
pub struct FilterFigure {
    /// Centres of the bands, Hz.
    pub centres_hz: Vec<f64>,
    /// Lower limit of the sweep, Hz.
    pub low_hz: f64,
    /// Upper limit of the sweep, Hz.
    pub high_hz: f64,
    /// Width, px.
    pub width_px: f32,
}

impl FilterFigure {
    /// Lays out the figure.
    pub fn draw(&self, notes: &FigureNotes) -> FigureDrawing {
        let mut drawing = FigureDrawing::new(self.width_px, 76.0 + HEIGHT + 62.0, notes);
        drawing.add_title();
        let [first, last] =
            [self.centres_hz.first(), self.centres_hz.last()].map(|hz| hz.copied().unwrap_or(1e3) / 1e3);
        let x = PlotAxis::log((self.low_hz / 1e3).min(first) / 2.0, (self.high_hz / 1e3).max(last) * 1.25);
        let y = PlotAxis::linear(0.0, 1.1);
        let frame = PlotFrame { left: 62.0, top: 76.0, width: self.width_px - 78.0, height: HEIGHT, x, y };
        let ticks: Vec<_> = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 100.0]
            .into_iter()
            .filter(|t| (x.low..=x.high).contains(t))
            .collect();
        frame.draw_grid(&mut drawing, &ticks, &y.round_ticks(5), true);
        let edge = StrokeStyle { dash_px: 3.0, ..StrokeStyle::new(FigureColour::Quiet, 1.0) };
        for limit in [self.low_hz, self.high_hz] {
            drawing.add_shape(stroked_line(
                vec![frame.page_position(limit / 1e3, 0.0), frame.page_position(limit / 1e3, y.high)],
                edge,
            ));
        }
        let curve = |value: &dyn Fn(f64) -> f64| -> Vec<[f32; 2]> {
            let frequency = |i: usize| x.low * (x.high / x.low).powf(i as f64 / (POINTS - 1) as f64);
            (0..POINTS).map(frequency).map(|khz| frame.page_position(khz, value(1e3 * khz))).collect()
        };
        for band in 0..self.centres_hz.len() {
            let points = curve(&|hz| band_gain(&self.centres_hz, band, hz));
            drawing.add_shape(stroked_line(points, StrokeStyle::new(band_colour(band), 2.0)));
        }
        let sum =
            curve(&|hz| (0..self.centres_hz.len()).map(|band| band_gain(&self.centres_hz, band, hz).powi(2)).sum());
        drawing.add_shape(stroked_line(sum, StrokeStyle { dash_px: 5.0, ..StrokeStyle::new(FigureColour::Ink, 1.2) }));
        frame.draw_axes(&mut drawing);
        frame.draw_titles(&mut drawing, "Frequency, kHz", "Gain");
        let names = self.centres_hz.iter().enumerate().map(|(i, hz)| (band_colour(i), format!("{} kHz", hz / 1e3)));
        let entries: Vec<_> = names.chain([(FigureColour::Ink, "sum of squares (dashed)".into())]).collect();
        draw_legend(&mut drawing, [62.0, 48.0], &entries);
        drawing.add_origin();
        drawing
    }
}
