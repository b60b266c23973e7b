//! A lake's location: a folder, `file://` or `memory://`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use echolake_schema::ErrorCause;
use object_store::ObjectStore;
use object_store::memory::InMemory;
use object_store::path::Path as ObjectPath;
use object_store::prefix::PrefixStore;
use url::Url;

use crate::durable::DurableFileSystem;
use crate::{Error, Result};

/// A lake's location, opened.
#[derive(Debug, Clone)]
pub(crate) struct LakeLocation {
    /// As the user wrote it.
    pub(crate) text: String,
    /// The folder, if it is one.
    pub(crate) folder: Option<PathBuf>,
    /// The lake alone.
    pub(crate) store: Arc<dyn ObjectStore>,
}

impl LakeLocation {
    pub(crate) fn parse(text: &str) -> Result<Self> {
        let wrong = |source: ErrorCause| Error::Location { location: text.to_owned(), source };
        if text.trim().is_empty() {
            return Err(wrong("it is empty".into()));
        }
        if !text.contains("://") {
            return Self::folder(text, Path::new(text));
        }
        let url = Url::parse(text).map_err(|e| wrong(e.into()))?;
        match url.scheme() {
            "file" => Self::folder(text, &url.to_file_path().map_err(|()| wrong("it names no local folder".into()))?),
            "memory" => Ok(Self::store(text, Arc::new(InMemory::new()))),
            scheme => Err(wrong(format!("this build does not reach `{scheme}://`").into())),
        }
    }

    /// A store that holds nothing but the lake.
    pub(crate) fn store(text: &str, store: Arc<dyn ObjectStore>) -> Self {
        Self { text: text.to_owned(), folder: None, store }
    }

    fn folder(text: &str, path: &Path) -> Result<Self> {
        let wrong = |source: ErrorCause| Error::Location { location: text.to_owned(), source };
        let absolute = std::path::absolute(path).map_err(|e| wrong(e.into()))?;
        if absolute.exists() && !absolute.is_dir() {
            return Err(wrong("it is a file".into()));
        }
        let prefix = ObjectPath::from_absolute_path(&absolute).map_err(|e| wrong(e.into()))?;
        let store = Arc::new(PrefixStore::new(DurableFileSystem::new(), prefix));
        Ok(Self { text: text.to_owned(), folder: Some(absolute), store })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nonsense_is_refused_with_a_hint() {
        for bad in ["", "s3://bucket/lake", "http://host/lake", "://", "/dev/null"] {
            let error = LakeLocation::parse(bad).expect_err(bad).to_string();
            assert!(error.contains("hint"), "{error}");
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
}
