//! Panels: reliefs, their meshes and materials, those of the paper, collections of them, and a panel as a run needs it.

pub mod collection;
pub mod material;
pub mod mesh;
pub mod paper_panel;
pub(crate) mod prepared_panel;
pub mod relief;
