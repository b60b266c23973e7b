//! The stones of a wall: one trait for all their arrangements.

use super::parameter::{ParameterLayer, ReliefParameter};

/// Seed of the wall; its range is that of whole numbers that a double holds exactly.
pub(super) const SEED: ReliefParameter = ReliefParameter::new_whole(
    "seed",
    ParameterLayer::Mesostructure,
    [0, 9_007_199_254_740_991, 1],
    "which wall of this kind",
);

/// A place on a wall of stones, model mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct StoneSpot {
    /// To the middle of the nearest joint, 0 or more.
    pub to_joint: f64,
    /// Height of the stone's face over the wall's plane, 0 or more; unused inside the joint.
    pub face: f64,
}

/// Arrangement of a wall's stones.
pub(super) trait StoneLayout {
    /// The stone at a place; `half_joint` is half a joint's width, model mm.
    fn spot_at(&self, x: f64, y: f64, half_joint: f64) -> StoneSpot;
}
