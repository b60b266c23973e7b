//! The large shape of a wall: flat, waves in one or two directions, a dome, a bowl.

use super::PANEL_SIZE_MM;
use super::chance::cosine_of_turns;
use super::parameter::{ParameterLayer, ReliefParameter};
use super::settings::{FULL_SCALE, MacrostructureShape, WallSettings};

const LAYER: ParameterLayer = ParameterLayer::Macrostructure;

pub(super) const PARAMETERS: [ReliefParameter; 4] = [
    ReliefParameter::new_choice(
        "macrostructure",
        LAYER,
        &["flat", "wavy_x", "wavy_y", "wavy_xy", "convex", "concave"],
        "the wall's large shape: waves along x, along y or both, a dome or a bowl",
    ),
    ReliefParameter::new_mm(
        "macro_depth_mm",
        LAYER,
        [0.0, 400.0, 120.0],
        "height of the large shape from its lowest to its highest point; nothing where it is flat. Waves 200 mm high \
         and 2500 mm long focus by 10 dB at some pairs in their troughs, a bowl over the whole panel is too shallow \
         for that",
    ),
    ReliefParameter::new_mm("macro_wavelength_mm", LAYER, [600.0, 6000.0, 2500.0], "from crest to crest"),
    ReliefParameter::new_number(
        "macro_phase",
        LAYER,
        "turns",
        [0.0, 1.0, 0.0],
        "where in a wave the wall's middle is: 0 on a crest, 0.5 in a trough",
    ),
];

/// The large shape.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct MacrostructureModel {
    shape: MacrostructureShape,
    /// Model mm.
    depth: f64,
    wavelength: f64,
    phase: f64,
}

impl MacrostructureModel {
    pub fn from_settings(settings: &WallSettings) -> Self {
        Self {
            shape: settings.macrostructure,
            depth: settings.macro_depth_mm / FULL_SCALE,
            wavelength: settings.macro_wavelength_mm / FULL_SCALE,
            phase: settings.macro_phase,
        }
    }

    /// Height over its lowest point, model mm.
    pub fn height_at(&self, x: f64, y: f64) -> f64 {
        let half = PANEL_SIZE_MM / 2.0;
        // 1 in the middle, 0 in the corners.
        let dome = || 1.0 - (x * x + y * y) / (2.0 * half * half);
        let wave = |v: f64| 0.5 + 0.5 * cosine_of_turns(v / self.wavelength + self.phase);
        self.depth
            * match self.shape {
                MacrostructureShape::Flat => 0.0,
                MacrostructureShape::WavyX => wave(x),
                MacrostructureShape::WavyY => wave(y),
                MacrostructureShape::WavyXy => (wave(x) + wave(y)) / 2.0,
                MacrostructureShape::Convex => dome(),
                MacrostructureShape::Concave => 1.0 - dome(),
            }
    }
}
