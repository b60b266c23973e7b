//! Ways to damage a file, with what of it stays as it was.

use std::ops::Range;

use anyhow::{Context as _, Result};
use bytes::Bytes;
use mcap::records::Record;
use rand::Rng;
use rand::seq::IndexedRandom as _;

use super::specimen::{FRAME, FlipSpecimen};

/// Largest block that is zeroed, doubled or taken out.
const LARGEST_BLOCK: f64 = 65_536.0;
/// Flips near a record's start hit its frame and the lengths in it.
const NEAR: usize = 64;
/// Channel, number and two times in front of a message's own bytes.
const MESSAGE_HEAD: usize = 22;

/// Kind of damage to a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum DamageKind {
    /// 1 to 8 bytes anywhere.
    Flips,
    /// 1 to 8 bytes in the first ones of records.
    FrameFlips,
    /// The end is missing.
    Truncated,
    /// A block of zeros.
    Zeroed,
    /// A block is there twice.
    Doubled,
    /// A block is missing.
    Removed,
    /// All between two places is missing.
    Cut,
    /// Two to four of the above.
    Several,
    /// Bytes of messages, and the chunk's CRC is that of the damaged ones: damage from before it was written.
    Sealed,
}

/// A part of a damaged file.
#[derive(Debug, Clone)]
enum FilePiece {
    /// Bytes of the undamaged file.
    Intact(Range<usize>),
    /// Others.
    Altered(Vec<u8>),
}

/// A damaged file.
#[derive(Debug)]
pub(crate) struct DamagedFile {
    pieces: Vec<FilePiece>,
}

impl DamageKind {
    pub(crate) const ALL: [Self; 9] = [
        Self::Flips,
        Self::FrameFlips,
        Self::Truncated,
        Self::Zeroed,
        Self::Doubled,
        Self::Removed,
        Self::Cut,
        Self::Several,
        Self::Sealed,
    ];
    const SINGLE: [Self; 7] =
        [Self::Flips, Self::FrameFlips, Self::Truncated, Self::Zeroed, Self::Doubled, Self::Removed, Self::Cut];

    pub(crate) fn label(self) -> &'static str {
        match self {
            Self::Flips => "1-8 bytes flipped",
            Self::FrameFlips => "flipped near frames",
            Self::Truncated => "truncated",
            Self::Zeroed => "block zeroed",
            Self::Doubled => "block doubled",
            Self::Removed => "block removed",
            Self::Cut => "cut in the middle",
            Self::Several => "several of these",
            Self::Sealed => "messages, CRC right",
        }
    }
}

impl DamagedFile {
    /// Damages a specimen.
    ///
    /// # Errors
    /// If the specimen itself is not as expected.
    pub(crate) fn new(specimen: &FlipSpecimen, kind: DamageKind, rng: &mut impl Rng) -> Result<Self> {
        let mut damaged = Self { pieces: vec![FilePiece::Intact(0..specimen.bytes.len())] };
        match kind {
            DamageKind::Several => {
                for _ in 0..rng.random_range(2..=4) {
                    let kind = *DamageKind::SINGLE.choose(rng).context("there are kinds")?;
                    damaged.apply(specimen, kind, rng);
                }
            }
            DamageKind::Sealed => damaged.seal(specimen, rng)?,
            kind => damaged.apply(specimen, kind, rng),
        }
        Ok(damaged)
    }

    /// The damaged file's bytes.
    pub(crate) fn bytes(&self, specimen: &FlipSpecimen) -> Bytes {
        let mut bytes = Vec::with_capacity(self.len());
        for piece in &self.pieces {
            match piece {
                FilePiece::Intact(range) => bytes.extend_from_slice(&specimen.bytes[range.clone()]),
                FilePiece::Altered(altered) => bytes.extend_from_slice(altered),
            }
        }
        bytes.into()
    }

    /// Returns whether these bytes of the undamaged file are still somewhere in one piece.
    pub(crate) fn keeps(&self, part: &Range<usize>) -> bool {
        self.pieces.iter().any(|p| matches!(p, FilePiece::Intact(r) if r.start <= part.start && part.end <= r.end))
    }

    fn len(&self) -> usize {
        self.pieces.iter().map(FilePiece::len).sum()
    }

    fn apply(&mut self, specimen: &FlipSpecimen, kind: DamageKind, rng: &mut impl Rng) {
        let size = self.len();
        if size == 0 {
            return;
        }
        let length = (LARGEST_BLOCK.powf(rng.random_range(0.0..1.0)) as usize).min(size);
        let start = rng.random_range(0..=size - length);
        match kind {
            DamageKind::FrameFlips => {
                for _ in 0..rng.random_range(1..=8) {
                    let record = specimen.records.choose(rng).map_or(0, |r| r.start);
                    self.flip((record + rng.random_range(0..NEAR)).min(size - 1), specimen, rng);
                }
            }
            DamageKind::Truncated => {
                let kept = self.split(rng.random_range(0..size));
                self.pieces.truncate(kept);
            }
            DamageKind::Zeroed => self.replace(start, length, vec![FilePiece::Altered(vec![0; length])]),
            DamageKind::Doubled => {
                let (from, to) = (self.split(start), self.split(start + length));
                let copy = self.pieces[from..to].to_vec();
                self.pieces.splice(to..to, copy);
            }
            DamageKind::Removed => self.replace(start, length, Vec::new()),
            DamageKind::Cut => {
                let (a, b) = (rng.random_range(0..size), rng.random_range(0..size));
                self.replace(a.min(b), a.abs_diff(b), Vec::new());
            }
            DamageKind::Flips | DamageKind::Several | DamageKind::Sealed => {
                for _ in 0..rng.random_range(1..=8) {
                    self.flip(rng.random_range(0..size), specimen, rng);
                }
            }
        }
    }

    fn flip(&mut self, at: usize, specimen: &FlipSpecimen, rng: &mut impl Rng) {
        // Half of them a single bit, as memory and wires do.
        let mask = if rng.random() { 1 << rng.random_range(0..8) } else { rng.random_range(1..=255) };
        let index = self.split(at);
        self.split(at + 1);
        let byte = match &self.pieces[index] {
            FilePiece::Intact(range) => specimen.bytes[range.start],
            FilePiece::Altered(bytes) => bytes[0],
        };
        self.pieces[index] = FilePiece::Altered(vec![byte ^ mask]);
    }

    fn replace(&mut self, start: usize, length: usize, by: Vec<FilePiece>) {
        let (from, to) = (self.split(start), self.split(start + length));
        self.pieces.splice(from..to, by);
    }

    /// Makes a piece begin at `at`; returns its number.
    fn split(&mut self, at: usize) -> usize {
        let mut before = 0;
        for index in 0..self.pieces.len() {
            let length = self.pieces[index].len();
            if at == before {
                return index;
            }
            if at < before + length {
                let (left, right) = self.pieces[index].halves(at - before);
                self.pieces.splice(index..=index, [left, right]);
                return index + 1;
            }
            before += length;
        }
        self.pieces.len()
    }

    // Flips bytes of messages in one chunk, and rebuilds its record.
    fn seal(&mut self, specimen: &FlipSpecimen, rng: &mut impl Rng) -> Result<()> {
        let range = specimen.chunks.choose(rng).context("there are chunks")?.range.clone();
        let body = &specimen.bytes[range.start + FRAME..range.end];
        let Record::Chunk { mut header, data } = mcap::parse_record(0x06, body)? else {
            anyhow::bail!("the specimen has a damaged chunk");
        };
        let mut records = zstd::bulk::decompress(&data, usize::try_from(header.uncompressed_size)?)?;
        let messages = messages(&records)?;
        if messages.is_empty() {
            return Ok(());
        }
        for _ in 0..rng.random_range(1..=8) {
            // Most are short, and the few bytes at the front are what readers trust.
            let message = messages.choose(rng).context("there are messages")?.clone();
            let reach = if rng.random() { message.len() } else { message.len().min(24) };
            if reach > 0 {
                records[message.start + rng.random_range(0..reach)] ^= 1 << rng.random_range(0..8);
            }
        }
        let data = zstd::bulk::compress(&records, 1)?;
        header.uncompressed_crc = crc32fast::hash(&records);
        let mut record = vec![0x06];
        record.extend((body.len() - usize::try_from(header.compressed_size)? + data.len()).to_le_bytes());
        record.extend(header.message_start_time.to_le_bytes());
        record.extend(header.message_end_time.to_le_bytes());
        record.extend(header.uncompressed_size.to_le_bytes());
        record.extend(header.uncompressed_crc.to_le_bytes());
        record.extend((header.compression.len() as u32).to_le_bytes());
        record.extend(header.compression.bytes());
        record.extend((data.len() as u64).to_le_bytes());
        record.extend(data);
        self.replace(range.start, range.len(), vec![FilePiece::Altered(record)]);
        Ok(())
    }
}

impl FilePiece {
    fn len(&self) -> usize {
        match self {
            Self::Intact(range) => range.len(),
            Self::Altered(bytes) => bytes.len(),
        }
    }

    fn halves(&self, at: usize) -> (Self, Self) {
        match self {
            Self::Intact(r) => (Self::Intact(r.start..r.start + at), Self::Intact(r.start + at..r.end)),
            Self::Altered(bytes) => (Self::Altered(bytes[..at].to_vec()), Self::Altered(bytes[at..].to_vec())),
        }
    }
}

/// Ranges of the messages' own bytes in a chunk's records.
fn messages(records: &[u8]) -> Result<Vec<Range<usize>>> {
    let (mut at, mut found) = (0, Vec::new());
    while at + FRAME <= records.len() {
        let length = usize::try_from(u64::from_le_bytes(records[at + 1..at + FRAME].try_into()?))?;
        if records[at] == 0x05 {
            found.push(at + FRAME + MESSAGE_HEAD..at + FRAME + length);
        }
        at += FRAME + length;
    }
    Ok(found)
}
