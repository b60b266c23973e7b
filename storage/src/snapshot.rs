//! What a reader may see: a frozen view of every table, cut down to what `runs` names.
//!
//! Delta commits one table at a time, so a run's rows are committed before its `runs` row. The file of that
//! row carries in its name the derivations that are current; files of other derivations are not seen.

use std::collections::{BTreeMap, HashMap};

use chrono::{DateTime, Utc};
use echolake_schema::tables::{Source, Table};
use echolake_schema::{RunId, SurfaceId};
use object_store::path::Path;

use crate::{CommitLog, DataFile, Result};

/// What the name of a file in `tables/` says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum FileName {
    /// Rows that come from the rig alone.
    Rig {
        /// Digest of what they were made from.
        derivation: String,
    },
    /// Rows of one run.
    Rows {
        /// The run's surface.
        surface: SurfaceId,
        /// The run.
        run: RunId,
        /// Digest of what they were made from.
        derivation: String,
    },
    /// A run's row in `runs`.
    Pointer(VisibleRun),
}

/// A run that readers see, and which derivations of its rows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct VisibleRun {
    /// The run's surface.
    pub surface: SurfaceId,
    /// The run.
    pub run: RunId,
    /// Derivation of the rows that come from the run alone.
    pub run_derivation: String,
    /// Derivation of the rows that need references; None while they are missing.
    pub reference_derivation: Option<String>,
}

impl VisibleRun {
    /// What the names of all of the run's rows in `runs` begin with.
    pub(crate) fn prefix(&self) -> String {
        format!("{}.{}.", self.surface, self.run)
    }
}

/// A frozen view of all tables.
#[derive(Debug, Clone, Default)]
pub struct Snapshot {
    files: HashMap<Table, Vec<DataFile>>,
    runs: BTreeMap<RunId, Current>,
    hidden: HashMap<Table, Vec<DataFile>>,
}

/// A run's row in `runs`, and when it was committed.
#[derive(Debug, Clone)]
struct Current {
    run: VisibleRun,
    since: DateTime<Utc>,
}

const EXTENSION: &str = ".parquet";
const WITHOUT: &str = "none";

impl FileName {
    /// The name.
    pub fn compose(&self) -> String {
        match self {
            Self::Rig { derivation } => format!("rig.{derivation}{EXTENSION}"),
            Self::Rows { surface, run, derivation } => format!("{surface}.{run}.{derivation}{EXTENSION}"),
            Self::Pointer(VisibleRun { surface, run, run_derivation, reference_derivation }) => {
                let references = reference_derivation.as_deref().unwrap_or(WITHOUT);
                format!("{surface}.{run}.{run_derivation}.{references}{EXTENSION}")
            }
        }
    }

    /// Reads a name; None where it is none of ours.
    pub fn parse(path: &Path) -> Option<Self> {
        let parts: Vec<_> = path.filename()?.strip_suffix(EXTENSION)?.split('.').collect();
        match parts[..] {
            ["rig", derivation] => Some(Self::Rig { derivation: derivation.into() }),
            [surface, run, derivation] => Some(Self::Rows {
                surface: surface.parse().ok()?,
                run: run.parse().ok()?,
                derivation: derivation.into(),
            }),
            [surface, run, run_derivation, references] => Some(Self::Pointer(VisibleRun {
                surface: surface.parse().ok()?,
                run: run.parse().ok()?,
                run_derivation: run_derivation.into(),
                reference_derivation: (references != WITHOUT).then(|| references.into()),
            })),
            _ => None,
        }
    }
}

impl Snapshot {
    /// Takes a view. `runs` is read first, so that whatever it names was committed before.
    pub(crate) async fn take(log: &dyn CommitLog) -> Result<Self> {
        let pointers = log.files(Table::Runs).await?;
        let mut snapshot = Self { runs: current_runs(&pointers), ..Self::default() };
        for table in Table::ALL {
            let files = if table == Table::Runs { pointers.clone() } else { log.files(table).await? };
            snapshot.sort_in(table, files);
        }
        Ok(snapshot)
    }

    /// The files of a table that readers see.
    pub fn files(&self, table: Table) -> &[DataFile] {
        self.files.get(&table).map_or(&[], Vec::as_slice)
    }

    /// The files of a table that belong to a run that readers see, but are no longer seen themselves. Those that are
    /// newer than the run's row may be about to be named by another ingest, and are none of them.
    pub fn superseded(&self, table: Table) -> &[DataFile] {
        self.hidden.get(&table).map_or(&[], Vec::as_slice)
    }

    /// The runs that readers see, by name and so by time.
    pub fn runs(&self) -> impl DoubleEndedIterator<Item = &VisibleRun> {
        self.runs.values().map(|current| &current.run)
    }

    /// One run.
    pub fn run(&self, run: &RunId) -> Option<&VisibleRun> {
        self.runs.get(run).map(|current| &current.run)
    }

    /// The files of one run in a table.
    pub fn files_of<'a>(&'a self, table: Table, run: &'a RunId) -> impl Iterator<Item = &'a DataFile> {
        self.files(table).iter().filter(move |f| match FileName::parse(&f.path) {
            Some(FileName::Rows { run: of, .. }) => of == *run,
            Some(FileName::Pointer(pointer)) => pointer.run == *run,
            _ => false,
        })
    }

    fn sort_in(&mut self, table: Table, files: Vec<DataFile>) {
        let (mut seen, mut hidden) = (Vec::new(), Vec::new());
        for file in files {
            match self.sees(table, &file) {
                Some(true) => seen.push(file),
                Some(false) if self.is_older_than_its_run(&file) => hidden.push(file),
                Some(false) | None => {}
            }
        }
        self.files.insert(table, seen);
        self.hidden.insert(table, hidden);
    }

    // None for what belongs to no run that is seen: another ingest may be about to name it.
    fn sees(&self, table: Table, file: &DataFile) -> Option<bool> {
        match FileName::parse(&file.path)? {
            FileName::Rig { .. } => Some(table.source() == Source::Rig),
            FileName::Pointer(pointer) => Some(self.run(&pointer.run) == Some(&pointer)),
            FileName::Rows { surface, run, derivation } => {
                let current = self.run(&run)?;
                let names = match table.source() {
                    Source::References => current.reference_derivation.as_ref() == Some(&derivation),
                    _ => current.run_derivation == derivation,
                };
                Some(names && (!one_a_surface(table) || self.latest(&surface) == Some(&run)))
            }
        }
    }

    fn is_older_than_its_run(&self, file: &DataFile) -> bool {
        let run = match FileName::parse(&file.path) {
            Some(FileName::Rows { run, .. }) => run,
            Some(FileName::Pointer(pointer)) => pointer.run,
            _ => return false,
        };
        self.runs.get(&run).is_some_and(|current| file.modified <= current.since)
    }

    fn latest(&self, surface: &SurfaceId) -> Option<&RunId> {
        self.runs().rev().find(|r| r.surface == *surface).map(|r| &r.run)
    }
}

// A surface that was measured twice is still one surface: its newest run tells what it is.
fn one_a_surface(table: Table) -> bool {
    matches!(table, Table::Surfaces | Table::Heightmaps)
}

// A crash between a run's new row and the removal of its old one leaves two; the newer one counts.
fn current_runs(pointers: &[DataFile]) -> BTreeMap<RunId, Current> {
    let mut by_age: Vec<_> = pointers.iter().collect();
    by_age.sort_by_key(|f| (f.modified, f.path.clone()));
    let parsed = by_age.into_iter().filter_map(|f| match FileName::parse(&f.path) {
        Some(FileName::Pointer(run)) => Some((run.run.clone(), Current { run, since: f.modified })),
        _ => None,
    });
    parsed.collect()
}

#[cfg(test)]
mod tests {
    use chrono::DateTime;

    use super::*;

    fn file(table: Table, name: &str, modified: i64) -> DataFile {
        let path = crate::delta::folder(table).join(name);
        let modified = DateTime::from_timestamp(modified, 0).expect("a time");
        DataFile { path, bytes: 1, rows: 1, modified, stats: None }
    }

    fn view(files: &[(Table, &str, i64)]) -> Snapshot {
        let of = |table| files.iter().filter(|f| f.0 == table).map(|f| file(f.0, f.1, f.2)).collect::<Vec<_>>();
        let mut snapshot = Snapshot { runs: current_runs(&of(Table::Runs)), ..Snapshot::default() };
        Table::ALL.into_iter().for_each(|table| snapshot.sort_in(table, of(table)));
        snapshot
    }

    fn names(files: &[DataFile]) -> Vec<&str> {
        files.iter().filter_map(|f| f.path.filename()).collect()
    }

    #[test]
    fn names_round_trip() {
        for name in [
            "rig.ab.parquet",
            "0015_0.20260105T080000Z-0015_0-7c1e.ab.parquet",
            "flat.r.ab.none.parquet",
            "flat.r.ab.cd.parquet",
        ] {
            let parsed = FileName::parse(&Path::from(name)).expect(name);
            assert_eq!(parsed.compose(), name);
        }
        for foreign in ["part-00000.parquet", "a.b.c.d.e.parquet", "a.b.c", "..parquet"] {
            assert_eq!(FileName::parse(&Path::from(foreign)), None, "{foreign}");
        }
    }

    #[test]
    fn rows_are_seen_once_runs_names_them() {
        let before = view(&[(Table::Measurements, "flat.r1.ab.parquet", 1)]);
        assert!(before.files(Table::Measurements).is_empty());
        assert!(before.superseded(Table::Measurements).is_empty(), "its ingest may still be going on");
        let after = view(&[
            (Table::Measurements, "flat.r1.ab.parquet", 1),
            (Table::Nce, "flat.r1.cd.parquet", 1),
            (Table::Nce, "flat.r1.old.parquet", 0),
            (Table::Nce, "flat.r1.ef.parquet", 3),
            (Table::Runs, "flat.r1.ab.cd.parquet", 2),
        ]);
        assert_eq!(names(after.files(Table::Measurements)), ["flat.r1.ab.parquet"]);
        assert_eq!(names(after.files(Table::Nce)), ["flat.r1.cd.parquet"]);
        assert_eq!(names(after.superseded(Table::Nce)), ["flat.r1.old.parquet"]);
    }

    #[test]
    fn the_newer_of_two_pointers_counts() {
        let both = view(&[
            (Table::Runs, "flat.r1.ab.none.parquet", 1),
            (Table::Runs, "flat.r1.ab.cd.parquet", 2),
            (Table::Tnce, "flat.r1.cd.parquet", 2),
        ]);
        assert_eq!(names(both.files(Table::Runs)), ["flat.r1.ab.cd.parquet"]);
        assert_eq!(names(both.superseded(Table::Runs)), ["flat.r1.ab.none.parquet"]);
        assert_eq!(names(both.files(Table::Tnce)), ["flat.r1.cd.parquet"]);
    }

    #[test]
    fn a_surface_has_one_row_however_often_it_was_measured() {
        let twice = view(&[
            (Table::Runs, "flat.r1.ab.none.parquet", 1),
            (Table::Runs, "flat.r2.cd.none.parquet", 2),
            (Table::Surfaces, "flat.r1.ab.parquet", 1),
            (Table::Surfaces, "flat.r2.cd.parquet", 2),
            (Table::Measurements, "flat.r1.ab.parquet", 1),
            (Table::Measurements, "flat.r2.cd.parquet", 2),
        ]);
        assert_eq!(names(twice.files(Table::Surfaces)), ["flat.r2.cd.parquet"]);
        assert_eq!(twice.files(Table::Measurements).len(), 2);
    }
}
