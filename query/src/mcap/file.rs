//! An MCAP file in the lake's store: its channels, and where its messages are.
//!
//! Both come from its summary, which is read by ranges from its end. A file without one, because it was cut off or its
//! writer makes none, or with one that is damaged, is walked from its first byte, one record in memory at a time.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{MAGIC, McapError};
use object_store::path::Path;
use object_store::{ObjectMeta, ObjectStore, ObjectStoreExt as _};

use super::chunk::{FRAME, Kind, LARGEST, Records, Step, Stop, words};
use super::error::Fault;
use super::schema::RawSchema;

/// What is read of a file's end at first: the summary of a run of a hundred measurements fits.
const TAIL: u64 = 64 << 10;
/// The footer: its frame, two places and a CRC; magic bytes follow.
const FOOTER: usize = FRAME + 20;
/// What is read at a time of a file that is walked.
const BLOCK: u64 = 4 << 20;
/// Messages that stand in no chunk are read in pieces of this size.
const PIECE: u64 = 1 << 20;
/// Summaries that are kept for the next query, in bytes.
const KEPT: usize = 64 << 20;
/// A record that ends the data section and has no CRC: behind it the reader checks that of the summary.
const DATA_END: [u8; FRAME + 4] = [op::DATA_END, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];

/// What is known of a file before any message is read.
#[derive(Debug)]
pub(super) struct McapFile {
    pub(super) path: Path,
    pub(super) bytes: u64,
    /// Whether its summary told where what is.
    pub(super) indexed: bool,
    pub(super) channels: BTreeMap<u16, Channel>,
    /// In the file's order, without overlaps.
    pub(super) pieces: Vec<Piece>,
    pub(super) attachments: Vec<Attachment>,
}

/// A file within a run's file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Attachment {
    /// Its name.
    pub name: String,
    /// As it was recorded with it.
    pub media_type: String,
    /// Size of what it holds.
    pub bytes: u64,
    /// Where its record is.
    pub(super) range: Range<u64>,
}

/// A channel.
#[derive(Debug, Clone)]
pub(super) struct Channel {
    pub(super) topic: String,
    pub(super) schema: Arc<RawSchema>,
    /// Messages, where that is known.
    pub(super) messages: Option<u64>,
    /// Times of its first and last message, where the file was walked.
    pub(super) times: Option<(u64, u64)>,
}

/// A chunk, or a run of messages in none.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Piece {
    pub(super) kind: Kind,
    pub(super) range: Range<u64>,
    /// Times of its earliest and latest message, ns.
    pub(super) times: (u64, u64),
    /// Channels of its messages; None where the index does not say.
    pub(super) channels: Option<Box<[u16]>>,
    /// Bytes of message indexes behind it.
    pub(super) index: u64,
    /// Bytes of its records before compression, where its index tells.
    pub(super) plain: u64,
}

impl Piece {
    /// Whether it may have messages of a channel.
    pub(super) fn has(&self, channel: u16) -> bool {
        self.channels.as_ref().is_none_or(|channels| channels.contains(&channel))
    }
}

/// Opens files; the summaries of the last ones are kept, which is good for as long as size and time stay.
#[derive(Debug)]
pub(crate) struct Files {
    pub(super) store: Arc<dyn ObjectStore>,
    kept: Mutex<Kept>,
}

#[derive(Debug, Default)]
struct Kept {
    files: HashMap<Path, (ObjectMeta, Arc<McapFile>)>,
    bytes: usize,
}

impl Files {
    pub(crate) fn new(store: Arc<dyn ObjectStore>) -> Self {
        Self { store, kept: Mutex::default() }
    }

    /// Opens a file of the lake's store.
    pub(super) async fn open(&self, path: &Path) -> Result<Arc<McapFile>, Fault> {
        let meta = self.store.head(path).await.map_err(|source| Fault::Read { file: path.to_string(), source })?;
        let known = self.kept().files.get(path).filter(|(known, _)| *known == meta).map(|(_, file)| file.clone());
        if let Some(file) = known {
            return Ok(file);
        }
        let file = Arc::new(Opening { store: self.store.as_ref(), path, bytes: meta.size }.file().await?);
        let mut kept = self.kept();
        if kept.bytes > KEPT {
            *kept = Kept::default();
        }
        kept.bytes += file.memory();
        kept.files.insert(path.clone(), (meta, file.clone()));
        Ok(file)
    }

    fn kept(&self) -> std::sync::MutexGuard<'_, Kept> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl McapFile {
    fn memory(&self) -> usize {
        let channels = self.channels.values().map(|c| c.topic.len() + c.schema.data.len() + 256).sum::<usize>();
        let pieces = self.pieces.iter().map(|p| 64 + 2 * p.channels.as_ref().map_or(0, |c| c.len())).sum::<usize>();
        channels + pieces
    }
}

/// A file that is being opened.
struct Opening<'a> {
    store: &'a dyn ObjectStore,
    path: &'a Path,
    bytes: u64,
}

impl Opening<'_> {
    async fn file(&self) -> Result<McapFile, Fault> {
        let tail = self.read(self.bytes.saturating_sub(TAIL)..self.bytes).await?;
        if let Some(start) = summary_start(&tail, self.bytes) {
            let from_end = self.bytes - start;
            let summary = match tail.len() as u64 >= from_end {
                true => tail.slice(tail.len() - from_end as usize..),
                false => self.read(start..self.bytes).await?,
            };
            // One that makes no sense is none.
            if let Some(found) = self.summary(&summary, start).ok().flatten() {
                return Ok(found);
            }
        }
        self.walk().await
    }

    async fn read(&self, range: Range<u64>) -> Result<Bytes, Fault> {
        if range.is_empty() {
            return Ok(Bytes::new());
        }
        let read = self.store.get_range(self.path, range).await;
        read.map_err(|source| Fault::Read { file: self.path.to_string(), source })
    }

    // None where the summary does not tell where all messages are.
    fn summary(&self, summary: &[u8], start: u64) -> Result<Option<McapFile>, McapError> {
        let mut definitions = Definitions::default();
        let (mut statistics, mut indexes, mut attachments) = (None, Vec::new(), Vec::new());
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_validate_summary_section_crc(true)
            .with_record_length_limit(summary.len());
        let mut reader = LinearReader::new_with_options(options);
        let mut rest = DATA_END.as_slice();
        let mut behind = Some(summary);
        while let Some(event) = reader.next_event() {
            match event? {
                LinearReadEvent::ReadRequest(_) => {
                    if rest.is_empty() {
                        rest = behind.take().ok_or(McapError::UnexpectedEof)?;
                    }
                    reader.insert(rest.len()).copy_from_slice(rest);
                    reader.notify_read(rest.len());
                    rest = &[];
                }
                LinearReadEvent::Record { opcode, data } => match mcap::parse_record(opcode, data)? {
                    Record::Statistics(found) => statistics = Some(found),
                    Record::ChunkIndex(index) => indexes.push(index),
                    Record::AttachmentIndex(index) => attachments.push(index),
                    other => definitions.learn(&other),
                },
            }
        }
        let Some(statistics) = statistics.filter(|s| s.chunk_count as usize == indexes.len()) else { return Ok(None) };
        if indexes.is_empty() && statistics.message_count > 0 {
            return Ok(None);
        }
        let pieces = indexes.into_iter().map(|index| {
            let end = index.chunk_start_offset.checked_add(index.chunk_length).filter(|end| *end <= start)?;
            let channels = index.message_index_offsets.keys().copied().collect::<Box<[_]>>();
            Some(Piece {
                kind: Kind::Chunk,
                range: index.chunk_start_offset..end,
                times: (index.message_start_time, index.message_end_time),
                // A writer may make no message indexes.
                channels: (!channels.is_empty()).then_some(channels),
                index: index.message_index_length.min(start - end),
                plain: index.uncompressed_size,
            })
        });
        let Some(mut pieces) = pieces.collect::<Option<Vec<_>>>() else { return Ok(None) };
        pieces.sort_by_key(|p| p.range.start);
        let overlap = pieces.windows(2).any(|two| two[0].range.end > two[1].range.start);
        let short = pieces.iter().any(|p| p.range.end - p.range.start < FRAME as u64);
        let all: BTreeSet<u16> = pieces.iter().flat_map(|p| p.channels.iter().flatten().copied()).collect();
        let mut channels = definitions.channels();
        if overlap || short || !all.iter().all(|id| channels.contains_key(id)) {
            return Ok(None);
        }
        for (id, channel) in &mut channels {
            channel.messages = Some(statistics.channel_message_counts.get(id).copied().unwrap_or(0));
        }
        let attachments = attachments.into_iter().filter_map(|index| {
            let end = index.offset.checked_add(index.length).filter(|end| *end <= start)?;
            let range = index.offset..end;
            Some(Attachment { name: index.name, media_type: index.media_type, bytes: index.data_size, range })
        });
        let attachments = attachments.collect();
        Ok(Some(McapFile { path: self.path.clone(), bytes: self.bytes, indexed: true, channels, pieces, attachments }))
    }

    fn damaged(&self, offset: u64, what: impl Into<String>) -> Fault {
        Fault::Damaged { file: self.path.to_string(), offset, what: what.into() }
    }

    // Goes through all records up to the end of the data or of what there is of them.
    async fn walk(&self) -> Result<McapFile, Fault> {
        let start = self.read(0..(MAGIC.len() as u64).min(self.bytes)).await?;
        if start[..] != *MAGIC {
            return Err(self.damaged(0, "it does not begin as an MCAP file does"));
        }
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_emit_chunks(true)
            .with_record_length_limit(LARGEST as usize);
        let mut reader = LinearReader::new_with_options(options);
        let mut walk = Walk { at: MAGIC.len() as u64, ..Walk::default() };
        let mut read = walk.at;
        loop {
            match reader.next_event() {
                Some(Ok(LinearReadEvent::ReadRequest(count))) => {
                    if read == self.bytes {
                        break;
                    }
                    // Much is read at a time, but never more than the record at hand needs is kept for long.
                    let block = self.read(read..(read + BLOCK.max(count as u64).min(LARGEST)).min(self.bytes)).await?;
                    reader.insert(block.len()).copy_from_slice(&block);
                    reader.notify_read(block.len());
                    read += block.len() as u64;
                    tokio::task::yield_now().await;
                }
                Some(Ok(LinearReadEvent::Record { opcode: op::DATA_END | op::FOOTER, .. })) | None => break,
                Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                    let at = walk.at;
                    walk.record(opcode, data).map_err(|what| self.damaged(at, what))?;
                }
                // Behind the last whole record of a file that was cut off something may stand that is none.
                Some(Err(e)) => return Err(self.damaged(walk.at, words(&e))),
            }
        }
        let attachments = std::mem::take(&mut walk.attachments);
        let (channels, pieces) = walk.finish();
        Ok(McapFile { path: self.path.clone(), bytes: self.bytes, indexed: false, channels, pieces, attachments })
    }
}

// Where the footer says that the summary begins.
fn summary_start(tail: &[u8], bytes: u64) -> Option<u64> {
    let footer = tail.strip_suffix(MAGIC)?;
    let footer = footer.get(footer.len().checked_sub(FOOTER)?..)?;
    if footer[0] != op::FOOTER {
        return None;
    }
    let Ok(Record::Footer(footer)) = mcap::parse_record(op::FOOTER, &footer[FRAME..]) else { return None };
    let inside = MAGIC.len() as u64..bytes - (FOOTER + MAGIC.len()) as u64;
    (inside.contains(&footer.summary_start) && bytes - footer.summary_start <= LARGEST).then_some(footer.summary_start)
}

/// Schemas and channels as they come.
#[derive(Debug, Default)]
struct Definitions {
    schemas: HashMap<u16, RawSchema>,
    channels: BTreeMap<u16, mcap::records::Channel>,
}

impl Definitions {
    // The first of an id counts; a second one repeats it.
    fn learn(&mut self, record: &Record<'_>) {
        match record {
            Record::Schema { header, data } => {
                self.schemas.entry(header.id).or_insert_with(|| RawSchema {
                    name: header.name.clone(),
                    encoding: header.encoding.clone(),
                    messages: String::new(),
                    data: data.to_vec(),
                });
            }
            Record::Channel(channel) => {
                self.channels.entry(channel.id).or_insert_with(|| channel.clone());
            }
            _ => {}
        }
    }

    fn channels(self) -> BTreeMap<u16, Channel> {
        let schema = |channel: &mcap::records::Channel| {
            let schema = self.schemas.get(&channel.schema_id).cloned().unwrap_or_default();
            Arc::new(RawSchema { messages: channel.message_encoding.clone(), ..schema })
        };
        let one = |(id, channel): (&u16, &mcap::records::Channel)| {
            (*id, Channel { topic: channel.topic.clone(), schema: schema(channel), messages: None, times: None })
        };
        self.channels.iter().map(one).collect()
    }
}

/// What a walk has come by.
#[derive(Debug, Default)]
struct Walk {
    /// Where the record at hand begins.
    at: u64,
    definitions: Definitions,
    /// Messages of each channel, and the times of the first and last.
    seen: BTreeMap<u16, (u64, (u64, u64))>,
    pieces: Vec<Piece>,
    attachments: Vec<Attachment>,
    /// Whether the last piece is one of messages in no chunk, which may go on.
    open: bool,
}

impl Walk {
    fn record(&mut self, opcode: u8, data: &[u8]) -> Result<(), String> {
        let range = self.at..self.at + (FRAME + data.len()) as u64;
        self.at = range.end;
        match opcode {
            op::CHUNK => self.chunk(range, data),
            op::MESSAGE | op::SCHEMA | op::CHANNEL => {
                let record = mcap::parse_record(opcode, data).map_err(|e| words(&e))?;
                let mut seen = Seen::default();
                self.see(&record, &mut seen);
                if opcode == op::MESSAGE {
                    self.message(range, seen);
                }
                Ok(())
            }
            op::ATTACHMENT => {
                self.open = false;
                if let Ok(Record::Attachment { header, data, .. }) = mcap::parse_record(opcode, data) {
                    let bytes = data.len() as u64;
                    let (name, media_type) = (header.name, header.media_type);
                    self.attachments.push(Attachment { name, media_type, bytes, range });
                }
                Ok(())
            }
            _ => {
                self.open = false;
                Ok(())
            }
        }
    }

    fn chunk(&mut self, range: Range<u64>, data: &[u8]) -> Result<(), String> {
        self.open = false;
        let mut whole = Vec::with_capacity(FRAME + data.len());
        whole.push(op::CHUNK);
        whole.extend_from_slice(&(data.len() as u64).to_le_bytes());
        whole.extend_from_slice(data);
        let mut seen = Seen::default();
        let mut sink = |record: Record<'_>| {
            self.see(&record, &mut seen);
            Ok::<_, std::convert::Infallible>(Step::Go)
        };
        match Records::new(whole.into(), Kind::Chunk)?.read(&mut sink) {
            Ok(_) => {}
            Err(Stop::Damage(what)) => return Err(what),
            Err(Stop::Sink(never)) => match never {},
        }
        if let Some(times) = seen.times {
            self.pieces.push(seen.piece(Kind::Chunk, range, times));
        }
        Ok(())
    }

    // Messages in no chunk are read together.
    fn message(&mut self, range: Range<u64>, seen: Seen) {
        let Some(times) = seen.times else { return };
        if let Some(piece) = self.pieces.last_mut().filter(|p| self.open && range.end - p.range.start <= PIECE) {
            piece.range.end = range.end;
            piece.times = (piece.times.0.min(times.0), piece.times.1.max(times.1));
            let channels = seen.channels.into_iter().chain(piece.channels.iter().flatten().copied());
            let channels: BTreeSet<u16> = channels.collect();
            piece.channels = Some(channels.into_iter().collect());
        } else {
            self.pieces.push(seen.piece(Kind::Loose, range, times));
            self.open = true;
        }
    }

    fn see(&mut self, record: &Record<'_>, seen: &mut Seen) {
        self.definitions.learn(record);
        if let Record::Message { header, .. } = record {
            let now = (header.log_time, header.log_time);
            let widen = |times: (u64, u64)| (times.0.min(now.0), times.1.max(now.1));
            let of = self.seen.entry(header.channel_id).or_insert((0, now));
            *of = (of.0 + 1, widen(of.1));
            seen.times = Some(seen.times.map_or(now, widen));
            seen.channels.insert(header.channel_id);
        }
    }

    fn finish(self) -> (BTreeMap<u16, Channel>, Vec<Piece>) {
        let mut channels = self.definitions.channels();
        for (id, channel) in &mut channels {
            let seen = self.seen.get(id);
            channel.messages = Some(seen.map_or(0, |(count, _)| *count));
            channel.times = seen.map(|(_, times)| *times);
        }
        (channels, self.pieces)
    }
}

/// What one piece holds.
#[derive(Default)]
struct Seen {
    times: Option<(u64, u64)>,
    channels: BTreeSet<u16>,
}

impl Seen {
    fn piece(self, kind: Kind, range: Range<u64>, times: (u64, u64)) -> Piece {
        Piece { kind, range, times, channels: Some(self.channels.into_iter().collect()), index: 0, plain: 0 }
    }
}
