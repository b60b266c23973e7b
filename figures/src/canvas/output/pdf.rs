//! A drawing as PDF: one page, with the font inside, so that its texts can be searched and copied.

use std::io::{self, Write as _};

use flate2::Compression;
use flate2::write::ZlibEncoder;
use pdf_writer::types::{CidFontType, FontFlags, LineJoinStyle, SystemInfo, UnicodeCmap};
use pdf_writer::{Content, Filter, Finish as _, Name, Pdf, Rect, Ref, Str, TextStr};

use super::{ellipse_curves, text_offset};
use crate::canvas::drawing::{DrawnShape, FigureDrawing, ShapeGeometry};
use crate::canvas::font::{FONT, font_face, glyph_advance, text_glyphs};

/// Points (1/72 inch) per px.
const POINTS: f32 = 0.75;
const FONT_NAME: Name<'static> = Name(b"F");
const BASE_FONT: Name<'static> = Name(b"EFGRSB+EcholakeFigures");
const CMAP_NAME: Name<'static> = Name(b"EcholakeFigures");
const SYSTEM: SystemInfo<'static> = SystemInfo { registry: Str(b"Adobe"), ordering: Str(b"Identity"), supplement: 0 };
/// Steps of opacity, of which each has a graphics state.
const OPACITIES: u8 = 100;

const CATALOG: Ref = Ref::new(1);
const PAGES: Ref = Ref::new(2);
const PAGE: Ref = Ref::new(3);
const CONTENTS: Ref = Ref::new(4);
const INFO: Ref = Ref::new(5);
const FONT_REF: Ref = Ref::new(6);
const CID_FONT: Ref = Ref::new(7);
const DESCRIPTOR: Ref = Ref::new(8);
const FONT_FILE: Ref = Ref::new(9);
const TO_UNICODE: Ref = Ref::new(10);
/// Graphics states, then pictures.
const FIRST_STATE: i32 = 20;
const FIRST_PICTURE: i32 = 200;

impl FigureDrawing {
    /// Returns the drawing as a PDF file; its notes are in the document's information.
    ///
    /// # Errors
    /// Its parts cannot be compressed.
    pub fn to_pdf(&self) -> io::Result<Vec<u8>> {
        let mut page = PdfPage { content: Content::new(), pictures: Vec::new(), opacities: Vec::new() };
        page.content.transform([POINTS, 0.0, 0.0, -POINTS, 0.0, self.height_px * POINTS]);
        self.shapes.iter().for_each(|shape| page.draw_shape(shape));
        let PdfPage { content, pictures, opacities } = page;
        let mut pdf = Pdf::new();
        pdf.catalog(CATALOG).pages(PAGES);
        pdf.pages(PAGES).kids([PAGE]).count(1);
        let mut written = pdf.page(PAGE);
        written.media_box(Rect::new(0.0, 0.0, self.width_px * POINTS, self.height_px * POINTS));
        written.parent(PAGES).contents(CONTENTS);
        let mut resources = written.resources();
        resources.fonts().pair(FONT_NAME, FONT_REF);
        let mut states = resources.ext_g_states();
        for opacity in &opacities {
            states.pair(Name(&state_name(*opacity)), state_ref(*opacity));
        }
        states.finish();
        let mut objects = resources.x_objects();
        for place in 0..pictures.len() {
            objects.pair(Name(&picture_name(place)), picture_ref(place));
        }
        objects.finish();
        resources.finish();
        written.finish();
        for opacity in opacities {
            pdf.ext_graphics(state_ref(opacity)).non_stroking_alpha(f32::from(opacity) / f32::from(OPACITIES));
        }
        for (place, (pixels, columns)) in pictures.iter().enumerate() {
            let packed = compress_zlib(pixels)?;
            let mut image = pdf.image_xobject(picture_ref(place), &packed);
            image.filter(Filter::FlateDecode);
            image.width(*columns as i32).height((pixels.len() / columns) as i32).bits_per_component(8);
            image.color_space().device_gray();
        }
        pdf.stream(CONTENTS, &compress_zlib(&content.finish())?).filter(Filter::FlateDecode);
        write_font(&mut pdf)?;
        let notes = &self.notes;
        let mut info = pdf.document_info(INFO);
        info.title(TextStr(&notes.title)).subject(TextStr(&notes.query)).keywords(TextStr(&notes.to_json()));
        info.creator(TextStr(&notes.command)).producer(TextStr(&notes.program));
        info.finish();
        Ok(pdf.finish())
    }
}

fn compress_zlib(bytes: &[u8]) -> io::Result<Vec<u8>> {
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::default());
    encoder.write_all(bytes)?;
    encoder.finish()
}

fn state_name(opacity: u8) -> Vec<u8> {
    format!("O{opacity}").into_bytes()
}

fn state_ref(opacity: u8) -> Ref {
    Ref::new(FIRST_STATE + i32::from(opacity))
}

fn picture_name(place: usize) -> Vec<u8> {
    format!("P{place}").into_bytes()
}

fn picture_ref(place: usize) -> Ref {
    Ref::new(FIRST_PICTURE + place as i32)
}

/// The page's operators, and what they refer to.
struct PdfPage<'a> {
    content: Content,
    pictures: Vec<(&'a [u8], usize)>,
    opacities: Vec<u8>,
}

impl<'a> PdfPage<'a> {
    fn draw_shape(&mut self, shape: &'a DrawnShape) {
        self.content.save_state();
        if let Some(fill) = shape.fill {
            let [r, g, b] = fill.rgb().map(|part| f32::from(part) / 255.0);
            self.content.set_fill_rgb(r, g, b);
        }
        if let Some(stroke) = shape.stroke {
            let [r, g, b] = stroke.colour.rgb().map(|part| f32::from(part) / 255.0);
            self.content.set_stroke_rgb(r, g, b).set_line_width(stroke.width_px);
            self.content.set_line_join(LineJoinStyle::RoundJoin);
            if stroke.dash_px > 0.0 {
                self.content.set_dash_pattern([stroke.dash_px], 0.0);
            }
        }
        if shape.opacity < 1.0 {
            let opacity = (shape.opacity.max(0.0) * f32::from(OPACITIES)).round().max(1.0) as u8;
            if !self.opacities.contains(&opacity) {
                self.opacities.push(opacity);
            }
            self.content.set_parameters(Name(&state_name(opacity)));
        }
        self.draw_outline(&shape.geometry);
        match (&shape.geometry, shape.fill, shape.stroke) {
            (ShapeGeometry::Text { .. } | ShapeGeometry::Picture { .. }, ..) => {}
            (_, Some(_), Some(_)) => _ = self.content.fill_nonzero_and_stroke(),
            (_, Some(_), None) => _ = self.content.fill_nonzero(),
            (_, None, Some(_)) => _ = self.content.stroke(),
            (_, None, None) => _ = self.content.end_path(),
        }
        self.content.restore_state();
    }

    fn draw_outline(&mut self, geometry: &'a ShapeGeometry) {
        let content = &mut self.content;
        match geometry {
            ShapeGeometry::Rect { x, y, width, height } => _ = content.rect(*x, *y, *width, *height),
            ShapeGeometry::Path { points, closed } => {
                for (i, [x, y]) in points.iter().enumerate() {
                    if i == 0 {
                        content.move_to(*x, *y)
                    } else {
                        content.line_to(*x, *y)
                    };
                }
                if *closed {
                    content.close_path();
                }
            }
            ShapeGeometry::Ellipse { centre, radii, angle_deg } => {
                let (sin, cos) = angle_deg.to_radians().sin_cos();
                content.transform([cos, sin, -sin, cos, centre[0], centre[1]]);
                let (start, curves) = ellipse_curves(*radii);
                content.move_to(start[0], start[1]);
                for [a, b, to] in curves {
                    content.cubic_to(a[0], a[1], b[0], b[1], to[0], to[1]);
                }
                content.close_path();
            }
            ShapeGeometry::Text { at, text, size_px, anchor, upwards } => {
                let offset = text_offset(text, *size_px, *anchor);
                let codes: Vec<u8> = text_glyphs(text).flat_map(|glyph| glyph.0.to_be_bytes()).collect();
                // y is downwards on the page, so letters are turned over again.
                let matrix = if *upwards {
                    [0.0, -1.0, -1.0, 0.0, at[0], at[1] - offset]
                } else {
                    [1.0, 0.0, 0.0, -1.0, at[0] + offset, at[1]]
                };
                content.begin_text().set_font(FONT_NAME, *size_px).set_text_matrix(matrix).show(Str(&codes)).end_text();
            }
            ShapeGeometry::Picture { x, y, side, pixels, columns } => {
                content.transform([*side, 0.0, 0.0, -*side, *x, *y + *side]);
                content.x_object(Name(&picture_name(self.pictures.len())));
                self.pictures.push((pixels, *columns));
            }
        }
    }
}

fn write_font(pdf: &mut Pdf) -> io::Result<()> {
    let Some(face) = font_face() else { return Ok(()) };
    let mut font = pdf.type0_font(FONT_REF);
    font.base_font(BASE_FONT).encoding_predefined(Name(b"Identity-H")).descendant_font(CID_FONT).to_unicode(TO_UNICODE);
    font.finish();
    let mut cid = pdf.cid_font(CID_FONT);
    cid.subtype(CidFontType::Type2).base_font(BASE_FONT).system_info(SYSTEM).font_descriptor(DESCRIPTOR);
    cid.cid_to_gid_map_predefined(Name(b"Identity"));
    let widths = (0..face.number_of_glyphs()).map(|glyph| 1000.0 * glyph_advance(ttf_parser::GlyphId(glyph)));
    cid.widths().consecutive(0, widths);
    cid.finish();
    let milli = 1000.0 / f32::from(face.units_per_em());
    let bounds = face.global_bounding_box();
    let [left, bottom, right, top] =
        [bounds.x_min, bounds.y_min, bounds.x_max, bounds.y_max].map(|edge| f32::from(edge) * milli);
    let mut descriptor = pdf.font_descriptor(DESCRIPTOR);
    descriptor.name(BASE_FONT).flags(FontFlags::NON_SYMBOLIC).bbox(Rect::new(left, bottom, right, top));
    descriptor.italic_angle(0.0).stem_v(80.0).font_file2(FONT_FILE);
    descriptor.ascent(f32::from(face.ascender()) * milli).descent(f32::from(face.descender()) * milli);
    descriptor.cap_height(f32::from(face.capital_height().unwrap_or(0)) * milli);
    descriptor.finish();
    let packed = compress_zlib(FONT)?;
    let mut file = pdf.stream(FONT_FILE, &packed);
    file.filter(Filter::FlateDecode).pair(Name(b"Length1"), FONT.len() as i32);
    file.finish();
    let mut cmap = UnicodeCmap::new(CMAP_NAME, SYSTEM);
    let characters = (' '..='\u{24f}').chain('\u{2010}'..='\u{2026}').chain(['\u{2212}']);
    for character in characters {
        if let Some(glyph) = face.glyph_index(character) {
            cmap.pair(glyph.0, character);
        }
    }
    pdf.cmap(TO_UNICODE, &cmap.finish());
    Ok(())
}
