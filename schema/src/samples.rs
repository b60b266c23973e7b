//! Samples of a recording to and from their bytes: written in the one format that is stored, read in all.
//!
//! ```
//! use echolake_schema::messages::SampleFormat;
//! use echolake_schema::samples;
//!
//! let bytes = samples::split_24(&[-0x80_0000, 0x40_0000]);
//! let mut fractions = [0.0; 2];
//! samples::decode_samples(SampleFormat::S24Split, &bytes, &mut fractions)?;
//! assert_eq!(fractions, [-1.0, 0.5]);
//! # Ok::<(), echolake_schema::Error>(())
//! ```

use crate::Error;
use crate::messages::SampleFormat;

/// Full scale's share that a step of 24 bits is.
const FRACTION_24: f32 = 1.0 / 8_388_608.0;

/// Signed 24-bit samples as [`SampleFormat::S24Split`]; of each sample its lowest 24 bits are kept.
pub fn split_24(samples: &[i32]) -> Vec<u8> {
    let mut bytes = vec![0; 3 * samples.len()];
    let (low, upper) = bytes.split_at_mut(samples.len());
    for ((l, u), x) in low.iter_mut().zip(upper.as_chunks_mut().0).zip(samples) {
        *l = *x as u8;
        *u = ((x >> 8) as i16).to_le_bytes();
    }
    bytes
}

/// The upper 16 bits of samples in [`SampleFormat::S24Split`], as [`SampleFormat::S16le`]: a slice, without a copy.
pub fn upper_16(split: &[u8]) -> &[u8] {
    &split[split.len() / 3..]
}

/// Writes the samples into `out` as fractions of full scale, -1.0 to 1.0: exact for up to 24 bits, the nearest `f32`
/// for 32.
///
/// # Errors
/// [`Error::SampleFormat`] if the format is unknown, [`Error::SampleBytes`] if the number of bytes is not the one that
/// `out` takes, [`Error::Sample`] if a sample is not a finite number; `out` is unspecified after an error.
pub fn decode_samples(format: SampleFormat, bytes: &[u8], out: &mut [f32]) -> Result<(), Error> {
    let width = format.sample_bytes().ok_or(Error::SampleFormat)?;
    if out.len().checked_mul(width) != Some(bytes.len()) {
        return Err(Error::SampleBytes { actual: bytes.len(), samples: out.len(), width });
    }
    match format {
        SampleFormat::S16le => decode_each(bytes, out, |b| f32::from(i16::from_le_bytes(b)) * (1.0 / 32_768.0)),
        SampleFormat::S24le => decode_each(bytes, out, |[l, m, h]| fraction_24(i32::from_le_bytes([0, l, m, h]) >> 8)),
        SampleFormat::S32le => decode_each(bytes, out, |b| i32::from_le_bytes(b) as f32 * (1.0 / 2_147_483_648.0)),
        SampleFormat::F32le => {
            decode_each(bytes, out, f32::from_le_bytes);
            if let Some(index) = out.iter().position(|x| !x.is_finite()) {
                return Err(Error::Sample { index, value: out[index] });
            }
        }
        SampleFormat::S24Split => {
            let (low, upper) = bytes.split_at(out.len());
            for ((y, l), u) in out.iter_mut().zip(low).zip(upper.as_chunks().0) {
                *y = fraction_24(i32::from(i16::from_le_bytes(*u)) << 8 | i32::from(*l));
            }
        }
        SampleFormat::Unspecified => return Err(Error::SampleFormat),
    }
    Ok(())
}

/// A WAV file of channels in one format, [`SampleFormat::S24Split`] becoming 24 bits a sample; of more than 4 GB it has
/// a header of unknown length.
///
/// ```
/// use echolake_schema::messages::SampleFormat;
///
/// let channel = [0.5f32, -0.25].map(f32::to_le_bytes).concat();
/// let file = echolake_schema::samples::encode_wav(SampleFormat::F32le, 96_000, &[&channel, &channel])?;
/// assert_eq!((file.len(), &file[..4], &file[36..40]), (44 + 16, &b"RIFF"[..], &b"data"[..]));
/// # Ok::<(), echolake_schema::Error>(())
/// ```
///
/// # Errors
/// [`Error::SampleFormat`] if the format is unknown, [`Error::SampleBytes`] if a channel is not as long as the first.
pub fn encode_wav(format: SampleFormat, rate_hz: u32, channels: &[&[u8]]) -> Result<Vec<u8>, Error> {
    let width = format.sample_bytes().ok_or(Error::SampleFormat)?;
    let samples = channels.first().map_or(0, |channel| channel.len() / width);
    if let Some(wrong) = channels.iter().find(|channel| channel.len() != samples * width) {
        return Err(Error::SampleBytes { actual: wrong.len(), samples, width });
    }
    let mut file = encode_wav_header(format, rate_hz, channels.len(), samples)?;
    file.reserve(samples * width * channels.len());
    for i in 0..samples {
        for channel in channels {
            match format {
                SampleFormat::S24Split => {
                    file.push(channel[i]);
                    file.extend_from_slice(&channel[samples + 2 * i..][..2]);
                }
                _ => file.extend_from_slice(&channel[width * i..][..width]),
            }
        }
    }
    Ok(file)
}

/// Encodes what precedes the samples of a WAV file, `samples` of each of `channels`.
///
/// # Errors
/// [`Error::SampleFormat`] if the format is unknown.
pub fn encode_wav_header(
    format: SampleFormat,
    rate_hz: u32,
    channels: usize,
    samples: usize,
) -> Result<Vec<u8>, Error> {
    let width = format.sample_bytes().ok_or(Error::SampleFormat)?;
    let frame = width * channels;
    let [riff_bytes, data_bytes] =
        [36 + samples * frame, samples * frame].map(|bytes| u32::try_from(bytes).unwrap_or(u32::MAX).to_le_bytes());
    let tag = if format == SampleFormat::F32le { 3 } else { 1 };
    let [tag, channel_count, frame_bytes, bits] =
        [tag, channels, frame, 8 * width].map(|field| (field as u16).to_le_bytes());
    let [rate, byte_rate] = [rate_hz, rate_hz.saturating_mul(frame as u32)].map(u32::to_le_bytes);
    let mut file = [*b"RIFF", riff_bytes, *b"WAVE", *b"fmt ", 16u32.to_le_bytes()].concat();
    file.extend([&tag[..], &channel_count, &rate, &byte_rate, &frame_bytes, &bits, b"data", &data_bytes].concat());
    Ok(file)
}

fn decode_each<const N: usize>(bytes: &[u8], out: &mut [f32], decode: impl Fn([u8; N]) -> f32) {
    out.iter_mut().zip(bytes.as_chunks().0).for_each(|(y, b)| *y = decode(*b));
}

fn fraction_24(x: i32) -> f32 {
    x as f32 * FRACTION_24
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All that is odd about 24 bits: both ends, signs, and carries from byte to byte.
    const SAMPLES: [i32; 11] = [0, 1, -1, 0x7F, 0x80, 0xFF, 0x100, -0x100, 0x12_3456, 0x7F_FFFF, -0x80_0000];

    fn decoded(format: SampleFormat, bytes: &[u8], count: usize) -> Result<Vec<f32>, Error> {
        let mut out = vec![f32::NAN; count];
        decode_samples(format, bytes, &mut out).map(|()| out)
    }

    #[test]
    fn split_samples_come_back_exactly() {
        // Long enough, and of a length that no vector divides, for the loop's vector part and its rest.
        let samples: Vec<i32> = SAMPLES.into_iter().cycle().take(1_003).collect();
        let fractions = decoded(SampleFormat::S24Split, &split_24(&samples), samples.len()).expect("samples");
        let back: Vec<i32> = fractions.iter().map(|y| (y * 8_388_608.0) as i32).collect();
        assert_eq!(back, samples);
    }

    #[test]
    fn split_and_packed_are_the_same_samples() {
        let packed: Vec<u8> = SAMPLES.iter().flat_map(|x| x.to_le_bytes().into_iter().take(3)).collect();
        let of = |format, bytes: &[u8]| decoded(format, bytes, SAMPLES.len()).expect("samples");
        assert_eq!(of(SampleFormat::S24Split, &split_24(&SAMPLES)), of(SampleFormat::S24le, &packed));
    }

    // Files that were written must stay readable, so the test spells out the bytes.
    #[test]
    fn low_bytes_come_first_and_upper_ones_are_16_bit() {
        let bytes = split_24(&[0x12_3456, -2]);
        assert_eq!(bytes, [0x56, 0xFE, 0x34, 0x12, 0xFF, 0xFF]);
        assert_eq!(upper_16(&bytes), [0x34, 0x12, 0xFF, 0xFF]);
        assert!(upper_16(&[]).is_empty());
    }

    // The file that Python 3's module `wave` writes of these frames, and the bytes that SciPy's `wavfile` reads.
    #[test]
    fn wav_files_are_those_of_other_programs() {
        let packed = [0x56, 0x34, 0x12, 0xFE, 0xFF, 0xFF];
        let turned = [0xFE, 0xFF, 0xFF, 0x56, 0x34, 0x12];
        let expected =
            b"RIFF\x30\0\0\0WAVEfmt \x10\0\0\0\x01\0\x02\0\0\x77\x01\0\0\xca\x08\0\x06\0\x18\0data\x0c\0\0\0\
                         \x56\x34\x12\xfe\xff\xff\xfe\xff\xff\x56\x34\x12";
        let encoded = |format, channels: &[&[u8]]| encode_wav(format, 96_000, channels).expect("a file");
        assert_eq!(encoded(SampleFormat::S24le, &[&packed, &turned]), expected);
        let [first, second] = [[0x12_3456, -2], [-2, 0x12_3456]].map(|samples| split_24(&samples));
        assert_eq!(encoded(SampleFormat::S24Split, &[&first, &second]), expected);
        let uneven = encode_wav(SampleFormat::S24le, 96_000, &[&packed, &turned[..3]]);
        assert_eq!(uneven, Err(Error::SampleBytes { actual: 3, samples: 2, width: 3 }));
    }

    #[test]
    fn every_format_has_the_same_full_scale() {
        let check = |format, bytes: &[u8]| {
            assert_eq!(decoded(format, bytes, 2).expect("two samples"), [-1.0, 0.5], "{format:?}");
        };
        check(SampleFormat::S16le, &[0, 0x80, 0, 0x40]);
        check(SampleFormat::S24le, &[0, 0, 0x80, 0, 0, 0x40]);
        check(SampleFormat::S24Split, &[0, 0, 0, 0x80, 0, 0x40]);
        check(SampleFormat::S32le, &[0, 0, 0, 0x80, 0, 0, 0, 0x40]);
        check(SampleFormat::F32le, &[0, 0, 0x80, 0xBF, 0, 0, 0, 0x3F]);
    }

    #[test]
    fn wrong_lengths_unknown_formats_and_nan_are_said() {
        let formats = [
            SampleFormat::S16le,
            SampleFormat::S24le,
            SampleFormat::S24Split,
            SampleFormat::S32le,
            SampleFormat::F32le,
        ];
        for format in formats {
            let width = format.sample_bytes().expect("a width");
            for actual in [0, width, 2 * width - 1, 2 * width + 1, 3 * width] {
                let expected = Error::SampleBytes { actual, samples: 2, width };
                assert_eq!(decoded(format, &vec![0; actual], 2), Err(expected), "{format:?}");
            }
            assert_eq!(decoded(format, &[], 0), Ok(Vec::new()), "{format:?}");
        }
        assert_eq!(decoded(SampleFormat::Unspecified, &[], 0), Err(Error::SampleFormat));
        let bytes = [1.0, f32::INFINITY].map(f32::to_le_bytes).concat();
        let expected = Error::Sample { index: 1, value: f32::INFINITY };
        assert_eq!(decoded(SampleFormat::F32le, &bytes, 2), Err(expected));
    }
}
