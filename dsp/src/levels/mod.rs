//! Energies and levels: of bands, along time, over frequency, of several measurements.

pub mod auralization;
pub mod decay;
pub mod diffusion;
pub mod energy;
pub mod envelope;
pub mod filter_bank;
pub mod frequency_response;
pub mod full_scale_octave;
pub mod level;
pub mod mean;
mod noise_crossing;
pub mod octave_filter;
pub mod oversampling;
pub mod rise;
pub mod room_parameters;
pub mod rounding;
pub mod spectrogram;
pub mod spectrum;
pub mod uncertainty;
