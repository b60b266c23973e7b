//! Reads a run's file and measures it.

mod copy_holes;
mod measure;
mod run_channels;
mod run_content;
mod run_envelope;

pub(crate) use copy_holes::check_filled;
pub(crate) use measure::{Event, Measurer, Response};
pub(crate) use run_content::RunContent;
pub(crate) use run_envelope::RunHead;
