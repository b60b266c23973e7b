//! PNG files of one grey channel (W3C Portable Network Graphics, third edition). The crate `png` would add itself,
//! fdeflate and a second miniz_oxide to the lock for the forty lines here.

const SIGNATURE: [u8; 8] = [0x89, b'P', b'N', b'G', b'\r', b'\n', 0x1A, b'\n'];
/// 8 bits, grey, deflate, adaptive filters, not interlaced.
const FORMAT: [u8; 5] = [8, 0, 0, 0, 0];
/// Rows as differences from the row above: smooth pictures grow a third smaller.
const FILTER_UP: u8 = 2;
const COMPRESSION: u8 = 6;

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
    let mut rows = Vec::with_capacity(pixels.len() + pixels.len() / width);
    let mut above = vec![0; width];
    for row in pixels.chunks_exact(width) {
        rows.push(FILTER_UP);
        rows.extend(row.iter().zip(&above).map(|(now, above)| now.wrapping_sub(*above)));
        above.copy_from_slice(row);
    }
    let height = pixels.len() / width;
    let mut header = [width as u32, height as u32].map(u32::to_be_bytes).concat();
    header.extend(FORMAT);
    let mut file = SIGNATURE.to_vec();
    chunk(&mut file, b"IHDR", &header);
    chunk(&mut file, b"IDAT", &miniz_oxide::deflate::compress_to_vec_zlib(&rows, COMPRESSION));
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

    #[test]
    fn a_picture_holds_its_pixels() {
        let pixels: Vec<u8> = (0..6).collect();
        let file = grey(&pixels, 3);
        assert_eq!(file[..8], SIGNATURE);
        assert_eq!(file[16..24], [0, 0, 0, 3, 0, 0, 0, 2], "three wide, two high");
        let at = file.windows(4).position(|w| w == b"IDAT").expect("data");
        let len = u32::from_be_bytes(file[at - 4..at].try_into().expect("four bytes")) as usize;
        let rows = miniz_oxide::inflate::decompress_to_vec_zlib(&file[at + 4..at + 4 + len]).expect("zlib");
        assert_eq!(rows, [2, 0, 1, 2, 2, 3, 3, 3]);
        assert_eq!(file[file.len() - 8..], *b"IEND\xAE\x42\x60\x82", "the checksum of the empty last chunk");
    }
}
