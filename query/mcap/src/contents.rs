//! What a run's file holds: topics with their sizes, attachments, and an attachment's bytes.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use datafusion::error::Result;
use echolake_lake::{Lake, LakeSnapshot, VisibleRun};
use echolake_recording::limits::LARGEST_CHUNK;
use echolake_recording::{FRAME_BYTES, Record, RecordCursor, opcode, parse_record};
use futures::{StreamExt as _, TryStreamExt as _};

use super::error::Fault;
use super::file::{Attachment, McapFile, McapFiles};
use super::piece::Piece;

/// Message indexes that are read at once.
const AT_ONCE: usize = 16;
/// Of files with more bytes of message indexes than this, sizes are not told.
const MOST_INDEXES: u64 = 64 << 20;

/// A topic of a run's file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topic {
    /// Its name.
    pub topic: String,
    /// Name of its schema.
    pub schema: String,
    /// How its messages are written.
    pub encoding: String,
    /// How many there are, where that is known.
    pub messages: Option<u64>,
    /// Their bytes before compression, where the file tells.
    pub bytes: Option<u64>,
}

/// What a run's file holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Contents {
    /// Its topics, the largest first.
    pub topics: Vec<Topic>,
    /// Its attachments.
    pub attachments: Vec<Attachment>,
}

/// What the file of a run holds.
///
/// # Errors
/// If the file cannot be read.
pub async fn read_contents(run: &VisibleRun, snapshot: &LakeSnapshot, files: &McapFiles) -> Result<Contents> {
    let file = open_run(run, snapshot, files).await?;
    let bytes = channel_sizes(&file, files).await?;
    let topic = |(id, channel): (&u16, &super::file::Channel)| Topic {
        topic: channel.topic.clone(),
        schema: channel.schema.name.clone(),
        encoding: channel.schema.messages.clone(),
        messages: channel.messages,
        bytes: bytes.as_ref().map(|bytes| bytes.get(id).copied().unwrap_or(0)),
    };
    let mut topics: Vec<_> = file.channels.iter().map(topic).collect();
    topics.sort_by(|a, b| b.bytes.cmp(&a.bytes).then_with(|| a.topic.cmp(&b.topic)));
    Ok(Contents { topics, attachments: file.attachments.clone() })
}

/// The bytes of the first attachment whose name ends so.
///
/// # Errors
/// As [`read_contents`].
pub async fn read_attachment(
    run: &VisibleRun,
    snapshot: &LakeSnapshot,
    ending: &str,
    files: &McapFiles,
) -> Result<Option<Bytes>> {
    let file = open_run(run, snapshot, files).await?;
    let Some(found) = file.attachments.iter().find(|a| a.name.ends_with(ending)) else { return Ok(None) };
    let range = found.range.clone();
    if range.end - range.start > LARGEST_CHUNK {
        return Err(Fault::damaged(&file.path, range.start, "its attachment is larger than is read").into());
    }
    let record = files.read_range(&file.path, range.clone()).await?;
    match record.get(FRAME_BYTES..).map(|body| parse_record(opcode::ATTACHMENT, body)) {
        Some(Ok(Record::Attachment { data, .. })) if record[0] == opcode::ATTACHMENT => {
            Ok(Some(data.into_owned().into()))
        }
        _ => {
            let what = "there is no sound attachment where its index says";
            Err(Fault::damaged(&file.path, range.start, what).into())
        }
    }
}

async fn open_run(run: &VisibleRun, snapshot: &LakeSnapshot, files: &McapFiles) -> Result<Arc<McapFile>, Fault> {
    let path = Lake::run_path(&run.surface, &run.run);
    files.open_file(&path, files.known_sizes(snapshot).await.get(&path).copied()).await
}

// Bytes by channel; None where the file does not tell.
async fn channel_sizes(file: &McapFile, files: &McapFiles) -> Result<Option<HashMap<u16, u64>>, Fault> {
    let told = file.walked.is_none() && file.pieces.iter().all(|p| p.index > 0);
    if !told || file.pieces.iter().map(|p| p.index).sum::<u64>() > MOST_INDEXES {
        return Ok(None);
    }
    let read = |piece: &Piece| {
        let range = piece.range.end..piece.range.end + piece.index;
        let plain = piece.plain;
        async move { Ok::<_, Fault>((files.read_range(&file.path, range).await?, plain)) }
    };
    let reads: Vec<_> = file.pieces.iter().map(read).collect();
    let mut reads = futures::stream::iter(reads).buffer_unordered(AT_ONCE);
    let mut sizes = HashMap::new();
    while let Some((bytes, plain)) = reads.try_next().await? {
        add_sizes(bytes, plain, &mut sizes);
    }
    Ok(Some(sizes))
}

// A message goes to where the next one begins, the last one to the chunk's end.
fn add_sizes(index: Bytes, plain: u64, sizes: &mut HashMap<u16, u64>) {
    let mut begins = Vec::new();
    let mut records = RecordCursor::new(index);
    while let Ok(Some(record)) = records.next_record() {
        if let Record::MessageIndex(index) = record {
            begins.extend(index.records.iter().map(|entry| (entry.offset, index.channel_id)));
        }
    }
    begins.sort_unstable();
    for (i, (begin, channel)) in begins.iter().enumerate() {
        let end = begins.get(i + 1).map_or(plain, |next| next.0);
        *sizes.entry(*channel).or_insert(0) += end.saturating_sub(*begin);
    }
}
