//! Responses of Foam and Flat made of pulses.

use super::*;

const LEN: usize = 384;
const RATE_HZ: f64 = 96e3;

// Sound of the sweep's range, about a fraction of a sample.
fn pulse(n: usize, at: f64) -> f64 {
    let x = n as f64 - at;
    let sinc = |edge_hz: f64| {
        let turns = 2.0 * edge_hz / RATE_HZ;
        if x.abs() < 1e-9 { turns } else { (std::f64::consts::PI * turns * x).sin() / (std::f64::consts::PI * x) }
    };
    (sinc(40e3) - sinc(2e3)) * (-(x / 60.0).powi(2)).exp()
}

// Direct sound, which goes as 1/d, and a reflection by layers, each with its delay in samples and factor.
fn response(direct: f64, reflected: f64, layers: &[(f64, f64)]) -> Vec<f64> {
    let reflection = |n| layers.iter().map(|(delay, r)| 0.7 * r * pulse(n, reflected + delay)).sum::<f64>();
    (0..LEN).map(|n| 60.0 / direct * pulse(n, direct) + reflection(n)).collect()
}

fn paths() -> impl Iterator<Item = ReflectionPath> {
    (0..400).map(|i| {
        let direct = 40.0 + 7.31 * f64::from(i % 12);
        let reflected = direct + 16.0 + 0.23 * f64::from(i);
        path(direct, reflected, 60.0 - 0.11 * f64::from(i) - 2.0 * f64::from(i % 7))
    })
}

fn path(direct: f64, reflected: f64, incidence_deg: f64) -> ReflectionPath {
    ReflectionPath { direct_secs: direct / RATE_HZ, reflected_secs: reflected / RATE_HZ, incidence_deg }
}

// A surface that reflects by the angle, and the wall behind it.
fn foam_layers(path: ReflectionPath) -> [(f64, f64); 2] {
    [(0.0, 0.04 + 0.1 * path.sine_square()), (27.4 - 2.0 * path.sine_square(), 0.02)]
}

fn responses(path: ReflectionPath, layers: &[(f64, f64)]) -> [Vec<f64>; 2] {
    let [direct, reflected] = [path.direct_secs, path.reflected_secs].map(|secs| secs * RATE_HZ);
    [response(direct, reflected, layers), response(direct, reflected, &[(0.0, 0.84)])]
}

fn energy(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum()
}

// Energies over all pairs of what Flat reflects, of Foam's error and of the estimates' by variant.
fn errors(layers: impl Fn(ReflectionPath) -> Vec<(f64, f64)>) -> [f64; 4] {
    let mut fit = FoamReflectionFit::new(LEN, RATE_HZ).expect("a fit");
    for path in paths() {
        let [foam, flat] = responses(path, &layers(path));
        let apart = path.separation_secs() >= LEAST_SEPARATION_SECS;
        assert_eq!(fit.add_pair(&foam, &flat, path), Ok(apart));
    }
    let estimate = fit.finish().expect("an estimate");
    let mut sums = [0.0; 4];
    for path in paths() {
        let [foam, flat] = responses(path, &layers(path));
        let [truth, _] = responses(path, &[]);
        let mut found = vec![f64::NAN; LEN];
        estimate.best.direct_sound(&foam, &flat, path.incidence_deg, &mut found).expect("lengths");
        let mut moved = found.clone();
        let variant = estimate.variants.last().expect("variants");
        variant.direct_sound(&foam, &flat, path.incidence_deg, &mut moved).expect("lengths");
        let errors = [energy(&flat, &truth), energy(&foam, &truth), energy(&found, &truth), energy(&moved, &found)];
        sums.iter_mut().zip(errors).for_each(|(sum, error)| *sum += error);
    }
    sums
}

#[test]
fn the_direct_sound_of_every_pair_is_found_though_foam_reflects_by_the_angle() {
    let [_, before, after, moved] = errors(|path| foam_layers(path).to_vec());
    assert!(after < 2.5e-3 * before, "{} dB of Foam's reflection is left", 10.0 * (after / before).log10());
    assert!(moved > after && moved < 0.1 * before, "{moved} of {before}");
}

#[test]
fn of_foam_that_reflects_nothing_nothing_is_found() {
    let [flat, before, after, _] = errors(|_| Vec::new());
    assert!(before == 0.0 && after < 1e-6 * flat, "{} dB", 10.0 * (after / flat).log10());
}

// Sample by sample, as the sums are defined.
#[test]
fn sums_of_products_are_those_of_the_gated_difference() {
    let fit = FoamReflectionFit::new(LEN, RATE_HZ).expect("a fit");
    let (lead, taps) = (fit.lead(), fit.lead() + fit.samples(FILTER_SECS[1]) + 1);
    for (direct, reflected) in [(60.0, 120.0), (30.0, 45.0), (8.0, 24.0), (150.0, 320.0)] {
        let path = path(direct, reflected, 30.0);
        let [foam, flat] = responses(path, &[(0.0, 0.1), (27.4, 0.02)]);
        let difference: Vec<f64> = flat.iter().zip(&foam).map(|(flat, foam)| flat - foam).collect();
        let moved = |n: usize, tap: usize| {
            (n + lead).checked_sub(tap).and_then(|at| difference.get(at)).copied().unwrap_or(0.0)
        };
        let pair = FittedPair { path, foam: foam.clone(), difference: difference.clone() };
        let gated = fit.gate_pair(&pair, taps);
        let sum = |term: &dyn Fn(usize) -> f64| -> f64 { (0..LEN).map(|n| fit.gate(&pair, n).powi(2) * term(n)).sum() };
        let products = gated.tap_products(taps);
        let greatest = sum(&|n| moved(n, lead).powi(2));
        for row in 0..taps {
            for column in 0..=row {
                let expected = sum(&|n| moved(n, row) * moved(n, column));
                let found = products[row * taps + column];
                assert!((found - expected).abs() < 1e-12 * greatest, "{direct} {row} {column}: {found} {expected}");
            }
        }
        let sound: Vec<f64> = (0..LEN).map(|n| 1e-4 * pulse(n, direct)).collect();
        for (tap, found) in gated.tap_correlations(taps, &sound).into_iter().enumerate() {
            let expected = sum(&|n| (foam[n] - sound[n] / path.direct_secs) * moved(n, tap));
            assert!((found - expected).abs() < 1e-12 * greatest, "{direct} {tap}: {found} {expected}");
        }
    }
}

#[test]
fn the_reflection_is_the_difference_through_the_filter_of_the_angle() {
    let filter = |factor: f64, taps: usize| (0..taps).map(|tap| factor * (tap as f64 * 0.7).cos()).collect::<Vec<_>>();
    for (lead, taps, len) in [(0, 1, 5), (3, 8, 30), (10, 68, LEN), (10, 66, 40)] {
        let classes = vec![0.0, 0.5];
        let reflection = FoamReflection { lead, classes, filters: vec![filter(0.1, taps), filter(-0.3, taps)] };
        let foam: Vec<f64> = (0..len).map(|n| (n as f64 * 0.3).sin()).collect();
        let difference: Vec<f64> = (0..len).map(|n| (n as f64 * 0.41).cos()).collect();
        let found = reflection.remove_reflection(&foam, &difference, 0.125);
        for (n, found) in found.iter().enumerate() {
            let moved =
                |tap: usize| (n + lead).checked_sub(tap).and_then(|at| difference.get(at)).copied().unwrap_or(0.0);
            let factor = |tap: usize| 0.75 * reflection.filters[0][tap] + 0.25 * reflection.filters[1][tap];
            let expected = foam[n] - (0..taps).map(|tap| factor(tap) * moved(tap)).sum::<f64>();
            assert!((found - expected).abs() < 1e-12, "{lead} {taps} {n}: {found} {expected}");
        }
    }
}

#[test]
fn signals_are_delayed_by_fractions_of_a_sample() {
    let mut delay = SignalDelay::new(2 * LEN);
    let signal: Vec<f64> = (0..LEN).map(|n| pulse(n, 100.0)).collect();
    delay.take_signal(&signal).expect("short enough");
    for samples in [0.0, 37.25, -41.5] {
        let delayed = delay.delay_signal(samples).expect("delayed");
        let off = (0..LEN).map(|n| (delayed[n] - pulse(n, 100.0 + samples)).abs()).fold(0.0, f64::max);
        // The pulse has a ten-thousandth of its peak where the signal begins.
        assert!(off < 1e-3, "{samples}: {off}");
    }
    assert!(delay.take_signal(&vec![0.0; 2 * LEN + 1]).is_none());
}

#[test]
fn few_pairs_or_a_flat_that_is_foam_give_no_estimate() {
    let responses = |r| response(60.0, 120.0, &[(0.0, r)]);
    let fit = |pairs: usize, flat: f64| {
        let mut fit = FoamReflectionFit::new(LEN, RATE_HZ).expect("a fit");
        for _ in 0..pairs {
            let added = fit.add_pair(&responses(0.05), &responses(flat), path(60.0, 120.0, 30.0));
            assert_eq!(added, Ok(true));
        }
        fit.finish()
    };
    assert!(fit(LEAST_PAIRS - 1, 0.8).is_none());
    assert!(fit(LEAST_PAIRS, 0.05).is_none());
    assert!(fit(LEAST_PAIRS, 0.8).is_some());
}

#[test]
fn overlapping_arrivals_and_bad_responses_add_nothing() {
    let mut fit = FoamReflectionFit::new(LEN, RATE_HZ).expect("a fit");
    let (foam, flat) = (response(60.0, 80.0, &[(0.0, 0.1)]), response(60.0, 80.0, &[(0.0, 0.8)]));
    for [direct, reflected, angle] in
        [[60.0, 80.0, 30.0], [60.0, 360.0, 30.0], [f64::NAN, 120.0, 30.0], [60.0, 120.0, f64::NAN]]
    {
        let added = fit.add_pair(&foam, &flat, path(direct, reflected, angle));
        assert_eq!(added, Ok(false), "{direct} {reflected} {angle}");
    }
    let mut broken = foam.clone();
    broken[200] = f64::NAN;
    let result = fit.add_pair(&broken, &flat, path(60.0, 120.0, 30.0));
    assert!(matches!(result, Err(Error::NotFinite { .. })), "{result:?}");
    assert!(matches!(fit.add_pair(&foam[1..], &flat, path(60.0, 120.0, 30.0)), Err(Error::Length { .. })));
    assert!(fit.pairs.is_empty());
    assert!(FoamReflectionFit::new(0, RATE_HZ).is_err() && FoamReflectionFit::new(9, 1e3).is_err());
}

// Of 1, 2, 3 and 4 the jackknife's variance is 3/4 of the sum of squares about the mean, 5.
#[test]
fn errors_of_an_estimate_are_those_of_its_variants() {
    assert!((estimate_error(2.0, &[1.0, 2.0, 3.0, 4.0, 2.0]) - 3.75f64.sqrt()).abs() < 1e-12);
    assert!((estimate_error(2.0, &[1.0, 1.0, 1.0, 1.0, 2.5]) - 0.5).abs() < 1e-12);
}
