//! A lake's location: a folder, `file://`, `memory://`, or a bucket of an object store.

use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

use echolake_schema::ErrorCause;
use object_store::ObjectStore;
use object_store::memory::InMemory;
use object_store::path::Path as ObjectPath;
use object_store::prefix::PrefixStore;
use url::Url;

use crate::durable::DurableFileSystem;
use crate::location_text::without_secrets;
#[cfg(feature = "tables")]
use crate::remote::CachedStore;
#[cfg(feature = "remote")]
use crate::remote::{ExclusionFault, RemoteStore, probe_exclusion};
use crate::{Error, Result};

/// A lake's location, opened.
#[derive(Debug, Clone)]
pub(crate) struct LakeLocation {
    /// As the user wrote it.
    pub text: String,
    /// The folder, if it is one.
    pub folder: Option<PathBuf>,
    /// The lake alone.
    pub store: Arc<dyn ObjectStore>,
    /// If it is an object store: what it does beyond `store`.
    #[cfg(feature = "remote")]
    pub remote: Option<Arc<RemoteStore>>,
    /// The same store, if it has a cache.
    #[cfg(feature = "tables")]
    pub cached: Option<CachedStore>,
}

impl LakeLocation {
    pub fn parse(text: &str) -> Result<Self> {
        let wrong = |source: ErrorCause| Error::Location { location: without_secrets(text), source };
        if text.trim().is_empty() {
            return Err(wrong("it is empty".into()));
        }
        if !text.contains("://") {
            return Self::from_folder(text, Path::new(text));
        }
        let url = Url::parse(text).map_err(|e| wrong(e.into()))?;
        match url.scheme() {
            "file" => {
                Self::from_folder(text, &url.to_file_path().map_err(|()| wrong("it names no local folder".into()))?)
            }
            "memory" => Ok(Self::from_store(text, Arc::new(InMemory::new()))),
            #[cfg(feature = "remote")]
            _ => {
                let (store, parts) = crate::remote::open_store(&url).map_err(wrong)?;
                let remote = RemoteStore { parts: Some(parts), ..RemoteStore::default() };
                Ok(Self { remote: Some(Arc::new(remote)), ..Self::from_store(text.trim_end_matches('/'), store) })
            }
            #[cfg(not(feature = "remote"))]
            scheme => Err(wrong(format!("this build does not reach `{scheme}://`").into())),
        }
    }

    /// Probes, before the first write of this process, if an object store lets one alone create an object. Folders do.
    ///
    /// # Errors
    /// [`Error::NotExclusive`], or what the store says.
    #[cfg(feature = "remote")]
    pub async fn ensure_exclusive(&self) -> Result<()> {
        let Some(remote) = &self.remote else { return Ok(()) };
        let probe = async {
            probe_exclusion(&self.store).await.map_err(|fault| match fault {
                ExclusionFault::Overwrites(observed) => Error::NotExclusive { location: self.text.clone(), observed },
                ExclusionFault::Store(cause) => Error::store_failure("write", &self.text, cause),
            })
        };
        remote.probed.get_or_try_init(|| probe).await.copied()
    }

    /// A store that holds nothing but the lake.
    pub fn from_store(text: &str, store: Arc<dyn ObjectStore>) -> Self {
        Self {
            text: text.to_owned(),
            folder: None,
            store,
            #[cfg(feature = "remote")]
            remote: None,
            #[cfg(feature = "tables")]
            cached: None,
        }
    }

    /// The same, of a store that is taken for a remote one if its name is a URL of one.
    pub fn named_store(name: &str, store: Arc<dyn ObjectStore>) -> Self {
        Self {
            #[cfg(feature = "remote")]
            remote: crate::remote_access(name).map(|_| Arc::default()),
            ..Self::from_store(name, store)
        }
    }

    fn from_folder(text: &str, path: &Path) -> Result<Self> {
        let wrong = |source: ErrorCause| Error::Location { location: without_secrets(text), source };
        let absolute = resolved_path(path).map_err(|e| wrong(e.into()))?;
        if absolute.exists() && !absolute.is_dir() {
            return Err(wrong("it is a file".into()));
        }
        let prefix = ObjectPath::from_absolute_path(&absolute).map_err(|e| wrong(e.into()))?;
        let store = Arc::new(PrefixStore::new(DurableFileSystem::new(&absolute), prefix));
        Ok(Self { folder: Some(absolute), ..Self::from_store(text, store) })
    }
}

/// Returns the absolute path without `..`, which paths of object stores cannot hold. Links are followed before a `..`
/// alone, as the system does.
fn resolved_path(path: &Path) -> std::io::Result<PathBuf> {
    let mut resolved = PathBuf::new();
    for part in std::path::absolute(path)?.components() {
        if part == Component::ParentDir {
            resolved = resolved.canonicalize()?;
            resolved.pop();
        } else {
            resolved.push(part);
        }
    }
    Ok(resolved)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nonsense_is_refused_with_a_hint() {
        for bad in
            ["", "s3://", "s3://key:secret@bucket/lake", "s3://bucket/lake?x", "http://host/lake", "://", "/dev/null"]
        {
            let error = LakeLocation::parse(bad).expect_err(bad).to_string();
            assert!(error.contains("hint"), "{error}");
        }
    }

    #[test]
    fn what_may_be_secret_is_not_repeated() {
        for bad in [
            "s3://key:s3cret@bucket/lake",
            "s3://key:s3c/ret@bucket/lake",
            "s3://key:s3cret@bu cket",
            "s3://s3cret@bucket",
            "az://container/lake?sig=s3cret",
            "http://key:s3c@ret@host/lake?x=s3cret",
            "gs://bucket/lake#s3cret",
        ] {
            let error = LakeLocation::parse(bad).expect_err(bad).to_string();
            assert!(!error.contains("s3c") && !error.contains("ret@") && error.contains("***"), "{error}");
        }
    }

    #[test]
    fn folders_and_file_urls_are_the_same() {
        let folder = tempfile::tempdir().expect("a folder");
        let plain = LakeLocation::parse(&folder.path().display().to_string()).expect("a folder");
        let url = Url::from_directory_path(folder.path()).expect("its URL");
        let url = LakeLocation::parse(url.as_str()).expect("a folder");
        assert_eq!(plain.folder, url.folder);
    }

    #[test]
    fn parent_folders_are_resolved() {
        let folder = tempfile::tempdir().expect("a folder");
        let root = folder.path().canonicalize().expect("it is there");
        std::fs::create_dir_all(root.join("a/b")).expect("made");
        let resolved =
            |path: &str| LakeLocation::parse(&root.join(path).display().to_string()).map(|found| found.folder);
        assert_eq!(resolved("a/b/../lake").expect("a folder"), Some(root.join("a/lake")));
        assert_eq!(resolved("a/../a/b/../../lake").expect("a folder"), Some(root.join("lake")));
        assert!(resolved("missing/../lake").is_err(), "the system does not find it either");
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(root.join("a/b"), root.join("link")).expect("linked");
            assert_eq!(resolved("link/../lake").expect("a folder"), Some(root.join("a/lake")));
        }
    }
}
