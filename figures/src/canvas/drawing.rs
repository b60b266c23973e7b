//! A drawing: shapes on a page, before they become SVG, PDF or PNG.

use crate::canvas::font::{fitted_text, text_width};
use crate::canvas::notes::FigureNotes;

/// Size of ordinary text, px.
pub(crate) const TEXT_PX: f32 = 12.0;
/// Size of small text, px.
pub(crate) const SMALL_PX: f32 = 10.0;
/// Size of a figure's title, px.
const TITLE_PX: f32 = 14.0;
/// Space left of a figure's title and right of it, px.
const TITLE_MARGIN: f32 = 12.0;

/// A figure that is drawn, and what it says of itself. Lengths are in px of 1/96 inch, y downwards.
#[derive(Debug, Clone)]
pub struct FigureDrawing {
    pub(crate) width_px: f32,
    pub(crate) height_px: f32,
    pub(crate) shapes: Vec<DrawnShape>,
    pub(crate) notes: FigureNotes,
}

/// A colour: of a theme, which pages may replace, or one that carries a number.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum FigureColour {
    Ink,
    Quiet,
    Rule,
    Block,
    Paper,
    Accent,
    Rgb([u8; 3]),
}

impl FigureColour {
    pub fn rgb(self) -> [u8; 3] {
        match self {
            Self::Ink => [22, 24, 26],
            Self::Quiet => [82, 88, 91],
            Self::Rule => [211, 213, 207],
            Self::Block => [169, 173, 170],
            Self::Paper => [255, 255, 255],
            Self::Accent => [11, 92, 140],
            Self::Rgb(rgb) => rgb,
        }
    }

    /// Returns the name by which a style sheet replaces the colour.
    pub fn theme_name(self) -> Option<&'static str> {
        match self {
            Self::Ink => Some("ink"),
            Self::Quiet => Some("quiet"),
            Self::Rule => Some("rule"),
            Self::Block => Some("block"),
            Self::Paper => Some("paper"),
            Self::Accent => Some("accent"),
            Self::Rgb(_) => None,
        }
    }
}

/// A line's colour, width and dashes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct StrokeStyle {
    pub colour: FigureColour,
    pub width_px: f32,
    /// Length of dashes and of the gaps between them, px; 0 for none.
    pub dash_px: f32,
}

impl StrokeStyle {
    pub fn new(colour: FigureColour, width_px: f32) -> Self {
        Self { colour, width_px, dash_px: 0.0 }
    }
}

/// The side of a text that is at its point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TextAnchor {
    Start,
    Middle,
    End,
}

#[derive(Debug, Clone)]
pub(crate) enum ShapeGeometry {
    Rect {
        x: f32,
        y: f32,
        width: f32,
        height: f32,
    },
    Path {
        points: Vec<[f32; 2]>,
        closed: bool,
    },
    Ellipse {
        centre: [f32; 2],
        radii: [f32; 2],
        angle_deg: f32,
    },
    Text {
        at: [f32; 2],
        text: String,
        size_px: f32,
        anchor: TextAnchor,
        upwards: bool,
    },
    /// Grey pixels, rows from the top, in a square.
    Picture {
        x: f32,
        y: f32,
        side: f32,
        pixels: Vec<u8>,
        columns: usize,
    },
}

/// A shape, how it is painted, and what a page reads from it.
#[derive(Debug, Clone)]
pub(crate) struct DrawnShape {
    pub geometry: ShapeGeometry,
    pub fill: Option<FigureColour>,
    pub opacity: f32,
    pub stroke: Option<StrokeStyle>,
    /// Attributes `data-*` of the SVG.
    pub data: Vec<(&'static str, usize)>,
}

impl DrawnShape {
    pub fn with_opacity(mut self, opacity: f32) -> Self {
        self.opacity = opacity;
        self
    }

    pub fn with_data(mut self, name: &'static str, value: usize) -> Self {
        self.data.push((name, value));
        self
    }
}

fn plain_shape(geometry: ShapeGeometry, fill: Option<FigureColour>, stroke: Option<StrokeStyle>) -> DrawnShape {
    DrawnShape { geometry, fill, opacity: 1.0, stroke, data: Vec::new() }
}

pub(crate) fn filled_rect([x, y]: [f32; 2], [width, height]: [f32; 2], fill: FigureColour) -> DrawnShape {
    plain_shape(ShapeGeometry::Rect { x, y, width, height }, Some(fill), None)
}

pub(crate) fn framed_rect([x, y]: [f32; 2], [width, height]: [f32; 2], stroke: StrokeStyle) -> DrawnShape {
    plain_shape(ShapeGeometry::Rect { x, y, width, height }, None, Some(stroke))
}

pub(crate) fn stroked_line(points: Vec<[f32; 2]>, stroke: StrokeStyle) -> DrawnShape {
    plain_shape(ShapeGeometry::Path { points, closed: false }, None, Some(stroke))
}

pub(crate) fn filled_area(points: Vec<[f32; 2]>, fill: FigureColour) -> DrawnShape {
    plain_shape(ShapeGeometry::Path { points, closed: true }, Some(fill), None)
}

pub(crate) fn filled_ellipse(centre: [f32; 2], radii: [f32; 2], angle_deg: f32, fill: FigureColour) -> DrawnShape {
    plain_shape(ShapeGeometry::Ellipse { centre, radii, angle_deg }, Some(fill), None)
}

pub(crate) fn picture_shape([x, y]: [f32; 2], side: f32, pixels: Vec<u8>, columns: usize) -> DrawnShape {
    plain_shape(ShapeGeometry::Picture { x, y, side, pixels, columns }, None, None)
}

/// Text in ink of ordinary size.
pub(crate) fn ink_label(at: [f32; 2], text: impl Into<String>, anchor: TextAnchor) -> DrawnShape {
    sized_label(at, text, anchor, TEXT_PX, FigureColour::Ink)
}

pub(crate) fn sized_label(
    at: [f32; 2],
    text: impl Into<String>,
    anchor: TextAnchor,
    size_px: f32,
    colour: FigureColour,
) -> DrawnShape {
    let geometry = ShapeGeometry::Text { at, text: text.into(), size_px, anchor, upwards: false };
    plain_shape(geometry, Some(colour), None)
}

/// Text that runs upwards, its middle at a point.
pub(crate) fn upward_label(at: [f32; 2], text: impl Into<String>) -> DrawnShape {
    let text = text.into();
    let anchor = TextAnchor::Middle;
    plain_shape(
        ShapeGeometry::Text { at, text, size_px: TEXT_PX, anchor, upwards: true },
        Some(FigureColour::Ink),
        None,
    )
}

impl FigureDrawing {
    pub(crate) fn new(width_px: f32, height_px: f32, notes: &FigureNotes) -> Self {
        Self { width_px, height_px, shapes: Vec::new(), notes: notes.clone() }
    }

    pub(crate) fn add_shape(&mut self, shape: DrawnShape) {
        self.shapes.push(shape);
    }

    /// Adds the title at the top.
    pub(crate) fn add_title(&mut self) {
        let text = fitted_text(&self.notes.title, TITLE_PX, self.width_px - 2.0 * TITLE_MARGIN);
        self.add_shape(sized_label([TITLE_MARGIN, 20.0], text, TextAnchor::Start, TITLE_PX, FigureColour::Ink));
    }

    /// Adds a line of text at the foot that says where the figure comes from, if its data is simulated.
    pub(crate) fn add_origin(&mut self) {
        let mut text = self.notes.origin_line();
        let room = self.width_px - 16.0;
        if text_width(&text, SMALL_PX) > room {
            text = self.notes.origin_word().to_owned();
        }
        let at = [self.width_px - 8.0, self.height_px - 6.0];
        self.add_shape(sized_label(at, text, TextAnchor::End, SMALL_PX, FigureColour::Quiet));
    }
}
