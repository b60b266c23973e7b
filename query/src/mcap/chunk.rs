//! The records of a piece of a file: one chunk, decompressed and its CRC checked, or records that stand in none.

use bytes::Bytes;
use mcap::McapError;
use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};

/// Opcode and length in front of every record.
pub(super) const FRAME: usize = 9;
/// Largest chunk and largest record that are read, in bytes, compressed or not. A writer's usual chunk has one MiB.
pub(super) const LARGEST: u64 = 256 << 20;
/// What is given to the reader at a time.
const STEP: usize = 256 << 10;

/// Reads the records of a piece, which may be left off and gone on with.
pub(super) struct Records {
    reader: LinearReader,
    bytes: Bytes,
    given: usize,
    /// Memory that the reader may take, in bytes.
    pub(super) memory: usize,
}

/// What a piece is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Chunk,
    /// Records that stand in no chunk.
    Loose,
}

/// Whether to go on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Step {
    Go,
    Pause,
}

/// How far a piece is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Progress {
    Paused,
    Done,
}

/// Why records are not read further.
pub(super) enum Stop<E> {
    /// The piece is damaged, in words.
    Damage(String),
    /// Whoever takes the records does not want more.
    Sink(E),
}

impl Records {
    /// Records of a piece: a whole chunk record, or several others. The text of an error says what is wrong.
    pub(super) fn new(bytes: Bytes, kind: Kind) -> Result<Self, String> {
        let largest = match kind {
            Kind::Chunk => chunk_memory(&bytes)?,
            Kind::Loose => bytes.len() as u64,
        };
        let memory = usize::try_from(largest).map_err(|e| e.to_string())?;
        // Its CRC is checked before the first record is given out. No length within is beyond the piece's own.
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(true)
            .with_record_length_limit(memory);
        Ok(Self { reader: LinearReader::new_with_options(options), bytes, given: 0, memory })
    }

    /// Gives records to `sink` until it pauses or there are none left.
    pub(super) fn read<E>(
        &mut self,
        sink: &mut impl FnMut(Record<'_>) -> Result<Step, E>,
    ) -> Result<Progress, Stop<E>> {
        loop {
            match self.reader.next_event() {
                Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                    let record = mcap::parse_record(opcode, data).map_err(|e| Stop::Damage(words(&e)))?;
                    if sink(record).map_err(Stop::Sink)? == Step::Pause {
                        return Ok(Progress::Paused);
                    }
                }
                Some(Ok(LinearReadEvent::ReadRequest(count))) => {
                    let left = self.bytes.len() - self.given;
                    if left == 0 {
                        // Between two records a frame is asked for, else it is the rest of something.
                        let whole = count == FRAME;
                        return if whole {
                            Ok(Progress::Done)
                        } else {
                            Err(Stop::Damage("a record ends early".into()))
                        };
                    }
                    let some = count.max(STEP).min(left);
                    self.reader.insert(some).copy_from_slice(&self.bytes[self.given..self.given + some]);
                    self.reader.notify_read(some);
                    self.given += some;
                }
                Some(Err(e)) => return Err(Stop::Damage(words(&e))),
                None => return Ok(Progress::Done),
            }
        }
    }
}

// The chunk's larger size, where its header is sound and both are bearable.
fn chunk_memory(bytes: &[u8]) -> Result<u64, String> {
    let (frame, body) = bytes.split_at_checked(FRAME).ok_or("its chunk ends within its frame")?;
    if frame[0] != op::CHUNK {
        return Err(format!("there is a record of kind {:#04x} where its index says that a chunk is", frame[0]));
    }
    let length = frame[1..].first_chunk().map_or(0, |b| u64::from_le_bytes(*b));
    if length != body.len() as u64 {
        return Err(format!("its chunk has {length} bytes, its index says {}", body.len()));
    }
    let Ok(Record::Chunk { header, .. }) = mcap::parse_record(op::CHUNK, body) else {
        return Err("its chunk's header makes no sense".to_owned());
    };
    if header.uncompressed_size > LARGEST || length > LARGEST {
        return Err(format!("its chunk has {} bytes, more than {LARGEST}", header.uncompressed_size.max(length)));
    }
    Ok(header.uncompressed_size.max(length))
}

/// An error of the MCAP reader with its cause.
pub(super) fn words(error: &McapError) -> String {
    match std::error::Error::source(error) {
        Some(cause) => format!("{error}: {cause}"),
        None => error.to_string(),
    }
}
