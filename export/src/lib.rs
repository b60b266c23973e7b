//! Data out of the lake: training sets, slices of run files, and the formats that acousticians expect.
//!
//! ```no_run,standalone_crate
//! # async fn example() -> Result<(), Box<dyn std::error::Error>> {
//! use echolake_export::{TrainingSet, write_training_set};
//!
//! let lake = echolake_lake::Lake::open("lake").await?;
//! let done = write_training_set(&lake, "training".as_ref(), &TrainingSet::default(), &mut |_, _| {}).await?;
//! println!("{} files", done.files.len());
//! # Ok(())
//! # }
//! ```

mod acoustics;
mod error;
mod ml;
mod output;
mod rows;
mod slice;
#[cfg(test)]
mod tests;

pub use acoustics::{
    DryRecording, ListenedResponse, MaterialBand, MaterialFormat, ResponseFormat, SOFA_COLUMNS, SoundLevel,
    format_materials, write_responses, write_sofa_file, write_sounds, write_wav,
};
pub use error::{Error, Result};
pub use ml::{
    ExportSummary, PartCounts, RowSymmetries, SHARDS, SplitBy, SplitParams, SplitPart, SurfaceSelection, TrainingSet,
    write_training_set,
};
pub use output::{PendingFile, WrittenFile};
pub use slice::{Check, Layout, Outline, OutlineSchema, OutlineTopic, Slice, SliceParams, Taken, outline_slice};
