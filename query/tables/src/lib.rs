//! The lake's tables for DataFusion: Parquet files of one snapshot, and small tables from memory.

mod boxed_scan;
mod lake_table;
mod part_rows;
mod readers;
mod small_tables;
mod unfiltered_source;

pub use lake_table::{FileReaders, LakeTable};
pub use readers::LakeReaderFactory;
pub use small_tables::SmallTables;
