//! One chunk of a run file: its size checked against the limits, decompressed, its CRC checked, cut into records.

use std::borrow::Cow;
use std::cell::RefCell;
use std::io::{self, Read as _};

use bytes::Bytes;
use echolake_schema::{ErrorCause, escape_controls};
use mcap::McapError;
use mcap::records::{ChunkHeader, MessageHeader, Record, op};
use zstd::bulk::Decompressor;

use crate::limits::{LARGE_RECORD, LARGEST_CHUNK};
use crate::record_frame::{FRAME_BYTES, RecordFrame};

/// Channel, sequence and two times in front of a message's data.
const MESSAGE_HEADER_BYTES: usize = 22;

/// Why a chunk cannot be decoded.
#[derive(Debug, thiserror::Error)]
pub enum ChunkError {
    /// Its first bytes make no sense.
    #[error("its header is damaged")]
    Header,
    /// It exceeds [`LARGEST_CHUNK`].
    #[error("it claims {claimed} bytes, with those that are stored more than {LARGEST_CHUNK}")]
    TooLarge {
        /// Bytes before compression, as the header says.
        claimed: u64,
    },
    /// No compression that is known.
    #[error("it is compressed with `{name}`, expected zstd or lz4")]
    Compression {
        /// The name in its header.
        name: String,
    },
    /// The decompressor refuses its bytes.
    #[error("it does not decompress: {0}")]
    Decompress(#[source] io::Error),
    /// Its size is not the one in its header.
    #[error("it has {actual} bytes, expected {expected}")]
    Length {
        /// Bytes that it decompresses to.
        actual: usize,
        /// Bytes that its header says.
        expected: u64,
    },
    /// Its content is not what was written.
    #[error("its CRC is {actual:08x}, expected {expected:08x}")]
    Crc {
        /// The CRC of its records.
        actual: u32,
        /// The one in its header.
        expected: u32,
    },
}

/// Distinguishes a chunk from all others of its run: CRC and size, and channel, number and time of its first message.
pub type ChunkIdentity = (u32, usize, Option<[u8; 14]>);

/// The records of a chunk.
#[derive(Debug)]
pub struct DecodedChunk {
    records: Bytes,
    crc: u32,
}

/// A message in a chunk.
#[derive(Debug, Clone, Copy)]
pub struct ChunkMessage<'a> {
    /// Its channel in the file.
    pub channel: u16,
    /// Time at which it was recorded, ns since 1970.
    pub log_time_ns: i64,
    /// Its encoded content.
    pub data: &'a [u8],
}

impl DecodedChunk {
    /// Decodes the body of a chunk record.
    ///
    /// # Errors
    /// [`ChunkError`]; nothing is allocated for a chunk that is too large.
    pub fn decode(body: &Bytes) -> Result<Self, ChunkError> {
        Self::decode_into(body, Vec::new())
    }

    /// Decodes into the memory of an earlier chunk ([`Self::into_memory`]), which the system need not clear.
    ///
    /// # Errors
    /// As [`Self::decode`].
    pub fn decode_into(body: &Bytes, memory: Vec<u8>) -> Result<Self, ChunkError> {
        let (header, data) = chunk_parts(body)?;
        let size = header.uncompressed_size as usize;
        let records = match header.compression.as_str() {
            "" => body.slice_ref(data),
            "zstd" => decompress_zstd(data, size, memory).map_err(ChunkError::Decompress)?,
            "lz4" => decompress_lz4(data, size, memory).map_err(ChunkError::Decompress)?,
            _ => return Err(ChunkError::Compression { name: header.compression }),
        };
        if records.len() != size {
            return Err(ChunkError::Length { actual: records.len(), expected: header.uncompressed_size });
        }
        let crc = crc32fast::hash(&records);
        if header.uncompressed_crc != 0 && header.uncompressed_crc != crc {
            return Err(ChunkError::Crc { actual: crc, expected: header.uncompressed_crc });
        }
        Ok(Self { records, crc })
    }

    /// Returns the bytes of memory that decoding takes, those of the body included.
    ///
    /// # Errors
    /// [`ChunkError::Header`], [`ChunkError::TooLarge`].
    pub fn memory_of(body: &[u8]) -> Result<u64, ChunkError> {
        let (header, _) = chunk_parts(body)?;
        Ok(header.uncompressed_size.max(body.len() as u64))
    }

    /// Returns its identity, which two copies of one chunk share.
    pub fn identity(&self) -> ChunkIdentity {
        let first = self.records().find(|(code, body)| *code == op::MESSAGE && body.len() >= MESSAGE_HEADER_BYTES);
        (self.crc, self.records.len(), first.and_then(|(_, body)| body[..14].try_into().ok()))
    }

    /// Checks that it is made of whole records and messages. A right CRC does not say so: its writer may have erred,
    /// and a chunk without a CRC may be damaged.
    ///
    /// # Errors
    /// [`RecordError::Early`].
    pub fn check_records(&self) -> Result<(), RecordError> {
        let is_whole = |(code, body): (u8, &[u8])| code != op::MESSAGE || body.len() >= MESSAGE_HEADER_BYTES;
        let mut whole_bytes = 0;
        for record in self.records() {
            whole_bytes += FRAME_BYTES + record.1.len();
            is_whole(record).then_some(()).ok_or(RecordError::Early)?;
        }
        (whole_bytes == self.records.len()).then_some(()).ok_or(RecordError::Early)
    }

    /// Returns its records as (opcode, body). Ends at one that is not whole: see [`Self::check_records`].
    pub fn records(&self) -> impl Iterator<Item = (u8, &[u8])> {
        let mut rest = &self.records[..];
        std::iter::from_fn(move || {
            let (code, body, behind) = split_record(rest)?;
            rest = behind;
            Some((code, body))
        })
    }

    /// Returns its messages that are whole.
    pub fn messages(&self) -> impl Iterator<Item = ChunkMessage<'_>> {
        let messages = self.records().filter(|(code, body)| *code == op::MESSAGE && body.len() >= MESSAGE_HEADER_BYTES);
        messages.map(|(_, body)| ChunkMessage {
            channel: u16::from_le_bytes([body[0], body[1]]),
            log_time_ns: i64::from_le_bytes(body[6..14].try_into().unwrap_or_default()),
            data: &body[MESSAGE_HEADER_BYTES..],
        })
    }

    /// Shares some of its bytes.
    pub fn share_bytes(&self, part: &[u8]) -> Bytes {
        self.records.slice_ref(part)
    }

    /// Returns its memory for [`Self::decode_into`]. It is empty if others share the records or they are large.
    pub fn into_memory(self) -> Vec<u8> {
        let mut records = self.records.try_into_mut().unwrap_or_default();
        records.clear();
        let memory = Vec::from(records);
        if memory.capacity() as u64 <= LARGE_RECORD { memory } else { Vec::new() }
    }

    /// Returns a strict cursor over its records.
    pub fn into_cursor(self) -> RecordCursor {
        RecordCursor::new(self.records)
    }
}

/// Why records cannot be read further.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The bytes end within a record.
    #[error("a record ends early")]
    Early,
    /// A record's content makes no sense.
    #[error("{}", describe_mcap_error(.0))]
    Content(McapError),
}

/// Reads records one after the other, and fails at the first that is not whole.
#[derive(Debug)]
pub struct RecordCursor {
    records: Bytes,
    position: usize,
}

impl RecordCursor {
    /// Reads the records that `records` hold, each with its frame.
    pub fn new(records: Bytes) -> Self {
        Self { records, position: 0 }
    }

    /// Returns the memory of the records: see [`DecodedChunk::into_memory`].
    pub fn into_memory(self) -> Vec<u8> {
        DecodedChunk { records: self.records, crc: 0 }.into_memory()
    }

    /// Returns the next record; None behind the last one.
    ///
    /// # Errors
    /// [`RecordError`].
    pub fn next_record(&mut self) -> Result<Option<Record<'_>>, RecordError> {
        self.next_unskipped(|_| false)
    }

    /// Returns the next record that is not a whole message of a channel that `is_skipped`; None behind the last one.
    ///
    /// # Errors
    /// [`RecordError`].
    #[inline]
    pub fn next_unskipped(&mut self, is_skipped: impl Fn(u16) -> bool) -> Result<Option<Record<'_>>, RecordError> {
        while self.position < self.records.len() {
            let rest = &self.records[self.position..];
            let (code, body, behind) = split_record(rest).ok_or(RecordError::Early)?;
            self.position = self.records.len() - behind.len();
            let is_message = code == op::MESSAGE && body.len() >= MESSAGE_HEADER_BYTES;
            if !(is_message && is_skipped(u16::from_le_bytes([body[0], body[1]]))) {
                return parse_fast(code, body).map(Some).map_err(RecordError::Content);
            }
        }
        Ok(None)
    }
}

/// Returns the body of a chunk record, whose frame must agree with the place where an index found it.
///
/// # Errors
/// What else stands there.
pub fn chunk_body(record: &Bytes) -> Result<Bytes, String> {
    if record.len() < FRAME_BYTES {
        return Err("its chunk ends within its frame".to_owned());
    }
    let frame = RecordFrame::from_bytes(record);
    if frame.code != op::CHUNK {
        return Err(format!("there is a record of kind {:#04x} where its index says that a chunk is", frame.code));
    }
    let body = record.slice(FRAME_BYTES..);
    match frame.length == body.len() as u64 {
        true => Ok(body),
        false => Err(format!("its chunk has {} bytes, its index says {}", frame.length, body.len())),
    }
}

/// Parses a record.
///
/// # Errors
/// The library's. It panics at an attachment that ends within its first fields, which is an error here.
pub fn parse_record(code: u8, body: &[u8]) -> Result<Record<'_>, McapError> {
    match code == op::ATTACHMENT && !has_attachment_head(body) {
        true => Err(McapError::UnexpectedEof),
        false => mcap::parse_record(code, body),
    }
}

// Two times, name, media type, the data's length, and a CRC behind the data.
fn has_attachment_head(body: &[u8]) -> bool {
    let text_end = |begin: usize| {
        let length = body.get(begin..begin.checked_add(4)?)?.first_chunk().map(|bytes| u32::from_le_bytes(*bytes))?;
        begin.checked_add(4)?.checked_add(length as usize)
    };
    text_end(16).and_then(text_end).and_then(|end| end.checked_add(8 + 4)).is_some_and(|end| end <= body.len())
}

/// Returns the cause of an error of the MCAP library: the system's own error, which the library's text does not name.
pub fn system_cause(error: McapError) -> ErrorCause {
    match error {
        McapError::Io(system) => system.into(),
        other => describe_mcap_error(&other).into(),
    }
}

/// Returns an error of the MCAP library with its cause. That of a parser is its innermost one: the others are a drawing
/// of the parser's source, with colours and the paths of the machine that built it.
pub fn describe_mcap_error(error: &McapError) -> String {
    match error {
        McapError::Parse(cause) => format!("{error}: {}", escape_controls(&cause.root_cause().to_string())),
        McapError::Io(cause) => format!("{error}: {cause}"),
        other => escape_controls(&other.to_string()),
    }
}

fn chunk_parts(body: &[u8]) -> Result<(ChunkHeader, &[u8]), ChunkError> {
    let Ok(Record::Chunk { header, data: Cow::Borrowed(data) }) = parse_record(op::CHUNK, body) else {
        return Err(ChunkError::Header);
    };
    let stored = if header.compression.is_empty() { 0 } else { data.len() as u64 };
    match header.uncompressed_size.saturating_add(stored) <= LARGEST_CHUNK {
        true => Ok((header, data)),
        false => Err(ChunkError::TooLarge { claimed: header.uncompressed_size }),
    }
}

#[inline]
fn split_record(records: &[u8]) -> Option<(u8, &[u8], &[u8])> {
    let (frame, behind) = records.split_at_checked(FRAME_BYTES)?;
    let frame = RecordFrame::from_bytes(frame);
    let (body, behind) = behind.split_at_checked(usize::try_from(frame.length).ok()?)?;
    Some((frame.code, body, behind))
}

// Most records are messages, which are read without the library's general parser.
#[inline]
fn parse_fast(code: u8, body: &[u8]) -> Result<Record<'_>, McapError> {
    match body.split_first_chunk::<MESSAGE_HEADER_BYTES>() {
        Some((h, data)) if code == op::MESSAGE => Ok(Record::Message {
            header: MessageHeader {
                channel_id: u16::from_le_bytes([h[0], h[1]]),
                sequence: u32::from_le_bytes([h[2], h[3], h[4], h[5]]),
                log_time: u64::from_le_bytes([h[6], h[7], h[8], h[9], h[10], h[11], h[12], h[13]]),
                publish_time: u64::from_le_bytes([h[14], h[15], h[16], h[17], h[18], h[19], h[20], h[21]]),
            },
            data: Cow::Borrowed(data),
        }),
        _ => parse_record(code, body),
    }
}

thread_local! {
    /// Its tables are large beside a chunk, so each thread makes them once.
    static DECOMPRESSOR: RefCell<Option<Decompressor<'static>>> = const { RefCell::new(None) };
}

// Memory that is allocated for a claim and not written to is never touched, so it costs nothing.
fn decompress_zstd(data: &[u8], size: usize, mut records: Vec<u8>) -> io::Result<Bytes> {
    records.reserve_exact(size);
    DECOMPRESSOR.with_borrow_mut(|kept| {
        let decompressor = match kept.take() {
            Some(decompressor) => decompressor,
            None => Decompressor::new()?,
        };
        kept.insert(decompressor).decompress_to_buffer(data, &mut records)?;
        Ok(records.into())
    })
}

fn decompress_lz4(data: &[u8], size: usize, mut records: Vec<u8>) -> io::Result<Bytes> {
    records.reserve_exact(size);
    // One byte more than claimed tells that the claim is wrong.
    lz4::Decoder::new(data)?.take(size as u64 + 1).read_to_end(&mut records)?;
    Ok(records.into())
}

#[cfg(test)]
mod tests {
    use mcap::{Compression, WriteOptions};

    use super::*;

    // The body of the one chunk of a file with three messages.
    fn chunk(compression: Option<Compression>) -> Bytes {
        let mut file = std::io::Cursor::new(Vec::new());
        let mut writer = WriteOptions::new().compression(compression).create(&mut file).expect("a writer");
        let channel = writer.add_channel(0, "/a", "json", &Default::default()).expect("added");
        for sequence in 0..3 {
            let header = MessageHeader { channel_id: channel, sequence, log_time: 7, publish_time: 8 };
            writer.write_to_known_channel(&header, &[sequence as u8; 1000]).expect("written");
        }
        writer.finish().expect("finished");
        drop(writer);
        let file = file.into_inner();
        let mut rest = &file[8..];
        while let Some((code, body, behind)) = split_record(rest) {
            if code == op::CHUNK {
                return Bytes::copy_from_slice(body);
            }
            rest = behind;
        }
        panic!("no chunk");
    }

    #[test]
    fn each_compression_is_decoded_to_the_same_records() {
        for compression in [None, Some(Compression::Zstd), Some(Compression::Lz4)] {
            let decoded = DecodedChunk::decode(&chunk(compression)).expect("sound");
            let sizes: Vec<_> = decoded.messages().map(|m| (m.channel, m.log_time_ns, m.data.len())).collect();
            assert_eq!(sizes.len(), 3, "{compression:?}");
            assert!(sizes.iter().all(|size| *size == (sizes[0].0, 7, 1000)), "{sizes:?}");
            let mut cursor = decoded.into_cursor();
            let mut count = 0;
            while cursor.next_record().expect("whole").is_some() {
                count += 1;
            }
            assert_eq!(count, 4, "a channel and its messages");
        }
    }

    // Of another channel's messages only the frame is looked at; what is no whole message is refused as ever.
    #[test]
    fn messages_of_skipped_channels_are_passed() {
        let record = |code: u8, body: &[u8]| [&[code][..], &(body.len() as u64).to_le_bytes(), body].concat();
        let message = |channel: u8| record(op::MESSAGE, &[&[channel][..], &[0; MESSAGE_HEADER_BYTES]].concat());
        let records = [message(1), message(2), record(0x80, &[1, 2]), message(1), message(2), message(3)].concat();
        let mut cursor = RecordCursor::new(records.into());
        let mut seen = Vec::new();
        while let Some(record) = cursor.next_unskipped(|channel| channel == 1).expect("whole") {
            seen.push(match record {
                Record::Message { header, .. } => header.channel_id,
                _ => 0,
            });
        }
        assert_eq!(seen, [2, 0, 2, 3]);
        for short in [0, 1, MESSAGE_HEADER_BYTES - 1] {
            let damaged = [message(1), record(op::MESSAGE, &vec![1; short])].concat();
            let mut cursor = RecordCursor::new(damaged.into());
            assert!(matches!(cursor.next_unskipped(|_| true), Err(RecordError::Content(_))), "{short}");
        }
        let mut cut = [message(1), message(1)].concat();
        cut.pop();
        assert!(matches!(RecordCursor::new(cut.into()).next_unskipped(|_| true), Err(RecordError::Early)));
    }

    #[test]
    fn each_bit_that_is_turned_is_found() {
        for compression in [None, Some(Compression::Zstd), Some(Compression::Lz4)] {
            let sound = chunk(compression);
            // Times in the header are not covered by the CRC.
            for at in 16..sound.len() {
                let mut damaged = sound.to_vec();
                damaged[at] ^= 1;
                let damaged = DecodedChunk::decode(&damaged.into());
                let same =
                    |found: DecodedChunk| found.identity() == DecodedChunk::decode(&sound).expect("sound").identity();
                // A checksum of the compression itself may be turned and not be looked at.
                assert!(damaged.map_or(true, same), "byte {at} of {compression:?}");
            }
        }
    }

    #[test]
    fn chunks_above_the_limit_are_refused_before_they_are_decoded() {
        let mut body = chunk(Some(Compression::Zstd)).to_vec();
        let stored = DecodedChunk::decode(&body.clone().into()).expect("sound").records.len() as u64;
        body[16..24].copy_from_slice(&(LARGEST_CHUNK - stored / 2).to_le_bytes());
        let within = DecodedChunk::decode(&body.clone().into());
        assert!(matches!(within, Err(ChunkError::Length { .. })), "{within:?}");
        for claimed in [LARGEST_CHUNK, LARGEST_CHUNK + 1, u64::MAX] {
            body[16..24].copy_from_slice(&claimed.to_le_bytes());
            let refused = DecodedChunk::decode(&body.clone().into());
            assert!(matches!(refused, Err(ChunkError::TooLarge { .. })), "{claimed}: {refused:?}");
        }
    }

    #[test]
    fn a_cursor_fails_where_a_record_ends_early() {
        let whole = DecodedChunk::decode(&chunk(None)).expect("sound");
        whole.check_records().expect("whole records");
        let whole = whole.records;
        for cut in [1, FRAME_BYTES, whole.len() - 1] {
            let part = DecodedChunk { records: whole.slice(..cut), crc: 0 };
            assert!(part.check_records().is_err(), "{cut}");
            let mut cursor = part.into_cursor();
            let failed =
                std::iter::from_fn(|| cursor.next_record().map(|r| r.map(drop)).transpose()).find_map(Result::err);
            assert!(matches!(failed, Some(RecordError::Early)), "{cut}: {failed:?}");
        }
    }
}
