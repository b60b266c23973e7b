//! The wells of a 2D primitive-root diffuser as a wall's stones.

use super::microstructure::{JOINT_SHAPE, joint_depth, joint_width};
use super::parameter::{ParameterLayer, ReliefParameter};
use super::settings::{FULL_SCALE, WallSettings};
use super::stones::{StoneLayout, StoneSpot};
use super::{PANEL_SIZE_MM, PrimitiveRootDiffuser};

const MESO: ParameterLayer = ParameterLayer::Mesostructure;

pub(super) const PARAMETERS: [ReliefParameter; 5] = [
    ReliefParameter::new_choice(
        "prime",
        MESO,
        &["157", "31", "43", "73", "211", "241", "307", "421", "463", "601", "757"],
        "p of the sequence g^k mod p; p - 1 wells, nearly square for these",
    ),
    ReliefParameter::new_mm(
        "well_depth_mm",
        MESO,
        [10.0, 150.0, 150.0],
        "depth of the deepest well; `prd` makes deeper ones",
    ),
    JOINT_SHAPE,
    joint_width(0.0),
    joint_depth(0.0),
];

/// Wells over the panel, model mm.
pub(super) struct DiffuserWells {
    depths: Vec<f64>,
    sides: [f64; 2],
    deepest: f64,
}

impl DiffuserWells {
    pub fn from_settings(settings: &WallSettings) -> Self {
        let deepest = settings.well_depth_mm / FULL_SCALE;
        // The options are primes, and the smallest is 31.
        let prime = settings.prime.parse().unwrap_or(31);
        let diffuser = PrimitiveRootDiffuser { prime, depth_mm: deepest };
        let (n, m) = diffuser.well_counts().unwrap_or((1, 1));
        Self { depths: diffuser.depths_mm(), sides: [n as f64, m as f64], deepest }
    }
}

impl StoneLayout for DiffuserWells {
    fn spot_at(&self, x: f64, y: f64, _half_joint: f64) -> StoneSpot {
        let mut to_joint = f64::INFINITY;
        let mut well = [0, 0];
        for (i, v) in [x, y].into_iter().enumerate() {
            let width = PANEL_SIZE_MM / self.sides[i];
            let index = (v / width + self.sides[i] / 2.0).floor().clamp(0.0, self.sides[i] - 1.0);
            let middle = (index + 0.5 - self.sides[i] / 2.0) * width;
            to_joint = to_joint.min((width / 2.0 - (v - middle).abs()).max(0.0));
            well[i] = index as usize;
        }
        StoneSpot { to_joint, face: self.deepest - self.depths[well[1] * self.sides[0] as usize + well[0]] }
    }
}
