//! A piece of a file: one chunk, or records in none, which are read one by one.

use std::ops::Range;

use bytes::Bytes;
use echolake_recording::{DecodedChunk, Record, RecordCursor, chunk_body};

/// The kind of a piece.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PieceKind {
    /// A chunk.
    Chunk,
    /// Records outside of chunks.
    Loose,
}

/// A chunk, or a run of messages in none.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Piece {
    pub kind: PieceKind,
    pub range: Range<u64>,
    /// Times of its earliest and latest message, ns.
    pub times: (u64, u64),
    /// Channels of its messages; None where the index does not say.
    pub channels: Option<Box<[u16]>>,
    /// Bytes of message indexes behind it.
    pub index: u64,
    /// Bytes of its records before compression, where its index tells.
    pub plain: u64,
}

impl Piece {
    /// Returns true if it may have messages of a channel.
    pub fn has_channel(&self, channel: u16) -> bool {
        self.channels.as_ref().is_none_or(|channels| channels.contains(&channel))
    }
}

/// Reads the records of a piece.
pub(super) struct PieceRecords {
    /// The body of a chunk that is not decoded yet.
    chunk: Option<Bytes>,
    /// Memory that the chunk is decoded into.
    room: Vec<u8>,
    records: RecordCursor,
    /// Memory that reading may take, in bytes.
    pub memory: usize,
}

impl PieceRecords {
    /// Reads a whole chunk record, or several other records. The text of an error is the damage.
    pub fn new(bytes: Bytes, kind: PieceKind) -> Result<Self, String> {
        match kind {
            PieceKind::Chunk => Self::from_chunk(chunk_body(&bytes)?),
            PieceKind::Loose => {
                Ok(Self { chunk: None, room: Vec::new(), memory: bytes.len(), records: RecordCursor::new(bytes) })
            }
        }
    }

    /// Reads the records of a chunk, given its body.
    pub fn from_chunk(body: Bytes) -> Result<Self, String> {
        let memory = DecodedChunk::memory_of(&body).map_err(|e| format!("its chunk is damaged: {e}"))?;
        let memory = usize::try_from(memory).map_err(|e| e.to_string())?;
        Ok(Self { chunk: Some(body), room: Vec::new(), records: RecordCursor::new(Bytes::new()), memory })
    }

    /// Decodes the chunk into the memory of an earlier one, [`Self::into_memory`].
    pub fn with_memory(mut self, room: Vec<u8>) -> Self {
        self.room = room;
        self
    }

    /// Returns the next record; None behind the last one. The text of an error is the damage.
    pub fn next_record(&mut self) -> Result<Option<Record<'_>>, String> {
        self.next_unskipped(|_| false)
    }

    /// As [`Self::next_record`], past messages of channels that are `is_skipped`.
    pub fn next_unskipped(&mut self, is_skipped: impl Fn(u16) -> bool) -> Result<Option<Record<'_>>, String> {
        if let Some(body) = self.chunk.take() {
            let room = std::mem::take(&mut self.room);
            let decoded = DecodedChunk::decode_into(&body, room).map_err(|e| format!("its chunk is damaged: {e}"))?;
            self.records = decoded.into_cursor();
        }
        self.records.next_unskipped(is_skipped).map_err(|e| e.to_string())
    }

    /// Returns the memory of the records for another piece.
    pub fn into_memory(self) -> Vec<u8> {
        self.records.into_memory()
    }
}
