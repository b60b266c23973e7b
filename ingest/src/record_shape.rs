//! Whether what stands in a run's file can be an MCAP record: the lengths inside of it must add up to its own.
//!
//! A damaged length would make the walk swallow the records behind it; lengths that contradict each other betray it.

/// Opcode and length in front of every record.
pub(crate) const FRAME: usize = 9;
/// The lengths inside of a record all stand in its first bytes; names that are longer do not occur.
pub(crate) const PREFIX: usize = 64 << 10;

/// Largest chunk that is read, as it is stored and decompressed together. Queries over run files read no larger ones.
pub(crate) const LARGEST_CHUNK: u64 = 256 << 20;

/// Bytes of the largest record of a kind that is read as a whole. What a file claims is taken into memory only up to this:
/// a sparse file of any size costs its maker nothing.
pub(crate) fn largest(code: u8) -> Option<u64> {
    match code {
        opcode::CHUNK | opcode::ATTACHMENT => Some(LARGEST_CHUNK),
        opcode::METADATA | opcode::SCHEMA | opcode::CHANNEL => Some(4 << 20),
        _ => None,
    }
}

/// Opcodes of the MCAP specification that the walk looks at.
pub(crate) mod opcode {
    pub(crate) const FOOTER: u8 = 0x02;
    pub(crate) const SCHEMA: u8 = 0x03;
    pub(crate) const CHANNEL: u8 = 0x04;
    pub(crate) const MESSAGE: u8 = 0x05;
    pub(crate) const CHUNK: u8 = 0x06;
    pub(crate) const ATTACHMENT: u8 = 0x09;
    pub(crate) const METADATA: u8 = 0x0C;
    pub(crate) const DATA_END: u8 = 0x0F;
    /// From here on they are private.
    pub(crate) const PRIVATE: u8 = 0x80;
}

/// What a record begins with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Frame {
    pub(crate) code: u8,
    /// Bytes behind the frame.
    pub(crate) length: u64,
}

/// How much a record's own bytes say for it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Shape {
    /// Its lengths add up.
    Sound,
    /// It has no lengths that could contradict each other.
    Unknown,
    /// They contradict each other, or there is no such record.
    Broken,
}

/// A part of a record.
enum Part {
    /// This many bytes.
    Fixed(u64),
    /// A 32-bit length and as many bytes.
    Short,
    /// A 64-bit length and as many bytes.
    Long,
}

impl Frame {
    /// The frame at the start of `bytes`, which are at least [`FRAME`].
    pub(crate) fn read(bytes: &[u8]) -> Self {
        let mut length = [0; 8];
        length.copy_from_slice(&bytes[1..FRAME]);
        Self { code: bytes[0], length: u64::from_le_bytes(length) }
    }

    /// Whether the specification has such records, or leaves them to others, with `left` bytes of the file behind the frame.
    pub(crate) fn is_possible(self, left: u64) -> bool {
        let is_known = !parts(self.code).is_empty() || matches!(self.code, opcode::MESSAGE | opcode::PRIVATE..);
        self.length <= left && is_known
    }

    /// What the first bytes behind the frame, at most [`PREFIX`], say of the record.
    pub(crate) fn shape(self, prefix: &[u8]) -> Shape {
        if self.code == opcode::MESSAGE || self.code >= opcode::PRIVATE {
            return Shape::Unknown;
        }
        let parts = parts(self.code);
        if parts.is_empty() {
            return Shape::Broken;
        }
        let mut at: u64 = 0;
        for part in parts {
            let length = match part {
                Part::Fixed(bytes) => Some(*bytes),
                Part::Short => number(prefix, at, 4).map(|n| n + 4),
                Part::Long => number(prefix, at, 8).and_then(|n| n.checked_add(8)),
            };
            match length.and_then(|l| at.checked_add(l)).filter(|end| *end <= self.length) {
                Some(end) => at = end,
                None => return Shape::Broken,
            }
        }
        if at == self.length { Shape::Sound } else { Shape::Broken }
    }
}

/// A record's parts in their order, from the specification; none where its length says nothing of it.
fn parts(code: u8) -> &'static [Part] {
    use Part::{Fixed, Long, Short};
    match code {
        // Header: profile, library.
        0x01 => &[Short, Short],
        // Summary's offsets, CRC.
        opcode::FOOTER => &[Fixed(20)],
        // Id; name, encoding, data.
        opcode::SCHEMA => &[Fixed(2), Short, Short, Short],
        // Id, schema; topic, encoding, metadata.
        opcode::CHANNEL => &[Fixed(4), Short, Short, Short],
        // Times, uncompressed size and CRC; compression, records.
        opcode::CHUNK => &[Fixed(28), Short, Long],
        // Message index: channel; entries.
        0x07 => &[Fixed(2), Short],
        // Chunk index: times, place; index offsets; index length; compression; sizes.
        0x08 => &[Fixed(32), Short, Fixed(8), Short, Fixed(16)],
        // Times; name, media type, data; CRC.
        opcode::ATTACHMENT => &[Fixed(16), Short, Short, Long, Fixed(4)],
        // Attachment index: place, times, size; name, media type.
        0x0A => &[Fixed(40), Short, Short],
        // Statistics: counts, times; counts of channels.
        0x0B => &[Fixed(42), Short],
        // Name, pairs.
        opcode::METADATA => &[Short, Short],
        // Metadata index: place; name.
        0x0D => &[Fixed(16), Short],
        // Summary offset: opcode, place.
        0x0E => &[Fixed(17)],
        // CRC.
        opcode::DATA_END => &[Fixed(4)],
        _ => &[],
    }
}

fn number(bytes: &[u8], at: u64, width: usize) -> Option<u64> {
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
            let frame = Frame::read(rest);
            let body = &rest[FRAME..FRAME + frame.length as usize];
            assert_eq!(frame.shape(body), Shape::Sound, "{frame:?}");
            for length in [frame.length - 1, frame.length + 1, frame.length ^ 0x100, u64::MAX] {
                let other = Frame { length, ..frame };
                assert_eq!(other.shape(&rest[FRAME..]), Shape::Broken, "{other:?}");
            }
            seen.insert(frame.code);
            rest = &rest[FRAME + frame.length as usize..];
        }
        let all = [1, 2, 3, 4, 6, 7, 8, 9, 0x0A, 0x0B, 0x0C, 0x0D, 0x0E, 0x0F];
        assert_eq!(seen.into_iter().collect::<Vec<_>>(), all, "all records but messages, which stand in the chunk");
    }

    #[test]
    fn records_that_do_not_exist_are_broken_and_private_ones_unknown() {
        let shape = |code| Frame { code, length: 0 }.shape(&[]);
        assert_eq!([shape(0), shape(0x10), shape(0x7F)], [Shape::Broken; 3]);
        assert_eq!([shape(opcode::MESSAGE), shape(0x80)], [Shape::Unknown; 2]);
    }
}
