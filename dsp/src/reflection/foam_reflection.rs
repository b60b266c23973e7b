//! Foam's own reflection, estimated from responses of Foam and Flat, and the direct sound without it.
//!
//! No foam absorbs everything. What it reflects is in every response of Foam, and to subtract that response takes the
//! same away from every surface: in phase from Flat, which it weakens, and out of phase from a relief whose reflection
//! arrives at other times, to which it adds energy.
//!
//! Flat and Foam lie in the same plane, so both reflect the same waves: for each pair, Foam's reflection is that of
//! Flat less Foam through a short filter k, which is the same for all pairs. It is fitted where the reflection arrives
//! well after the direct sound. The direct sound is then Foam's response less k applied to the difference, also for
//! pairs whose arrivals overlap.

use std::sync::Arc;

use realfft::num_complex::Complex;
use realfft::{ComplexToReal, RealToComplex};

use crate::error::check_len;
use crate::{Error, RealSample};

/// Least time between both arrivals of a pair that the filter is fitted to, s. With less, what is left of the direct
/// sound's low frequencies is mistaken for Foam's reflection; with more, too few pairs are left.
const LEAST_SEPARATION_SECS: f64 = 0.6e-3;
/// Time before the reflection's arrival at which the fitted part begins to rise, and the length of that rise, s.
const GATE_SECS: [f64; 2] = [0.3e-3, 0.2e-3];
/// Times that the filter spans about the reflection by Flat, s: sound that enters 50 mm of foam and comes back from the
/// wall behind it is 0.3 ms late.
const FILTER_SECS: [f64; 2] = [-0.1e-3, 0.6e-3];
/// Least number of pairs for an estimate: what is not Foam's reflection averages out over them.
pub const LEAST_PAIRS: usize = 24;
/// Power added at all frequencies, relative to the mean: nothing is known of those that the sweep lacks.
const LOADING: f64 = 1e-4;

/// Fits the filter from Foam's and Flat's responses of many pairs.
///
/// ```
/// use echolake_dsp::foam_reflection::FoamReflectionFit;
///
/// let mut fit = FoamReflectionFit::<f64>::new(384, 96e3)?;
/// let response = |reflection: f64| {
///     let mut ir = vec![0.0; 384];
///     (ir[80], ir[160]) = (1.0, reflection);
///     ir
/// };
/// for _ in 0..24 {
///     assert!(fit.add_pair(&response(0.04), &response(0.84), 80.0 / 96e3, 160.0 / 96e3)?);
/// }
/// let reflection = fit.finish().ok_or("24 pairs are enough")?;
/// let mut direct = vec![0.0; 384];
/// reflection.direct_sound(&response(0.04), &response(0.84), &mut direct)?;
/// assert!((direct[80] - 1.0).abs() < 1e-3 && direct[160].abs() < 1e-3);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct FoamReflectionFit<T: RealSample> {
    rate_hz: f64,
    len: usize,
    forward: Arc<dyn RealToComplex<T>>,
    inverse: Arc<dyn ComplexToReal<f64>>,
    /// Sums over pairs, per bin: the cross spectrum of Foam with the difference, and the difference's power.
    cross: Vec<Complex<f64>>,
    power: Vec<Complex<f64>>,
    pairs: usize,
}

/// Foam's reflection relative to what Flat reflects more.
#[derive(Debug, Clone, PartialEq)]
pub struct FoamReflection {
    /// Samples by which the first tap comes before the reflection by Flat.
    lead: usize,
    taps: Vec<f64>,
    /// Number of pairs that it was fitted to.
    pub pairs: usize,
}

impl<T: RealSample> FoamReflectionFit<T> {
    /// Begins a fit to responses of `len` samples.
    ///
    /// # Errors
    /// [`Error::Setting`] for no samples, or a rate at which the filter has no tap.
    pub fn new(len: usize, rate_hz: f64) -> Result<Self, Error> {
        if len == 0 || !(rate_hz.is_finite() && rate_hz * FILTER_SECS[1] >= 1.0) {
            let actual = format!("{len} samples at {rate_hz} Hz");
            return Err(Error::Setting { what: "the response", actual, expected: "samples at some kHz" });
        }
        let bins = len + 1;
        Ok(Self {
            rate_hz,
            len,
            // Twice the length: the circle does not close.
            forward: T::plan_real_forward(2 * len),
            inverse: f64::plan_real_inverse(2 * len),
            cross: vec![Complex::default(); bins],
            power: vec![Complex::default(); bins],
            pairs: 0,
        })
    }

    /// Adds a pair: its responses of Foam and Flat, and the arrivals of the direct sound and of the reflection in the
    /// panel's plane, s. Returns false, and adds nothing, if they arrive too soon after one another.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn add_pair(&mut self, foam: &[T], flat: &[T], direct_secs: f64, reflected_secs: f64) -> Result<bool, Error> {
        check_len("Foam's response", foam.len(), self.len)?;
        check_len("Flat's response", flat.len(), self.len)?;
        let inside = (reflected_secs + FILTER_SECS[1]) * self.rate_hz < self.len as f64;
        if !(inside && reflected_secs - direct_secs >= LEAST_SEPARATION_SECS) {
            return Ok(false);
        }
        let gate = |n: usize| {
            let secs = n as f64 / self.rate_hz - (reflected_secs - GATE_SECS[0]);
            let rise = (secs / GATE_SECS[1]).clamp(0.0, 1.0);
            T::of(0.5 - 0.5 * (std::f64::consts::PI * rise).cos())
        };
        let spectrum = |sample: &dyn Fn(usize) -> T| {
            let mut signal = self.forward.make_input_vec();
            signal.iter_mut().take(self.len).enumerate().for_each(|(n, x)| *x = gate(n) * sample(n));
            let mut spectrum = self.forward.make_output_vec();
            let done = self.forward.process(&mut signal, &mut spectrum);
            let finite = done.is_ok() && spectrum.first().is_some_and(|dc| dc.re.f64().is_finite());
            finite.then_some(spectrum).ok_or(Error::NotFinite { what: "a reference's response" })
        };
        let of_foam = spectrum(&|n| foam[n])?;
        let of_difference = spectrum(&|n| flat[n] - foam[n])?;
        let wide = |x: &Complex<T>| Complex::new(x.re.f64(), x.im.f64());
        let sums = self.cross.iter_mut().zip(&mut self.power);
        for ((cross, power), (foam, difference)) in sums.zip(of_foam.iter().zip(&of_difference)) {
            let difference = wide(difference);
            *cross += wide(foam) * difference.conj();
            *power += difference.norm_sqr();
        }
        self.pairs += 1;
        Ok(true)
    }

    /// Fits the filter by least squares; None of fewer than [`LEAST_PAIRS`], or if Flat reflects no more than Foam.
    pub fn finish(mut self) -> Option<FoamReflection> {
        if self.pairs < LEAST_PAIRS {
            return None;
        }
        let samples = |secs: f64| (secs * self.rate_hz).round() as usize;
        let lead = samples(-FILTER_SECS[0]);
        let behind = samples(FILTER_SECS[1]);
        let correlation = |spectrum: &mut [Complex<f64>]| {
            let mut out = self.inverse.make_output_vec();
            // The ends of a real signal's spectrum are real.
            for end in [0, self.len] {
                spectrum[end].im = 0.0;
            }
            self.inverse.process(spectrum, &mut out).ok().map(|()| out)
        };
        let mut own = correlation(&mut self.power)?;
        let cross = correlation(&mut self.cross)?;
        if own.first().is_none_or(|power| *power <= 0.0) {
            return None;
        }
        own[0] *= 1.0 + LOADING;
        let circle = cross.len();
        let wanted: Vec<f64> = (0..=lead + behind).map(|tap| cross[(circle + tap - lead) % circle]).collect();
        Some(FoamReflection { lead, taps: solve_toeplitz(&own, &wanted), pairs: self.pairs })
    }
}

impl FoamReflection {
    /// Computes the direct sound of a pair: Foam's response without its reflection.
    ///
    /// foam, flat, direct  `[n]`
    ///
    /// # Errors
    /// [`Error::Length`].
    pub fn direct_sound<T: RealSample>(&self, foam: &[T], flat: &[T], direct: &mut [T]) -> Result<(), Error> {
        check_len("Flat's response", flat.len(), foam.len())?;
        check_len("the direct sound", direct.len(), foam.len())?;
        let difference: Vec<f64> = flat.iter().zip(foam).map(|(flat, foam)| flat.f64() - foam.f64()).collect();
        for (n, (direct, foam)) in direct.iter_mut().zip(foam).enumerate() {
            // Sample n + lead - tap of the difference.
            let first = (n + self.lead + 1).saturating_sub(difference.len());
            let taps = self.taps.iter().enumerate().skip(first).take_while(|(tap, _)| *tap <= n + self.lead);
            let reflected: f64 = taps.map(|(tap, k)| k * difference[n + self.lead - tap]).sum();
            *direct = T::of(foam.f64() - reflected);
        }
        Ok(())
    }
}

// Conjugate gradients: the matrix, with `first` as its first row, is an autocorrelation's and thus positive definite.
fn solve_toeplitz(first: &[f64], wanted: &[f64]) -> Vec<f64> {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let times = |x: &[f64]| -> Vec<f64> {
        (0..x.len()).map(|i: usize| x.iter().enumerate().map(|(j, x)| first[i.abs_diff(j)] * x).sum()).collect()
    };
    let mut solution = vec![0.0; wanted.len()];
    let mut residual = wanted.to_vec();
    let mut direction = residual.clone();
    let mut left = dot(&residual, &residual);
    let least = 1e-20 * dot(wanted, wanted);
    // Exact arithmetic needs as many steps as there are unknowns.
    for _ in 0..8 * wanted.len() {
        if left <= least {
            break;
        }
        let image = times(&direction);
        let step = left / dot(&direction, &image);
        solution.iter_mut().zip(&direction).for_each(|(x, d)| *x += step * d);
        residual.iter_mut().zip(&image).for_each(|(r, i)| *r -= step * i);
        let now = dot(&residual, &residual);
        direction.iter_mut().zip(&residual).for_each(|(d, r)| *d = r + now / left * *d);
        left = now;
    }
    solution
}

#[cfg(test)]
mod tests {
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

    // Direct sound and a reflection by layers, each with its delay in samples and factor.
    fn response(direct: f64, reflected: f64, layers: &[(f64, f64)]) -> Vec<f64> {
        let reflection = |n| layers.iter().map(|(delay, r)| 0.7 * r * pulse(n, reflected + delay)).sum::<f64>();
        (0..LEN).map(|n| pulse(n, direct) + reflection(n)).collect()
    }

    fn arrivals() -> impl Iterator<Item = (f64, f64)> {
        (0..120).map(|i| {
            let direct = 40.0 + 7.31 * f64::from(i % 12);
            (direct, direct + 16.0 + 0.83 * f64::from(i))
        })
    }

    #[test]
    fn the_direct_sound_of_every_pair_is_found_though_foam_reflects_twice() {
        // A surface that reflects 4 %, and the wall behind it.
        let (foam, flat) = ([(0.0, 0.04), (27.4, 0.02)], [(0.0, 0.84)]);
        let mut fit = FoamReflectionFit::<f64>::new(LEN, RATE_HZ).expect("a fit");
        let mut fitted = 0;
        for (direct, reflected) in arrivals() {
            let (foam, flat) = (response(direct, reflected, &foam), response(direct, reflected, &flat));
            let added = fit.add_pair(&foam, &flat, direct / RATE_HZ, reflected / RATE_HZ).expect("added");
            fitted += usize::from(added);
        }
        let reflection = fit.finish().expect("an estimate");
        assert!(reflection.pairs == fitted && (LEAST_PAIRS..120).contains(&fitted), "{fitted}");
        let energy = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
        let (mut before, mut after) = (0.0, 0.0);
        for (direct, reflected) in arrivals() {
            let (foam, flat) = (response(direct, reflected, &foam), response(direct, reflected, &flat));
            let (truth, mut found) = (response(direct, reflected, &[]), vec![f64::NAN; LEN]);
            reflection.direct_sound(&foam, &flat, &mut found).expect("lengths");
            before += energy(&foam, &truth);
            after += energy(&found, &truth);
        }
        let left_db = 10.0 * (after / before).log10();
        assert!(left_db < -25.0, "{left_db} dB of Foam's reflection is left");
    }

    #[test]
    fn few_pairs_or_a_flat_that_is_foam_give_no_estimate() {
        let responses = |r| response(60.0, 120.0, &[(0.0, r)]);
        let fit = |pairs: usize, flat: f64| {
            let mut fit = FoamReflectionFit::<f64>::new(LEN, RATE_HZ).expect("a fit");
            for _ in 0..pairs {
                let added = fit.add_pair(&responses(0.05), &responses(flat), 60.0 / RATE_HZ, 120.0 / RATE_HZ);
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
        let mut fit = FoamReflectionFit::<f64>::new(LEN, RATE_HZ).expect("a fit");
        let (foam, flat) = (response(60.0, 90.0, &[(0.0, 0.1)]), response(60.0, 90.0, &[(0.0, 0.8)]));
        for [direct, reflected] in [[60.0, 90.0], [60.0, 360.0], [f64::NAN, 120.0]] {
            assert_eq!(
                fit.add_pair(&foam, &flat, direct / RATE_HZ, reflected / RATE_HZ),
                Ok(false),
                "{direct} {reflected}"
            );
        }
        let mut broken = foam.clone();
        broken[200] = f64::NAN;
        let result = fit.add_pair(&broken, &flat, 60.0 / RATE_HZ, 120.0 / RATE_HZ);
        assert!(matches!(result, Err(Error::NotFinite { .. })), "{result:?}");
        assert!(matches!(fit.add_pair(&foam[1..], &flat, 0.0, 0.001), Err(Error::Length { .. })));
        assert_eq!(fit.pairs, 0);
        assert!(FoamReflectionFit::<f32>::new(0, RATE_HZ).is_err() && FoamReflectionFit::<f32>::new(9, 1e3).is_err());
    }
}
