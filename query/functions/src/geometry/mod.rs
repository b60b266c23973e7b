//! Functions of geometry, sound and symmetry.

pub(crate) mod fresnel;
pub(crate) mod sound;
pub(crate) mod symmetry;
