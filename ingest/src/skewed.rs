//! A store as a machine whose clock is wrong writes to it, and whose commits of `runs` are preceded by others' work.

use std::fmt;
use std::sync::Arc;

use async_trait::async_trait;
use chrono::TimeDelta;
use futures::future::BoxFuture;
use futures::stream::BoxStream;
use object_store::path::Path;
use object_store::{
    CopyOptions, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta, ObjectStore, PutMultipartOptions,
    PutOptions, PutPayload, PutResult, RenameOptions, Result as StoreResult,
};
use serde_json::Value;

/// Work of another machine, done before each commit of `runs`.
pub(crate) type Interlude = Arc<dyn Fn() -> BoxFuture<'static, ()> + Send + Sync>;

/// A store whose commits have the times of a skewed clock.
pub(crate) struct SkewedStore {
    inner: Arc<dyn ObjectStore>,
    skew: TimeDelta,
    interlude: Option<Interlude>,
}

impl SkewedStore {
    pub(crate) fn new(inner: Arc<dyn ObjectStore>, skew: TimeDelta, interlude: Option<Interlude>) -> Arc<Self> {
        Arc::new(Self { inner, skew, interlude })
    }

    fn shift(&self, commit: &[u8]) -> Vec<u8> {
        let mut shifted = Vec::new();
        for line in commit.split(|b| *b == b'\n').filter(|line| !line.is_empty()) {
            let mut line: Value = serde_json::from_slice(line).expect("an action");
            for action in line.as_object_mut().expect("an object").values_mut() {
                for name in ["timestamp", "modificationTime", "deletionTimestamp", "createdTime"] {
                    if let Some(time) = action.get_mut(name) {
                        *time = (time.as_i64().expect("a time") + self.skew.num_milliseconds()).into();
                    }
                }
            }
            shifted.extend(serde_json::to_vec(&line).expect("JSON"));
            shifted.push(b'\n');
        }
        shifted
    }
}

impl fmt::Debug for SkewedStore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SkewedStore").field("skew", &self.skew).finish_non_exhaustive()
    }
}

impl fmt::Display for SkewedStore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("SkewedStore")
    }
}

#[async_trait]
impl ObjectStore for SkewedStore {
    async fn put_opts(&self, location: &Path, payload: PutPayload, opts: PutOptions) -> StoreResult<PutResult> {
        let is_commit = location.as_ref().contains("/_delta_log/") && location.extension() == Some("json");
        if !is_commit {
            return self.inner.put_opts(location, payload, opts).await;
        }
        if let Some(interlude) = self.interlude.as_ref().filter(|_| location.as_ref().starts_with("tables/runs/")) {
            interlude().await;
        }
        let bytes: Vec<u8> = payload.iter().flatten().copied().collect();
        self.inner.put_opts(location, self.shift(&bytes).into(), opts).await
    }

    async fn put_multipart_opts(
        &self,
        location: &Path,
        opts: PutMultipartOptions,
    ) -> StoreResult<Box<dyn MultipartUpload>> {
        self.inner.put_multipart_opts(location, opts).await
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> StoreResult<GetResult> {
        self.inner.get_opts(location, options).await
    }

    fn delete_stream(&self, locations: BoxStream<'static, StoreResult<Path>>) -> BoxStream<'static, StoreResult<Path>> {
        self.inner.delete_stream(locations)
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, StoreResult<ObjectMeta>> {
        self.inner.list(prefix)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> StoreResult<ListResult> {
        self.inner.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> StoreResult<()> {
        self.inner.copy_opts(from, to, options).await
    }

    async fn rename_opts(&self, from: &Path, to: &Path, options: RenameOptions) -> StoreResult<()> {
        self.inner.rename_opts(from, to, options).await
    }
}
