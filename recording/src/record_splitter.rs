//! Splits a file that arrives in blocks into records, for readers that go through it from its first byte.

use bytes::{Bytes, BytesMut};

use crate::limits::LARGEST_CHUNK;
use crate::record_frame::{FRAME_BYTES, RecordFrame};

/// Bytes of the largest record that is split off; one larger is damage.
const LARGEST: u64 = LARGEST_CHUNK + (1 << 20);

/// A record as it is in the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SplitRecord {
    /// Byte of the file at which it begins.
    pub offset: u64,
    /// Its opcode.
    pub code: u8,
    /// The record behind its frame.
    pub body: Bytes,
}

impl SplitRecord {
    /// Returns the byte of the file behind it.
    pub fn end_offset(&self) -> u64 {
        self.offset + (FRAME_BYTES + self.body.len()) as u64
    }
}

/// Blocks of a file, and how far they are split.
#[derive(Debug)]
pub struct RecordSplitter {
    buffer: BytesMut,
    offset: u64,
}

impl RecordSplitter {
    /// Splits a file from this byte on.
    pub fn new(offset: u64) -> Self {
        Self { buffer: BytesMut::new(), offset }
    }

    /// Returns the byte of the file at which the next record begins.
    pub fn offset(&self) -> u64 {
        self.offset
    }

    /// Returns the byte of the file at which the next record ends, if its frame is there.
    pub fn claimed_end(&self) -> Option<u64> {
        let frame = self.buffer.get(..FRAME_BYTES).map(RecordFrame::from_bytes)?;
        Some(self.offset.saturating_add(frame.length).saturating_add(FRAME_BYTES as u64))
    }

    /// Takes the file's next bytes.
    pub fn push_bytes(&mut self, block: &[u8]) {
        self.buffer.extend_from_slice(block);
    }

    /// Returns the next record, or None and how many more bytes it needs at least.
    ///
    /// # Errors
    /// A record that is larger than any that is read.
    pub fn next_record(&mut self) -> Result<Result<SplitRecord, u64>, String> {
        let there = self.buffer.len() as u64;
        if there < FRAME_BYTES as u64 {
            return Ok(Err(FRAME_BYTES as u64 - there));
        }
        let RecordFrame { code, length } = RecordFrame::from_bytes(&self.buffer);
        if length > LARGEST {
            return Err(format!("a record of kind {code:#04x} has {length} bytes, more than {LARGEST}"));
        }
        let bytes = FRAME_BYTES as u64 + length;
        if there < bytes {
            return Ok(Err(bytes - there));
        }
        let body = self.buffer.split_to(bytes as usize).freeze().slice(FRAME_BYTES..);
        let record = SplitRecord { offset: self.offset, code, body };
        self.offset += bytes;
        Ok(Ok(record))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_are_the_same_however_the_file_is_cut() {
        let record = |code: u8, body: &[u8]| [&[code][..], &(body.len() as u64).to_le_bytes(), body].concat();
        let file = [record(3, b"schema"), record(5, b""), record(6, &[7; 300])].concat();
        for block in [1, 8, 9, 10, 100, file.len()] {
            let mut splitter = RecordSplitter::new(8);
            let mut found = Vec::new();
            for part in file.chunks(block) {
                splitter.push_bytes(part);
                while let Ok(record) = splitter.next_record().expect("sound") {
                    found.push((record.offset, record.code, record.body.len(), record.end_offset()));
                }
            }
            assert_eq!(found, [(8, 3, 6, 23), (23, 5, 0, 32), (32, 6, 300, 341)], "blocks of {block}");
        }
    }

    #[test]
    fn a_record_that_is_too_large_is_refused_by_its_frame() {
        let mut splitter = RecordSplitter::new(0);
        splitter.push_bytes(&[6, 0, 0, 0, 0, 1]);
        assert_eq!(splitter.next_record(), Ok(Err(3)));
        splitter.push_bytes(&[0, 0, 0]);
        assert!(splitter.next_record().is_err());
    }
}
