//! A drawing as a file.

mod pdf;
mod png;
mod svg;

use crate::canvas::drawing::TextAnchor;
use crate::canvas::font::text_width;

/// Returns where a text begins, left of its point.
fn text_offset(text: &str, size_px: f32, anchor: TextAnchor) -> f32 {
    match anchor {
        TextAnchor::Start => 0.0,
        TextAnchor::Middle => -text_width(text, size_px) / 2.0,
        TextAnchor::End => -text_width(text, size_px),
    }
}

/// The four curves of an ellipse around the origin: a start, then two control points and an end each.
fn ellipse_curves([rx, ry]: [f32; 2]) -> ([f32; 2], [[[f32; 2]; 3]; 4]) {
    // A quarter of a circle as a cubic curve.
    const REACH: f32 = 0.552_284_8;
    let kx = REACH * rx;
    let ky = REACH * ry;
    let curves = [
        [[rx, ky], [kx, ry], [0.0, ry]],
        [[-kx, ry], [-rx, ky], [-rx, 0.0]],
        [[-rx, -ky], [-kx, -ry], [0.0, -ry]],
        [[kx, -ry], [rx, -ky], [rx, 0.0]],
    ];
    ([rx, 0.0], curves)
}
