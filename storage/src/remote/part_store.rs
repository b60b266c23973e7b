//! Uploads of one object in parts, with ids that the caller keeps: another process can resume them.

use std::fmt;
use std::sync::Arc;

use object_store::multipart::{MultipartStore, PartId};
use object_store::path::Path;
use object_store::{PutPayload, Result as StoreResult};

use super::retrying::retry_operation;

/// Uploads in parts to a lake's part of a bucket. Whatever can be repeated is repeated.
pub(crate) struct PartStore {
    store: Arc<dyn MultipartStore>,
    prefix: Path,
    /// Tries of one operation.
    limit: u32,
}

impl fmt::Debug for PartStore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PartStore").field("prefix", &self.prefix).finish_non_exhaustive()
    }
}

impl PartStore {
    pub fn new(store: Arc<dyn MultipartStore>, prefix: Path, limit: u32) -> Self {
        Self { store, prefix, limit }
    }

    fn path_in_bucket(&self, path: &Path) -> Path {
        self.prefix.parts().chain(path.parts()).collect()
    }

    /// Begins an upload; returns its id. An id whose answer was lost is never used: the bucket's rule aborts it.
    pub async fn begin_upload(&self, path: &Path) -> StoreResult<String> {
        let path = self.path_in_bucket(path);
        retry_operation(self.limit, || self.store.create_multipart(&path)).await
    }

    /// Uploads a part; parts count from 0. Returns its id.
    pub async fn put_part(&self, path: &Path, upload: &str, number: usize, part: PutPayload) -> StoreResult<String> {
        let path = self.path_in_bucket(path);
        let upload = upload.to_owned();
        let part_id = retry_operation(self.limit, || self.store.put_part(&path, &upload, number, part.clone())).await?;
        Ok(part_id.content_id)
    }

    /// Makes the object of all parts, by their ids in order.
    pub async fn complete_upload(&self, path: &Path, upload: &str, parts: Vec<String>) -> StoreResult<()> {
        let path = self.path_in_bucket(path);
        let upload = upload.to_owned();
        let parts: Vec<_> = parts.into_iter().map(|content_id| PartId { content_id }).collect();
        retry_operation(self.limit, || self.store.complete_multipart(&path, &upload, parts.clone())).await.map(drop)
    }
}
