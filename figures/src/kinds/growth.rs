//! Costs over sizes, on logarithmic axes: what grows in proportion has the slope of the dashed line.

use crate::canvas::colours::kind_colour;
use crate::canvas::drawing::{FigureColour, FigureDrawing, StrokeStyle, stroked_line};
use crate::canvas::frame::{PlotAxis, PlotFrame, draw_legend};
use crate::canvas::notes::FigureNotes;

const HEIGHT: f32 = 320.0;
const TOP: f32 = 112.0;
const LEFT: f32 = 62.0;
/// Entries of the legend in a line.
const ENTRIES: usize = 3;

/// Costs of several things over the same sizes.
#[derive(Debug, Clone, PartialEq)]
pub struct GrowthFigure {
    /// Title of the axis of sizes.
    pub size_title: String,
    /// Title of the axis of costs, with their unit.
    pub cost_title: String,
    /// Sizes in ascending order, over 0.
    pub sizes: Vec<f64>,
    /// Names and costs, one per size, over 0.
    pub costs: Vec<(String, Vec<f64>)>,
    /// Width, px.
    pub width_px: f32,
}

impl GrowthFigure {
    /// Lays out the figure.
    pub fn draw(&self, notes: &FigureNotes) -> FigureDrawing {
        let mut drawing = FigureDrawing::new(self.width_px, TOP + HEIGHT + 62.0, notes);
        drawing.add_title();
        let x = decades(&self.sizes);
        let y = decades(&self.costs.iter().flat_map(|(_, costs)| costs).copied().collect::<Vec<_>>());
        let frame = PlotFrame { left: LEFT, top: TOP, width: self.width_px - LEFT - 16.0, height: HEIGHT, x, y };
        frame.draw_grid(&mut drawing, &self.sizes, &powers_of_ten(y), true);
        let rise = (x.high / x.low).min(y.high / y.low);
        let diagonal = vec![frame.page_position(x.low, y.low), frame.page_position(x.low * rise, y.low * rise)];
        let dashed = StrokeStyle { dash_px: 5.0, ..StrokeStyle::new(FigureColour::Quiet, 1.2) };
        drawing.add_shape(stroked_line(diagonal, dashed));
        let mut entries = Vec::new();
        for (number, (name, costs)) in self.costs.iter().enumerate() {
            let points = self.sizes.iter().zip(costs).map(|(size, cost)| frame.page_position(*size, *cost)).collect();
            drawing.add_shape(stroked_line(points, StrokeStyle::new(kind_colour(number), 2.0)));
            entries.push((kind_colour(number), name.clone()));
        }
        entries.push((FigureColour::Quiet, "in proportion (dashed)".into()));
        for (line, entries) in entries.chunks(ENTRIES).enumerate() {
            draw_legend(&mut drawing, [LEFT, 48.0 + 18.0 * line as f32], entries);
        }
        frame.draw_axes(&mut drawing);
        frame.draw_titles(&mut drawing, &self.size_title, &self.cost_title);
        drawing.add_origin();
        drawing
    }
}

// An axis from the power of ten at or below all values to the one above them.
fn decades(values: &[f64]) -> PlotAxis {
    let known = || values.iter().copied().filter(|value| *value > 0.0 && value.is_finite());
    let low = 10f64.powf(known().fold(f64::INFINITY, f64::min).min(1e9).log10().floor());
    let high = 10f64.powf(known().fold(0.0, f64::max).log10().ceil());
    PlotAxis::log(low, high.max(low * 10.0))
}

fn powers_of_ten(axis: PlotAxis) -> Vec<f64> {
    std::iter::successors(Some(axis.low), |tick| Some(tick * 10.0))
        .take_while(|tick| *tick <= axis.high * 1.01)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_are_whole_decades() {
        let axis = decades(&[0.03, 2.0, 0.0, f64::NAN]);
        assert!((axis.low - 0.01).abs() < 1e-12 && (axis.high - 10.0).abs() < 1e-9);
        assert_eq!(powers_of_ten(axis).len(), 4);
        let costs = vec![("a".to_owned(), vec![0.03, 2.0]), ("b".to_owned(), vec![f64::NAN, 1.0])];
        let figure = GrowthFigure {
            size_title: "surfaces".into(),
            cost_title: "s".into(),
            sizes: vec![10.0, 350.0],
            costs,
            width_px: 640.0,
        };
        assert!(!figure.draw(&FigureNotes::default()).to_svg().contains("inf"));
    }
}
