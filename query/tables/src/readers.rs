//! Readers of data files, which read a footer once for concurrent scans. If the lake has a cache, each reader counts
//! its hits for `EXPLAIN ANALYZE`.

use std::collections::HashMap;
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

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
use object_store::path::Path;
use parquet::arrow::arrow_reader::ArrowReaderOptions;
use parquet::arrow::async_reader::AsyncFileReader;
use parquet::errors::Result as ParquetResult;
use parquet::file::metadata::ParquetMetaData;
use tokio::sync::Mutex as AsyncMutex;
use tokio::time::timeout;

/// Time for which a reader waits for another one, which is about to read the same footer.
const FOOTER_WAIT: Duration = Duration::from_secs(1);

/// Makes readers of a lake's data files, which share the files' footers.
#[derive(Debug)]
pub struct LakeReaderFactory {
    lake: Lake,
    metadata: Arc<FileMetadataCache>,
    footer_reads: FooterReads,
}

impl LakeReaderFactory {
    /// Creates readers for a lake, whose footers are kept in `metadata`.
    pub fn new(lake: &Lake, metadata: Arc<FileMetadataCache>) -> Self {
        Self { lake: lake.clone(), metadata, footer_reads: FooterReads::default() }
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
        let footer_read = self.footer_reads.footer_lock(&file.object_meta.location);
        let readers = CachedParquetFileReaderFactory::new(store, self.metadata.clone());
        let reader = readers.create_reader(partition_index, file, metadata_size_hint, metrics)?;
        let reader = Box::new(FooterReader { reader, footer_read });
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

/// Locks of the files that have readers: partitions of one file ask for its footer at the same time, and the second one
/// finds it in the cache.
#[derive(Debug, Default)]
struct FooterReads(Mutex<HashMap<Path, Weak<AsyncMutex<()>>>>);

impl FooterReads {
    fn footer_lock(&self, path: &Path) -> Arc<AsyncMutex<()>> {
        let mut reads = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(read) = reads.get(path).and_then(Weak::upgrade) {
            return read;
        }
        reads.retain(|_, read| read.strong_count() > 0);
        let read = Arc::default();
        reads.insert(path.clone(), Arc::downgrade(&read));
        read
    }
}

/// A reader that waits while another one reads the file's footer, but not for long: nobody polls a query whose reader
/// fetches no rows.
struct FooterReader {
    reader: Box<dyn AsyncFileReader + Send>,
    footer_read: Arc<AsyncMutex<()>>,
}

impl AsyncFileReader for FooterReader {
    fn get_bytes(&mut self, range: Range<u64>) -> BoxFuture<'_, ParquetResult<Bytes>> {
        self.reader.get_bytes(range)
    }

    fn get_byte_ranges(&mut self, ranges: Vec<Range<u64>>) -> BoxFuture<'_, ParquetResult<Vec<Bytes>>> {
        self.reader.get_byte_ranges(ranges)
    }

    fn get_metadata<'a>(
        &'a mut self,
        options: Option<&'a ArrowReaderOptions>,
    ) -> BoxFuture<'a, ParquetResult<Arc<ParquetMetaData>>> {
        async move {
            let _reading = timeout(FOOTER_WAIT, self.footer_read.lock()).await;
            self.reader.get_metadata(options).await
        }
        .boxed()
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
    reader: Box<FooterReader>,
    counters: Arc<CacheCounters>,
    reported: CacheCounts,
    counts: CacheMetrics,
}

impl CountingReader {
    fn report_counts(&mut self) {
        let now = self.counters.read_counts();
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
            self.report_counts();
            read
        }
        .boxed()
    }

    fn get_byte_ranges(&mut self, ranges: Vec<Range<u64>>) -> BoxFuture<'_, ParquetResult<Vec<Bytes>>> {
        async move {
            let read = self.reader.get_byte_ranges(ranges).await;
            self.report_counts();
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
            self.report_counts();
            read
        }
        .boxed()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn readers_of_a_footer_wait_for_each_other_and_leave_nothing() {
        let reads = FooterReads::default();
        let (file, other) = (Path::from("a.parquet"), Path::from("b.parquet"));
        let first = reads.footer_lock(&file);
        let reading = first.lock().await;
        assert!(reads.footer_lock(&file).try_lock().is_err());
        assert!(reads.footer_lock(&other).try_lock().is_ok());
        drop(reading);
        assert!(reads.footer_lock(&file).try_lock().is_ok());
        drop(first);
        let _third = reads.footer_lock(&other);
        assert_eq!(reads.0.lock().expect("locked").len(), 1);
    }
}
