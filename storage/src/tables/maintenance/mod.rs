//! Work on whole tables: merging and deleting files, removing runs, making a lost table again.

mod optimize;
mod rebuild;
mod removal;
mod vacuum;

pub use optimize::{MergeProgress, OptimizeReport, TARGET_BYTES, TableOptimizeReport};
pub use rebuild::GivenUpRows;
pub use vacuum::{DeletedFile, DeletionMode, KEEP_HOURS, VacuumReport};
