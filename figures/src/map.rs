//! Surfaces as points, close together if they reflect alike.

use crate::colours::kind_colour;
use crate::drawing::{FigureColour, FigureDrawing, SMALL_PX, TextAnchor, ellipse, sized_label};
use crate::font::{fitted_text, text_width};
use crate::frame::{PlotAxis, PlotFrame, draw_legend};
use crate::notes::FigureNotes;

/// More points than these have no names.
const MOST_NAMES: usize = 60;

/// A surface on the map.
#[derive(Debug, Clone, PartialEq)]
pub struct MapPosition {
    /// Its name.
    pub name: String,
    /// Its kind, which has a colour.
    pub kind: String,
    /// Coordinates along the first two components, dB.
    pub position_db: [f64; 2],
}

/// Surfaces on the map.
#[derive(Debug, Clone, PartialEq)]
pub struct MapFigure {
    /// The surfaces.
    pub positions: Vec<MapPosition>,
    /// Shares of the variance of both components.
    pub explained: [f64; 2],
    /// Width, px.
    pub width_px: f32,
}

impl MapFigure {
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
        let [x, y] = [0, 1].map(|axis| self.range(axis));
        let frame = PlotFrame { left: 64.0, top, width: self.width_px - 80.0, height, x, y };
        frame.draw_grid(&mut drawing, &x.ticks(6), &y.ticks(6), true);
        for surface in &self.positions {
            let kind = kinds.iter().position(|kind| *kind == surface.kind).unwrap_or(0);
            let at = frame.place(surface.position_db[0], surface.position_db[1]);
            drawing.add(ellipse(at, [4.0, 4.0], 0.0, kind_colour(kind)).opaque(0.85));
            if self.positions.len() <= MOST_NAMES {
                let past = at[0] + 8.0 + text_width(&surface.name, SMALL_PX) > self.width_px;
                let (x, anchor) = if past { (at[0] - 6.0, TextAnchor::End) } else { (at[0] + 6.0, TextAnchor::Start) };
                drawing.add(sized_label([x, at[1] + 3.5], &surface.name, anchor, SMALL_PX, FigureColour::Ink));
            }
        }
        frame.draw_axes(&mut drawing);
        let title = |i: usize| format!("Component {}, dB ({:.0} % of the variance)", i + 1, 100.0 * self.explained[i]);
        frame.draw_titles(&mut drawing, &title(0), &title(1));
        drawing.add_origin();
        drawing
    }

    fn range(&self, axis: usize) -> PlotAxis {
        let values = self.positions.iter().map(|p| p.position_db[axis]);
        let (low, high) = values.fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(v), high.max(v)));
        if low > high {
            return PlotAxis::linear(-1.0, 1.0);
        }
        let air = ((high - low) * 0.06).max(0.1);
        PlotAxis::linear(low - air, high + air)
    }
}

fn legend_rows(entries: &[(FigureColour, String)], width: f32) -> Vec<Vec<(FigureColour, String)>> {
    let mut rows: Vec<Vec<_>> = vec![Vec::new()];
    let mut used = 0.0;
    for entry in entries {
        let own = 26.0 + text_width(&entry.1, SMALL_PX);
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
