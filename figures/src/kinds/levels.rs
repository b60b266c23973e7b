//! Levels of surfaces by band with error bars, one series per surface.

use crate::canvas::colours::{KIND_COUNT, kind_colour};
use crate::canvas::drawing::{
    FigureColour, FigureDrawing, SMALL_PX, StrokeStyle, TEXT_PX, TextAnchor, filled_ellipse, filled_rect, sized_label,
    stroked_line,
};
use crate::canvas::font::text_width;
use crate::canvas::frame::{PlotAxis, PlotFrame, draw_legend, legend_width};
use crate::canvas::notes::FigureNotes;
use crate::kinds::table::{FigureTable, TableRow};

const LEFT: f32 = 62.0;
const RIGHT: f32 = 14.0;
const PLOT_HEIGHT: f32 = 280.0;
const LEGEND_LINE: f32 = 18.0;
const DOT_PX: f32 = 3.5;
const CAP_PX: f32 = 3.5;
/// Standard uncertainties that hold 95 % of a normal distribution.
const COVERAGE_FACTOR: f64 = 1.96;
/// Share of a band's width that its series stand in, and the most that one of them takes.
const SERIES_SHARE: f64 = 0.7;
const MOST_SERIES_SHARE: f64 = 0.12;
/// Half of the longest bar that the axis makes room for, dB: a band without energy has an uncertainty beyond all
/// bounds.
const MOST_BAR_DB: f64 = 6.0;
/// Room above and below the values, as a share of their range.
const MARGIN: f64 = 0.06;

/// Levels by band with error bars: rows are series, columns are bands, the last of which is the total.
#[derive(Debug, Clone, PartialEq)]
pub struct LevelsFigure {
    /// Levels and their standard uncertainties, dB.
    pub table: FigureTable,
    /// Unit of the levels, such as "dB re Flat total".
    pub unit: String,
    /// Width, px.
    pub width_px: f32,
    /// Draws title, explanation and origin around the plot. Without it a page has them.
    pub with_caption: bool,
}

impl LevelsFigure {
    /// Returns the title of levels in a unit such as "dB re Flat total".
    pub fn default_title(unit: &str) -> String {
        format!("Mean TNCE of the values up to the 90th percentile, {unit}")
    }

    /// Returns the title of levels without Foam's own reflection, or with it if it is not known.
    pub fn shown_title(unit: &str, has_foam: bool) -> String {
        let without = if has_foam { "with Foam\u{2019}s reflection" } else { "without Foam\u{2019}s reflection" };
        format!("Mean TNCE of the values up to the 90th percentile, {without}, {unit}")
    }

    /// Lays out the figure.
    pub fn draw(&self, notes: &FigureNotes) -> FigureDrawing {
        let legend = self.legend_lines();
        let legend_top = if self.with_caption { 44.0 } else { 14.0 };
        let top = legend_top + LEGEND_LINE * legend.len() as f32;
        let foot = if self.with_caption { 62.0 } else { 28.0 };
        let mut drawing = FigureDrawing::new(self.width_px, top + PLOT_HEIGHT + foot, notes);
        if self.with_caption {
            drawing.add_title();
        }
        for (line, entries) in legend.iter().enumerate() {
            draw_legend(&mut drawing, [LEFT, legend_top + LEGEND_LINE * line as f32], entries);
        }
        let bands = self.table.columns.len().max(1);
        let frame = PlotFrame {
            left: LEFT,
            top,
            width: self.width_px - LEFT - RIGHT,
            height: PLOT_HEIGHT,
            x: PlotAxis::linear(-0.5, bands as f64 - 0.5),
            y: self.level_axis(),
        };
        frame.draw_grid(&mut drawing, &[], &frame.y.round_ticks(7), true);
        self.draw_band_names(&mut drawing, &frame);
        let zero = [frame.page_position(-0.5, 0.0), frame.page_position(bands as f64 - 0.5, 0.0)];
        drawing.add_shape(stroked_line(zero.to_vec(), StrokeStyle::new(FigureColour::Quiet, 1.4)));
        for (series, row) in self.table.rows.iter().enumerate() {
            self.draw_series(&mut drawing, &frame, series, row);
        }
        frame.draw_axes(&mut drawing);
        frame.draw_titles(&mut drawing, "", &self.unit);
        if self.with_caption {
            let at = [LEFT, top + PLOT_HEIGHT + 36.0];
            let text = "Bars: 95 %, which is 1.96 times the standard uncertainty to either side";
            drawing.add_shape(sized_label(at, text, TextAnchor::Start, SMALL_PX, FigureColour::Quiet));
            drawing.add_origin();
        }
        drawing
    }

    fn legend_lines(&self) -> Vec<Vec<(FigureColour, String)>> {
        let mut lines = vec![Vec::new()];
        let mut x = LEFT;
        for (series, row) in self.table.rows.iter().enumerate() {
            let width = legend_width(&row.name);
            if x > LEFT && x + width > self.width_px {
                lines.push(Vec::new());
                x = LEFT;
            }
            x += width;
            if let Some(line) = lines.last_mut() {
                line.push((kind_colour(series), row.name.clone()));
            }
        }
        lines
    }

    // All levels with their bars, and 0 dB. Longer bars end at the ends of the axis.
    fn level_axis(&self) -> PlotAxis {
        let bands = 0..self.table.columns.len();
        let ends = self.table.rows.iter().flat_map(|row| bands.clone().filter_map(|band| bar_ends(row, band)));
        let held = ends.map(|[least, most]| {
            let excess = ((most - least) / 2.0 - MOST_BAR_DB).max(0.0);
            [least + excess, most - excess]
        });
        let [low, high] = held.fold([0.0f64, 0.0], |[low, high], [least, most]| [low.min(least), high.max(most)]);
        let margin = MARGIN * (high - low).max(0.5);
        PlotAxis::linear(low - margin, high + margin)
    }

    // Where names are wider than their bands, only every second one is drawn, or fewer.
    fn draw_band_names(&self, drawing: &mut FigureDrawing, frame: &PlotFrame) {
        let names = &self.table.columns;
        let step = frame.width / names.len().max(1) as f32;
        let widest = |size_px: f32| names.iter().map(|name| text_width(name, size_px)).fold(0.0, f32::max) + 6.0;
        let size_px = if widest(TEXT_PX) <= step { TEXT_PX } else { SMALL_PX };
        let every = (widest(size_px) / step).ceil().max(1.0) as usize;
        let last = names.len().saturating_sub(1);
        let bottom = frame.top + frame.height;
        for (band, name) in names.iter().enumerate().filter(|(band, _)| (last - band).is_multiple_of(every)) {
            let [x, _] = frame.page_position(band as f64, 0.0);
            drawing.add_shape(sized_label([x, bottom + 16.0], name, TextAnchor::Middle, size_px, FigureColour::Ink));
        }
        if names.len() > 1 {
            let [x, _] = frame.page_position(last as f64 - 0.5, 0.0);
            drawing.add_shape(filled_rect([x, frame.top], [1.0, frame.height], FigureColour::Rule));
        }
    }

    fn draw_series(&self, drawing: &mut FigureDrawing, frame: &PlotFrame, series: usize, row: &TableRow) {
        let count = self.table.rows.len() as f64;
        let step = (SERIES_SHARE / count).min(MOST_SERIES_SHARE);
        let offset = (series as f64 - (count - 1.0) / 2.0) * step;
        let level = |band: usize| row.values.get(band).copied().flatten().filter(|level| level.is_finite());
        let place = |band: usize| Some(frame.page_position(band as f64 + offset, level(band)?));
        let octaves = self.table.columns.len().saturating_sub(1);
        let dash_px = if series < KIND_COUNT { 0.0 } else { 4.0 };
        let line = StrokeStyle { dash_px, ..StrokeStyle::new(kind_colour(series), 1.2) };
        // The total is no band beside the last one.
        drawing.add_shape(stroked_line((0..octaves).filter_map(place).collect(), line));
        for band in 0..self.table.columns.len() {
            let Some([x, y]) = place(band) else { continue };
            let dot = filled_ellipse([x, y], [DOT_PX, DOT_PX], 0.0, kind_colour(series));
            drawing.add_shape(dot.with_data("series", series).with_data("band", band));
            let Some(ends) = bar_ends(row, band).filter(|[low, high]| low < high) else { continue };
            let bar = StrokeStyle::new(FigureColour::Ink, 1.0);
            let ends = ends.map(|end| frame.page_position(band as f64 + offset, end)[1]);
            drawing.add_shape(stroked_line(ends.map(|y| [x, y]).to_vec(), bar));
            for y in ends {
                drawing.add_shape(stroked_line(vec![[x - CAP_PX, y], [x + CAP_PX, y]], bar));
            }
        }
    }
}

// The ends of a level's bar; both are the level if its uncertainty is not known.
fn bar_ends(row: &TableRow, band: usize) -> Option<[f64; 2]> {
    let level = row.values.get(band).copied().flatten().filter(|level| level.is_finite())?;
    let half = COVERAGE_FACTOR * row.uncertainty(band).unwrap_or(0.0);
    Some([level - half, level + half])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn figure(levels: &[Option<f64>], uncertainties: &[Option<f64>]) -> LevelsFigure {
        let row = TableRow {
            name: "a".into(),
            values: levels.to_vec(),
            uncertainties: uncertainties.to_vec(),
            decimals: 2,
            is_percent: false,
        };
        let columns = ["2.5 kHz", "5 kHz", "Total"].map(str::to_owned).to_vec();
        let table = FigureTable { corner: "Surface".into(), columns, rows: vec![row], with_extremes: false };
        LevelsFigure { table, unit: "dB re Flat total".into(), width_px: 560.0, with_caption: true }
    }

    // The heights of dots, and those of the vertical bars' ends, px.
    fn drawn_heights(drawing: &FigureDrawing) -> (Vec<f32>, Vec<[f32; 2]>) {
        use crate::canvas::drawing::ShapeGeometry;
        let mut dots = Vec::new();
        let mut bars = Vec::new();
        for shape in &drawing.shapes {
            match &shape.geometry {
                ShapeGeometry::Ellipse { centre, .. } => dots.push(centre[1]),
                ShapeGeometry::Path { points, .. } if shape.stroke.is_some_and(|s| s.colour == FigureColour::Ink) => {
                    if let [from, to] = points[..]
                        && from[0] == to[0]
                    {
                        bars.push([from[1], to[1]]);
                    }
                }
                _ => {}
            }
        }
        (dots, bars)
    }

    #[test]
    fn dots_are_levels_and_bars_are_95_percent() {
        let drawing =
            figure(&[Some(0.0), Some(-2.0), Some(1.0)], &[None, Some(0.5), Some(0.25)]).draw(&FigureNotes::default());
        let (dots, bars) = drawn_heights(&drawing);
        let px_per_db = dots[0] - dots[2];
        assert!(px_per_db > 20.0 && (dots[1] - dots[0] - 2.0 * px_per_db).abs() < 0.01, "{dots:?}");
        for (bar, [dot, u]) in bars.iter().zip([[dots[1], 0.5], [dots[2], 0.25]]) {
            let half = 1.96 * u * px_per_db;
            assert!((bar[0] - dot - half).abs() < 0.01 && (dot - bar[1] - half).abs() < 0.01, "{bar:?}");
        }
        assert_eq!(bars.len(), 2, "no bar without an uncertainty");
    }

    #[test]
    fn what_is_not_known_is_not_drawn() {
        let drawing = figure(&[None, Some(f64::NAN), None], &[]).draw(&FigureNotes::default());
        assert_eq!(drawn_heights(&drawing), (vec![], vec![]));
        assert!(!drawing.to_svg().contains("NaN"));
    }

    #[test]
    fn a_bar_beyond_all_bounds_leaves_room_for_levels() {
        let drawing =
            figure(&[Some(0.0), Some(-2.0), Some(1.0)], &[None, Some(1e6), None]).draw(&FigureNotes::default());
        let (dots, bars) = drawn_heights(&drawing);
        assert!(dots[1] - dots[0] > 30.0, "{dots:?}");
        assert!(bars[0][0] - bars[0][1] > 279.0, "{bars:?}");
    }

    #[test]
    fn names_of_many_bands_do_not_overlap() {
        let mut figure = figure(&[], &[]);
        figure.table.columns = (0..12).map(|band| format!("{} Hz", 125 << band)).chain(["Total".to_owned()]).collect();
        figure.width_px = 340.0;
        let svg = figure.draw(&FigureNotes::default()).to_svg();
        assert!(svg.contains(">Total</text>") && svg.matches(" Hz</text>").count() < 6, "{svg}");
    }
}
