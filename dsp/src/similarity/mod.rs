//! How alike signals and rows are.

pub mod components;
pub mod correlation;
pub mod self_organising_map;
