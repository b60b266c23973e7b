//! The worker that reads each file. A file goes to the same worker in every query, by rendezvous hashing, so that what
//! workers cache adds up; large files are cut at fixed places for the same reason.

use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::sync::Arc;

use async_trait::async_trait;
use datafusion::datasource::listing::PartitionedFile;
use datafusion::datasource::physical_plan::{FileGroup, FileScanConfig};
use datafusion::datasource::source::DataSourceExec;
use datafusion::error::Result;
use datafusion::physical_plan::{ExecutionPlan, ExecutionPlanProperties as _};
use datafusion_distributed::{
    DesiredTaskCountEvent, DesiredTaskCountEventResponse, DesiredTaskCountHandler, DistributedLeafExec,
    RouteTasksEvent, RouteTasksEventResponse, RouteTasksHandler, ScaleUpLeafNodeEvent, ScaleUpLeafNodeEventResponse,
    ScaleUpLeafNodeHandler, WorkerResolver,
};
use echolake_mcap_tables::{McapExec, ScanPiece};
use url::Url;

use super::decision::{find_file_scan, find_mcap_scan, read_bytes};

/// Bytes of a file that one worker reads as one piece.
const PIECE_BYTES: u64 = 32 << 20;
/// A scan of less than this is not worth a second worker.
const SMALL_SCAN_BYTES: u64 = 1 << 20;
/// Limit of what a worker gets of a scan, as a part of the mean: the next in a file's order has what is above it.
const LOAD_LIMIT: f64 = 1.15;

/// The workers of one query. A stage has a task on each of them, or one task.
#[derive(Debug, Clone)]
pub(super) struct QueryWorkers {
    urls: Arc<Vec<Url>>,
    /// True if even small scans are spread.
    is_eager: bool,
}

impl QueryWorkers {
    pub fn new(urls: Vec<Url>, is_eager: bool) -> Self {
        Self { urls: Arc::new(urls), is_eager }
    }

    // Pieces of a table's files, by the worker that reads them.
    fn assign_files(&self, files: impl Iterator<Item = PartitionedFile>) -> Vec<Vec<PartitionedFile>> {
        self.assign_pieces(join_parts(files).into_iter().flat_map(cut_file).collect(), self.urls.len())
    }

    // By the first so many workers.
    fn assign_pieces<P: FilePiece>(&self, mut pieces: Vec<P>, count: usize) -> Vec<Vec<P>> {
        // Large ones first: what comes late finds workers with room.
        pieces.sort_by(|a, b| b.bytes().cmp(&a.bytes()).then_with(|| a.place().cmp(&b.place())));
        let total: u64 = pieces.iter().map(P::bytes).sum();
        let limit = (total as f64 / count as f64 * LOAD_LIMIT) as u64;
        let mut loads = vec![0_u64; count];
        let mut assigned: Vec<_> = (0..count).map(|_| Vec::new()).collect();
        for piece in pieces {
            let size = piece.bytes();
            let fitting = self.worker_order(&piece, count).into_iter().find(|worker| loads[*worker] + size <= limit);
            let worker = fitting.or_else(|| (0..count).min_by_key(|worker| loads[*worker]));
            if let Some(worker) = worker {
                loads[worker] += size;
                assigned[worker].push(piece);
            }
        }
        assigned
    }

    // The workers, from the one that a piece belongs to.
    fn worker_order(&self, piece: &impl FilePiece, count: usize) -> Vec<usize> {
        let mut order: Vec<_> = (0..count).collect();
        order.sort_by_key(|worker| {
            let mut hasher = DefaultHasher::new();
            (self.urls[*worker].as_str(), piece.place()).hash(&mut hasher);
            hasher.finish()
        });
        order
    }

    fn plan_file_tasks(&self, scan: &FileScanConfig, partitions: usize) -> Vec<Arc<dyn ExecutionPlan>> {
        let files = scan.file_groups.iter().flat_map(|group| group.iter().cloned());
        let plan_task = |pieces| {
            let mut scan = scan.clone();
            scan.file_groups = group_pieces(pieces, partitions).into_iter().map(FileGroup::new).collect();
            DataSourceExec::from_data_source(scan) as Arc<dyn ExecutionPlan>
        };
        self.assign_files(files).into_iter().map(plan_task).collect()
    }

    fn plan_mcap_tasks(&self, scan: &McapExec, count: usize, partitions: usize) -> Vec<Arc<dyn ExecutionPlan>> {
        let place = |piece| McapPiece { path: scan.piece_path(&piece).to_owned(), piece };
        let pieces = scan.partition_pieces().into_iter().flatten().map(place).collect();
        let plan_task = |pieces| {
            let groups = group_pieces(pieces, partitions).into_iter();
            let groups = groups.map(|pieces: Vec<McapPiece>| pieces.into_iter().map(|piece| piece.piece).collect());
            Arc::new(scan.with_partitions(groups.collect())) as Arc<dyn ExecutionPlan>
        };
        self.assign_pieces(pieces, count).into_iter().map(plan_task).collect()
    }
}

/// A part of a file that one worker reads.
trait FilePiece {
    /// Returns its file, whose name stands for its content, and its place there.
    fn place(&self) -> (&str, u64);

    /// Returns its size.
    fn bytes(&self) -> u64;
}

impl FilePiece for PartitionedFile {
    fn place(&self) -> (&str, u64) {
        let start = self.range.as_ref().map_or(0, |range| range.start);
        (self.object_meta.location.as_ref(), start.unsigned_abs())
    }

    fn bytes(&self) -> u64 {
        self.effective_size()
    }
}

/// A piece of a run file.
struct McapPiece {
    path: String,
    piece: ScanPiece,
}

impl FilePiece for McapPiece {
    // Other queries read other chunks: what is near to them belongs to the same worker.
    fn place(&self) -> (&str, u64) {
        (&self.path, self.piece.start_offset() / PIECE_BYTES)
    }

    fn bytes(&self) -> u64 {
        self.piece.byte_count()
    }
}

// Scans cut files where it suits their partitions, which are others in every query.
fn join_parts(files: impl Iterator<Item = PartitionedFile>) -> Vec<PartitionedFile> {
    let mut parts = BTreeMap::<_, Vec<PartitionedFile>>::new();
    for file in files {
        parts.entry(file.object_meta.location.clone()).or_default().push(file);
    }
    let join = |mut parts: Vec<PartitionedFile>| {
        let bytes: u64 = parts.iter().map(PartitionedFile::effective_size).sum();
        if parts.first().is_some_and(|file| bytes == file.object_meta.size) {
            parts.truncate(1);
            parts.iter_mut().for_each(|file| file.range = None);
        }
        parts
    };
    parts.into_values().flat_map(join).collect()
}

// A reader of a range reads the row groups that begin in it.
fn cut_file(file: PartitionedFile) -> Vec<PartitionedFile> {
    let size = file.object_meta.size;
    if file.range.is_some() || size < 2 * PIECE_BYTES {
        return vec![file];
    }
    let starts = (0..size.div_ceil(PIECE_BYTES)).map(|number| number * PIECE_BYTES);
    starts.map(|start| file.clone().with_range(start as i64, size.min(start + PIECE_BYTES) as i64)).collect()
}

// Into partitions of about the same size.
fn group_pieces<P: FilePiece>(pieces: Vec<P>, count: usize) -> Vec<Vec<P>> {
    let mut groups: Vec<_> = (0..count).map(|_| (0_u64, Vec::new())).collect();
    for piece in pieces {
        if let Some((bytes, group)) = groups.iter_mut().min_by_key(|group| group.0) {
            *bytes += piece.bytes();
            group.push(piece);
        }
    }
    groups.into_iter().map(|(_, pieces)| pieces).collect()
}

impl WorkerResolver for QueryWorkers {
    fn get_urls(&self) -> Result<Vec<Url>> {
        Ok(self.urls.to_vec())
    }
}

#[async_trait]
impl DesiredTaskCountHandler for QueryWorkers {
    async fn handle(&self, event: DesiredTaskCountEvent<'_>) -> Option<Result<DesiredTaskCountEventResponse>> {
        let bytes = match find_file_scan(event.plan.as_ref()) {
            Some(scan) => read_bytes(scan),
            None => find_mcap_scan(event.plan.as_ref())?.fetched_bytes(),
        };
        let count = if self.is_eager || bytes >= SMALL_SCAN_BYTES { self.urls.len() } else { 1 };
        Some(Ok(DesiredTaskCountEventResponse::desired(count)))
    }
}

impl ScaleUpLeafNodeHandler for QueryWorkers {
    fn handle(&self, event: ScaleUpLeafNodeEvent<'_>) -> Option<Result<ScaleUpLeafNodeEventResponse>> {
        let partitions = event.plan.output_partitioning().partition_count();
        let node = event.plan.as_ref();
        let tasks = match (find_file_scan(node), find_mcap_scan(node)) {
            _ if event.task_count == 1 => return None,
            // What has an order or a partitioning of its own is the library's to split.
            (Some(scan), _)
                if event.task_count == self.urls.len()
                    && scan.output_partitioning.is_none()
                    && scan.output_ordering.is_empty() =>
            {
                self.plan_file_tasks(scan, partitions)
            }
            (None, Some(scan)) if event.task_count <= self.urls.len() => {
                self.plan_mcap_tasks(scan, event.task_count, partitions)
            }
            _ => return None,
        };
        let leaf = DistributedLeafExec::try_new(event.plan.clone(), tasks);
        Some(leaf.map(|leaf| ScaleUpLeafNodeEventResponse::new(Arc::new(leaf))))
    }
}

impl RouteTasksHandler for QueryWorkers {
    fn handle(&self, event: RouteTasksEvent<'_>) -> Option<Result<RouteTasksEventResponse>> {
        let is_whole = event.task_count > 1 && event.task_count <= self.urls.len();
        is_whole.then(|| Ok(RouteTasksEventResponse::new(self.urls[..event.task_count].to_vec())))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use super::*;

    fn make_workers(count: usize) -> QueryWorkers {
        let urls = (0..count).map(|n| format!("http://10.0.0.{n}:7070").parse().expect("a URL"));
        QueryWorkers::new(urls.collect(), false)
    }

    // By the workers' addresses.
    fn place_files(workers: &QueryWorkers, files: &[PartitionedFile]) -> HashMap<(String, u64), String> {
        let assigned = workers.assign_files(files.iter().cloned());
        let of_worker = |(worker, pieces): (usize, Vec<PartitionedFile>)| {
            let url = workers.urls[worker].to_string();
            pieces.into_iter().map(move |piece| ((piece.place().0.to_owned(), piece.place().1), url.clone()))
        };
        assigned.into_iter().enumerate().flat_map(of_worker).collect()
    }

    #[test]
    fn files_stay_with_their_workers() {
        let files: Vec<_> =
            (0..400).map(|n| PartitionedFile::new(format!("tables/nce/{n}.parquet"), 4 << 20)).collect();
        let four = place_files(&make_workers(4), &files);
        assert_eq!(four.len(), 400);
        let mut reversed = files.clone();
        reversed.reverse();
        assert_eq!(place_files(&make_workers(4), &reversed), four, "the order of the files changes nothing");
        let most = make_workers(4).assign_files(files.iter().cloned()).iter().map(Vec::len).max();
        assert!(most.expect("four") <= 115, "{most:?}");
        // A fifth worker takes files from the others, and moves few among them.
        let five = place_files(&make_workers(5), &files);
        let moved = files.iter().filter(|file| {
            let place = (file.object_meta.location.to_string(), 0);
            five[&place] != four[&place] && !five[&place].contains("10.0.0.4")
        });
        assert!(moved.count() < 80);
    }

    #[test]
    fn files_that_a_scan_has_cut_are_whole_again() {
        let part = |from: i64, to: i64| PartitionedFile::new("tables/nce/a.parquet", 1_000).with_range(from, to);
        let joined = join_parts([part(0, 300), part(300, 1_000)].into_iter());
        assert_eq!((joined.len(), joined[0].range.is_none()), (1, true));
        assert_eq!(join_parts([part(0, 300), part(400, 1_000)].into_iter()).len(), 2, "a part is not read");
    }

    #[test]
    fn large_files_are_cut_and_cover_themselves() {
        let pieces = cut_file(PartitionedFile::new("tables/nce/merged.parquet", 1_000_000_007));
        let mut end = 0;
        for piece in &pieces {
            let range = piece.range.as_ref().expect("a range");
            assert_eq!(range.start, end);
            end = range.end;
        }
        assert_eq!((end, pieces.len()), (1_000_000_007, 30));
        let sum = |pieces: Vec<PartitionedFile>| pieces.iter().map(PartitionedFile::effective_size).sum::<u64>();
        let loads: Vec<u64> = make_workers(4).assign_pieces(pieces, 4).into_iter().map(sum).collect();
        assert!(loads.iter().all(|load| *load as f64 <= 1.3 * 250_000_000.0), "{loads:?}");
        assert_eq!(loads.iter().sum::<u64>(), 1_000_000_007);
    }
}
