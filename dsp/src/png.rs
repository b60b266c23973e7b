//! PNG files, grey or of three colours (W3C Portable Network Graphics, third edition). The crate `png` would add itself,
//! fdeflate and a second miniz_oxide to the lock for the fifty lines here.

use miniz_oxide::deflate::core::{CompressorOxide, TDEFLFlush, compress_to_output, create_comp_flags_from_zip_params};

const SIGNATURE: [u8; 8] = [0x89, b'P', b'N', b'G', b'\r', b'\n', 0x1A, b'\n'];
/// Types of pixels: grey, or red, green and blue.
const GREY: u8 = 0;
const COLOURED: u8 = 2;
/// Rows as differences from the row above: smooth pictures grow a third smaller.
const FILTER_UP: u8 = 2;
const COMPRESSION: u8 = 6;
/// Window bits of a stream with zlib's header.
const ZLIB: i32 = 15;

/// A picture as a file.
///
/// pixels  `[height x width]`, rows from the top, 0 black
///
/// ```
/// let file = echolake_dsp::png::grey(&[0, 255, 255, 0], 2);
/// assert!(file.starts_with(b"\x89PNG"));
/// ```
///
/// # Panics
/// If `width` is 0.
pub fn grey(pixels: &[u8], width: usize) -> Vec<u8> {
    encode([pixels], [width, pixels.len() / width], GREY, &[])
}

/// A picture of three bytes per pixel, with texts by name. It comes in strips, so that it need not be whole in memory.
///
/// strips  `[rows of a strip x width x 3]`, from the top; together `size` has, width and height
///
/// # Panics
/// If the width is 0.
pub fn coloured<P: AsRef<[u8]>>(
    strips: impl IntoIterator<Item = P>,
    size: [usize; 2],
    texts: &[(&str, String)],
) -> Vec<u8> {
    encode(strips, size, COLOURED, texts)
}

fn encode<P: AsRef<[u8]>>(
    strips: impl IntoIterator<Item = P>,
    [width, height]: [usize; 2],
    pixel_type: u8,
    texts: &[(&str, String)],
) -> Vec<u8> {
    let length = if pixel_type == COLOURED { width * 3 } else { width };
    let mut packed = Vec::new();
    let mut compressor = CompressorOxide::new(create_comp_flags_from_zip_params(COMPRESSION.into(), ZLIB, 0));
    let mut compress = |bytes: &[u8], flush| {
        compress_to_output(&mut compressor, bytes, flush, |part| {
            packed.extend_from_slice(part);
            true
        });
    };
    let mut above = vec![0; length];
    let mut filtered = Vec::with_capacity(1 + length);
    for strip in strips {
        for row in strip.as_ref().chunks_exact(length) {
            filtered.clear();
            filtered.push(FILTER_UP);
            filtered.extend(row.iter().zip(&above).map(|(now, above)| now.wrapping_sub(*above)));
            compress(&filtered, TDEFLFlush::None);
            above.copy_from_slice(row);
        }
    }
    compress(&[], TDEFLFlush::Finish);
    let mut header = [width as u32, height as u32].map(u32::to_be_bytes).concat();
    // 8 bits, deflate, adaptive filters, not interlaced.
    header.extend([8, pixel_type, 0, 0, 0]);
    let mut file = SIGNATURE.to_vec();
    chunk(&mut file, b"IHDR", &header);
    for (name, text) in texts {
        // Not compressed, no language.
        chunk(&mut file, b"iTXt", &[name.as_bytes(), &[0; 5], text.as_bytes()].concat());
    }
    chunk(&mut file, b"IDAT", &packed);
    chunk(&mut file, b"IEND", &[]);
    file
}

fn chunk(file: &mut Vec<u8>, name: &[u8; 4], content: &[u8]) {
    file.extend((content.len() as u32).to_be_bytes());
    let from = file.len();
    file.extend(name);
    file.extend(content);
    file.extend(crc32fast::hash(&file[from..]).to_be_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decompressed(file: &[u8]) -> Vec<u8> {
        let at = file.windows(4).position(|w| w == b"IDAT").expect("data");
        let len = u32::from_be_bytes(file[at - 4..at].try_into().expect("four bytes")) as usize;
        miniz_oxide::inflate::decompress_to_vec_zlib(&file[at + 4..at + 4 + len]).expect("zlib")
    }

    #[test]
    fn a_picture_holds_its_pixels() {
        let pixels: Vec<u8> = (0..6).collect();
        let file = grey(&pixels, 3);
        assert_eq!(file[..8], SIGNATURE);
        assert_eq!(file[16..24], [0, 0, 0, 3, 0, 0, 0, 2], "three wide, two high");
        assert_eq!(decompressed(&file), [2, 0, 1, 2, 2, 3, 3, 3]);
        let coloured = coloured([&pixels[..3], &pixels[3..]], [1, 2], &[("Title", "a".into())]);
        assert_eq!(coloured[16..26], [0, 0, 0, 1, 0, 0, 0, 2, 8, 2], "one wide, two high, three colours");
        let strips = decompressed(&coloured);
        assert_eq!(strips, [2, 0, 1, 2, 2, 3, 3, 3], "two strips of a row each");
        assert!(coloured.windows(15).any(|w| w == b"iTXtTitle\0\0\0\0\0a"), "its text");
        assert_eq!(file[file.len() - 8..], *b"IEND\xAE\x42\x60\x82", "the checksum of the empty last chunk");
    }
}
