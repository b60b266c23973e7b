//! An MCAP file in the lake's store: its channels, and where its messages are.
//!
//! Both come from its summary, which is read by ranges from its end. A file without one, because it was cut off or its
//! writer makes none, or with one that is damaged or does not account for all that the file holds, is walked from its
//! first byte, one record in memory at a time.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::ops::Range;
use std::sync::Arc;

use bytes::Bytes;
use echolake_lake::{Lake, LakeSnapshot};
use echolake_lake_tables::ColumnStore;
use echolake_recording::{
    BlockReader, ChannelDefinitions, DefinitionDigests, FRAME_BYTES, MAGIC, Record, RecordFrame, RecordSplitter,
    RunSummary, SplitRecord, describe_mcap_error, find_part, opcode, parse_record, summary_range, tail_range,
};
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _};
use quick_cache::Weighter;
use quick_cache::sync::Cache;

use super::encodings::RawSchema;
use super::error::Fault;
use super::piece::{Piece, PieceKind, PieceRecords};
use super::run_sizes::RunSizes;

/// What is read at a time of a file that is walked.
const BLOCK: u64 = 4 << 20;
/// Messages that stand in no chunk are read in pieces of this size.
const PIECE: u64 = 1 << 20;
/// What is read at a time of ranges that a summary does not list.
const UNLISTED_BLOCK: u64 = 64 << 10;
/// Maximum size of the cached summaries, bytes.
const CACHED_BYTES: u64 = 64 << 20;

/// What is known of a file before any message is read.
#[derive(Debug)]
pub(super) struct McapFile {
    pub path: Path,
    pub bytes: u64,
    /// The reason why it was walked; None if its summary told where what is.
    pub walked: Option<String>,
    pub channels: BTreeMap<u16, Channel>,
    /// Those of its summary; a walk compares all schemas and channels by itself.
    pub digests: DefinitionDigests,
    /// In the file's order, without overlaps.
    pub pieces: Vec<Piece>,
    pub attachments: Vec<Attachment>,
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
    pub topic: String,
    pub schema: Arc<RawSchema>,
    /// Messages, where that is known.
    pub messages: Option<u64>,
    /// Times of its first and last message, where the file was walked.
    pub times: Option<(u64, u64)>,
}

/// Opens files, and caches their summaries.
#[derive(Debug)]
pub struct McapFiles {
    store: Arc<dyn ObjectStore>,
    /// None for a lake in a folder, where a look at a file costs nothing and shows if somebody changed it.
    sizes: Option<RunSizes>,
    cache: Cache<FileVersion, Arc<McapFile>, SummaryWeighter>,
}

/// A file with its size in bytes and its time in microseconds: it has another summary once they change.
type FileVersion = (Path, u64, i64);

/// Weighs summaries by their memory in bytes.
#[derive(Debug, Clone)]
struct SummaryWeighter;

impl Weighter<FileVersion, Arc<McapFile>> for SummaryWeighter {
    fn weight(&self, _: &FileVersion, file: &Arc<McapFile>) -> u64 {
        file.memory_bytes() as u64
    }
}

impl McapFiles {
    /// Creates an empty cache for a lake, whose decoded columns are in `columns`.
    pub fn new(lake: &Lake, columns: &Arc<ColumnStore>) -> Self {
        let sizes = lake.is_remote().then(|| RunSizes::new(lake, columns));
        // So few items are one shard, in which a summary may take all the room.
        Self { store: lake.store(), sizes, cache: Cache::with_weighter(32, CACHED_BYTES, SummaryWeighter) }
    }

    /// Returns the sizes of the runs' files, if files need not be asked for them.
    pub(super) async fn known_sizes(&self, snapshot: &LakeSnapshot) -> HashMap<Path, u64> {
        match &self.sizes {
            Some(sizes) => sizes.read_sizes(snapshot).await,
            None => HashMap::new(),
        }
    }

    /// Opens a file of the lake's store, whose size may be known.
    pub(super) async fn open_file(&self, path: &Path, known_bytes: Option<u64>) -> Result<Arc<McapFile>, Fault> {
        let (bytes, modified) = match known_bytes {
            // A run's file never changes.
            Some(bytes) => (bytes, 0),
            None => {
                let meta = self.store.head(path).await;
                let meta = meta.map_err(|e| Fault::Read { file: path.to_string(), source: e.into() })?;
                (meta.size, meta.last_modified.timestamp_micros())
            }
        };
        let opening = Opening { files: self, path, bytes };
        let version = (path.clone(), bytes, modified);
        self.cache.get_or_insert_async(&version, async { opening.read_file().await.map(Arc::new) }).await
    }

    /// Reads a range of a file.
    pub(super) async fn read_range(&self, path: &Path, range: Range<u64>) -> Result<Bytes, Fault> {
        let bytes = self.store.get_range(path, range.clone()).await;
        let bytes = bytes.map_err(|e| Fault::Read { file: path.to_string(), source: e.into() })?;
        check_length(path, &range, bytes)
    }

    /// Returns true if the files are in a folder, where a read costs no request.
    pub(super) fn are_in_folder(&self) -> bool {
        self.sizes.is_none()
    }

    /// Opens a file in a folder.
    pub(super) async fn open_disk(&self, path: &Path) -> DiskFile {
        let blocks = BlockReader::open(self.store.clone(), path.clone()).await;
        DiskFile { path: path.clone(), blocks }
    }
}

/// A file on this machine's disk, whose ranges are read into the same memory, which the cache then holds.
pub(super) struct DiskFile {
    path: Path,
    blocks: BlockReader,
}

impl DiskFile {
    /// Reads a range, on this thread.
    pub async fn read_range(&mut self, range: Range<u64>) -> Result<Bytes, Fault> {
        let bytes = self.blocks.read_block(range.clone()).await;
        let bytes = bytes.map_err(|source| Fault::Read { file: self.path.to_string(), source })?;
        check_length(&self.path, &range, bytes)
    }
}

fn check_length(path: &Path, range: &Range<u64>, bytes: Bytes) -> Result<Bytes, Fault> {
    match bytes.len() as u64 == range.end - range.start {
        true => Ok(bytes),
        false => Err(Fault::damaged(path, range.start, "it became shorter while it was read")),
    }
}

impl McapFile {
    fn memory_bytes(&self) -> usize {
        let channels = self.channels.values().map(|c| c.topic.len() + c.schema.data.len() + 256).sum::<usize>();
        let pieces = self.pieces.iter().map(|p| 64 + 2 * p.channels.as_ref().map_or(0, |c| c.len())).sum::<usize>();
        channels + pieces
    }
}

/// A file that is being opened.
struct Opening<'a> {
    files: &'a McapFiles,
    path: &'a Path,
    bytes: u64,
}

impl Opening<'_> {
    async fn read_file(&self) -> Result<McapFile, Fault> {
        match self.summary_file().await? {
            Ok(file) => Ok(file),
            Err(reason) => self.walk_file(reason).await,
        }
    }

    // The text is the reason why the summary does not do.
    async fn summary_file(&self) -> Result<Result<McapFile, String>, Fault> {
        let tail = self.read_range(tail_range(self.bytes)).await?;
        let Some(range) = summary_range(&tail, self.bytes) else { return Ok(Err("it has no summary".to_owned())) };
        let start = range.start;
        let from_end = self.bytes - start;
        let summary = match tail.len() as u64 >= from_end {
            true => tail.slice(tail.len() - from_end as usize..),
            false => self.read_range(range).await?,
        };
        let summary = match RunSummary::parse(&summary) {
            Ok(summary) => summary,
            Err(e) => return Ok(Err(format!("its summary is damaged: {}", describe_mcap_error(&e)))),
        };
        if let Some(what) = summary.describe_unaccounted() {
            return Ok(Err(format!("its summary {what}")));
        }
        let Some(unlisted) = summary.unlisted_ranges(start) else {
            return Ok(Err("its summary lists parts that overlap".to_owned()));
        };
        for range in unlisted {
            if self.has_messages(range).await? {
                return Ok(Err("its summary lists chunks, but there are messages elsewhere".to_owned()));
            }
        }
        let file = self.indexed_file(summary, start);
        Ok(file.ok_or_else(|| "its summary lists chunks where there can be none".to_owned()))
    }

    // Whether there are messages, or chunks of them, in a range of records; so it may be if they are damaged.
    async fn has_messages(&self, mut range: Range<u64>) -> Result<bool, Fault> {
        let mut block = Bytes::new();
        while !range.is_empty() {
            if block.len() < FRAME_BYTES {
                block = self.read_range(range.start..range.end.min(range.start + UNLISTED_BLOCK)).await?;
            }
            if block.len() < FRAME_BYTES {
                return Ok(true);
            }
            let RecordFrame { code, length } = RecordFrame::from_bytes(&block);
            let bytes = length.saturating_add(FRAME_BYTES as u64);
            if matches!(code, opcode::MESSAGE | opcode::CHUNK) || bytes > range.end - range.start {
                return Ok(true);
            }
            range.start += bytes;
            block = block.slice(block.len().min(bytes as usize)..);
        }
        Ok(false)
    }

    // Whether it ends as a file does that was not cut off.
    async fn is_closed(&self) -> Result<bool, Fault> {
        let end = self.read_range(self.bytes.saturating_sub(MAGIC.len() as u64)..self.bytes).await?;
        Ok(end[..] == *MAGIC && self.bytes > MAGIC.len() as u64)
    }

    async fn read_range(&self, range: Range<u64>) -> Result<Bytes, Fault> {
        if range.is_empty() {
            return Ok(Bytes::new());
        }
        self.files.read_range(self.path, range).await
    }

    // The summary accounts for all messages; None if it has them where they cannot be.
    fn indexed_file(&self, summary: RunSummary, start: u64) -> Option<McapFile> {
        let indexes = summary.chunk_indexes;
        let statistics = summary.statistics?;
        let pieces = indexes.into_iter().map(|index| {
            let end = index.chunk_start_offset.checked_add(index.chunk_length).filter(|end| *end <= start)?;
            let channels = index.message_index_offsets.keys().copied().collect::<Box<[_]>>();
            Some(Piece {
                kind: PieceKind::Chunk,
                range: index.chunk_start_offset..end,
                times: (index.message_start_time, index.message_end_time),
                // A writer may make no message indexes.
                channels: (!channels.is_empty()).then_some(channels),
                index: index.message_index_length.min(start - end),
                plain: index.uncompressed_size,
            })
        });
        let mut pieces = pieces.collect::<Option<Vec<_>>>()?;
        pieces.sort_by_key(|p| p.range.start);
        let short = pieces.iter().any(|p| p.range.end - p.range.start < FRAME_BYTES as u64);
        let mut channels = with_raw_schemas(&summary.channels);
        if short {
            return None;
        }
        for (id, channel) in &mut channels {
            channel.messages = Some(statistics.channel_message_counts.get(id).copied().unwrap_or(0));
        }
        let attachments = summary.attachment_indexes.into_iter().filter_map(|index| {
            let end = index.offset.checked_add(index.length).filter(|end| *end <= start)?;
            let range = index.offset..end;
            Some(Attachment { name: index.name, media_type: index.media_type, bytes: index.data_size, range })
        });
        let attachments = attachments.collect();
        let path = self.path.clone();
        let digests = summary.digests;
        Some(McapFile { path, bytes: self.bytes, walked: None, channels, digests, pieces, attachments })
    }

    fn damaged_at(&self, offset: u64, what: impl Into<String>) -> Fault {
        Fault::damaged(self.path, offset, what)
    }

    // Whether the record at `offset`, which claims more bytes than there are, is what a file that was cut off ends in.
    async fn check_end(&self, offset: u64) -> Result<(), Fault> {
        if self.is_closed().await? {
            return Err(self.damaged_at(offset, "a record claims more bytes than there are"));
        }
        self.check_nothing_follows(offset + 1).await
    }

    // The walk ends here: what a second file behind this one holds, or a chunk behind damage, would be left out.
    async fn check_nothing_follows(&self, mut offset: u64) -> Result<(), Fault> {
        while offset + FRAME_BYTES as u64 <= self.bytes {
            let bytes = self.read_range(offset..(offset + BLOCK).min(self.bytes)).await?;
            match find_part(&bytes, self.bytes - offset) {
                Ok(position) => {
                    let what = "another file, or a part of this one, begins here behind what is read; \
                                hint: `echolake recover` keeps what is whole";
                    return Err(self.damaged_at(offset + position as u64, what));
                }
                Err(searched) => offset += searched.max(1) as u64,
            }
            tokio::task::yield_now().await;
        }
        Ok(())
    }

    // Goes through all records up to the end of the data or of what there is of them.
    async fn walk_file(&self, mut reason: String) -> Result<McapFile, Fault> {
        let start = self.read_range(0..(MAGIC.len() as u64).min(self.bytes)).await?;
        if start[..] != *MAGIC {
            return Err(self.damaged_at(0, "it does not begin as an MCAP file does"));
        }
        let mut splitter = RecordSplitter::new(MAGIC.len() as u64);
        let mut walk = Walk::default();
        let mut read = splitter.offset();
        loop {
            let offset = splitter.offset();
            let is_beyond = splitter.claimed_end().map_or(read == self.bytes, |end| end > self.bytes);
            if is_beyond && offset < self.bytes {
                self.check_end(offset).await?;
            }
            if is_beyond {
                // A record that was cut off is none.
                reason = format!("it is cut off at byte {offset} of {}", self.bytes);
                break;
            }
            match splitter.next_record().map_err(|what| self.damaged_at(offset, what))? {
                Ok(SplitRecord { code: opcode::DATA_END | opcode::FOOTER, .. }) => {
                    self.check_nothing_follows(splitter.offset()).await?;
                    break;
                }
                Ok(record) => walk.add_record(&record).map_err(|what| self.damaged_at(offset, what))?,
                Err(missing) => {
                    let block = self.read_range(read..(read + BLOCK.max(missing)).min(self.bytes)).await?;
                    read += block.len() as u64;
                    splitter.push_bytes(&block);
                    tokio::task::yield_now().await;
                }
            }
        }
        let attachments = std::mem::take(&mut walk.attachments);
        let (channels, pieces) = walk.finish().map_err(|(offset, what)| self.damaged_at(offset, what))?;
        let path = self.path.clone();
        let walked = Some(reason);
        let digests = DefinitionDigests::default();
        Ok(McapFile { path, bytes: self.bytes, walked, channels, digests, pieces, attachments })
    }
}

fn with_raw_schemas(channels: &BTreeMap<u16, Arc<echolake_recording::Channel<'static>>>) -> BTreeMap<u16, Channel> {
    let raw = |channel: &echolake_recording::Channel<'_>| {
        let messages = channel.message_encoding.clone();
        let schema = channel.schema.as_ref().map(|schema| RawSchema {
            name: schema.name.clone(),
            encoding: schema.encoding.clone(),
            messages: String::new(),
            data: schema.data.to_vec(),
        });
        let schema = Arc::new(RawSchema { messages, ..schema.unwrap_or_default() });
        Channel { topic: channel.topic.clone(), schema, messages: None, times: None }
    };
    channels.iter().map(|(id, channel)| (*id, raw(channel))).collect()
}

/// Channels and pieces of a file that was walked.
type WalkedParts = (BTreeMap<u16, Channel>, Vec<Piece>);

/// The damage of a message whose channel nothing describes.
pub(super) fn undescribed_channel(channel: u16) -> String {
    format!("it has a message of channel {channel}, which no record describes")
}

/// What a walk has come by.
#[derive(Debug, Default)]
struct Walk {
    definitions: ChannelDefinitions,
    /// Messages of each channel, and the times of the first and last.
    seen: BTreeMap<u16, (u64, (u64, u64))>,
    pieces: Vec<Piece>,
    attachments: Vec<Attachment>,
    /// Whether the last piece is one of messages in no chunk, which may go on.
    open: bool,
}

impl Walk {
    fn add_record(&mut self, record: &SplitRecord) -> Result<(), String> {
        let range = record.offset..record.end_offset();
        match record.code {
            opcode::CHUNK => self.add_chunk(range, record.body.clone()),
            opcode::MESSAGE | opcode::SCHEMA | opcode::CHANNEL => {
                let parsed = parse_record(record.code, &record.body).map_err(|e| describe_mcap_error(&e))?;
                let mut seen = Seen::default();
                self.see_record(&parsed, &mut seen)?;
                if record.code == opcode::MESSAGE {
                    self.add_message(range, seen);
                }
                Ok(())
            }
            opcode::ATTACHMENT => {
                self.open = false;
                if let Ok(Record::Attachment { header, data, .. }) = parse_record(record.code, &record.body) {
                    let bytes = data.len() as u64;
                    let name = header.name;
                    let media_type = header.media_type;
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

    fn add_chunk(&mut self, range: Range<u64>, body: Bytes) -> Result<(), String> {
        self.open = false;
        let mut seen = Seen::default();
        let mut records = PieceRecords::from_chunk(body)?;
        while let Some(record) = records.next_record()? {
            self.see_record(&record, &mut seen)?;
        }
        if let Some(times) = seen.times {
            self.pieces.push(seen.into_piece(PieceKind::Chunk, range, times));
        }
        Ok(())
    }

    // Messages in no chunk are read together.
    fn add_message(&mut self, range: Range<u64>, seen: Seen) {
        let Some(times) = seen.times else { return };
        if let Some(piece) = self.pieces.last_mut().filter(|p| self.open && range.end - p.range.start <= PIECE) {
            piece.range.end = range.end;
            piece.times = (piece.times.0.min(times.0), piece.times.1.max(times.1));
            let channels = seen.channels.into_iter().chain(piece.channels.iter().flatten().copied());
            let channels: BTreeSet<u16> = channels.collect();
            piece.channels = Some(channels.into_iter().collect());
        } else {
            self.pieces.push(seen.into_piece(PieceKind::Loose, range, times));
            self.open = true;
        }
    }

    fn see_record(&mut self, record: &Record<'_>, seen: &mut Seen) -> Result<(), String> {
        self.definitions.learn_definition(record)?;
        if let Record::Message { header, .. } = record {
            let now = (header.log_time, header.log_time);
            let widen = |times: (u64, u64)| (times.0.min(now.0), times.1.max(now.1));
            let of = self.seen.entry(header.channel_id).or_insert((0, now));
            *of = (of.0 + 1, widen(of.1));
            seen.times = Some(seen.times.map_or(now, widen));
            seen.channels.insert(header.channel_id);
        }
        Ok(())
    }

    // An error has the place of a message whose channel nothing describes: nobody knows its topic.
    fn finish(self) -> Result<WalkedParts, (u64, String)> {
        let mut channels = with_raw_schemas(&self.definitions.into_channels());
        if let Some(unknown) = self.seen.keys().find(|id| !channels.contains_key(id)) {
            let piece = self.pieces.iter().find(|piece| piece.has_channel(*unknown));
            return Err((piece.map_or(0, |piece| piece.range.start), undescribed_channel(*unknown)));
        }
        for (id, channel) in &mut channels {
            let seen = self.seen.get(id);
            channel.messages = Some(seen.map_or(0, |(count, _)| *count));
            channel.times = seen.map(|(_, times)| *times);
        }
        Ok((channels, self.pieces))
    }
}

/// What one piece holds.
#[derive(Default)]
struct Seen {
    times: Option<(u64, u64)>,
    channels: BTreeSet<u16>,
}

impl Seen {
    fn into_piece(self, kind: PieceKind, range: Range<u64>, times: (u64, u64)) -> Piece {
        Piece { kind, range, times, channels: Some(self.channels.into_iter().collect()), index: 0, plain: 0 }
    }
}
