//! Surfaces as points, close together if they reflect alike.

use std::collections::HashMap;

use echolake_dsp::components::PrincipalComponents;
use echolake_dsp::self_organising_map::SelfOrganisingMap;

use crate::canvas::colours::{KIND_COUNT, kind_colour};
use crate::canvas::drawing::{
    DrawnShape, FigureColour, FigureDrawing, SMALL_PX, StrokeStyle, TextAnchor, filled_area, filled_ellipse,
    sized_label, stroked_line,
};
use crate::canvas::font::{fitted_text, text_width};
use crate::canvas::frame::{PlotAxis, PlotFrame, legend_width};
use crate::canvas::notes::FigureNotes;

/// More points than these have no names.
const MOST_NAMES: usize = 60;
/// Width of a map, px.
const WIDTH_PX: f32 = 720.0;
/// Opacity of the unit that is farthest from those beside it.
const DARKEST_UNIT: f64 = 0.35;
/// Distance of surfaces that share a unit, units, and the golden angle of the spiral that they stand on.
const SPIRAL_STEP: f64 = 0.09;
const GOLDEN_ANGLE: f64 = 2.399_96;

/// A surface on the map.
#[derive(Debug, Clone, PartialEq)]
pub struct MapPosition {
    /// Its name; none if it is empty.
    pub name: String,
    /// Its kind, which has a colour.
    pub kind: String,
    /// Coordinates: along the two components in dB, in units of a self-organising map, or two figures.
    pub position: [f64; 2],
}

/// What the plane of a map is.
#[derive(Debug, Clone, PartialEq)]
pub enum MapPlane {
    /// Two principal components.
    Components {
        /// Those to the right and upwards, 0 the first.
        indices: [usize; 2],
        /// Their shares of the variance.
        explained: [f64; 2],
    },
    /// Units of a self-organising map.
    Units {
        /// Columns and rows.
        size: [usize; 2],
        /// Mean distance of each unit from those beside it, row by row.
        borders: Vec<f64>,
    },
    /// Two figures of panels.
    Figures {
        /// Titles of the axes.
        titles: [String; 2],
        /// Points that no other is better than in both, in the order of the first.
        front: Vec<[f64; 2]>,
    },
}

/// Surfaces on the map.
#[derive(Debug, Clone, PartialEq)]
pub struct MapFigure {
    /// The surfaces.
    pub positions: Vec<MapPosition>,
    /// What they are placed on.
    pub plane: MapPlane,
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
            position: of(&found.row_position(row)),
        };
        let positions = surfaces.map(position).collect();
        let plane = MapPlane::Components { indices: components, explained: of(&found.explained_shares()) };
        Self { positions, plane, width_px: WIDTH_PX }
    }

    /// Places surfaces on their units. Each is given by its row, its name and its kind; those of one unit stand around
    /// its middle.
    pub fn of_units<'a>(map: &SelfOrganisingMap, surfaces: impl Iterator<Item = (usize, &'a str, &'a str)>) -> Self {
        let mut members: HashMap<[usize; 2], usize> = HashMap::new();
        let position = |(row, name, kind): (usize, &str, &str)| {
            let unit = map.units[row];
            let before = members.entry(unit).or_default();
            let radius = SPIRAL_STEP * (*before as f64).sqrt();
            let angle = GOLDEN_ANGLE * *before as f64;
            *before += 1;
            let position = [unit[0] as f64 + radius * angle.cos(), unit[1] as f64 + radius * angle.sin()];
            MapPosition { name: name.to_owned(), kind: kind.to_owned(), position }
        };
        let positions = surfaces.map(position).collect();
        let plane = MapPlane::Units { size: map.size, borders: map.borders.clone() };
        Self { positions, plane, width_px: WIDTH_PX }
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
            .map(|(i, kind)| (i, fitted_text(&kind.replace('_', " "), SMALL_PX, room - 26.0)))
            .collect();
        let rows = legend_rows(&entries, room);
        let top = 40.0 + rows.len() as f32 * 16.0;
        let width = self.width_px - 80.0;
        let height = match &self.plane {
            MapPlane::Components { .. } | MapPlane::Figures { .. } => width * 0.8,
            MapPlane::Units { size: [columns, rows], .. } => width * *rows as f32 / (*columns).max(1) as f32,
        };
        let mut drawing = FigureDrawing::new(self.width_px, top + height + 62.0, notes);
        drawing.add_title();
        for (row, entries) in rows.iter().enumerate() {
            let mut x = 64.0;
            let y = 42.0 + row as f32 * 16.0;
            for (kind, name) in entries {
                drawing.add_shape(kind_mark(*kind, [x + 5.0, y - 4.0]));
                drawing.add_shape(sized_label([x + 14.0, y], name, TextAnchor::Start, SMALL_PX, FigureColour::Ink));
                x += legend_width(name);
            }
        }
        let [x, y] = [0, 1].map(|axis| self.axis_range(axis));
        let frame = PlotFrame { left: 64.0, top, width, height, x, y };
        match &self.plane {
            MapPlane::Units { size, borders } => draw_units(&mut drawing, &frame, *size, borders),
            MapPlane::Components { .. } | MapPlane::Figures { .. } => {
                frame.draw_grid(&mut drawing, &x.round_ticks(6), &y.round_ticks(6), true);
            }
        }
        if let MapPlane::Figures { front, .. } = &self.plane {
            let line = front.iter().map(|[x, y]| frame.page_position(*x, *y)).collect();
            drawing.add_shape(stroked_line(line, StrokeStyle::new(FigureColour::Ink, 1.0)));
        }
        let named = self.positions.iter().filter(|position| !position.name.is_empty()).count();
        let mut names = NameLabels::default();
        for surface in &self.positions {
            let kind = kinds.iter().position(|kind| *kind == surface.kind).unwrap_or(0);
            let at = frame.page_position(surface.position[0], surface.position[1]);
            drawing.add_shape(kind_mark(kind, at).with_opacity(0.85));
            if named <= MOST_NAMES && !surface.name.is_empty() {
                names.draw_name(&mut drawing, at, &surface.name);
            }
        }
        frame.draw_axes(&mut drawing);
        let [x_title, y_title] = match &self.plane {
            MapPlane::Components { indices, explained } => [0, 1].map(|axis| {
                let number = indices[axis] + 1;
                format!("Component {number}, dB ({:.0} % of the variance)", 100.0 * explained[axis])
            }),
            MapPlane::Units { .. } => {
                ["Units of the self-organising map; dark ones are borders between groups".to_owned(), String::new()]
            }
            MapPlane::Figures { titles, .. } => titles.clone(),
        };
        frame.draw_titles(&mut drawing, &x_title, &y_title);
        drawing.add_origin();
        drawing
    }

    fn axis_range(&self, axis: usize) -> PlotAxis {
        if let MapPlane::Units { size, .. } = &self.plane {
            return PlotAxis::linear(-0.5, size[axis] as f64 - 0.5);
        }
        let values = self.positions.iter().map(|p| p.position[axis]);
        let (low, high) = values.fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(v), high.max(v)));
        if low > high {
            return PlotAxis::linear(-1.0, 1.0);
        }
        let air = ((high - low) * 0.06).max(0.1);
        PlotAxis::linear(low - air, high + air)
    }
}

// A unit is as dark as it is far from those beside it.
fn draw_units(drawing: &mut FigureDrawing, frame: &PlotFrame, [columns, _]: [usize; 2], borders: &[f64]) {
    let farthest = borders.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
    for (unit, border) in borders.iter().enumerate() {
        let column = (unit % columns) as f64;
        let row = (unit / columns) as f64;
        let corners = [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]];
        let outline = corners.map(|[x, y]| frame.page_position(column + x, row + y)).to_vec();
        let shade = (DARKEST_UNIT * border / farthest) as f32;
        drawing.add_shape(filled_area(outline, FigureColour::Ink).with_opacity(shade).with_data("unit", unit));
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

// Colours begin again after some kinds, with another form.
fn kind_mark(kind: usize, [x, y]: [f32; 2]) -> DrawnShape {
    let corners = |corners: &[[f32; 2]]| {
        filled_area(corners.iter().map(|[right, down]| [x + right, y + down]).collect(), kind_colour(kind))
    };
    match kind / KIND_COUNT % 3 {
        0 => filled_ellipse([x, y], [4.0, 4.0], 0.0, kind_colour(kind)),
        1 => corners(&[[-3.5, -3.5], [3.5, -3.5], [3.5, 3.5], [-3.5, 3.5]]),
        _ => corners(&[[0.0, -4.5], [4.5, 3.5], [-4.5, 3.5]]),
    }
}

fn legend_rows(entries: &[(usize, String)], width: f32) -> Vec<Vec<(usize, String)>> {
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
        let position = |name: &str| MapPosition { name: name.into(), kind: "brick".into(), position: [1.0, 2.0] };
        let positions = ["0011_1", "0012_1", "0013_1"].map(position).to_vec();
        let plane = MapPlane::Components { indices: [0, 2], explained: [0.7, 0.2] };
        let figure = MapFigure { positions, plane, width_px: 400.0 };
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

    /// Bug 7: as many kinds as the paper's typologies can be told apart.
    #[test]
    fn twelve_kinds_have_twelve_marks() {
        let marks: Vec<_> = (0..12).map(|kind| format!("{:?}", kind_mark(kind, [0.0, 0.0]))).collect();
        for (i, mark) in marks.iter().enumerate() {
            assert!(!marks[..i].contains(mark), "{mark}");
        }
    }

    #[test]
    fn points_without_names_have_none() {
        let position =
            |name: &str, x: f64| MapPosition { name: name.into(), kind: "candidate".into(), position: [x, 0.0] };
        let positions = (0..100).map(|n| position("", f64::from(n))).chain([position("best_1", 3.0)]).collect();
        let titles = ["level".to_owned(), "scattering".to_owned()];
        let plane = MapPlane::Figures { titles, front: vec![[0.0, 0.0], [3.0, 0.0]] };
        let svg = MapFigure { positions, plane, width_px: 400.0 }.draw(&FigureNotes::default()).to_svg();
        assert_eq!(svg.matches("best_1").count(), 1);
        assert!(svg.contains("scattering"));
    }

    #[test]
    fn units_are_as_dark_as_they_are_far() {
        let units = vec![[0, 0], [2, 1], [2, 1]];
        let map = SelfOrganisingMap { size: [3, 2], units, borders: vec![0.0, 2.0, 1.0, 0.0, 0.0, 4.0] };
        let names = ["0011_1", "0012_1", "0013_1"];
        let figure = MapFigure::of_units(&map, names.iter().enumerate().map(|(row, name)| (row, *name, "brick")));
        assert_eq!([0, 1].map(|i| figure.positions[i].position), [[0.0, 0.0], [2.0, 1.0]]);
        assert_ne!(figure.positions[2].position, [2.0, 1.0], "it stands beside the other of its unit");
        let drawing = figure.draw(&FigureNotes::default());
        let shades: Vec<f32> =
            drawing.shapes.iter().filter(|shape| !shape.data.is_empty()).map(|shape| shape.opacity).collect();
        assert_eq!(shades, [0.0, 0.175, 0.0875, 0.0, 0.0, 0.35]);
    }
}
