//! Functions of the values of many rows.

pub(crate) mod average;
pub(crate) mod p90_mean;
pub(crate) mod panel_splits;
pub(crate) mod value_counts;
