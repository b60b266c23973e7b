//! Implementations of the rig's traits.

pub mod simulated;
pub(crate) mod paced;
