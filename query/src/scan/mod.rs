//! Scans of the lake's tables: Parquet files of one snapshot, and small tables from memory.

pub(crate) mod boxed_scan;
mod part_rows;
pub(crate) mod readers;
#[cfg(test)]
mod request_tests;
pub(crate) mod small_tables;
pub(crate) mod table;
