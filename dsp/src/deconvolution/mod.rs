//! Division of the recording by the loopback in the Fourier domain, within the sweep's range.

mod aligned;
mod joint;
mod pruned;
pub mod response_deconvolution;

use std::f64::consts::FRAC_PI_2;
use std::ops::{Range, RangeInclusive};
use std::sync::Arc;

pub use echolake_schema::SpectralDivision;
use realfft::num_complex::Complex;
use rustfft::{Fft, FftDirection};

use self::aligned::AlignedBuffer;
use self::joint::{BinPower, SignalLevels};
use self::pruned::PrunedInverse;
use crate::error::check_len;
use crate::{Error, RealSample};

/// Settings of a deconvolution.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DeconvolutionParams {
    /// Samples of recording and loopback.
    pub recording_len: usize,
    /// Samples of the response that are wanted, from its start.
    pub output_len: usize,
    /// Sampling rate, Hz.
    pub rate_hz: f64,
    /// Lowest frequency of the sweep, Hz.
    pub low_hz: f64,
    /// Highest frequency of the sweep, Hz.
    pub high_hz: f64,
    /// Treatment of frequencies at the limits of that range and beyond them.
    pub division: SpectralDivision,
    /// Width over which [`SpectralDivision::Tapered`] rises and falls, Hz.
    pub taper_hz: f64,
    /// Length of the transforms.
    pub length: TransformLength,
}

/// Length of the transforms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TransformLength {
    /// That of the recording, as in the reference; slow if it has large prime factors.
    Exact,
    /// Padded with zeros to the next even length without prime factors above 5.
    Fast,
}

/// Bins that are divided at a time.
const PIECE: usize = 64;

/// x / s in the Fourier domain (Rust et al. 2021, appendix, step 1).
///
/// recording `[recording_len]`, loopback `[recording_len]`  any unit, the same
/// ir        `[output_len]`                                 their ratio; sample 0 is the instant of emission
///
/// Inside of the sweep's range the division is exact. Outside, the sweep has next to no energy and plain
/// division would fill the lowest and the highest band with noise; [`SpectralDivision`] says what is done about it.
///
/// Both signals are real, so one complex transform of z = x + i s does for both: with the mirror image
/// b\[k\] = conj Z\[n - k\], X = (Z + b) / 2 and S = (Z - b) / 2i, and their quotient needs neither of them. It goes
/// straight to where the inverse transform, of the wanted samples only, reads it.
///
/// ```
/// use echolake_dsp::deconvolution::{DeconvolutionParams, DeconvolutionPlan, TransformLength};
/// use echolake_dsp::sweep::{SineSweep, SweepShape};
/// use echolake_schema::SpectralDivision;
///
/// let shape = SweepShape::Linear;
/// let sweep =
///     SineSweep { shape, rate_hz: 8e3, duration_secs: 0.064, low_hz: 100.0, high_hz: 3_900.0, fade_secs: 0.001 };
/// let loopback = sweep.samples();
/// let recording: Vec<f64> = (0..512).map(|n| if n < 3 { 0.0 } else { 0.5 * loopback[n - 3] }).collect();
/// let plan = DeconvolutionPlan::new(DeconvolutionParams {
///     recording_len: 512,
///     output_len: 8,
///     rate_hz: 8e3,
///     low_hz: 100.0,
///     high_hz: 3_900.0,
///     division: SpectralDivision::Floored { floor_db: -60.0 },
///     taper_hz: 0.0,
///     length: TransformLength::Fast,
/// })?;
/// let mut ir = [0.0; 8];
/// plan.deconvolve_recording(&recording, &loopback, &mut ir, &mut plan.make_scratch())?;
/// assert!((ir[3] - 0.5).abs() < 0.05, "{ir:?}");
/// # Ok::<(), echolake_dsp::Error>(())
/// ```
pub struct DeconvolutionPlan<T: RealSample> {
    recording_len: usize,
    output_len: usize,
    len: usize,
    forward: Arc<dyn Fft<T>>,
    inverse: PrunedInverse<T>,
    in_range: RangeInclusive<usize>,
    division: SpectralDivision,
    /// Distance of bins, the sweep's range, and the taper's width, Hz.
    step_hz: f64,
    range_hz: [f64; 2],
    taper_hz: f64,
}

/// Buffers of a [`DeconvolutionPlan`].
pub struct DeconvolutionScratch<T: RealSample> {
    /// `[len + 1]`: the transform of both signals, and its first bin again as the mirror image of itself.
    joint: AlignedBuffer<Complex<T>>,
    /// Scratch of the transforms; between them, the quotient. One buffer, as the cache has no room for two.
    work: AlignedBuffer<Complex<T>>,
    sums: Vec<Complex<T>>,
    /// Gains of both signals in the joint transform.
    gains: [f64; 2],
}

/// The transform of a recording and its loopback together, from which those of each follow.
pub struct JointSpectrum<'a, T> {
    joint: &'a [Complex<T>],
    gains: [f64; 2],
}

impl<T: RealSample> JointSpectrum<'_, T> {
    /// Returns the length of the transform.
    pub fn transform_len(&self) -> usize {
        self.joint.len() - 1
    }

    /// Replaces two spectra by those of the recording and the loopback, as transforms of real samples give them.
    ///
    /// recorded, looped `[transform_len / 2 + 1]`
    pub fn split_spectra(&self, recorded: &mut Vec<Complex<T>>, looped: &mut Vec<Complex<T>>) {
        let bins = self.transform_len() / 2 + 1;
        let [recording_scale, loopback_scale] = self.gains.map(|gain| T::of(0.5 / gain));
        let pairs = || self.joint[..bins].iter().zip(self.joint.iter().rev()).map(|(z, mirrored)| (z, mirrored.conj()));
        recorded.clear();
        recorded.extend(pairs().map(|(z, b)| (z + b) * recording_scale));
        looped.clear();
        looped.extend(pairs().map(|(z, b)| {
            let d = z - b;
            Complex::new(d.im, -d.re) * loopback_scale
        }));
    }
}

impl<T: RealSample> DeconvolutionPlan<T> {
    /// Plans the transforms.
    ///
    /// # Errors
    /// [`Error::Setting`] if there is nothing to transform or the range is empty.
    pub fn new(params: DeconvolutionParams) -> Result<Self, Error> {
        let setting = |what, actual: String, expected| Err(Error::Setting { what, actual, expected });
        if params.recording_len < 2 {
            return setting("the recording's length", params.recording_len.to_string(), "2 samples or more");
        }
        if let SpectralDivision::Floored { floor_db } = params.division
            && !floor_db.is_finite()
        {
            return setting("the divisor's floor (dB)", floor_db.to_string(), "a finite level");
        }
        if !(params.taper_hz >= 0.0 && params.taper_hz.is_finite()) {
            return setting("the taper's width (Hz)", params.taper_hz.to_string(), "finite, 0 or more");
        }
        let n = match params.length {
            TransformLength::Exact => params.recording_len,
            TransformLength::Fast => fast_length(params.recording_len),
        };
        let step = params.rate_hz / n as f64;
        let first = (params.low_hz / step).ceil().max(0.0) as usize;
        let last = ((params.high_hz / step).floor() as usize).min(n / 2);
        if !(step > 0.0 && step.is_finite() && params.low_hz >= 0.0) || first > last {
            let range = format!("{} to {} Hz at {} Hz", params.low_hz, params.high_hz, params.rate_hz);
            return setting("the sweep's range", range, "one that holds a frequency of the transform");
        }
        Ok(Self {
            recording_len: params.recording_len,
            output_len: params.output_len,
            len: n,
            forward: T::plan_fft(n, FftDirection::Forward),
            inverse: PrunedInverse::new(n, params.output_len),
            in_range: first..=last,
            division: params.division,
            step_hz: step,
            range_hz: [params.low_hz, params.high_hz],
            taper_hz: params.taper_hz,
        })
    }

    /// Buffers for [`Self::deconvolve_recording`]; one per thread.
    pub fn make_scratch(&self) -> DeconvolutionScratch<T> {
        let work = self.forward.get_inplace_scratch_len();
        let work = work.max(self.inverse.spectrum_len() + self.inverse.scratch_len());
        DeconvolutionScratch {
            joint: AlignedBuffer::new(self.len + 1),
            work: AlignedBuffer::new(work),
            sums: self.inverse.make_sums(),
            gains: [f64::NAN; 2],
        }
    }

    /// Returns the spectrum of what was deconvolved last with these buffers.
    pub fn joint_spectrum<'a>(&self, scratch: &'a mut DeconvolutionScratch<T>) -> JointSpectrum<'a, T> {
        JointSpectrum { gains: scratch.gains, joint: scratch.joint.values() }
    }

    /// Samples of the response that a run gives.
    pub fn output_len(&self) -> usize {
        self.output_len
    }

    /// Deconvolves one recording.
    ///
    /// # Errors
    /// [`Error::Length`], [`Error::NoLoopback`], or [`Error::NotFinite`].
    pub fn deconvolve_recording(
        &self,
        recording: &[T],
        loopback: &[T],
        ir: &mut [T],
        scratch: &mut DeconvolutionScratch<T>,
    ) -> Result<(), Error> {
        self.run_within(self.range_hz, recording, loopback, ir, scratch)
    }

    /// Deconvolves one recording; [`SpectralDivision::Tapered`] tapers at these limits within the sweep's range.
    ///
    /// # Errors
    /// [`Error::Length`], [`Error::NoLoopback`], or [`Error::NotFinite`].
    pub fn run_within(
        &self,
        limits_hz: [f64; 2],
        recording: &[T],
        loopback: &[T],
        ir: &mut [T],
        scratch: &mut DeconvolutionScratch<T>,
    ) -> Result<(), Error> {
        check_len("the recording", recording.len(), self.recording_len)?;
        check_len("the loopback", loopback.len(), self.recording_len)?;
        check_len("the response", ir.len(), self.output_len)?;
        let DeconvolutionScratch { joint, work, sums, gains } = scratch;
        let joint = joint.values();
        let work = work.values();
        let levels = SignalLevels::from_signals(recording, loopback)?;
        *gains = levels.gains;
        self.transform_jointly(recording, loopback, levels.gains.map(T::of), joint, work);
        let (quotient, work) = work.split_at_mut(self.inverse.spectrum_len());
        self.divide_spectra(limits_hz, joint, levels.rounding, quotient)?;
        let kept = ir.len().min(self.len);
        let (ir, rest) = ir.split_at_mut(kept);
        self.inverse.compute_samples(
            quotient,
            T::of(levels.gains[1] / levels.gains[0] / self.len as f64),
            ir,
            sums,
            work,
        );
        rest.fill(T::default());
        // Finite samples can still be too large for a spectrum; that spoils every sample of the response.
        if ir.iter().all(|x| x.f64().is_finite()) { Ok(()) } else { Err(Error::NotFinite { what: "the response" }) }
    }

    // Z of both signals times their gains, x + i s.
    fn transform_jointly(&self, x: &[T], s: &[T], gains: [T; 2], joint: &mut [Complex<T>], work: &mut [Complex<T>]) {
        let [x_gain, s_gain] = gains;
        for (z, (x, s)) in joint.iter_mut().zip(x.iter().zip(s)) {
            *z = Complex::new(*x * x_gain, *s * s_gain);
        }
        joint[self.recording_len..].fill(Complex::default());
        self.forward.process_with_scratch(&mut joint[..self.len], work);
        joint[self.len] = joint[0];
    }

    // Lays X / S for the inverse transform: first the bins in range, because a floor follows from them.
    fn divide_spectra(
        &self,
        limits_hz: [f64; 2],
        joint: &[Complex<T>],
        rounding: f64,
        quotient: &mut [Complex<T>],
    ) -> Result<(), Error> {
        let first = *self.in_range.start();
        let end = *self.in_range.end() + 1;
        let power = self.divide_bins(first..end, T::default(), |_| T::of(1.0), joint, quotient);
        let mean = power.power_sum() / (end - first) as f64;
        // One sample that is not finite spoils all bins.
        if !mean.is_finite() {
            return Err(Error::NotFinite { what: "the recording or the loopback" });
        }
        if !(mean > rounding && power.least_power() > 0.0) {
            return Err(Error::NoLoopback);
        }
        let beyond = [0..first, end..self.len / 2 + 1];
        let floor = match self.division {
            SpectralDivision::Tapered => {
                // A half cosine from the limits on, over half of the range at most.
                let [low_hz, high_hz] = limits_hz;
                let width_hz = self.taper_hz.min((high_hz - low_hz) / 2.0);
                let gain = |bin: usize| {
                    let hz = bin as f64 * self.step_hz;
                    let inside = ((hz - low_hz).min(high_hz - hz) / width_hz).clamp(0.0, 1.0);
                    T::of((FRAC_PI_2 * inside).sin().powi(2))
                };
                // The bins that are not wholly inside.
                let rising = (((low_hz + width_hz) / self.step_hz).ceil() as usize).clamp(first, end);
                let falling = (((high_hz - width_hz) / self.step_hz).ceil() as usize).clamp(rising, end);
                self.divide_bins(first..rising, T::default(), gain, joint, quotient);
                self.divide_bins(falling..end, T::default(), gain, joint, quotient);
                beyond.into_iter().for_each(|bins| self.silence_bins(bins, quotient));
                return Ok(());
            }
            SpectralDivision::Floored { floor_db } => T::of(mean * 10f64.powf(floor_db / 10.0)),
            // A bin without any power, as the first one may be, counts as rounding.
            SpectralDivision::Literal => T::of(rounding),
        };
        if floor <= T::default() {
            return Err(Error::NoLoopback);
        }
        for bins in beyond {
            self.divide_bins(bins, floor, |_| T::of(1.0), joint, quotient);
        }
        Ok(())
    }

    fn silence_bins(&self, bins: Range<usize>, quotient: &mut [Complex<T>]) {
        for first in bins.clone().step_by(PIECE) {
            self.inverse.lay_bins(first, &[Complex::default(); PIECE][..PIECE.min(bins.end - first)], quotient);
        }
    }

    // Divides with the divisor's power raised to `floor`, times `gain` of the bin; returns the power before it is
    // raised, times 4.
    fn divide_bins(
        &self,
        bins: Range<usize>,
        floor: T,
        gain: impl Fn(usize) -> T,
        joint: &[Complex<T>],
        quotient: &mut [Complex<T>],
    ) -> BinPower<T> {
        let mut piece = [Complex::default(); PIECE];
        let mut powers = [T::default(); PIECE];
        let mut total = BinPower::none();
        for first in bins.clone().step_by(PIECE) {
            let count = PIECE.min(bins.end - first);
            // Mirror images are in the opposite order.
            let mirrored = joint[self.len + 1 - first - count..=self.len - first].iter().rev();
            let bins = joint[first..first + count].iter().zip(mirrored);
            for (i, ((z, mirrored), (to, power))) in bins.zip(piece.iter_mut().zip(&mut powers)).enumerate() {
                (*to, *power) = divide_bin(*z, *mirrored, gain(first + i), floor);
            }
            self.inverse.lay_bins(first, &piece[..count], quotient);
            total.add_powers(&powers[..count]);
        }
        total
    }
}

// Gain X / S of a bin and the bin of its mirror image, and the power of 2 S before it is raised to `floor`.
#[inline]
fn divide_bin<T: RealSample>(z: Complex<T>, mirrored: Complex<T>, gain: T, floor: T) -> (Complex<T>, T) {
    let b = mirrored.conj();
    // With d = Z - b = 2i S and u = Z + b = 2 X, X / S = i u conj(d) / |d|^2.
    let u = z + b;
    let d = z - b;
    let power = d.norm_sqr();
    let raised = gain / if power > floor { power } else { floor };
    (Complex::new((u.re * d.im - u.im * d.re) * raised, (u.re * d.re + u.im * d.im) * raised), power)
}

/// The least even length without prime factors above 5 that holds `len` samples.
pub fn fast_length(len: usize) -> usize {
    let smooth = |mut n: usize| {
        for factor in [2, 3, 5] {
            while n.is_multiple_of(factor) {
                n /= factor;
            }
        }
        n == 1
    };
    (len.max(2)..).find(|n| n.is_multiple_of(2) && smooth(*n)).unwrap_or(len)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fast_lengths() {
        for (len, expected) in [(1, 2), (2, 2), (7, 8), (11, 12), (487, 500), (5_760, 5_760), (48_961, 49_152)] {
            assert_eq!(fast_length(len), expected, "{len}");
        }
    }

    #[test]
    fn silence_and_nan_are_refused() {
        let plan = DeconvolutionPlan::<f32>::new(DeconvolutionParams {
            recording_len: 100,
            output_len: 10,
            rate_hz: 96e3,
            low_hz: 2e3,
            high_hz: 40e3,
            division: SpectralDivision::Floored { floor_db: -60.0 },
            taper_hz: 0.0,
            length: TransformLength::Fast,
        })
        .expect("a plan");
        let (mut ir, mut scratch) = (vec![0.0; 10], plan.make_scratch());
        let noise: Vec<f32> = (0..100).map(|i| ((i * 37) % 19) as f32 - 9.0).collect();
        assert_eq!(plan.deconvolve_recording(&noise, &[0.0; 100], &mut ir, &mut scratch), Err(Error::NoLoopback));
        let mut broken = noise.clone();
        broken[50] = f32::NAN;
        assert!(matches!(
            plan.deconvolve_recording(&broken, &noise, &mut ir, &mut scratch),
            Err(Error::NotFinite { .. })
        ));
        assert!(matches!(
            plan.deconvolve_recording(&noise[1..], &noise, &mut ir, &mut scratch),
            Err(Error::Length { .. })
        ));
        // Finite, but its power is past what an f32 holds.
        let loud: Vec<f32> = noise.iter().map(|x| x * 1e20).collect();
        assert!(matches!(
            plan.deconvolve_recording(&noise, &loud, &mut ir, &mut scratch),
            Err(Error::NotFinite { .. })
        ));
        assert!(matches!(plan.deconvolve_recording(&loud, &loud, &mut ir, &mut scratch), Err(Error::NotFinite { .. })));
        let faint: Vec<f32> = noise.iter().map(|x| x * 1e-30).collect();
        assert_eq!(plan.deconvolve_recording(&noise, &faint, &mut ir, &mut scratch), Err(Error::NoLoopback));
        plan.deconvolve_recording(&noise, &noise, &mut ir, &mut scratch).expect("good after bad");
        assert!((ir[0] - ir.iter().copied().fold(0.0, f32::max)).abs() < 1e-6, "{ir:?}");
    }

    // One of the signals is a million times as loud, and the length is even or odd.
    #[test]
    fn the_spectra_of_both_signals_follow_from_the_joint_one() {
        for recording_len in [128, 135] {
            let plan = DeconvolutionPlan::<f64>::new(DeconvolutionParams {
                recording_len,
                output_len: 10,
                rate_hz: 96e3,
                low_hz: 2e3,
                high_hz: 40e3,
                division: SpectralDivision::Tapered,
                taper_hz: 0.0,
                length: TransformLength::Exact,
            })
            .expect("a plan");
            let noise = |seed: usize| move |n: usize| ((n * seed) % 101) as f64 - 50.0;
            let recording: Vec<f64> = (0..recording_len).map(noise(37)).collect();
            let loopback: Vec<f64> = (0..recording_len).map(noise(59)).map(|x| 1e-6 * x).collect();
            let (mut ir, mut scratch) = (vec![0.0; 10], plan.make_scratch());
            plan.deconvolve_recording(&recording, &loopback, &mut ir, &mut scratch).expect("a response");
            let (mut recorded, mut looped) = (vec![Complex::default(); 3], Vec::new());
            let joint = plan.joint_spectrum(&mut scratch);
            assert_eq!(joint.transform_len(), recording_len);
            joint.split_spectra(&mut recorded, &mut looped);
            for (signal, spectrum, level) in [(recording, recorded, 1.0), (loopback, looped, 1e-6)] {
                assert_eq!(spectrum.len(), recording_len / 2 + 1);
                for (k, z) in spectrum.iter().enumerate() {
                    let cycles = |n: usize| ((k * n) % recording_len) as f64 / recording_len as f64;
                    let turn = |n: usize| Complex::from_polar(1.0, -std::f64::consts::TAU * cycles(n));
                    let expected: Complex<f64> = signal.iter().enumerate().map(|(n, x)| turn(n) * x).sum();
                    assert!((z - expected).norm() < 1e-10 * level, "{recording_len}, {k}: {z}, expected {expected}");
                }
            }
        }
    }

    #[test]
    fn settings_without_a_meaning_are_refused() {
        let good = DeconvolutionParams {
            recording_len: 100,
            output_len: 10,
            rate_hz: 96e3,
            low_hz: 2e3,
            high_hz: 40e3,
            division: SpectralDivision::Floored { floor_db: -60.0 },
            taper_hz: 0.0,
            length: TransformLength::Exact,
        };
        assert!(DeconvolutionPlan::<f32>::new(good).is_ok());
        for bad in [
            DeconvolutionParams { recording_len: 1, ..good },
            DeconvolutionParams { rate_hz: 0.0, ..good },
            DeconvolutionParams { rate_hz: f64::NAN, ..good },
            DeconvolutionParams { rate_hz: f64::INFINITY, ..good },
            DeconvolutionParams { low_hz: f64::NAN, ..good },
            DeconvolutionParams { low_hz: 41e3, ..good },
            DeconvolutionParams { high_hz: f64::NAN, ..good },
            DeconvolutionParams { division: SpectralDivision::Floored { floor_db: f64::NAN }, ..good },
            DeconvolutionParams { division: SpectralDivision::Floored { floor_db: f64::NEG_INFINITY }, ..good },
            DeconvolutionParams { taper_hz: f64::NAN, ..good },
            DeconvolutionParams { taper_hz: -1.0, ..good },
        ] {
            assert!(matches!(DeconvolutionPlan::<f32>::new(bad), Err(Error::Setting { .. })), "{bad:?}");
        }
    }

    // In range the tapered quotient is the floored one times the taper, beyond it there is nothing.
    #[test]
    fn a_tapered_quotient_is_the_floored_one_times_the_taper() {
        let (len, rate_hz, low_hz, high_hz, taper_hz) = (1_000, 96e3, 2_000.0, 40_000.0, 500.0);
        let loopback: Vec<f64> = (0..len).map(|i| f64::from((i as u32 * 7919) % 1013) - 506.0).collect();
        let recording: Vec<f64> = (0..len).map(|i| f64::from((i as u32 * 104_729) % 997) - 498.0).collect();
        let spectrum = |division| {
            let length = TransformLength::Exact;
            let (recording_len, output_len) = (len, len);
            let plan = DeconvolutionPlan::<f64>::new(DeconvolutionParams {
                recording_len,
                output_len,
                rate_hz,
                low_hz,
                high_hz,
                division,
                taper_hz,
                length,
            })
            .expect("a plan");
            let mut ir = vec![0.0; len];
            plan.deconvolve_recording(&recording, &loopback, &mut ir, &mut plan.make_scratch()).expect("a response");
            let forward = f64::plan_real_forward(len);
            let mut bins = forward.make_output_vec();
            forward.process(&mut ir, &mut bins).expect("a spectrum");
            bins
        };
        let floored = spectrum(SpectralDivision::Floored { floor_db: SpectralDivision::FLOOR_DB });
        let literal = spectrum(SpectralDivision::Literal);
        let largest = floored.iter().map(|c| c.norm()).fold(0.0, f64::max);
        for (k, tapered) in spectrum(SpectralDivision::Tapered).iter().enumerate() {
            let hz = k as f64 * rate_hz / len as f64;
            let inside = ((hz - low_hz).min(high_hz - hz) / taper_hz).clamp(0.0, 1.0);
            let gain = (1.0 - (std::f64::consts::PI * inside).cos()) / 2.0;
            assert!((tapered - floored[k] * gain).norm() < 1e-9 * largest, "{hz} Hz: {tapered} {}", floored[k]);
            if (low_hz..=high_hz).contains(&hz) {
                assert!((literal[k] - floored[k]).norm() < 1e-9 * largest, "{hz} Hz: {}", literal[k]);
            }
        }
        let quotient = |k: usize| {
            let turn = |n: usize| Complex::from_polar(1.0, -std::f64::consts::TAU * (k * n % len) as f64 / len as f64);
            let sum = |x: &[f64]| x.iter().enumerate().map(|(n, x)| turn(n) * x).sum::<Complex<f64>>();
            sum(&recording) / sum(&loopback)
        };
        for k in [1, 7, 430, 499] {
            assert!((literal[k] / quotient(k) - 1.0).norm() < 1e-6, "bin {k}: {} {}", literal[k], quotient(k));
        }
    }

    // Odd and even lengths, with few samples wanted of many and with all: a delay comes out as one sample.
    #[test]
    fn a_delayed_recording_is_a_single_sample() {
        for (len, output_len) in [(99, 99), (99, 11), (100, 100), (100, 10), (487, 10), (500, 10), (2, 1), (3, 3)] {
            let plan = DeconvolutionPlan::<f64>::new(DeconvolutionParams {
                recording_len: len,
                output_len,
                rate_hz: 96e3,
                low_hz: 0.0,
                high_hz: 48e3,
                division: SpectralDivision::Floored { floor_db: -60.0 },
                taper_hz: 0.0,
                length: TransformLength::Exact,
            })
            .expect("a plan");
            let delay = 7 % output_len;
            let loopback: Vec<f64> = (0..len).map(|i| f64::from((i as u32 * 7919) % 101) - 33.0).collect();
            let recording: Vec<f64> = (0..len).map(|i| 0.5 * loopback[(i + len - delay) % len]).collect();
            let mut ir = vec![f64::NAN; output_len];
            plan.deconvolve_recording(&recording, &loopback, &mut ir, &mut plan.make_scratch()).expect("a response");
            for (n, x) in ir.iter().enumerate() {
                let expected = if n == delay { 0.5 } else { 0.0 };
                assert!((x - expected).abs() < 1e-10, "{len}, {output_len}: sample {n} is {x}");
            }
        }
    }

    // Both channels share a transform; the faint one must not drown in the rounding of the loud one.
    #[test]
    fn faint_channels_keep_their_precision() {
        let plan = DeconvolutionPlan::<f32>::new(DeconvolutionParams {
            recording_len: 4_096,
            output_len: 100,
            rate_hz: 96e3,
            low_hz: 2e3,
            high_hz: 40e3,
            division: SpectralDivision::Floored { floor_db: -60.0 },
            taper_hz: 0.0,
            length: TransformLength::Fast,
        })
        .expect("a plan");
        let loopback: Vec<f32> = (0..4_096u32).map(|i| ((i * 7919) % 1013) as f32 - 506.0).collect();
        let run = |gain: f32| {
            let recording: Vec<f32> = (0..4_096).map(|i| if i < 9 { 0.0 } else { gain * loopback[i - 9] }).collect();
            let mut ir = vec![f32::NAN; 100];
            plan.deconvolve_recording(&recording, &loopback, &mut ir, &mut plan.make_scratch()).expect("a response");
            ir.iter().map(|x| f64::from(x / gain)).collect::<Vec<_>>()
        };
        let even = run(1.0);
        for gain in [1e-6, 1e-3, 1e4] {
            let worst = run(gain).iter().zip(&even).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(worst < 1e-5, "{gain}: {worst}");
        }
    }

    // Zeros follow if more is requested than the transform holds.
    #[test]
    fn what_is_longer_than_the_transform_ends_in_zeros() {
        let plan = DeconvolutionPlan::<f64>::new(DeconvolutionParams {
            recording_len: 99,
            output_len: 120,
            rate_hz: 96e3,
            low_hz: 2e3,
            high_hz: 40e3,
            division: SpectralDivision::Floored { floor_db: -60.0 },
            taper_hz: 0.0,
            length: TransformLength::Exact,
        })
        .expect("a plan");
        let noise: Vec<f64> = (0..99).map(|i| f64::from((i * 37) % 19) - 9.0).collect();
        let mut ir = vec![f64::NAN; 120];
        plan.deconvolve_recording(&noise, &noise, &mut ir, &mut plan.make_scratch()).expect("a response");
        assert!(ir[..99].iter().all(|x| x.is_finite()));
        assert_eq!(&ir[99..], &[0.0; 21]);
    }
}
