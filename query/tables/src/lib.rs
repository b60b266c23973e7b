//! The lake's tables for DataFusion: standard scans of the Parquet files of one snapshot, and the last rewrite of a plan,
//! after which scans read what the process holds.

mod boxed_scan;
mod column_store;
mod held_scan;
mod lake_table;
mod leading_filter;
mod local_scans;
mod placed_rows;
mod readers;
mod run_rows;
mod scan_files;

pub use column_store::ColumnStore;
pub use lake_table::{FileReaders, LakeTable, TableSize};
pub use local_scans::{rewrite_children, rewrite_local_scans};
pub use readers::LakeReaderFactory;
pub use run_rows::{RowReading, RunRows};
