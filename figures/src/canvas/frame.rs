//! The frame of a plot: axes with round numbers, and places of values in it.

use crate::canvas::drawing::{
    FigureColour, FigureDrawing, SMALL_PX, StrokeStyle, TextAnchor, filled_rect, ink_label, sized_label, stroked_line,
    upward_label,
};
use crate::canvas::font::text_width;

/// An axis: the range that it shows.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PlotAxis {
    pub low: f64,
    pub high: f64,
    pub is_log: bool,
}

impl PlotAxis {
    pub fn linear(low: f64, high: f64) -> Self {
        // A range of nothing would divide by it.
        let high = if high > low { high } else { low + 1.0 };
        Self { low, high, is_log: false }
    }

    pub fn log(low: f64, high: f64) -> Self {
        Self { low, high, is_log: true }
    }

    /// Returns where a value is, 0 at the low end, 1 at the high end; values beyond are at the ends.
    fn axis_share(self, value: f64) -> f64 {
        let share = if self.is_log {
            (value / self.low).ln() / (self.high / self.low).ln()
        } else {
            (value - self.low) / (self.high - self.low)
        };
        share.clamp(0.0, 1.0)
    }

    /// Returns about `count` round numbers in the range.
    pub fn round_ticks(self, count: usize) -> Vec<f64> {
        let step = round_step((self.high - self.low) / count.max(1) as f64);
        let [first, last] = [(self.low / step - 1e-9).ceil() as i64, (self.high / step + 1e-9).floor() as i64];
        (first..=last).map(|i| i as f64 * step).collect()
    }
}

fn round_step(raw: f64) -> f64 {
    let power = 10f64.powf(raw.log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * power).find(|step| *step >= raw * 0.999_999).unwrap_or(power)
}

/// A number as figures say it.
pub(crate) fn number_text(value: f64) -> String {
    let rounded = (value * 1e6).round() / 1e6;
    format!("{}", if rounded == 0.0 { 0.0 } else { rounded }).replace('-', "\u{2212}")
}

/// The place of a plot on its page, and its axes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PlotFrame {
    pub left: f32,
    pub top: f32,
    pub width: f32,
    pub height: f32,
    pub x: PlotAxis,
    pub y: PlotAxis,
}

impl PlotFrame {
    /// Returns where a value is on the page.
    pub fn page_position(&self, x: f64, y: f64) -> [f32; 2] {
        let x = self.left + self.width * self.x.axis_share(x) as f32;
        [x, self.top + self.height * (1.0 - self.y.axis_share(y)) as f32]
    }

    /// Draws lines at ticks, and their numbers; those of y only if they are asked for.
    pub fn draw_grid(&self, drawing: &mut FigureDrawing, x_ticks: &[f64], y_ticks: &[f64], with_y: bool) {
        let rule = StrokeStyle::new(FigureColour::Rule, 1.0);
        for tick in y_ticks {
            let [_, y] = self.page_position(self.x.low, *tick);
            drawing.add_shape(stroked_line(vec![[self.left, y], [self.left + self.width, y]], rule));
            if with_y {
                let at = [self.left - 6.0, y + 4.0];
                drawing.add_shape(ink_label(at, number_text(*tick), TextAnchor::End));
            }
        }
        for tick in x_ticks {
            let [x, _] = self.page_position(*tick, self.y.low);
            drawing.add_shape(stroked_line(vec![[x, self.top], [x, self.top + self.height]], rule));
            drawing.add_shape(ink_label([x, self.top + self.height + 16.0], number_text(*tick), TextAnchor::Middle));
        }
    }

    /// Draws the axes; to be called after what they frame.
    pub fn draw_axes(&self, drawing: &mut FigureDrawing) {
        let [right, bottom] = [self.left + self.width, self.top + self.height];
        let corner = vec![[self.left, self.top], [self.left, bottom], [right, bottom]];
        drawing.add_shape(stroked_line(corner, StrokeStyle::new(FigureColour::Ink, 1.0)));
    }

    /// Draws the titles of the axes.
    pub fn draw_titles(&self, drawing: &mut FigureDrawing, x: &str, y: &str) {
        let bottom = self.top + self.height;
        drawing.add_shape(ink_label([self.left + self.width / 2.0, bottom + 34.0], x, TextAnchor::Middle));
        if !y.is_empty() {
            drawing.add_shape(upward_label([self.left - 44.0, self.top + self.height / 2.0], y));
        }
    }
}

/// Draws a line of coloured squares with their names from a point to the right.
pub(crate) fn draw_legend(drawing: &mut FigureDrawing, [x, y]: [f32; 2], entries: &[(FigureColour, String)]) {
    let mut x = x;
    for (colour, name) in entries {
        drawing.add_shape(filled_rect([x, y - 9.0], [10.0, 10.0], *colour));
        drawing.add_shape(sized_label([x + 14.0, y], name, TextAnchor::Start, SMALL_PX, FigureColour::Ink));
        x += legend_width(name);
    }
}

/// Returns the room of a legend's entry, with the space behind it.
pub(crate) fn legend_width(name: &str) -> f32 {
    // Viewers that lack the font take a wider one.
    26.0 + 1.15 * text_width(name, SMALL_PX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round() {
        assert_eq!(PlotAxis::linear(0.0, 4.0).round_ticks(4), [0.0, 1.0, 2.0, 3.0, 4.0]);
        assert_eq!(PlotAxis::linear(0.0, 1.05).round_ticks(5), [0.0, 0.5, 1.0]);
        let ticks: Vec<_> = PlotAxis::linear(-0.013, 0.021).round_ticks(4).into_iter().map(number_text).collect();
        assert_eq!(ticks, ["\u{2212}0.01", "0", "0.01", "0.02"]);
    }
}
