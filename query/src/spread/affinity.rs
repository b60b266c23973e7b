//! Which worker reads which files. A file goes to the same worker in every query, by rendezvous hashing, so that what
//! workers cache adds up; large files are cut at fixed places for the same reason.

use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::sync::Arc;

use async_trait::async_trait;
use datafusion::datasource::listing::PartitionedFile;
use datafusion::datasource::physical_plan::FileGroup;
use datafusion::datasource::source::DataSourceExec;
use datafusion::error::Result;
use datafusion::physical_plan::{ExecutionPlan, ExecutionPlanProperties as _};
use datafusion_distributed::{
    DesiredTaskCountEvent, DesiredTaskCountEventResponse, DesiredTaskCountHandler, DistributedLeafExec,
    RouteTasksEvent, RouteTasksEventResponse, RouteTasksHandler, ScaleUpLeafNodeEvent, ScaleUpLeafNodeEventResponse,
    ScaleUpLeafNodeHandler, WorkerResolver,
};
use url::Url;

use super::decision::{file_scan, read_bytes};

/// Bytes of a file that one worker reads as one piece.
const PIECE_BYTES: u64 = 32 << 20;
/// A scan of less than this is not worth a second worker.
const SMALL_SCAN_BYTES: u64 = 1 << 20;
/// Most that a worker gets of a scan, as a part of the mean: the next in a file's order has what is above it.
const MOST_OF_MEAN: f64 = 1.15;

/// The workers of one query. A stage has a task on each of them, or one task.
#[derive(Debug, Clone)]
pub(super) struct QueryWorkers {
    urls: Arc<Vec<Url>>,
    /// True if even small scans are spread.
    is_eager: bool,
}

impl QueryWorkers {
    pub(super) fn new(urls: Vec<Url>, is_eager: bool) -> Self {
        Self { urls: Arc::new(urls), is_eager }
    }

    // Pieces of files, by the worker that reads them.
    fn assign(&self, files: impl Iterator<Item = PartitionedFile>) -> Vec<Vec<PartitionedFile>> {
        let mut pieces: Vec<_> = whole_files(files).into_iter().flat_map(pieces_of).collect();
        // Large ones first: what comes late finds workers with room.
        pieces.sort_by(|a, b| b.effective_size().cmp(&a.effective_size()).then_with(|| key(a).cmp(&key(b))));
        let total: u64 = pieces.iter().map(PartitionedFile::effective_size).sum();
        let most = (total as f64 / self.urls.len() as f64 * MOST_OF_MEAN) as u64;
        let mut loads = vec![0_u64; self.urls.len()];
        let mut assigned = vec![Vec::new(); self.urls.len()];
        for piece in pieces {
            let size = piece.effective_size();
            let fitting = self.order_of(&piece).into_iter().find(|worker| loads[*worker] + size <= most);
            let worker = fitting.or_else(|| (0..loads.len()).min_by_key(|worker| loads[*worker]));
            if let Some(worker) = worker {
                loads[worker] += size;
                assigned[worker].push(piece);
            }
        }
        assigned
    }

    // The workers, from the one that a piece belongs to.
    fn order_of(&self, piece: &PartitionedFile) -> Vec<usize> {
        let mut order: Vec<_> = (0..self.urls.len()).collect();
        order.sort_by_key(|worker| {
            let mut hasher = DefaultHasher::new();
            (self.urls[*worker].as_str(), key(piece)).hash(&mut hasher);
            hasher.finish()
        });
        order
    }
}

// The name stands for the content.
fn key(piece: &PartitionedFile) -> (&str, i64) {
    (piece.object_meta.location.as_ref(), piece.range.as_ref().map_or(0, |range| range.start))
}

// Scans cut files where it suits their partitions, which are others in every query.
fn whole_files(files: impl Iterator<Item = PartitionedFile>) -> Vec<PartitionedFile> {
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
fn pieces_of(file: PartitionedFile) -> Vec<PartitionedFile> {
    let size = file.object_meta.size;
    if file.range.is_some() || size < 2 * PIECE_BYTES {
        return vec![file];
    }
    let starts = (0..size.div_ceil(PIECE_BYTES)).map(|number| number * PIECE_BYTES);
    starts.map(|start| file.clone().with_range(start as i64, size.min(start + PIECE_BYTES) as i64)).collect()
}

// Into partitions of about the same size.
fn groups(pieces: Vec<PartitionedFile>, count: usize) -> Vec<FileGroup> {
    let mut groups = vec![(0_u64, Vec::new()); count];
    for piece in pieces {
        if let Some((bytes, group)) = groups.iter_mut().min_by_key(|group| group.0) {
            *bytes += piece.effective_size();
            group.push(piece);
        }
    }
    groups.into_iter().map(|(_, pieces)| FileGroup::new(pieces)).collect()
}

impl WorkerResolver for QueryWorkers {
    fn get_urls(&self) -> Result<Vec<Url>> {
        Ok(self.urls.to_vec())
    }
}

#[async_trait]
impl DesiredTaskCountHandler for QueryWorkers {
    async fn handle(&self, event: DesiredTaskCountEvent<'_>) -> Option<Result<DesiredTaskCountEventResponse>> {
        let bytes = read_bytes(file_scan(event.plan)?);
        let count = if self.is_eager || bytes >= SMALL_SCAN_BYTES { self.urls.len() } else { 1 };
        Some(Ok(DesiredTaskCountEventResponse::desired(count)))
    }
}

impl ScaleUpLeafNodeHandler for QueryWorkers {
    fn handle(&self, event: ScaleUpLeafNodeEvent<'_>) -> Option<Result<ScaleUpLeafNodeEventResponse>> {
        let scan = file_scan(event.plan)?;
        // What has an order or a partitioning of its own is the library's to split.
        if event.task_count != self.urls.len()
            || event.task_count == 1
            || scan.output_partitioning.is_some()
            || !scan.output_ordering.is_empty()
        {
            return None;
        }
        let partitions = event.plan.output_partitioning().partition_count();
        let files = scan.file_groups.iter().flat_map(|group| group.iter().cloned());
        let tasks = self.assign(files).into_iter().map(|pieces| {
            let mut scan = scan.clone();
            scan.file_groups = groups(pieces, partitions);
            DataSourceExec::from_data_source(scan) as Arc<dyn ExecutionPlan>
        });
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

    fn workers(count: usize) -> QueryWorkers {
        let urls = (0..count).map(|n| format!("http://10.0.0.{n}:7070").parse().expect("a URL"));
        QueryWorkers::new(urls.collect(), false)
    }

    // By the workers' addresses.
    fn places(workers: &QueryWorkers, files: &[PartitionedFile]) -> HashMap<(String, i64), String> {
        let assigned = workers.assign(files.iter().cloned());
        let of_worker = |(worker, pieces): (usize, Vec<PartitionedFile>)| {
            let url = workers.urls[worker].to_string();
            pieces.into_iter().map(move |piece| ((key(&piece).0.to_owned(), key(&piece).1), url.clone()))
        };
        assigned.into_iter().enumerate().flat_map(of_worker).collect()
    }

    #[test]
    fn files_stay_with_their_workers() {
        let files: Vec<_> =
            (0..400).map(|n| PartitionedFile::new(format!("tables/nce/{n}.parquet"), 4 << 20)).collect();
        let four = places(&workers(4), &files);
        assert_eq!(four.len(), 400);
        let mut reversed = files.clone();
        reversed.reverse();
        assert_eq!(places(&workers(4), &reversed), four, "the order of the files changes nothing");
        let counts = workers(4).assign(files.iter().cloned()).iter().map(Vec::len).max();
        assert!(counts.expect("four") <= 115, "{counts:?}");
        // A fifth worker takes files from the others, and moves few among them.
        let five = places(&workers(5), &files);
        let moved = files.iter().filter(|file| {
            let place = (file.object_meta.location.to_string(), 0);
            five[&place] != four[&place] && !five[&place].contains("10.0.0.4")
        });
        assert!(moved.count() < 80);
    }

    #[test]
    fn files_that_a_scan_has_cut_are_whole_again() {
        let file = |from: i64, to: i64| PartitionedFile::new("tables/nce/a.parquet", 1_000).with_range(from, to);
        let joined = whole_files([file(0, 300), file(300, 1_000)].into_iter());
        assert_eq!((joined.len(), joined[0].range.is_none()), (1, true));
        assert_eq!(whole_files([file(0, 300), file(400, 1_000)].into_iter()).len(), 2, "a part is not read");
    }

    #[test]
    fn large_files_are_cut_and_cover_themselves() {
        let file = PartitionedFile::new("tables/nce/merged.parquet", 1_000_000_007);
        let pieces = pieces_of(file);
        let mut end = 0;
        for piece in &pieces {
            let range = piece.range.as_ref().expect("a range");
            assert_eq!(range.start, end);
            end = range.end;
        }
        assert_eq!((end, pieces.len()), (1_000_000_007, 30));
        let loads =
            workers(4).assign(pieces.into_iter()).into_iter().map(|p| p.iter().map(|p| p.effective_size()).sum());
        let loads: Vec<u64> = loads.collect();
        assert!(loads.iter().all(|load| *load as f64 <= 1.3 * 250_000_000.0), "{loads:?}");
        assert_eq!(loads.iter().sum::<u64>(), 1_000_000_007);
    }
}
