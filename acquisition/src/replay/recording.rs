//! A recording as a replay reads it: its index in memory, its chunks one at a time.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{self, Read as _, Seek as _, SeekFrom};
use std::ops::Range;
use std::path::{Path, PathBuf};

use bytes::Bytes;
use echolake_recording::limits::LARGEST_CHUNK;
use echolake_recording::{
    Channel, ChannelDefinitions, ChunkIndex, DecodedChunk, DefinitionDigests, FRAME_BYTES, Record, RecordingItem,
    RecordingReader, ResyncError, RunSummary, summary_range, tail_range,
};

use super::error::Error;
use crate::run::recorder::Topic;

const FRAME: u64 = FRAME_BYTES as u64;

/// An MCAP file that can be replayed.
pub struct Recording {
    path: PathBuf,
    file: File,
    /// By channel of the file.
    pub(super) topics: BTreeMap<u16, Topic>,
    /// Those of its summary; a walk compares all schemas and channels by itself.
    digests: DefinitionDigests,
    /// Those with messages, by the time of their first.
    pub(super) chunks: Vec<Stretch>,
    /// First and last time, ns since 1970.
    pub(super) range: (u64, u64),
    defect: Option<String>,
}

/// What is known of a chunk without reading it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Stretch {
    pub start: u64,
    pub end: u64,
    pub offset: u64,
    pub length: u64,
    /// Nothing where the index does not tell.
    channels: Option<BTreeSet<u16>>,
}

/// Where a message stands in the order of a recording: its time, its chunk, its place there.
pub(super) type Key = (u64, u64, u32);

/// A message of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Message {
    pub key: Key,
    pub channel: u16,
    pub data: Vec<u8>,
}

impl Recording {
    /// Opens a file and reads its index. One without, because it was cut off or is damaged, is walked through, and what
    /// is whole of it is replayed.
    ///
    /// # Errors
    /// [`Error::Read`], or [`Error::Unplayable`] where there is not one whole message.
    pub fn open(path: &Path) -> Result<Self, Error> {
        let unread = |source| Error::Read { path: path.to_owned(), source };
        let mut file = File::open(path).map_err(unread)?;
        let summary = match read_summary(&mut file) {
            // One that leaves out a part of what the file holds is as good as none.
            Ok(found) => found.filter(|s| !s.chunk_indexes.is_empty() && s.describe_unaccounted().is_none()),
            Err(Unread::System(source)) => return Err(unread(source)),
            // The walk says what is wrong.
            Err(Unread::Damaged) => None,
        };
        let mut digests = DefinitionDigests::default();
        let (topics, mut chunks, defect) = match summary {
            Some(summary) => {
                digests = summary.digests;
                let chunks = summary.chunk_indexes.iter().filter_map(Stretch::of_index).collect();
                (topics_of(summary.channels.values().map(|c| c.as_ref())), chunks, None)
            }
            None => walk_recording(path)?,
        };
        chunks.sort_by_key(|c: &Stretch| (c.start, c.offset));
        let range = chunks.first().map(|first| (first.start, chunks.iter().map(|c| c.end).fold(first.end, u64::max)));
        let Some(range) = range else {
            let reason = match defect {
                Some(defect) => format!("{defect}, and nothing before it is whole"),
                None => "it has no chunks with messages; hint: `mcap recover` writes a file in chunks".to_owned(),
            };
            return Err(Error::Unplayable { path: path.to_owned(), reason });
        };
        Ok(Self { path: path.to_owned(), file, topics, digests, chunks, range, defect })
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What is wrong with it as a whole, in words; damage within it shows when it is played.
    pub fn defect(&self) -> Option<&str> {
        self.defect.as_deref()
    }

    /// First and last time, ns since 1970.
    pub fn time_range(&self) -> (u64, u64) {
        self.range
    }

    /// The messages of a chunk by their time, of some channels; in words where it is damaged.
    pub(super) fn read_messages(&self, chunk: &Stretch, channels: &BTreeSet<u16>) -> Result<Vec<Message>, String> {
        let decoded = DecodedChunk::decode(&self.read_body(chunk)?).map_err(|e| format!("a chunk is damaged: {e}"))?;
        let mut records = decoded.into_cursor();
        let mut messages = Vec::new();
        let mut place = 0;
        while let Some(record) = records.next_record().map_err(|e| e.to_string())? {
            self.digests.check_definition(&record)?;
            if let Record::Message { header, data } = record
                && channels.contains(&header.channel_id)
            {
                let key = (header.log_time, chunk.offset, place);
                messages.push(Message { key, channel: header.channel_id, data: data.into_owned() });
            }
            place += 1;
        }
        messages.sort_by_key(|m| m.key);
        Ok(messages)
    }

    fn read_body(&self, chunk: &Stretch) -> Result<Bytes, String> {
        if !(FRAME..=FRAME + LARGEST_CHUNK).contains(&chunk.length) {
            return Err(format!("a chunk of {} bytes", chunk.length));
        }
        let mut body = vec![0; (chunk.length - FRAME) as usize];
        let mut file = &self.file;
        let read = file.seek(SeekFrom::Start(chunk.offset.saturating_add(FRAME)));
        read.and_then(|_| file.read_exact(&mut body)).map_err(|e| e.to_string())?;
        Ok(body.into())
    }
}

impl Stretch {
    fn of_index(index: &ChunkIndex) -> Option<Self> {
        let start = index.message_start_time;
        let end = index.message_end_time;
        let channels: BTreeSet<u16> = index.message_index_offsets.keys().copied().collect();
        // That is how a chunk without messages looks.
        let is_empty = channels.is_empty() && start == 0 && end == 0;
        let channels = Some(channels).filter(|c| !c.is_empty());
        let offset = index.chunk_start_offset;
        let length = index.chunk_length;
        (!is_empty && start <= end).then_some(Self { start, end, offset, length, channels })
    }

    /// Whether it may have messages of one of these channels.
    pub fn has_any(&self, channels: &BTreeSet<u16>) -> bool {
        self.channels.as_ref().is_none_or(|has| !has.is_disjoint(channels))
    }
}

/// Why a summary is not read.
enum Unread {
    System(std::io::Error),
    Damaged,
}

fn read_summary(file: &mut File) -> Result<Option<RunSummary>, Unread> {
    let bytes = file.metadata().map_err(Unread::System)?.len();
    let tail = read_range(file, tail_range(bytes)).map_err(Unread::System)?;
    let Some(range) = summary_range(&tail, bytes) else { return Ok(None) };
    let summary = read_range(file, range).map_err(Unread::System)?;
    RunSummary::parse(&summary).map(Some).map_err(|_| Unread::Damaged)
}

fn read_range(file: &mut File, range: Range<u64>) -> io::Result<Vec<u8>> {
    let mut bytes = vec![0; (range.end - range.start) as usize];
    file.seek(SeekFrom::Start(range.start))?;
    file.read_exact(&mut bytes)?;
    Ok(bytes)
}

type Walked = (BTreeMap<u16, Topic>, Vec<Stretch>, Option<String>);

// The index of a file that has none.
fn walk_recording(path: &Path) -> Result<Walked, Error> {
    let unread = |e: ResyncError| {
        let reason = match e {
            ResyncError::Read { source, .. } => source.to_string(),
            ResyncError::Gone { .. } => "it is gone".to_owned(),
            ResyncError::NotMcap { actual, .. } => format!("it is no MCAP file: it begins with {actual}"),
        };
        Error::Unplayable { path: path.to_owned(), reason }
    };
    let mut walk = RecordingReader::open(path).map_err(unread)?;
    let mut definitions = ChannelDefinitions::default();
    let mut chunks = Vec::new();
    while let Some(item) = walk.next_item().map_err(unread)? {
        let chunk = match item {
            RecordingItem::Chunk(chunk) => chunk,
            // Those of a chunk have a CRC and count for more.
            RecordingItem::Definition(record) => {
                let _ = definitions.learn_definition(&record);
                continue;
            }
            _ => continue,
        };
        let mut times = Vec::new();
        let mut channels = BTreeSet::new();
        for record in &chunk.records {
            definitions.learn_definition(record).map_err(|what| Error::Unplayable {
                path: path.to_owned(),
                reason: format!("the chunk at byte {}: {what}", chunk.offset),
            })?;
            if let Record::Message { header, .. } = record {
                times.push(header.log_time);
                channels.insert(header.channel_id);
            }
        }
        if let (Some(start), Some(end)) = (times.iter().copied().min(), times.iter().copied().max()) {
            let offset = chunk.offset;
            let length = chunk.length;
            chunks.push(Stretch { start, end, offset, length, channels: Some(channels) });
        }
    }
    // What was closed, yet has no chunks, is of another make, not damaged.
    let damage = walk.finish().map_err(unread)?.damage;
    let defect = if damage.is_empty() {
        (!chunks.is_empty()).then(|| "it has no index".to_owned())
    } else {
        Some(damage.join("; "))
    };
    Ok((topics_of(definitions.into_channels().values().map(|c| c.as_ref())), chunks, defect))
}

fn topics_of<'a>(channels: impl Iterator<Item = &'a Channel<'static>>) -> BTreeMap<u16, Topic> {
    let topic = |channel: &Channel<'_>| Topic {
        channel: channel.id,
        topic: channel.topic.clone(),
        encoding: channel.message_encoding.clone(),
        schema: channel.schema.as_ref().map(|s| s.name.clone()).unwrap_or_default(),
        schema_encoding: channel.schema.as_ref().map(|s| s.encoding.clone()).unwrap_or_default(),
        schema_data: channel.schema.as_ref().map(|s| s.data.to_vec()).unwrap_or_default(),
    };
    channels.map(|channel| (channel.id, topic(channel))).collect()
}
