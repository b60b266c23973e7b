//! The simulated tweeter and microphone: their responses on the axis and their directivity.

use std::f64::consts::{PI, TAU};

use realfft::num_complex::Complex;

/// Radius of the tweeter's membrane, m (Rust et al. 2021: 20 mm across).
const MEMBRANE_M: f64 = 0.01;
/// Speed of sound at 20 C, m/s.
const SPEED_M_S: f64 = 343.2;
/// Nodes of the quadrature over the membrane: exact to 1e-9 up to 60 kHz.
const MEMBRANE_NODES: usize = 16;
/// The tweeter's response is not published. These resonances, Hz, dB and quality, make Flat's shares of the bands those
/// of the paper's table 2.
const RESONANCES: [(f64, f64, f64); 2] = [(3_530.0, 7.1, 1.3), (30_400.0, 5.5, 1.6)];
/// Level of the tweeter beside its resonances: with it the direct sound keeps its distance from full scale.
const TWEETER_FACTOR: f64 = 0.5;
/// The microphone's pole: -1 dB at 40 kHz (40BE; Rust et al. 2021).
const MICROPHONE_POLE_HZ: f64 = 78_600.0;
/// The microphone's directivity at 40 kHz, dB by degrees off its axis: the first two are the paper's, the rest goes on.
const MICROPHONE_DB: [(f64, f64); 5] = [(0.0, 0.0), (30.0, -2.0), (60.0, -4.0), (90.0, -5.5), (180.0, -8.0)];
const MICROPHONE_HZ: f64 = 40_000.0;

/// Spectrum of tweeter and microphone on their axes.
pub(super) fn on_axis_response(frequency_hz: f64) -> Complex<f64> {
    let microphone = Complex::new(1.0, frequency_hz / MICROPHONE_POLE_HZ).inv();
    let tweeter: Complex<f64> =
        RESONANCES.iter().map(|resonance| resonance_response(frequency_hz, *resonance)).product();
    tweeter * microphone * TWEETER_FACTOR
}

// A bell of this gain around its frequency, with the least phase that goes with it.
fn resonance_response(frequency_hz: f64, (resonance_hz, gain_db, quality): (f64, f64, f64)) -> Complex<f64> {
    let at = Complex::new(0.0, frequency_hz / resonance_hz);
    let gain = 10f64.powf(gain_db / 40.0);
    let width = at / quality;
    (at * at + width * gain + 1.0) / (at * at + width / gain + 1.0)
}

/// Gain of the tweeter at a cosine against its axis: a piston in a baffle, behind which it is as loud as beside it.
pub(super) fn speaker_directivity(cosine: f64, frequency_hz: f64) -> f64 {
    let sine = (1.0 - cosine.max(0.0).powi(2)).max(0.0).sqrt();
    piston_directivity(TAU * frequency_hz / SPEED_M_S * MEMBRANE_M * sine)
}

/// Gain of the microphone at a cosine against its axis: in dB it grows with the square of the frequency, as a small
/// diaphragm's does.
pub(super) fn microphone_directivity(cosine: f64, frequency_hz: f64) -> f64 {
    let degrees = cosine.clamp(-1.0, 1.0).acos().to_degrees();
    let next = MICROPHONE_DB.iter().position(|(at, _)| *at >= degrees).unwrap_or(MICROPHONE_DB.len() - 1).max(1);
    let ((from, start), (to, end)) = (MICROPHONE_DB[next - 1], MICROPHONE_DB[next]);
    let db = start + (end - start) * (degrees - from) / (to - from);
    10f64.powf(db * (frequency_hz / MICROPHONE_HZ).powi(2) / 20.0)
}

// 2 J1(x)/x, as the mean of e^(i x t) over the membrane: Gauss-Chebyshev quadrature of the second kind.
fn piston_directivity(x: f64) -> f64 {
    let step = PI / (MEMBRANE_NODES + 1) as f64;
    let node = |i: usize| {
        let (sine, cosine) = (i as f64 * step).sin_cos();
        sine * sine * (x * cosine).cos()
    };
    2.0 / (MEMBRANE_NODES + 1) as f64 * (1..=MEMBRANE_NODES).map(node).sum::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_piston_has_its_nulls() {
        // Zeros of J1, and 2 J1(1) (Abramowitz and Stegun, tables 9.1 and 9.5).
        for (x, expected) in [(0.0, 1.0), (1.0, 0.880_101_171_5), (3.831_705_970_2, 0.0), (7.015_586_669_8, 0.0)] {
            assert!((piston_directivity(x) - expected).abs() < 1e-9, "{x}");
        }
        // At 40 kHz the first is 31 degrees off the axis; to the sides of 2 kHz the tweeter is all but alike.
        assert!(speaker_directivity(31.5f64.to_radians().cos(), 40e3).abs() < 0.02);
        assert!(speaker_directivity(0.0, 2e3) > 0.98 && speaker_directivity(-1.0, 2e3) > 0.98);
    }

    #[test]
    fn the_microphone_is_as_its_data_sheet() {
        for (degrees, expected_db) in [(0.0f64, 0.0), (30.0, -2.0), (60.0, -4.0)] {
            let db = 20.0 * microphone_directivity(degrees.to_radians().cos(), 40e3).log10();
            assert!((db - expected_db).abs() < 1e-6, "{degrees}: {db} dB");
        }
        let at_40_khz = Complex::new(1.0, 40e3 / MICROPHONE_POLE_HZ).inv();
        assert!((20.0 * at_40_khz.norm().log10() + 1.0).abs() < 0.01);
        for resonance in RESONANCES {
            let level = |hz| 20.0 * resonance_response(hz, resonance).norm().log10();
            assert!((level(resonance.0) - resonance.1).abs() < 1e-9 && level(resonance.0 / 20.0).abs() < 0.1);
        }
    }
}
