//! Acquisition: from a rig, or from files of another origin, to a run's MCAP file.
//!
//! ```
//! use echolake_acquisition::relief::PanelRelief;
//!
//! let wall = PanelRelief::by_name("stretcher_bond")?;
//! assert_eq!(wall.material().reflection_factor, 0.83);
//! # Ok::<(), echolake_acquisition::relief::Error>(())
//! ```

pub mod assessment;
pub mod collection;
pub mod conformance;
pub mod controller;
pub mod disk;
pub mod drivers;
#[cfg(feature = "import")]
pub mod import;
pub mod live;
pub mod mesh;
pub mod metrics;
pub mod objection;
pub mod plan;
pub mod preflight;
mod prepared_panel;
pub mod recorder;
pub mod recovery;
pub mod relief;
pub mod replay;
pub mod rig;
pub mod rigs;
pub mod robots;
pub mod run;
pub mod session;
pub mod simulate;
mod viewer;

pub use viewer::ViewerAccess;
