//! Standard uncertainty of levels, from what the subtraction of the direct sound leaves.
//!
//! Speaker and microphone are never at the same place twice, the air is never the same, and the direct sound of two
//! runs differs by a delay and a gain. Their size is measured in each run, before the reflection arrives. What they do
//! to a level is linear in them for most measurements; squares are kept for those whose reflection is weak.

use std::f64::consts::LN_10;
use std::sync::Arc;

use realfft::ComplexToReal;
use realfft::num_complex::Complex;

use crate::error::check_len;
use crate::{Error, RealSample};

/// Least time between both arrivals of a pair that residuals are measured in, s.
const LEAST_SEPARATION_SECS: f64 = 0.35e-3;
/// Times before the reflection's arrival between which the measured part falls to nothing, s: the first parts of a
/// relief reflect before the plane does, by 0.17 ms if they stand 30 mm over it.
const GATE_SECS: [f64; 2] = [0.3e-3, 0.2e-3];
/// Time before the direct sound's arrival up to which there is noise alone, s.
const NOISE_SECS: f64 = 0.4e-3;
/// Least number of pairs for an estimate.
pub const LEAST_PAIRS: usize = 24;

/// One kind of error over a run's pairs: the part that all have in common, and the variance about it.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ErrorMoments {
    /// Mean over the pairs.
    pub mean: f64,
    /// Variance about the mean.
    pub variance: f64,
}

/// Difference between a run's direct sound and the one that is subtracted, and the noise.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct DirectSoundResidual {
    /// Relative gain.
    pub gain: ErrorMoments,
    /// Delay, samples.
    pub delay: ErrorMoments,
    /// Power density of the noise within the sweep's range: the mean square of a sample, were it the same everywhere.
    pub noise: f64,
}

/// Measures a run's [`DirectSoundResidual`].
///
/// ```
/// use echolake_dsp::Complex;
/// use echolake_dsp::uncertainty::ResidualFit;
///
/// let mut fit = ResidualFit::<f64>::new(384, 96e3, [2e3, 40e3])?;
/// // The spectrum of a sample of 1, the 80th of 384, and of 1 % of it.
/// let turn = std::f64::consts::TAU * 80.0 / 384.0;
/// let direct: Vec<_> = (0..193).map(|bin| Complex::from_polar(1.0, -turn * f64::from(bin))).collect();
/// let reflected: Vec<_> = direct.iter().map(|x| 0.01 * x).collect();
/// let of_pair = fit.prepare_direct(&direct, 80.0 / 96e3, 200.0 / 96e3)?;
/// for _ in 0..24 {
///     assert!(fit.add_pair(&reflected, &of_pair)?);
/// }
/// let residual = fit.finish().ok_or("24 pairs are enough")?;
/// assert!((residual.gain.mean - 0.01).abs() < 1e-9 && residual.delay.mean.abs() < 1e-9);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct ResidualFit<T: RealSample> {
    rate_hz: f64,
    len: usize,
    inverse: Arc<dyn ComplexToReal<T>>,
    /// Gain of each bin, over the number of samples: falls smoothly to nothing at the limits of the sweep's range, so
    /// that nothing rings from one arrival to the other.
    bin_gains: Vec<f64>,
    /// Power of what is left of noise, over its density.
    noise_share: f64,
    gains: ErrorSums,
    delays: ErrorSums,
    noise: (usize, f64),
    filtered: Vec<Complex<T>>,
    signal: Vec<T>,
    work: Vec<Complex<T>>,
}

/// The direct sound of a pair, as [`ResidualFit`] compares responses with it: the same for all runs.
#[derive(Debug, Clone, PartialEq)]
pub struct DirectSoundWaveform<T> {
    /// Samples of noise alone, before it arrives.
    quiet: usize,
    /// Direct sound within the sweep's range, and what a delay by a sample adds to it, both times the gate, up to its
    /// end. Empty if the reflection arrives too soon thereafter.
    gated: [Vec<T>; 2],
    /// Sums of products: of the direct sound with itself, of both, and of the delay's with itself.
    products: [f64; 3],
}

#[derive(Debug, Clone, Copy, Default)]
struct ErrorSums {
    count: usize,
    sum: f64,
    squares: f64,
}

/// Energy of a reflected response, and what gain and delay of the direct sound beneath it do to that energy.
///
/// The energy changes by `gain` times a gain, `gain_square` times its square, and the same of a delay in samples.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct EnergySensitivity {
    /// Energy.
    pub energy: f64,
    /// Change of the energy per relative gain.
    pub gain: f64,
    /// Change of the energy per square of a relative gain: the direct sound's energy.
    pub gain_square: f64,
    /// Change of the energy per sample of delay.
    pub delay: f64,
    /// Change of the energy per square of a delay.
    pub delay_square: f64,
    /// Change of the energy per kelvin that the air is warmer.
    pub temperature: f64,
    /// Standard uncertainty of the energy by its correction to the reference air, per logarithm of the ratio of speeds
    /// of sound.
    pub correction: f64,
}

/// Changes of the energy of a bin that its correction for the air leaves uncertain.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct EnergyChanges {
    /// Relative change per kelvin that the air is warmer.
    pub per_kelvin: f64,
    /// Relative standard uncertainty per logarithm of the ratio of speeds of sound.
    pub uncertainty_per_ratio: f64,
}

/// Error of a level relative to its energy, by what its measurements share.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LevelError {
    /// Common to a run's measurements.
    pub common: f64,
    /// Variance of the rest, which differs from measurement to measurement.
    pub variance: f64,
    /// Per kelvin that the run's air was warmer than its sensor says; the whole run has the same.
    pub own_per_kelvin: f64,
    /// The same of Flat's air.
    pub flat_per_kelvin: f64,
    /// Per logarithm of the ratio of speeds of sound that the run is corrected for; the whole run has the same.
    pub per_ratio: f64,
}

/// The residuals of a run and of Flat's, whose energies are divided by one another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LevelUncertainty {
    /// Residual of the run.
    pub run: DirectSoundResidual,
    /// Residual of Flat; None for the run that Flat's energies are from, whose levels have the errors of one side.
    pub flat: Option<DirectSoundResidual>,
    /// Standard uncertainty of the temperature of a run's air, K.
    pub temperature_k: f64,
    /// Mean logarithm of the speed of sound in the run's air over that in the reference air; 0 if energies are not
    /// corrected for it.
    pub ln_ratio: f64,
}

impl<T: RealSample> ResidualFit<T> {
    /// Begins with responses of `len` samples to sweeps of this range, Hz.
    ///
    /// # Errors
    /// [`Error::Setting`] for no samples, a rate that is not finite and above 0, or a range that is not below half of
    /// it.
    pub fn new(len: usize, rate_hz: f64, range_hz: [f64; 2]) -> Result<Self, Error> {
        if len == 0 || !(rate_hz.is_finite() && rate_hz > 0.0) {
            let actual = format!("{len} samples at {rate_hz} Hz");
            return Err(Error::Setting { what: "the response", actual, expected: "samples at some kHz" });
        }
        let [low, high] = range_hz;
        if !(0.0 <= low && low < high && 2.0 * high <= rate_hz) {
            let actual = format!("{low} to {high} Hz");
            return Err(Error::Setting { what: "the sweep's range", actual, expected: "up to half of the rate" });
        }
        let gain = |bin: usize| {
            let share = (bin as f64 * rate_hz / len as f64 - low) / (high - low);
            if (0.0..=1.0).contains(&share) { (std::f64::consts::PI * share).sin().powi(2) } else { 0.0 }
        };
        let smooth: Vec<f64> = (0..len / 2 + 1).map(gain).collect();
        let inverse = T::plan_real_inverse(len);
        Ok(Self {
            rate_hz,
            len,
            noise_share: 2.0 * smooth.iter().map(|gain| gain * gain).sum::<f64>() / len as f64,
            bin_gains: smooth.iter().map(|gain| gain / len as f64).collect(),
            gains: ErrorSums::default(),
            delays: ErrorSums::default(),
            noise: (0, 0.0),
            filtered: inverse.make_input_vec(),
            signal: inverse.make_output_vec(),
            work: inverse.make_scratch_vec(),
            inverse,
        })
    }

    /// Prepares a pair's direct sound by its spectrum `[len / 2 + 1]` and the arrivals of direct and reflected sound in
    /// the panel's plane, s. It serves every fit of the same settings.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn prepare_direct(
        &mut self,
        spectrum: &[Complex<T>],
        direct_secs: f64,
        reflected_secs: f64,
    ) -> Result<DirectSoundWaveform<T>, Error> {
        let quiet = ((direct_secs - NOISE_SECS) * self.rate_hz).clamp(0.0, self.len as f64) as usize;
        let mut waveform = DirectSoundWaveform { quiet, gated: [Vec::new(), Vec::new()], products: [0.0; 3] };
        if reflected_secs - direct_secs < LEAST_SEPARATION_SECS || !(direct_secs + reflected_secs).is_finite() {
            return Ok(waveform);
        }
        let gates: Vec<f64> = (0..self.len)
            .map(|n| gate_gain(n as f64 / self.rate_hz - reflected_secs, GATE_SECS))
            .take_while(|gate| *gate > 0.0)
            .collect();
        let len = self.len;
        let direct = self.filter_spectrum(spectrum, |_| Complex::new(1.0, 0.0))?.to_vec();
        let derivative = self.filter_spectrum(spectrum, |bin| Complex::new(0.0, bin_angle(bin, len)))?;
        let [mut dd, mut ds, mut ss] = [0.0; 3];
        for ((gate, d), s) in gates.iter().zip(&direct).zip(derivative) {
            let d = d.f64();
            let s = -s.f64();
            dd += gate * d * d;
            ds += gate * d * s;
            ss += gate * s * s;
        }
        // Otherwise arrivals at one another's side are not told apart.
        if dd * ss - ds * ds > 1e-6 * dd * ss {
            let gated = |signal: &[T], sign: f64| {
                gates.iter().zip(signal).map(|(gate, x)| T::of(sign * gate * x.f64())).collect()
            };
            waveform.gated = [gated(&direct, 1.0), gated(derivative, -1.0)];
            waveform.products = [dd, ds, ss];
        }
        Ok(waveform)
    }

    /// Adds a pair by the spectrum `[len / 2 + 1]` of its response without the direct sound. Returns false, and
    /// measures only the noise, if the reflection arrives too soon after the direct sound.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn add_pair(&mut self, reflected: &[Complex<T>], direct: &DirectSoundWaveform<T>) -> Result<bool, Error> {
        let reflected = self.filter_spectrum(reflected, |_| Complex::new(1.0, 0.0))?;
        let quiet = &reflected[..direct.quiet];
        let noise = T::dot_product(quiet, quiet);
        // Least squares of gain x direct - delay x derivative.
        let [xd, xs] = direct.gated.each_ref().map(|gated| T::dot_product(reflected, gated));
        self.noise.0 += direct.quiet;
        self.noise.1 += noise;
        if direct.gated[0].is_empty() {
            return Ok(false);
        }
        let [dd, ds, ss] = direct.products;
        let determinant = dd * ss - ds * ds;
        self.gains.add_value((xd * ss - xs * ds) / determinant);
        self.delays.add_value((xs * dd - xd * ds) / determinant);
        Ok(true)
    }

    /// Computes the moments; None of fewer than [`LEAST_PAIRS`].
    pub fn finish(&self) -> Option<DirectSoundResidual> {
        let (samples, squares) = self.noise;
        (self.gains.count >= LEAST_PAIRS).then(|| DirectSoundResidual {
            gain: self.gains.moments(),
            delay: self.delays.moments(),
            noise: if samples == 0 { 0.0 } else { squares / samples as f64 / self.noise_share },
        })
    }

    // The signal of a spectrum within the sweep's range, times a factor of each bin.
    fn filter_spectrum(
        &mut self,
        spectrum: &[Complex<T>],
        factor: impl Fn(usize) -> Complex<f64>,
    ) -> Result<&[T], Error> {
        check_len("the spectrum", spectrum.len(), self.bin_gains.len())?;
        let not_finite = Error::NotFinite { what: "the response" };
        if !spectrum[0].re.f64().is_finite() {
            return Err(not_finite);
        }
        let bins = self.filtered.iter_mut().zip(spectrum).zip(&self.bin_gains).enumerate();
        for (bin, ((filtered, x), gain)) in bins {
            let value = Complex::new(x.re.f64(), x.im.f64()) * factor(bin) * gain;
            *filtered = Complex::new(T::of(value.re), T::of(value.im));
        }
        // The ends of a real signal's spectrum are real.
        self.filtered[0].im = T::default();
        if self.len.is_multiple_of(2) {
            self.filtered[self.len / 2].im = T::default();
        }
        let done = self.inverse.process_with_scratch(&mut self.filtered, &mut self.signal, &mut self.work);
        done.map(|()| &self.signal[..]).map_err(|_| not_finite)
    }
}

/// Returns the gain so many seconds after a reflection's arrival that falls over half a cosine from 1 to 0 between two
/// times before it, s.
pub(crate) fn gate_gain(secs: f64, [from, to]: [f64; 2]) -> f64 {
    match (secs + from) / (from - to) {
        ..=0.0 => 1.0,
        fall @ 0.0..1.0 => 0.5 + 0.5 * (std::f64::consts::PI * fall).cos(),
        _ => 0.0,
    }
}

/// Returns a bin's angle per sample, by which a derivative multiplies it; half of the rate has none.
pub(crate) fn bin_angle(bin: usize, len: usize) -> f64 {
    if 2 * bin == len { 0.0 } else { std::f64::consts::TAU * bin as f64 / len as f64 }
}

impl ErrorSums {
    fn add_value(&mut self, value: f64) {
        self.count += 1;
        self.sum += value;
        self.squares += value * value;
    }

    fn moments(&self) -> ErrorMoments {
        let mean = self.sum / self.count as f64;
        ErrorMoments { mean, variance: (self.squares / self.count as f64 - mean * mean).max(0.0) }
    }
}

impl EnergySensitivity {
    /// Sums the sensitivities of bands to that of their sum.
    pub fn sum_of_bands(bands: &[Self]) -> Self {
        bands.iter().fold(Self::default(), |a, b| Self {
            energy: a.energy + b.energy,
            gain: a.gain + b.gain,
            gain_square: a.gain_square + b.gain_square,
            delay: a.delay + b.delay,
            delay_square: a.delay_square + b.delay_square,
            temperature: a.temperature + b.temperature,
            correction: a.correction + b.correction,
        })
    }
}

// Moments of an error, and the relative change of the energy per error and per its square.
fn gain_terms(residual: &DirectSoundResidual, s: &EnergySensitivity) -> (ErrorMoments, f64, f64) {
    (residual.gain, s.gain / s.energy, s.gain_square / s.energy)
}

fn delay_terms(residual: &DirectSoundResidual, s: &EnergySensitivity) -> (ErrorMoments, f64, f64) {
    (residual.delay, s.delay / s.energy, s.delay_square / s.energy)
}

impl LevelUncertainty {
    /// Computes the error of the energy of a measurement over Flat's, relative to it.
    pub fn relative_error(&self, of: &EnergySensitivity, flat: &EnergySensitivity) -> LevelError {
        let mut error = LevelError {
            variance: 4.0 * self.run.noise / of.energy,
            own_per_kelvin: of.temperature / of.energy,
            per_ratio: of.correction / of.energy,
            ..LevelError::default()
        };
        if let Some(residual) = &self.flat {
            error.variance += 4.0 * residual.noise / flat.energy;
            error.flat_per_kelvin = flat.temperature / flat.energy;
        }
        for kind in [gain_terms, delay_terms] {
            let (run, s, square) = kind(&self.run, of);
            // Whatever its sign, an error adds energy.
            error.common += run.mean * s + run.variance * square;
            error.variance += run.variance * s * s + 2.0 * (run.variance * square).powi(2);
            if let Some(residual) = &self.flat {
                let (of_flat, s_flat, square_flat) = kind(residual, flat);
                error.common -= of_flat.mean * s_flat + of_flat.variance * square_flat;
                // Both have Foam's error in them: half of the smaller variance.
                let shared = run.variance.min(of_flat.variance);
                error.variance += of_flat.variance * s_flat * s_flat - shared * s * s_flat;
            }
        }
        error
    }

    /// Computes the standard uncertainty of a level, dB; None without energy.
    pub fn level_db(&self, of: &EnergySensitivity, flat: &EnergySensitivity) -> Option<f64> {
        let db = self.combine_db(&self.relative_error(of, flat));
        (of.energy > 0.0 && flat.energy > 0.0 && db.is_finite()).then_some(db)
    }

    /// Combines the parts of an error to a standard uncertainty, dB.
    pub fn combine_db(&self, error: &LevelError) -> f64 {
        let temperature = error.own_per_kelvin.hypot(error.flat_per_kelvin) * self.temperature_k;
        let correction = error.per_ratio * self.ln_ratio;
        let squares = error.common.powi(2) + error.variance + temperature.powi(2) + correction.powi(2);
        10.0 / LN_10 * squares.sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chain::DerivationPlan;

    const LEN: usize = 384;
    const RATE_HZ: f64 = 96e3;
    const RANGE_HZ: [f64; 2] = [2e3, 40e3];

    // Sound of 2 to 40 kHz about a fraction of a sample.
    fn pulse(at: f64) -> Vec<f64> {
        let sample = |n: usize| {
            let x = n as f64 - at;
            let sinc = |edge_hz: f64| {
                let turns = 2.0 * edge_hz / RATE_HZ;
                if x.abs() < 1e-9 {
                    turns
                } else {
                    (std::f64::consts::PI * turns * x).sin() / (std::f64::consts::PI * x)
                }
            };
            (sinc(40e3) - sinc(2e3)) * (-(x / 60.0).powi(2)).exp()
        };
        (0..LEN).map(sample).collect()
    }

    fn spectrum(signal: &[f64]) -> Vec<Complex<f64>> {
        let forward = f64::plan_real_forward(signal.len());
        let mut spectrum = forward.make_output_vec();
        forward.process(&mut signal.to_vec(), &mut spectrum).expect("a spectrum");
        spectrum
    }

    fn sum(a: &[f64], factor: f64, b: &[f64]) -> Vec<f64> {
        a.iter().zip(b).map(|(a, b)| a + factor * b).collect()
    }

    #[test]
    fn energies_change_as_told_by_gain_and_delay() {
        let plan = DerivationPlan::new(LEN, RATE_HZ, &[2.5e3, 5e3, 10e3, 20e3, 40e3]).expect("a plan");
        let (direct, reflected) = (pulse(80.0), sum(&pulse(84.3), 0.2, &pulse(120.0)));
        let mut scratch = plan.make_scratch();
        let mut sensitivities = |signal: &[f64]| {
            let mut found = [EnergySensitivity::default(); 5];
            let by_air = |_| EnergyChanges { per_kelvin: 0.01, uncertainty_per_ratio: 0.8 };
            plan.compute_sensitivities(&spectrum(signal), &spectrum(&direct), by_air, &mut found, &mut scratch)
                .expect("sensitivities");
            found
        };
        let before = sensitivities(&reflected);
        assert!(before.iter().all(|band| (band.temperature / band.energy - 0.01).abs() < 1e-12), "{before:?}");
        assert!(before.iter().all(|band| (band.correction / band.energy - 0.8).abs() < 1e-12), "{before:?}");
        for (gain, delay) in [(0.02, 0.0), (0.0, 0.03)] {
            // The direct sound of the run, later and louder than what is subtracted.
            let left = sum(&sum(&pulse(80.0 + delay), gain, &direct), -1.0, &direct);
            let after = sensitivities(&sum(&reflected, 1.0, &left));
            for (before, after) in before.iter().zip(&after) {
                let linear = before.gain * gain + before.delay * delay;
                let square = before.gain_square * gain * gain + before.delay_square * delay * delay;
                let (told, found) = (linear + square, after.energy - before.energy);
                assert!((told - found).abs() < 1e-3 * before.energy, "{gain} {delay}: {told} {found}");
            }
        }
    }

    #[test]
    fn delays_and_gains_are_found_before_the_reflection_and_noise_before_all() {
        let mut fit = ResidualFit::<f64>::new(LEN, RATE_HZ, RANGE_HZ).expect("a fit");
        let noise = |n: usize, pair: usize| {
            let mixed = ((n + LEN * pair) as u32 ^ 0x5bd1_e995).wrapping_mul(0x9e37_79b1);
            let mixed = (mixed ^ (mixed >> 15)).wrapping_mul(0x85eb_ca6b);
            (f64::from(mixed ^ (mixed >> 13)) / f64::from(u32::MAX) * 2.0 - 1.0) * 1e-4
        };
        for pair in 0..40 {
            let (direct, at) = (pulse(80.0), 165.0 + pair as f64);
            let delay = if pair % 2 == 0 { 0.03 } else { 0.01 };
            let left = sum(&sum(&pulse(80.0 + delay), 0.005, &direct), -1.0, &direct);
            let mut reflected = sum(&left, 0.7, &pulse(at));
            reflected.iter_mut().enumerate().for_each(|(n, x)| *x += noise(n, pair));
            let waveform = fit.prepare_direct(&spectrum(&direct), 80.0 / RATE_HZ, at / RATE_HZ).expect("finite");
            assert_eq!(fit.add_pair(&spectrum(&reflected), &waveform), Ok(true));
        }
        let found = fit.finish().expect("40 pairs");
        assert!((found.delay.mean - 0.02).abs() < 0.001, "{found:?}");
        assert!((found.delay.variance.sqrt() - 0.01).abs() < 0.001, "{found:?}");
        assert!((found.gain.mean - 0.005).abs() < 0.001, "{found:?}");
        assert!((found.noise.sqrt() / 1e-4 - 0.577).abs() < 0.06, "{found:?}");
    }

    #[test]
    fn few_pairs_and_overlapping_arrivals_give_nothing() {
        let mut fit = ResidualFit::<f64>::new(LEN, RATE_HZ, RANGE_HZ).expect("a fit");
        let direct = spectrum(&pulse(80.0));
        let silence = spectrum(&[0.0; LEN]);
        let mut prepare = |signal: &[Complex<f64>], at: f64| fit.prepare_direct(signal, 80.0 / RATE_HZ, at / RATE_HZ);
        let apart = prepare(&direct, 160.0).expect("finite");
        let [near, silent] = [prepare(&direct, 110.0), prepare(&silence, 160.0)].map(|found| found.expect("finite"));
        assert!(matches!(prepare(&direct[1..], 160.0), Err(Error::Length { .. })));
        for _ in 1..LEAST_PAIRS {
            assert_eq!(fit.add_pair(&direct, &apart), Ok(true));
        }
        assert_eq!(fit.add_pair(&direct, &near), Ok(false));
        assert_eq!(fit.add_pair(&silence, &silent), Ok(false));
        assert!(matches!(fit.add_pair(&direct[1..], &apart), Err(Error::Length { .. })));
        let broken = vec![Complex::from(f64::NAN); direct.len()];
        assert!(matches!(fit.add_pair(&broken, &apart), Err(Error::NotFinite { .. })));
        assert!(fit.finish().is_none());
        for (len, rate_hz, range_hz) in [(0, RATE_HZ, RANGE_HZ), (9, f64::NAN, RANGE_HZ), (9, RATE_HZ, [2e3, 50e3])] {
            assert!(ResidualFit::<f32>::new(len, rate_hz, range_hz).is_err());
        }
    }

    #[test]
    fn common_errors_cancel_over_flat_and_stay_in_flat_itself() {
        let residual = DirectSoundResidual {
            gain: ErrorMoments { mean: 0.01, variance: 1e-4 },
            delay: ErrorMoments { mean: 0.01, variance: 1e-4 },
            noise: 1e-8,
        };
        let flat = EnergySensitivity {
            energy: 0.5,
            gain: 0.1,
            gain_square: 1.0,
            delay: 0.2,
            delay_square: 1.0,
            temperature: 0.001,
            correction: 0.4,
        };
        let mut levels = LevelUncertainty { run: residual, flat: Some(residual), temperature_k: 0.1, ln_ratio: 0.0 };
        let error = levels.relative_error(&flat, &flat);
        assert!(error.common.abs() < 1e-15 && error.own_per_kelvin == 0.002, "{error:?}");
        let db = levels.level_db(&flat, &flat).expect("a level");
        assert!((0.01..0.1).contains(&db), "{db}");
        assert_eq!(levels.level_db(&EnergySensitivity::default(), &flat), None);
        levels.ln_ratio = 0.01;
        assert!((levels.level_db(&flat, &flat).expect("a level").powi(2) - db * db - 0.0347f64.powi(2)).abs() < 1e-5);
        levels.flat = None;
        // Half of the variance: nothing is divided by.
        assert!((levels.relative_error(&flat, &flat).common - 0.0064).abs() < 1e-12);
    }
}
