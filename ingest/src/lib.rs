//! From a run's MCAP file to rows.
//!
//! A run's own rows are committed first and its row in `runs` last. Then [`complete()`] derives what needs
//! references, for every run whose references are there and are not the ones its rows used.
//!
//! ```no_run
//! use echolake_ingest::{Ingest, Source, complete};
//! # async fn example() -> Result<(), Box<dyn std::error::Error>> {
//! let lake = echolake_lake::Lake::open("lake").await?;
//! let taken = Ingest::new(&lake).take_in(&Source::File("run.mcap".into())).await?;
//! println!("{} measurements of {}", taken.measurements, taken.surface);
//! complete(&lake, &mut |_| {}).await?;
//! # Ok(())
//! # }
//! ```

mod chunk;
mod complete;
mod derive;
pub mod doctor;
mod error;
mod ingest;
mod inspect;
mod measure;
mod read_back;
mod record_shape;
mod references;
mod rows;
mod run_content;
mod run_reader;

pub use complete::{Completed, complete};
pub use error::{Error, Result};
pub use ingest::{Ingest, Outcome, Source, Taken, pending};
#[doc(hidden)]
pub use inspect::{Inspected, Inspection, inspect};
pub use run_reader::Integrity;

/// Version of the code that derives rows; it stands in every row.
pub const CODE_VERSION: &str = concat!("echolake ", env!("CARGO_PKG_VERSION"));
