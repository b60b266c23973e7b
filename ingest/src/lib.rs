//! From a run's MCAP file to rows.
//!
//! A run's rows are committed first and its row in `runs` last: after that commit readers see them. Then
//! [`LakeIngest::complete_runs`] derives again the rows that used outdated references, and nothing else.
//!
//! ```no_run,standalone_crate
//! use echolake_ingest::{FileReport, LakeIngest, pending_runs};
//! # async fn example() -> Result<(), Box<dyn std::error::Error>> {
//! let lake = echolake_lake::Lake::open("lake").await?;
//! let ingest = LakeIngest::new(&lake, std::sync::Arc::default());
//! ingest
//!     .ingest_runs(pending_runs(&lake).await?, &mut |report| {
//!         if let FileReport::Ingested(run) = report {
//!             println!("{} measurements of {}", run.measurements, run.surface);
//!         }
//!     })
//!     .await?;
//! ingest.complete_runs(&mut |_, _| {}).await?;
//! ingest.release_claims().await;
//! # Ok(())
//! # }
//! ```

mod complete;
mod context;
#[cfg(test)]
mod crash_tests;
mod derive;
mod derived_values;
pub mod doctor;
mod error;
mod freed_memory;
mod inbox;
mod ingest;
mod pipeline;
mod read_back;
mod reading;
mod references;
mod remove;
mod report;
#[cfg(test)]
mod revision_tests;
mod rows;
mod run_derivation;

pub use complete::{CompletedRun, CompletionReport, CompletionSummary};
pub use echolake_recording::FileIntegrity;
pub use error::{Error, Result};
pub use freed_memory::keep_freed_memory;
pub use inbox::{
    PendingFiles, RecordingState, RunSource, SuspectFile, UnfinishedRecording, find_runs, has_end, list_arrivals,
    list_pending, pending_runs, rig_of_run,
};
pub use ingest::LakeIngest;
pub use remove::{RemovedFile, RunRemoval, find_removals, find_removed};
pub use report::{FileReport, IngestOutcome, IngestedRun};

/// Version of the code that derives rows; every row has it.
pub const CODE_VERSION: &str = concat!("echolake ", env!("CARGO_PKG_VERSION"));
