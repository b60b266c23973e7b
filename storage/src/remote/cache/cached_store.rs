//! A store that reads immutable objects through a cache.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::ops::Range;
use std::sync::Arc;

use async_trait::async_trait;
use bytes::Bytes;
use futures::stream::{self, BoxStream};
use futures::{FutureExt as _, StreamExt as _};
use object_store::path::Path;
use object_store::{
    Attributes, CopyOptions, Error as StoreError, GetOptions, GetRange, GetResult, GetResultPayload, ListResult,
    MultipartUpload, ObjectMeta, ObjectStore, PutMultipartOptions, PutOptions, PutPayload, PutResult,
    Result as StoreResult,
};
use tokio::task::JoinSet;

use super::block_cache::{BLOCK_BYTES, join_blocks};
use super::block_folder::CachedBlock;
use super::{BlockCache, CacheCounters};
use crate::FileName;

/// A read of more bytes than this passes the cache by: it takes long anyhow, and would evict everything else.
const LARGEST_READ: u64 = 64 << 20;

/// A store over another one.
#[derive(Debug, Clone)]
pub(crate) struct CachedStore {
    inner: Arc<dyn ObjectStore>,
    cache: Arc<BlockCache>,
    /// Counters of one scan, beside those of the cache.
    scan: Option<Arc<CacheCounters>>,
}

impl CachedStore {
    pub fn new(inner: Arc<dyn ObjectStore>, cache: Arc<BlockCache>) -> Self {
        Self { inner, cache, scan: None }
    }

    /// The same store for one scan, which has counters of its own.
    pub fn for_scan(&self, counters: Arc<CacheCounters>) -> Self {
        Self { scan: Some(counters), ..self.clone() }
    }

    pub fn block_cache(&self) -> &BlockCache {
        &self.cache
    }

    // As a task of its own, which ends with this: other readers wait for the blocks that this one fetches, and a query
    // whose reader fetches no rows is not polled.
    async fn read_blocks(&self, path: &Path, numbers: BTreeSet<u64>) -> StoreResult<BTreeMap<u64, CachedBlock>> {
        let Self { inner, cache, scan } = self.clone();
        let path = path.clone();
        let mut task = JoinSet::new();
        task.spawn(async move { cache.read_blocks(inner.as_ref(), &path, numbers, scan.as_deref()).await }.boxed());
        match task.join_next().await {
            Some(Ok(read)) => read,
            Some(Err(source)) => Err(StoreError::JoinError { source }),
            None => Ok(BTreeMap::new()),
        }
    }

    // Returns None if the cache has no answer: the store says why.
    async fn read_ranges(&self, path: &Path, ranges: &[Range<u64>]) -> StoreResult<Option<CachedRead>> {
        let total: u64 = ranges.iter().map(|range| range.end.saturating_sub(range.start)).sum();
        let is_readable = ranges.iter().all(|range| range.start < range.end) && total > 0 && total <= LARGEST_READ;
        if !is_immutable(path) || !is_readable {
            return Ok(None);
        }
        let numbers: BTreeSet<u64> =
            ranges.iter().flat_map(|range| range.start / BLOCK_BYTES..range.end.div_ceil(BLOCK_BYTES)).collect();
        let blocks = self.read_blocks(path, numbers).await?;
        let Some(block) = blocks.values().next() else { return Ok(None) };
        let object_bytes = block.object_bytes;
        if ranges.iter().any(|range| range.start >= object_bytes) {
            return Ok(None);
        }
        let meta = ObjectMeta {
            location: path.clone(),
            last_modified: block.modified,
            size: object_bytes,
            e_tag: None,
            version: None,
        };
        let parts = ranges.iter().map(|range| join_blocks(&blocks, range)).collect();
        Ok(Some(CachedRead { meta, parts }))
    }
}

/// Ranges of an object.
struct CachedRead {
    meta: ObjectMeta,
    parts: Vec<Bytes>,
}

/// Returns whether an object has the same content for as long as its name exists.
fn is_immutable(path: &Path) -> bool {
    let parts: Vec<_> = path.parts().collect();
    match parts.iter().map(AsRef::as_ref).collect::<Vec<_>>().as_slice() {
        ["runs", .., _] => path.extension() == Some("mcap"),
        ["tables", _, _] => !matches!(FileName::parse(path), None | Some(FileName::Rig { .. })),
        _ => false,
    }
}

fn bounded_range(options: &GetOptions) -> Option<Range<u64>> {
    let GetOptions { if_match, if_none_match, if_modified_since, if_unmodified_since, range, version, head, .. } =
        options;
    let is_plain = if_match.is_none()
        && if_none_match.is_none()
        && if_modified_since.is_none()
        && if_unmodified_since.is_none()
        && version.is_none()
        && !head;
    match range {
        Some(GetRange::Bounded(range)) if is_plain => Some(range.clone()),
        _ => None,
    }
}

impl fmt::Display for CachedStore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.inner.fmt(f)
    }
}

#[async_trait]
impl ObjectStore for CachedStore {
    async fn put_opts(&self, location: &Path, payload: PutPayload, opts: PutOptions) -> StoreResult<PutResult> {
        self.inner.put_opts(location, payload, opts).await
    }

    async fn put_multipart_opts(
        &self,
        location: &Path,
        opts: PutMultipartOptions,
    ) -> StoreResult<Box<dyn MultipartUpload>> {
        self.inner.put_multipart_opts(location, opts).await
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> StoreResult<GetResult> {
        let Some(range) = bounded_range(&options) else { return self.inner.get_opts(location, options).await };
        let Some(CachedRead { meta, mut parts }) = self.read_ranges(location, std::slice::from_ref(&range)).await?
        else {
            return self.inner.get_opts(location, options).await;
        };
        let bytes = parts.pop().unwrap_or_default();
        let range = range.start..range.start + bytes.len() as u64;
        let payload = GetResultPayload::Stream(stream::iter([Ok(bytes)]).boxed());
        Ok(GetResult { payload, meta, range, attributes: Attributes::default() })
    }

    async fn get_ranges(&self, location: &Path, ranges: &[Range<u64>]) -> StoreResult<Vec<Bytes>> {
        match self.read_ranges(location, ranges).await? {
            Some(read) => Ok(read.parts),
            None => self.inner.get_ranges(location, ranges).await,
        }
    }

    fn delete_stream(&self, locations: BoxStream<'static, StoreResult<Path>>) -> BoxStream<'static, StoreResult<Path>> {
        self.inner.delete_stream(locations)
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, StoreResult<ObjectMeta>> {
        self.inner.list(prefix)
    }

    fn list_with_offset(&self, prefix: Option<&Path>, offset: &Path) -> BoxStream<'static, StoreResult<ObjectMeta>> {
        self.inner.list_with_offset(prefix, offset)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> StoreResult<ListResult> {
        self.inner.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> StoreResult<()> {
        self.inner.copy_opts(from, to, options).await
    }
}
