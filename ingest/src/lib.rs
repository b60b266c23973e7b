//! From a run's MCAP file to rows.
//!
//! A run's rows are committed first and its row in `runs` last: after that commit readers see them. Then
//! [`LakeIngest::complete`] derives again the rows that used outdated references, and nothing else.
//!
//! ```no_run,standalone_crate
//! use echolake_ingest::{FileReport, LakeIngest, pending};
//! # async fn example() -> Result<(), Box<dyn std::error::Error>> {
//! let lake = echolake_lake::Lake::open("lake").await?;
//! let ingest = LakeIngest::new(&lake, std::sync::Arc::default());
//! ingest
//!     .take_in(pending(&lake).await?, &mut |report| {
//!         if let FileReport::Taken(taken) = report {
//!             println!("{} measurements of {}", taken.measurements, taken.surface);
//!         }
//!     })
//!     .await?;
//! ingest.complete(&mut |_, _| {}).await?;
//! ingest.close().await;
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
mod files;
mod ingest;
mod marks;
mod measure;
#[cfg(test)]
mod mortal;
mod pipeline;
mod read_back;
mod references;
mod remove;
mod rows;
mod run_channels;
mod run_content;
#[cfg(test)]
mod skewed;

pub use complete::{CompletedRun, CompletionReport, CompletionSummary};
pub use echolake_recording::FileIntegrity;
pub use error::{Error, Result};
pub use files::{
    PendingFiles, RecordingState, RunSource, UnfinishedRecording, find_runs, has_end, list_arrivals, list_pending,
    pending, rig_of_run,
};
pub use ingest::{FileReport, IngestOutcome, IngestedRun, LakeIngest};
#[doc(hidden)]
pub use marks::SuspectFile;
pub use remove::{RemovedFile, RunRemoval, find_removals, find_removed};

/// Version of the code that derives rows; every row has it.
pub const CODE_VERSION: &str = concat!("echolake ", env!("CARGO_PKG_VERSION"));
