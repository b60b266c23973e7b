//! Correction of reflected responses from the air that they were measured in to the reference air.
//!
//! The correction of the time axis moves every frequency, and with it what speaker and microphone do to each: along a
//! slope of 6 dB an octave 0.6 % is 0.05 dB. And air of another temperature and humidity absorbs more or less.

use std::f64::consts::LN_10;
use std::sync::Arc;

use echolake_schema::AirTreatment;
use realfft::num_complex::Complex;
use realfft::{ComplexToReal, RealToComplex};

use crate::air::{AirAbsorption, AirState};
use crate::error::check_len;
use crate::foam::subtract_foam;
use crate::temperature::ReferenceAir;
use crate::uncertainty::{EnergyChanges, LEAST_PAIRS, gate_gain};
use crate::{Error, RealSample};

/// Natural logarithm of an amplitude ratio per dB.
const NEPER_PER_DB: f64 = LN_10 / 20.0;

/// Standard uncertainty of the slope of reflected sound, d ln(amplitude) / d ln(frequency), and the frequency, Hz, from
/// where it is so great; below, it rises with frequency. A relief's sound leaves the speaker in other directions than
/// Flat's, of which the slope is learned. By errors of three panels in runs of the simulated rig at 18 to 25 C
/// (`tests/numbers/repeated_runs.py`).
const SLOPE_UNCERTAINTY: f64 = 0.4;
const UNCERTAIN_HZ: f64 = 28e3;
/// Share of a slope's difference to the mean of its neighbours that is uncertain, too: slopes between bins are off by
/// it near a resonance.
const BENT_SHARE: f64 = 0.5;

/// 1 / 0! to 1 / 8!: coefficients of the exponential series, and of those of sine and cosine.
const INVERSE_FACTORIALS: [f64; 9] =
    [1.0, 1.0, 1.0 / 2.0, 1.0 / 6.0, 1.0 / 24.0, 1.0 / 120.0, 1.0 / 720.0, 1.0 / 5_040.0, 1.0 / 40_320.0];
/// Greatest number whose exponential is computed by them, within 1.1e-11.
const SERIES_LIMIT: f64 = 0.25;

/// Half of the width that slopes are smoothed over, as a ratio of frequencies: a third of an octave in all, if there
/// are too few pairs for other sound to average out.
const SMOOTHED_RATIO: f64 = 1.122_462_048_309_373;
/// Distance of the bins between which a slope is taken with enough pairs to its own, Hz: a resonance of a tweeter is
/// wider.
const SLOPE_HZ: f64 = 250.0;
/// Times before the reflection's arrival between which the part of the direct sound falls to nothing that its slopes at
/// high frequencies are of, s: there the speaker sends much less to its side than to the panel, and what Foam reflects
/// is as strong.
const GATE_SECS: [f64; 2] = [0.15e-3, 0.05e-3];
/// Least time between both arrivals of a pair for that, s.
const LEAST_SEPARATION_SECS: f64 = 0.2e-3;
/// Frequency from which on that part takes over, Hz, up to a third more; at least so many periods in the mean time
/// between both arrivals, below which it is too short.
const GATED_HZ: f64 = 12e3;
const GATED_PERIODS: f64 = 5.0;

/// Learns the slopes of speaker and microphone from the direct sound and from what Flat reflects.
///
/// Spectra are summed as if all pairs' sound came at once: what else is in a response has other delays in each pair,
/// and averages out.
pub struct AirCorrectionFit<T: RealSample> {
    rate_hz: f64,
    len: usize,
    range_hz: [f64; 2],
    reference: ReferenceAir,
    forward: Arc<dyn RealToComplex<T>>,
    direct: PathSum,
    reflected: PathSum,
    /// The part of the direct sound before the reflection, of the pairs that have one, and the sum of its times, s.
    gated: PathSum,
    separation_secs: f64,
}

/// Sum of pairs' aligned spectra, `[len / 2 + 1]`, and of the lengths of their paths, m.
struct PathSum {
    pairs: usize,
    spectrum: Vec<Complex<f64>>,
    metres: f64,
}

impl<T: RealSample> AirCorrectionFit<T> {
    /// Begins with responses of `len` samples to sweeps of this range, Hz.
    pub fn new(len: usize, rate_hz: f64, range_hz: [f64; 2], reference: ReferenceAir) -> Self {
        let [direct, reflected, gated] =
            [(); 3].map(|()| PathSum { pairs: 0, spectrum: vec![Complex::default(); len / 2 + 1], metres: 0.0 });
        let forward = T::plan_real_forward(len);
        Self { rate_hz, len, range_hz, reference, forward, direct, reflected, gated, separation_secs: 0.0 }
    }

    /// Adds a pair: its direct sound and what Flat reflects, `[len]`, and the lengths of both paths, m.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn add_pair(&mut self, direct: &[T], reflected: &[T], metres: [f64; 2]) -> Result<(), Error> {
        let sound_m_s = self.reference.speed_of_sound();
        let [direct_m, reflected_m] = metres;
        let separation_secs = (reflected_m - direct_m) / sound_m_s;
        let before: Vec<T> = if separation_secs < LEAST_SEPARATION_SECS {
            Vec::new()
        } else {
            self.separation_secs += separation_secs;
            let gate = |(n, x): (usize, &T)| {
                T::of(x.f64() * gate_gain(n as f64 / self.rate_hz - reflected_m / sound_m_s, GATE_SECS))
            };
            direct.iter().enumerate().map(gate).collect()
        };
        let mut signal = self.forward.make_input_vec();
        let mut spectrum = self.forward.make_output_vec();
        let mut work = self.forward.make_scratch_vec();
        for (sum, from, metres) in [
            (&mut self.direct, direct, direct_m),
            (&mut self.reflected, reflected, reflected_m),
            (&mut self.gated, &before[..], direct_m),
        ] {
            if from.is_empty() {
                continue;
            }
            transform(&*self.forward, from, &mut signal, &mut spectrum, &mut work)?;
            let turn = std::f64::consts::TAU * metres / sound_m_s * self.rate_hz / self.len as f64;
            for (bin, (sum, x)) in sum.spectrum.iter_mut().zip(&spectrum).enumerate() {
                // Far pairs count as much as near ones.
                *sum += Complex::new(x.re.f64(), x.im.f64()) * Complex::from_polar(metres, turn * bin as f64);
            }
            sum.metres += metres;
            sum.pairs += 1;
        }
        Ok(())
    }

    /// Plans the correction.
    pub fn finish(self) -> AirCorrection<T> {
        let step_hz = self.rate_hz / self.len as f64;
        let [colder, own, warmer] = [-0.5, 0.0, 0.5].map(|kelvin| {
            let air = self.reference.air();
            AirEffect::new(&self.reference, &AirState { temperature_c: air.temperature_c + kelvin, ..air })
        });
        let squares: Vec<f64> = (0..self.len / 2 + 1).map(|bin| (bin as f64 * step_hz).powi(2)).collect();
        let by_bin = |effect: &AirEffect| -> Vec<f64> {
            let mut nepers = vec![0.0; squares.len()];
            effect.fill_absorption(&squares, &mut nepers);
            nepers
        };
        let absorption = by_bin(&own);
        let smoothed = |path: &PathSum| smoothed_slopes(&path.emitted_spectrum(&absorption), step_hz, self.range_hz);
        let slopes = |path: &PathSum| match path.pairs >= LEAST_PAIRS {
            true => exact_slopes(&path.emitted_spectrum(&absorption), step_hz, self.range_hz),
            false => smoothed(path),
        };
        let reflected_slopes = slopes(&self.reflected);
        let mut direct_slopes = slopes(&self.direct);
        if self.gated.pairs >= LEAST_PAIRS {
            let separation_secs = self.separation_secs / self.gated.pairs as f64;
            let from_hz = GATED_HZ.max(GATED_PERIODS / separation_secs);
            let gated = smoothed(&self.gated);
            for ((bin, slope), gated) in direct_slopes.iter_mut().enumerate().zip(gated) {
                let share = ((bin as f64 * step_hz / from_hz - 1.0) * 3.0).clamp(0.0, 1.0);
                *slope = *slope * (1.0 - share) + gated * share;
            }
        }
        let changes = by_bin(&warmer).into_iter().zip(by_bin(&colder)).map(|(warm, cold)| 2.0 * (cold - warm));
        let ln_ratio = warmer.ln_ratio - colder.ln_ratio;
        AirCorrection {
            len: self.len,
            reference: self.reference,
            direct_slopes,
            slope_uncertainties: slope_uncertainties(&reflected_slopes, step_hz),
            transducers_per_kelvin: reflected_slopes.iter().map(|slope| 2.0 * slope.re * ln_ratio).collect(),
            absorption_per_kelvin: changes.collect(),
            reflected_slopes,
            absorption,
            squares,
            forward: self.forward,
            inverse: T::plan_real_inverse(self.len),
        }
    }
}

/// A response and its spectrum, of which each follows from the other.
#[derive(Debug, Clone, PartialEq)]
pub struct TransformedResponse<T> {
    /// `[len]`.
    pub samples: Vec<T>,
    /// `[len / 2 + 1]`.
    pub spectrum: Vec<Complex<T>>,
}

/// The air that a pair's response and the direct sound beneath it were measured in, and the lengths of both paths.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairAir {
    /// Air of the response.
    pub response: AirState,
    /// Air of the direct sound that is subtracted.
    pub direct: AirState,
    /// Length of the direct path, m.
    pub direct_m: f64,
    /// Length of the path by the panel's plane, m.
    pub reflected_m: f64,
}

/// Subtracts the direct sound, and corrects what remains to the reference air.
///
/// The direct sound is brought to the response's air first, because it is subtracted there.
pub struct AirCorrection<T: RealSample> {
    len: usize,
    reference: ReferenceAir,
    /// `[bins]`: d ln(spectrum) / d ln(frequency) of speaker and microphone, on the direct and on the reflected path.
    direct_slopes: Vec<Complex<f64>>,
    reflected_slopes: Vec<Complex<f64>>,
    /// `[bins]`: standard uncertainty of the latter.
    slope_uncertainties: Vec<f64>,
    /// `[bins]`: squares of the frequencies, Hz^2.
    squares: Vec<f64>,
    /// `[bins]`: absorption by the reference air, neper/m.
    absorption: Vec<f64>,
    /// `[bins]`: relative change of an energy per kelvin by speaker and microphone, and by absorption per metre.
    transducers_per_kelvin: Vec<f64>,
    absorption_per_kelvin: Vec<f64>,
    forward: Arc<dyn RealToComplex<T>>,
    inverse: Arc<dyn ComplexToReal<T>>,
}

/// Buffers of an [`AirCorrection`], and what it knows of the response that it was given last.
pub struct AirScratch<T> {
    signal: Vec<T>,
    /// `[bins]`: spectrum of the response.
    response: Vec<Complex<T>>,
    /// `[bins]`: gains that bring the direct sound to the response's air, and the response to the reference air.
    to_response: Vec<Complex<T>>,
    to_reference: Vec<Complex<T>>,
    /// `[bins]`: absorption by the response's air and by that of the direct sound, neper/m.
    absorbed: [Vec<f64>; 2],
    /// `[bins]`: logarithms of gains.
    nepers: Vec<Complex<f64>>,
    scaled: Vec<Complex<T>>,
    work: Vec<Complex<T>>,
}

/// Speed of sound in air over that in the reference air, and absorption by bin of a corrected response.
struct AirEffect {
    ln_ratio: f64,
    ratio: f64,
    absorption: AirAbsorption,
}

impl AirEffect {
    fn new(reference: &ReferenceAir, air: &AirState) -> Self {
        let ratio = reference.time_ratio(air);
        Self { ln_ratio: ratio.ln(), ratio, absorption: AirAbsorption::new(air) }
    }

    // At frequencies of the corrected response with these squares, neper/m.
    fn fill_absorption(&self, squares: &[f64], nepers_per_m: &mut [f64]) {
        let factor = self.ratio * self.ratio;
        for (nepers, square) in nepers_per_m.iter_mut().zip(squares) {
            *nepers = NEPER_PER_DB * self.absorption.db_per_m_of_square(square * factor);
        }
    }
}

impl<T: RealSample> AirScratch<T> {
    /// Returns the gain by which the response that was taken last holds the direct sound with this spectrum `[bins]`:
    /// about 1, and -1 if the microphone's polarity is inverted.
    pub fn direct_gain(&self, direct: &[Complex<T>]) -> f64 {
        let mut sums = [0.0; 2];
        for (x, d) in self.response.iter().zip(direct) {
            sums[0] += (x.re * d.re + x.im * d.im).f64();
            sums[1] += d.norm_sqr().f64();
        }
        sums[0] / sums[1]
    }
}

impl<T: RealSample> AirCorrection<T> {
    /// Buffers; one per thread.
    pub fn make_scratch(&self) -> AirScratch<T> {
        let work = self.forward.get_scratch_len().max(self.inverse.get_scratch_len());
        let spectrum = self.forward.make_output_vec();
        AirScratch {
            signal: self.forward.make_input_vec(),
            response: spectrum.clone(),
            to_response: spectrum.clone(),
            to_reference: spectrum.clone(),
            absorbed: [self.squares.clone(), self.squares.clone()],
            nepers: vec![Complex::default(); spectrum.len()],
            scaled: spectrum,
            work: vec![Complex::default(); work],
        }
    }

    /// A place for [`Self::subtract_direct`], which fills it again and again.
    pub fn make_reflected(&self) -> TransformedResponse<T> {
        TransformedResponse { samples: self.forward.make_input_vec(), spectrum: self.forward.make_output_vec() }
    }

    /// Computes what a surface reflects, in the reference air, from a response `[len]` and the direct sound.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn subtract_direct(
        &self,
        ir: &[T],
        direct: &TransformedResponse<T>,
        pair: &PairAir,
        reflected: &mut TransformedResponse<T>,
        scratch: &mut AirScratch<T>,
    ) -> Result<(), Error> {
        check_len("the reflected response", reflected.samples.len(), self.len)?;
        check_len("the direct sound", direct.samples.len(), self.len)?;
        self.take_response(ir, pair, scratch)?;
        self.reflected_spectrum(&direct.spectrum, &mut reflected.spectrum, scratch);
        if self.reference.treatment == AirTreatment::Paper {
            subtract_foam(ir, &direct.samples, &mut reflected.samples);
            return Ok(());
        }
        let share = T::of((self.len as f64).recip());
        scratch.scaled.iter_mut().zip(&reflected.spectrum).for_each(|(scaled, x)| *scaled = x * share);
        let done = self.inverse.process_with_scratch(&mut scratch.scaled, &mut reflected.samples, &mut scratch.work);
        done.map_err(|_| Error::NotFinite { what: "the response" })
    }

    /// Takes a response `[len]` for [`Self::reflected_spectrum`].
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn take_response(&self, ir: &[T], pair: &PairAir, scratch: &mut AirScratch<T>) -> Result<(), Error> {
        let AirScratch { signal, response, to_response, to_reference, absorbed, nepers, work, .. } = scratch;
        transform(&*self.forward, ir, signal, response, work)?;
        if self.reference.treatment == AirTreatment::Paper {
            let one = Complex::new(T::of(1.0), T::default());
            to_response.fill(one);
            to_reference.fill(one);
            return Ok(());
        }
        let of_response = AirEffect::new(&self.reference, &pair.response);
        let of_direct = AirEffect::new(&self.reference, &pair.direct);
        let [by_response, by_direct] = absorbed;
        of_response.fill_absorption(&self.squares, by_response);
        of_direct.fill_absorption(&self.squares, by_direct);
        let ln_ratio = of_response.ln_ratio - of_direct.ln_ratio;
        let changes = by_direct.iter().zip(&*by_response).map(|(direct, response)| direct - response);
        for ((nepers, slope), change) in nepers.iter_mut().zip(&self.direct_slopes).zip(changes) {
            *nepers = slope * ln_ratio + change * pair.direct_m;
        }
        fill_gains(nepers, to_response);
        let changes = by_response.iter().zip(&self.absorption).map(|(response, reference)| response - reference);
        for ((nepers, slope), change) in nepers.iter_mut().zip(&self.reflected_slopes).zip(changes) {
            *nepers = slope * -of_response.ln_ratio + change * pair.reflected_m;
        }
        fill_gains(nepers, to_reference);
        Ok(())
    }

    /// Computes the spectrum of what a surface reflects from the response that was taken last, and the direct sound's
    /// spectrum, [`Self::compute_spectrum`].
    ///
    /// direct, reflected  `[len / 2 + 1]`
    pub fn reflected_spectrum(
        &self,
        direct: &[Complex<T>],
        reflected: &mut [Complex<T>],
        AirScratch { response, to_response, to_reference, .. }: &AirScratch<T>,
    ) {
        let gains = to_response.iter().zip(to_reference);
        for (((out, x), d), (to_response, to_reference)) in reflected.iter_mut().zip(response).zip(direct).zip(gains) {
            *out = (*x - d * to_response) * to_reference;
        }
        // The ends of a real signal's spectrum are real.
        reflected[0].im = T::default();
        if self.len.is_multiple_of(2) {
            reflected[self.len / 2].im = T::default();
        }
    }

    /// Computes the spectrum of a response `[len]`, and keeps both.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn transform_response(
        &self,
        samples: Vec<T>,
        scratch: &mut AirScratch<T>,
    ) -> Result<TransformedResponse<T>, Error> {
        let spectrum = self.compute_spectrum(&samples, scratch)?;
        Ok(TransformedResponse { samples, spectrum })
    }

    /// Computes the spectrum of a signal `[len]`.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn compute_spectrum(&self, signal: &[T], scratch: &mut AirScratch<T>) -> Result<Vec<Complex<T>>, Error> {
        let mut spectrum = self.forward.make_output_vec();
        transform(&*self.forward, signal, &mut scratch.signal, &mut spectrum, &mut scratch.work)?;
        Ok(spectrum)
    }

    /// Returns the relative change, per kelvin that the air is warmer than it is thought to be, of a bin's energy after
    /// a path of so many metres, and its standard uncertainty, per logarithm of the ratio of speeds of sound that it is
    /// corrected for.
    pub fn energy_changes(&self, bin: usize, metres: f64) -> EnergyChanges {
        let of = |changes: &[f64]| changes.get(bin).copied().unwrap_or(0.0);
        EnergyChanges {
            per_kelvin: of(&self.transducers_per_kelvin) + metres * of(&self.absorption_per_kelvin),
            uncertainty_per_ratio: 2.0 * of(&self.slope_uncertainties),
        }
    }
}

fn fill_gains<T: RealSample>(nepers: &mut [Complex<f64>], gains: &mut [Complex<T>]) {
    exponentiate(nepers);
    gains.iter_mut().zip(nepers).for_each(|(gain, exact)| *gain = Complex::new(T::of(exact.re), T::of(exact.im)));
}

// Gains are near 1, and then all of them are computed without a branch, side by side.
fn exponentiate(values: &mut [Complex<f64>]) {
    match values.iter().filter(|x| !(x.l1_norm() <= SERIES_LIMIT)).count() {
        0 => values.iter_mut().for_each(|x| *x = small_exponential(*x)),
        _ => values.iter_mut().for_each(|x| *x = x.exp()),
    }
}

// The series of exp, sine and cosine up to the eighth power take less than the functions.
fn small_exponential(nepers: Complex<f64>) -> Complex<f64> {
    let [one, _, f2, f3, f4, f5, f6, f7, f8] = INVERSE_FACTORIALS;
    let level = INVERSE_FACTORIALS.iter().rev().fold(0.0, |sum, inverse| sum * nepers.re + inverse);
    let square = nepers.im * nepers.im;
    let cosine = (((f8 * square - f6) * square + f4) * square - f2) * square + one;
    let sine = (((f5 - f7 * square) * square - f3) * square + one) * nepers.im;
    Complex::new(level * cosine, level * sine)
}

fn transform<T: RealSample>(
    forward: &dyn RealToComplex<T>,
    from: &[T],
    signal: &mut [T],
    spectrum: &mut [Complex<T>],
    work: &mut [Complex<T>],
) -> Result<(), Error> {
    check_len("the response", from.len(), signal.len())?;
    signal.copy_from_slice(from);
    let done = forward.process_with_scratch(signal, spectrum, work);
    let is_finite = done.is_ok() && spectrum.first().is_some_and(|dc| dc.re.f64().is_finite());
    if is_finite { Ok(()) } else { Err(Error::NotFinite { what: "the response" }) }
}

impl PathSum {
    // Speaker and microphone alone, without absorption by the reference air.
    fn emitted_spectrum(&self, absorption: &[f64]) -> Vec<Complex<f64>> {
        let metres = self.metres / self.pairs.max(1) as f64;
        self.spectrum.iter().zip(absorption).map(|(x, nepers)| x * (metres * nepers).exp()).collect()
    }
}

// The first and the last bin whose neighbours are within the range that the sweep has, and no part of its tapers.
fn slope_range(bins: usize, step_hz: f64, [low_hz, high_hz]: [f64; 2]) -> [usize; 2] {
    let first = (low_hz * 1.02 / step_hz).ceil() as usize + 2;
    let last = ((high_hz * 0.98 / step_hz).floor() as usize).saturating_sub(2).min(bins.saturating_sub(2));
    [first, last.max(first)]
}

// d ln(spectrum) / d ln(frequency) of a bin between two others; none where there is no sound.
fn slope_between(spectrum: &[Complex<f64>], [low, high]: [usize; 2]) -> Option<Complex<f64>> {
    let (below, above) = (spectrum.get(low)?, spectrum.get(high)?);
    let slope = (above / below).ln() / (high as f64 / low as f64).ln();
    slope.is_finite().then_some(slope)
}

// Slopes at the resolution of a response; beyond the range the nearest one's.
fn exact_slopes(spectrum: &[Complex<f64>], step_hz: f64, range_hz: [f64; 2]) -> Vec<Complex<f64>> {
    let [first, last] = slope_range(spectrum.len(), step_hz, range_hz);
    let distance = (SLOPE_HZ / step_hz).round().max(1.0) as usize;
    let slope_of = |bin: usize| {
        let bin = bin.clamp(first, last);
        let distance = distance.min(bin - (first - 1)).min(last + 1 - bin);
        slope_between(spectrum, [bin - distance, bin + distance]).unwrap_or_default()
    };
    (0..spectrum.len()).map(slope_of).collect()
}

// Slopes over a third of an octave; beyond the range the nearest one's.
fn smoothed_slopes(spectrum: &[Complex<f64>], step_hz: f64, range_hz: [f64; 2]) -> Vec<Complex<f64>> {
    let [first, last] = slope_range(spectrum.len(), step_hz, range_hz);
    let smoothed = |bin: usize| {
        let bin = bin.clamp(first, last) as f64;
        let lowest = ((bin / SMOOTHED_RATIO).round() as usize).max(first);
        let highest = ((bin * SMOOTHED_RATIO).round() as usize).min(last);
        let mut sum = Complex::default();
        let mut weights = 0.0;
        for bin in lowest..=highest {
            // Where there is next to no sound, there is no slope.
            let Some(slope) = slope_between(spectrum, [bin - 1, bin + 1]) else { continue };
            let weight = (spectrum[bin + 1] * spectrum[bin - 1]).norm();
            sum += slope * weight;
            weights += weight;
        }
        if weights > 0.0 { sum / weights } else { Complex::default() }
    };
    (0..spectrum.len()).map(smoothed).collect()
}

// Directions of a relief's sound, and bends of the slope between bins.
fn slope_uncertainties(slopes: &[Complex<f64>], step_hz: f64) -> Vec<f64> {
    let uncertainty = |bin: usize| {
        let around = [bin.saturating_sub(1), (bin + 1).min(slopes.len() - 1)].map(|bin| slopes[bin]);
        let bend = (slopes[bin] - (around[0] + around[1]) / 2.0).norm();
        let directions = SLOPE_UNCERTAINTY * (bin as f64 * step_hz / UNCERTAIN_HZ).min(1.0);
        directions.hypot(BENT_SHARE * bend)
    };
    (0..slopes.len()).map(uncertainty).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEN: usize = 384;
    const RATE_HZ: f64 = 96e3;
    const REFERENCE: ReferenceAir = ReferenceAir { celsius: 20.0, treatment: AirTreatment::Complete };
    const DIRECT_M: f64 = 0.3;
    const REFLECTED_M: f64 = 0.7;

    // A tweeter that gets louder by 12 dB an octave, and turns the phase by 2 for each factor e.
    fn smooth(hz: f64) -> Complex<f64> {
        Complex::from_polar((hz / 10e3).powi(2), 2.0 * (hz / 10e3).ln())
    }

    // The same with a resonance at 9 kHz, of quality factor 8.
    fn resonant(hz: f64) -> Complex<f64> {
        let ratio = hz / 9e3;
        let damping = Complex::new(0.0, ratio / 8.0);
        smooth(hz) * (1.0 + 2.0 * damping / (1.0 - ratio * ratio + damping))
    }

    // Both paths' sound in air, on the reference's time axis: their delays are the same in all air.
    fn response(emitted: fn(f64) -> Complex<f64>, air: &AirState, reflected: f64) -> Vec<f64> {
        let effect = AirEffect::new(&REFERENCE, air);
        let nepers_per_m = |hz: f64| NEPER_PER_DB * effect.absorption.db_per_m(hz * effect.ratio);
        let mut spectrum: Vec<_> = (0..LEN / 2 + 1)
            .map(|bin| {
                let hz = bin as f64 * RATE_HZ / LEN as f64;
                if !(2e3..=40e3).contains(&hz) {
                    return Complex::default();
                }
                let path = |metres: f64| {
                    let samples = metres / REFERENCE.speed_of_sound() * RATE_HZ;
                    let level = (-metres * nepers_per_m(hz)).exp();
                    emitted(hz * effect.ratio)
                        * Complex::from_polar(level, -std::f64::consts::TAU * bin as f64 * samples / LEN as f64)
                };
                path(DIRECT_M) + path(REFLECTED_M) * reflected
            })
            .collect();
        let mut signal = vec![0.0; LEN];
        f64::plan_real_inverse(LEN).process(&mut spectrum, &mut signal).expect("a signal");
        signal
    }

    fn correction(emitted: fn(f64) -> Complex<f64>, pairs: usize) -> AirCorrection<f64> {
        let mut fit = AirCorrectionFit::new(LEN, RATE_HZ, [2e3, 40e3], REFERENCE);
        let air = REFERENCE.air();
        let silent = response(emitted, &air, 0.0);
        let all = response(emitted, &air, 1.0);
        let reflected: Vec<f64> = all.iter().zip(&silent).map(|(all, direct)| all - direct).collect();
        for _ in 0..pairs {
            fit.add_pair(&silent, &reflected, [DIRECT_M, REFLECTED_M]).expect("a pair");
        }
        fit.finish()
    }

    // Returns the greatest difference from what is reflected in the reference air, dB re its energy.
    fn greatest_difference_db(emitted: fn(f64) -> Complex<f64>, pairs: usize) -> f64 {
        let correction = correction(emitted, pairs);
        let mut scratch = correction.make_scratch();
        let reference = REFERENCE.air();
        let silent = response(emitted, &reference, 0.0);
        let all = response(emitted, &reference, 0.5);
        let expected: Vec<f64> = all.iter().zip(&silent).map(|(all, d)| all - d).collect();
        let mut greatest_db = f64::NEG_INFINITY;
        for (celsius, humidity_pct) in [(18.0, 30.0), (25.0, 60.0), (20.0, 50.0)] {
            let own = AirState { temperature_c: celsius, humidity_pct, pressure_hpa: 965.0 };
            let other = AirState { temperature_c: 22.0, humidity_pct: 40.0, pressure_hpa: 980.0 };
            let pair = PairAir { response: own, direct: other, direct_m: DIRECT_M, reflected_m: REFLECTED_M };
            let direct = response(emitted, &other, 0.0);
            let direct = correction.transform_response(direct, &mut scratch).expect("a spectrum");
            let mut reflected = correction.make_reflected();
            reflected.samples.fill(f64::NAN);
            let measured = response(emitted, &own, 0.5);
            correction.subtract_direct(&measured, &direct, &pair, &mut reflected, &mut scratch).expect("a reflection");
            let spectrum = correction.compute_spectrum(&reflected.samples, &mut scratch).expect("a spectrum");
            let apart = spectrum.iter().zip(&reflected.spectrum).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
            assert!(apart < 1e-11, "{celsius} C: the spectrum is that of the samples but for {apart}");
            let reflected = reflected.samples;
            let energy = |signal: &[f64]| signal.iter().map(|x| x * x).sum::<f64>();
            let off: Vec<f64> = reflected.iter().zip(&expected).map(|(a, b)| a - b).collect();
            greatest_db = greatest_db.max(10.0 * (energy(&off) / energy(&expected)).log10());
        }
        greatest_db
    }

    #[test]
    fn reflections_are_those_of_the_reference_air() {
        // The slope between two bins, 500 Hz apart, is not quite that of the power. Before the reflection there is a
        // part of the direct sound, whose range ends at once here.
        for (pairs, most_db) in [(1, -75.0), (LEAST_PAIRS, -50.0)] {
            let off_db = greatest_difference_db(smooth, pairs);
            assert!(off_db < most_db, "{pairs}: {off_db} dB");
        }
    }

    // S5: a third of an octave is wider than a resonance.
    #[test]
    fn a_resonance_is_corrected_at_the_resolution_of_the_response() {
        let [few, enough] = [1, LEAST_PAIRS].map(|pairs| greatest_difference_db(resonant, pairs));
        assert!(enough < -50.0 && enough < few - 6.0, "{few} and {enough} dB");
    }

    #[test]
    fn energies_change_by_the_slope_and_by_absorption() {
        let correction = correction(smooth, 1);
        let air = |celsius| AirState { temperature_c: celsius, ..REFERENCE.air() };
        let ratio = REFERENCE.time_ratio(&air(20.5)) / REFERENCE.time_ratio(&air(19.5));
        for bin in [20, 40, 150] {
            let change = correction.energy_changes(bin, 0.0).per_kelvin;
            assert!((change / (ratio.powi(4) - 1.0) - 1.0).abs() < 0.01, "{bin}: {change}");
        }
        let absorbed = |celsius| AirAbsorption::new(&air(celsius)).db_per_m(40e3 * REFERENCE.time_ratio(&air(celsius)));
        let change = (10f64.powf(-0.2 * (absorbed(20.5) - absorbed(19.5))) - 1.0) / 2.0;
        let found =
            (correction.energy_changes(160, 2.0).per_kelvin - correction.energy_changes(160, 0.0).per_kelvin) / 2.0;
        assert!((found / change - 1.0).abs() < 0.02, "{found} {change}");
    }

    #[test]
    fn gains_are_those_of_the_exponential_function() {
        for i in -60..=60 {
            for k in -60..=60 {
                let nepers = Complex::new(f64::from(i), f64::from(k)) / 200.0;
                // The ninth term at 0.25, and f32 keeps 6e-8.
                let mut gains = [nepers, Complex::default()];
                exponentiate(&mut gains);
                let off = (gains[0] - nepers.exp()).norm();
                assert!(off < 1.1e-11 && gains[1] == Complex::new(1.0, 0.0), "{nepers}: {off}");
            }
        }
        let mut gains = [Complex::new(f64::NAN, 0.0)];
        exponentiate(&mut gains);
        assert!(gains[0].re.is_nan());
    }

    #[test]
    fn wrong_lengths_and_numbers_are_refused() {
        let correction = correction(smooth, 1);
        let mut scratch = correction.make_scratch();
        let air = REFERENCE.air();
        let pair = PairAir { response: air, direct: air, direct_m: DIRECT_M, reflected_m: REFLECTED_M };
        let mut out = correction.make_reflected();
        let zeros = [0.0; LEN];
        let mut broken = zeros;
        broken[3] = f64::NAN;
        let direct = correction.transform_response(zeros.to_vec(), &mut scratch).expect("a spectrum");
        let found = correction.subtract_direct(&zeros[1..], &direct, &pair, &mut out, &mut scratch);
        assert!(matches!(found, Err(Error::Length { .. })));
        let found = correction.subtract_direct(&broken, &direct, &pair, &mut out, &mut scratch);
        assert!(matches!(found, Err(Error::NotFinite { .. })));
        let found = correction.transform_response(broken.to_vec(), &mut scratch);
        assert!(matches!(found, Err(Error::NotFinite { .. })));
    }
}
