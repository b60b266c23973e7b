//! Layout of a WAV file: how its samples are coded, and where they are. RIFF, and RF64 or BW64 for more than 4 GB.
//!
//! Every byte of a file belongs to a chunk, or the file is refused: bytes behind the samples that are no chunk are
//! samples that its header does not know.

#[cfg(test)]
mod tests;

use std::fs::File;
use std::io::{BufReader, ErrorKind, Read, Seek as _, SeekFrom};
use std::ops::Range;
use std::path::Path;

/// Format tags of the `fmt` chunk.
const INTEGER: u16 = 1;
const FLOAT: u16 = 3;
const EXTENSIBLE: u16 = 0xFFFE;
/// Least length that a writer puts into the header if it does not know the samples' length, because it cannot seek.
const UNKNOWN_BYTES: u64 = 0x7FFF_F000;
/// Length of a chunk whose true one is in `ds64`.
const LONG_BYTES: u64 = 0xFFFF_FFFF;

/// How a sample is coded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SampleCoding {
    /// Signed, but for those of one byte.
    Integer,
    /// 32 or 64 bits.
    Float,
}

/// Coding and place of a file's samples.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct WavLayout {
    pub coding: SampleCoding,
    pub rate_hz: u32,
    pub channels: u16,
    /// Bytes of a sample: 1 to 4, or 8.
    width: usize,
    /// Bits of a sample that are valid.
    pub bits: u32,
    /// Unused bits above the valid ones; those below are 0.
    unused_above: u32,
    /// Place of the first sample, bytes.
    start: u64,
    /// Samples of each channel.
    pub samples: u64,
    /// Faults of the header that cost nothing.
    pub warnings: Vec<String>,
}

/// A chunk's name, and the place and length of its content.
struct ChunkHead {
    name: [u8; 4],
    start: u64,
    bytes: u64,
}

/// Chunks are found one after the other.
struct ChunkReader {
    file: BufReader<File>,
    size: u64,
    /// Place of the next chunk.
    at: u64,
}

impl WavLayout {
    /// Reads the layout; the text of an error says what the file is or has instead.
    pub fn read(path: &Path) -> Result<Self, String> {
        let mut chunks = ChunkReader::open(path)?;
        let (mut format, mut long_bytes, mut data) = (None, None, None);
        while let Some(mut chunk) = chunks.next(data.is_some())? {
            let place = chunk.start - 8;
            let is_data = chunk.name == *b"data";
            if is_data && let Some(bytes) = long_bytes.filter(|_| chunk.bytes == LONG_BYTES) {
                chunk.bytes = bytes;
            }
            let there = chunks.size - chunk.start;
            let declared = chunk.bytes;
            let is_unknown = is_data
                && match declared {
                    0 => there > 1 && chunks.head_at(chunk.start)?.is_none(),
                    _ => declared > there && (UNKNOWN_BYTES..=LONG_BYTES).contains(&declared),
                };
            if is_unknown {
                chunk.bytes = there;
            } else if is_data && declared > there {
                return Err(format!(
                    "is cut off: its header says {declared} bytes of samples from byte {} on, {there} are there; hint: \
                     copy it again",
                    chunk.start
                ));
            }
            match &chunk.name {
                b"data" if data.is_some() => {
                    return Err(format!(
                        "has a second `data` chunk at byte {place}, expected one; hint: export it again"
                    ));
                }
                b"data" => data = Some((chunk.start, chunk.bytes, is_unknown.then_some(declared))),
                b"fmt " => format = Some(chunks.content::<40>(&chunk)?),
                b"ds64" => {
                    let [_, _, _, _, _, _, _, _, length @ ..] = chunks.content::<16>(&chunk)?;
                    long_bytes = Some(u64::from_le_bytes(length));
                }
                _ => {}
            }
            chunks.pass(&chunk)?;
        }
        let (start, bytes, unknown) = data.ok_or("is no WAV file that can be read: it has no `data` chunk")?;
        let format = format.ok_or("is no WAV file that can be read: it has no `fmt ` chunk")?;
        let mut layout = Self::from_format(&format)?;
        let frame_bytes = layout.frame_bytes() as u64;
        if unknown.is_none() && !bytes.is_multiple_of(frame_bytes) {
            return Err(format!(
                "ends within a sample: {bytes} bytes of samples from byte {start} on, {frame_bytes} for one of each \
                 channel"
            ));
        }
        layout.start = start;
        layout.samples = bytes / frame_bytes;
        if let Some(declared) = unknown {
            let samples = layout.samples;
            layout.warnings.push(format!(
                "its header says {declared} bytes of samples, {bytes} are there: all of its {samples} samples to the \
                 file's end are taken"
            ));
        }
        layout.unused_above = layout.find_unused_above(path)?;
        Ok(layout)
    }

    // Of the content of `fmt`; what it lacks of an extension is 0.
    fn from_format(format: &[u8; 40]) -> Result<Self, String> {
        let short = |at: usize| u16::from_le_bytes([format[at], format[at + 1]]);
        let long = |at: usize| u32::from_le_bytes([format[at], format[at + 1], format[at + 2], format[at + 3]]);
        let rate_hz = long(4);
        let (channels, frame_bytes, stored_bits) = (short(2), usize::from(short(12)), short(14));
        let (tag, bits) = match short(0) {
            // Some writers leave the number of valid bits at 0.
            EXTENSIBLE => (short(24), if short(18) == 0 { stored_bits } else { short(18) }),
            tag => (tag, stored_bits),
        };
        if channels == 0 || rate_hz == 0 || !frame_bytes.is_multiple_of(usize::from(channels)) {
            return Err(format!(
                "has {channels} channels in {frame_bytes} bytes at {rate_hz} Hz, expected whole bytes"
            ));
        }
        let width = frame_bytes / usize::from(channels);
        let bits = u32::from(bits);
        let coding = match (tag, width, bits) {
            (INTEGER, 1, 8) => SampleCoding::Integer,
            (INTEGER, 2..=4, 9..=32) if bits <= 8 * width as u32 => SampleCoding::Integer,
            (FLOAT, 4, 32) | (FLOAT, 8, 64) => SampleCoding::Float,
            (INTEGER | FLOAT, ..) => {
                let kind = if tag == FLOAT { "float" } else { "integer" };
                return Err(format!(
                    "has {kind} samples of {bits} bits in {width} bytes, expected integers of 8, 16, 24 or 32 bits \
                     or floats of 32 or 64"
                ));
            }
            (other, ..) => return Err(format!("is coded by format {other:#06x}, expected plain integers or floats")),
        };
        let declared = u64::from(long(8));
        let expected = u64::from(rate_hz) * frame_bytes as u64;
        let warning = (declared != expected).then(|| {
            format!("its header says {declared} bytes a second, expected {expected}: its rate of {rate_hz} Hz counts")
        });
        let warnings = Vec::from_iter(warning);
        Ok(Self { coding, rate_hz, channels, width, bits, unused_above: 0, start: 0, samples: 0, warnings })
    }

    fn frame_bytes(&self) -> usize {
        self.width * usize::from(self.channels)
    }

    // Samples of fewer bits than their bytes have are in the upper bits by the format's definition, and in the lower
    // ones of some writers. Which of both it is shows in all samples together.
    fn find_unused_above(&self, path: &Path) -> Result<u32, String> {
        let (width_bits, bits) = (8 * self.width as u32, self.bits);
        let unused = width_bits - bits;
        if self.coding == SampleCoding::Float || unused == 0 {
            return Ok(0);
        }
        // The samples' bytes are the uppermost of 32 bits.
        let below = ((1u32 << unused) - 1) << (32 - width_bits);
        let (mut is_upper, mut is_lower) = (true, true);
        self.visit(path, 0..self.samples, |frame| {
            for x in frame.chunks_exact(self.width).map(upper_bits) {
                is_upper &= x as u32 & below == 0;
                is_lower &= x << unused >> unused == x;
            }
        })?;
        match (is_upper, is_lower) {
            (true, _) => Ok(0),
            (false, true) => Ok(unused),
            _ => Err(format!("says that {bits} of {width_bits} bits of a sample are valid, and uses the others, too")),
        }
    }

    /// Visits the integers of a channel, counted from 0, as the uppermost of 32 bits; of a range of samples, those that
    /// there are.
    pub fn visit_integers(
        &self,
        path: &Path,
        channel: u16,
        range: Range<u64>,
        mut visit: impl FnMut(i32),
    ) -> Result<(), String> {
        let first = usize::from(channel) * self.width;
        self.visit(path, range, |frame| visit(upper_bits(&frame[first..first + self.width]) << self.unused_above))
    }

    /// Visits the floats of a channel, as [`Self::visit_integers`] does.
    pub fn visit_floats(
        &self,
        path: &Path,
        channel: u16,
        range: Range<u64>,
        mut visit: impl FnMut(f32),
    ) -> Result<(), String> {
        let first = usize::from(channel) * self.width;
        self.visit(path, range, |frame| {
            let bytes = &frame[first..first + self.width];
            visit(match bytes.try_into().map(f64::from_le_bytes) {
                Ok(double) => double as f32,
                Err(_) => f32::from_bits(upper_bits(bytes) as u32),
            });
        })
    }

    // Visits one sample of each channel after the other.
    fn visit(&self, path: &Path, range: Range<u64>, mut visit: impl FnMut(&[u8])) -> Result<(), String> {
        let failed = |e: std::io::Error| format!("cannot be read: {e}");
        let mut file = BufReader::new(File::open(path).map_err(failed)?);
        let mut frame = vec![0; self.frame_bytes()];
        file.seek(SeekFrom::Start(self.start + range.start * frame.len() as u64)).map_err(failed)?;
        for _ in range.start..range.end.min(self.samples) {
            file.read_exact(&mut frame).map_err(failed)?;
            visit(&frame);
        }
        Ok(())
    }
}

// Little-endian bytes as the uppermost of 32 bits; a single byte counts from 0, its middle is silence.
fn upper_bits(bytes: &[u8]) -> i32 {
    if let [byte] = bytes {
        return i32::from(byte ^ 0x80) << 24;
    }
    bytes.iter().rev().fold(0u32, |x, byte| x << 8 | u32::from(*byte)).wrapping_shl(32 - 8 * bytes.len() as u32) as i32
}

impl ChunkReader {
    fn open(path: &Path) -> Result<Self, String> {
        let failed = |e: std::io::Error| format!("cannot be read: {e}");
        let file = File::open(path).map_err(failed)?;
        let size = file.metadata().map_err(failed)?.len();
        let mut chunks = Self { file: BufReader::new(file), size, at: 12 };
        let head: [u8; 12] = chunks.bytes_at(0)?;
        match (&head[..4], &head[8..]) {
            (b"RIFF" | b"RF64" | b"BW64", b"WAVE") => Ok(chunks),
            _ => Err("is no WAV file that can be read: it does not begin with `RIFF` and `WAVE`".into()),
        }
    }

    // Finds the next chunk; None at the end of the file.
    fn next(&mut self, has_data: bool) -> Result<Option<ChunkHead>, String> {
        let left = self.size.saturating_sub(self.at);
        // The last chunk may be padded.
        if left == 0 || (left == 1 && has_data) {
            return Ok(None);
        }
        match (self.head_at(self.at)?, has_data) {
            (Some(chunk), _) => Ok(Some(chunk)),
            (None, true) => Err(format!(
                "has {left} bytes behind its samples, from byte {} on, that are no chunk of a WAV file: its header \
                 says fewer samples than there are, or it is damaged; hint: export it again",
                self.at
            )),
            (None, false) => Err(format!("is no WAV file that can be read: byte {} begins no chunk", self.at)),
        }
    }

    // The chunk that begins at a place, if one does.
    fn head_at(&mut self, at: u64) -> Result<Option<ChunkHead>, String> {
        let left = self.size.saturating_sub(at);
        let head: [u8; 8] = self.bytes_at(at)?;
        let [name @ .., a, b, c, d] = head;
        let bytes = u64::from(u32::from_le_bytes([a, b, c, d]));
        let is_name = name.iter().all(|byte| (b' '..=b'~').contains(byte));
        let is_within = name == *b"data" || left >= 8 + bytes;
        let is_chunk = is_name && left >= 8 && is_within;
        Ok(is_chunk.then_some(ChunkHead { name, start: at + 8, bytes }))
    }

    // Goes behind a chunk. One of odd length is padded; some writers do not.
    fn pass(&mut self, chunk: &ChunkHead) -> Result<(), String> {
        let end = chunk.start + chunk.bytes;
        let is_padded = chunk.bytes % 2 == 1 && !matches!(&self.bytes_at::<4>(end)?, b"data" | b"fmt ");
        self.at = end + u64::from(is_padded);
        Ok(())
    }

    // The first bytes of a chunk's content; zeros follow a shorter one.
    fn content<const N: usize>(&mut self, chunk: &ChunkHead) -> Result<[u8; N], String> {
        let mut content = self.bytes_at(chunk.start)?;
        content.iter_mut().skip(chunk.bytes as usize).for_each(|byte| *byte = 0);
        Ok(content)
    }

    // Bytes at a place; zeros follow the file's end.
    fn bytes_at<const N: usize>(&mut self, at: u64) -> Result<[u8; N], String> {
        let failed = |e: std::io::Error| format!("cannot be read: {e}");
        self.file.seek(SeekFrom::Start(at)).map_err(failed)?;
        let mut bytes = [0; N];
        let mut filled = 0;
        while filled < N {
            match self.file.read(&mut bytes[filled..]) {
                Ok(0) => break,
                Ok(count) => filled += count,
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) => return Err(failed(e)),
            }
        }
        Ok(bytes)
    }
}
