//! Implementations of the rig's traits.

pub(crate) mod paced;
pub mod simulated;
