//! One channel of a WAV file, checked before it is believed.

use std::fs::File;
use std::io::{BufReader, Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};

use echolake_schema::messages::SampleFormat;
use echolake_schema::samples::split_24;
use hound::{SampleFormat as WavFormat, WavReader, WavSpec};

/// A channel of a file.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct WavChannel {
    path: PathBuf,
    channel: u16,
    pub(super) spec: WavSpec,
    pub(super) samples: u32,
}

/// The samples of a channel.
pub(super) struct ChannelSamples {
    pub(super) bytes: Vec<u8>,
    pub(super) fractions: Vec<f32>,
    pub(super) clipped: u32,
}

impl WavChannel {
    /// Opens `file.wav`, or `file.wav#2` for its second channel. The text of an error names the fault.
    pub(super) fn open(folder: &Path, reference: &str) -> Result<Self, String> {
        let (name, channel) = match reference.rsplit_once('#') {
            Some((name, number)) => {
                let number: u16 = number.parse().map_err(|_| format!("`#{number}` is no channel number"))?;
                (name, number)
            }
            None => (reference, 1),
        };
        let path = folder.join(name);
        let shown = path.display();
        let size = std::fs::metadata(&path).map_err(|e| format!("cannot read `{shown}`: {e}"))?.len();
        if size == 0 {
            return Err(format!("`{shown}` is empty"));
        }
        let reader = WavReader::open(&path).map_err(|e| format!("`{shown}` is no WAV file that can be read: {e}"))?;
        let (spec, samples) = (reader.spec(), reader.duration());
        drop(reader);
        // hound does not check the header's length; a file that was cut off is shorter than it says.
        let (start, declared) = data_chunk(&path).map_err(|e| format!("`{shown}`: {e}"))?;
        if size < start + declared {
            let there = size.saturating_sub(start);
            return Err(format!(
                "`{shown}` is cut off: its header says {declared} bytes of samples, {there} are there"
            ));
        }
        if samples == 0 {
            return Err(format!("`{shown}` has no samples"));
        }
        if !(1..=spec.channels).contains(&channel) {
            return Err(format!("`{shown}` has {} channels, expected one with number {channel}", spec.channels));
        }
        let found = Self { path, channel: channel - 1, spec, samples };
        match found.format() {
            Some(_) => Ok(found),
            None => Err(format!(
                "`{}` has {} bits a sample, expected 16, 24 or 32",
                found.path.display(),
                spec.bits_per_sample
            )),
        }
    }

    /// Returns its file and channel, for messages.
    pub(super) fn label(&self) -> String {
        format!("`{}`, channel {}", self.path.display(), self.channel + 1)
    }

    /// Returns the format that stores its samples without loss.
    pub(super) fn format(&self) -> Option<SampleFormat> {
        match (self.spec.sample_format, self.spec.bits_per_sample) {
            (WavFormat::Int, 16) => Some(SampleFormat::S16le),
            (WavFormat::Int, 24) => Some(SampleFormat::S24Split),
            (WavFormat::Int, 32) => Some(SampleFormat::S32le),
            (WavFormat::Float, 32) => Some(SampleFormat::F32le),
            _ => None,
        }
    }

    /// Reads its samples, as bytes of `format`, which is its own or a wider one.
    pub(super) fn read(&self, format: SampleFormat) -> Result<ChannelSamples, String> {
        let failed = |e: hound::Error| format!("cannot read `{}`: {e}", self.path.display());
        let mut reader = WavReader::open(&self.path).map_err(failed)?;
        let (skip, step) = (usize::from(self.channel), usize::from(self.spec.channels));
        let mut out = ChannelSamples { bytes: Vec::new(), fractions: Vec::new(), clipped: 0 };
        if self.spec.sample_format == WavFormat::Float {
            for sample in reader.samples::<f32>().skip(skip).step_by(step) {
                let x = sample.map_err(failed)?;
                if !x.is_finite() {
                    return Err(format!("`{}` has a sample that is {x}", self.path.display()));
                }
                out.bytes.extend(x.to_le_bytes());
                out.fractions.push(x);
                out.clipped += u32::from(x.abs() >= 1.0);
            }
            return Ok(out);
        }
        let bits = u32::from(self.spec.bits_per_sample);
        let full = 2f64.powi(bits as i32 - 1);
        let width = format.bytes().unwrap_or(4);
        let shift = 8 * width as u32 - bits;
        let mut wide = Vec::with_capacity(self.samples as usize);
        for sample in reader.samples::<i32>().skip(skip).step_by(step) {
            let x = sample.map_err(failed)?;
            wide.push(x << shift);
            out.fractions.push((f64::from(x) / full) as f32);
            let at_full_scale = f64::from(x) <= -full || f64::from(x) >= full - 1.0;
            out.clipped += u32::from(at_full_scale);
        }
        out.bytes = match format {
            SampleFormat::S24Split => split_24(&wide),
            _ => wide.iter().flat_map(|x| x.to_le_bytes().into_iter().take(width)).collect(),
        };
        Ok(out)
    }
}

/// Returns the wider of two formats, if one holds the other's samples exactly.
pub(super) fn common_format(a: SampleFormat, b: SampleFormat) -> Option<SampleFormat> {
    match (a == b, a == SampleFormat::F32le || b == SampleFormat::F32le) {
        (true, _) => Some(a),
        (false, true) => None,
        (false, false) => {
            if a.bytes() > b.bytes() {
                Some(a)
            } else {
                Some(b)
            }
        }
    }
}

// Returns the begin of the `data` chunk's content, and its length by its header.
fn data_chunk(path: &Path) -> Result<(u64, u64), String> {
    let mut file = BufReader::new(File::open(path).map_err(|e| e.to_string())?);
    let mut at = 12;
    loop {
        let mut head = [0; 8];
        file.seek(SeekFrom::Start(at)).map_err(|e| e.to_string())?;
        file.read_exact(&mut head).map_err(|_| "it has no `data` chunk".to_owned())?;
        let length = u64::from(u32::from_le_bytes([head[4], head[5], head[6], head[7]]));
        if &head[..4] == b"data" {
            return Ok((at + 8, length));
        }
        // Chunks begin at even places.
        at += 8 + length + length % 2;
    }
}

#[cfg(test)]
mod tests {
    use echolake_schema::samples::decode;

    use super::*;

    fn written(folder: &Path, bits_per_sample: u16, samples: &[i32]) -> WavChannel {
        let spec = WavSpec { channels: 1, sample_rate: 96_000, bits_per_sample, sample_format: WavFormat::Int };
        let name = format!("{bits_per_sample}.wav");
        let mut writer = hound::WavWriter::create(folder.join(&name), spec).expect("a file");
        samples.iter().for_each(|x| writer.write_sample(*x).expect("a sample"));
        writer.finalize().expect("a whole file");
        WavChannel::open(folder, &name).expect("a channel")
    }

    // What is stored is read back as the fractions that import itself computed with.
    #[test]
    fn every_width_keeps_its_samples() {
        let folder = tempfile::tempdir().expect("a folder");
        let widths = [(16, SampleFormat::S16le), (24, SampleFormat::S24Split), (32, SampleFormat::S32le)];
        for (bits, format) in widths {
            let full = 1i64 << (bits - 1);
            let samples = [0, 1, -1, 0x1234, -0x1235, full - 1, -full].map(|x| x as i32);
            let channel = written(folder.path(), bits, &samples);
            assert_eq!(channel.format(), Some(format));
            for wider in widths.into_iter().filter(|(w, _)| *w >= bits).map(|(_, f)| f) {
                let read = channel.read(wider).expect("samples");
                let mut decoded = [f32::NAN; 7];
                decode(wider, &read.bytes, &mut decoded).expect("bytes of this format");
                assert_eq!(decoded.as_slice(), read.fractions, "{bits} bits as {wider:?}");
                assert_eq!(decoded.map(|y| (f64::from(y) * full as f64) as i32), samples.map(|x| (x as f32) as i32));
                assert_eq!(read.clipped, 2);
            }
        }
    }
}
