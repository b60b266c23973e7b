//! A store in memory that dies at one of its writes, for crash tests.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use async_trait::async_trait;
use futures::stream::BoxStream;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{
    CopyOptions, Error as StoreError, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta, ObjectStore,
    PutMultipartOptions, PutOptions, PutPayload, PutResult, RenameOptions, Result as StoreResult,
};

/// The moment of a store's death.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum DeathMoment {
    /// The write is not made.
    Before,
    /// The write is made, and its author gets an error.
    After,
}

/// A store that dies at its nth write; all later writes fail.
#[derive(Debug)]
pub(crate) struct MortalStore {
    inner: Arc<InMemory>,
    writes: AtomicUsize,
    last: usize,
    death: DeathMoment,
}

impl MortalStore {
    pub(crate) fn new(inner: Arc<InMemory>, last: usize, death: DeathMoment) -> Arc<Self> {
        Arc::new(Self { inner, writes: AtomicUsize::new(0), last, death })
    }

    /// Returns whether the store has died.
    pub(crate) fn died(&self) -> bool {
        self.writes.load(Ordering::SeqCst) > self.last
    }

    // Returns (made, acknowledged): whether the write is made, and whether its author gets its result.
    fn write(&self) -> (bool, bool) {
        let number = self.writes.fetch_add(1, Ordering::SeqCst);
        (number < self.last || (number == self.last && self.death == DeathMoment::After), number < self.last)
    }

    async fn mutate<T>(&self, work: impl Future<Output = StoreResult<T>>) -> StoreResult<T> {
        let (made, heard) = self.write();
        let done = if made { Some(work.await) } else { None };
        done.filter(|_| heard).unwrap_or_else(|| Err(dead()))
    }
}

fn dead() -> StoreError {
    StoreError::Generic { store: "Mortal", source: "the power is gone".into() }
}

impl fmt::Display for MortalStore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Mortal")
    }
}

#[async_trait]
impl ObjectStore for MortalStore {
    async fn put_opts(&self, location: &Path, payload: PutPayload, opts: PutOptions) -> StoreResult<PutResult> {
        self.mutate(self.inner.put_opts(location, payload, opts)).await
    }

    async fn put_multipart_opts(
        &self,
        location: &Path,
        opts: PutMultipartOptions,
    ) -> StoreResult<Box<dyn MultipartUpload>> {
        self.mutate(self.inner.put_multipart_opts(location, opts)).await
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> StoreResult<GetResult> {
        self.inner.get_opts(location, options).await
    }

    fn delete_stream(&self, locations: BoxStream<'static, StoreResult<Path>>) -> BoxStream<'static, StoreResult<Path>> {
        match self.write() {
            (true, true) => self.inner.delete_stream(locations),
            _ => Box::pin(futures::stream::once(async { Err(dead()) })),
        }
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, StoreResult<ObjectMeta>> {
        self.inner.list(prefix)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> StoreResult<ListResult> {
        self.inner.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> StoreResult<()> {
        self.mutate(self.inner.copy_opts(from, to, options)).await
    }

    // Atomic, as in a file system.
    async fn rename_opts(&self, from: &Path, to: &Path, options: RenameOptions) -> StoreResult<()> {
        self.mutate(self.inner.rename_opts(from, to, options)).await
    }
}
