//! Scans of run files as they are sent to workers: which files, which of their pieces, and what of the messages. A
//! worker reads the summaries of the files by itself, and caches them. What comes is checked before it is used, because
//! whoever knows the workers' token may send anything.

use std::fmt;
use std::ops::RangeInclusive;
use std::sync::Arc;

use arrow::datatypes::SchemaRef;
use arrow::ipc::reader::StreamReader;
use arrow::ipc::writer::StreamWriter;
use datafusion::common::tree_node::TreeNodeRecursion;
use datafusion::error::{DataFusionError, Result};
use datafusion::execution::{SendableRecordBatchStream, TaskContext};
use datafusion::physical_expr::PhysicalExpr;
use datafusion::physical_plan::metrics::{ExecutionPlanMetricsSet, MetricsSet};
use datafusion::physical_plan::stream::RecordBatchStreamAdapter;
use datafusion::physical_plan::{DisplayAs, DisplayFormatType, ExecutionPlan, PlanProperties, ReplaceChildrenOptions};
use futures::{StreamExt as _, TryStreamExt as _, stream};
use prost::Message;
use tokio::sync::OnceCell;

use super::error::Fault;
use super::file::McapFiles;
use super::scan::{McapExec, Scan, ScanPiece, Source, leaf_plan_methods, plan_properties};
use super::table::{McapTable, decoded_table, message_table};
use super::target::{Target, parse_path};

/// Files that a partition opens at once.
const OPENED_AT_ONCE: usize = 16;

/// Encodes a scan of run files; None if the node is none.
///
/// # Errors
/// [`DataFusionError::ArrowError`] if its columns cannot be written.
pub fn encode_mcap_scan(node: &dyn ExecutionPlan) -> Result<Option<Vec<u8>>> {
    node.downcast_ref::<McapExec>().map(|scan| Ok(ScanMessage::from_plan(scan)?.encode_to_vec())).transpose()
}

/// Decodes a scan, which opens its `files` once it runs.
///
/// # Errors
/// [`DataFusionError::Plan`] if the bytes are no scan of run files of a lake.
pub fn decode_mcap_scan(bytes: &[u8], files: &Arc<McapFiles>) -> Result<Arc<dyn ExecutionPlan>> {
    let message = ScanMessage::decode(bytes).map_err(|e| not_sent(&e.to_string()))?;
    let schema = StreamReader::try_new(message.schema.as_slice(), None)?.schema();
    if message.projection.len() != schema.fields().len() {
        return Err(not_sent("its columns are not those of its schema"));
    }
    for file in &message.files {
        parse_path(&file.path)?;
    }
    let properties = plan_properties(&schema, message.partitions.len());
    Ok(Arc::new(SentScan {
        message: Arc::new(message),
        files: files.clone(),
        table: Arc::default(),
        schema,
        properties,
        metrics: ExecutionPlanMetricsSet::new(),
    }))
}

fn not_sent(what: &str) -> DataFusionError {
    DataFusionError::Plan(format!("the scan of run files is not as engines send it: {what}"))
}

#[derive(Clone, PartialEq, Message)]
struct ScanMessage {
    /// None for all topics.
    #[prost(string, optional, tag = "1")]
    topic: Option<String>,
    /// Messages as they are, without columns of their own.
    #[prost(bool, tag = "2")]
    is_raw: bool,
    /// All files of the table, because its columns are those of all.
    #[prost(message, repeated, tag = "3")]
    files: Vec<FileMessage>,
    /// The columns that are asked for, as Arrow's stream format has them.
    #[prost(bytes = "vec", tag = "4")]
    schema: Vec<u8>,
    #[prost(uint64, repeated, tag = "5")]
    projection: Vec<u64>,
    /// First and last time of messages, ns; empty for all.
    #[prost(sint64, repeated, tag = "6")]
    times: Vec<i64>,
    #[prost(uint64, optional, tag = "7")]
    limit: Option<u64>,
    #[prost(message, repeated, tag = "8")]
    partitions: Vec<PartitionMessage>,
}

#[derive(Clone, PartialEq, Message)]
struct FileMessage {
    #[prost(string, tag = "1")]
    path: String,
    #[prost(uint64, tag = "2")]
    bytes: u64,
    /// Surface and run; empty for a file that is no run.
    #[prost(string, repeated, tag = "3")]
    run: Vec<String>,
}

#[derive(Clone, PartialEq, Message)]
struct PartitionMessage {
    #[prost(message, repeated, tag = "1")]
    pieces: Vec<PieceMessage>,
}

/// A piece by its place.
#[derive(Clone, PartialEq, Message)]
struct PieceMessage {
    #[prost(uint64, tag = "1")]
    file: u64,
    #[prost(uint64, tag = "2")]
    start: u64,
    #[prost(uint64, tag = "3")]
    end: u64,
}

impl ScanMessage {
    fn from_plan(plan: &McapExec) -> Result<Self> {
        let scan = plan.scan();
        let mut schema = StreamWriter::try_new(Vec::new(), &scan.schema)?;
        schema.finish()?;
        let file = |source: &Source| FileMessage {
            path: source.file.path.to_string(),
            bytes: source.file.bytes,
            run: source.run.iter().flat_map(|(surface, run)| [surface.clone(), run.clone()]).collect(),
        };
        let piece = |piece: ScanPiece| PieceMessage {
            file: piece.source as u64,
            start: piece.piece.range.start,
            end: piece.piece.range.end,
        };
        let partition = |pieces: Vec<ScanPiece>| PartitionMessage { pieces: pieces.into_iter().map(piece).collect() };
        Ok(Self {
            topic: scan.parts.topic.clone(),
            is_raw: scan.parts.mappings.is_none(),
            files: scan.parts.sources.iter().map(file).collect(),
            schema: schema.into_inner()?,
            projection: scan.projection.iter().map(|place| *place as u64).collect(),
            times: scan.times.iter().flat_map(|times| [*times.start(), *times.end()]).collect(),
            limit: scan.limit.map(|limit| limit as u64),
            partitions: plan.partition_pieces().into_iter().map(partition).collect(),
        })
    }

    // The table of the same files.
    async fn open_table(&self, files: &Arc<McapFiles>, schema: &SchemaRef) -> Result<McapTable> {
        let open = |file: &FileMessage| {
            let file = file.clone();
            async move { file.open_target(files).await }
        };
        let targets: Vec<_> = stream::iter(self.files.iter().map(open)).buffered(OPENED_AT_ONCE).try_collect().await?;
        let topic = self.topic.as_deref();
        let table = match topic.filter(|_| !self.is_raw) {
            Some(topic) => decoded_table(targets, topic, files)?,
            None => message_table(targets, topic, files)?,
        };
        match table.schema.project(&self.column_places()).is_ok_and(|own| own == **schema) {
            true => Ok(table),
            false => Err(not_sent("the files have other columns")),
        }
    }

    fn column_places(&self) -> Vec<usize> {
        self.projection.iter().map(|place| *place as usize).collect()
    }

    // The scan of a partition's pieces.
    fn plan_partition(&self, partition: usize, table: &McapTable, schema: &SchemaRef) -> Result<McapExec> {
        let sent = self.partitions.get(partition).map(|partition| partition.pieces.as_slice()).unwrap_or_default();
        let find = |sent: &PieceMessage| {
            let source = sent.file as usize;
            let pieces = &table.parts.sources.get(source)?.file.pieces;
            let place = pieces.binary_search_by_key(&sent.start, |piece| piece.range.start).ok()?;
            let piece = pieces.get(place).filter(|piece| piece.range.end == sent.end)?;
            Some(ScanPiece { source, piece: piece.clone() })
        };
        let pieces: Option<Vec<_>> = sent.iter().map(find).collect();
        let pieces = pieces.ok_or_else(|| not_sent("the files have no such pieces"))?;
        let times = match self.times.as_slice() {
            [] => None,
            [first, last] => Some(RangeInclusive::new(*first, *last)),
            _ => return Err(not_sent("its times are no range")),
        };
        let limit = self.limit.map(|limit| limit as usize);
        let projection = self.column_places();
        let scan = Scan { parts: table.parts.clone(), projection, schema: schema.clone(), times, limit };
        Ok(McapExec::from_partitions(Arc::new(scan), vec![pieces]))
    }
}

impl FileMessage {
    async fn open_target(self, files: &McapFiles) -> Result<Target, Fault> {
        let path = parse_path(&self.path)?;
        let run = match <[String; 2]>::try_from(self.run) {
            Ok([surface, run]) => Some((surface, run)),
            Err(_) => None,
        };
        // A run's file never changes, so that a store need not be asked for it.
        let known = (run.is_some() && !files.are_in_folder()).then_some(self.bytes);
        let file = files.open_file(&path, known).await?;
        match file.bytes == self.bytes {
            true => Ok(Target { run, file }),
            false => {
                let what = format!("it has {} bytes, and had {} when the query was planned", file.bytes, self.bytes);
                Err(Fault::damaged(&path, self.bytes.min(file.bytes), what))
            }
        }
    }
}

/// A scan on a worker, whose files are opened once it runs.
#[derive(Debug)]
struct SentScan {
    message: Arc<ScanMessage>,
    files: Arc<McapFiles>,
    /// Opened by the partition that runs first.
    table: Arc<OnceCell<McapTable>>,
    schema: SchemaRef,
    properties: Arc<PlanProperties>,
    metrics: ExecutionPlanMetricsSet,
}

impl DisplayAs for SentScan {
    fn fmt_as(&self, _: DisplayFormatType, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let pieces: usize = self.message.partitions.iter().map(|partition| partition.pieces.len()).sum();
        write!(f, "McapExec: topic={:?}, files={}, chunks={pieces}", self.message.topic, self.message.files.len())
    }
}

impl ExecutionPlan for SentScan {
    leaf_plan_methods!();

    fn execute(&self, partition: usize, context: Arc<TaskContext>) -> Result<SendableRecordBatchStream> {
        let (message, files, schema) = (self.message.clone(), self.files.clone(), self.schema.clone());
        let (table, metrics) = (self.table.clone(), self.metrics.clone());
        let batches = async move {
            let table = table.get_or_try_init(|| message.open_table(&files, &schema)).await?;
            message.plan_partition(partition, table, &schema)?.with_metrics(metrics).execute(0, context)
        };
        let batches = stream::once(batches).try_flatten();
        Ok(Box::pin(RecordBatchStreamAdapter::new(self.schema.clone(), batches)))
    }
}
