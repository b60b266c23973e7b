//! Takes runs out of a lake: their files leave `runs/` first, then their rows leave the tables.
//!
//! The order makes a removal that was cut off one that can be resumed: without its file, no ingest brings a run back.
//! Its row in `runs` goes before its other rows, so that readers see all of it or nothing.

use std::collections::BTreeSet;

use echolake_lake::{Lake, LakeSnapshot, RemovalRecord, VisibleRun};
use echolake_schema::tables::Table;
use echolake_schema::{RunId, SurfaceId};
use object_store::path::Path;
use object_store::{Error as StoreError, ObjectStoreExt as _};
use serde::Serialize;

use crate::error::{Error, Result};
use crate::inbox::{self, RunSource};
use crate::ingest::LakeIngest;
use crate::report::FileReport;

/// What becomes of a removed run's file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RemovedFile {
    /// It is moved to `quarantine/`.
    Kept,
    /// It is deleted.
    Deleted,
}

/// A run that is to be removed, or was.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct RunRemoval {
    /// The run.
    #[serde(rename = "run_id")]
    pub run: RunId,
    /// Its surface.
    #[serde(rename = "surface_id")]
    pub surface: SurfaceId,
    /// Its measurements that readers see.
    pub measurements: u64,
    /// Its file; None if it is gone already.
    pub file: Option<String>,
    /// Size of the file.
    pub bytes: u64,
    /// The path to which the file was moved.
    pub moved_to: Option<String>,
}

/// Finds runs in a lake by their names.
///
/// # Errors
/// [`Error::NoRun`] if the lake has neither file nor rows of one of them, or an error of the lake.
pub async fn find_removals(lake: &Lake, names: &[String]) -> Result<Vec<RunRemoval>> {
    let snapshot = lake.snapshot().await?;
    let mut found: Vec<RunRemoval> = Vec::with_capacity(names.len());
    for name in names {
        let removal = find_removal(lake, &snapshot, name).await?;
        if found.iter().all(|other| other.run != removal.run) {
            found.push(removal);
        }
    }
    Ok(found)
}

async fn find_removal(lake: &Lake, snapshot: &LakeSnapshot, name: &str) -> Result<RunRemoval> {
    let absent = || Error::NoRun { given: name.to_owned() };
    let stem = name.rsplit('/').next().unwrap_or_default();
    let run: RunId = stem.strip_suffix(".mcap").unwrap_or(stem).parse().map_err(|_| absent())?;
    let surface = match snapshot.run(&run) {
        Some(visible) => visible.surface.clone(),
        None => run.untagged_name().split_once('-').and_then(|(_, surface)| surface.parse().ok()).ok_or_else(absent)?,
    };
    let path = Lake::run_path(&surface, &run);
    let bytes = match lake.store().head(&path).await {
        Ok(meta) => Some(meta.size),
        Err(StoreError::NotFound { .. }) => None,
        Err(e) => return Err(Error::read_failure(&path, e)),
    };
    if bytes.is_none() && snapshot.run(&run).is_none() && !lake.has_rows_of(&run).await? {
        return Err(absent());
    }
    let rows = snapshot.files_of(Table::Measurements, &run).map(|file| match file.parts.is_empty() {
        true => file.rows,
        false => file.visible_parts().filter(|(part, _)| part.run == run).map(|(part, _)| part.rows).sum(),
    });
    Ok(RunRemoval {
        measurements: rows.sum(),
        file: bytes.map(|_| path.to_string()),
        bytes: bytes.unwrap_or(0),
        moved_to: None,
        run,
        surface,
    })
}

impl LakeIngest<'_> {
    /// Removes runs from the lake. Rows that were derived with them as references follow by
    /// [`LakeIngest::complete_runs`]. The same call resumes a removal that was cut off.
    ///
    /// # Errors
    /// [`Error::CameBack`] if another ingest has ingested one of them meanwhile; a refusal of an older run whose
    /// surface would lose its row, before anything is removed; or an error of the lake.
    pub async fn remove_runs(&self, removals: &mut [RunRemoval], file: RemovedFile, by: &str) -> Result<()> {
        let lake = self.lake;
        let runs: BTreeSet<RunId> = removals.iter().map(|removal| removal.run.clone()).collect();
        self.restore_surfaces(&runs).await?;
        for removal in removals.iter_mut() {
            let path = Lake::run_path(&removal.surface, &removal.run);
            match file {
                RemovedFile::Kept => {
                    let now = chrono::Utc::now().format("%Y-%m-%dT%H:%M:%SZ");
                    let reason = format!(
                        "run `{}` was removed from the lake by {by} at {now}; hint: to ingest it again, move it back \
                         into `inbox/`",
                        removal.run
                    );
                    removal.moved_to = inbox::set_file_aside(lake, &path, &reason).await?.map(|path| path.to_string());
                }
                RemovedFile::Deleted => inbox::delete_run(lake, &path).await?,
            }
        }
        lake.remove_runs(&RemovalRecord { runs: runs.clone(), by: by.to_owned() }).await?;
        for RunRemoval { run, surface, measurements, moved_to, .. } in removals.iter() {
            tracing::info!(%run, %surface, measurements, by, moved_to, "a run was removed");
        }
        let snapshot = lake.snapshot().await?;
        match runs.iter().find(|run| snapshot.run(run).is_some()) {
            Some(run) => Err(Error::CameBack { run: run.to_string() }),
            None => Ok(()),
        }
    }

    // A surface's row is that of its newest run, and the log may have lost those of older ones. What describes it when
    // the newest ones are gone is therefore written before.
    async fn restore_surfaces(&self, removed: &BTreeSet<RunId>) -> Result<()> {
        let snapshot = self.lake.snapshot().await?;
        let later = snapshot.describing_runs(|run| !removed.contains(&run.run), VisibleRun::is_rejected);
        let present = snapshot.describing_runs(|_| true, VisibleRun::is_rejected);
        self.restore_rows(&snapshot, &(&later - &present)).await
    }

    /// Writes the own rows of runs that are to describe their surfaces: the log may have lost them.
    ///
    /// # Errors
    /// The refusal of a run's file.
    pub(crate) async fn restore_rows(&self, snapshot: &LakeSnapshot, runs: &BTreeSet<RunId>) -> Result<()> {
        let source = |run: &VisibleRun| RunSource::Lake(Lake::run_path(&run.surface, &run.run));
        let sources: Vec<_> = runs.iter().filter_map(|run| snapshot.run(run)).map(source).collect();
        if sources.is_empty() {
            return Ok(());
        }
        let mut refused = None;
        let mut report = |report: FileReport| match report {
            FileReport::Refused { why, .. } => refused = Some(why),
            FileReport::Gone(file) => refused = Some(Error::Gone { file: file.to_string() }),
            FileReport::Ingested(_) | FileReport::Claimed(_) => {}
        };
        self.clone().writing_again().ingest_runs(sources, &mut report).await?;
        refused.map_or(Ok(()), Err)
    }
}

/// Returns the path of a removed run's file, if it stands in `quarantine/`.
pub async fn find_removed(lake: &Lake, name: &str) -> Option<Path> {
    let stem = name.rsplit('/').next().unwrap_or_default();
    let stem = stem.strip_suffix(".mcap").unwrap_or(stem);
    let path = Path::parse(format!("quarantine/{stem}.mcap")).ok()?;
    lake.store().head(&path).await.ok().map(|_| path)
}
