//! From a rig, or from somebody's files, to a run's MCAP file.

pub mod relief;
pub mod mesh;
pub mod kirchhoff;
