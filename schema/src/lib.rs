//! Ids, quantities, grid, symmetry, messages and table schemas of echolake. Knows no other member and does no I/O.
//!
//! ```
//! use echolake_schema::{Rig, SurfaceId};
//!
//! let rig = Rig::paper();
//! let grid = rig.build_grid()?;
//! assert_eq!((grid.points().len(), grid.pairs().len()), (78, 2951));
//! let surface: SurfaceId = "panel_0016_r180_0".parse()?;
//! assert_eq!(surface.panel(), "0016");
//! # Ok::<(), echolake_schema::Error>(())
//! ```

pub mod annotations;
pub mod devices;
mod error;
pub mod grid;
pub mod ids;
pub mod interchange;
pub mod manifest;
pub mod messages;
pub mod quantities;
pub mod rig;
pub mod robots;
pub mod samples;
pub mod simulation;
pub mod splits;
pub mod symmetry;
pub mod tables;
pub mod topics;

pub use error::{Error, ErrorCause, escape_controls, quoted_text};
pub use grid::{Grid, Pair, Point};
pub use ids::{PairId, PointId, ProjectName, RunId, SurfaceId};
pub use manifest::{RunManifest, SurfaceRecord, SurfaceRole};
pub use quantities::{Celsius, MODEL_SCALE, SampleRate, Timestamp};
pub use rig::{AirTreatment, Rig, SpectralDivision, SweepShape};
pub use symmetry::Symmetry;
pub use tables::Table;
