//! Parameters of the reliefs that are not made in layers; their lengths are the panel's own.

use super::parameter::{ParameterLayer, ReliefParameter};

const fn mm(key: &'static str, range: [f64; 3], about: &'static str) -> ReliefParameter {
    ReliefParameter::number(key, ParameterLayer::Whole, "mm on the panel", range, about)
}

const SEED: ReliefParameter =
    ReliefParameter::whole("seed", ParameterLayer::Whole, [0, u64::MAX, 1], "which wall of this kind");

const BRICKS: [ReliefParameter; 7] = [
    mm("length_mm", [5.0, 585.0, 80.0], "length of a stretcher"),
    mm("height_mm", [2.0, 585.0, 30.0], "height of a course without its joint"),
    mm("joint_width_mm", [0.0, 146.25, 4.0], "width of the joints, up to a quarter brick"),
    mm("joint_depth_mm", [0.0, 10.0, 8.0], "depth of the joints"),
    mm("jitter_mm", [0.0, 10.0, 3.0], "bricks stand out by up to this"),
    ReliefParameter::number("tilt_deg", ParameterLayer::Whole, "degrees", [0.0, 5.0, 1.5], "bricks tilt by up to this"),
    SEED,
];
const DIFFUSER: [ReliefParameter; 2] = [
    ReliefParameter::whole("prime", ParameterLayer::Whole, [5, 10_007, 157], "the prime p; p - 1 wells"),
    mm("depth_mm", [0.1, 38.0, 38.0], "depth of the deepest well under the highest"),
];
const WAVES: [ReliefParameter; 4] = [
    ReliefParameter::whole("waves", ParameterLayer::Whole, [1, 32, 3], "number of waves"),
    mm("wavelength_mm", [20.0, 10_000.0, 250.0], "shortest wavelength"),
    mm("depth_mm", [0.0, 22.0, 20.0], "crest over trough at most"),
    SEED,
];

/// Returns the parameters of a relief.
pub(super) fn parameters(relief: &str) -> &'static [ReliefParameter] {
    match relief {
        "brick" | "flemish" => &BRICKS,
        "prd" => &DIFFUSER,
        "wavy" => &WAVES,
        _ => &[],
    }
}
