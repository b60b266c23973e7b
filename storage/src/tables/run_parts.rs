//! The runs whose rows a file has: of one run by its name, of several by the list of its parts in the log.

use echolake_schema::{ProjectName, RunId};
use object_store::path::Path;
use serde::Deserialize;
use serde_json::{Value, json};

use super::file_name::{EXTENSION, FileName, VisibleRun};
use crate::{DataFile, RunPart, RunRowCounts};

/// The column of `runs` that holds a run's project.
const PROJECT: &str = "project";

/// Returns the run of a file of one run; None for other files.
pub(crate) fn run_of_file(file: &DataFile) -> Option<&RunId> {
    match file.name.as_ref()? {
        FileName::Rows { run, .. } => Some(run),
        FileName::Pointer(pointer) => Some(&pointer.run),
        FileName::Rig { .. } | FileName::Merged { .. } => None,
    }
}

/// A run's row in `runs`.
pub(crate) struct RunPointer<'a> {
    pub run: VisibleRun,
    /// The version of `runs` that added it.
    pub version: u64,
    pub row_counts: Option<&'a RunRowCounts>,
}

/// Lists the rows of `runs` that a file of that table shows.
pub(crate) fn list_pointers(file: &DataFile) -> Vec<RunPointer<'_>> {
    let pointer = |name: FileName| match name {
        FileName::Pointer(run) => Some(run),
        _ => None,
    };
    if file.parts.is_empty() {
        let shown = file.name.clone().and_then(pointer).filter(|run| !file.hidden.contains(&run.run));
        let version = file.log_version;
        let row_counts = file.row_counts.as_ref();
        return shown.map(|run| RunPointer { run, version, row_counts }).into_iter().collect();
    }
    let parts = file.visible_parts().map(|(part, _)| part);
    let pointers = parts.filter_map(|part| {
        let run = pointer(FileName::parse(&part.file_name().into())?)?;
        let version = part.row_version?;
        Some(RunPointer { run, version, row_counts: part.row_counts.as_ref() })
    });
    pointers.collect()
}

impl DataFile {
    /// The runs whose rows the file shows; none for rows that come from the rig.
    pub fn shown_runs(&self) -> Vec<RunId> {
        match self.parts.is_empty() {
            true => run_of_file(self).cloned().into_iter().collect(),
            false => self.visible_parts().map(|(part, _)| part.run.clone()).collect(),
        }
    }

    /// Returns the project of the runs of a file of `runs`, which is the same for all of them; None if they have none.
    pub(crate) fn project(&self) -> Option<ProjectName> {
        let stats = self.stats.as_ref()?;
        let [least, greatest] = [&stats.min, &stats.max].map(|values| values.get(PROJECT).and_then(Value::as_str));
        least.filter(|_| least == greatest)?.parse().ok()
    }
}

/// A part in the log: the name that it had as a file of its own, and its rows; in `runs`, and of rows that users add,
/// also the version that added it.
#[derive(Deserialize)]
#[serde(untagged)]
enum LoggedPart {
    Rows(String, u64),
    Versioned(String, u64, u64),
}

/// Parts as text.
pub(crate) fn encode_parts(parts: &[RunPart]) -> String {
    let one = |part: &RunPart| match part.row_version {
        Some(version) => json!([part.file_name(), part.rows, version]),
        None => json!([part.file_name(), part.rows]),
    };
    Value::Array(parts.iter().map(one).collect()).to_string()
}

/// Decodes the parts from such a text; None if it is none.
pub(crate) fn decode_parts(text: &str) -> Option<Vec<RunPart>> {
    let parts: Vec<LoggedPart> = serde_json::from_str(text).ok()?;
    let one = |part: LoggedPart| match part {
        LoggedPart::Rows(name, rows) => RunPart::from_path(&name.into(), rows, None),
        LoggedPart::Versioned(name, rows, version) => RunPart::from_path(&name.into(), rows, Some(version)),
    };
    parts.into_iter().map(one).collect::<Option<Vec<_>>>().filter(|parts| !parts.is_empty())
}

impl RunPart {
    /// The only part of a file of one run; None if the file has another name.
    pub(crate) fn of_file(file: &DataFile) -> Option<Self> {
        let is_pointer = matches!(file.name, Some(FileName::Pointer(_)));
        let part = Self::from_path(&file.path, file.rows, is_pointer.then_some(file.log_version))?;
        Some(Self { row_counts: file.row_counts.clone(), ..part })
    }

    /// Returns whether it is of a run's row in `runs`, whose derivation is several.
    pub(crate) fn is_pointer(&self) -> bool {
        self.derivation.contains('.')
    }

    fn from_path(path: &Path, rows: u64, row_version: Option<u64>) -> Option<Self> {
        match FileName::parse(path)? {
            FileName::Rows { surface, run, derivation } => {
                Some(Self { surface, run, derivation, rows, row_version, row_counts: None })
            }
            FileName::Pointer(pointer) => {
                let derivation = pointer.joined_derivations();
                let row_version = Some(row_version?);
                let row_counts = None;
                Some(Self { surface: pointer.surface, run: pointer.run, derivation, rows, row_version, row_counts })
            }
            FileName::Rig { .. } | FileName::Merged { .. } => None,
        }
    }

    /// The name of a file with these rows alone.
    pub(crate) fn file_name(&self) -> String {
        format!("{}.{}.{}{EXTENSION}", self.surface, self.run, self.derivation)
    }
}
