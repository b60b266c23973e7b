//! One channel of a WAV file, checked before it is believed.

use std::ops::Range;
use std::path::{Path, PathBuf};

use echolake_acquisition::disk::open_plain_file;
use echolake_schema::messages::SampleFormat;
use echolake_schema::samples::split_24;

use crate::Error;
use crate::wav_layout::{SampleCoding, WavLayout};

/// A channel of a file.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct WavChannel {
    path: PathBuf,
    channel: u16,
    pub layout: WavLayout,
}

/// The samples of a channel.
pub(crate) struct ChannelSamples {
    pub bytes: Vec<u8>,
    pub fractions: Vec<f32>,
    pub clipped: u32,
}

/// A recording that is no measurement, of which blocks are read.
#[derive(Debug, Clone, PartialEq)]
pub struct DryWav {
    channel: WavChannel,
}

impl DryWav {
    /// Opens a channel of a WAV file: `file.wav`, or `file.wav#2` for its second one.
    ///
    /// # Errors
    /// [`Error::WavFile`].
    pub fn open(path: &Path) -> Result<Self, Error> {
        let opened = WavChannel::open(Path::new(""), &path.to_string_lossy());
        Ok(Self { channel: opened.map_err(|fault| Error::WavFile { fault })? })
    }

    /// Says which of its channels is read; None if it has one.
    pub fn describe_channel(&self) -> Option<String> {
        let channels = self.channel.layout.channels;
        (channels > 1).then(|| format!("{} of {channels}", self.channel.label()))
    }

    /// Sampling rate.
    pub fn rate_hz(&self) -> u32 {
        self.channel.layout.rate_hz
    }

    /// Samples in it.
    pub fn sample_count(&self) -> u64 {
        self.channel.layout.samples
    }

    /// Reads a range of its samples, fractions of full scale.
    ///
    /// # Errors
    /// [`Error::WavFile`].
    pub fn read_block(&self, range: Range<u64>) -> Result<Vec<f32>, Error> {
        let read = self.channel.read_samples(self.channel.sample_format(), range);
        Ok(read.map_err(|fault| Error::WavFile { fault })?.fractions)
    }
}

/// Splits `file.wav#2` into file and channel. A file of that very name comes first, and `#` without a number behind
/// it belongs to the name.
pub(crate) fn split_reference<'a>(folder: &Path, reference: &'a str) -> Result<(&'a str, u16), String> {
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    match reference.rsplit_once('#').filter(|(_, number)| is_number(number)) {
        Some((name, number)) if !folder.join(reference).exists() => {
            let channel = number.parse().map_err(|_| format!("`#{number}` is no channel number"))?;
            Ok((name, channel))
        }
        _ => Ok((reference, 1)),
    }
}

impl WavChannel {
    /// Opens `file.wav`, or `file.wav#2` for its second channel. The text of an error names the fault.
    pub fn open(folder: &Path, reference: &str) -> Result<Self, String> {
        let (name, channel) = split_reference(folder, reference)?;
        let path = folder.join(name);
        let shown = path.display();
        let size = open_plain_file(&path).and_then(|file| file.metadata());
        let size = size.map_err(|e| format!("cannot read `{shown}`: {e}"))?.len();
        if size == 0 {
            return Err(format!("`{shown}` is empty"));
        }
        let layout = WavLayout::read(&path).map_err(|fault| format!("`{shown}` {fault}"))?;
        if layout.samples == 0 {
            return Err(format!("`{shown}` has no samples"));
        }
        if !(1..=layout.channels).contains(&channel) {
            return Err(format!("`{shown}` has {} channels, expected one with number {channel}", layout.channels));
        }
        Ok(Self { path, channel: channel - 1, layout })
    }

    /// Returns its file and channel, for messages.
    pub fn label(&self) -> String {
        format!("`{}`, channel {}", self.path.display(), self.channel + 1)
    }

    /// Returns the format that stores its samples without loss.
    pub fn sample_format(&self) -> SampleFormat {
        match (self.layout.coding, self.layout.bits) {
            (SampleCoding::Float, _) => SampleFormat::F32le,
            (SampleCoding::Integer, ..=16) => SampleFormat::S16le,
            (SampleCoding::Integer, ..=24) => SampleFormat::S24Split,
            (SampleCoding::Integer, _) => SampleFormat::S32le,
        }
    }

    /// Reads a range of its samples, as bytes of `format`, which is its own or one that holds them; beyond its end they
    /// are 0.
    pub fn read_samples(&self, format: SampleFormat, range: Range<u64>) -> Result<ChannelSamples, String> {
        let failed = |fault: String| format!("`{}` {fault}", self.path.display());
        let count = range.end.saturating_sub(range.start) as usize;
        let width = format.sample_bytes().unwrap_or(4);
        let mut out = ChannelSamples { bytes: Vec::new(), fractions: Vec::with_capacity(count), clipped: 0 };
        let mut wide = Vec::new();
        if self.layout.coding == SampleCoding::Float {
            let visit = |x: f32| {
                out.fractions.push(x);
                out.clipped += u32::from(x.abs() >= 1.0);
            };
            self.layout.visit_floats(&self.path, self.channel, range, visit).map_err(failed)?;
            if let Some(x) = out.fractions.iter().find(|x| !x.is_finite()) {
                return Err(failed(format!("has a sample that is {x}")));
            }
        } else {
            let highest = i32::MAX - ((1u32 << (32 - self.layout.bits)) - 1) as i32;
            let visit = |x: i32| {
                wide.push(x >> (32 - 8 * width));
                out.fractions.push((f64::from(x) / 2f64.powi(31)) as f32);
                out.clipped += u32::from(x == i32::MIN || x >= highest);
            };
            self.layout.visit_integers(&self.path, self.channel, range, visit).map_err(failed)?;
            wide.resize(count, 0);
        }
        out.fractions.resize(count, 0.0);
        out.bytes = match format {
            SampleFormat::F32le => out.fractions.iter().flat_map(|x| x.to_le_bytes()).collect(),
            SampleFormat::S24Split => split_24(&wide),
            _ => wide.iter().flat_map(|x| x.to_le_bytes().into_iter().take(width)).collect(),
        };
        Ok(out)
    }

    /// Reads all of its samples.
    pub fn read_all(&self, format: SampleFormat) -> Result<ChannelSamples, String> {
        self.read_samples(format, 0..self.layout.samples)
    }
}

/// Returns the wider of two formats, if one holds the other's samples exactly; floats hold integers of 24 bits.
pub(crate) fn common_format(a: SampleFormat, b: SampleFormat) -> Option<SampleFormat> {
    let is_float = [a, b].contains(&SampleFormat::F32le);
    if is_float && a != b {
        return (![a, b].contains(&SampleFormat::S32le)).then_some(SampleFormat::F32le);
    }
    Some(if a.sample_bytes() > b.sample_bytes() { a } else { b })
}

#[cfg(test)]
mod tests {
    use echolake_schema::samples::{decode_samples, encode_wav};

    use super::*;

    fn written(folder: &Path, bits: usize, samples: &[i32]) -> WavChannel {
        let format = [SampleFormat::S16le, SampleFormat::S24le, SampleFormat::S32le][bits / 8 - 2];
        let bytes: Vec<u8> = samples.iter().flat_map(|x| x.to_le_bytes().into_iter().take(bits / 8)).collect();
        let name = format!("{bits}.wav");
        std::fs::write(folder.join(&name), encode_wav(format, 96_000, &[&bytes]).expect("a file")).expect("written");
        WavChannel::open(folder, &name).expect("a channel")
    }

    /// E25: a file that is there is read, whatever its name; a channel is what stands behind the last `#` if it is
    /// digits.
    #[test]
    fn a_number_sign_belongs_to_a_name_unless_a_channel_follows_it() {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::create_dir(folder.path().join("C# takes")).expect("made");
        let frames: [&[u8]; 2] = [&[1, 0], &[2, 0]];
        let wav = encode_wav(SampleFormat::S16le, 96_000, &frames).expect("a file");
        let names = ["TrumpetF#2.wav", "take #1.WAV", "C# takes/voice.wav", "odd#2", "A#.wav", "B#"];
        for name in names {
            std::fs::write(folder.path().join(name), &wav).expect("written");
        }
        for name in names {
            for (reference, channel) in [(name.to_owned(), 1), (format!("{name}#1"), 1), (format!("{name}#2"), 2)] {
                let samples = WavChannel::open(folder.path(), &reference).expect(&reference);
                let samples = samples.read_all(SampleFormat::S16le).expect("samples");
                assert_eq!(samples.bytes, [channel, 0], "{reference}");
            }
        }
        let refused = |reference: &str| WavChannel::open(folder.path(), reference).expect_err(reference);
        assert!(refused("A#.wav#3").contains("has 2 channels, expected one with number 3"));
        assert!(refused("A#.wav#0").contains("has 2 channels, expected one with number 0"));
        assert_eq!(refused("A#.wav#70000"), "`#70000` is no channel number");
        assert!(refused("A#.wav#two").contains("A#.wav#two`: No such file"), "{}", refused("A#.wav#two"));
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
            assert_eq!(channel.sample_format(), format);
            for wider in widths.into_iter().filter(|(w, _)| *w >= bits).map(|(_, f)| f) {
                let read = channel.read_all(wider).expect("samples");
                let mut decoded = [f32::NAN; 7];
                decode_samples(wider, &read.bytes, &mut decoded).expect("bytes of this format");
                assert_eq!(decoded.as_slice(), read.fractions, "{bits} bits as {wider:?}");
                assert_eq!(decoded.map(|y| (f64::from(y) * full as f64) as i32), samples.map(|x| (x as f32) as i32));
                assert_eq!(read.clipped, 2);
            }
        }
    }
}
