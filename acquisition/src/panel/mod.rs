//! Panels: reliefs, their meshes and materials, collections of them, and a panel as a run needs it.

pub mod collection;
pub mod material;
pub mod mesh;
pub(crate) mod prepared_panel;
pub mod relief;
