//! Sweeps that were put into noise at known samples.

use echolake_dsp::sweep::{SineSweep, SweepShape};
use echolake_schema::messages::SampleFormat;
use echolake_schema::samples::encode_wav;

use super::*;

/// Samples from a sweep's beginning to the arrival of its direct sound.
const DIRECT: usize = 100;
/// Direct sound, a stronger reflection, and a later one.
const RESPONSE: [(usize, f32); 3] = [(DIRECT, 0.6), (DIRECT + 41, -1.0), (DIRECT + 230, 0.3)];

fn search(takes: &[f64], secs: f64, sweep_level: f32, noise_level: f32) -> Result<u64, String> {
    let rig = Rig::paper();
    let sweep = SineSweep {
        shape: SweepShape::Linear,
        rate_hz: 96e3,
        duration_secs: 0.5,
        low_hz: 2e3,
        high_hz: 40e3,
        fade_secs: 1e-3,
    };
    let sweep: Vec<f32> = sweep.samples().iter().map(|x| *x as f32).collect();
    let mut state = 1u32;
    let mut uniform = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / 8_388_608.0 - 1.0
    };
    let mut recording: Vec<f32> = (0..(secs * 96e3) as usize).map(|_| noise_level * uniform()).collect();
    for take in takes {
        for (delay, gain) in RESPONSE {
            let start = (take * 96e3) as usize + delay;
            recording[start..].iter_mut().zip(&sweep).for_each(|(x, s)| *x += sweep_level * gain * s);
        }
    }
    let folder = tempfile::tempdir().expect("a folder");
    let bytes: Vec<u8> = recording.iter().flat_map(|x| x.to_le_bytes()).collect();
    let file = encode_wav(SampleFormat::F32le, 96_000, &[&bytes]).expect("a file");
    std::fs::write(folder.path().join("long.wav"), file).expect("written");
    let recording = WavChannel::open(folder.path(), "long.wav").expect("a recording");
    find_sweep(&recording, &sweep, 384, &rig)
}

#[test]
fn a_sweep_is_found_in_silence_and_under_noise() {
    let expected = 7 * 96_000 + DIRECT as u64;
    assert_eq!(search(&[7.0], 9.0, 0.5, 1e-5), Ok(expected));
    // The noise has a mean power of 1/3, the strongest arrival's sweep one of 1/2 at an amplitude of 1: 20 dB below.
    let level = (2.0f32 / 300.0).sqrt();
    let under_noise = search(&[7.0], 9.0, level, 1.0).expect("a sweep");
    assert!(under_noise.abs_diff(expected) <= 1, "{under_noise}, {expected}");
}

#[test]
fn none_several_and_cut_ones_are_named() {
    let refused = |takes: &[f64], level, expected: &str| {
        let error = search(takes, 6.0, level, 1e-3).expect_err(expected);
        assert!(error.contains(expected), "{error}");
    };
    refused(&[], 0.0, "does not have the sweep that the loopback's file is");
    refused(&[0.5, 2.25, 4.0], 0.5, "has 3 sweeps, at 0.501, 2.251, 4.001 s, expected one; hint: cut it into a file");
    refused(&[5.75], 0.5, "has 6.000 s, and a sweep of 0.500 s that arrives at 5.751 s: it is cut off");
}
