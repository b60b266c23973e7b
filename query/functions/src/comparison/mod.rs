//! Functions that compare lists, and the diffusion of levels.

pub(crate) mod alike;
pub(crate) mod diffusion;
