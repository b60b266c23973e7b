//! A place in an object store that files of this machine are copied to, such as an export.

use std::path::Path as FsPath;
use std::sync::Arc;

use futures::{StreamExt as _, TryStreamExt as _, stream};
use object_store::path::Path;
use object_store::{Error as StoreError, ObjectStore, ObjectStoreExt as _, PutMode};
use url::Url;

use super::{PartStore, open_store};
use crate::location_text::{object_text, without_secrets};
use crate::upload::{PARTS_AT_ONCE, part_bytes, read_part};
use crate::{Error, Result};

/// A folder of an object store. What it holds is never overwritten.
///
/// ```no_run
/// # async fn example() -> echolake_lake::Result<()> {
/// let folder = echolake_lake::ObjectFolder::open("s3://bucket/reliefs")?;
/// folder.ensure_empty().await?;
/// folder.send_file(std::path::Path::new("reliefs/README.md"), "README.md").await?;
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct ObjectFolder {
    location: String,
    store: Arc<dyn ObjectStore>,
    parts: PartStore,
}

impl ObjectFolder {
    /// Opens a location such as `s3://bucket/prefix` by the environment's settings. Nothing is requested yet.
    ///
    /// # Errors
    /// [`Error::Location`].
    pub fn open(location: &str) -> Result<Self> {
        let wrong = |source| Error::Location { location: without_secrets(location), source };
        let url = Url::parse(location).map_err(|e| wrong(e.into()))?;
        let (store, parts) = open_store(&url).map_err(wrong)?;
        Ok(Self { location: location.trim_end_matches('/').to_owned(), store, parts })
    }

    /// Checks that nothing is there.
    ///
    /// # Errors
    /// [`Error::ObjectExists`], or what the store says.
    pub async fn ensure_empty(&self) -> Result<()> {
        let first = self.store.list(None).try_next().await;
        match first.map_err(|e| Error::store_failure("list", &self.location, e))? {
            Some(_) => Err(Error::ObjectExists { path: self.location.clone() }),
            None => Ok(()),
        }
    }

    /// Checks that there is no object of this name.
    ///
    /// # Errors
    /// [`Error::ObjectExists`], or what the store says.
    pub async fn ensure_absent(&self, name: &str) -> Result<()> {
        let path = object_text(&self.location, name);
        match self.store.head(&Path::from(name)).await {
            Ok(_) => Err(Error::ObjectExists { path }),
            Err(StoreError::NotFound { .. }) => Ok(()),
            Err(e) => Err(Error::store_failure("read", path, e)),
        }
    }

    /// Sends a file. Its object is there as a whole or not at all.
    ///
    /// # Errors
    /// [`Error::ObjectExists`], [`Error::UploadFile`] if the file cannot be read, or what the store says.
    pub async fn send_file(&self, file: &FsPath, name: &str) -> Result<()> {
        let to = Path::from(name);
        let text = object_text(&self.location, name);
        let failed = |action: &'static str| {
            let text = text.clone();
            move |e| Error::store_failure(action, text, e)
        };
        let unreadable = |source| Error::UploadFile { action: "read", file: file.to_owned(), source, hint: "" };
        let bytes = std::fs::metadata(file).map_err(unreadable)?.len();
        let size = part_bytes(bytes);
        if bytes <= size {
            let content = read_part(file, 0..bytes).await?;
            return match self.store.put_opts(&to, content.into(), PutMode::Create.into()).await {
                Ok(_) => Ok(()),
                Err(StoreError::AlreadyExists { .. }) => Err(Error::ObjectExists { path: text }),
                Err(e) => Err(failed("write")(e)),
            };
        }
        self.ensure_absent(name).await?;
        let upload = self.parts.begin_upload(&to).await.map_err(failed("begin the upload of"))?;
        let send_one = |number: u64| {
            let upload = &upload;
            let to = &to;
            let range = number * size..((number + 1) * size).min(bytes);
            let failed = failed("write");
            async move {
                let part = read_part(file, range).await?;
                self.parts.put_part(to, upload, number as usize, part.into()).await.map_err(failed)
            }
        };
        let numbers = 0..bytes.div_ceil(size);
        let parts = stream::iter(numbers).map(send_one).buffered(PARTS_AT_ONCE).try_collect().await?;
        let Err(error) = self.parts.complete_upload(&to, &upload, parts).await else { return Ok(()) };
        // Its answer may have been lost.
        match self.store.head(&to).await {
            Ok(meta) if meta.size == bytes => Ok(()),
            _ => Err(failed("complete the upload of")(error)),
        }
    }
}
