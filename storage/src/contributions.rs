//! Contributions: what users add to a lake, annotations and predictions. Each accepted request is a numbered object
//! that never changes, in a folder beside `tables/`, so that tables which are deleted and made again lose none.
//!
//! 1. A writer creates the object of the next number. Of several writers of a number, the store lets one succeed.
//! 2. A commit of `runs` names the highest number that readers see, as Delta's action `txn`. From then on readers see
//!    it, and every version of the lake has its own contributions.
//!
//! An object whose commit is missing, because its writer ended between the two steps, is seen with the next commit.

use bytes::Bytes;
use echolake_schema::annotations::Annotation;
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _, PutMode};

use crate::{Error, Lake, Result};

/// Objects that are read concurrently.
const TOGETHER: usize = 16;

/// A sequence of contributions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ContributionLog {
    /// Labels, verdicts and notes: JSON objects, one per line.
    Annotations,
    /// Predictions of models: Parquet.
    Predictions,
}

/// The highest numbers that readers see at a version of the lake; 0 if there are none.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ContributionCounts {
    /// Of annotations.
    pub annotations: u64,
    /// Of predictions.
    pub predictions: u64,
}

/// A numbered object of a log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ContributionFile {
    /// Its number, from 1.
    pub number: u64,
    /// Path in the lake.
    pub path: Path,
    /// Size.
    pub bytes: u64,
}

impl ContributionLog {
    /// All logs.
    pub const ALL: [Self; 2] = [Self::Annotations, Self::Predictions];

    /// Its name: that of its folder and of its table in SQL.
    pub fn name(self) -> &'static str {
        match self {
            Self::Annotations => "annotations",
            Self::Predictions => "predictions",
        }
    }

    /// The log of this name.
    pub fn by_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|log| log.name() == name)
    }

    fn extension(self) -> &'static str {
        match self {
            Self::Annotations => "ndjson",
            Self::Predictions => "parquet",
        }
    }

    /// The application of Delta's action `txn`.
    pub(crate) fn application(self) -> String {
        format!("echolake.{}", self.name())
    }

    fn path(self, number: u64) -> Path {
        Path::from(self.name()).join(format!("{number:020}.{}", self.extension()))
    }

    fn number_of(self, path: &Path) -> Option<u64> {
        let digits = path.filename()?.strip_suffix(self.extension())?.strip_suffix('.')?;
        (digits.len() == 20).then(|| digits.parse().ok()).flatten()
    }

    /// The files in the folder by number.
    pub(crate) async fn list_files(self, store: &dyn ObjectStore) -> Result<Vec<ContributionFile>> {
        let folder = Path::from(self.name());
        let listed: Vec<_> =
            store.list(Some(&folder)).try_collect().await.map_err(|e| Error::store_failure("list", &folder, e))?;
        let numbered = listed.into_iter().filter_map(|meta| {
            let number = self.number_of(&meta.location)?;
            Some(ContributionFile { number, path: meta.location, bytes: meta.size })
        });
        let mut files: Vec<_> = numbered.collect();
        files.sort_by_key(|file| file.number);
        Ok(files)
    }
}

impl ContributionCounts {
    /// The number of a log.
    pub fn of_log(self, log: ContributionLog) -> u64 {
        match log {
            ContributionLog::Annotations => self.annotations,
            ContributionLog::Predictions => self.predictions,
        }
    }
}

impl Lake {
    /// The files of a log up to a number, by number; those that no version of the lake shows yet are among them if
    /// `up_to` is `u64::MAX`.
    ///
    /// # Errors
    /// [`Error::LostContribution`] if one is missing, or what the store says.
    pub async fn list_contributions(&self, log: ContributionLog, up_to: u64) -> Result<Vec<ContributionFile>> {
        if up_to == 0 {
            return Ok(Vec::new());
        }
        let mut files = log.list_files(self.store().as_ref()).await?;
        files.retain(|file| file.number <= up_to);
        let last = if up_to == u64::MAX { files.last().map_or(0, |file| file.number) } else { up_to };
        let lost = (1..=last).zip(files.iter().map(|file| Some(file.number)).chain([None]));
        match lost.into_iter().find(|(number, there)| *there != Some(*number)) {
            Some((number, _)) => Err(Error::LostContribution { path: log.path(number).to_string() }),
            None => Ok(files),
        }
    }

    /// The bytes of a contribution.
    ///
    /// # Errors
    /// [`Error::LostContribution`], or what the store says.
    pub async fn read_contribution(&self, log: ContributionLog, number: u64) -> Result<Bytes> {
        let path = log.path(number);
        match self.store().get(&path).await {
            Ok(found) => found.bytes().await.map_err(|e| Error::store_failure("read", &path, e)),
            Err(object_store::Error::NotFound { .. }) => Err(Error::LostContribution { path: path.to_string() }),
            Err(e) => Err(Error::store_failure("read", &path, e)),
        }
    }

    /// The annotations of numbers after `after` up to `up_to`, in their order.
    ///
    /// # Errors
    /// [`Error::LostContribution`], [`Error::DamagedContribution`], or what the store says.
    pub async fn read_annotations(&self, after: u64, up_to: u64) -> Result<Vec<Annotation>> {
        let log = ContributionLog::Annotations;
        let read = futures::stream::iter(after + 1..=up_to).map(|number| async move {
            let bytes = self.read_contribution(log, number).await?;
            parse_annotations(number, &bytes).map_err(|reason| {
                let path = log.path(number).to_string();
                Error::DamagedContribution { path, reason }
            })
        });
        read.buffered(TOGETHER).try_concat().await
    }

    /// Creates the object of a number; false if the number is taken. Readers do not see it before
    /// [`Lake::commit_contributions`].
    ///
    /// # Errors
    /// What the store says.
    pub async fn create_contribution(&self, log: ContributionLog, number: u64, bytes: Bytes) -> Result<bool> {
        let path = log.path(number);
        match self.store().put_opts(&path, bytes.into(), PutMode::Create.into()).await {
            Ok(_) => Ok(true),
            Err(object_store::Error::AlreadyExists { .. }) => Ok(false),
            Err(e) => Err(Error::store_failure("write", &path, e)),
        }
    }

    /// Shows the contributions up to a number to readers; returns the version of the lake that shows them.
    ///
    /// # Errors
    /// [`Error::Log`] if the log of `runs` is damaged, or what the store says.
    pub async fn commit_contributions(&self, log: ContributionLog, number: u64) -> Result<u64> {
        self.commit_log().commit_contributions(log, number).await
    }
}

fn parse_annotations(number: u64, bytes: &[u8]) -> std::result::Result<Vec<Annotation>, String> {
    let lines = bytes.split(|byte| *byte == b'\n').filter(|line| !line.is_empty());
    let parsed = lines.enumerate().map(|(i, line)| match serde_json::from_slice::<Annotation>(line) {
        Ok(annotation) if annotation.number == number => Ok(annotation),
        Ok(annotation) => Err(format!("line {}: its number is {}", i + 1, annotation.number)),
        Err(e) => Err(format!("line {}: {e}", i + 1)),
    });
    parsed.collect()
}

#[cfg(test)]
mod tests {
    use echolake_schema::Rig;

    use super::*;
    use crate::{LakeMoment, ReferenceSurfaces};

    async fn open(url: &str) -> Lake {
        Lake::open_or_create(url, &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake")
    }

    async fn add(lake: &Lake, number: u64) -> u64 {
        let log = ContributionLog::Annotations;
        assert!(lake.create_contribution(log, number, format!("{number}").into()).await.expect("written"));
        lake.commit_contributions(log, number).await.expect("committed")
    }

    #[tokio::test]
    async fn versions_have_their_contributions_and_tables_made_again_lose_none() {
        let folder = tempfile::tempdir().expect("a folder");
        let url = folder.path().join("lake").display().to_string();
        let lake = open(&url).await;
        let log = ContributionLog::Annotations;
        let before = lake.version_at(&LakeMoment::Version(0)).await.expect("a version");
        let first = add(&lake, 1).await;
        assert!(!lake.create_contribution(log, 1, "other".into()).await.expect("looked at"), "the number is taken");
        let mut last = first;
        // Past a checkpoint, which keeps the number.
        for number in 2..=45 {
            last = add(&lake, number).await;
        }
        assert_eq!(lake.commit_contributions(log, 45).await.expect("there"), last, "nothing is committed twice");
        let reader = open(&url).await;
        let counts = |n| ContributionCounts { annotations: n, predictions: 0 };
        assert_eq!(reader.snapshot().await.expect("a view").contributions(), counts(45));
        for (version, expected) in [(before, 0), (first, 1), (last, 45)] {
            assert_eq!(reader.contributions_at(version).await.expect("known"), counts(expected), "{version}");
        }
        assert_eq!(reader.read_contribution(log, 7).await.expect("bytes"), "7");
        std::fs::remove_dir_all(folder.path().join("lake/tables")).expect("removed");
        let again = open(&url).await;
        assert_eq!(again.snapshot().await.expect("a view").contributions(), counts(45));
        let path = folder.path().join("lake").join(log.path(7).as_ref());
        std::fs::remove_file(&path).expect("removed");
        let lost = again.list_contributions(log, 45).await.expect_err("lost").to_string();
        assert!(lost.contains("annotations/00000000000000000007.ndjson"), "{lost}");
    }
}
