//! Deletes files that no log names any more and no reader can hold any more.

use std::path::{Path as FsPath, PathBuf};
use std::time::SystemTime;

use chrono::{DateTime, TimeDelta, Utc};
use echolake_schema::tables::Table;
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::ObjectStore as _;
use object_store::path::Path;
use serde::Serialize;

use crate::locks::{CLAIMS_FOLDER, MaintenanceLease};
use crate::tables::file_name::table_folder;
use crate::{Error, FileHistory, Lake, Result};

/// Hours for which a file is kept after it left its table, by default and at most: Delta's log forgets the time of
/// removal after a week.
pub const KEEP_HOURS: u32 = 168;
/// Least age for deleting a file that no log ever named: an ingest writes files first and commits them within minutes.
const BEFORE_COMMIT: TimeDelta = TimeDelta::hours(1);
/// Files that one request deletes on an object store.
const DELETED_AT_ONCE: usize = 500;
/// Folder of recordings that are copied in.
const INBOX: &str = "inbox";

/// Choice between deleting files and listing them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DeletionMode {
    /// Files are deleted.
    Real,
    /// Files are only reported.
    Pretended,
}

/// The files that were deleted, or would be.
#[derive(Debug, Clone, Default, Serialize)]
pub struct VacuumReport {
    /// The files.
    pub files: Vec<DeletedFile>,
    /// Their bytes.
    pub bytes: u64,
}

/// One file that was deleted.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct DeletedFile {
    /// Path in the lake.
    pub path: String,
    /// Size.
    pub bytes: u64,
    #[serde(skip)]
    place: FileAccess,
}

/// Access to a file: by the store or by the local file system.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum FileAccess {
    Store(Path),
    /// The store does not list a local write's temporary file.
    Local(PathBuf),
}

impl Lake {
    /// Deletes, under the maintenance lease, files that left their table longer ago than `keep`, and temporary and
    /// uncommitted files that crashes left behind. Files in `runs/` and those of tagged versions are not touched.
    ///
    /// # Errors
    /// [`Error::Maintained`] if another process holds the lease, [`Error::LeaseLost`], [`Error::Log`] if a log is
    /// damaged, or what the store says. What was deleted before is so.
    pub async fn vacuum(
        &self,
        keep: TimeDelta,
        deletion: DeletionMode,
        deleted: &mut (dyn FnMut(usize, usize) + Send),
    ) -> Result<VacuumReport> {
        if deletion == DeletionMode::Pretended {
            return self.left_over(keep).await;
        }
        let mut lease = MaintenanceLease::acquire(self).await?;
        let done = self.delete_left_over(keep, deleted, &mut lease).await;
        let released = lease.release().await;
        done.and_then(|report| released.map(|()| report))
    }

    async fn delete_left_over(
        &self,
        keep: TimeDelta,
        deleted: &mut (dyn FnMut(usize, usize) + Send),
        lease: &mut MaintenanceLease,
    ) -> Result<VacuumReport> {
        let report = self.left_over(keep).await?;
        let mut done = 0;
        for files in report.files.chunks(if self.is_remote() { DELETED_AT_ONCE } else { 1 }) {
            lease.ensure_held().await?;
            let mut stored = Vec::new();
            for file in files {
                match &file.place {
                    FileAccess::Store(path) => stored.push(Ok(path.clone())),
                    // Its writer may have taken it away.
                    FileAccess::Local(path) => drop(std::fs::remove_file(path)),
                }
            }
            let mut gone = self.store().delete_stream(futures::stream::iter(stored).boxed());
            while let Some(one) = gone.next().await {
                match one {
                    Err(e) if !matches!(e, object_store::Error::NotFound { .. }) => {
                        return Err(Error::store_failure("delete", "tables", e));
                    }
                    _ => {}
                }
            }
            done += files.len();
            deleted(done, report.files.len());
        }
        Ok(report)
    }

    // The store is listed before the logs are read, so that whatever is committed meanwhile is named.
    async fn left_over(&self, keep: TimeDelta) -> Result<VacuumReport> {
        let now = Utc::now();
        let mut files = Vec::new();
        let old = |modified| is_over(modified, None, now, keep);
        let tagged_versions = self.tagged_versions().await?;
        for table in Table::ALL {
            let there = self.store().list_with_delimiter(Some(&table_folder(table))).await;
            let there = there.map_err(|e| Error::store_failure("list", table_folder(table), e))?;
            // Without a log, nothing says what the files are.
            let Some(history) = self.commit_log().file_history(table).await? else { continue };
            let tagged = self.files_at_versions(table, &tagged_versions).await?;
            for meta in there.objects {
                if !tagged.contains(&meta.location)
                    && is_left_over(&history, &meta.location, |gone| is_over(meta.last_modified, gone, now, keep))
                {
                    files.push(DeletedFile::from_object(meta.location, meta.size));
                }
            }
        }
        let inbox = self.list_folder(INBOX).await?.files;
        let is_unfinished = |path: &Path| matches!(path.extension(), Some("copying" | "uploading"));
        let unfinished = inbox.into_iter().filter(|m| is_unfinished(&m.location) && old(m.last_modified));
        // Claims of processes that died.
        let claims = Path::from(CLAIMS_FOLDER);
        let claims: Vec<_> = self
            .store()
            .list(Some(&claims))
            .try_collect()
            .await
            .map_err(|e| Error::store_failure("list", claims, e))?;
        let claims = claims.into_iter().filter(|meta| old(meta.last_modified));
        files.extend(unfinished.chain(claims).map(|meta| DeletedFile::from_object(meta.location, meta.size)));
        if let Some(lake) = self.folder() {
            let mut temporaries = Vec::new();
            ["tables", INBOX].iter().for_each(|name| find_temporaries(&lake.join(name), &mut temporaries));
            let old = temporaries.into_iter().filter(|(_, modified, _)| old(DateTime::<Utc>::from(*modified)));
            files.extend(old.map(|(path, _, bytes)| {
                let within = path.strip_prefix(lake).unwrap_or(&path).display().to_string();
                DeletedFile { path: within, bytes, place: FileAccess::Local(path) }
            }));
        }
        files.sort();
        Ok(VacuumReport { bytes: files.iter().map(|f| f.bytes).sum(), files })
    }
}

impl DeletedFile {
    fn from_object(path: Path, bytes: u64) -> Self {
        Self { path: path.to_string(), bytes, place: FileAccess::Store(path) }
    }
}

fn is_left_over(history: &FileHistory, path: &Path, is_over: impl Fn(Option<DateTime<Utc>>) -> bool) -> bool {
    let Some(name) = path.filename() else { return false };
    path.extension() == Some("parquet")
        && !history.current.contains(name)
        && is_over(history.removed.get(name).copied())
}

// A file that was modified after its removal was rewritten, for a commit that is still pending.
fn is_over(modified: DateTime<Utc>, gone: Option<DateTime<Utc>>, now: DateTime<Utc>, keep: TimeDelta) -> bool {
    match gone {
        Some(gone) if gone >= modified => now - gone >= keep,
        _ => now - modified >= keep.max(BEFORE_COMMIT),
    }
}

// `name#123`: what a local write has not brought to its end. Folders that cannot be read hold none of ours.
fn find_temporaries(folder: &FsPath, found: &mut Vec<(PathBuf, SystemTime, u64)>) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        let name = entry.file_name();
        let Ok(meta) = entry.metadata() else { continue };
        if meta.is_dir() {
            find_temporaries(&path, found);
            continue;
        }
        let name = name.to_string_lossy();
        let number = name.rsplit_once('#').map(|(_, number)| number);
        if let (Some(number), Ok(modified)) = (number, meta.modified())
            && !number.is_empty()
            && number.bytes().all(|b| b.is_ascii_digit())
        {
            found.push((path, modified, meta.len()));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_kept_from_their_removal_on_and_new_ones_until_they_are_committed() {
        let at = |hour: i64| DateTime::from_timestamp(hour * 3600, 0).expect("a time");
        let over =
            |modified, gone: Option<i64>, keep| is_over(at(modified), gone.map(at), at(100), TimeDelta::hours(keep));
        assert!(over(0, Some(50), 50) && !over(0, Some(51), 50), "counted from the removal");
        assert!(over(0, Some(100), 0), "gone, and nobody waits");
        assert!(over(99, None, 0) && !over(100, None, 0), "an ingest may be about to name it");
        assert!(over(50, None, 50) && !over(51, None, 50));
        assert!(!over(100, Some(50), 0), "written anew");
    }
}
