//! A drawing as SVG. Colours of a theme have a class, so that a page can replace them; texts are texts.

use std::fmt::{self, Write as _};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use crate::canvas::drawing::{
    DrawnShape, FigureColour, FigureDrawing, ShapeGeometry, StrokeStyle, TEXT_PX, TextAnchor,
};
use crate::canvas::picture::encode_grey_png;

const FONTS: &str = "IBM Plex Sans,Helvetica Neue,Arial,sans-serif";

impl FigureDrawing {
    /// Returns the drawing as an SVG file.
    pub fn to_svg(&self) -> String {
        let width = Number(self.width_px);
        let height = Number(self.height_px);
        let notes = &self.notes;
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} \
             {height}\" font-family=\"{FONTS}\" font-size=\"{}\" \
             role=\"img\">\n<title>{}</title>\n<metadata>{}</metadata>\n",
            Number(TEXT_PX),
            Escaped(&notes.title),
            Escaped(&notes.to_json()),
        );
        let page = FigureColour::Paper;
        // Writing to a string does not fail.
        let _ = writeln!(svg, "<rect width=\"{width}\" height=\"{height}\"{}/>", Painted(Some(page), None));
        for shape in &self.shapes {
            let _ = writeln!(svg, "{}", Element(shape));
        }
        svg.push_str("</svg>\n");
        svg
    }
}

/// A length with two decimals at most.
struct Number(f32);

impl fmt::Display for Number {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let rounded = (self.0 * 100.0).round() / 100.0;
        write!(f, "{}", if rounded == 0.0 { 0.0 } else { rounded })
    }
}

/// Text between tags or in an attribute.
struct Escaped<'a>(&'a str);

impl fmt::Display for Escaped<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for character in self.0.chars() {
            match character {
                '&' => f.write_str("&amp;")?,
                '<' => f.write_str("&lt;")?,
                '>' => f.write_str("&gt;")?,
                '"' => f.write_str("&quot;")?,
                // XML has none of these, not even as references.
                '\n' | '\t' => f.write_char(character)?,
                '\u{fffe}' | '\u{ffff}' => f.write_char(' ')?,
                c if c.is_control() => f.write_char(' ')?,
                c => f.write_char(c)?,
            }
        }
        Ok(())
    }
}

struct Colour(FigureColour);

impl fmt::Display for Colour {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [r, g, b] = self.0.rgb();
        write!(f, "#{r:02x}{g:02x}{b:02x}")
    }
}

/// Attributes of paint, with the classes of a theme's colours.
struct Painted(Option<FigureColour>, Option<StrokeStyle>);

impl fmt::Display for Painted {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let fill = self.0.and_then(FigureColour::theme_name).map(|name| format!("fill-{name}"));
        let stroke = self.1.and_then(|stroke| stroke.colour.theme_name()).map(|name| format!("stroke-{name}"));
        let classes: Vec<_> = fill.into_iter().chain(stroke).collect();
        if !classes.is_empty() {
            write!(f, " class=\"{}\"", classes.join(" "))?;
        }
        match self.0 {
            Some(fill) => write!(f, " fill=\"{}\"", Colour(fill))?,
            None => f.write_str(" fill=\"none\"")?,
        }
        let Some(stroke) = self.1 else { return Ok(()) };
        write!(f, " stroke=\"{}\" stroke-width=\"{}\"", Colour(stroke.colour), Number(stroke.width_px))?;
        if self.0.is_none() {
            f.write_str(" stroke-linejoin=\"round\"")?;
        }
        if stroke.dash_px > 0.0 {
            write!(f, " stroke-dasharray=\"{}\"", Number(stroke.dash_px))?;
        }
        Ok(())
    }
}

struct Element<'a>(&'a DrawnShape);

impl fmt::Display for Element<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let paint = Painted(self.0.fill, self.0.stroke);
        match &self.0.geometry {
            ShapeGeometry::Rect { x, y, width, height } => {
                let [x, y, width, height] = [x, y, width, height].map(|v| Number(*v));
                write!(f, "<rect x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\"{paint}")?;
            }
            ShapeGeometry::Path { points, closed } => {
                f.write_str("<path d=\"")?;
                for (i, [x, y]) in points.iter().enumerate() {
                    write!(f, "{}{} {}", if i == 0 { "M" } else { "L" }, Number(*x), Number(*y))?;
                }
                write!(f, "{}\"{paint}", if *closed { "Z" } else { "" })?;
            }
            ShapeGeometry::Ellipse { centre: [x, y], radii: [rx, ry], angle_deg } => {
                let [x, y, rx, ry] = [x, y, rx, ry].map(|v| Number(*v));
                write!(f, "<ellipse cx=\"{x}\" cy=\"{y}\" rx=\"{rx}\" ry=\"{ry}\"{paint}")?;
                if *angle_deg != 0.0 {
                    write!(f, " transform=\"rotate({} {x} {y})\"", Number(*angle_deg))?;
                }
            }
            ShapeGeometry::Text { at: [x, y], text, size_px, anchor, upwards } => {
                let [x, y] = [x, y].map(|v| Number(*v));
                if *upwards {
                    write!(f, "<text transform=\"translate({x} {y}) rotate(-90)\"")?;
                } else {
                    write!(f, "<text x=\"{x}\" y=\"{y}\"")?;
                }
                match anchor {
                    TextAnchor::Start => {}
                    TextAnchor::Middle => f.write_str(" text-anchor=\"middle\"")?,
                    TextAnchor::End => f.write_str(" text-anchor=\"end\"")?,
                }
                if *size_px != TEXT_PX {
                    write!(f, " font-size=\"{}\"", Number(*size_px))?;
                }
                return write!(f, "{paint}>{}</text>", Escaped(text));
            }
            ShapeGeometry::Picture { x, y, side, pixels, columns } => {
                let [x, y, side] = [x, y, side].map(|v| Number(*v));
                // A picture without pixels is no file, and shows nothing.
                let Ok(file) = encode_grey_png(pixels, *columns) else { return Ok(()) };
                let data = STANDARD.encode(file);
                let place = format!("x=\"{x}\" y=\"{y}\" width=\"{side}\" height=\"{side}\"");
                return write!(f, "<image {place} href=\"data:image/png;base64,{data}\"/>");
            }
        }
        if self.0.opacity < 1.0 {
            write!(f, " fill-opacity=\"{}\"", self.0.opacity)?;
        }
        for (name, value) in &self.0.data {
            write!(f, " data-{name}=\"{value}\"")?;
        }
        f.write_str("/>")
    }
}
