//! Readers of data files. If the lake has a cache, each tells `EXPLAIN ANALYZE` what the cache had.

use std::ops::Range;
use std::sync::Arc;

use bytes::Bytes;
use datafusion::datasource::listing::PartitionedFile;
use datafusion::datasource::physical_plan::ParquetFileReaderFactory;
use datafusion::datasource::physical_plan::parquet::CachedParquetFileReaderFactory;
use datafusion::error::Result;
use datafusion::execution::cache::cache_manager::FileMetadataCache;
use datafusion::physical_plan::metrics::{Count, ExecutionPlanMetricsSet, MetricBuilder};
use echolake_lake::{CacheCounters, CacheCounts, Lake};
use futures::FutureExt as _;
use futures::future::BoxFuture;
use parquet::arrow::arrow_reader::ArrowReaderOptions;
use parquet::arrow::async_reader::AsyncFileReader;
use parquet::errors::Result as ParquetResult;
use parquet::file::metadata::ParquetMetaData;

/// Makes readers of a lake's data files, which share the files' footers.
#[derive(Debug)]
pub(crate) struct LakeReaderFactory {
    lake: Lake,
    metadata: Arc<FileMetadataCache>,
}

impl LakeReaderFactory {
    pub(crate) fn new(lake: &Lake, metadata: Arc<FileMetadataCache>) -> Self {
        Self { lake: lake.clone(), metadata }
    }
}

impl ParquetFileReaderFactory for LakeReaderFactory {
    fn create_reader(
        &self,
        partition_index: usize,
        file: PartitionedFile,
        metadata_size_hint: Option<usize>,
        metrics: &ExecutionPlanMetricsSet,
    ) -> Result<Box<dyn AsyncFileReader + Send>> {
        let counters = Arc::new(CacheCounters::default());
        let cached = self.lake.store_for_scan(counters.clone());
        let store = cached.clone().unwrap_or_else(|| self.lake.store());
        let readers = CachedParquetFileReaderFactory::new(store, self.metadata.clone());
        let reader = readers.create_reader(partition_index, file, metadata_size_hint, metrics)?;
        if cached.is_none() {
            return Ok(reader);
        }
        let metric = |name: &'static str| MetricBuilder::new(metrics).counter(name, partition_index);
        let counts = CacheMetrics {
            memory_hits: metric("cache_memory_hits"),
            disk_hits: metric("cache_disk_hits"),
            misses: metric("cache_misses"),
            requests: metric("store_requests"),
        };
        Ok(Box::new(CountingReader { reader, counters, reported: CacheCounts::default(), counts }))
    }
}

/// Metrics of a scan.
struct CacheMetrics {
    memory_hits: Count,
    disk_hits: Count,
    misses: Count,
    requests: Count,
}

/// A reader that reports after each read.
struct CountingReader {
    reader: Box<dyn AsyncFileReader + Send>,
    counters: Arc<CacheCounters>,
    reported: CacheCounts,
    counts: CacheMetrics,
}

impl CountingReader {
    fn report(&mut self) {
        let now = self.counters.counts();
        let before = std::mem::replace(&mut self.reported, now);
        let difference = |now: u64, before: u64| usize::try_from(now - before).unwrap_or(usize::MAX);
        self.counts.memory_hits.add(difference(now.memory_hits, before.memory_hits));
        self.counts.disk_hits.add(difference(now.disk_hits, before.disk_hits));
        self.counts.misses.add(difference(now.misses, before.misses));
        self.counts.requests.add(difference(now.requests, before.requests));
    }
}

impl AsyncFileReader for CountingReader {
    fn get_bytes(&mut self, range: Range<u64>) -> BoxFuture<'_, ParquetResult<Bytes>> {
        async move {
            let read = self.reader.get_bytes(range).await;
            self.report();
            read
        }
        .boxed()
    }

    fn get_byte_ranges(&mut self, ranges: Vec<Range<u64>>) -> BoxFuture<'_, ParquetResult<Vec<Bytes>>> {
        async move {
            let read = self.reader.get_byte_ranges(ranges).await;
            self.report();
            read
        }
        .boxed()
    }

    fn get_metadata<'a>(
        &'a mut self,
        options: Option<&'a ArrowReaderOptions>,
    ) -> BoxFuture<'a, ParquetResult<Arc<ParquetMetaData>>> {
        async move {
            let read = self.reader.get_metadata(options).await;
            self.report();
            read
        }
        .boxed()
    }
}
