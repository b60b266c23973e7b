//! The signal-processing kernels of echolake: plan once, run many, nothing allocated in `run`. No I/O.
//!
//! Signals are slices of `f32` (the product) or `f64` (its oracle); see [`RealSample`]. The order of work is
//! deconvolve, temperature-correct, crop, subtract Foam, filter, cumulate, normalise by Flat.
//!
//! ```
//! use echolake_dsp::chain::{MeasurementParams, MeasurementPlan};
//! use echolake_dsp::sweep::{SineSweep, SweepShape};
//! use echolake_dsp::temperature::ReferenceAir;
//! use echolake_schema::{Rig, SpectralDivision};
//!
//! let shape = SweepShape::Linear;
//! let sweep =
//!     SineSweep { shape, rate_hz: 96e3, duration_secs: 0.03, low_hz: 2e3, high_hz: 40e3, fade_secs: 0.001 };
//! let loopback = sweep.samples();
//! let recording: Vec<f64> = (0..loopback.len()).map(|n| if n < 10 { 0.0 } else { 0.5 * loopback[n - 10] }).collect();
//! let reference = ReferenceAir::from_response(&Rig::paper().impulse_response);
//! let plan = MeasurementPlan::new(&MeasurementParams {
//!     recording_len: loopback.len(),
//!     ir_len: 384,
//!     rate_hz: 96e3,
//!     low_hz: 2e3,
//!     high_hz: 40e3,
//!     division: SpectralDivision::Tapered,
//!     reference,
//! })?;
//! let mut ir = vec![0.0; 384];
//! plan.compute_ir(&recording, &loopback, &reference.air(), &mut ir, &mut plan.make_scratch())?;
//! let peak = (0..384).max_by(|a, b| ir[*a].total_cmp(&ir[*b]));
//! assert_eq!(peak, Some(10));
//! # Ok::<(), echolake_dsp::Error>(())
//! ```

pub mod chain;
pub mod deconvolution;
mod error;
#[cfg(test)]
mod golden;
mod levels;
mod real;
mod reflection;
mod relief;
mod similarity;
pub mod sweep;
pub mod take_analysis;
pub mod temperature;

pub use deconvolution::response_deconvolution;
pub use error::Error;
pub use levels::{
    auralization, decay, diffusion, energy, envelope, filter_bank, frequency_response, full_scale_octave, level, mean,
    octave_filter, oversampling, rise, room_parameters, rounding, spectrogram, spectrum, uncertainty,
};
pub use real::RealSample;
pub use realfft::num_complex::Complex;
pub use reflection::{
    air, air_correction, arrival, far_field, foam, foam_reflection, fresnel, geometry, kirchhoff, periodic_profile,
    relief_coefficients, repeating_relief, scattering,
};
pub use relief::{height_field, heights};
pub use similarity::{components, correlation, self_organising_map, significance};
