//! The skin of a wall: its joints' profile, and how rough it is.

use super::chance::SeededRandom;
use super::parameter::{ParameterLayer, ReliefParameter};
use super::settings::{FULL_SCALE, JointShape, WallSettings};

const LAYER: ParameterLayer = ParameterLayer::Microstructure;

pub(super) const JOINT_SHAPE: ReliefParameter = ReliefParameter::new_choice(
    "joint_shape",
    LAYER,
    &["recessed", "flush", "raked", "concave", "v"],
    "profile of the joints: recessed has a level floor, flush is filled up to the stones, raked has an uneven floor, \
     concave is a bucket handle's arc, v has two slopes",
);
/// Parameters of how far the joints differ from their width and depth.
pub(super) const JITTER: [ReliefParameter; 2] = [
    ReliefParameter::new_mm(
        "joint_width_jitter_mm",
        LAYER,
        [0.0, 20.0, 0.0],
        "joints are wider and narrower than joint_width_mm by up to this",
    ),
    ReliefParameter::new_mm(
        "joint_depth_jitter_mm",
        LAYER,
        [0.0, 20.0, 0.0],
        "joints are deeper and shallower than joint_depth_mm by up to this",
    ),
];
/// Distance along the wall over which the joints' width and depth change, full-scale mm: about half a brick.
const JITTER_MM: f64 = 120.0;
/// Parameters of the skin.
pub(super) const SKIN: [ReliefParameter; 2] = [
    ReliefParameter::new_mm(
        "roughness_mm",
        LAYER,
        [0.0, 60.0, 0.0],
        "height of the surface's unevenness from its lowest to its highest point at most: +-30 mm are 60",
    ),
    ReliefParameter::new_mm("roughness_grain_mm", LAYER, [20.0, 400.0, 60.0], "size of the unevenness along the wall"),
];

/// Makes the parameter for the joints' width.
pub(super) const fn joint_width(default: f64) -> ReliefParameter {
    ReliefParameter::new_mm("joint_width_mm", LAYER, [0.0, 40.0, default], "width of the joints between stones")
}

/// Makes the parameter for the joints' depth.
pub(super) const fn joint_depth(default: f64) -> ReliefParameter {
    ReliefParameter::new_mm(
        "joint_depth_mm",
        LAYER,
        [0.0, 80.0, default],
        "how far the joints lie behind the stones' faces",
    )
}

/// Joints and skin.
#[derive(Debug, Clone)]
pub(super) struct MicrostructureModel {
    shape: JointShape,
    /// Model mm.
    half_width: f64,
    depth: f64,
    half_width_jitter: f64,
    depth_jitter: f64,
    roughness: f64,
    grain: f64,
    chance: SeededRandom,
}

impl MicrostructureModel {
    pub fn from_settings(settings: &WallSettings) -> Self {
        Self {
            shape: settings.joint_shape,
            half_width: settings.joint_width_mm / FULL_SCALE / 2.0,
            depth: settings.joint_depth_mm / FULL_SCALE,
            half_width_jitter: settings.joint_width_jitter_mm / FULL_SCALE / 2.0,
            depth_jitter: settings.joint_depth_jitter_mm / FULL_SCALE,
            roughness: settings.roughness_mm / FULL_SCALE,
            grain: settings.roughness_grain_mm / FULL_SCALE,
            chance: SeededRandom::new(settings.seed, 0x4A01),
        }
    }

    /// Returns half the width of the joints near a place, model mm.
    pub fn half_width(&self, x: f64, y: f64) -> f64 {
        (self.half_width + self.jitter_at(2, self.half_width_jitter, x, y)).max(0.0)
    }

    // Unevenness along the joints, up to `most` to either side.
    fn jitter_at(&self, purpose: i64, most: f64, x: f64, y: f64) -> f64 {
        if most == 0.0 {
            return 0.0;
        }
        let scale = JITTER_MM / FULL_SCALE;
        most * self.chance.at_place(purpose, 0).smooth_noise(x / scale, y / scale)
    }

    /// Returns the height of a joint under the wall's plane, at a distance from its middle that is below its
    /// `half_width` here.
    pub fn joint_height(&self, to_middle: f64, half_width: f64, x: f64, y: f64) -> f64 {
        // 0 at the joint's edges, 1 in its middle.
        let in_joint = ((half_width - to_middle) / half_width).clamp(0.0, 1.0);
        let share = match self.shape {
            JointShape::Flush => 0.0,
            JointShape::Recessed => 1.0,
            // Mortar that was scratched out is uneven along the joint, by about its width.
            JointShape::Raked => {
                0.75 + 0.25 * self.chance.smooth_noise(x / (2.0 * self.half_width), y / (2.0 * self.half_width))
            }
            JointShape::Concave => (in_joint * (2.0 - in_joint)).sqrt(),
            JointShape::V => in_joint,
        };
        -(self.depth + self.jitter_at(3, self.depth_jitter, x, y)).max(0.0) * share
    }

    /// Unevenness of the skin: three octaves of noise, each half as high as the one before.
    pub fn roughness_at(&self, x: f64, y: f64) -> f64 {
        if self.roughness == 0.0 {
            return 0.0;
        }
        let octave = |n: u32| {
            let scale = f64::from(1 << n);
            self.chance.at_place(1, i64::from(n)).smooth_noise(x * scale / self.grain, y * scale / self.grain) / scale
        };
        (octave(0) + octave(1) + octave(2)) / 1.75 * self.roughness / 2.0
    }
}
