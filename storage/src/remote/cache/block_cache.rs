//! Blocks of objects: from memory, from the folder, or from the store by as few requests as possible. A block that
//! several readers want at once is fetched once.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::Arc;

use bytes::Bytes;
use futures::{FutureExt as _, StreamExt as _, stream};
use object_store::path::Path;
use object_store::{Error as StoreError, GetOptions, GetRange, ObjectStore, Result as StoreResult};
use quick_cache::sync::{Cache, DefaultLifecycle, PlaceholderGuard};
use quick_cache::{DefaultHashBuilder, Weighter};

use super::block_folder::CachedBlock;
use super::{BlockFolder, CacheCounters, CacheCounts};

/// Bytes of a block. At 100 MB/s it takes 10 ms to fetch, less than a request to a store takes to begin.
pub(super) const BLOCK_BYTES: u64 = 1 << 20;
/// Bytes of blocks that a process keeps in memory.
pub const CACHE_MEMORY_BYTES: u64 = 64 << 20;
/// Neighbouring blocks that one request fetches.
const BLOCKS_PER_REQUEST: usize = 16;
/// Requests of one read at once.
const CONCURRENT_REQUESTS: usize = 8;

/// An object and the number of a block in it.
type BlockKey = (Path, u64);

/// Weighs blocks by their bytes.
#[derive(Debug, Clone)]
struct BlockWeighter;

impl Weighter<BlockKey, CachedBlock> for BlockWeighter {
    fn weight(&self, _: &BlockKey, block: &CachedBlock) -> u64 {
        block.bytes.len() as u64 + 1
    }
}

type BlockLifecycle = DefaultLifecycle<BlockKey, CachedBlock>;
type BlockGuard<'a> = PlaceholderGuard<'a, BlockKey, CachedBlock, BlockWeighter, DefaultHashBuilder, BlockLifecycle>;

/// The blocks that a process has in memory, and the folder with those of all processes.
#[derive(Debug)]
pub(crate) struct BlockCache {
    memory: Cache<BlockKey, CachedBlock, BlockWeighter>,
    folder: Option<Arc<BlockFolder>>,
    counters: CacheCounters,
}

impl BlockCache {
    pub fn new(folder: Option<BlockFolder>) -> Self {
        // So few items are one shard, in which a block may take all the room.
        let memory = Cache::with_weighter(32, CACHE_MEMORY_BYTES, BlockWeighter);
        Self { memory, folder: folder.map(Arc::new), counters: CacheCounters::default() }
    }

    pub fn read_counts(&self) -> CacheCounts {
        self.counters.read_counts()
    }

    /// Reads blocks of an object. Blocks behind its end are left out.
    ///
    /// # Errors
    /// What the store says.
    pub async fn read_blocks(
        &self,
        store: &dyn ObjectStore,
        path: &Path,
        numbers: BTreeSet<u64>,
        scan: Option<&CacheCounters>,
    ) -> StoreResult<BTreeMap<u64, CachedBlock>> {
        let mut blocks = BTreeMap::new();
        let mut missing = Vec::new();
        // In ascending order, so that two readers never wait for each other.
        for number in numbers {
            match self.memory.get_value_or_guard_async(&(path.clone(), number)).await {
                Ok(block) => drop(blocks.insert(number, block)),
                Err(guard) => missing.push((number, guard)),
            }
        }
        let mut counts = CacheCounts { memory_hits: blocks.len() as u64, ..CacheCounts::default() };
        let missing = self.take_from_folder(path, missing, &mut blocks).await;
        counts.disk_hits = blocks.len() as u64 - counts.memory_hits;
        counts.misses = missing.len() as u64;
        let requests = group_neighbours(missing);
        counts.requests = requests.len() as u64;
        let mut fetches = Vec::new();
        for guards in requests {
            fetches.push(self.fetch_blocks(store, path, guards).boxed());
        }
        let mut fetches = stream::iter(fetches).buffer_unordered(CONCURRENT_REQUESTS);
        let mut failure = None;
        while let Some(fetched) = fetches.next().await {
            match fetched {
                Ok(fetched) => blocks.extend(fetched.into_iter().inspect(|(_, block)| {
                    counts.fetched_bytes += block.bytes.len() as u64;
                })),
                Err(error) => failure = Some(error),
            }
        }
        [Some(&self.counters), scan].into_iter().flatten().for_each(|counters| counters.add_counts(&counts));
        failure.map_or(Ok(blocks), Err)
    }

    // Returns what is not in the folder.
    async fn take_from_folder<'a>(
        &self,
        path: &Path,
        missing: Vec<(u64, BlockGuard<'a>)>,
        blocks: &mut BTreeMap<u64, CachedBlock>,
    ) -> Vec<(u64, BlockGuard<'a>)> {
        let Some(folder) = self.folder.clone().filter(|_| !missing.is_empty()) else { return missing };
        let numbers: Vec<_> = missing.iter().map(|(number, _)| *number).collect();
        let path = path.clone();
        let read = move || numbers.iter().map(|number| folder.read_block(&path, *number)).collect::<Vec<_>>();
        // A reader that panics has found nothing.
        let found = tokio::task::spawn_blocking(read).await.unwrap_or_default();
        let mut left = Vec::new();
        for ((number, guard), block) in missing.into_iter().zip(found.into_iter().chain(std::iter::repeat(None))) {
            match block {
                Some(block) => {
                    // An error is that the place was given up meanwhile.
                    let _ = guard.insert(block.clone());
                    blocks.insert(number, block);
                }
                None => left.push((number, guard)),
            }
        }
        left
    }

    // Fetches neighbouring blocks by one request.
    async fn fetch_blocks(
        &self,
        store: &dyn ObjectStore,
        path: &Path,
        guards: Vec<(u64, BlockGuard<'_>)>,
    ) -> StoreResult<Vec<(u64, CachedBlock)>> {
        let first = guards.first().map_or(0, |(number, _)| *number);
        let range = Some(GetRange::Bounded(first * BLOCK_BYTES..(first + guards.len() as u64) * BLOCK_BYTES));
        let found = store.get_opts(path, GetOptions { range, ..GetOptions::default() }).await?;
        let object = found.meta.clone();
        let range = found.range.clone();
        let bytes = found.bytes().await?;
        if bytes.len() as u64 != range.end - range.start || range.start != first * BLOCK_BYTES {
            let source = format!("{} bytes came of {}..{}", bytes.len(), range.start, range.end).into();
            return Err(StoreError::Generic { store: "cache", source });
        }
        let mut fetched = Vec::new();
        for (number, guard) in guards {
            let part = part_of(number * BLOCK_BYTES..(number + 1) * BLOCK_BYTES, range.start, bytes.len());
            // A copy, so that it does not hold its neighbours in memory.
            let bytes = Bytes::copy_from_slice(&bytes[part]);
            let block = CachedBlock { bytes, object_bytes: object.size, modified: object.last_modified };
            if !block.bytes.is_empty() {
                let _ = guard.insert(block.clone());
                fetched.push((number, block));
            }
        }
        self.put_into_folder(path, &fetched).await;
        Ok(fetched)
    }

    async fn put_into_folder(&self, path: &Path, fetched: &[(u64, CachedBlock)]) {
        let Some(folder) = self.folder.clone() else { return };
        let path = path.clone();
        let fetched = fetched.to_vec();
        let write = move || fetched.iter().for_each(|(number, block)| folder.write_block(&path, *number, block));
        let _ = tokio::task::spawn_blocking(write).await;
    }
}

// The part of `length` bytes from `start` on that lies in a range.
fn part_of(range: Range<u64>, start: u64, length: usize) -> Range<usize> {
    let place = |at: u64| usize::try_from(at.saturating_sub(start)).unwrap_or(usize::MAX).min(length);
    place(range.start)..place(range.end)
}

fn group_neighbours(missing: Vec<(u64, BlockGuard<'_>)>) -> Vec<Vec<(u64, BlockGuard<'_>)>> {
    let mut groups: Vec<Vec<(u64, BlockGuard<'_>)>> = Vec::new();
    for (number, guard) in missing {
        match groups.last_mut() {
            Some(group) if group[0].0 + group.len() as u64 == number && group.len() < BLOCKS_PER_REQUEST => {
                group.push((number, guard));
            }
            _ => groups.push(vec![(number, guard)]),
        }
    }
    groups
}

/// Joins the blocks that a range lies in; what is behind the object's end is left out.
pub(super) fn join_blocks(blocks: &BTreeMap<u64, CachedBlock>, range: &Range<u64>) -> Bytes {
    let parts = blocks.range(range.start / BLOCK_BYTES..range.end.div_ceil(BLOCK_BYTES)).map(|(number, block)| {
        let part = part_of(range.clone(), number * BLOCK_BYTES, block.bytes.len());
        block.bytes.slice(part)
    });
    let parts: Vec<Bytes> = parts.collect();
    match <[Bytes; 1]>::try_from(parts) {
        Ok([alone]) => alone,
        Err(parts) => parts.concat().into(),
    }
}
