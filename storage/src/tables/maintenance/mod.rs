//! Work on whole tables: merging and deleting files, removing runs, making a lost table again.

mod optimize;
mod rebuild;
mod removal;
mod vacuum;

#[cfg(test)]
pub(crate) use optimize::tests as merge_tests;
pub use optimize::{MergeProgress, OptimizeReport, TARGET_BYTES, TableOptimizeReport};
pub(crate) use optimize::{group_name, part_key};
pub use rebuild::GivenUpRows;
pub use vacuum::{DeletedFile, DeletionMode, KEEP_HOURS, VacuumReport};
