//! Takes made from a known response at 96 kHz, 2 to 40 kHz, 0.5 s, each with one fault.

use std::f64::consts::{PI, TAU};

use super::*;

/// Name of a take, the take, and whether a fault is the expected one.
type FaultCase = (&'static str, Take, fn(&TakeFault) -> bool);
use crate::deconvolution::{DeconvolutionParams, DeconvolutionPlan, SpectralDivision, TransformLength};
use crate::sweep::SweepShape;

const RATE_HZ: f64 = 96e3;
const LEN: usize = 52_800;
/// Samples before the sweep.
const START: usize = 1_920;
/// Delays of the known response, samples, and its gains.
const ARRIVALS: [(usize, f64); 6] = [(100, 1.0), (137, -0.5), (203, 0.35), (333, 0.25), (420, 0.2), (800, 0.1)];

fn sweep(shape: SweepShape) -> SineSweep {
    SineSweep { shape, rate_hz: RATE_HZ, duration_secs: 0.5, low_hz: 2e3, high_hz: 40e3, fade_secs: 0.001 }
}

/// Microphone and loopback.
#[derive(Clone)]
struct Take {
    sweep: SineSweep,
    microphone: Vec<f64>,
    loopback: Vec<f64>,
}

impl Take {
    fn new(shape: SweepShape) -> Self {
        let sweep = sweep(shape);
        let mut loopback = vec![0.0; START];
        loopback.extend(sweep.samples().iter().map(|x| 0.5 * x));
        loopback.resize(LEN, 0.0);
        Self { microphone: reflect(&loopback), sweep, loopback }
    }

    /// Applies a change to the microphone's channel, or to both.
    fn change(mut self, both: bool, change: impl Fn(&[f64]) -> Vec<f64>) -> Self {
        self.microphone = change(&self.microphone);
        if both {
            self.loopback = change(&self.loopback);
        }
        self
    }

    /// Noise of -80 and -100 dB.
    fn analyze(&self) -> TakeAnalysis {
        let microphone = single(&self.microphone, 1e-4, 1);
        let loopback = single(&self.loopback, 1e-5, 2);
        let analyzer = TakeAnalyzer::new(self.sweep, LEN).expect("a plan");
        analyzer.analyze_take(&microphone, Some(&loopback)).expect("an analysis")
    }
}

fn reflect(signal: &[f64]) -> Vec<f64> {
    let term = |n: usize, (delay, gain): &(usize, f64)| if n < *delay { 0.0 } else { 0.6 * gain * signal[n - delay] };
    (0..signal.len()).map(|n| ARRIVALS.iter().map(|arrival| term(n, arrival)).sum()).collect()
}

fn single(signal: &[f64], noise: f64, seed: u32) -> Vec<f32> {
    let mut state = seed;
    let mut chance = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(state >> 8) / 16_777_216.0 - 0.5
    };
    // Evenly distributed, of this rms.
    signal.iter().map(|x| (x + noise * 12f64.sqrt() * chance()) as f32).collect()
}

/// The signal at times `n * (1 + ratio) + shift`, by a Kaiser-windowed sinc of 128 samples.
fn resample(signal: &[f64], ratio: f64, shift: f64) -> Vec<f64> {
    let bessel = |x: f64| {
        (1..40)
            .fold((1.0, 1.0), |(sum, term), k| {
                let term = term * (x / 2.0 / f64::from(k)).powi(2);
                (sum + term, term)
            })
            .0
    };
    let table: Vec<f64> = (0..=4096)
        .map(|i| bessel(12.0 * (1.0 - (f64::from(i) / 4096.0).powi(2)).max(0.0).sqrt()) / bessel(12.0))
        .collect();
    let at = |n: usize| {
        let time = n as f64 * (1.0 + ratio) + shift;
        let around = (time.floor() as i64 - 63)..=(time.floor() as i64 + 64);
        let term = |i: i64| {
            let x = signal.get(usize::try_from(i).ok()?)?;
            let v = time - i as f64;
            let sinc = if v.abs() < 1e-12 { 1.0 } else { (PI * v).sin() / (PI * v) };
            let place = (v.abs() / 64.0 * 4096.0).min(4095.0);
            let left = place.floor();
            let window = table[left as usize] * (1.0 - place + left) + table[left as usize + 1] * (place - left);
            Some(x * sinc * window)
        };
        around.filter_map(term).sum()
    };
    (0..signal.len()).map(at).collect()
}

fn remove(signal: &[f64], at: usize, count: usize) -> Vec<f64> {
    let mut out = [&signal[..at], &signal[at + count..]].concat();
    out.resize(signal.len(), 0.0);
    out
}

fn repeat(signal: &[f64], at: usize, count: usize) -> Vec<f64> {
    [&signal[..at], &signal[at - count..signal.len() - count]].concat()
}

const SHAPES: [SweepShape; 2] = [SweepShape::Linear, SweepShape::Exponential];

#[test]
fn a_good_take_has_no_fault_and_one_clock() {
    for shape in SHAPES {
        let good = Take::new(shape).analyze();
        assert_eq!(good.faults, [], "{shape:?}");
        assert!(good.clock_ratio_ppm.abs() < 0.1, "{shape:?}: {} ppm", good.clock_ratio_ppm);
        assert!(good.loopback_match_db > 45.0, "{shape:?}: {} dB", good.loopback_match_db);
    }
}

// A pole at 60 kHz and one at 10 Hz, as amplifiers and converters have them, move the delay by 1 us within the sweep,
// as
// 2 ppm would.
#[test]
fn a_converter_is_no_drift() {
    for shape in SHAPES {
        let converter = |signal: &[f64]| {
            let low = (-TAU * 60e3 / RATE_HZ).exp();
            let high = (-TAU * 10.0 / RATE_HZ).exp();
            let mut state = [0.0, 0.0];
            let step = |x: &f64| {
                state[0] = low * state[0] + (1.0 - low) * x;
                state[1] = high * state[1] + (1.0 - high) * state[0];
                state[0] - state[1]
            };
            signal.iter().map(step).collect()
        };
        let found = Take::new(shape).change(true, converter).analyze();
        assert_eq!(found.faults, [], "{shape:?}");
        assert!(found.clock_ratio_ppm.abs() < 0.3, "{shape:?}: {} ppm", found.clock_ratio_ppm);
    }
}

// With the same clock a take is unharmed; with a digital copy of the sweep as loopback the recording drifts away.
#[test]
fn clocks_are_compared() {
    for shape in SHAPES {
        for ppm in [50.0, 200.0, 2_000.0, -50.0] {
            let drift = |signal: &[f64]| resample(signal, 1e-6 * ppm, 0.0);
            let shared = Take::new(shape).change(true, drift).analyze();
            assert_eq!(shared.faults, [], "{shape:?}, {ppm} ppm");
            assert!((shared.clock_ratio_ppm - ppm).abs() < 0.1, "{shape:?}: {} {ppm} ppm", shared.clock_ratio_ppm);
            let apart = Take::new(shape).change(false, drift).analyze();
            let [TakeFault::Clock { ppm: found, limit_ppm }] = apart.faults[..] else {
                panic!("{shape:?}, {ppm} ppm: {:?}", apart.faults)
            };
            // Arrivals that interfere hide some ppm.
            assert!((found - ppm).abs() < 3.0 + 0.002 * ppm.abs(), "{shape:?}: {found} {ppm} ppm");
            assert!((apart.clock_ratio_ppm - ppm).abs() < 3.0 + 0.002 * ppm.abs());
            assert!((limit_ppm - 45.0).abs() < 1e-9);
        }
    }
}

#[test]
fn lost_and_repeated_samples_are_found_where_they_are() {
    let middle = START + 24_000;
    for shape in SHAPES {
        for (channel, both) in [(TakeChannel::Recording, false), (TakeChannel::Loopback, true)] {
            let take = Take::new(shape);
            let cases = [
                ("441 lost", take.clone().change(both, |x| remove(x, middle, 441))),
                ("1 lost", take.clone().change(both, |x| remove(x, middle, 1))),
                ("10 ms repeated", take.clone().change(both, |x| repeat(x, middle, 960))),
            ];
            for (what, take) in cases {
                let faults = take.analyze().faults;
                let Some(TakeFault::Dropout { channel: found, at_secs, .. }) = faults.first() else {
                    panic!("{shape:?}, {what}, {channel}: {faults:?}")
                };
                assert_eq!(*found, channel, "{shape:?}, {what}");
                assert!((at_secs - middle as f64 / RATE_HZ).abs() < 0.02, "{shape:?}, {what}, {channel}: {at_secs} s");
            }
        }
    }
}

#[test]
fn the_loopback_is_judged_by_its_match() {
    for shape in SHAPES {
        let good = Take::new(shape);
        let gained = |signal: &[f64], db: f64| signal.iter().map(|x| x * 10f64.powf(db / 20.0)).collect::<Vec<_>>();
        let faint = Take { loopback: gained(&good.loopback, -34.0), ..good.clone() };
        assert_eq!(faint.analyze().faults, [], "{shape:?}: clean at -40 dBFS");
        let silent = Take { loopback: vec![0.0; LEN], ..good.clone() };
        let crosstalk = Take { loopback: gained(&good.microphone, -35.0), ..good.clone() };
        let summed: Vec<f64> = good.microphone.iter().zip(&good.loopback).map(|(a, b)| 0.5 * (a + b)).collect();
        let summed = Take { loopback: summed.clone(), microphone: summed, ..good.clone() };
        let swapped = Take { loopback: good.microphone.clone(), microphone: good.loopback.clone(), ..good.clone() };
        let cases: [FaultCase; 4] = [
            ("silent", silent, |f| matches!(f, TakeFault::Loopback { match_db, .. } if *match_db < 0.0)),
            (
                "crosstalk",
                crosstalk,
                |f| matches!(f, TakeFault::SameSignal { level_db } if (level_db - 35.0).abs() < 0.1),
            ),
            ("mono sum", summed, |f| matches!(f, TakeFault::SameSignal { level_db } if level_db.abs() < 0.1)),
            // 100 samples.
            (
                "swapped",
                swapped,
                |f| matches!(f, TakeFault::Swapped { early_secs } if (early_secs - 1.042e-3).abs() < 2e-5),
            ),
        ];
        for (what, take, expected) in cases {
            let faults = take.analyze().faults;
            assert!(faults.len() == 1 && expected(&faults[0]) && faults[0].spoils_response(), "{what}: {faults:?}");
        }
    }
}

#[test]
fn other_recordings_are_named() {
    let good = Take::new(SweepShape::Linear);
    let slow = good.clone().change(false, |x| resample(x, 44.1 / 48.0 - 1.0, 0.0));
    assert!(matches!(slow.analyze().faults[..], [TakeFault::NoResponse { .. }]), "{:?}", slow.analyze().faults);
    let noise: Vec<f64> = single(&vec![0.0; LEN], 0.1, 7).into_iter().map(f64::from).collect();
    let other = Take { microphone: reflect(&noise), loopback: noise, ..good.clone() };
    assert!(matches!(other.analyze().faults[..], [TakeFault::UnknownSweep { .. }]), "{:?}", other.analyze().faults);
    // 25 ms of the sweep are missing.
    for is_start in [true, false] {
        let loopback = if is_start {
            remove(&good.loopback, 0, START + 2_400)
        } else {
            let silence = vec![0.0; LEN - START - 48_000 + 2_400];
            [&silence, &good.loopback[..LEN - silence.len()]].concat()
        };
        let cut = Take { microphone: reflect(&loopback), loopback, ..good.clone() };
        let faults = cut.analyze().faults;
        let ((Some(TakeFault::CutStart { lost_secs }), true) | (Some(TakeFault::CutEnd { lost_secs }), false)) =
            (faults.first(), is_start)
        else {
            panic!("{is_start}: {faults:?}")
        };
        assert!((lost_secs - 0.025).abs() < 1e-3, "{is_start}: {lost_secs} s");
    }
}

/// E24: the sweep may be at any place of a recording: only what is cut off is a fault, and by its length.
#[test]
fn a_sweep_is_found_after_any_silence() {
    for shape in SHAPES {
        let sweep = sweep(shape);
        // An exponential sweep without its end lacks too much of its range to be told from a torn one.
        let cuts = if shape == SweepShape::Linear { &[(0.5, -0.025), (-0.025, 0.5)][..] } else { &[] };
        for (before_secs, after_secs) in [(0.0, 0.02), (1.0, 0.2), (3.0, 0.2)].iter().chain(cuts).copied() {
            let samples = |secs: f64| (secs * RATE_HZ).round() as i64;
            let start = samples(before_secs);
            let played = sweep.samples();
            let len = (start + samples(after_secs)) as usize + played.len();
            let sample = |n: usize| usize::try_from(n as i64 - start).ok().and_then(|at| played.get(at));
            let loopback: Vec<f64> = (0..len).map(|n| 0.5 * sample(n).unwrap_or(&0.0)).collect();
            let analyzer = TakeAnalyzer::new(sweep, len).expect("a plan");
            let [microphone, loopback] = [single(&reflect(&loopback), 1e-4, 1), single(&loopback, 1e-5, 2)];
            let faults = analyzer.analyze_take(&microphone, Some(&loopback)).expect("an analysis").faults;
            let lost = match faults[..] {
                [] => 0.0,
                [TakeFault::CutStart { lost_secs }, ..] if before_secs < 0.0 => lost_secs,
                [TakeFault::CutEnd { lost_secs }, ..] if after_secs < 0.0 => lost_secs,
                _ => panic!("{shape:?}, {before_secs} s before, {after_secs} s after: {faults:?}"),
            };
            let expected = (-before_secs.min(after_secs)).max(0.0);
            assert!((lost - expected).abs() < 1e-3, "{shape:?}, {before_secs} s: {lost} s, expected {expected} s");
        }
    }
}

// Starts that differ by up to 10 ms, fractions of a sample included.
#[test]
fn a_start_s_jitter_leaves_the_response() {
    for shape in SHAPES {
        let first = respond(&Take::new(shape), 1_000);
        let energy = crate::energy::energy(&first);
        for i in 0..5 {
            let shift = 960.0 * (f64::from(i) / 2.0 - 1.0) + 0.37;
            let take = Take::new(shape).change(true, |x| resample(x, 0.0, shift));
            assert_eq!(take.analyze().faults, [], "{shape:?}, {shift}");
            let difference: Vec<f32> = respond(&take, 1_000).iter().zip(&first).map(|(a, b)| a - b).collect();
            let level = power_to_db(crate::energy::energy(&difference) / energy);
            assert!(level < -90.0, "{shape:?}, {shift} samples: {level} dB");
        }
    }
}

// y = x + 0.1 x^2 + 0.1 x^3 of a sine of amplitude a: orders 2 and 3 are 0.05 a and 0.025 a^2 over 1 + 0.075 a^2. The
// loopback has a = 0.5. What would alias is left out, as a converter's filter does.
#[test]
fn harmonics_are_separated_for_exponential_sweeps_alone() {
    let distort = |take: Take| {
        let harmonic = |n: usize, order: f64| {
            let secs = (n as f64 - START as f64) / RATE_HZ;
            let left = take.sweep.time_at(46e3 / order).min(0.5) - secs;
            let gain = 0.5 - 0.5 * (PI * (left.min(secs) / 0.002).clamp(0.0, 1.0)).cos();
            (gain, TAU * order * take.sweep.cycles_at_time(secs))
        };
        let distorted = |n: usize| {
            let (second, phase_2) = harmonic(n, 2.0);
            let (third, phase_3) = harmonic(n, 3.0);
            let x = take.loopback[n];
            x * (1.0 + 0.1 * 0.75 * 0.25) + 0.05 * 0.25 * second * (1.0 - phase_2.cos())
                - 0.025 * 0.125 * third * phase_3.sin()
        };
        let distorted: Vec<f64> = (0..LEN).map(distorted).collect();
        Take { microphone: reflect(&distorted), ..take }
    };
    let found = distort(Take::new(SweepShape::Exponential)).analyze();
    assert_eq!(found.faults, []);
    let distortion = found.distortion.expect("harmonics");
    let fundamental = 1.0 + 0.1 * 0.75 * 0.25;
    let expected = [0.05 * 0.5, 0.025 * 0.25].map(|x: f64| 20.0 * (x / fundamental).log10());
    for (i, expected) in expected.into_iter().enumerate() {
        let (order, level) = distortion.harmonics[i];
        assert!(order == i + 2 && (level - expected).abs() < 0.5, "{order}: {level} dB, expected {expected}");
    }
    assert!(distortion.harmonics[2..].iter().all(|(_, level)| *level < -60.0), "{distortion:?}");
    let found = distort(Take::new(SweepShape::Linear)).analyze();
    assert_eq!(found.distortion, None);
    // Order 2 passes a frequency twice as fast as the sweep: half the power of 0.025, from 4 kHz on.
    let expected = power_to_db(0.025f64.powi(2) / 2.0 * 36.0 / 38.0);
    let [TakeFault::Distortion { level_db }] = found.faults[..] else { panic!("{:?}", found.faults) };
    assert!((level_db - expected).abs() < 2.0, "{level_db} dB, expected {expected}");
}

#[test]
fn without_a_loopback_the_recording_s_clock_is_that_of_the_sweep() {
    for shape in SHAPES {
        for ppm in [0.0, 50.0, 2_000.0] {
            let take = Take::new(shape).change(false, |x| resample(x, 1e-6 * ppm, 0.0));
            let analyzer = TakeAnalyzer::new(take.sweep, LEN).expect("a plan");
            let found = analyzer.analyze_take(&single(&take.microphone, 1e-4, 1), None).expect("an analysis");
            assert!(
                (found.clock_ratio_ppm - ppm).abs() < 4.0 + 0.002 * ppm,
                "{shape:?}: {} ppm",
                found.clock_ratio_ppm
            );
            assert_eq!(found.faults.is_empty(), ppm == 0.0, "{shape:?}: {:?}", found.faults);
        }
    }
}

// A tone at a quarter of the sampling rate whose samples are 3 dB below its peak is no sweep, so the sweep itself is
// made louder: every sample is below full scale in the end, the signal between them is not.
#[test]
fn peaks_between_samples_are_named() {
    let mut take = Take::new(SweepShape::Linear);
    take.loopback = take.loopback.iter().map(|x| (2.1 * x).clamp(-0.999, 0.999)).collect();
    let faults = take.analyze().faults;
    let is_named = |f: &TakeFault| matches!(f, TakeFault::BetweenSamples { channel: TakeChannel::Loopback, peak_dbfs } if *peak_dbfs > 0.2);
    assert!(faults.iter().any(is_named) && !faults.iter().any(TakeFault::spoils_response), "{faults:?}");
}

fn respond(take: &Take, output_len: usize) -> Vec<f32> {
    let plan = DeconvolutionPlan::<f32>::new(DeconvolutionParams {
        recording_len: LEN,
        output_len,
        rate_hz: RATE_HZ,
        low_hz: 2e3,
        high_hz: 40e3,
        division: SpectralDivision::Tapered,
        taper_hz: 250.0,
        length: TransformLength::Fast,
    })
    .expect("a plan");
    let mut ir = vec![0.0; output_len];
    let [microphone, loopback] = [&take.microphone, &take.loopback].map(|signal| single(signal, 0.0, 1));
    plan.deconvolve_recording(&microphone, &loopback, &mut ir, &mut plan.make_scratch()).expect("a response");
    ir
}

// An offset of 0.1 of full scale, and hum of -20 dBFS at 50 Hz with its third and fifth harmonic: 0.01 dB in any band.
#[test]
fn offset_and_hum_are_harmless() {
    let bank =
        crate::filter_bank::FilterBankPlan::<f32>::new(1_000, RATE_HZ, &[2.5e3, 5e3, 1e4, 2e4, 4e4]).expect("a bank");
    let energies = |take: &Take| {
        let mut energies = [0.0; 5];
        bank.compute_energies(&respond(take, 1_000), &mut energies, &mut bank.make_scratch()).expect("energies");
        energies
    };
    for shape in SHAPES {
        let hum = |x: &[f64]| {
            let tone = |n: usize, hz: f64| (TAU * hz * n as f64 / RATE_HZ).sin();
            let at = |n: usize| 0.1 + 0.1 * tone(n, 50.0) + 0.03 * tone(n, 150.0) + 0.01 * tone(n, 250.0);
            x.iter().enumerate().map(|(n, x)| x + at(n)).collect()
        };
        let take = Take::new(shape);
        let clean = energies(&take);
        let take = take.change(false, hum);
        assert_eq!(take.analyze().faults, [], "{shape:?}");
        for (hummed, clean) in energies(&take).iter().zip(clean) {
            assert!(power_to_db(hummed / clean).abs() < 0.01, "{shape:?}: {} dB", power_to_db(hummed / clean));
        }
    }
}

// Limits of the sweep inside of its fades: what is divided there is as exact as elsewhere. The response is limited to
// the sweep's range, and its tapers of 250 Hz ring for 4 ms.
#[test]
fn a_response_rings_before_its_arrival_as_its_taper_says() {
    for shape in SHAPES {
        for fade_secs in [0.001, 0.05] {
            let mut take = Take::new(shape);
            take.sweep.fade_secs = fade_secs;
            take.loopback[START..START + 48_000].copy_from_slice(&take.sweep.samples());
            take.microphone = reflect(&take.loopback);
            let ir = respond(&take, fast_length(LEN));
            let peak = ir.iter().fold(0.0f32, |most, x| most.max(x.abs()));
            let level = |early: usize| {
                let before = (early..1_500).map(|n| ir[(100 + ir.len() - n) % ir.len()].abs());
                20.0 * (before.fold(0.0f32, f32::max) / peak).log10()
            };
            assert!(level(384) < -60.0, "{shape:?}, {fade_secs} s: {} dB", level(384));
        }
    }
}

// As each bin by itself, for numbers of bins that fill groups and that do not.
#[test]
fn bins_are_turned_by_their_cycles() {
    for count in [0, 1, 3, 4, 5, 64, 1_625] {
        let cycles = |bin: usize| -9_500.3 + 7.77 * bin as f64 + 1e-4 * (bin as f64).powi(2);
        let bins: Vec<Complex<f32>> = (0..count).map(|bin| Complex::new(bin as f32, 1.0 - bin as f32)).collect();
        let mut turned = bins.clone();
        clock::turn_bins(&mut turned, cycles);
        for (bin, (before, after)) in bins.iter().zip(&turned).enumerate() {
            let expected = widen(*before) * Complex::from_polar(1.0, TAU * cycles(bin).fract());
            let off = (widen(*after) - expected).norm() / expected.norm();
            assert!(off < 2e-7, "{count}, bin {bin}: {off}");
        }
    }
}

/// A take of a room at 48 kHz: a sweep of 20 Hz to 20 kHz in this time, direct sound after 300 samples, and a decay of
/// sparse reflections by `seed`.
struct RoomTake {
    sweep: SineSweep,
    channels: [Vec<f64>; 2],
    seed: u64,
}

impl RoomTake {
    fn new(duration_secs: f64, seed: u64) -> Self {
        let sweep = SineSweep {
            shape: SweepShape::Exponential,
            rate_hz: 48e3,
            duration_secs,
            low_hz: 20.0,
            high_hz: 20e3,
            fade_secs: 0.01,
        };
        let mut state = seed;
        let mut chance = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let mut loopback = vec![0.0; 2_400];
        loopback.extend(sweep.samples().iter().map(|x| 0.5 * x));
        loopback.resize(loopback.len() + 33_600, 0.0);
        let mut microphone = vec![0.0; loopback.len()];
        let mut add = |delay: usize, gain: f64| {
            microphone[delay..].iter_mut().zip(&loopback).for_each(|(sum, x)| *sum += gain * x);
        };
        add(300, 0.5);
        for _ in 0..30 {
            let delay = 400 + (12_000.0 * chance().powi(2)) as usize;
            add(delay, 0.3 * (chance() - 0.5) * (-(delay as f64) / 5_000.0).exp());
        }
        Self { sweep, channels: [microphone, loopback], seed }
    }

    fn faults(&self, noise: f64) -> Vec<TakeFault> {
        let [microphone, loopback] = &self.channels;
        let microphone = single(microphone, noise, self.seed as u32 + 1);
        let loopback = single(loopback, 1e-5, self.seed as u32 + 2);
        let analyzer = TakeAnalyzer::new(self.sweep, loopback.len()).expect("a plan");
        analyzer.analyze_take(&microphone, Some(&loopback)).expect("an analysis").faults
    }
}

// S7: most of the time of a room's sweep is within 4 kHz of its lower limit.
#[test]
fn samples_lost_by_an_exponential_sweep_are_found_over_most_of_its_time() {
    for share in [0.35, 0.5, 0.6, 0.75, 0.9] {
        for count in [64, 512] {
            let mut take = RoomTake::new(4.0, 7);
            let at_secs = 0.05 + share * 4.0;
            take.channels[0] = remove(&take.channels[0], (at_secs * 48e3) as usize, count);
            let faults = take.faults(1e-4);
            let found = faults.iter().find_map(|fault| match fault {
                TakeFault::Dropout { at_secs, .. } => Some(*at_secs),
                _ => None,
            });
            assert!(found.is_some_and(|found| (found - at_secs).abs() < 0.1), "{share} {count}: {faults:?}");
        }
    }
}

#[test]
fn good_takes_of_rooms_are_not_refused() {
    for seed in 0..200 {
        let noise = [1e-5, 1e-4, 1e-3][seed as usize % 3];
        let faults = RoomTake::new(1.0, seed).faults(noise);
        assert!(!faults.iter().any(TakeFault::spoils_response), "{seed}: {faults:?}");
    }
}

// S8: a response begins when its sweep is played, and lacks what comes before.
#[test]
fn sound_before_it_is_played_is_named() {
    for shape in SHAPES {
        let early = |samples: usize| {
            let mut take = Take::new(shape);
            take.microphone.drain(..samples);
            take.microphone.resize(LEN, 0.0);
            take.analyze().faults
        };
        assert_eq!(early(90), []);
        let faults = early(200);
        let is_early = |fault: &TakeFault| {
            matches!(fault, TakeFault::EarlyArrival { early_secs } if
            (early_secs * RATE_HZ - 100.0).abs() < 12.0)
        };
        assert!(faults.len() == 1 && is_early(&faults[0]), "{faults:?}");
    }
}

// S6: what a response differs by after the best delay, which two clocks leave open, dB.
fn difference_db(found: &[f32], expected: &[f32]) -> f64 {
    let spectrum = |signal: &[f32]| {
        let forward = f64::plan_real_forward(signal.len());
        let mut spectrum = forward.make_output_vec();
        let mut samples: Vec<f64> = signal.iter().map(|x| f64::from(*x)).collect();
        forward.process(&mut samples, &mut spectrum).expect("a spectrum");
        spectrum
    };
    let [found, expected] = [spectrum(found), spectrum(expected)];
    let energy: f64 = expected.iter().map(Complex::norm_sqr).sum();
    let step = TAU / (2 * (expected.len() - 1)) as f64;
    let off = |delay: f64| -> f64 {
        let bins = found.iter().zip(&expected).enumerate();
        bins.map(|(k, (f, e))| (f * Complex::from_polar(1.0, step * k as f64 * delay) - e).norm_sqr()).sum()
    };
    let least = (-500..=500).map(|i| off(f64::from(i) * 0.002)).fold(f64::INFINITY, f64::min);
    10.0 * (least / energy).log10()
}

#[test]
fn the_clock_of_a_recording_is_undone() {
    for shape in SHAPES {
        let good = respond(&Take::new(shape), 1_024);
        for ppm in [12.0, 25.0, 40.0, -30.0] {
            let mut take = Take::new(shape).change(false, |signal| resample(signal, 1e-6 * ppm, 0.0));
            let analysis = take.analyze();
            assert_eq!(analysis.faults, [], "{shape:?}, {ppm} ppm");
            let found = analysis.recording_clock_ppm.expect("it is told");
            let before = difference_db(&respond(&take, 1_024), &good);
            crate::temperature::stretch_recording(&mut take.microphone, found);
            let after = difference_db(&respond(&take, 1_024), &good);
            assert!(after < -30.0 && after < before - 8.0, "{shape:?}, {ppm} ppm: {before} and {after} dB");
        }
        assert_eq!(Take::new(shape).analyze().recording_clock_ppm, None);
    }
}
