//! A run's file in the lake: that it is the one that was ingested, its summary, and parts of it by range.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use arrow::datatypes::Int64Type;
use bytes::Bytes;
use echolake_lake::{Lake, LakeSnapshot};
use echolake_recording::{
    Attachment, Channel, ChunkIndex, DecodedChunk, DefinitionDigests, McapError, Record, RecordCursor, RecordError,
    RunSummary, chunk_body, describe_mcap_error, summary_range, tail_range,
};
use echolake_schema::tables::Table;
use echolake_schema::{ErrorCause, RunId, SurfaceId, topics};
use object_store::path::Path;
use object_store::{GetOptions, ObjectStore, ObjectStoreExt as _};
use sha2::{Digest as _, Sha256};

use super::Check;
use crate::error::{Error, Result};
use crate::rows;

/// What is read at a time of a file whose checksum is taken.
const BLOCK: u64 = 4 << 20;
/// What the lake says of a run's file.
#[derive(Debug, Clone)]
pub(super) struct RunFile {
    pub run: RunId,
    pub surface: SurfaceId,
    pub path: Path,
    pub bytes: u64,
    pub sha256: String,
    pub started_ns: u64,
}

/// A run's file, opened.
pub(super) struct Source {
    pub file: RunFile,
    store: Arc<dyn ObjectStore>,
    pub channels: BTreeMap<u16, Arc<Channel<'static>>>,
    digests: DefinitionDigests,
    /// In the file's order.
    pub chunks: Vec<ChunkIndex>,
    attachments: Vec<Range<u64>>,
    /// The run's manifest.
    pub manifest: BTreeMap<String, String>,
}

/// A message, its samples still where the chunk has them.
#[derive(Debug, Clone)]
pub(super) struct Message {
    pub channel: Arc<Channel<'static>>,
    pub log_time: u64,
    pub publish_time: u64,
    pub data: Bytes,
}

impl RunFile {
    /// Looks a run up.
    pub async fn find_run(lake: &Lake, snapshot: &LakeSnapshot, run: &RunId) -> Result<Self> {
        let columns = ["surface_id", "run_id", "started_ns", "file", "file_bytes", "file_sha256"];
        let row = rows::of_run(lake, snapshot, Table::Runs, run, &columns).await?;
        let text = |column| rows::text_column(&row, column).first().map(|text| (*text).to_owned());
        let (Some(path), Some(sha256)) = (text("file"), text("file_sha256")) else {
            return Err(Error::Unknown { kind: "run", name: run.to_string(), known: "those of table runs".into() });
        };
        let number = |column| rows::number_column::<Int64Type>(&row, column).map(|n| u64::try_from(n[0]).unwrap_or(0));
        let bytes = number("file_bytes")?;
        let started_ns = number("started_ns")?;
        let surface = text("surface_id").unwrap_or_default().parse()?;
        Ok(Self { run: run.clone(), surface, path: Path::from(path), bytes, sha256, started_ns })
    }

    // A store that is away says nothing of the file.
    fn read_error(&self, fault: object_store::Error) -> Error {
        echolake_lake::Error::from_unanswered(&self.path, fault)
            .map_or_else(|fault| self.changed_error(fault), Error::from)
    }

    fn changed_error(&self, source: impl Into<ErrorCause>) -> Error {
        Error::Changed { run: self.run.clone(), file: self.path.to_string(), source: source.into() }
    }
}

impl Source {
    /// Opens a run's file and checks that it is the one that was ingested.
    pub async fn open(store: Arc<dyn ObjectStore>, file: RunFile, check: Check) -> Result<Self> {
        let tail = read_tail(store.as_ref(), &file).await?;
        let mut source = Self {
            file,
            store,
            channels: BTreeMap::new(),
            digests: DefinitionDigests::default(),
            chunks: Vec::new(),
            attachments: Vec::new(),
            manifest: BTreeMap::new(),
        };
        if check == Check::Whole {
            source.check_hash().await?;
        }
        source.read_summary(&tail).await?;
        Ok(source)
    }

    async fn check_hash(&self) -> Result<()> {
        let mut sha = Sha256::new();
        for start in (0..self.file.bytes).step_by(BLOCK as usize) {
            sha.update(self.read_range(start..(start + BLOCK).min(self.file.bytes)).await?);
        }
        let actual = hex::encode(sha.finalize());
        if actual == self.file.sha256 {
            Ok(())
        } else {
            Err(self.file.changed_error(format!("its SHA-256 is {actual}, expected {}", self.file.sha256)))
        }
    }

    async fn read_range(&self, range: Range<u64>) -> Result<Bytes> {
        self.store.get_range(&self.file.path, range).await.map_err(|e| self.file.read_error(e))
    }

    async fn read_summary(&mut self, tail: &Bytes) -> Result<()> {
        let bytes = self.file.bytes;
        let Some(range) = summary_range(tail, bytes) else {
            let reason = "its file has no index, because it was cut off while it was recorded".to_owned();
            return Err(Error::Uncuttable { run: self.file.run.clone(), reason });
        };
        let from_end = (bytes - range.start) as usize;
        let summary = match tail.len().checked_sub(from_end) {
            Some(start) => tail.slice(start..),
            None => self.read_range(range).await?,
        };
        let summary = RunSummary::parse(&summary).map_err(|e| self.damaged_error(&e))?;
        self.channels = summary.channels;
        self.digests = summary.digests;
        self.chunks = summary.chunk_indexes;
        self.chunks.sort_by_key(|chunk| chunk.chunk_start_offset);
        self.attachments =
            summary.attachment_indexes.iter().map(|a| a.offset..a.offset.saturating_add(a.length)).collect();
        let manifest = summary.metadata_indexes.iter().find(|m| m.name == topics::RUN_METADATA);
        if let Some(index) = manifest {
            let record = self.read_range(index.offset..index.offset.saturating_add(index.length)).await?;
            if let Ok(Some(Record::Metadata(found))) = RecordCursor::new(record).next_record() {
                self.manifest = found.metadata;
            }
        }
        match self.manifest.get("run_id").map(String::as_str) {
            Some(run) if run == self.file.run.as_str() => Ok(()),
            found => Err(self.file.changed_error(format!("it is of run {}", found.unwrap_or("that has no name")))),
        }
    }

    pub fn damaged_error(&self, error: &McapError) -> Error {
        Error::damaged(&self.file.path, describe_mcap_error(error))
    }

    fn damaged_record(&self, error: RecordError) -> Error {
        Error::damaged(&self.file.path, error)
    }

    /// What is attached to the file, one at a time.
    pub async fn read_attachment(&self, number: usize) -> Result<Option<Attachment<'static>>> {
        let Some(range) = self.attachments.get(number) else { return Ok(None) };
        let record = self.read_range(range.clone()).await?;
        let mut record = RecordCursor::new(record);
        match record.next_record().map_err(|e| self.damaged_record(e))? {
            Some(Record::Attachment { header, data, .. }) => Ok(Some(Attachment {
                log_time: header.log_time,
                create_time: header.create_time,
                name: header.name,
                media_type: header.media_type,
                data: data.into_owned().into(),
            })),
            _ => Err(Error::damaged(&self.file.path, "there is no attachment where its index says")),
        }
    }

    /// All messages of a chunk, in the file's order; its CRC is checked before the first is given out.
    pub async fn read_messages(&self, chunk: &ChunkIndex) -> Result<Vec<Message>> {
        let record = self
            .read_range(chunk.chunk_start_offset..chunk.chunk_start_offset.saturating_add(chunk.chunk_length))
            .await?;
        let chunk_damaged = |what: String| Error::damaged(&self.file.path, what);
        let body = chunk_body(&record).map_err(chunk_damaged)?;
        let decoded = DecodedChunk::decode(&body).map_err(|e| chunk_damaged(format!("a chunk is damaged: {e}")))?;
        let mut records = decoded.into_cursor();
        let mut messages = Vec::new();
        while let Some(record) = records.next_record().map_err(|e| self.damaged_record(e))? {
            self.digests.check_definition(&record).map_err(chunk_damaged)?;
            let Record::Message { header, data } = record else { continue };
            let channel = self.channels.get(&header.channel_id).cloned();
            let channel =
                channel.ok_or_else(|| chunk_damaged(format!("no channel {} in its index", header.channel_id)))?;
            messages.push(Message {
                channel,
                log_time: header.log_time,
                publish_time: header.publish_time,
                data: Bytes::copy_from_slice(&data),
            });
        }
        Ok(messages)
    }
}

// The answer to the first read tells the file's size, so that the store need not be asked for it.
async fn read_tail(store: &dyn ObjectStore, file: &RunFile) -> Result<Bytes> {
    let found = store.get_opts(&file.path, GetOptions::new().with_range(Some(tail_range(file.bytes)))).await;
    let (size, tail) = match found {
        Ok(found) => (found.meta.size, found.bytes().await.map_err(|e| file.read_error(e))?),
        Err(object_store::Error::NotFound { .. }) => return Err(file.changed_error("it is not there; was it moved?")),
        // A shorter file has no such range.
        Err(error) => match store.head(&file.path).await {
            Ok(meta) if meta.size != file.bytes => (meta.size, Bytes::new()),
            _ => return Err(file.read_error(error)),
        },
    };
    if size == file.bytes {
        Ok(tail)
    } else {
        Err(file.changed_error(format!("it has {size} bytes, expected {}", file.bytes)))
    }
}
