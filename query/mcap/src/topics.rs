//! The topics of files as a table: what there is, before anything is scanned.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::array::{ArrayRef, BooleanArray, Int64Array, StringArray, TimestampNanosecondArray};
use arrow::datatypes::{DataType, Field, Schema};
use arrow::record_batch::RecordBatch;
use bytes::Bytes;
use datafusion::catalog::TableProvider;
use datafusion::datasource::MemTable;
use echolake_recording::{Record, RecordCursor};
use echolake_schema::escape_controls;
use futures::{StreamExt as _, TryStreamExt as _};

use super::column::{UTC, time_type};
use super::error::Fault;
use super::file::{McapFile, McapFiles};
use super::piece::{Piece, PieceKind, PieceRecords};
use super::rows::Head;
use super::target::Target;

/// Files that are asked for their first and last times at once.
const AT_ONCE: usize = 16;
/// Message indexes larger than this are not read for two times, but the chunk is.
const LARGEST_INDEX: u64 = 16 << 20;

type Times = Option<(u64, u64)>;

/// A row for each channel of each file.
pub(super) async fn channel_table(
    targets: Vec<Target>,
    files: &Arc<McapFiles>,
) -> Result<Arc<dyn TableProvider>, Fault> {
    let times = |target: Target| async move {
        let times = channel_times(&target.file, files).await?;
        Ok::<_, Fault>((target, times))
    };
    let found: Vec<_> = futures::stream::iter(targets).map(times).buffered(AT_ONCE).try_collect().await?;
    let rows: Vec<_> = found.iter().flat_map(|(target, times)| channel_rows(target, times)).collect();
    let batch = channel_batch(&rows)
        .map_err(|e| Fault::invalid_call(format!("the topics make no table: {e}"), "this is a bug"))?;
    let table = MemTable::try_new(batch.schema(), vec![vec![batch]]);
    Ok(Arc::new(table.map_err(|e| Fault::invalid_call(e.strip_backtrace(), "this is a bug"))?))
}

struct Row<'a> {
    target: &'a Target,
    channel: &'a super::file::Channel,
    times: Times,
    chunk_bytes: u64,
}

fn channel_rows<'a>(target: &'a Target, times: &'a HashMap<u16, (u64, u64)>) -> impl Iterator<Item = Row<'a>> {
    target.file.channels.iter().map(|(id, channel)| {
        let size = |p: &Piece| p.range.end - p.range.start;
        let chunk_bytes = target.file.pieces.iter().filter(|p| p.has_channel(*id)).map(size).sum();
        Row { target, channel, times: times.get(id).copied(), chunk_bytes }
    })
}

fn channel_batch(rows: &[Row<'_>]) -> Result<RecordBatch, arrow::error::ArrowError> {
    fn text_column<'a>(rows: &'a [Row<'a>], of: impl Fn(&'a Row<'a>) -> Option<&'a str>) -> ArrayRef {
        Arc::new(rows.iter().map(of).collect::<StringArray>())
    }
    fn integer_column(rows: &[Row<'_>], of: impl Fn(&Row<'_>) -> Option<u64>) -> ArrayRef {
        Arc::new(rows.iter().map(|r| of(r).and_then(|n| i64::try_from(n).ok())).collect::<Int64Array>())
    }
    fn time_column(rows: &[Row<'_>], of: impl Fn((u64, u64)) -> u64) -> ArrayRef {
        let nanos = |r: &Row<'_>| r.times.and_then(|times| i64::try_from(of(times)).ok());
        Arc::new(rows.iter().map(nanos).collect::<TimestampNanosecondArray>().with_timezone(UTC))
    }
    let named = |name: &str, kind, nullable| Field::new(name, kind, nullable);
    let schema = Schema::new(vec![
        Head::Surface.column_field(),
        Head::Run.column_field(),
        named("file", DataType::Utf8, false),
        named("topic", DataType::Utf8, false),
        named("schema_name", DataType::Utf8, false),
        named("schema_encoding", DataType::Utf8, false),
        named("message_encoding", DataType::Utf8, false),
        named("messages", DataType::Int64, true),
        named("first_time", time_type(), true),
        named("last_time", time_type(), true),
        named("chunk_bytes", DataType::Int64, true),
        named("file_bytes", DataType::Int64, true),
        named("indexed", DataType::Boolean, false),
        named("read_by", DataType::Utf8, false),
    ]);
    let indexed: Vec<bool> = rows.iter().map(|r| r.target.file.walked.is_none()).collect();
    let read_by = |r: &Row<'_>| match &r.target.file.walked {
        Some(reason) => escape_controls(&format!("walk: {reason}")),
        None => "summary".to_owned(),
    };
    let read_by: Vec<String> = rows.iter().map(read_by).collect();
    let columns: Vec<ArrayRef> = vec![
        text_column(rows, |r| r.target.run.as_ref().map(|(surface, _)| surface.as_str())),
        text_column(rows, |r| r.target.run.as_ref().map(|(_, run)| run.as_str())),
        text_column(rows, |r| Some(r.target.file.path.as_ref())),
        text_column(rows, |r| Some(&r.channel.topic)),
        text_column(rows, |r| Some(&r.channel.schema.name)),
        text_column(rows, |r| Some(&r.channel.schema.encoding)),
        text_column(rows, |r| Some(&r.channel.schema.messages)),
        integer_column(rows, |r| r.channel.messages),
        time_column(rows, |times| times.0),
        time_column(rows, |times| times.1),
        integer_column(rows, |r| Some(r.chunk_bytes)),
        integer_column(rows, |r| Some(r.target.file.bytes)),
        Arc::new(BooleanArray::from(indexed)),
        Arc::new(StringArray::from(read_by)),
    ];
    RecordBatch::try_new(Arc::new(schema), columns)
}

// Times of each channel's first and last message: from the message indexes behind the first and the last chunks that
// have it, and behind others only where their times overlap. Chunks without message indexes are read themselves.
async fn channel_times(file: &McapFile, files: &McapFiles) -> Result<HashMap<u16, (u64, u64)>, Fault> {
    let mut found = HashMap::new();
    let mut indexes = Indexes { file, files, read: HashMap::new() };
    for (id, channel) in &file.channels {
        if let Some(times) = channel.times {
            found.insert(*id, times);
        } else if channel.messages != Some(0)
            && let Some(times) = indexes.read_times(*id).await?
        {
            found.insert(*id, times);
        }
    }
    Ok(found)
}

struct Indexes<'a> {
    file: &'a McapFile,
    files: &'a McapFiles,
    /// First and last time of each channel, by the piece's offset.
    read: HashMap<u64, HashMap<u16, (u64, u64)>>,
}

impl Indexes<'_> {
    // Times of a channel's first and last message. Once the piece that begins first and the one that ends last are
    // read, most others lie between them.
    async fn read_times(&mut self, channel: u16) -> Result<Times, Fault> {
        let mut pieces: Vec<_> = self.file.pieces.iter().filter(|p| p.has_channel(channel)).collect();
        pieces.sort_by_key(|p| p.times.0);
        if let Some(latest) = (1..pieces.len()).max_by_key(|i| pieces[*i].times.1) {
            pieces[1..=latest].rotate_right(1);
        }
        let mut times: Times = None;
        for piece in pieces {
            if times.is_some_and(|(first, last)| first <= piece.times.0 && piece.times.1 <= last) {
                continue;
            }
            if let Some((first, last)) = self.piece_times(piece, channel).await? {
                times = Some(times.map_or((first, last), |times| (times.0.min(first), times.1.max(last))));
            }
        }
        Ok(times)
    }

    // None if the channel has no messages in the piece.
    async fn piece_times(&mut self, piece: &Piece, channel: u16) -> Result<Times, Fault> {
        let place = piece.range.start;
        if !self.read.contains_key(&place) {
            let path = &self.file.path;
            let times = if (1..=LARGEST_INDEX).contains(&piece.index) {
                let index = piece.range.end..piece.range.end + piece.index;
                index_times(self.files.read_range(path, index).await?)
            } else {
                let chunk = self.files.read_range(path, piece.range.clone()).await?;
                chunk_times(chunk).map_err(|what| Fault::damaged(path, place, what))?
            };
            self.read.insert(place, times);
        }
        Ok(self.read.get(&place).and_then(|times| times.get(&channel).copied()))
    }
}

fn chunk_times(chunk: Bytes) -> Result<HashMap<u16, (u64, u64)>, String> {
    let mut times = HashMap::new();
    let mut records = PieceRecords::new(chunk, PieceKind::Chunk)?;
    while let Some(record) = records.next_record()? {
        if let Record::Message { header, .. } = record {
            let (first, last) = times.entry(header.channel_id).or_insert((header.log_time, header.log_time));
            *first = header.log_time.min(*first);
            *last = header.log_time.max(*last);
        }
    }
    Ok(times)
}

fn index_times(bytes: Bytes) -> HashMap<u16, (u64, u64)> {
    let mut times = HashMap::new();
    let mut records = RecordCursor::new(bytes);
    while let Ok(Some(record)) = records.next_record() {
        if let Record::MessageIndex(index) = record {
            let all = || index.records.iter().map(|entry| entry.log_time);
            if let (Some(first), Some(last)) = (all().min(), all().max()) {
                times.insert(index.channel_id, (first, last));
            }
        }
    }
    times
}
