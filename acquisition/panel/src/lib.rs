//! Panels: reliefs, their meshes and materials, those of the paper, collections of them, and a panel as a run needs it.
//!
//! ```
//! use echolake_panel::relief::PanelRelief;
//!
//! let wall = PanelRelief::by_name("stretcher_bond")?;
//! assert_eq!(wall.material().name(), "coated print");
//! # Ok::<(), echolake_panel::relief::Error>(())
//! ```

pub mod collection;
pub mod material;
pub mod mesh;
pub mod paper_panel;
mod prepared_panel;
pub mod relief;

pub use prepared_panel::{OriginalFile, PanelGeometry, PanelSpecimen, PreparedPanel};
