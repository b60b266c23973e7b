//! A drawing as PNG, at twice its size unless that is very large.

use std::io;

use png::ColorType;
use ttf_parser::OutlineBuilder;
use zeno::{Cap, Command, Join, Mask, Stroke, Style, Transform, Vector};

use super::{ellipse_curves, text_offset};
use crate::canvas::drawing::{DrawnShape, FigureColour, FigureDrawing, ShapeGeometry, StrokeStyle};
use crate::canvas::font::{font_face, glyph_advance, outline_glyph, text_glyphs, text_width};
use crate::canvas::picture::encode_png;

/// Pixels per px of a drawing: 192 dots per inch.
const SCALE: f32 = 2.0;
/// Drawings of more pixels have one per px.
const MOST_PIXELS: f32 = 1e8;
/// Pixels that are drawn at a time: their memory does not depend on the drawing's size.
const STRIP_PIXELS: usize = 4 << 20;
/// More than half the widest line.
const MOST_STROKE_PX: f32 = 4.0;

impl FigureDrawing {
    /// Returns the drawing as a PNG file; its notes are texts of the file.
    ///
    /// # Errors
    /// The drawing has no area, or is larger than such a file can be.
    pub fn to_png(&self) -> io::Result<Vec<u8>> {
        let is_large = self.width_px * self.height_px * SCALE * SCALE > MOST_PIXELS;
        let scale = if is_large { 1.0 } else { SCALE };
        let [width, height] = [self.width_px, self.height_px].map(|length| (length * scale).ceil().max(1.0) as usize);
        let extents: Vec<_> = self.shapes.iter().map(|shape| vertical_extent(&shape.geometry)).collect();
        let strip_rows = (STRIP_PIXELS / width).clamp(1, height);
        let strips = (0..height).step_by(strip_rows).map(|top| {
            let rows = strip_rows.min(height - top);
            let pixels = FigureColour::Paper.rgb().map(f32::from).repeat(width * rows);
            let mut canvas = PixelStrip { pixels, scale, width, top, rows };
            let [first, last] = [top, top + rows].map(|row| row as f32 / scale);
            let shown = self.shapes.iter().zip(&extents).filter(|(_, [from, to])| *to >= first && *from <= last);
            shown.for_each(|(shape, _)| canvas.draw_shape(shape));
            canvas.pixels.iter().map(|part| part.round() as u8).collect::<Vec<u8>>()
        });
        encode_png(strips, [width, height], ColorType::Rgb, &self.notes.named_notes())
    }
}

/// Returns the rows, px, that a shape touches at most.
fn vertical_extent(geometry: &ShapeGeometry) -> [f32; 2] {
    let [from, to] = match geometry {
        ShapeGeometry::Rect { y, height, .. } => [*y, y + height],
        ShapeGeometry::Picture { y, side, .. } => [*y, y + side],
        ShapeGeometry::Path { points, .. } => {
            points.iter().fold([f32::MAX, f32::MIN], |[from, to], [_, y]| [from.min(*y), to.max(*y)])
        }
        ShapeGeometry::Ellipse { centre, radii, .. } => {
            let reach = radii[0].max(radii[1]);
            [centre[1] - reach, centre[1] + reach]
        }
        ShapeGeometry::Text { at, text, size_px, upwards, .. } => {
            let reach = if *upwards { text_width(text, *size_px) } else { *size_px };
            [at[1] - reach, at[1] + reach]
        }
    };
    [from - MOST_STROKE_PX, to + MOST_STROKE_PX]
}

/// Some rows of opaque pixels, red, green and blue from 0 to 255; fractions count where many faint shapes overlap.
struct PixelStrip {
    pixels: Vec<f32>,
    /// Pixels per px.
    scale: f32,
    width: usize,
    /// The picture's row that is its first.
    top: usize,
    rows: usize,
}

impl PixelStrip {
    fn draw_shape(&mut self, shape: &DrawnShape) {
        match (&shape.geometry, shape.fill) {
            (ShapeGeometry::Picture { x, y, side, pixels, columns }, _) => {
                return self.draw_picture([*x, *y], *side, pixels, *columns);
            }
            // Cells that touch must not show the page between them: no part of a pixel is covered.
            (ShapeGeometry::Rect { x, y, width, height }, Some(fill)) => {
                self.fill_rect([*x, *y], [*width, *height], fill.rgb());
            }
            (geometry, Some(fill)) => {
                let (path, placed) = path_of(geometry);
                self.cover_path(&path, placed, Style::default(), fill.rgb(), shape.opacity);
            }
            (_, None) => {}
        }
        if let Some(StrokeStyle { colour, width_px, dash_px }) = shape.stroke {
            let (path, placed) = path_of(&shape.geometry);
            let dashes = [dash_px, dash_px];
            let mut stroke = Stroke::new(width_px);
            stroke.cap(Cap::Butt).join(Join::Round);
            if dash_px > 0.0 {
                stroke.dash(&dashes, 0.0);
            }
            self.cover_path(&path, placed, stroke.into(), colour.rgb(), 1.0);
        }
    }

    fn cover_path(&mut self, path: &[Command], placed: Transform, style: Style<'_>, rgb: [u8; 3], opacity: f32) {
        let transform = placed.then_scale(self.scale, self.scale).then_translate(0.0, -(self.top as f32));
        let (coverage, place) = Mask::new(path).style(style).transform(Some(transform)).render();
        let columns = place.width as usize;
        for (row, line) in coverage.chunks_exact(columns.max(1)).enumerate() {
            let Ok(y) = usize::try_from(place.top + row as i32) else { continue };
            for (column, share) in line.iter().enumerate().filter(|(_, share)| **share > 0) {
                if let Ok(x) = usize::try_from(place.left + column as i32) {
                    self.blend_pixel(x, y, rgb, opacity * f32::from(*share) / 255.0);
                }
            }
        }
    }

    fn blend_pixel(&mut self, x: usize, y: usize, rgb: [u8; 3], share: f32) {
        if x >= self.width || y >= self.rows {
            return;
        }
        let at = 3 * (y * self.width + x);
        for (below, above) in self.pixels[at..at + 3].iter_mut().zip(rgb) {
            *below += (f32::from(above) - *below) * share;
        }
    }

    fn fill_rect(&mut self, [x, y]: [f32; 2], [width, height]: [f32; 2], rgb: [u8; 3]) {
        let edge = |at: f32, from: usize, count: usize| {
            ((at * self.scale).round() - from as f32).clamp(0.0, count as f32) as usize
        };
        let [left, right] = [x, x + width].map(|at| edge(at, 0, self.width));
        let [first, end] = [y, y + height].map(|at| edge(at, self.top, self.rows));
        for row in first..end {
            for pixel in self.pixels[3 * (row * self.width + left)..3 * (row * self.width + right)].chunks_exact_mut(3)
            {
                pixel.copy_from_slice(&rgb.map(f32::from));
            }
        }
    }

    // The nearest cell's brightness.
    fn draw_picture(&mut self, [x, y]: [f32; 2], side: f32, pixels: &[u8], columns: usize) {
        let count = (side * self.scale).round() as usize;
        let [left, top] = [x, y].map(|at| (at * self.scale).round() as usize);
        for (row, column) in (0..count).flat_map(|row| (0..count).map(move |column| (row, column))) {
            let cell = (row * columns / count) * columns + column * columns / count;
            if let (Some(grey), Some(y)) = (pixels.get(cell), (top + row).checked_sub(self.top)) {
                self.blend_pixel(left + column, y, [*grey; 3], 1.0);
            }
        }
    }
}

fn path_of(geometry: &ShapeGeometry) -> (Vec<Command>, Transform) {
    let mut path = Vec::new();
    let mut placed = Transform::IDENTITY;
    match geometry {
        ShapeGeometry::Rect { x, y, width, height } => {
            let corners = [[*x, *y], [x + width, *y], [x + width, y + height], [*x, y + height]];
            push_lines(&mut path, &corners, true);
        }
        ShapeGeometry::Path { points, closed } => push_lines(&mut path, points, *closed),
        ShapeGeometry::Ellipse { centre, radii, angle_deg } => {
            let (start, curves) = ellipse_curves(*radii);
            path.push(Command::MoveTo(start.into()));
            path.extend(curves.map(|[a, b, to]| Command::CurveTo(a.into(), b.into(), to.into())));
            path.push(Command::Close);
            let (sin, cos) = angle_deg.to_radians().sin_cos();
            placed = Transform::new(cos, sin, -sin, cos, centre[0], centre[1]);
        }
        ShapeGeometry::Text { at, text, size_px, anchor, upwards } => {
            let em = font_face().map_or(0.0, |face| size_px / f32::from(face.units_per_em()));
            let mut pen = GlyphPen { path, x: text_offset(text, *size_px, *anchor), em };
            for glyph in text_glyphs(text) {
                outline_glyph(glyph, &mut pen);
                pen.x += glyph_advance(glyph) * size_px;
            }
            path = pen.path;
            placed = if *upwards {
                Transform::new(0.0, -1.0, 1.0, 0.0, at[0], at[1])
            } else {
                Transform::translation(at[0], at[1])
            };
        }
        ShapeGeometry::Picture { .. } => {}
    }
    (path, placed)
}

fn push_lines(path: &mut Vec<Command>, points: &[[f32; 2]], closed: bool) {
    for (i, point) in points.iter().enumerate() {
        let point = Vector::from(*point);
        path.push(if i == 0 { Command::MoveTo(point) } else { Command::LineTo(point) });
    }
    if closed {
        path.push(Command::Close);
    }
}

/// Adds glyphs to a path, from units of the font, whose y is upwards.
struct GlyphPen {
    path: Vec<Command>,
    x: f32,
    em: f32,
}

impl GlyphPen {
    fn point_at(&self, x: f32, y: f32) -> Vector {
        Vector::new(self.x + x * self.em, -y * self.em)
    }
}

impl OutlineBuilder for GlyphPen {
    fn move_to(&mut self, x: f32, y: f32) {
        self.path.push(Command::MoveTo(self.point_at(x, y)));
    }

    fn line_to(&mut self, x: f32, y: f32) {
        self.path.push(Command::LineTo(self.point_at(x, y)));
    }

    fn quad_to(&mut self, x1: f32, y1: f32, x: f32, y: f32) {
        self.path.push(Command::QuadTo(self.point_at(x1, y1), self.point_at(x, y)));
    }

    fn curve_to(&mut self, x1: f32, y1: f32, x2: f32, y2: f32, x: f32, y: f32) {
        self.path.push(Command::CurveTo(self.point_at(x1, y1), self.point_at(x2, y2), self.point_at(x, y)));
    }

    fn close(&mut self) {
        self.path.push(Command::Close);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::canvas::drawing::{TextAnchor, filled_rect, ink_label};
    use crate::canvas::notes::FigureNotes;
    use crate::canvas::picture::tests::decode_png;

    // Three strips: what is across their limits is whole.
    #[test]
    fn strips_make_one_picture() {
        let mut tall = FigureDrawing::new(1500.0, 1500.0, &FigureNotes::default());
        let accent = FigureColour::Accent;
        tall.add_shape(filled_rect([10.0, 10.0], [20.0, 1480.0], accent));
        for row in 0..100 {
            tall.add_shape(ink_label([40.0, 15.0 * row as f32], "M", TextAnchor::Start));
        }
        let (size, pixels) = decode_png(&tall.to_png().expect("a file"));
        assert_eq!(size, [3000, 3000]);
        let at = |x: usize, y: usize| &pixels[3 * (3000 * y + x)..][..3];
        assert!((20..2980).all(|y| at(40, y) == accent.rgb()), "the bar");
        assert_eq!((at(40, 19), at(40, 2980), at(2000, 1500)), (&[255; 3][..], &[255; 3][..], &[255; 3][..]));
        let letter = |row: usize| {
            (0..60)
                .flat_map(|x| (0..26).map(move |y| (x, y)))
                .map(|(x, y)| at(80 + x, 30 * row + y - 25).to_vec())
                .collect::<Vec<_>>()
        };
        assert!((2..99).all(|row| letter(row) == letter(1)), "the letters");
    }

    #[test]
    fn large_drawings_have_a_pixel_per_px() {
        let file = FigureDrawing::new(10.0, 3e6, &FigureNotes::default()).to_png().expect("a file");
        assert_eq!(decode_png(&file).0, [10, 3_000_000]);
    }
}
