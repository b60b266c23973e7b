//! Rows of every table, as Arrow batches in the order of the table's columns.

mod columns;
pub(crate) mod derived;
pub(crate) mod heightmaps;
pub(crate) mod logs;
pub(crate) mod measurements;
pub(crate) mod runs;
pub(crate) mod stats;
pub(crate) mod surfaces;

pub(crate) use columns::{RowColumns, RunKeys};
