//! The opcode and the length in front of each record, and a check of a record by its first bytes.
//!
//! The lengths inside of a record must add up to its own. A damaged length would make a reader swallow the records
//! behind it; lengths that contradict each other tell.

use mcap::records::op;

use crate::limits::{LARGEST_ATTACHMENT, LARGEST_CHUNK, LARGEST_DEFINITION};

/// Bytes of the opcode and the length in front of each record.
pub const FRAME_BYTES: usize = 9;

/// The first bytes of a record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecordFrame {
    /// The opcode.
    pub code: u8,
    /// Bytes behind the frame.
    pub length: u64,
}

impl RecordFrame {
    /// Returns the frame at the start of `bytes`, which are at least [`FRAME_BYTES`].
    pub fn from_bytes(bytes: &[u8]) -> Self {
        let mut length = [0; 8];
        length.copy_from_slice(&bytes[1..FRAME_BYTES]);
        Self { code: bytes[0], length: u64::from_le_bytes(length) }
    }
}

/// The lengths inside of a record all stand in its first bytes; names that are longer do not occur.
pub(crate) const PREFIX_BYTES: usize = 64 << 10;

/// Bytes of the largest record of a kind that is read as a whole. A claim in a file takes memory up to this only: a
/// sparse file of any size costs its maker nothing.
pub(crate) fn largest_record(code: u8) -> Option<u64> {
    match code {
        op::CHUNK => Some(LARGEST_CHUNK),
        op::ATTACHMENT => Some(LARGEST_ATTACHMENT),
        op::METADATA | op::SCHEMA | op::CHANNEL => Some(LARGEST_DEFINITION),
        _ => None,
    }
}

/// Opcodes from here on are private.
const PRIVATE: u8 = 0x80;

/// Evidence of a record's own bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RecordShape {
    /// Its lengths add up.
    Sound,
    /// It has no lengths that could contradict each other.
    Unknown,
    /// They contradict each other, or there is no such record.
    Broken,
}

/// A part of a record.
enum RecordPart {
    /// This many bytes.
    Fixed(u64),
    /// A 32-bit length and as many bytes.
    Short,
    /// A 64-bit length and as many bytes.
    Long,
}

impl RecordFrame {
    /// Returns whether the specification has such records, or leaves them to others, with `left` bytes of the file
    /// behind the frame.
    pub(crate) fn is_possible(self, left: u64) -> bool {
        let is_known = !record_parts(self.code).is_empty() || matches!(self.code, op::MESSAGE | PRIVATE..);
        self.length <= left && is_known
    }

    /// Judges the record by the first bytes behind the frame, at most [`PREFIX_BYTES`].
    pub(crate) fn judge_shape(self, prefix: &[u8]) -> RecordShape {
        if self.code == op::MESSAGE || self.code >= PRIVATE {
            return RecordShape::Unknown;
        }
        let parts = record_parts(self.code);
        if parts.is_empty() {
            return RecordShape::Broken;
        }
        let mut at: u64 = 0;
        for part in parts {
            let length = match part {
                RecordPart::Fixed(bytes) => Some(*bytes),
                RecordPart::Short => number_at(prefix, at, 4).map(|n| n + 4),
                RecordPart::Long => number_at(prefix, at, 8).and_then(|n| n.checked_add(8)),
            };
            match length.and_then(|l| at.checked_add(l)).filter(|end| *end <= self.length) {
                Some(end) => at = end,
                None => return RecordShape::Broken,
            }
        }
        if at == self.length { RecordShape::Sound } else { RecordShape::Broken }
    }
}

/// A record's parts in their order, from the specification; none where its length says nothing of it.
fn record_parts(code: u8) -> &'static [RecordPart] {
    use RecordPart::{Fixed, Long, Short};
    match code {
        // Header: profile, library.
        0x01 => &[Short, Short],
        // Summary's offsets, CRC.
        op::FOOTER => &[Fixed(20)],
        // Id; name, encoding, data.
        op::SCHEMA => &[Fixed(2), Short, Short, Short],
        // Id, schema; topic, encoding, metadata.
        op::CHANNEL => &[Fixed(4), Short, Short, Short],
        // Times, uncompressed size and CRC; compression, records.
        op::CHUNK => &[Fixed(28), Short, Long],
        // Message index: channel; entries.
        0x07 => &[Fixed(2), Short],
        // Chunk index: times, place; index offsets; index length; compression; sizes.
        0x08 => &[Fixed(32), Short, Fixed(8), Short, Fixed(16)],
        // Times; name, media type, data; CRC.
        op::ATTACHMENT => &[Fixed(16), Short, Short, Long, Fixed(4)],
        // Attachment index: place, times, size; name, media type.
        0x0A => &[Fixed(40), Short, Short],
        // Statistics: counts, times; counts of channels.
        0x0B => &[Fixed(42), Short],
        // Name, pairs.
        op::METADATA => &[Short, Short],
        // Metadata index: place; name.
        0x0D => &[Fixed(16), Short],
        // Summary offset: opcode, place.
        0x0E => &[Fixed(17)],
        // CRC.
        op::DATA_END => &[Fixed(4)],
        _ => &[],
    }
}

fn number_at(bytes: &[u8], at: u64, width: usize) -> Option<u64> {
    let at = usize::try_from(at).ok()?;
    let mut number = [0; 8];
    number[..width].copy_from_slice(bytes.get(at..at.checked_add(width)?)?);
    Some(u64::from_le_bytes(number))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_record_of_a_written_file_is_sound_and_none_of_another_length_is() {
        let mut file = std::io::Cursor::new(Vec::new());
        let mut writer = mcap::Writer::new(&mut file).expect("a writer");
        let schema = writer.add_schema("a.B", "protobuf", b"x").expect("added");
        let channel = writer.add_channel(schema, "/a", "protobuf", &Default::default()).expect("added");
        let header = mcap::records::MessageHeader { channel_id: channel, sequence: 1, log_time: 2, publish_time: 2 };
        writer.write_to_known_channel(&header, b"data").expect("written");
        writer.flush().expect("a chunk");
        let metadata = [("key".to_owned(), "value".to_owned())].into();
        writer.write_metadata(&mcap::records::Metadata { name: "m".into(), metadata }).expect("written");
        let (name, media_type) = ("a".to_owned(), "text/plain".to_owned());
        let attachment = mcap::Attachment { log_time: 1, create_time: 1, name, media_type, data: b"hello".into() };
        writer.attach(&attachment).expect("written");
        writer.finish().expect("finished");
        drop(writer);
        let file = file.into_inner();
        let mut rest = &file[8..file.len() - 8];
        let mut seen = std::collections::BTreeSet::new();
        while !rest.is_empty() {
            let frame = RecordFrame::from_bytes(rest);
            let body = &rest[FRAME_BYTES..FRAME_BYTES + frame.length as usize];
            assert_eq!(frame.judge_shape(body), RecordShape::Sound, "{frame:?}");
            for length in [frame.length - 1, frame.length + 1, frame.length ^ 0x100, u64::MAX] {
                let other = RecordFrame { length, ..frame };
                assert_eq!(other.judge_shape(&rest[FRAME_BYTES..]), RecordShape::Broken, "{other:?}");
            }
            seen.insert(frame.code);
            rest = &rest[FRAME_BYTES + frame.length as usize..];
        }
        let all = [1, 2, 3, 4, 6, 7, 8, 9, 0x0A, 0x0B, 0x0C, 0x0D, 0x0E, 0x0F];
        assert_eq!(seen.into_iter().collect::<Vec<_>>(), all, "all records but messages, which stand in the chunk");
    }

    #[test]
    fn records_that_do_not_exist_are_broken_and_private_ones_unknown() {
        let shape = |code| RecordFrame { code, length: 0 }.judge_shape(&[]);
        assert_eq!([shape(0), shape(0x10), shape(0x7F)], [RecordShape::Broken; 3]);
        assert_eq!([shape(op::MESSAGE), shape(0x80)], [RecordShape::Unknown; 2]);
    }
}
