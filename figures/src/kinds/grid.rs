//! The paper's layered grid plot: levels of every point's pair with one microphone point, layers across, bands down.

use echolake_schema::{Grid, Point};

use crate::canvas::colours::{HIGH_DB, LOW_DB, LevelPalette, centred_colour, fitting_reach, paper_colour};
use crate::canvas::drawing::{
    FigureColour, FigureDrawing, SMALL_PX, StrokeStyle, TEXT_PX, TextAnchor, filled_rect, framed_rect, ink_label,
    sized_label,
};
use crate::canvas::font::{fitted_text, text_width};
use crate::canvas::frame::number_text;
use crate::canvas::notes::FigureNotes;

const GAP: f32 = 10.0;
const LABELS: f32 = 54.0;
const NARROW: f32 = 420.0;
const NARROW_LABELS: f32 = 46.0;
/// Space between the name of a band and its cells.
const LABEL_GAP: f32 = 6.0;
const HEADER: f32 = 22.0;
const CAPTION: f32 = 52.0;
const BETWEEN_PANELS: f32 = 24.0;
/// Greatest side of a cell, which a grid of a few points reaches.
const MOST_CELL_PX: f32 = 40.0;
/// Sides of a layer's only cell in the side of its block.
const SINGLE_CELL: f32 = 3.0;

/// A point of a layer: column along x, row along y.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GridPosition {
    /// Index of the point in a panel's levels.
    pub point: usize,
    /// Column along x, 0 the leftmost.
    pub column: usize,
    /// Row along y, 0 the lowest.
    pub row: usize,
}

/// A layer of the grid.
#[derive(Debug, Clone, PartialEq)]
pub struct GridLayer {
    /// Its heading.
    pub label: String,
    /// Its points.
    pub positions: Vec<GridPosition>,
}

impl GridLayer {
    /// Returns the layers of a rig's grid, by the order of their points along x and y.
    pub fn from_grid(grid: &Grid) -> Vec<Self> {
        let count = grid.points().iter().map(|point| point.layer + 1).max().unwrap_or(0);
        (0..count).map(|layer| Self::from_points(grid.points().iter().filter(|point| point.layer == layer))).collect()
    }

    fn from_points<'a>(points: impl Iterator<Item = &'a Point>) -> Self {
        let points: Vec<_> = points.collect();
        let ranks = |axis: usize| {
            let mut places: Vec<_> = points.iter().map(|point| point.position_mm[axis]).collect();
            places.sort_by(f64::total_cmp);
            places.dedup();
            places
        };
        let [columns, rows] = [ranks(0), ranks(1)];
        let rank = |places: &[f64], at: f64| places.iter().position(|place| *place == at).unwrap_or(0);
        let position = |point: &&Point| GridPosition {
            point: point.id.index(),
            column: rank(&columns, point.position_mm[0]),
            row: rank(&rows, point.position_mm[1]),
        };
        let label = points.first().map_or_else(String::new, |point| format!("{} mm", point.position_mm[2]));
        Self { label, positions: points.iter().map(position).collect() }
    }

    // The columns or the rows, whichever are more.
    fn cells_across(&self) -> usize {
        self.positions.iter().map(|position| position.column.max(position.row) + 1).max().unwrap_or(1)
    }
}

/// The levels of a band by point, dB; none if there is no value.
pub type BandLevels = Vec<Option<f64>>;

/// The levels of a surface.
#[derive(Debug, Clone, PartialEq)]
pub struct GridPanel {
    /// Its heading.
    pub title: String,
    /// By band.
    pub levels_db: Vec<BandLevels>,
    /// True if the values are differences of two levels.
    pub is_difference: bool,
}

impl GridPanel {
    /// Returns the panel of a surface: some bands of its levels. If there is a base, a surface and its levels, these
    /// are subtracted from those of every other surface.
    pub fn new(name: &str, levels_db: &[BandLevels], shown: &[usize], base: Option<(&str, &[BandLevels])>) -> Self {
        let own = shown.iter().filter_map(|band| levels_db.get(*band));
        let Some((base_name, base)) = base.filter(|(base_name, _)| *base_name != name) else {
            return Self { title: name.to_owned(), levels_db: own.cloned().collect(), is_difference: false };
        };
        let difference = |(own, other): (&Option<f64>, &Option<f64>)| Some((*own)? - (*other)?);
        let bases = shown.iter().filter_map(|band| base.get(*band));
        let levels_db = own.zip(bases).map(|(own, other)| own.iter().zip(other).map(difference).collect()).collect();
        Self { title: format!("{name} less {base_name}"), levels_db, is_difference: true }
    }
}

/// The colours of a grid plot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum GridScale {
    /// The paper's, from -20 to 6 dB.
    Paper,
    /// From -reach to reach.
    Centred {
        /// The end of the scale, dB.
        reach_db: f64,
    },
}

/// Grid plots of one or more surfaces side by side.
#[derive(Debug, Clone, PartialEq)]
pub struct GridFigure {
    /// Names of the bands.
    pub bands: Vec<String>,
    /// The layers, lowest first.
    pub layers: Vec<GridLayer>,
    /// The microphone's point.
    pub microphone: usize,
    /// The surfaces.
    pub panels: Vec<GridPanel>,
    /// Colours of levels. Differences, which the paper has none of, are always centred.
    pub palette: LevelPalette,
    /// Width of a panel, px.
    pub panel_px: f32,
    /// Panels in a row.
    pub columns: usize,
    /// Draws titles, scale and origin around the panels. Without it a page has them.
    pub with_caption: bool,
}

/// Places of the parts of a panel.
struct PanelLayout {
    labels: f32,
    side: f32,
    height: f32,
}

impl GridFigure {
    /// Returns the title of grid plots for a microphone point, whose levels have a unit such as "dB re Flat total".
    pub fn default_title(microphone: &str, unit: &str) -> String {
        format!("TNCE for microphone {microphone}, {unit}")
    }

    fn panel_layout(&self) -> PanelLayout {
        let least = if self.panel_px < NARROW { NARROW_LABELS } else { LABELS };
        let widest_name = self.bands.iter().map(|name| text_width(name, TEXT_PX)).fold(0.0, f32::max);
        let labels = least.max((widest_name + LABEL_GAP).ceil());
        let layers = self.layers.len().max(1) as f32;
        let widest = self.layers.iter().map(GridLayer::cells_across).max().unwrap_or(1);
        let most = MOST_CELL_PX * if widest == 1 { SINGLE_CELL } else { widest as f32 };
        let side = ((self.panel_px - labels - GAP * (layers - 1.0)) / layers).floor().clamp(12.0, most);
        PanelLayout { labels, side, height: HEADER + self.bands.len() as f32 * (side + GAP) }
    }

    /// Lays out the figure.
    pub fn draw(&self, notes: &FigureNotes) -> FigureDrawing {
        let layout = self.panel_layout();
        let columns = self.columns.clamp(1, self.panels.len().max(1));
        let rows = self.panels.len().div_ceil(columns);
        let (margin, top) = if self.with_caption { (12.0, 40.0) } else { (0.0, 0.0) };
        let title_px = if self.with_caption { 22.0 } else { 0.0 };
        let step = [self.panel_px + BETWEEN_PANELS, layout.height + title_px + 8.0];
        let width = columns as f32 * step[0] - BETWEEN_PANELS + 2.0 * margin;
        let height = top + rows as f32 * step[1] + if self.with_caption { CAPTION } else { -8.0 };
        let mut drawing = FigureDrawing::new(width, height, notes);
        if self.with_caption {
            drawing.add_title();
        }
        for (place, panel) in self.panels.iter().enumerate() {
            let at = [margin + (place % columns) as f32 * step[0], top + (place / columns) as f32 * step[1]];
            if self.with_caption {
                let title = fitted_text(&panel.title, TEXT_PX, self.panel_px - layout.labels);
                drawing.add_shape(ink_label([at[0] + layout.labels, at[1] + 10.0], title, TextAnchor::Start));
            }
            self.draw_panel(&mut drawing, panel, &layout, [at[0], at[1] + title_px]);
        }
        if self.with_caption {
            let at = [margin + layout.labels, top + rows as f32 * step[1] + 2.0];
            let mut scales: Vec<_> = self.panels.iter().map(|panel| self.panel_scale(panel)).collect();
            scales.dedup();
            for (i, scale) in scales.into_iter().take(2).enumerate() {
                draw_scale(&mut drawing, [at[0] + 300.0 * i as f32, at[1]], scale);
            }
            drawing.add_origin();
        }
        drawing
    }

    // All panels in the same colours have the same scale.
    fn panel_scale(&self, panel: &GridPanel) -> GridScale {
        let is_paper = |panel: &GridPanel| self.palette == LevelPalette::Paper && !panel.is_difference;
        if is_paper(panel) {
            return GridScale::Paper;
        }
        let centred = self.panels.iter().filter(|panel| !is_paper(panel));
        let values = centred.flat_map(|panel| panel.levels_db.iter().flatten().copied().flatten());
        GridScale::Centred { reach_db: fitting_reach(values) }
    }

    fn draw_panel(&self, drawing: &mut FigureDrawing, panel: &GridPanel, layout: &PanelLayout, [left, top]: [f32; 2]) {
        let scale = self.panel_scale(panel);
        let block_x = |layer: usize| left + layout.labels + layer as f32 * (layout.side + GAP);
        for (number, layer) in self.layers.iter().enumerate() {
            let at = [block_x(number) + layout.side / 2.0, top + 14.0];
            drawing.add_shape(sized_label(at, &layer.label, TextAnchor::Middle, TEXT_PX, FigureColour::Quiet));
        }
        for (band, name) in self.bands.iter().enumerate() {
            let row_top = top + HEADER + band as f32 * (layout.side + GAP);
            drawing.add_shape(ink_label([left, row_top + layout.side / 2.0 + 4.0], name, TextAnchor::Start));
            for (number, layer) in self.layers.iter().enumerate() {
                let block = BlockLayout::new(layer, layout.side, [block_x(number), row_top]);
                drawing.add_shape(filled_rect(
                    [block.x - 1.0, block.y - 1.0],
                    [block.size * block.columns as f32 + 2.0, block.size * block.rows as f32 + 2.0],
                    FigureColour::Block,
                ));
                for position in &layer.positions {
                    let level = panel.levels_db.get(band).and_then(|levels| *levels.get(position.point)?);
                    let level = level.filter(|level| !level.is_nan());
                    self.draw_cell(
                        drawing,
                        block.cell_corner(*position),
                        block.size,
                        (band, position.point, level),
                        scale,
                    );
                }
            }
        }
    }

    fn draw_cell(
        &self,
        drawing: &mut FigureDrawing,
        [x, y]: [f32; 2],
        size: f32,
        (band, point, level): (usize, usize, Option<f64>),
        scale: GridScale,
    ) {
        let is_microphone = point == self.microphone;
        let colour = level.map(|level| scale.level_rgb(level));
        let fill = match (is_microphone, colour) {
            (true, _) => FigureColour::Accent,
            (false, Some(rgb)) => FigureColour::Rgb(rgb),
            (false, None) => FigureColour::Block,
        };
        let cell = filled_rect([x, y], [size, size], fill);
        drawing.add_shape(cell.with_data("row", band).with_data("point", point));
        let text_px = (size * 0.7).floor().clamp(7.0, 13.0);
        let mark = match (is_microphone, level) {
            (true, _) => Some(("M", FigureColour::Paper)),
            (false, None) => Some(("+", FigureColour::Ink)),
            (false, Some(_)) => None,
        };
        if let Some((text, colour)) = mark {
            let at = [x + size / 2.0, y + size / 2.0 + text_px * 0.36];
            drawing.add_shape(sized_label(at, text, TextAnchor::Middle, text_px, colour));
        }
    }
}

/// Places of the cells of a layer: whole pixels, so that they touch.
struct BlockLayout {
    x: f32,
    y: f32,
    size: f32,
    columns: usize,
    rows: usize,
}

impl BlockLayout {
    fn new(layer: &GridLayer, side: f32, [x, y]: [f32; 2]) -> Self {
        let columns = layer.positions.iter().map(|p| p.column + 1).max().unwrap_or(1);
        let rows = layer.positions.iter().map(|p| p.row + 1).max().unwrap_or(1);
        let most = layer.cells_across();
        let size = if most == 1 { (side / SINGLE_CELL).floor() } else { ((side - 2.0) / most as f32).floor() };
        let size = size.max(1.0);
        let inset = |count: usize| ((side - size * count as f32) / 2.0).floor();
        Self { x: x + inset(columns), y: y + inset(rows), size, columns, rows }
    }

    // y grows upwards, as seen from above.
    fn cell_corner(&self, position: GridPosition) -> [f32; 2] {
        let row = self.rows - 1 - position.row;
        [self.x + self.size * position.column as f32, self.y + self.size * row as f32]
    }
}

impl GridScale {
    fn level_rgb(self, level_db: f64) -> [u8; 3] {
        match self {
            Self::Paper => paper_colour(level_db),
            Self::Centred { reach_db } => centred_colour(level_db, reach_db),
        }
    }
}

fn draw_scale(drawing: &mut FigureDrawing, [x, y]: [f32; 2], scale: GridScale) {
    const STEPS: usize = 52;
    const STEP_PX: f32 = 5.0;
    let (low, high, ticks) = match scale {
        GridScale::Paper => (LOW_DB, HIGH_DB, vec![-20.0, -10.0, 0.0, 6.0]),
        GridScale::Centred { reach_db } => {
            (-reach_db, reach_db, [-1.0, -0.5, 0.0, 0.5, 1.0].map(|share| share * reach_db).to_vec())
        }
    };
    for step in 0..STEPS {
        let value = low + (high - low) * step as f64 / (STEPS - 1) as f64;
        let at = [x + step as f32 * STEP_PX, y];
        drawing.add_shape(filled_rect(at, [STEP_PX + 0.2, 11.0], FigureColour::Rgb(scale.level_rgb(value))));
    }
    let width = STEPS as f32 * STEP_PX;
    drawing.add_shape(framed_rect([x, y], [width, 11.0], StrokeStyle::new(FigureColour::Quiet, 1.0)));
    for tick in ticks {
        let sign = if tick > 0.0 { "+" } else { "" };
        let text = format!("{sign}{}", number_text(tick));
        let at = [x + width * ((tick - low) / (high - low)) as f32, y + 24.0];
        drawing.add_shape(sized_label(at, &text, TextAnchor::Middle, SMALL_PX, FigureColour::Ink));
    }
    let last = [x + width + 8.0 + text_width("+6", SMALL_PX), y + 24.0];
    drawing.add_shape(sized_label(last, "dB", TextAnchor::Start, SMALL_PX, FigureColour::Ink));
}

#[cfg(test)]
mod tests {
    use super::*;

    fn figure(level: Option<f64>, palette: LevelPalette) -> GridFigure {
        let position = |point: usize| GridPosition { point, column: point / 2, row: point % 2 };
        let layers = vec![GridLayer { label: "124 mm".into(), positions: (0..4).map(position).collect() }];
        let levels_db = vec![vec![None, Some(0.0), Some(-20.0), level]];
        let panels = vec![GridPanel { title: "a<b".into(), levels_db, is_difference: false }];
        let bands = vec!["Total".into()];
        GridFigure { bands, layers, microphone: 0, panels, palette, panel_px: 200.0, columns: 1, with_caption: true }
    }

    fn cell(svg: &str, point: usize) -> &str {
        svg.lines().find(|line| line.contains(&format!("data-point=\"{point}\""))).expect("a cell")
    }

    #[test]
    fn cells_have_the_colours_of_their_levels() {
        let svg = figure(Some(6.0), LevelPalette::Paper).draw(&FigureNotes::default()).to_svg();
        for (point, colour) in [(0, "#0b5c8c"), (1, "#000000"), (2, "#ffffff"), (3, "#ff0000")] {
            assert!(cell(&svg, point).contains(&format!("fill=\"{colour}\"")), "{}", cell(&svg, point));
        }
        assert!(svg.contains(">M</text>") && !svg.contains(">+</text>"));
        assert!(svg.contains(">a&lt;b</text>"), "text is escaped");
        let unknown = figure(Some(f64::NAN), LevelPalette::Paper).draw(&FigureNotes::default()).to_svg();
        assert!(unknown.contains(">+</text>"), "NaN is no value");
        let none = figure(None, LevelPalette::Paper).draw(&FigureNotes::default()).to_svg();
        assert!(none.contains(">+</text>"), "a cell without a value has a cross");
    }

    // Left column below, then above: y grows upwards.
    #[test]
    fn cells_are_seen_from_above() {
        let svg = figure(Some(6.0), LevelPalette::Paper).draw(&FigureNotes::default()).to_svg();
        let number = |point: usize, name: &str| -> f64 {
            let rest = cell(&svg, point).split(&format!("{name}=\"")).nth(1).expect("an attribute");
            rest.split('"').next().expect("its end").parse().expect("a number")
        };
        assert_eq!(number(0, " x"), number(1, " x"));
        assert!(number(0, " y") > number(1, " y") && number(2, " x") > number(0, " x"));
    }

    #[test]
    fn a_base_is_subtracted_from_all_but_itself() {
        let own = [vec![Some(1.0)], vec![Some(10.0), Some(1.0), None]];
        let base = [vec![Some(2.0)], vec![Some(4.0), None, None]];
        let panel = GridPanel::new("a", &own, &[1], Some(("b", &base)));
        assert_eq!((panel.title.as_str(), panel.is_difference), ("a less b", true));
        assert_eq!(panel.levels_db, [[Some(6.0), None, None]]);
        let itself = GridPanel::new("b", &base, &[0, 1], Some(("b", &base)));
        assert_eq!((itself.title.as_str(), itself.is_difference, &itself.levels_db[..]), ("b", false, &base[..]));
    }

    // Two columns and two rows of 40 px, though the panel has room for more.
    #[test]
    fn few_points_have_small_cells() {
        let svg = figure(None, LevelPalette::Paper).draw(&FigureNotes::default()).to_svg();
        assert!(cell(&svg, 1).contains(" width=\"39\""), "{}", cell(&svg, 1));
    }

    #[test]
    fn names_of_bands_end_before_their_cells() {
        let mut figure = figure(None, LevelPalette::Centred);
        figure.bands = vec!["32.768 kHz".into()];
        let svg = figure.draw(&FigureNotes::default()).to_svg();
        let x: f32 = cell(&svg, 0).split(" x=\"").nth(1).expect("x").split('"').next().expect("x").parse().expect("x");
        assert!(x > 12.0 + text_width("32.768 kHz", TEXT_PX), "{x}");
    }

    #[test]
    fn all_panels_have_one_scale() {
        let mut figure = figure(Some(2.0), LevelPalette::Centred);
        let svg = figure.draw(&FigureNotes::default()).to_svg();
        // -20 dB is the end of the scale, 0 dB grey, 2 dB a tenth of the way to orange.
        for (point, colour) in [(1, "#ececec"), (2, "#2166ac"), (3, "#eaded5")] {
            assert!(cell(&svg, point).contains(&format!("fill=\"{colour}\"")), "{}", cell(&svg, point));
        }
        figure.panels.push(GridPanel { levels_db: vec![vec![Some(40.0); 4]], ..figure.panels[0].clone() });
        let svg = figure.draw(&FigureNotes::default()).to_svg();
        assert!(cell(&svg, 2).contains("fill=\"#87a9cc\""), "half of the way to blue: {}", cell(&svg, 2));
    }
}
