//! Lakes on object stores: S3 and what speaks its protocol, Google Cloud Storage, Azure Blob Storage.
//!
//! A bucket and a prefix name the lake; all other settings are the environment's, by the names that each store's own
//! tools use.

#[cfg(feature = "tables")]
mod cache;
mod exclusion;
#[cfg(feature = "tables")]
mod object_folder;
mod part_store;
mod retrying;
mod settings;
mod store_threads;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use echolake_schema::ErrorCause;
use object_store::ObjectStore;
use object_store::path::Path as ObjectPath;
use object_store::prefix::PrefixStore;
use tokio::sync::OnceCell;
use url::Url;

#[cfg(feature = "tables")]
pub(crate) use cache::{BlockCache, BlockFolder, CachedStore};
#[cfg(feature = "tables")]
pub use cache::{CACHE_MEMORY_BYTES, CacheCounters, CacheCounts, CacheFolder};
pub(crate) use exclusion::{ExclusionFault, create_object, probe_exclusion};
#[cfg(feature = "tables")]
pub use object_folder::ObjectFolder;
pub(crate) use part_store::PartStore;
#[cfg(feature = "tables")]
pub(crate) use retrying::backoff_time;
pub(crate) use retrying::{RetriedError, RetryingStore, count_requests, is_forbidden, list_causes};

/// Abilities of an object store beyond reads and writes of whole objects.
#[derive(Debug, Default)]
pub(crate) struct RemoteStore {
    /// The result of the probe that writers make first.
    pub probed: OnceCell<()>,
    /// Uploads in parts.
    pub parts: Option<PartStore>,
}

/// Opens the store of a URL such as `s3://bucket/prefix`, from its prefix on. Nothing is requested yet.
///
/// # Errors
/// An unknown scheme, a URL with more than bucket and prefix, or settings that do not go together.
pub(crate) fn open_store(url: &Url) -> Result<(Arc<dyn ObjectStore>, PartStore), ErrorCause> {
    let bucket = url.host_str().filter(|bucket| !bucket.is_empty()).ok_or("it names no bucket")?;
    if !url.username().is_empty() || url.password().is_some() {
        return Err("credentials are read from the environment, never from a URL".into());
    }
    if url.port().is_some() || url.query().is_some() || url.fragment().is_some() {
        return Err("expected a bucket and a prefix, and nothing else".into());
    }
    let prefix = ObjectPath::from_url_path(url.path())?;
    let (store, parts) = settings::build_store(url.scheme(), bucket)?;
    let limit = settings::max_attempts()?.unwrap_or(retrying::RETRY_LIMIT);
    let parts = PartStore::new(parts, prefix.clone(), limit);
    let store: Arc<dyn ObjectStore> = Arc::new(RetryingStore::new(store, limit));
    let has_prefix = !prefix.as_ref().is_empty();
    Ok((if has_prefix { Arc::new(PrefixStore::new(store, prefix)) } else { store }, parts))
}

pub use settings::{RemoteAccess, remote_access};
