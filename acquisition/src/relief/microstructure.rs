//! The skin of a wall: its joints' profile, and how rough it is.

use super::chance::SeededRandom;
use super::parameter::{ParameterLayer, ReliefParameter};
use super::settings::WallSettings;

const LAYER: ParameterLayer = ParameterLayer::Microstructure;

pub(super) const JOINT_SHAPE: ReliefParameter = ReliefParameter::choice(
    "joint_shape",
    LAYER,
    &["recessed", "flush", "raked", "concave", "v"],
    "profile of the joints: recessed has a level floor, flush is filled up to the stones, raked has an uneven floor, \
     concave is a bucket handle's arc, v has two slopes",
);
pub(super) const JOINT_WIDTH: ReliefParameter = joint_width(10.0);
pub(super) const JOINT_DEPTH: ReliefParameter = joint_depth(10.0);
pub(super) const ROUGHNESS: ReliefParameter = ReliefParameter::mm(
    "roughness_mm",
    LAYER,
    [0.0, 10.0, 0.0],
    "height of the surface's unevenness from its lowest to its highest point at most",
);
pub(super) const GRAIN: ReliefParameter =
    ReliefParameter::mm("roughness_grain_mm", LAYER, [20.0, 400.0, 60.0], "size of the unevenness along the wall");

/// [`JOINT_WIDTH`] with another default.
pub(super) const fn joint_width(default: f64) -> ReliefParameter {
    ReliefParameter::mm("joint_width_mm", LAYER, [0.0, 40.0, default], "width of the joints between stones")
}

/// [`JOINT_DEPTH`] with another default.
pub(super) const fn joint_depth(default: f64) -> ReliefParameter {
    ReliefParameter::mm(
        "joint_depth_mm",
        LAYER,
        [0.0, 40.0, default],
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
    roughness: f64,
    grain: f64,
    chance: SeededRandom,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum JointShape {
    Flush,
    Recessed,
    Raked,
    Concave,
    V,
}

impl MicrostructureModel {
    pub(super) fn of(settings: &WallSettings, seed: u64) -> Self {
        let shape = match settings.word(&JOINT_SHAPE) {
            "flush" => JointShape::Flush,
            "raked" => JointShape::Raked,
            "concave" => JointShape::Concave,
            "v" => JointShape::V,
            _ => JointShape::Recessed,
        };
        Self {
            shape,
            half_width: settings.model_mm(&JOINT_WIDTH) / 2.0,
            depth: settings.model_mm(&JOINT_DEPTH),
            roughness: settings.model_mm(&ROUGHNESS),
            grain: settings.model_mm(&GRAIN),
            chance: SeededRandom::new(seed, 0x4A01),
        }
    }

    /// Distance of a point from its stone's edge, model mm: below 0 in the joint.
    pub(super) fn inside(&self, to_middle_of_joint: f64) -> f64 {
        to_middle_of_joint - self.half_width
    }

    /// Returns the height of the joint under the wall's plane, if `inside` is below 0.
    pub(super) fn joint(&self, inside: f64, x: f64, y: f64) -> f64 {
        // 0 at the joint's edges, 1 in its middle.
        let in_joint = (-inside / self.half_width).clamp(0.0, 1.0);
        let share = match self.shape {
            JointShape::Flush => 0.0,
            JointShape::Recessed => 1.0,
            // Mortar that was scratched out is uneven along the joint, by about its width.
            JointShape::Raked => {
                0.75 + 0.25 * self.chance.noise(x / (2.0 * self.half_width), y / (2.0 * self.half_width))
            }
            JointShape::Concave => (in_joint * (2.0 - in_joint)).sqrt(),
            JointShape::V => in_joint,
        };
        -self.depth * share
    }

    /// Unevenness of the skin: three octaves of noise, each half as high as the one before.
    pub(super) fn roughness(&self, x: f64, y: f64) -> f64 {
        if self.roughness == 0.0 {
            return 0.0;
        }
        let octave = |n: u32| {
            let scale = f64::from(1 << n);
            self.chance.at(1, i64::from(n)).noise(x * scale / self.grain, y * scale / self.grain) / scale
        };
        (octave(0) + octave(1) + octave(2)) / 1.75 * self.roughness / 2.0
    }
}
