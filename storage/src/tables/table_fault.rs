//! What is wrong with a table: its log does not have what `runs` names, or cannot be read.

use echolake_schema::RunId;
use echolake_schema::tables::Table;

use crate::{DataFile, Error};

/// A run that has other rows in a table than its row in `runs` names.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LackingRows {
    /// The run.
    pub run: RunId,
    /// Rows that it must have; None if an earlier version of the program wrote its row in `runs`, which does not say.
    pub expected: Option<u64>,
    /// Rows that the table's log has.
    pub actual: u64,
}

impl std::fmt::Display for LackingRows {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.expected {
            Some(expected) => write!(f, "run `{}` has {} rows, expected {expected}", self.run, self.actual),
            None => write!(f, "run `{}` has {} rows, expected some", self.run, self.actual),
        }
    }
}

/// A table that cannot be answered from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct TableFault {
    /// The table.
    pub table: Table,
    /// Files of another program are all that is wrong.
    pub is_of_foreign_files: bool,
    is_unreadable: bool,
    found: String,
}

impl TableFault {
    fn new(table: Table, found: impl Into<String>) -> Self {
        Self { table, is_of_foreign_files: false, is_unreadable: false, found: found.into() }
    }

    pub fn from_lacking(table: Table, lacking: &[LackingRows]) -> Self {
        let first = lacking.first().map(ToString::to_string).unwrap_or_default();
        match lacking.len() {
            0 | 1 => Self::new(table, first),
            count => Self::new(table, format!("{first}, and {} more runs lack rows", count - 1)),
        }
    }

    pub fn from_foreign(table: Table, file: &DataFile) -> Self {
        let found = format!("another program put `{}` into its log", file.path);
        Self { is_of_foreign_files: true, ..Self::new(table, found) }
    }

    /// A version that `runs` shows and the log no longer has.
    pub fn lost_version(table: Table, shown: u64, newest: Option<u64>) -> Self {
        let found = match newest {
            Some(newest) => format!("its log ends at version {newest}, and `runs` names version {shown}"),
            None => format!("it has no log, and `runs` names version {shown}"),
        };
        Self::new(table, found)
    }

    pub fn without_rig(table: Table) -> Self {
        Self::new(table, "it has none of the rig's rows")
    }

    pub fn without_log(table: Table) -> Self {
        Self::new(table, "it has no log, and `runs/` has run files")
    }

    pub fn unfinished() -> Self {
        Self::new(Table::Runs, "it was emptied or changed by another program, and not all run files are in it again")
    }

    pub fn unreadable(table: Table, found: String) -> Self {
        Self { is_unreadable: true, ..Self::new(table, found) }
    }

    pub fn to_error(&self) -> Error {
        let table = self.table.name();
        let found = self.found.clone();
        match self.is_unreadable {
            true => Error::Log { table, action: "read", source: found.into() },
            false => Error::Incomplete { table, found },
        }
    }
}
