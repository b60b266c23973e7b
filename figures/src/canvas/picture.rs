//! PNG files of pixels.

use std::io::{self, Write as _};

use png::{ColorType, Encoder, Filter};

/// Returns a grey picture as a PNG file.
///
/// pixels  `[height x width]`, rows from the top, 0 black
///
/// ```
/// let file = echolake_figures::encode_grey_png(&[0, 255, 255, 0], 2)?;
/// assert!(file.starts_with(b"\x89PNG"));
/// # Ok::<(), std::io::Error>(())
/// ```
///
/// # Errors
/// The picture has no pixels, or its last row is not whole.
pub fn encode_grey_png(pixels: &[u8], width: usize) -> io::Result<Vec<u8>> {
    encode_png([pixels], [width, pixels.len() / width.max(1)], ColorType::Grayscale, &[])
}

/// Returns a picture with texts by name. It comes in strips, so that it need not be whole in memory.
///
/// strips  `[rows of a strip x width x colours]`, from the top; together `size` has, width and height
pub(crate) fn encode_png<P: AsRef<[u8]>>(
    strips: impl IntoIterator<Item = P>,
    size: [usize; 2],
    colours: ColorType,
    texts: &[(&str, String)],
) -> io::Result<Vec<u8>> {
    let [width, height] = size.map(|length| u32::try_from(length).unwrap_or(u32::MAX));
    let mut file = Vec::new();
    let mut encoder = Encoder::new(&mut file, width, height);
    encoder.set_color(colours);
    // Rows as differences from the row above: smooth pictures grow a third smaller.
    encoder.set_filter(Filter::Up);
    for (name, text) in texts {
        encoder.add_itxt_chunk((*name).to_owned(), text.clone())?;
    }
    let mut header = encoder.write_header()?;
    let mut rows = header.stream_writer()?;
    for strip in strips {
        rows.write_all(strip.as_ref())?;
    }
    rows.finish()?;
    header.finish()?;
    Ok(file)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Returns a file's width and height, and its pixels.
    pub(crate) fn decode_png(file: &[u8]) -> ([u32; 2], Vec<u8>) {
        let mut reader = png::Decoder::new(io::Cursor::new(file)).read_info().expect("a header");
        let mut pixels = vec![0; reader.output_buffer_size().expect("a size")];
        let frame = reader.next_frame(&mut pixels).expect("pixels");
        ([frame.width, frame.height], pixels)
    }

    #[test]
    fn a_picture_holds_its_pixels() {
        let pixels: Vec<u8> = (0..6).collect();
        assert_eq!(decode_png(&encode_grey_png(&pixels, 3).expect("a picture")), ([3, 2], pixels.clone()));
        let texts = [("Title", "a".to_owned())];
        let strips = encode_png([&pixels[..3], &pixels[3..]], [1, 2], ColorType::Rgb, &texts).expect("a picture");
        assert_eq!(decode_png(&strips), ([1, 2], pixels.clone()), "two strips of a row each");
        assert!(strips.windows(15).any(|w| w == b"iTXtTitle\0\0\0\0\0a"), "its text");
        for (pixels, width) in [(&pixels[..0], 3), (&pixels[..5], 3), (&pixels[..], 0)] {
            assert!(encode_grey_png(pixels, width).is_err(), "{width} in a row of {}", pixels.len());
        }
    }
}
