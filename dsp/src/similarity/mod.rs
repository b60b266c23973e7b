//! Measures of likeness of signals and rows.

pub mod components;
pub mod correlation;
pub mod self_organising_map;
pub mod significance;
