//! One chunk of a run's file: decompressed, its CRC checked, cut into messages.

use std::cell::RefCell;
use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use mcap::records::Record;
use zstd::bulk::Decompressor;

use crate::record_shape::LARGEST_CHUNK;

/// Opcode and length in front of every record.
const FRAME: usize = 9;
/// Longest name of a topic or schema that is kept. None that ingest knows is as long.
const LONGEST_NAME: usize = 256;

/// Channels by id: the topic and the schema's name.
pub(crate) type Channels = HashMap<u16, Channel>;

/// A channel, as far as ingest needs it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Channel {
    pub(crate) topic: String,
    pub(crate) schema: String,
}

/// A chunk's records.
#[derive(Debug)]
pub(crate) struct Chunk {
    data: Bytes,
    crc: u32,
}

/// What distinguishes a chunk from all others of its run: CRC and size, and channel, number and time of its first message.
pub(crate) type Identity = (u32, usize, Option<[u8; 14]>);

/// A message in a chunk.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Message<'a> {
    pub(crate) channel: u16,
    pub(crate) log_time_ns: i64,
    pub(crate) data: &'a [u8],
}

/// Schemas seen so far, needed to name a channel's schema.
#[derive(Debug, Default, Clone)]
pub(crate) struct Definitions {
    schemas: HashMap<u16, String>,
    /// Chunks that are being measured share them.
    pub(crate) channels: Arc<Channels>,
}

impl Definitions {
    /// What is known stays: a chunk's definitions have its CRC, those of the summary may be damaged.
    pub(crate) fn learn(&mut self, record: &Record<'_>) {
        match record {
            Record::Schema { header, .. } => {
                self.schemas.entry(header.id).or_insert_with(|| kept_name(&header.name));
            }
            Record::Channel(channel) if !self.channels.contains_key(&channel.id) => {
                let schema = self.schemas.get(&channel.schema_id).cloned().unwrap_or_default();
                let channels = Arc::make_mut(&mut self.channels);
                channels.insert(channel.id, Channel { topic: kept_name(&channel.topic), schema });
            }
            _ => {}
        }
    }
}

impl Chunk {
    /// Decompresses a chunk record's body. The text of an error says what is wrong with it.
    pub(crate) fn decode(body: &Bytes) -> Result<Self, String> {
        let Ok(Record::Chunk { header, data }) = mcap::parse_record(0x06, body) else {
            return Err("its header is damaged".into());
        };
        let stored = if header.compression.is_empty() { 0 } else { data.len() as u64 };
        if header.uncompressed_size.saturating_add(stored) > LARGEST_CHUNK {
            let claimed = header.uncompressed_size;
            return Err(format!("it claims {claimed} bytes, with those that are stored more than {LARGEST_CHUNK}"));
        }
        let size = header.uncompressed_size as usize;
        let data = match header.compression.as_str() {
            "" => body.slice_ref(&data),
            // Not copied, however much shorter than its claim it is.
            "zstd" => Bytes::from_owner(decompress(&data, size).map_err(|e| format!("it does not decompress: {e}"))?),
            other => return Err(format!("it is compressed with `{other}`, expected zstd")),
        };
        if data.len() != size {
            return Err(format!("it has {} bytes, expected {size}", data.len()));
        }
        let crc = crc32fast::hash(&data);
        if header.uncompressed_crc != 0 && header.uncompressed_crc != crc {
            return Err(format!("its CRC is {crc:08x}, expected {:08x}", header.uncompressed_crc));
        }
        Ok(Self { data, crc })
    }

    /// The same for two copies of one chunk.
    pub(crate) fn identity(&self) -> Identity {
        let first = self.records().find(|(code, body)| *code == 0x05 && body.len() >= 22);
        (self.crc, self.data.len(), first.and_then(|(_, body)| body[..14].try_into().ok()))
    }

    /// Whether all its messages are of these channels.
    pub(crate) fn is_known_to(&self, channels: &Channels) -> bool {
        self.messages().all(|m| channels.contains_key(&m.channel))
    }

    /// Its records as (opcode, body); ends early where a frame makes no sense, which a right CRC excludes.
    pub(crate) fn records(&self) -> impl Iterator<Item = (u8, &[u8])> {
        let mut rest = &self.data[..];
        std::iter::from_fn(move || {
            let (frame, behind) = rest.split_at_checked(FRAME)?;
            let length = usize::try_from(u64::from_le_bytes(frame[1..].try_into().ok()?)).ok()?;
            let (body, behind) = behind.split_at_checked(length)?;
            rest = behind;
            Some((frame[0], body))
        })
    }

    /// Schemas and channels that the chunk introduces.
    pub(crate) fn learn(&self, definitions: &mut Definitions) {
        for (code, body) in self.records().filter(|(code, _)| matches!(code, 0x03 | 0x04)) {
            if let Ok(record) = mcap::parse_record(code, body) {
                definitions.learn(&record);
            }
        }
    }

    /// Some of its bytes, shared.
    pub(crate) fn share(&self, part: &[u8]) -> Bytes {
        self.data.slice_ref(part)
    }

    /// Its messages.
    pub(crate) fn messages(&self) -> impl Iterator<Item = Message<'_>> {
        self.records().filter(|(code, body)| *code == 0x05 && body.len() >= 22).map(|(_, body)| Message {
            channel: u16::from_le_bytes([body[0], body[1]]),
            log_time_ns: i64::from_le_bytes(body[6..14].try_into().unwrap_or_default()),
            data: &body[22..],
        })
    }
}

fn kept_name(name: &str) -> String {
    if name.len() <= LONGEST_NAME { name.to_owned() } else { String::new() }
}

thread_local! {
    /// Its tables are large beside a chunk, so each thread makes them once.
    static DECOMPRESSOR: RefCell<Option<Decompressor<'static>>> = const { RefCell::new(None) };
}

// What is allocated for a claim that the bytes do not bear out is never touched, so it takes no memory.
fn decompress(data: &[u8], size: usize) -> std::io::Result<Vec<u8>> {
    DECOMPRESSOR.with_borrow_mut(|kept| {
        let decompressor = match kept.take() {
            Some(decompressor) => decompressor,
            None => Decompressor::new()?,
        };
        kept.insert(decompressor).decompress(data, size)
    })
}
