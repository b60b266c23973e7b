//! The large shape of a wall: flat, waves in one or two directions, a dome, a bowl.

use super::PANEL_SIZE_MM;
use super::chance::cosine_of_turns;
use super::parameter::{ParameterLayer, ReliefParameter};
use super::settings::WallSettings;

pub(super) const SHAPE: ReliefParameter = ReliefParameter::choice(
    "macrostructure",
    ParameterLayer::Macrostructure,
    &["flat", "wavy_x", "wavy_y", "wavy_xy", "convex", "concave"],
    "the wall's large shape: waves along x, along y or both, a dome or a bowl",
);
pub(super) const DEPTH: ReliefParameter = ReliefParameter::mm(
    "macro_depth_mm",
    ParameterLayer::Macrostructure,
    [0.0, 200.0, 120.0],
    "height of the large shape from its lowest to its highest point; nothing where it is flat",
);
pub(super) const WAVELENGTH: ReliefParameter = ReliefParameter::mm(
    "macro_wavelength_mm",
    ParameterLayer::Macrostructure,
    [600.0, 6000.0, 2500.0],
    "from crest to crest",
);
pub(super) const PHASE: ReliefParameter = ReliefParameter::number(
    "macro_phase",
    ParameterLayer::Macrostructure,
    "turns",
    [0.0, 1.0, 0.0],
    "where in a wave the wall's middle is: 0 on a crest, 0.5 in a trough",
);

/// The large shape.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct MacrostructureModel {
    shape: MacrostructureShape,
    /// Model mm.
    depth: f64,
    wavelength: f64,
    phase: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum MacrostructureShape {
    Flat,
    Wavy { x: bool, y: bool },
    Convex,
    Concave,
}

impl MacrostructureModel {
    pub(super) fn of(settings: &WallSettings) -> Self {
        let shape = match settings.word(&SHAPE) {
            "wavy_x" => MacrostructureShape::Wavy { x: true, y: false },
            "wavy_y" => MacrostructureShape::Wavy { x: false, y: true },
            "wavy_xy" => MacrostructureShape::Wavy { x: true, y: true },
            "convex" => MacrostructureShape::Convex,
            "concave" => MacrostructureShape::Concave,
            _ => MacrostructureShape::Flat,
        };
        Self {
            shape,
            depth: settings.model_mm(&DEPTH),
            wavelength: settings.model_mm(&WAVELENGTH),
            phase: settings.number(&PHASE),
        }
    }

    /// Height over its lowest point, model mm.
    pub(super) fn height(&self, x: f64, y: f64) -> f64 {
        let half = PANEL_SIZE_MM / 2.0;
        // 1 in the middle, 0 in the corners.
        let dome = || 1.0 - (x * x + y * y) / (2.0 * half * half);
        let wave = |v: f64| 0.5 + 0.5 * cosine_of_turns(v / self.wavelength + self.phase);
        self.depth
            * match self.shape {
                MacrostructureShape::Flat => 0.0,
                MacrostructureShape::Wavy { x: true, y: false } => wave(x),
                MacrostructureShape::Wavy { x: false, .. } => wave(y),
                MacrostructureShape::Wavy { x: true, y: true } => (wave(x) + wave(y)) / 2.0,
                MacrostructureShape::Convex => dome(),
                MacrostructureShape::Concave => 1.0 - dome(),
            }
    }
}
