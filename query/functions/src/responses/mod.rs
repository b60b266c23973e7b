//! Functions of impulse responses.

pub(crate) mod band_energy;
pub(crate) mod decay;
pub(crate) mod nce;
pub(crate) mod octave_band;
pub(crate) mod rise;
pub(crate) mod room_parameters;
pub(crate) mod spectrum;
