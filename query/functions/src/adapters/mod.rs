//! How kernels become functions of DataFusion: their descriptions, arguments and answers, and the rig they are for.

pub(crate) mod aggregate;
pub(crate) mod answers;
pub(crate) mod arguments;
pub(crate) mod description;
pub(crate) mod per_length;
pub(crate) mod rig;
pub(crate) mod scalar;
