//! Checks a lake for contents, missing parts and damage, down to the last CRC.

use std::collections::BTreeSet;
use std::sync::Arc;

use arrow::record_batch::RecordBatch;
use echolake_lake::{Error as LakeError, FileName, FolderListing, Lake, LakeSnapshot};
use echolake_recording::{DecodedChunk, ResyncItem, ResyncReader};
use echolake_schema::tables::Table;
use object_store::path::Path;
use serde::Serialize;

use crate::error::Result;
use crate::inbox::has_end;
use crate::read_back;
use crate::references::ReferenceFinder;
use crate::remove::find_removed;
use crate::rows::runs::text_of;

/// Result of a check of a lake.
#[derive(Debug, Clone, Default, Serialize)]
pub struct LakeReport {
    /// The tables, in order.
    pub tables: Vec<TableReport>,
    /// Runs that readers see.
    pub runs: usize,
    /// Bytes of run files.
    pub run_bytes: u64,
    /// Problems and notes, worst first.
    pub findings: Vec<LakeFinding>,
}

/// Counts of one table.
#[derive(Debug, Clone, Serialize)]
pub struct TableReport {
    /// Its name.
    pub table: &'static str,
    /// Files that readers see.
    pub files: usize,
    /// Rows in them.
    pub rows: u64,
    /// Their bytes.
    pub bytes: u64,
}

/// A problem or note.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct LakeFinding {
    /// Its severity.
    pub severity: FindingSeverity,
    /// The file or run.
    pub subject: String,
    /// Description with a hint.
    pub what: String,
}

/// Severity of a finding, worst first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FindingSeverity {
    /// Data are damaged or lost.
    Damaged,
    /// Something is missing so far.
    Missing,
    /// For information.
    Note,
}

/// Progress of the check.
#[derive(Debug, Clone, Copy)]
pub struct CheckStep<'a> {
    /// The file that is being checked.
    pub subject: &'a str,
    /// Files done.
    pub done: usize,
    /// Files in all.
    pub total: usize,
}

impl LakeReport {
    /// Returns whether data are damaged or lost.
    pub fn is_damaged(&self) -> bool {
        self.findings.iter().any(|f| f.severity == FindingSeverity::Damaged)
    }

    fn find_in(&mut self, table: Table, what: impl ToString) {
        self.add_finding(FindingSeverity::Damaged, format!("tables/{}", table.name()), what.to_string());
    }

    fn add_finding(&mut self, severity: FindingSeverity, subject: impl ToString, what: impl Into<String>) {
        self.findings.push(LakeFinding { severity, subject: subject.to_string(), what: what.into() });
    }
}

/// Checks a lake: every file of every table is decoded, and every run file read to its last CRC.
///
/// # Errors
/// [`crate::Error`] if the lake itself cannot be read; damage in it is a finding.
pub async fn examine_lake(lake: &Lake, progress: &mut dyn FnMut(CheckStep<'_>)) -> Result<LakeReport> {
    let mut report = LakeReport::default();
    let snapshot = match lake.snapshot().await {
        // Without it, nothing says what the other tables must have.
        Err(error @ LakeError::Log { .. }) => {
            report.add_finding(FindingSeverity::Damaged, "tables/runs", error.to_string());
            return Ok(report);
        }
        snapshot => Arc::new(snapshot?),
    };
    report.runs = snapshot.runs().count();
    find_faults(lake, &snapshot, &mut report).await?;
    let total = Table::ALL.iter().map(|t| snapshot.files(*t).len()).sum::<usize>() + report.runs;
    let mut done = 0;
    for table in Table::ALL {
        let files = snapshot.files(table);
        for file in files {
            progress(CheckStep { subject: file.path.as_ref(), done, total });
            done += 1;
            if let Err(error) = lake.check_file(table, file).await {
                report.add_finding(FindingSeverity::Damaged, &file.path, error.to_string());
            }
        }
        // What the lake's earlier form has and the table not yet.
        if let Err(error) = lake.read_pending_rows(&snapshot, table).await {
            report.find_in(table, error);
        }
        report.tables.push(TableReport {
            table: table.name(),
            files: files.len(),
            rows: files.iter().map(|file| file.visible_rows()).sum(),
            bytes: files.iter().map(|f| f.bytes).sum(),
        });
    }
    // A table of annotations that cannot be read has a finding of its own.
    let rejected = lake.read_rejections(&snapshot).await.ok();
    for run in rejected.iter().flat_map(|rejected| snapshot.unfollowed_runs(rejected)) {
        let what = "verdicts on it came after the last ingest; hint: `echolake ingest` derives again what rests on it";
        report.add_finding(FindingSeverity::Note, &run.run, what);
    }
    let finder = ReferenceFinder::new(lake, snapshot.clone(), Arc::new(rejected.unwrap_or_default()));
    for run in snapshot.runs() {
        for file in snapshot.files_of(Table::Runs, &run.run) {
            progress(CheckStep { subject: file.path.as_ref(), done, total });
            done += 1;
            match read_back::run_row(lake, file, &run.run).await {
                Ok(row) => check_run(lake, &finder, &row, &mut report).await?,
                // Reported above, when the table's files were decoded.
                Err(_) => continue,
            }
        }
    }
    find_strays(lake, &snapshot, &mut report).await?;
    report.findings.sort();
    Ok(report)
}

// What the tables' logs have, against what `runs` names.
async fn find_faults(lake: &Lake, snapshot: &LakeSnapshot, report: &mut LakeReport) -> Result<()> {
    let is_named = snapshot.check_table(Table::Runs).map_err(|fault| report.find_in(Table::Runs, fault)).is_ok();
    for table in Table::ALL {
        for lacking in snapshot.lacking_rows(table) {
            report.find_in(table, format!("{lacking}; hint: `echolake ingest` derives them again from the run's file"));
        }
        for file in snapshot.foreign_files(table) {
            let what = "another program put it into the table's log; hint: `echolake ingest` removes it, and derives \
                        again what it replaced";
            report.add_finding(FindingSeverity::Damaged, &file.path, what);
        }
        if is_named
            && snapshot.lacking_rows(table).is_empty()
            && snapshot.foreign_files(table).is_empty()
            && let Err(fault) = snapshot.check_table(table)
        {
            report.find_in(table, fault);
        }
        if let Some(versions) = lake.overdue_checkpoint(table).await? {
            let what = format!(
                "{versions} versions since its last checkpoint; hint: can the folder be written? The log of ingest \
                 says why a checkpoint failed"
            );
            report.add_finding(FindingSeverity::Note, format!("tables/{}/_delta_log", table.name()), what);
        }
    }
    Ok(())
}

async fn check_run(lake: &Lake, finder: &ReferenceFinder, row: &RecordBatch, report: &mut LakeReport) -> Result<()> {
    let text = |column| text_of(row, column).unwrap_or_default();
    let run = text("run_id");
    let path = text("file");
    let state = text("state");
    for finding in check_run_file(lake, &Path::from(path.as_str()), &text("file_sha256"), report).await? {
        report.add_finding(FindingSeverity::Damaged, &path, finding);
    }
    let removed = find_removed(lake, &run).await;
    if let Some(removed) = removed.filter(|_| report.findings.iter().any(|f| f.subject == path)) {
        let what = format!("its file is at `{removed}`; hint: `echolake remove {run}` resumes its removal");
        report.add_finding(FindingSeverity::Damaged, &run, what);
    }
    if state == "partial" {
        report.add_finding(
            FindingSeverity::Note,
            &run,
            "the recording was stopped, cut off or damaged; what it holds is in the tables",
        );
    }
    if let Ok(surface) = text("surface_id").parse() {
        let missing = finder.wanted_references(&surface).missing_names();
        if !missing.is_empty() {
            let what = format!(
                "waits for reference {missing}, which levels need; hint: ingest a run of that surface, and it is \
                 completed"
            );
            report.add_finding(FindingSeverity::Missing, &run, what);
        } else if text("reference_derivation").is_empty() {
            report.add_finding(
                FindingSeverity::Missing,
                &run,
                "its references are there, its derived rows are not; hint: `echolake ingest`",
            );
        }
    }
    Ok(())
}

/// Returns descriptions of the damage in a run's file.
async fn check_run_file(lake: &Lake, path: &Path, sha256: &str, report: &mut LakeReport) -> Result<Vec<String>> {
    let mut reader = match ResyncReader::open(lake.store(), path.clone(), path.to_string()).await {
        Ok(reader) => reader,
        Err(e) => return Ok(vec![e.to_string()]),
    };
    let mut wrong = Vec::new();
    while let Some(item) = reader.next_item().await? {
        if let ResyncItem::Chunk(raw) = item {
            let offset = raw.offset;
            match DecodedChunk::decode(&raw.body) {
                Ok(chunk) => wrong
                    .extend(chunk.check_records().err().map(|reason| format!("the chunk at byte {offset}: {reason}"))),
                Err(reason) => {
                    wrong.push(format!("the chunk at byte {offset}: {reason}"));
                    reader.look_into(offset).await?;
                }
            }
        }
    }
    let integrity = reader.finish().await?;
    report.run_bytes += integrity.bytes;
    wrong.extend(integrity.damage);
    if integrity.sha256 != sha256 {
        wrong.push(format!("its SHA-256 is {}, at ingest it was {sha256}", integrity.sha256));
    }
    Ok(wrong)
}

// Files that no row names: not yet ingested, refused, or left behind by a crash.
async fn find_strays(lake: &Lake, snapshot: &LakeSnapshot, report: &mut LakeReport) -> Result<()> {
    let named: BTreeSet<Path> = Table::ALL
        .iter()
        .flat_map(|t| snapshot.files(*t).iter().chain(snapshot.superseded_files(*t)))
        .map(|f| f.path.clone())
        .chain(snapshot.runs().map(|r| Lake::run_path(&r.surface, &r.run)))
        .collect();
    let mut listing = FolderListing::default();
    for folder in ["inbox", "quarantine", "runs", "tables"] {
        let mut listed = lake.list_folder(folder).await?;
        listing.files.append(&mut listed.files);
        listing.unusable.append(&mut listed.unusable);
    }
    for entry in listing.unusable {
        report.add_finding(FindingSeverity::Missing, entry.path, format!("it is passed over: {}", entry.reason));
    }
    let mut left_behind = (0, 0);
    for meta in listing.files.into_iter().filter(|m| !named.contains(&m.location)) {
        let path = meta.location;
        let folder = path.parts().next().map(|part| part.as_ref().to_owned()).unwrap_or_default();
        let (severity, what) = match (folder.as_str(), path.extension().unwrap_or_default()) {
            // The digest of the run beside it.
            ("inbox" | "runs", "sha256") => continue,
            ("inbox", "uploading") => {
                (FindingSeverity::Note, "part of a run that is being uploaded; hint: `echolake upload` of it resumes")
            }
            ("inbox" | "runs", "mcap") if !has_end(lake, &path).await.unwrap_or(true) => {
                let what = format!(
                    "it has no end after {} bytes: it is still being copied, or its recording was cut off; hint: copy \
                     it again, or `echolake recover` makes a run of what it holds",
                    meta.size
                );
                report.add_finding(FindingSeverity::Missing, &path, what);
                continue;
            }
            ("inbox", "mcap") => (FindingSeverity::Missing, "not yet ingested; hint: `echolake ingest`"),
            ("inbox", _) if !path.as_ref().ends_with(".mcap.partial") => {
                (FindingSeverity::Note, "no run file; ingest leaves it alone")
            }
            ("inbox", _) => (
                FindingSeverity::Note,
                "unfinished recording (still running, stopped or cut off); hint: `echolake acquire --resume` resumes \
                 it, `echolake recover` makes a run of what it holds",
            ),
            ("runs", _) => (
                FindingSeverity::Damaged,
                "in no table: an ingest reads it now or was cut off, or the log of `runs` lost its newest commits; \
                 hint: `echolake ingest`",
            ),
            // It is named with its file.
            ("quarantine", _) if path.as_ref().ends_with(".reason.txt") => continue,
            ("quarantine", _) => (FindingSeverity::Note, "was refused or removed; the reason stands beside it"),
            ("tables", _) if FileName::parse(&path).is_some() => {
                left_behind = (left_behind.0 + 1, left_behind.1 + meta.size);
                continue;
            }
            _ => continue,
        };
        report.add_finding(severity, &path, what);
    }
    if left_behind.0 > 0 {
        let what = format!(
            "{} files ({} bytes) of older derivations or of an ingest that was cut off; hint: `echolake vacuum`",
            left_behind.0, left_behind.1
        );
        report.add_finding(FindingSeverity::Note, "tables", what);
    }
    Ok(())
}
