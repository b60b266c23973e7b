//! Acquisition: from a rig to a run's MCAP file.

pub mod design;
pub mod disk;
pub mod recovery;
pub mod replay;
pub mod rig;
pub mod run;
mod viewer;

pub use viewer::ViewerAccess;
