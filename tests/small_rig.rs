//! A rig that measures in milliseconds, for tests and campaigns.

/// A rig small enough for tests: 10 points, 45 pairs, sweeps of 30 ms.
pub(crate) const SMALL_RIG: &str = r#"
name = "small"
[sweep]
duration_secs = 0.03
[[grid.layers]]
points_per_side = 3
pitch_mm = 120.0
height_mm = 124.0
[[grid.layers]]
points_per_side = 1
pitch_mm = 0.0
height_mm = 304.0
"#;
