//! The records of a piece of a file: one chunk, or records in none, read a few at a time.

use bytes::Bytes;
use echolake_recording::{DecodedChunk, Record, RecordCursor, chunk_body};

/// Reads the records of a piece; reading may pause and continue later.
pub(super) struct PieceRecords {
    source: PieceSource,
    /// Memory that reading may take, in bytes.
    pub(super) memory: usize,
}

/// The state of a piece.
enum PieceSource {
    /// The body of a chunk, which is decoded when its first record is asked for.
    Encoded(Bytes),
    /// Its records.
    Decoded(RecordCursor),
}

/// The kind of a piece.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PieceKind {
    /// A chunk.
    Chunk,
    /// Records outside of chunks.
    Loose,
}

/// The reader's wish behind a record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ReadStep {
    Continue,
    Pause,
}

/// Progress in a piece.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ReadProgress {
    Paused,
    Done,
}

/// The reason why records are not read further.
pub(super) enum ReadStop<E> {
    /// The piece is damaged, in words.
    Damage(String),
    /// The reader wants no more.
    Sink(E),
}

impl PieceRecords {
    /// Reads a whole chunk record, or several other records. The text of an error says what is wrong.
    pub(super) fn new(bytes: Bytes, kind: PieceKind) -> Result<Self, String> {
        match kind {
            PieceKind::Chunk => Self::from_chunk(chunk_body(&bytes)?),
            PieceKind::Loose => {
                let memory = bytes.len();
                Ok(Self { source: PieceSource::Decoded(RecordCursor::new(bytes)), memory })
            }
        }
    }

    /// Reads the records of a chunk, given its body.
    pub(super) fn from_chunk(body: Bytes) -> Result<Self, String> {
        let memory = DecodedChunk::memory_of(&body).map_err(|e| format!("its chunk is damaged: {e}"))?;
        let memory = usize::try_from(memory).map_err(|e| e.to_string())?;
        Ok(Self { source: PieceSource::Encoded(body), memory })
    }

    /// Gives records to `sink` until it pauses or there are none left.
    pub(super) fn read<E>(
        &mut self,
        sink: &mut impl FnMut(Record<'_>) -> Result<ReadStep, E>,
    ) -> Result<ReadProgress, ReadStop<E>> {
        if let PieceSource::Encoded(body) = &self.source {
            let decoded = DecodedChunk::decode(body);
            let decoded = decoded.map_err(|e| ReadStop::Damage(format!("its chunk is damaged: {e}")))?;
            self.source = PieceSource::Decoded(decoded.into_cursor());
        }
        let PieceSource::Decoded(records) = &mut self.source else { return Ok(ReadProgress::Done) };
        while let Some(record) = records.next_record().map_err(|e| ReadStop::Damage(e.to_string()))? {
            if sink(record).map_err(ReadStop::Sink)? == ReadStep::Pause {
                return Ok(ReadProgress::Paused);
            }
        }
        Ok(ReadProgress::Done)
    }
}
