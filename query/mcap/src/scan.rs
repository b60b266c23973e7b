//! The scan of a topic: reads the pieces that have it, side by side, and decodes what is asked for.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::ops::{Range, RangeInclusive};
use std::sync::Arc;

use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use bytes::Bytes;
use datafusion::common::tree_node::TreeNodeRecursion;
use datafusion::error::Result;
use datafusion::execution::memory_pool::{MemoryConsumer, MemoryReservation};
use datafusion::execution::{SendableRecordBatchStream, TaskContext};
use datafusion::physical_expr::{EquivalenceProperties, PhysicalExpr};
use datafusion::physical_plan::coop::make_cooperative;
use datafusion::physical_plan::execution_plan::{Boundedness, EmissionType, SchedulingType};
use datafusion::physical_plan::metrics::{BaselineMetrics, Count, ExecutionPlanMetricsSet, MetricBuilder, MetricsSet};
use datafusion::physical_plan::stream::RecordBatchStreamAdapter;
use datafusion::physical_plan::{
    DisplayAs, DisplayFormatType, ExecutionPlan, Partitioning, PlanProperties, ReplaceChildrenOptions,
};
use echolake_recording::Record;
use futures::stream::{self, BoxStream};
use futures::{StreamExt as _, TryStreamExt as _};

use super::error::Fault;
use super::file::{DiskFile, McapFile, McapFiles, undescribed_channel};
use super::piece::{Piece, PieceRecords};
use super::rows::{Head, Mapping, Message, Rows};

/// Reads from a store, where each is a request.
const STORE_READS: ReadSizes = ReadSizes { most: 4 << 20, gap: 128 << 10 };
/// Reads from a disk, which fit a core's cache.
const DISK_READS: ReadSizes = ReadSizes { most: 512 << 10, gap: 4 << 10 };
/// Requests under way while what another one fetched is decoded.
const AHEAD: usize = 2;

/// Limits of one read.
struct ReadSizes {
    /// Neighbouring pieces are read together up to this many bytes.
    most: u64,
    /// Most bytes between two pieces that are read with them.
    gap: u64,
}

/// What all partitions of all scans of a table share.
#[derive(Debug)]
pub(super) struct Parts {
    /// None for all topics.
    pub topic: Option<String>,
    pub files: Arc<McapFiles>,
    pub heads: Vec<Head>,
    pub sources: Vec<Source>,
    /// None in a table of messages as they are.
    pub mappings: Option<Vec<Mapping>>,
}

/// One file.
#[derive(Debug)]
pub(super) struct Source {
    pub run: Option<(String, String)>,
    pub file: Arc<McapFile>,
    /// The channels that are meant: topic, and which mapping they have.
    pub channels: BTreeMap<u16, (String, usize)>,
    /// By channel, whether the file describes it and it is not meant.
    skipped: Box<[bool]>,
}

impl Source {
    /// A file of which some channels are meant.
    pub fn new(run: Option<(String, String)>, file: Arc<McapFile>, channels: BTreeMap<u16, (String, usize)>) -> Self {
        let mut skipped = vec![false; file.channels.keys().next_back().map_or(0, |last| usize::from(*last) + 1)];
        file.channels.keys().for_each(|id| skipped[usize::from(*id)] = !channels.contains_key(id));
        Self { run, file, channels, skipped: skipped.into() }
    }

    fn is_skipped(&self, channel: u16) -> bool {
        self.skipped.get(usize::from(channel)).is_some_and(|is_skipped| *is_skipped)
    }

    /// Returns the pieces that may have messages of the channels in the time.
    pub fn pieces_within<'a>(&'a self, times: Option<&'a RangeInclusive<i64>>) -> impl Iterator<Item = &'a Piece> {
        let nanos = |time: u64| i64::try_from(time).unwrap_or(i64::MAX);
        let within = move |p: &&Piece| {
            times.is_none_or(|times| nanos(p.times.1) >= *times.start() && nanos(p.times.0) <= *times.end())
        };
        let meant = |p: &&Piece| self.channels.keys().any(|channel| p.has_channel(*channel));
        self.file.pieces.iter().filter(within).filter(meant)
    }
}

/// What a scan is asked for.
#[derive(Debug)]
pub(super) struct Scan {
    pub parts: Arc<Parts>,
    /// Columns that are asked for, by their place in the table.
    pub projection: Vec<usize>,
    /// The same as fields.
    pub schema: SchemaRef,
    /// Times of messages, ns; None if all are asked for, also those that have no such time.
    pub times: Option<RangeInclusive<i64>>,
    pub limit: Option<usize>,
}

/// The plan of a scan.
#[derive(Debug)]
pub struct McapExec {
    scan: Arc<Scan>,
    partitions: Vec<Vec<FileRead>>,
    properties: Arc<PlanProperties>,
    metrics: ExecutionPlanMetricsSet,
}

/// Bytes of one file that are fetched at once, and the pieces in them.
#[derive(Debug, Clone)]
struct FileRead {
    source: usize,
    range: Range<u64>,
    pieces: Vec<Piece>,
}

/// A piece of one of the files of a scan, which can be read on its own.
#[derive(Debug, Clone)]
pub struct ScanPiece {
    pub(super) source: usize,
    pub(super) piece: Piece,
}

impl ScanPiece {
    /// Returns the offset of its first byte in its file.
    pub fn start_offset(&self) -> u64 {
        self.piece.range.start
    }

    /// Returns its size in bytes.
    pub fn byte_count(&self) -> u64 {
        self.piece.range.end - self.piece.range.start
    }
}

impl McapExec {
    /// A plan that reads `pieces` in up to `most` partitions of about the same size.
    pub(super) fn new(scan: Scan, pieces: Vec<ScanPiece>, most: usize) -> Self {
        let bytes: u64 = pieces.iter().map(ScanPiece::byte_count).sum();
        let share = bytes.div_ceil(most.max(1) as u64).max(1);
        let mut partitions = vec![Vec::new()];
        let mut taken = 0;
        for piece in pieces {
            if taken >= share {
                partitions.push(Vec::new());
                taken = 0;
            }
            taken += piece.byte_count();
            if let Some(pieces) = partitions.last_mut() {
                pieces.push(piece);
            }
        }
        let plan = Self::from_partitions(Arc::new(scan), partitions);
        let read: usize = plan.partitions.iter().flatten().map(|read| read.pieces.len()).sum();
        MetricBuilder::new(&plan.metrics).global_counter("chunks_pruned").add(plan.count_pieces() - read);
        plan
    }

    // Pieces of all its files, also those that are not read.
    fn count_pieces(&self) -> usize {
        self.scan.parts.sources.iter().map(|source| source.file.pieces.len()).sum()
    }

    /// A plan of these partitions.
    pub(super) fn from_partitions(scan: Arc<Scan>, partitions: Vec<Vec<ScanPiece>>) -> Self {
        let sizes = if scan.parts.files.are_in_folder() { DISK_READS } else { STORE_READS };
        let join = |mut pieces: Vec<ScanPiece>| {
            pieces.sort_by_key(|piece| (piece.source, piece.piece.range.start));
            let mut reads = Vec::new();
            pieces.into_iter().for_each(|piece| add_piece(&mut reads, piece, &sizes));
            reads
        };
        let partitions: Vec<_> = partitions.into_iter().map(join).collect();
        let properties = plan_properties(&scan.schema, partitions.len());
        Self { scan, partitions, properties, metrics: ExecutionPlanMetricsSet::new() }
    }

    /// Counts into the metrics of another plan, too.
    pub(super) fn with_metrics(self, metrics: ExecutionPlanMetricsSet) -> Self {
        Self { metrics, ..self }
    }

    pub(super) fn scan(&self) -> &Scan {
        &self.scan
    }

    /// Returns the bytes of files that it fetches. One with a limit ends early, and fetches few.
    pub fn fetched_bytes(&self) -> u64 {
        let reads = self.partitions.iter().flatten().filter(|_| self.scan.limit.is_none());
        reads.map(|read| read.range.end - read.range.start).sum()
    }

    /// Returns the path of a piece's file.
    pub fn piece_path(&self, piece: &ScanPiece) -> &str {
        self.scan.parts.sources[piece.source].file.path.as_ref()
    }

    /// Returns the pieces that each partition reads.
    pub fn partition_pieces(&self) -> Vec<Vec<ScanPiece>> {
        let of_read = |read: &FileRead| {
            let source = read.source;
            read.pieces.clone().into_iter().map(move |piece| ScanPiece { source, piece })
        };
        self.partitions.iter().map(|reads| reads.iter().flat_map(of_read).collect()).collect()
    }

    /// Returns a plan that reads these pieces of it, in these partitions.
    pub fn with_partitions(&self, partitions: Vec<Vec<ScanPiece>>) -> Self {
        Self::from_partitions(self.scan.clone(), partitions)
    }
}

/// Returns what operators above a scan may rely on.
pub(super) fn plan_properties(schema: &SchemaRef, partitions: usize) -> Arc<PlanProperties> {
    let properties = PlanProperties::new(
        EquivalenceProperties::new(schema.clone()),
        Partitioning::UnknownPartitioning(partitions),
        EmissionType::Incremental,
        Boundedness::Bounded,
    );
    Arc::new(properties.with_scheduling_type(SchedulingType::Cooperative))
}

// To the last read, where the piece is near enough, or as another one.
fn add_piece(reads: &mut Vec<FileRead>, piece: ScanPiece, sizes: &ReadSizes) {
    let ScanPiece { source, piece } = piece;
    let near = |r: &&mut FileRead| {
        let gap = piece.range.start.checked_sub(r.range.end);
        r.source == source && gap.is_some_and(|gap| gap <= sizes.gap) && piece.range.end - r.range.start <= sizes.most
    };
    match reads.last_mut().filter(near) {
        Some(read) => {
            read.range.end = piece.range.end;
            read.pieces.push(piece);
        }
        None => reads.push(FileRead { source, range: piece.range.clone(), pieces: vec![piece] }),
    }
}

impl DisplayAs for McapExec {
    fn fmt_as(&self, _: DisplayFormatType, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let chosen: usize = self.partitions.iter().flatten().map(|read| read.pieces.len()).sum();
        let bytes: u64 = self.partitions.iter().flatten().map(|read| read.range.end - read.range.start).sum();
        let fields = self.scan.schema.fields();
        let columns: Vec<_> = fields.iter().map(|f| f.name().as_str()).collect();
        match &self.scan.parts.topic {
            Some(topic) => write!(f, "McapExec: topic={topic}")?,
            None => write!(f, "McapExec: all topics")?,
        }
        write!(f, ", files={}, chunks={chosen} of {}", self.scan.parts.sources.len(), self.count_pieces())?;
        write!(f, ", bytes={bytes}, columns=[{}]", columns.join(", "))?;
        match self.scan.limit {
            Some(limit) => write!(f, ", limit={limit}"),
            None => Ok(()),
        }
    }
}

/// What the plans of scans of run files have in common: no inputs, no expressions, fixed properties, and metrics.
macro_rules! leaf_plan_methods {
    () => {
        fn name(&self) -> &'static str {
            "McapExec"
        }

        fn properties(&self) -> &Arc<PlanProperties> {
            &self.properties
        }

        fn children(&self) -> Vec<&Arc<dyn ExecutionPlan>> {
            Vec::new()
        }

        fn apply_expressions(
            &self,
            _: &mut dyn FnMut(&Arc<dyn PhysicalExpr>) -> Result<TreeNodeRecursion>,
        ) -> Result<TreeNodeRecursion> {
            Ok(TreeNodeRecursion::Continue)
        }

        fn replace_children(
            self: Arc<Self>,
            _: Vec<Arc<dyn ExecutionPlan>>,
            _: ReplaceChildrenOptions,
        ) -> Result<Arc<dyn ExecutionPlan>> {
            Ok(self)
        }

        fn with_new_children(self: Arc<Self>, _: Vec<Arc<dyn ExecutionPlan>>) -> Result<Arc<dyn ExecutionPlan>> {
            Ok(self)
        }

        fn metrics(&self) -> Option<MetricsSet> {
            Some(self.metrics.clone_inner())
        }
    };
}
pub(super) use leaf_plan_methods;

impl ExecutionPlan for McapExec {
    leaf_plan_methods!();

    fn execute(&self, partition: usize, context: Arc<TaskContext>) -> Result<SendableRecordBatchStream> {
        let reads = self.partitions.get(partition).cloned().unwrap_or_default();
        let count = |name: &'static str| MetricBuilder::new(&self.metrics).counter(name, partition);
        let scan = &self.scan;
        let most = context.session_config().batch_size();
        let scanner = Scanner {
            scan: scan.clone(),
            reads: match scan.parts.files.are_in_folder() {
                true => read_disk(scan.parts.clone(), reads, count("bytes_read")),
                false => fetch_reads(scan.parts.clone(), reads, count("bytes_read")),
            },
            fetched: None,
            current: None,
            room: Vec::new(),
            rows: Rows::new(scan.schema.clone(), &scan.parts.heads, &scan.projection, most),
            left: scan.limit.unwrap_or(usize::MAX),
            memory: MemoryConsumer::new("McapExec").register(context.memory_pool()),
            chunks: count("chunks_read"),
            unfit: count("values_unfit"),
            baseline: BaselineMetrics::new(&self.metrics, partition),
        };
        let batches = stream::try_unfold(scanner, |mut scanner| async move {
            Ok(scanner.next_batch().await?.map(|batch| (batch, scanner)))
        });
        Ok(make_cooperative(Box::pin(RecordBatchStreamAdapter::new(scan.schema.clone(), batches))))
    }
}

/// Bytes of files, each with the read that they answer.
type ReadStream = BoxStream<'static, Result<(FileRead, Bytes), Fault>>;

// Each one is read when the one before is decoded, into the same memory.
fn read_disk(parts: Arc<Parts>, reads: Vec<FileRead>, bytes_read: Count) -> ReadStream {
    let state = (parts, reads.into_iter(), bytes_read, None::<(usize, DiskFile)>);
    let batches = stream::try_unfold(state, |(parts, mut reads, bytes_read, open)| async move {
        let Some(read) = reads.next() else { return Ok(None) };
        let path = &parts.sources[read.source].file.path;
        let mut file = match open {
            Some((source, file)) if source == read.source => file,
            _ => parts.files.open_disk(path).await,
        };
        let bytes = file.read_range(read.range.clone()).await?;
        bytes_read.add(bytes.len());
        let open = Some((read.source, file));
        Ok(Some(((read, bytes), (parts, reads, bytes_read, open))))
    });
    batches.boxed()
}

// The next ones are on their way while one is decoded.
fn fetch_reads(parts: Arc<Parts>, reads: Vec<FileRead>, bytes_read: Count) -> ReadStream {
    let one = move |read: FileRead| {
        let parts = parts.clone();
        let bytes_read = bytes_read.clone();
        async move {
            let bytes = parts.files.read_range(&parts.sources[read.source].file.path, read.range.clone()).await?;
            bytes_read.add(bytes.len());
            Ok((read, bytes))
        }
    };
    stream::iter(reads).map(one).buffered(AHEAD).boxed()
}

/// One partition on its way.
struct Scanner {
    scan: Arc<Scan>,
    reads: ReadStream,
    fetched: Option<Fetched>,
    current: Option<Current>,
    /// Memory of the chunk before.
    room: Vec<u8>,
    rows: Rows,
    /// Rows until the limit.
    left: usize,
    memory: MemoryReservation,
    chunks: Count,
    /// Values that are null because they are not of their column's type.
    unfit: Count,
    baseline: BaselineMetrics,
}

/// What was fetched at once, and what of it is still to be read.
struct Fetched {
    source: usize,
    start: u64,
    bytes: Bytes,
    pieces: VecDeque<Piece>,
}

/// The piece at hand.
struct Current {
    source: usize,
    offset: u64,
    records: PieceRecords,
}

impl Scanner {
    async fn next_batch(&mut self) -> Result<Option<RecordBatch>> {
        loop {
            if let Some(batch) = self.rows.take_batch() {
                self.baseline.record_output(batch.num_rows());
                return Ok(Some(batch));
            }
            if self.left == 0 || !self.open_piece().await? {
                self.rows.finish_batch()?;
                self.left = 0;
                let Some(batch) = self.rows.take_batch() else { return Ok(None) };
                self.baseline.record_output(batch.num_rows());
                return Ok(Some(batch));
            }
            let elapsed = self.baseline.elapsed_compute().clone();
            let _timer = elapsed.timer();
            self.decode_piece()?;
            self.unfit.add(self.rows.take_unfit());
        }
    }

    // Whether there is a piece at hand, or another one.
    async fn open_piece(&mut self) -> Result<bool> {
        while self.current.is_none() {
            let Some(fetched) = &mut self.fetched else {
                match self.reads.try_next().await? {
                    Some((read, bytes)) => {
                        let source = read.source;
                        let start = read.range.start;
                        self.fetched = Some(Fetched { source, start, bytes, pieces: read.pieces.into() });
                    }
                    None => return Ok(false),
                }
                continue;
            };
            let Some(piece) = fetched.pieces.pop_front() else {
                self.fetched = None;
                continue;
            };
            // Between chunks others have their turn, and a query that is dropped ends.
            let source = fetched.source;
            let offset = piece.range.start;
            let bytes =
                fetched.bytes.slice((offset - fetched.start) as usize..(piece.range.end - fetched.start) as usize);
            let path = &self.scan.parts.sources[source].file.path;
            let room = std::mem::take(&mut self.room);
            let records = PieceRecords::new(bytes, piece.kind).map_err(|what| Fault::damaged(path, offset, what))?;
            let records = records.with_memory(room);
            self.memory.try_resize(records.memory)?;
            self.chunks.add(1);
            self.current = Some(Current { source, offset, records });
            tokio::task::yield_now().await;
        }
        Ok(true)
    }

    // Continues with the piece at hand until a batch is ready.
    fn decode_piece(&mut self) -> Result<()> {
        let Some(Current { source, offset, records }) = &mut self.current else { return Ok(()) };
        let parts = &self.scan.parts;
        let source = &parts.sources[*source];
        let path = &source.file.path;
        let damaged = |what: String| Fault::damaged(path, *offset, what);
        while let Some(record) = records.next_unskipped(|channel| source.is_skipped(channel)).map_err(damaged)? {
            let Record::Message { header, data } = &record else {
                source.file.digests.check_definition(&record).map_err(damaged)?;
                continue;
            };
            let Some((topic, mapping)) = source.channels.get(&header.channel_id) else {
                return Err(damaged(undescribed_channel(header.channel_id)).into());
            };
            if let Some(times) = &self.scan.times
                && !i64::try_from(header.log_time).is_ok_and(|nanos| times.contains(&nanos))
            {
                continue;
            }
            let message = Message { run: source.run.as_ref(), topic, header, data };
            let mapping = parts.mappings.as_ref().map(|all| (*mapping, &all[*mapping]));
            let is_ready = self.rows.push_message(&message, mapping)?.map_err(|what| Fault::Message {
                file: path.to_string(),
                topic: topic.clone(),
                sequence: header.sequence,
                offset: *offset,
                what,
            })?;
            self.left -= 1;
            if is_ready || self.left == 0 {
                return Ok(());
            }
        }
        self.room = self.current.take().map(|current| current.records.into_memory()).unwrap_or_default();
        Ok(())
    }
}
