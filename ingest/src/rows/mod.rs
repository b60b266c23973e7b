//! Rows of every table of a run, as Arrow batches.

pub(crate) mod derived;
pub(crate) mod heightmaps;
mod keys;
pub(crate) mod logs;
pub(crate) mod measurements;
pub(crate) mod runs;
pub(crate) mod stats;
pub(crate) mod surfaces;

pub(crate) use keys::RunKeys;

/// Returns None for NaN and infinities.
fn finite_value(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}
