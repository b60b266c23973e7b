//! The lake's tables for DataFusion: standard scans of the Parquet files of one snapshot, and the last rewrite of a plan,
//! after which scans read what the process holds.

mod boxed_scan;
mod held_scan;
mod held_table;
mod lake_table;
mod local_scans;
mod readers;
mod scan_files;
mod small_tables;

pub use lake_table::{FileReaders, LakeTable};
pub use local_scans::rewrite_local_scans;
pub use readers::LakeReaderFactory;
pub use small_tables::SmallTables;
