//! The figures' font: IBM Plex Sans, Latin, without hints, under another name because it was changed; its licence is
//! `font/OFL.txt`. PDF files hold it, PNG files its outlines; SVG files name IBM Plex Sans.

use std::sync::LazyLock;

use ttf_parser::{Face, GlyphId, OutlineBuilder};

/// The font's file.
pub(crate) const FONT: &[u8] = include_bytes!("font/figures.ttf");

/// The glyph of what the font lacks.
const MISSING: GlyphId = GlyphId(0);

static FACE: LazyLock<Option<Face<'static>>> = LazyLock::new(|| Face::parse(FONT, 0).ok());

/// Returns the font; none if its file is no font, which a test excludes.
pub(crate) fn font_face() -> Option<&'static Face<'static>> {
    FACE.as_ref()
}

/// Returns the glyphs of a text; a character that the font lacks is a box.
pub(crate) fn text_glyphs(text: &str) -> impl Iterator<Item = GlyphId> {
    let shown = text.chars().filter(|character| !character.is_control());
    shown.filter_map(|character| Some(font_face()?.glyph_index(character).unwrap_or(MISSING)))
}

/// Returns a glyph's width for a font of 1 px.
pub(crate) fn glyph_advance(glyph: GlyphId) -> f32 {
    font_face()
        .map_or(0.0, |face| f32::from(face.glyph_hor_advance(glyph).unwrap_or(0)) / f32::from(face.units_per_em()))
}

/// Returns a text's width.
pub(crate) fn text_width(text: &str, size_px: f32) -> f32 {
    size_px * text_glyphs(text).map(glyph_advance).sum::<f32>()
}

/// Returns a text that fits into a width: the end of a longer one is an ellipsis.
pub(crate) fn fitted_text(text: &str, size_px: f32, room_px: f32) -> String {
    if text_width(text, size_px) <= room_px {
        return text.to_owned();
    }
    let mut width = text_width("\u{2026}", size_px);
    let fits = |character: &char| {
        width += text_width(character.encode_utf8(&mut [0; 4]), size_px);
        width <= room_px
    };
    text.chars().take_while(fits).chain(['\u{2026}']).collect()
}

/// Outlines a glyph in units of the font.
pub(crate) fn outline_glyph(glyph: GlyphId, builder: &mut impl OutlineBuilder) {
    if let Some(face) = font_face() {
        face.outline_glyph(glyph, builder);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_font_has_what_figures_say() {
        let text = "−20 dB, 2.5 kHz, 21.5 °C, 0…4 ms · ± µ";
        assert!(text_glyphs(text).all(|glyph| glyph != MISSING));
        let width = text_width("2.5 kHz", 12.0);
        assert!((38.0..48.0).contains(&width), "{width}");
        assert_eq!(text_glyphs("a\u{1f600}\n").count(), 2, "a box for what it lacks, nothing for a line break");
    }

    #[test]
    fn a_text_that_does_not_fit_has_an_ellipsis() {
        assert_eq!(fitted_text("0015_1", 12.0, 100.0), "0015_1");
        let fitted = fitted_text(&"long".repeat(50), 12.0, 100.0);
        assert!(fitted.starts_with("longlong") && fitted.ends_with('\u{2026}'), "{fitted}");
        assert!((80.0..=100.0).contains(&text_width(&fitted, 12.0)), "{fitted}");
    }
}
