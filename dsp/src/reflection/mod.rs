//! Sound from a speaker to a microphone: direct sound, reflections at a relief and at Foam.

pub mod air;
pub mod air_correction;
pub mod arrival;
pub mod far_field;
pub mod foam;
pub mod foam_reflection;
pub mod fresnel;
pub mod geometry;
pub mod kirchhoff;
pub mod periodic_profile;
pub mod relief_coefficients;
pub mod repeating_relief;
pub mod scattering;
