//! Values of a wall's parameters.

use serde::{Deserialize, Serialize};

/// The wall is this many times as large as the panel (Rust et al. 2021).
pub const FULL_SCALE: f64 = 10.0;

/// Parameters of a wall by their keys, lengths in full-scale mm. Those that its relief does not have are 0.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub(super) struct WallSettings {
    pub seed: u64,
    pub macrostructure: MacrostructureShape,
    pub macro_depth_mm: f64,
    pub macro_wavelength_mm: f64,
    pub macro_phase: f64,
    pub projection_mm: f64,
    pub lean_mm: f64,
    pub bulge_mm: f64,
    pub brick_length_mm: f64,
    pub brick_height_mm: f64,
    pub course_height_mm: f64,
    pub stone_length_mm: f64,
    pub variation: f64,
    pub stone_size_mm: f64,
    pub irregularity: f64,
    pub elongation: f64,
    pub primitive: SolidShape,
    pub primitive_size_mm: f64,
    pub primitive_height_mm: f64,
    pub gap_mm: f64,
    pub turn: SolidTurn,
    pub prime: String,
    pub well_depth_mm: f64,
    pub joint_shape: JointShape,
    pub joint_width_mm: f64,
    pub joint_depth_mm: f64,
    pub joint_width_jitter_mm: f64,
    pub joint_depth_jitter_mm: f64,
    pub roughness_mm: f64,
    pub roughness_grain_mm: f64,
}

/// Form of the panel under its stones.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum MacrostructureShape {
    #[default]
    Flat,
    WavyX,
    WavyY,
    WavyXy,
    Convex,
    Concave,
}

/// Form of the joints.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum JointShape {
    #[default]
    Recessed,
    Flush,
    Raked,
    Concave,
    V,
}

/// Solid of a lattice of primitives.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum SolidShape {
    #[default]
    Pyramid,
    Hemisphere,
    Box,
    Wedge,
    Ridge,
    Cone,
    Cylinder,
}

/// Rotation of a lattice's solids.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum SolidTurn {
    #[default]
    Alike,
    Alternating,
    Random,
}
