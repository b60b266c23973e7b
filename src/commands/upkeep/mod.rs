//! Commands that keep the tables of a lake in order.

pub(crate) mod optimize;
pub(crate) mod rebuild;
pub(crate) mod remove;
pub(crate) mod tag;
pub(crate) mod vacuum;
