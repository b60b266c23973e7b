//! Acquisition: from a rig, or from files of another origin, to a run's MCAP file.

pub mod disk;
#[cfg(feature = "import")]
pub mod import;
pub mod recovery;
pub mod replay;
pub mod rig;
pub mod run;
mod viewer;

pub use viewer::ViewerAccess;
