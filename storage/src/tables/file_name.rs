//! Names of the files in `tables/`, and of the folders that they are in.

use echolake_schema::tables::Table;
use echolake_schema::{RunId, SurfaceId};
use object_store::path::Path;

/// Parsed name of a file in `tables/`.
///
/// ```
/// use echolake_lake::FileName;
///
/// let name = FileName::Rows { surface: "flat".parse()?, run: "r1".parse()?, derivation: "ab".into() };
/// assert_eq!(name.compose(), "flat.r1.ab.parquet");
/// assert_eq!(FileName::parse(&"tables/nce/flat.r1.ab.parquet".into()), Some(name));
/// # Ok::<(), echolake_schema::Error>(())
/// ```
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
    /// Rows of several runs, which the log lists.
    Merged {
        /// Digest of the list.
        digest: String,
    },
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
    /// Mark of the verdicts that its rows follow; None if they reject none of its measurements.
    pub verdicts: Option<String>,
}

/// Common beginning of the names of files with rows of this run alone.
pub(crate) fn run_prefix(surface: &SurfaceId, run: &RunId) -> String {
    format!("{surface}.{run}.")
}

impl VisibleRun {
    /// Common beginning of the names of all of the run's rows in `runs`.
    pub(crate) fn name_prefix(&self) -> String {
        run_prefix(&self.surface, &self.run)
    }

    /// Both derivations and the mark of the verdicts, as the name of the run's row has them.
    pub(crate) fn joined_derivations(&self) -> String {
        let mark = self.verdicts.iter().map(|mark| format!("{MARKED}{mark}")).collect::<String>();
        format!("{}.{}{mark}", self.run_derivation, self.reference_derivation.as_deref().unwrap_or(WITHOUT))
    }
}

/// Extension of all files of tables.
pub(crate) const EXTENSION: &str = ".parquet";
const WITHOUT: &str = "none";
/// What precedes the mark of verdicts.
const MARKED: &str = "-";
const MERGED: &str = "merged";

impl FileName {
    /// The name.
    pub fn compose(&self) -> String {
        match self {
            Self::Rig { derivation } => format!("rig.{derivation}{EXTENSION}"),
            Self::Merged { digest } => format!("{MERGED}.{digest}{EXTENSION}"),
            Self::Rows { surface, run, derivation } => format!("{surface}.{run}.{derivation}{EXTENSION}"),
            Self::Pointer(run) => format!("{}{}{EXTENSION}", run.name_prefix(), run.joined_derivations()),
        }
    }

    /// Parses a name; None if it is not one of ours.
    pub fn parse(path: &Path) -> Option<Self> {
        let parts: Vec<_> = path.filename()?.strip_suffix(EXTENSION)?.split('.').collect();
        match parts[..] {
            ["rig", derivation] => Some(Self::Rig { derivation: derivation.into() }),
            [MERGED, digest] => Some(Self::Merged { digest: digest.into() }),
            [surface, run, derivation] => Some(Self::Rows {
                surface: surface.parse().ok()?,
                run: run.parse().ok()?,
                derivation: derivation.into(),
            }),
            [surface, run, run_derivation, references] => {
                let (references, verdicts) = match references.split_once(MARKED) {
                    Some((references, mark)) => (references, Some(mark.to_owned())),
                    None => (references, None),
                };
                Some(Self::Pointer(VisibleRun {
                    surface: surface.parse().ok()?,
                    run: run.parse().ok()?,
                    run_derivation: run_derivation.into(),
                    reference_derivation: (references != WITHOUT).then(|| references.into()),
                    verdicts,
                }))
            }
            _ => None,
        }
    }
}

/// Returns a table's folder in the lake.
pub(crate) fn table_folder(table: Table) -> Path {
    Path::from(format!("tables/{}", table.name()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_round_trip() {
        for name in [
            "rig.ab.parquet",
            "0015_0.20260105T080000Z-0015_0-7c1e.ab.parquet",
            "flat.r.ab.none.parquet",
            "flat.r.ab.cd.parquet",
            "flat.r.ab.cd-ef.parquet",
            "flat.r.ab.none-rejected.parquet",
            "merged.ab.parquet",
        ] {
            let parsed = FileName::parse(&Path::from(name)).expect(name);
            assert_eq!(parsed.compose(), name);
        }
        for foreign in ["part-00000.parquet", "a.b.c.d.e.parquet", "a.b.c", "..parquet"] {
            assert_eq!(FileName::parse(&Path::from(foreign)), None, "{foreign}");
        }
    }
}
