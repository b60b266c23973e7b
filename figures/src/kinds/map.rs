//! Surfaces as points, close together if they reflect alike.

use echolake_dsp::components::PrincipalComponents;

use crate::canvas::colours::kind_colour;
use crate::canvas::drawing::{FigureColour, FigureDrawing, SMALL_PX, TextAnchor, filled_ellipse, sized_label};
use crate::canvas::font::{fitted_text, text_width};
use crate::canvas::frame::{PlotAxis, PlotFrame, draw_legend, legend_width};
use crate::canvas::notes::FigureNotes;

/// More points than these have no names.
const MOST_NAMES: usize = 60;
/// Width of a map, px.
const WIDTH_PX: f32 = 720.0;

/// A surface on the map.
#[derive(Debug, Clone, PartialEq)]
pub struct MapPosition {
    /// Its name.
    pub name: String,
    /// Its kind, which has a colour.
    pub kind: String,
    /// Coordinates along the two components, dB.
    pub position_db: [f64; 2],
}

/// Surfaces on the map.
#[derive(Debug, Clone, PartialEq)]
pub struct MapFigure {
    /// The surfaces.
    pub positions: Vec<MapPosition>,
    /// The components to the right and upwards, 0 the first.
    pub components: [usize; 2],
    /// Shares of the variance of both components.
    pub explained: [f64; 2],
    /// Width, px.
    pub width_px: f32,
}

impl MapFigure {
    /// Places surfaces by two of the components that were found. Each is given by its row there, its name and its kind.
    pub fn of_components<'a>(
        found: &PrincipalComponents,
        components: [usize; 2],
        surfaces: impl Iterator<Item = (usize, &'a str, &'a str)>,
    ) -> Self {
        let of = |values: &[f64]| components.map(|component| values.get(component).copied().unwrap_or(0.0));
        let position = |(row, name, kind): (usize, &str, &str)| MapPosition {
            name: name.to_owned(),
            kind: kind.to_owned(),
            position_db: of(&found.row_position(row)),
        };
        let positions = surfaces.map(position).collect();
        Self { positions, components, explained: of(&found.explained_shares()), width_px: WIDTH_PX }
    }

    /// Returns the title that a map has if it is given no other.
    pub fn default_title(surfaces: usize, unit: &str) -> String {
        format!("{surfaces} surfaces by their TNCE, {unit}")
    }

    /// Lays out the figure.
    pub fn draw(&self, notes: &FigureNotes) -> FigureDrawing {
        let mut kinds: Vec<&str> = self.positions.iter().map(|p| p.kind.as_str()).collect();
        kinds.sort_unstable();
        kinds.dedup();
        let room = self.width_px - 90.0;
        let entries: Vec<_> = kinds
            .iter()
            .enumerate()
            .map(|(i, kind)| (kind_colour(i), fitted_text(&kind.replace('_', " "), SMALL_PX, room - 26.0)))
            .collect();
        let rows = legend_rows(&entries, room);
        let top = 40.0 + rows.len() as f32 * 16.0;
        let height = (self.width_px - 80.0) * 0.8;
        let mut drawing = FigureDrawing::new(self.width_px, top + height + 62.0, notes);
        drawing.add_title();
        for (row, entries) in rows.iter().enumerate() {
            draw_legend(&mut drawing, [64.0, 42.0 + row as f32 * 16.0], entries);
        }
        let [x, y] = [0, 1].map(|axis| self.axis_range(axis));
        let frame = PlotFrame { left: 64.0, top, width: self.width_px - 80.0, height, x, y };
        frame.draw_grid(&mut drawing, &x.round_ticks(6), &y.round_ticks(6), true);
        let mut names = NameLabels::default();
        for surface in &self.positions {
            let kind = kinds.iter().position(|kind| *kind == surface.kind).unwrap_or(0);
            let at = frame.page_position(surface.position_db[0], surface.position_db[1]);
            drawing.add_shape(filled_ellipse(at, [4.0, 4.0], 0.0, kind_colour(kind)).with_opacity(0.85));
            if self.positions.len() <= MOST_NAMES {
                names.draw_name(&mut drawing, at, &surface.name);
            }
        }
        frame.draw_axes(&mut drawing);
        let [x_title, y_title] = [0, 1].map(|axis| {
            let number = self.components[axis] + 1;
            format!("Component {number}, dB ({:.0} % of the variance)", 100.0 * self.explained[axis])
        });
        frame.draw_titles(&mut drawing, &x_title, &y_title);
        drawing.add_origin();
        drawing
    }

    fn axis_range(&self, axis: usize) -> PlotAxis {
        let values = self.positions.iter().map(|p| p.position_db[axis]);
        let (low, high) = values.fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(v), high.max(v)));
        if low > high {
            return PlotAxis::linear(-1.0, 1.0);
        }
        let air = ((high - low) * 0.06).max(0.1);
        PlotAxis::linear(low - air, high + air)
    }
}

/// The names that are drawn already: left, right and baseline of each.
#[derive(Default)]
struct NameLabels {
    drawn: Vec<[f32; 3]>,
}

impl NameLabels {
    /// Draws a name beside its point, below those that are in its way.
    fn draw_name(&mut self, drawing: &mut FigureDrawing, [x, y]: [f32; 2], name: &str) {
        let width = text_width(name, SMALL_PX);
        let is_right = x + 8.0 + width <= drawing.width_px;
        let left = if is_right { x + 6.0 } else { x - 6.0 - width };
        let mut baseline = y + 3.5;
        let touches = |[from, to, line]: &[f32; 3], baseline: f32| {
            *from < left + width && left < *to && (line - baseline).abs() < SMALL_PX
        };
        while let Some([_, _, line]) = self.drawn.iter().find(|other| touches(other, baseline)) {
            baseline = line + SMALL_PX;
        }
        self.drawn.push([left, left + width, baseline]);
        drawing.add_shape(sized_label([left, baseline], name, TextAnchor::Start, SMALL_PX, FigureColour::Ink));
    }
}

fn legend_rows(entries: &[(FigureColour, String)], width: f32) -> Vec<Vec<(FigureColour, String)>> {
    let mut rows: Vec<Vec<_>> = vec![Vec::new()];
    let mut used = 0.0;
    for entry in entries {
        let own = legend_width(&entry.1);
        if used + own > width && used > 0.0 {
            rows.push(Vec::new());
            used = 0.0;
        }
        used += own;
        if let Some(row) = rows.last_mut() {
            row.push(entry.clone());
        }
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::canvas::drawing::ShapeGeometry;

    #[test]
    fn names_at_one_place_are_below_each_other() {
        let position = |name: &str| MapPosition { name: name.into(), kind: "brick".into(), position_db: [1.0, 2.0] };
        let positions = ["0011_1", "0012_1", "0013_1"].map(position).to_vec();
        let figure = MapFigure { positions, components: [0, 2], explained: [0.7, 0.2], width_px: 400.0 };
        let drawing = figure.draw(&FigureNotes::default());
        assert!(drawing.to_svg().contains("Component 3, dB (20 % of the variance)"));
        let baselines: Vec<f32> = drawing
            .shapes
            .iter()
            .filter_map(|shape| match &shape.geometry {
                ShapeGeometry::Text { at, text, .. } if text.ends_with("_1") => Some(at[1]),
                _ => None,
            })
            .collect();
        assert_eq!(baselines.len(), 3);
        assert!(baselines.windows(2).all(|two| two[1] - two[0] >= SMALL_PX), "{baselines:?}");
    }
}
