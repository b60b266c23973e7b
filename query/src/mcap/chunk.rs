//! The records of a piece of a file: one chunk, decompressed and its CRC checked, or records that stand in none.

use std::borrow::Cow;
use std::cell::RefCell;

use bytes::Bytes;
use mcap::McapError;
use mcap::records::{ChunkHeader, MessageHeader, Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use zstd::bulk::Decompressor;

/// Opcode and length in front of every record.
pub(super) const FRAME: usize = 9;
/// Largest chunk and largest record that are read, in bytes, compressed or not. A writer's usual chunk has one MiB.
pub(super) const LARGEST: u64 = 256 << 20;
/// What is given to the reader at a time.
const STEP: usize = 256 << 10;
/// A chunk that claims to have shrunk more than this is decompressed piece by piece: nothing large is allocated for a
/// size that its bytes do not bear out.
const USUAL_RATIO: u64 = 64;
/// Channel, sequence and two times, in front of a message's data.
const MESSAGE_HEADER: usize = 22;

/// Reads the records of a piece, which may be left off and gone on with.
pub(super) struct Records {
    source: Source,
    /// Memory that reading may take, in bytes.
    pub(super) memory: usize,
}

/// Where records come from.
enum Source {
    /// A chunk that is unpacked at once, when its first record is asked for.
    Packed(Bytes),
    /// A chunk as it was before it was compressed, and how far it is read.
    Whole(Bytes, usize),
    /// Anything else, by the mcap crate's reader.
    Stream(Box<LinearReader>, Bytes, usize),
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
            Kind::Chunk => {
                let (header, data) = chunk(&bytes)?;
                let largest = header.uncompressed_size.max(bytes.len() as u64);
                let memory = usize::try_from(largest).map_err(|e| e.to_string())?;
                if is_unpacked_at_once(&header, data) {
                    return Ok(Self { source: Source::Packed(bytes), memory });
                }
                largest
            }
            Kind::Loose => bytes.len() as u64,
        };
        let memory = usize::try_from(largest).map_err(|e| e.to_string())?;
        // Its CRC is checked before the first record is given out. No length within is beyond the piece's own.
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(true)
            .with_record_length_limit(memory);
        let reader = Box::new(LinearReader::new_with_options(options));
        Ok(Self { source: Source::Stream(reader, bytes, 0), memory })
    }

    /// Gives records to `sink` until it pauses or there are none left.
    pub(super) fn read<E>(
        &mut self,
        sink: &mut impl FnMut(Record<'_>) -> Result<Step, E>,
    ) -> Result<Progress, Stop<E>> {
        if let Source::Packed(bytes) = &self.source {
            self.source = Source::Whole(unpacked(bytes).map_err(Stop::Damage)?, 0);
        }
        match &mut self.source {
            // It became a whole one.
            Source::Packed(_) => Ok(Progress::Done),
            Source::Whole(records, at) => read_whole(records, at, sink),
            Source::Stream(reader, bytes, given) => read_stream(reader, bytes, given, sink),
        }
    }
}

fn read_whole<E>(
    records: &[u8],
    at: &mut usize,
    sink: &mut impl FnMut(Record<'_>) -> Result<Step, E>,
) -> Result<Progress, Stop<E>> {
    let early = || Stop::Damage("a record ends early".to_owned());
    while *at < records.len() {
        let (frame, behind) = records[*at..].split_at_checked(FRAME).ok_or_else(early)?;
        let length = frame[1..].first_chunk().map_or(0, |b| u64::from_le_bytes(*b));
        let length = usize::try_from(length).ok().filter(|n| *n <= behind.len()).ok_or_else(early)?;
        let record = record(frame[0], &behind[..length]).map_err(|e| Stop::Damage(words(&e)))?;
        *at += FRAME + length;
        if sink(record).map_err(Stop::Sink)? == Step::Pause {
            return Ok(Progress::Paused);
        }
    }
    Ok(Progress::Done)
}

// Most records are messages, which are read without the crate's general parser.
fn record(opcode: u8, body: &[u8]) -> Result<Record<'_>, McapError> {
    match body.split_first_chunk::<MESSAGE_HEADER>() {
        Some((h, data)) if opcode == op::MESSAGE => Ok(Record::Message {
            header: MessageHeader {
                channel_id: u16::from_le_bytes([h[0], h[1]]),
                sequence: u32::from_le_bytes([h[2], h[3], h[4], h[5]]),
                log_time: u64::from_le_bytes([h[6], h[7], h[8], h[9], h[10], h[11], h[12], h[13]]),
                publish_time: u64::from_le_bytes([h[14], h[15], h[16], h[17], h[18], h[19], h[20], h[21]]),
            },
            data: Cow::Borrowed(data),
        }),
        _ => mcap::parse_record(opcode, body),
    }
}

fn read_stream<E>(
    reader: &mut LinearReader,
    bytes: &[u8],
    given: &mut usize,
    sink: &mut impl FnMut(Record<'_>) -> Result<Step, E>,
) -> Result<Progress, Stop<E>> {
    loop {
        match reader.next_event() {
            Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                let record = mcap::parse_record(opcode, data).map_err(|e| Stop::Damage(words(&e)))?;
                if sink(record).map_err(Stop::Sink)? == Step::Pause {
                    return Ok(Progress::Paused);
                }
            }
            Some(Ok(LinearReadEvent::ReadRequest(count))) => {
                let left = bytes.len() - *given;
                if left == 0 {
                    // Between two records a frame is asked for, else it is the rest of something.
                    let whole = count == FRAME;
                    return if whole { Ok(Progress::Done) } else { Err(Stop::Damage("a record ends early".into())) };
                }
                let some = count.max(STEP).min(left);
                reader.insert(some).copy_from_slice(&bytes[*given..*given + some]);
                reader.notify_read(some);
                *given += some;
            }
            Some(Err(e)) => return Err(Stop::Damage(words(&e))),
            None => return Ok(Progress::Done),
        }
    }
}

thread_local! {
    /// Its tables are large beside a chunk, so each thread makes them once.
    static DECOMPRESSOR: RefCell<Option<Decompressor<'static>>> = const { RefCell::new(None) };
}

fn is_unpacked_at_once(header: &ChunkHeader, data: &[u8]) -> bool {
    match header.compression.as_str() {
        "" => true,
        "zstd" => header.uncompressed_size / USUAL_RATIO <= data.len() as u64,
        _ => false,
    }
}

// A chunk before it was compressed, its CRC checked.
fn unpacked(bytes: &Bytes) -> Result<Bytes, String> {
    let (header, data) = chunk(bytes)?;
    let size = header.uncompressed_size;
    let whole = match header.compression.as_str() {
        "" => bytes.slice_ref(data),
        _ => {
            let unpacked = DECOMPRESSOR.with_borrow_mut(|kept| {
                let decompressor = match kept.take() {
                    Some(decompressor) => decompressor,
                    None => Decompressor::new()?,
                };
                kept.insert(decompressor).decompress(data, size as usize)
            });
            unpacked.map_err(|e| format!("its chunk does not decompress: {e}"))?.into()
        }
    };
    if whole.len() as u64 != size {
        return Err(format!("its chunk has {} bytes, expected {size}", whole.len()));
    }
    let (crc, expected) = (crc32fast::hash(&whole), header.uncompressed_crc);
    if expected != 0 && crc != expected {
        return Err(format!("its chunk's CRC is {crc:08x}, expected {expected:08x}"));
    }
    Ok(whole)
}

// A chunk's header and data, where they are sound and their sizes are bearable.
fn chunk(bytes: &Bytes) -> Result<(ChunkHeader, &[u8]), String> {
    let (frame, body) = bytes.split_at_checked(FRAME).ok_or("its chunk ends within its frame")?;
    if frame[0] != op::CHUNK {
        return Err(format!("there is a record of kind {:#04x} where its index says that a chunk is", frame[0]));
    }
    let length = frame[1..].first_chunk().map_or(0, |b| u64::from_le_bytes(*b));
    if length != body.len() as u64 {
        return Err(format!("its chunk has {length} bytes, its index says {}", body.len()));
    }
    let Ok(Record::Chunk { header, data: Cow::Borrowed(data) }) = mcap::parse_record(op::CHUNK, body) else {
        return Err("its chunk's header makes no sense".to_owned());
    };
    if header.uncompressed_size > LARGEST || length > LARGEST {
        return Err(format!("its chunk has {} bytes, more than {LARGEST}", header.uncompressed_size.max(length)));
    }
    Ok((header, data))
}

/// An error of the MCAP reader with its cause.
pub(super) fn words(error: &McapError) -> String {
    match std::error::Error::source(error) {
        Some(cause) => format!("{error}: {cause}"),
        None => error.to_string(),
    }
}
