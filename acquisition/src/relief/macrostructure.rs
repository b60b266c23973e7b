//! The large shape of a wall: flat, waves in one or two directions, a dome, a bowl.

use super::PANEL_SIZE_MM;
use super::chance::cosine_of_turns;
use super::parameter::{Layer, Parameter};
use super::settings::Settings;

pub(super) const SHAPE: Parameter = Parameter::choice(
    "macrostructure",
    Layer::Macrostructure,
    &["flat", "wavy_x", "wavy_y", "wavy_xy", "convex", "concave"],
    "the wall's large shape: waves along x, along y or both, a dome or a bowl",
);
pub(super) const DEPTH: Parameter = Parameter::mm(
    "macro_depth_mm",
    Layer::Macrostructure,
    [0.0, 200.0, 120.0],
    "height of the large shape from its lowest to its highest point; nothing where it is flat",
);
pub(super) const WAVELENGTH: Parameter =
    Parameter::mm("macro_wavelength_mm", Layer::Macrostructure, [600.0, 6000.0, 2500.0], "from crest to crest");
pub(super) const PHASE: Parameter = Parameter::number(
    "macro_phase",
    Layer::Macrostructure,
    "turns",
    [0.0, 1.0, 0.0],
    "where in a wave the wall's middle is: 0 on a crest, 0.5 in a trough",
);

/// The large shape.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Macrostructure {
    shape: Shape,
    /// Model mm.
    depth: f64,
    wavelength: f64,
    phase: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Shape {
    Flat,
    Wavy { x: bool, y: bool },
    Convex,
    Concave,
}

impl Macrostructure {
    pub(super) fn of(settings: &Settings) -> Self {
        let shape = match settings.word(&SHAPE) {
            "wavy_x" => Shape::Wavy { x: true, y: false },
            "wavy_y" => Shape::Wavy { x: false, y: true },
            "wavy_xy" => Shape::Wavy { x: true, y: true },
            "convex" => Shape::Convex,
            "concave" => Shape::Concave,
            _ => Shape::Flat,
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
                Shape::Flat => 0.0,
                Shape::Wavy { x: true, y: false } => wave(x),
                Shape::Wavy { x: false, .. } => wave(y),
                Shape::Wavy { x: true, y: true } => (wave(x) + wave(y)) / 2.0,
                Shape::Convex => dome(),
                Shape::Concave => 1.0 - dome(),
            }
    }
}
