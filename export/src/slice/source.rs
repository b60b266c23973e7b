//! A run's file in the lake: that it is the one that was ingested, its summary, and parts of it by range.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use arrow::datatypes::Int64Type;
use bytes::Bytes;
use echolake_lake::{Lake, LakeSnapshot};
use echolake_schema::tables::Table;
use echolake_schema::{RunId, SurfaceId, topics};
use mcap::records::{ChunkIndex, Record};
use mcap::sans_io::{
    LinearReadEvent, LinearReader, LinearReaderOptions, SummaryReadEvent, SummaryReader, SummaryReaderOptions,
};
use mcap::{Attachment, Channel, McapError};
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _};
use sha2::{Digest as _, Sha256};

use super::Check;
use crate::error::{Error, Result};
use crate::rows;

/// Opcode and length in front of every record.
const FRAME: usize = 9;
/// What is read of a file's end at first: summaries of most runs fit.
const TAIL: u64 = 1 << 20;
/// What is read at a time of a file whose checksum is taken.
const BLOCK: u64 = 4 << 20;
/// Largest record that is read, as everywhere.
const LARGEST: usize = 256 << 20;

/// What the lake says of a run's file.
#[derive(Debug, Clone)]
pub(super) struct RunFile {
    pub(super) run: RunId,
    pub(super) surface: SurfaceId,
    pub(super) path: Path,
    pub(super) bytes: u64,
    pub(super) sha256: String,
    pub(super) started_ns: u64,
}

/// A run's file, opened.
pub(super) struct Source {
    pub(super) file: RunFile,
    store: Arc<dyn ObjectStore>,
    pub(super) channels: BTreeMap<u16, Arc<Channel<'static>>>,
    /// In the file's order.
    pub(super) chunks: Vec<ChunkIndex>,
    attachments: Vec<Range<u64>>,
    /// The run's manifest.
    pub(super) manifest: BTreeMap<String, String>,
}

/// A message, its samples still where the chunk has them.
#[derive(Debug, Clone)]
pub(super) struct Message {
    pub(super) channel: Arc<Channel<'static>>,
    pub(super) log_time: u64,
    pub(super) publish_time: u64,
    pub(super) data: Bytes,
}

impl RunFile {
    /// Looks a run up.
    pub(super) async fn find(lake: &Lake, snapshot: &LakeSnapshot, run: &RunId) -> Result<Self> {
        let columns = ["surface_id", "run_id", "started_ns", "file", "file_bytes", "file_sha256"];
        let row = rows::of_run(lake, snapshot, Table::Runs, run, &columns).await?;
        let text = |column| rows::texts(&row, column).first().map(|text| (*text).to_owned());
        let (Some(path), Some(sha256)) = (text("file"), text("file_sha256")) else {
            return Err(Error::Unknown { kind: "run", name: run.to_string(), known: "those of table runs".into() });
        };
        let number = |column| rows::numbers::<Int64Type>(&row, column).map(|n| u64::try_from(n[0]).unwrap_or(0));
        let (bytes, started_ns) = (number("file_bytes")?, number("started_ns")?);
        let surface = text("surface_id").unwrap_or_default().parse()?;
        Ok(Self { run: run.clone(), surface, path: Path::from(path), bytes, sha256, started_ns })
    }

    fn changed(&self, reason: impl ToString) -> Error {
        Error::Changed { run: self.run.clone(), file: self.path.to_string(), reason: reason.to_string() }
    }
}

impl Source {
    /// Opens a run's file and checks that it is the one that was ingested.
    pub(super) async fn open(store: Arc<dyn ObjectStore>, file: RunFile, check: Check) -> Result<Self> {
        let meta = store.head(&file.path).await.map_err(|e| match e {
            object_store::Error::NotFound { .. } => file.changed("it is not there; was it moved?"),
            other => file.changed(other),
        })?;
        if meta.size != file.bytes {
            return Err(file.changed(format!("it has {} bytes, expected {}", meta.size, file.bytes)));
        }
        let mut source = Self {
            file,
            store,
            channels: BTreeMap::new(),
            chunks: Vec::new(),
            attachments: Vec::new(),
            manifest: BTreeMap::new(),
        };
        if check == Check::Whole {
            source.hash().await?;
        }
        source.read_summary().await?;
        Ok(source)
    }

    async fn hash(&self) -> Result<()> {
        let mut sha = Sha256::new();
        for start in (0..self.file.bytes).step_by(BLOCK as usize) {
            sha.update(self.read(start..(start + BLOCK).min(self.file.bytes)).await?);
        }
        let actual = hex::encode(sha.finalize());
        match actual == self.file.sha256 {
            true => Ok(()),
            false => Err(self.file.changed(format!("its SHA-256 is {actual}, expected {}", self.file.sha256))),
        }
    }

    async fn read(&self, range: Range<u64>) -> Result<Bytes> {
        self.store.get_range(&self.file.path, range).await.map_err(|e| self.file.changed(e))
    }

    async fn read_summary(&mut self) -> Result<()> {
        let bytes = self.file.bytes;
        let options = SummaryReaderOptions::default().with_file_size(bytes).with_record_length_limit(LARGEST);
        let mut reader = SummaryReader::new_with_options(options);
        let (mut at, tail_start) = (0u64, bytes.saturating_sub(TAIL));
        let tail = self.read(tail_start..bytes).await?;
        while let Some(event) = reader.next_event() {
            match event.map_err(|e| self.damaged(&e))? {
                SummaryReadEvent::SeekRequest(to) => {
                    at = match to {
                        std::io::SeekFrom::Start(to) => to,
                        std::io::SeekFrom::End(by) => bytes.saturating_add_signed(by),
                        std::io::SeekFrom::Current(by) => at.saturating_add_signed(by),
                    };
                    reader.notify_seeked(at);
                }
                SummaryReadEvent::ReadRequest(count) => {
                    let end = (at + count as u64).min(bytes);
                    let part = match at.checked_sub(tail_start) {
                        Some(from) => tail.slice(from as usize..(end - tail_start) as usize),
                        None => self.read(at..end).await?,
                    };
                    reader.insert(part.len()).copy_from_slice(&part);
                    reader.notify_read(part.len());
                    at = end;
                }
            }
        }
        let Some(summary) = reader.finish() else {
            let reason = "its file has no index, because it was cut off while it was recorded".to_owned();
            return Err(Error::Uncuttable { run: self.file.run.clone(), reason });
        };
        self.channels = summary.channels.into_iter().collect();
        self.chunks = summary.chunk_indexes;
        self.chunks.sort_by_key(|chunk| chunk.chunk_start_offset);
        self.attachments =
            summary.attachment_indexes.iter().map(|a| a.offset..a.offset.saturating_add(a.length)).collect();
        let manifest = summary.metadata_indexes.iter().find(|m| m.name == topics::RUN_METADATA);
        if let Some(index) = manifest {
            let record = self.read(index.offset..index.offset.saturating_add(index.length)).await?;
            if let Ok(Record::Metadata(found)) = parse(&record) {
                self.manifest = found.metadata;
            }
        }
        match self.manifest.get("run_id").map(String::as_str) {
            Some(run) if run == self.file.run.as_str() => Ok(()),
            found => Err(self.file.changed(format!("it is of run {}", found.unwrap_or("that has no name")))),
        }
    }

    pub(super) fn damaged(&self, error: &McapError) -> Error {
        let cause = std::error::Error::source(error).map(|cause| format!(": {cause}")).unwrap_or_default();
        Error::damaged(&self.file.path, format!("{error}{cause}"))
    }

    /// What is attached to the file, one at a time.
    pub(super) async fn attachment(&self, number: usize) -> Result<Option<Attachment<'static>>> {
        let Some(range) = self.attachments.get(number) else { return Ok(None) };
        let record = self.read(range.clone()).await?;
        match parse(&record).map_err(|e| self.damaged(&e))?.into_owned() {
            Record::Attachment { header, data, .. } => Ok(Some(Attachment {
                log_time: header.log_time,
                create_time: header.create_time,
                name: header.name,
                media_type: header.media_type,
                data,
            })),
            _ => Err(Error::damaged(&self.file.path, "there is no attachment where its index says")),
        }
    }

    /// All messages of a chunk, in the file's order; its CRC is checked before the first is given out.
    pub(super) async fn messages(&self, chunk: &ChunkIndex) -> Result<Vec<Message>> {
        let record =
            self.read(chunk.chunk_start_offset..chunk.chunk_start_offset.saturating_add(chunk.chunk_length)).await?;
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(true)
            .with_record_length_limit(LARGEST);
        let mut reader = LinearReader::new_with_options(options);
        let (mut given, mut messages) = (0, Vec::new());
        while let Some(event) = reader.next_event() {
            match event.map_err(|e| self.damaged(&e))? {
                LinearReadEvent::ReadRequest(_) if given == record.len() => break,
                LinearReadEvent::ReadRequest(_) => {
                    reader.insert(record.len()).copy_from_slice(&record);
                    reader.notify_read(record.len());
                    given = record.len();
                }
                LinearReadEvent::Record { opcode, data } => {
                    if opcode != mcap::records::op::MESSAGE {
                        continue;
                    }
                    let Record::Message { header, data } =
                        mcap::parse_record(opcode, data).map_err(|e| self.damaged(&e))?
                    else {
                        continue;
                    };
                    let channel = self.channels.get(&header.channel_id).cloned().ok_or_else(|| {
                        Error::damaged(&self.file.path, format!("no channel {} in its index", header.channel_id))
                    })?;
                    messages.push(Message {
                        channel,
                        log_time: header.log_time,
                        publish_time: header.publish_time,
                        data: Bytes::copy_from_slice(&data),
                    });
                }
            }
        }
        Ok(messages)
    }
}

fn parse(record: &[u8]) -> mcap::McapResult<Record<'_>> {
    match record.split_at_checked(FRAME) {
        Some((frame, body)) => mcap::parse_record(frame[0], body),
        None => Err(McapError::UnexpectedEof),
    }
}
