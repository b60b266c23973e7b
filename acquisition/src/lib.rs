//! Acquisition: from a rig, or from files of another origin, to a run's MCAP file.
//!
//! ```
//! use echolake_acquisition::panel::relief::PanelRelief;
//!
//! let wall = PanelRelief::by_name("stretcher_bond")?;
//! assert_eq!(wall.material().name(), "coated print");
//! # Ok::<(), echolake_acquisition::panel::relief::Error>(())
//! ```

pub mod disk;
#[cfg(feature = "import")]
pub mod import;
pub mod panel;
pub mod recovery;
pub mod replay;
pub mod rig;
pub mod run;
mod viewer;

pub use viewer::ViewerAccess;
