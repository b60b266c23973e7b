//! Merges small files of a table into large ones: all that `optimize` finds, and those of few runs at the end of an
//! ingest. Neither the rows that readers see nor their storage format changes.
//!
//! A merged file's Add lists its parts, (surface, run, derivation) each with its number of rows; a snapshot decides
//! over every part as it would over a file of its own. A part of `runs` has, in addition, the version that added it:
//! which of two rows of a run is newer does not change when one is merged. Runs of several projects are not merged, so
//! that whoever may see one project has whole files of it; surfaces are merged with those of the same references alone,
//! whose names ingest takes from the files' statistics.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use echolake_schema::ProjectName;
use echolake_schema::tables::{Source, Table};
use futures::TryStreamExt as _;
use serde::Serialize;
use sha2::{Digest as _, Sha256};

use crate::locks::MaintenanceLease;
use crate::{
    CommitEffect, CommitOutcome, DataFile, Error, FileEncoder, FileName, Lake, LakeSnapshot, ReferenceSurfaces,
    RemovalRecord, ReplacedFiles, Result, RunPart, TableCommit,
};

/// Default size that files are merged to: few enough for a million responses, small enough to be held in memory.
pub const TARGET_BYTES: u64 = 128 << 20;
/// Files that a merge by runs replaces, at least: to replace a large one and few small ones costs more than they do.
const LEAST_MERGED_FILES: usize = 4;
/// Hex digits that a name keeps of its digest.
const DIGEST_DIGITS: usize = 16;

/// Progress of a merge.
#[derive(Debug, Clone, Copy)]
pub struct MergeProgress {
    /// The table at work.
    pub table: Table,
    /// Files merged, of all tables.
    pub done: usize,
    /// Files to merge, of all tables.
    pub total: usize,
}

/// Report of merging a lake's files.
#[derive(Debug, Clone, Default, Serialize)]
pub struct OptimizeReport {
    /// The tables that were changed.
    pub tables: Vec<TableOptimizeReport>,
    /// It was stopped before its end.
    pub stopped: bool,
}

/// Report of merging a table's files.
#[derive(Debug, Clone, Serialize)]
pub struct TableOptimizeReport {
    /// Its name.
    pub table: &'static str,
    /// Files that were merged.
    pub merged: usize,
    /// Their bytes.
    pub bytes_before: u64,
    /// Files that replaced them.
    pub files: usize,
    /// Their bytes.
    pub bytes_after: u64,
    /// Merges that were dropped because ingest replaced one of the files meanwhile.
    pub outdated: usize,
}

impl Lake {
    /// Merges small files under the maintenance lease. Ingest and readers may continue.
    ///
    /// # Errors
    /// [`Error::Maintained`] if another process holds the lease, [`Error::LeaseLost`], [`Error::DataFile`], or what the
    /// store says. What was merged before stays so.
    pub async fn optimize(
        &self,
        target_bytes: u64,
        stop: &AtomicBool,
        progress: &mut (dyn FnMut(MergeProgress) + Send),
    ) -> Result<OptimizeReport> {
        let mut lease = MaintenanceLease::acquire(self).await?;
        let done = self.merge_all(target_bytes, stop, progress, &mut lease).await;
        let released = lease.release().await;
        done.and_then(|report| released.map(|()| report))
    }

    async fn merge_all(
        &self,
        target_bytes: u64,
        stop: &AtomicBool,
        progress: &mut (dyn FnMut(MergeProgress) + Send),
        lease: &mut MaintenanceLease,
    ) -> Result<OptimizeReport> {
        self.settle_contributions().await?;
        self.remove_superseded().await?;
        let snapshot = self.snapshot().await?;
        let readers = FileReaders::from_snapshot(self, &snapshot);
        let plans: Vec<_> = Table::ALL
            .into_iter()
            .map(|table| (table, plan_merges(&snapshot, &readers, table, MergeRule::Bytes(target_bytes))))
            .collect();
        let total = plans.iter().flat_map(|(_, groups)| groups).map(Vec::len).sum();
        let mut report = OptimizeReport::default();
        let mut done = 0;
        for (table, groups) in plans.into_iter().filter(|(_, groups)| !groups.is_empty()) {
            let name = table.name();
            let mut of =
                TableOptimizeReport { table: name, merged: 0, bytes_before: 0, files: 0, bytes_after: 0, outdated: 0 };
            for group in &groups {
                progress(MergeProgress { table, done, total });
                if stop.load(Ordering::Relaxed) {
                    report.stopped = true;
                    break;
                }
                match self.merge_files(table, group, CommitEffect::Layout.into(), Some(&mut *lease)).await? {
                    (CommitOutcome::Outdated, _) => of.outdated += 1,
                    (_, bytes) => {
                        of.merged += group.len();
                        of.bytes_before += group.iter().map(|f| f.bytes).sum::<u64>();
                        of.files += 1;
                        of.bytes_after += bytes;
                    }
                }
                done += group.len();
            }
            // The same rows, so readers see the version at once.
            if table.source() == Source::Users
                && let Some(version) = self.commit_log().newest_version(table).await?
            {
                self.commit_log().show_version(table, version).await?;
            }
            report.tables.push(of);
        }
        Ok(report)
    }

    /// Merges files of fewer than so many runs, wherever four or more have as many runs together: a lake that grows by
    /// a run at a time has as few files as one that grows by groups. Returns the number of files that went.
    ///
    /// # Errors
    /// [`Error::DataFile`], or what the store says. What was merged before stays so.
    pub async fn merge_small_groups(&self, snapshot: &LakeSnapshot, runs: usize, stop: &AtomicBool) -> Result<usize> {
        let readers = FileReaders::from_snapshot(self, snapshot);
        let of_ingest = Table::ALL.into_iter().filter(|table| table.source() != Source::Users);
        let mut merged = 0;
        for table in of_ingest {
            for group in plan_merges(snapshot, &readers, table, MergeRule::Runs(runs)) {
                if stop.load(Ordering::Relaxed) {
                    return Ok(merged);
                }
                let (outcome, _) = self.merge_files(table, &group, CommitEffect::Layout.into(), None).await?;
                merged += if outcome == CommitOutcome::Now { group.len() } else { 0 };
            }
        }
        Ok(merged)
    }

    /// Rewrites a merged file without its superseded rows. If another writer did so meanwhile, nothing changes.
    pub(crate) async fn rewrite_file(&self, table: Table, file: &DataFile) -> Result<CommitOutcome> {
        self.rewrite_without(table, file, None).await
    }

    /// The same, for the rows of runs that somebody removes, which the file hides.
    pub(crate) async fn rewrite_without(
        &self,
        table: Table,
        file: &DataFile,
        removal: Option<RemovalRecord>,
    ) -> Result<CommitOutcome> {
        let change = TableCommit { removal, ..TableCommit::default() };
        let file = Arc::new(file.clone());
        let (outcome, _) = self.merge_files(table, std::slice::from_ref(&file), change, None).await?;
        Ok(outcome)
    }

    // One file in the place of several, by a commit that adds nothing else; returns its size, too.
    async fn merge_files(
        &self,
        table: Table,
        files: &[Arc<DataFile>],
        change: TableCommit,
        mut lease: Option<&mut MaintenanceLease>,
    ) -> Result<(CommitOutcome, u64)> {
        let mut slices: Vec<_> = files.iter().flat_map(|file| run_slices(file)).collect();
        slices.sort_by(|a, b| part_key(&a.part).cmp(&part_key(&b.part)));
        let seen_runs = files.iter().map(|file| file.seen_runs).max().unwrap_or(0);
        let mut encoder = FileEncoder::new(table, table.schema(self.rig()));
        for slice in &slices {
            if let Some(lease) = lease.as_deref_mut() {
                lease.ensure_held().await?;
            }
            let mut batches = self.read_rows(table, slice.file, &[], slice.rows.clone()).await?;
            let mut rows = 0;
            while let Some(batch) = batches.try_next().await? {
                rows += batch.num_rows() as u64;
                encoder.write_batch(&batch)?;
            }
            encoder.end_run()?;
            if rows != slice.part.rows {
                let source = format!("{rows} rows were read of {} of run {}", slice.part.rows, slice.part.run).into();
                return Err(Error::DataFile { file: slice.file.path.to_string(), source });
            }
        }
        let parts: Vec<_> = slices.into_iter().map(|s| s.part).collect();
        let mut staged = self.stage_file(table, &merged_name(&parts), encoder.finish()?).await?;
        let replaced = files.iter().map(|file| file.logged_file()).collect();
        staged.file.replaces = vec![ReplacedFiles { prefix: None, files: replaced }];
        staged.file.parts = parts;
        // A part that `runs` does not name yet stays as new as its author made it.
        staged.file.seen_runs = seen_runs;
        if let Some(lease) = lease {
            lease.ensure_held().await?;
        }
        let bytes = staged.file.bytes;
        let commit = TableCommit { add: vec![staged.file], ..change };
        let outcome = self.commit_log().commit_change(table, &commit).await?;
        Ok((outcome[0], bytes))
    }
}

/// A run's rows, and their range in a file.
struct RunSlice<'a> {
    file: &'a DataFile,
    part: RunPart,
    rows: std::ops::Range<u64>,
}

fn run_slices(file: &DataFile) -> Vec<RunSlice<'_>> {
    if let Some(part) = RunPart::of_file(file) {
        return vec![RunSlice { file, rows: 0..file.rows, part }];
    }
    file.visible_parts().map(|(part, rows)| RunSlice { file, part: part.clone(), rows }).collect()
}

/// The order of the parts of a file.
pub(crate) fn part_key(part: &RunPart) -> (&str, &str, Option<u64>) {
    (part.surface.as_str(), part.run.as_str(), part.row_version)
}

/// The name of a file that is made of the rows of several runs at once: never that of one that is merged, whose bytes
/// may be others.
pub(crate) fn group_name(parts: &[RunPart]) -> String {
    name_after(b"group\n", parts).compose()
}

fn merged_name(parts: &[RunPart]) -> FileName {
    name_after(b"", parts)
}

fn name_after(kind: &[u8], parts: &[RunPart]) -> FileName {
    let mut sha = Sha256::new();
    sha.update(kind);
    for part in parts {
        sha.update(part.file_name());
        sha.update("\n");
        // The same name added again may be another row.
        sha.update(part.row_version.map(|version| format!("{version}\n")).unwrap_or_default());
    }
    FileName::Merged { digest: hex::encode(sha.finalize())[..DIGEST_DIGITS].to_owned() }
}

/// Readers of a run's rows.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum RunAudience {
    /// Everybody, in a lake without projects.
    Common,
    /// All projects. In `runs`, a file has runs of one project even so: it tells their project.
    References(Option<ProjectName>),
    /// A project, or readers of all projects alone.
    Project(Option<ProjectName>),
    /// Differs between the runs of a file.
    Mixed,
}

/// Tells who reads the rows of a file.
struct FileReaders<'a> {
    snapshot: &'a LakeSnapshot,
    references: &'a ReferenceSurfaces,
    /// A lake without projects has readers of one kind.
    has_projects: bool,
}

impl<'a> FileReaders<'a> {
    fn from_snapshot(lake: &'a Lake, snapshot: &'a LakeSnapshot) -> Self {
        let has_projects = snapshot.runs().any(|run| snapshot.project_of(&run.run).is_some());
        Self { snapshot, references: &lake.config().references, has_projects }
    }

    fn audience_of(&self, table: Table, file: &DataFile) -> RunAudience {
        if table.source() == Source::Users && self.has_projects {
            return RunAudience::Project(file.project());
        }
        let of = |slice: &RunSlice<'_>| {
            let project = self.snapshot.project_of(&slice.part.run).cloned();
            match [&self.references.flat, &self.references.foam].contains(&&slice.part.surface) {
                _ if !self.has_projects => RunAudience::Common,
                true => RunAudience::References(project.filter(|_| table == Table::Runs)),
                false => RunAudience::Project(project),
            }
        };
        let mut audiences = run_slices(file).iter().map(of).collect::<Vec<_>>();
        audiences.dedup();
        match audiences.len() {
            1 => audiences.remove(0),
            _ => RunAudience::Mixed,
        }
    }
}

/// The choice of files that are merged, and of the size up to which they are.
#[derive(Debug, Clone, Copy)]
enum MergeRule {
    /// Those of less than half of these bytes, to as many bytes at most.
    Bytes(u64),
    /// Those of fewer than so many runs, to as many runs at least.
    Runs(usize),
}

impl MergeRule {
    fn is_small(self, file: &DataFile) -> bool {
        match self {
            Self::Bytes(target) => file.bytes < target / 2,
            Self::Runs(runs) => run_count(file) < runs,
        }
    }

    // Returns whether a group is full without the next file.
    fn is_full(self, group: &[Arc<DataFile>], next: &DataFile) -> bool {
        match self {
            Self::Bytes(target) => group.iter().map(|file| file.bytes).sum::<u64>() + next.bytes > target,
            Self::Runs(runs) => has_runs(group, runs),
        }
    }

    fn is_worthwhile(self, group: &[Arc<DataFile>]) -> bool {
        match self {
            Self::Bytes(_) => group.len() > 1,
            Self::Runs(runs) => group.len() >= LEAST_MERGED_FILES && has_runs(group, runs),
        }
    }
}

fn has_runs(group: &[Arc<DataFile>], runs: usize) -> bool {
    group.iter().map(|file| run_count(file)).sum::<usize>() >= runs
}

fn run_count(file: &DataFile) -> usize {
    file.parts.len().max(1)
}

// Neighbours by surface and run in groups of about the wanted size, so that a query for a surface opens few files.
fn plan_merges(
    snapshot: &LakeSnapshot,
    readers: &FileReaders<'_>,
    table: Table,
    rule: MergeRule,
) -> Vec<Vec<Arc<DataFile>>> {
    if table.source() == Source::Rig {
        return Vec::new();
    }
    let is_small = |f: &&Arc<DataFile>| rule.is_small(f) && f.hidden.is_empty();
    let first = |f: &DataFile| run_slices(f).first().map(|s| (s.part.surface.clone(), s.part.run.clone()));
    let mut small: Vec<_> = snapshot.files(table).iter().filter(is_small).cloned().collect();
    let place = |file: &DataFile| (readers.audience_of(table, file), surface_references(table, file));
    small.sort_by_cached_key(|file| (place(file), first(file)));
    let mut groups: Vec<Vec<Arc<DataFile>>> = Vec::new();
    let mut last = None;
    for file in small {
        let place = Some(place(&file));
        match groups.last_mut().filter(|group| place == last && !rule.is_full(group, &file)) {
            Some(group) => group.push(file),
            None => groups.push(vec![file]),
        }
        last = place;
    }
    groups.retain(|group| rule.is_worthwhile(group));
    groups
}

// The references of a file's surfaces, which are the same for all of them.
fn surface_references(table: Table, file: &DataFile) -> Option<[Option<String>; 2]> {
    let text = |column| Some(file.stats.as_ref()?.min.get(column)?.as_str()?.to_owned());
    (table == Table::Surfaces).then(|| [text("flat_reference"), text("foam_reference")])
}

#[cfg(test)]
pub(crate) mod tests;
