//! The signal-processing kernels of echolake: plan once, run many, nothing allocated in `run`. No I/O.
//!
//! Signals are slices of `f32` (the product) or `f64` (its oracle); see [`RealSample`]. The order of work is
//! deconvolve, temperature-correct, crop, subtract Foam, filter, cumulate, normalise by Flat.
//!
//! ```
//! use echolake_dsp::chain::{MeasurementParams, MeasurementPlan};
//! use echolake_dsp::sweep::LinearSweep;
//! use echolake_schema::SpectralDivision;
//!
//! let sweep = LinearSweep { rate_hz: 96e3, duration_secs: 0.03, low_hz: 2e3, high_hz: 40e3, fade_secs: 0.001 };
//! let loopback = sweep.samples();
//! let recording: Vec<f64> = (0..loopback.len()).map(|n| if n < 10 { 0.0 } else { 0.5 * loopback[n - 10] }).collect();
//! let plan = MeasurementPlan::new(&MeasurementParams {
//!     recording_len: loopback.len(),
//!     ir_len: 384,
//!     rate_hz: 96e3,
//!     low_hz: 2e3,
//!     high_hz: 40e3,
//!     division: SpectralDivision::Tapered,
//!     reference_celsius: 20.0,
//! })?;
//! let mut ir = vec![0.0; 384];
//! plan.ir(&recording, &loopback, 20.0, &mut ir, &mut plan.scratch())?;
//! let peak = (0..384).max_by(|a, b| ir[*a].total_cmp(&ir[*b]));
//! assert_eq!(peak, Some(10));
//! # Ok::<(), echolake_dsp::Error>(())
//! ```

pub mod air;
mod aligned;
pub mod arrival;
pub mod chain;
mod complex_vector;
pub mod components;
pub mod correlation;
pub mod decay;
pub mod deconvolution;
pub mod diffusion;
pub mod energy;
pub mod envelope;
mod error;
pub mod filter_bank;
pub mod foam;
pub mod foam_reflection;
pub mod frequency_response;
pub mod fresnel;
pub mod geometry;
#[cfg(test)]
mod golden;
pub mod height_field;
pub mod heights;
mod joint;
pub mod kirchhoff;
pub mod level;
pub mod mean;
pub mod png;
mod pruned;
mod real;
pub mod response_deconvolution;
pub mod rise;
pub mod self_organising_map;
pub mod spectrogram;
pub mod spectrum;
pub mod sweep;
pub mod temperature;
pub mod uncertainty;

pub use error::Error;
pub use real::{RealSample, SampleVector, VECTOR_LANES};
