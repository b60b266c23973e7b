//! Heights of reliefs.

pub mod height_field;
pub mod heights;
