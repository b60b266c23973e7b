//! Shape shared by stones of every kind: they stand out, lean and bulge.

use super::chance::SeededRandom;
use super::parameter::{ParameterLayer, ReliefParameter};
use super::settings::{FULL_SCALE, WallSettings};

/// Makes the parameter for the stones' height over the wall.
pub(super) const fn stone_projection(high: f64, default: f64) -> ReliefParameter {
    let about = "stones stand out of the wall by up to this";
    ReliefParameter::new_mm("projection_mm", ParameterLayer::Mesostructure, [0.0, high, default], about)
}

/// Makes the parameter for the stones' lean.
pub(super) const fn stone_lean(default: f64) -> ReliefParameter {
    let about = "one edge or corner of a stone stands out over its opposite by up to this";
    ReliefParameter::new_mm("lean_mm", ParameterLayer::Mesostructure, [0.0, 30.0, default], about)
}

/// Makes the parameter for the bulge of the stones' faces.
pub(super) const fn stone_bulge(high: f64, default: f64) -> ReliefParameter {
    let about = "the middle of a stone's face stands out over its edges by this";
    ReliefParameter::new_mm("bulge_mm", ParameterLayer::Mesostructure, [0.0, high, default], about)
}

/// Face of each stone of a wall, model mm.
#[derive(Debug, Clone)]
pub(super) struct StoneFaces {
    projection: f64,
    lean: f64,
    bulge: f64,
}

impl StoneFaces {
    pub fn from_settings(settings: &WallSettings) -> Self {
        Self {
            projection: settings.projection_mm / FULL_SCALE,
            lean: settings.lean_mm / FULL_SCALE,
            bulge: settings.bulge_mm / FULL_SCALE,
        }
    }

    /// Height of a stone's face. `place` runs from -1 to 1 over the stone, `rise` from 0 at its edge to 1 where it
    /// bulges most.
    pub fn face_height(&self, stone: SeededRandom, place: [f64; 2], rise: f64) -> f64 {
        let slope = [stone.signed_number(1), stone.signed_number(2)];
        // Leaning stones turn out of the wall, never into it.
        let lean: f64 = (0..2).map(|i| slope[i] * place[i].clamp(-1.0, 1.0) + slope[i].abs()).sum();
        self.projection * stone.unit_number(0) + self.lean * lean / 4.0 + self.bulge * rise
    }
}

/// Rises from 0 at the edge to 1 at a distance, and is level there.
pub(super) fn pillow_rise(inside: f64, distance: f64) -> f64 {
    let t = (inside / distance).clamp(0.0, 1.0);
    t * (2.0 - t)
}
