//! The octave-warped itersine filter bank: zero phase, circular, its gains' squares sum to 1.

use std::f64::consts::PI;
use std::ops::Range;
use std::sync::Arc;

use realfft::RealToComplex;
use realfft::num_complex::Complex;
use rustfft::{Fft, FftDirection};

use crate::energy::accumulate_couple;
use crate::error::check_len;
use crate::uncertainty::{EnergyChanges, EnergySensitivity, bin_angle};
use crate::{Error, RealSample};

/// The itersine window on |x| <= 1/2: sin(pi/2 cos^2(pi x)), 0 elsewhere.
///
/// The paper prints the cosine without its square; only with it do the squares of two windows half apart
/// sum to 1, as in PyGSP, GSPBox and LTFAT.
pub fn itersine(x: f64) -> f64 {
    if x.abs() > 0.5 { 0.0 } else { (PI / 2.0 * (PI * x).cos().powi(2)).sin() }
}

/// Gain of one band at a frequency. The first band takes all that is lower, the last all that is higher;
/// a band that is not there has none.
pub fn band_gain(centres_hz: &[f64], band: usize, frequency_hz: f64) -> f64 {
    let (Some(first), true) = (centres_hz.first(), band < centres_hz.len()) else { return 0.0 };
    let last = (centres_hz.len() - 1) as f64;
    let octaves = (frequency_hz.abs() / first).log2().clamp(0.0, last);
    itersine((octaves - band as f64) / 2.0)
}

/// Splits a signal into bands.
///
/// ir    `[len]`
/// bands `[centres x len]`, band after band
///
/// Band signals are real, so one complex inverse transform does for two, a + i b, with gains a + i b for its bins.
///
/// Source: Rust et al. 2021; Wesfreid and Wickerhauser 1993 for the window.
///
/// ```
/// let plan = echolake_dsp::filter_bank::FilterBankPlan::new(384, 96e3, &[5_000.0, 10_000.0, 20_000.0])?;
/// let mut ir = vec![0.0; 384];
/// ir[7] = 2.0;
/// let mut bands = vec![0.0; plan.band_count() * plan.len()];
/// plan.split_bands(&ir, &mut bands, &mut plan.make_scratch())?;
/// let energy: f64 = bands.iter().map(|x| x * x).sum();
/// assert!((energy - 4.0).abs() < 1e-9);
/// # Ok::<(), echolake_dsp::Error>(())
/// ```
pub struct FilterBankPlan<T: RealSample> {
    len: usize,
    bands: Vec<BandWeights>,
    couples: Vec<BandCouple<T>>,
    /// `[len/2 + 1]`: angle of each bin per sample.
    angles: Vec<f64>,
    forward: Arc<dyn RealToComplex<T>>,
    inverse: Arc<dyn Fft<T>>,
}

/// Weights by which a band takes the power of a spectrum.
struct BandWeights {
    /// Bins in which it has a gain, up to half of the rate.
    bins: Range<usize>,
    /// `[bins]`: square of the gain, over the number of samples; twice that for a bin with a mirror image.
    weights: Vec<f64>,
}

/// Values of one bin that are summed to an [`EnergySensitivity`], in the order of its fields.
type SensitivityTerms = [f64; 7];

/// Bins that are summed side by side.
const LANES: usize = 8;

const NOT_FINITE: Error = Error::NotFinite { what: "the response" };

/// Two bands that are transformed as one; the second is empty if the number of bands is odd.
struct BandCouple<T> {
    /// Bins in which at least one of them has a gain, up to half of the rate.
    bins: Range<usize>,
    /// `[bins]`: first + i second, over the number of samples.
    gains: Vec<Complex<T>>,
}

/// Buffers of a [`FilterBankPlan`].
pub struct FilterBankScratch<T> {
    signal: Vec<T>,
    spectrum: Vec<Complex<T>>,
    /// `[len/2 + 1]`.
    terms: Vec<SensitivityTerms>,
    /// `[couples x len]`.
    coupled: Vec<Complex<T>>,
    work: Vec<Complex<T>>,
}

impl<T: RealSample> FilterBankPlan<T> {
    /// Plans for signals of `len` samples; the centres are an octave apart, ascending.
    ///
    /// # Errors
    /// [`Error::Setting`] if they are not, or there are none.
    pub fn new(len: usize, rate_hz: f64, centres_hz: &[f64]) -> Result<Self, Error> {
        let octaves = centres_hz.windows(2).all(|w| (w[1] / w[0] - 2.0).abs() < 1e-6);
        if !octaves || !centres_hz.first().is_some_and(|hz| *hz > 0.0 && hz.is_finite()) {
            let actual = format!("{centres_hz:?}");
            return Err(Error::Setting { what: "the bands' centres", actual, expected: "frequencies an octave apart" });
        }
        if !(rate_hz > 0.0 && rate_hz.is_finite()) {
            let actual = rate_hz.to_string();
            return Err(Error::Setting { what: "the sampling rate (Hz)", actual, expected: "finite, above 0" });
        }
        if len == 0 {
            return Err(Error::Setting { what: "the signal's length", actual: "0".into(), expected: "1 or more" });
        }
        let frequency = |k: usize| k as f64 * rate_hz / len as f64;
        let bins = len / 2 + 1;
        let weights = |band| BandWeights::new(len, |k| T::of(band_gain(centres_hz, band, frequency(k))).f64());
        let bands: Vec<usize> = (0..centres_hz.len()).collect();
        let couple = |bands: &[usize]| {
            let scaled = |band: Option<&usize>, k| {
                T::of(band.map_or(0.0, |band| band_gain(centres_hz, *band, frequency(k)) / len as f64))
            };
            let at = |k: usize| Complex::new(scaled(bands.first(), k), scaled(bands.get(1), k));
            BandCouple::new((0..bins).map(at).collect())
        };
        Ok(Self {
            len,
            bands: bands.iter().copied().map(weights).collect(),
            couples: bands.chunks(2).map(couple).collect(),
            angles: (0..bins).map(|bin| bin_angle(bin, len)).collect(),
            forward: T::plan_real_forward(len),
            inverse: T::plan_fft(len, FftDirection::Inverse),
        })
    }

    /// Number of bands.
    pub fn band_count(&self) -> usize {
        self.bands.len()
    }

    /// Samples of a signal.
    #[allow(clippy::len_without_is_empty, reason = "a plan for no samples is refused")]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Buffers for [`Self::split_bands`]; one per thread.
    pub fn make_scratch(&self) -> FilterBankScratch<T> {
        let work = self.forward.get_scratch_len().max(self.inverse.get_inplace_scratch_len());
        FilterBankScratch {
            signal: self.forward.make_input_vec(),
            spectrum: self.forward.make_output_vec(),
            terms: vec![SensitivityTerms::default(); self.angles.len()],
            coupled: vec![Complex::default(); self.couples.len() * self.len],
            work: vec![Complex::default(); work],
        }
    }

    /// Splits one signal.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn split_bands(&self, ir: &[T], bands: &mut [T], scratch: &mut FilterBankScratch<T>) -> Result<(), Error> {
        check_len("the bands", bands.len(), self.bands.len() * self.len)?;
        self.compute_spectrum(ir, scratch)?;
        let spectrum = std::mem::take(&mut scratch.spectrum);
        let filtered = self.filter_couples(&spectrum, scratch);
        scratch.spectrum = spectrum;
        filtered?;
        let coupled = &scratch.coupled;
        for (out, coupled) in bands.chunks_mut(2 * self.len).zip(coupled.chunks_exact(self.len)) {
            let (first, second) = out.split_at_mut(self.len);
            first.iter_mut().zip(coupled).for_each(|(out, c)| *out = c.re);
            second.iter_mut().zip(coupled).for_each(|(out, c)| *out = c.im);
        }
        Ok(())
    }

    /// Computes the running energy of each band of a signal times a factor, and its energy, by the signal's spectrum.
    ///
    /// spectrum  `[len / 2 + 1]`, curves `[bands x len]`, energies `[bands]`
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn accumulate_bands(
        &self,
        spectrum: &[Complex<T>],
        factor: f64,
        curves: &mut [T],
        energies: &mut [f64],
        scratch: &mut FilterBankScratch<T>,
    ) -> Result<(), Error> {
        check_len("the curves", curves.len(), self.bands.len() * self.len)?;
        check_len("the energies", energies.len(), self.bands.len())?;
        self.filter_couples(spectrum, scratch)?;
        let coupled = scratch.coupled.chunks_exact(self.len);
        for ((curves, energies), coupled) in curves.chunks_mut(2 * self.len).zip(energies.chunks_mut(2)).zip(coupled) {
            let (first, second) = curves.split_at_mut(self.len);
            // The last couple of an odd number of bands has no second one.
            let second = if second.is_empty() { &mut scratch.signal[..] } else { second };
            let sums = accumulate_couple(coupled, factor, first, second);
            energies.iter_mut().zip(sums).for_each(|(energy, sum)| *energy = sum);
        }
        Ok(())
    }

    /// The same for a signal of samples `[len]`.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn accumulate_signal(
        &self,
        ir: &[T],
        factor: f64,
        curves: &mut [T],
        energies: &mut [f64],
        scratch: &mut FilterBankScratch<T>,
    ) -> Result<(), Error> {
        self.compute_spectrum(ir, scratch)?;
        let spectrum = std::mem::take(&mut scratch.spectrum);
        let done = self.accumulate_bands(&spectrum, factor, curves, energies, scratch);
        scratch.spectrum = spectrum;
        done
    }

    /// Energy of a signal in each band, by Parseval: no band is computed for it.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn compute_energies(
        &self,
        ir: &[T],
        energies: &mut [f64],
        scratch: &mut FilterBankScratch<T>,
    ) -> Result<(), Error> {
        check_len("the energies", energies.len(), self.bands.len())?;
        self.compute_spectrum(ir, scratch)?;
        self.spectrum_energies(&scratch.spectrum, energies);
        Ok(())
    }

    /// Computes the energy of a signal in each band from its spectrum.
    ///
    /// spectrum  `[len / 2 + 1]`, energies `[bands]`
    pub fn spectrum_energies(&self, spectrum: &[Complex<T>], energies: &mut [f64]) {
        for (band, energy) in self.bands.iter().zip(energies) {
            *energy = sum_powers(&spectrum[band.bins.clone()], &band.weights);
        }
    }

    /// Computes the energy of a signal in all bins from its spectrum `[len / 2 + 1]`.
    pub fn spectrum_energy(&self, spectrum: &[Complex<T>]) -> f64 {
        let power = |(bin, x): (usize, &Complex<T>)| bin_weight(bin, self.len) * x.norm_sqr().f64();
        spectrum.iter().enumerate().map(power).sum()
    }

    /// Energy of a reflected response in each band, and what errors of the direct sound beneath it do to that energy,
    /// and the air by its changes of each bin.
    ///
    /// reflected, direct  `[len / 2 + 1]`: their spectra
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn compute_sensitivities(
        &self,
        reflected: &[Complex<T>],
        direct: &[Complex<T>],
        by_air: impl Fn(usize) -> EnergyChanges,
        sensitivities: &mut [EnergySensitivity],
        scratch: &mut FilterBankScratch<T>,
    ) -> Result<(), Error> {
        check_len("the sensitivities", sensitivities.len(), self.bands.len())?;
        self.check_spectrum(reflected)?;
        self.check_spectrum(direct)?;
        let spectra = reflected.iter().zip(direct).zip(&self.angles);
        for ((bin, terms), ((x, d), angle)) in scratch.terms.iter_mut().enumerate().zip(spectra) {
            let product = x.conj() * d;
            let power = d.norm_sqr().f64();
            let energy = x.norm_sqr().f64();
            let gain = product.re.f64();
            // A delay adds minus the first derivative, and half of its square times the second.
            let delay = angle * product.im.f64();
            let air = by_air(bin);
            let [warmer, ratio] = [air.per_kelvin, air.uncertainty_per_ratio].map(|change| energy * change);
            *terms = [energy, 2.0 * gain, power, 2.0 * delay, angle * angle * (power - gain), warmer, ratio];
        }
        for (band, sensitivity) in self.bands.iter().zip(sensitivities) {
            let mut sums = SensitivityTerms::default();
            for (terms, weight) in scratch.terms[band.bins.clone()].iter().zip(&band.weights) {
                sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += weight * term);
            }
            let [energy, gain, gain_square, delay, delay_square, temperature, correction] = sums;
            *sensitivity =
                EnergySensitivity { energy, gain, gain_square, delay, delay_square, temperature, correction };
        }
        Ok(())
    }

    fn filter_couples(&self, spectrum: &[Complex<T>], scratch: &mut FilterBankScratch<T>) -> Result<(), Error> {
        self.check_spectrum(spectrum)?;
        let FilterBankScratch { coupled, work, .. } = scratch;
        for (couple, coupled) in self.couples.iter().zip(coupled.chunks_exact_mut(self.len)) {
            couple.filter_spectrum(spectrum, coupled);
        }
        self.inverse.process_with_scratch(coupled, work);
        Ok(())
    }

    fn compute_spectrum(&self, ir: &[T], scratch: &mut FilterBankScratch<T>) -> Result<(), Error> {
        check_len("the response", ir.len(), self.len)?;
        let FilterBankScratch { signal, spectrum, work, .. } = scratch;
        signal.copy_from_slice(ir);
        let done = self.forward.process_with_scratch(signal, spectrum, work);
        done.map_err(|_| NOT_FINITE)?;
        self.check_spectrum(spectrum)
    }

    // The first bin is the sum of all samples, and one that is not finite spoils it.
    fn check_spectrum(&self, spectrum: &[Complex<T>]) -> Result<(), Error> {
        check_len("the spectrum", spectrum.len(), self.angles.len())?;
        if spectrum[0].re.f64().is_finite() { Ok(()) } else { Err(NOT_FINITE) }
    }
}

impl BandWeights {
    fn new(len: usize, gain: impl Fn(usize) -> f64) -> Self {
        let weight = |bin| gain(bin).powi(2) * bin_weight(bin, len);
        let mut weights: Vec<f64> = (0..len / 2 + 1).map(weight).collect();
        let first = weights.iter().position(|weight| *weight > 0.0).unwrap_or(0);
        let end = weights.iter().rposition(|weight| *weight > 0.0).map_or(first, |last| last + 1);
        weights.truncate(end);
        Self { bins: first..end, weights: weights.split_off(first) }
    }
}

// Share of a bin's power in a signal's energy. A bin counts for its mirror image too, except 0 Hz and, if the length is
// even, the last one.
fn bin_weight(bin: usize, len: usize) -> f64 {
    let images = if bin == 0 || 2 * bin == len { 1.0 } else { 2.0 };
    images / len as f64
}

fn sum_powers<T: RealSample>(spectrum: &[Complex<T>], weights: &[f64]) -> f64 {
    let mut sums = [0.0; LANES];
    let (bins, last_bins) = spectrum.as_chunks::<LANES>();
    let (bin_weights, last_weights) = weights.as_chunks::<LANES>();
    for (bins, weights) in bins.iter().zip(bin_weights) {
        for ((sum, x), weight) in sums.iter_mut().zip(bins).zip(weights) {
            *sum += weight * x.norm_sqr().f64();
        }
    }
    let last = last_bins.iter().zip(last_weights).map(|(x, weight)| weight * x.norm_sqr().f64());
    sums.iter().sum::<f64>() + last.sum::<f64>()
}

impl<T: RealSample> BandCouple<T> {
    fn new(mut gains: Vec<Complex<T>>) -> Self {
        let used = |c: &Complex<T>| c.re != T::default() || c.im != T::default();
        let first = gains.iter().position(used).unwrap_or(0);
        let end = gains.iter().rposition(used).map_or(first, |last| last + 1);
        gains.truncate(end);
        Self { bins: first..end, gains: gains.split_off(first) }
    }

    // A bin k and its mirror image n - k: both bands are real, so it is conj X[k] with the same gains.
    fn filter_spectrum(&self, spectrum: &[Complex<T>], out: &mut [Complex<T>]) {
        let Range { start, end } = self.bins;
        let (low, high) = out.split_at_mut(spectrum.len());
        low[..start].fill(Complex::default());
        low[end..].fill(Complex::default());
        let bins = spectrum[start..end].iter().zip(&self.gains);
        low[start..end].iter_mut().zip(bins.clone()).for_each(|(out, (x, gain))| *out = x * gain);
        high.fill(Complex::default());
        // The first bin has no mirror image; nor has the last if the length is even, and `high` ends before it.
        let images = high.iter_mut().rev().skip(start.saturating_sub(1));
        images.zip(bins.skip(usize::from(start == 0))).for_each(|(out, (x, gain))| *out = x.conj() * gain);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAPER: [f64; 5] = [2_500.0, 5_000.0, 10_000.0, 20_000.0, 40_000.0];

    #[test]
    fn the_frame_is_tight_for_any_number_of_bands() {
        let audible: Vec<f64> = (0..10).map(|k| 31.25 * f64::from(1 << k)).collect();
        let lists = (1..=5).map(|count| &PAPER[..count]).chain([&audible[..]]);
        for centres in lists {
            for i in 0..10_000 {
                let hz = f64::from(i) * 4.8;
                let sum: f64 = (0..centres.len()).map(|b| band_gain(centres, b, hz).powi(2)).sum();
                assert!((sum - 1.0).abs() < 1e-14, "{} bands at {hz} Hz: {sum}", centres.len());
            }
            for (band, hz) in centres.iter().enumerate() {
                assert!((band_gain(centres, band, *hz) - 1.0).abs() < 1e-12, "{hz} Hz is the middle of its band");
            }
        }
    }

    #[test]
    fn energy_is_conserved_for_odd_and_even_lengths() {
        for len in [1, 2, 3, 383, 384, 399, 400, 401, 512, 997] {
            let plan = FilterBankPlan::<f64>::new(len, 96e3, &PAPER).expect("a plan");
            let ir: Vec<f64> = (0..len).map(|i| f64::from((i as u32 * 7919) % 101) - 50.0).collect();
            let (mut bands, mut scratch) = (vec![f64::NAN; 5 * len], plan.make_scratch());
            let mut energies = vec![f64::NAN; 5];
            plan.split_bands(&ir, &mut bands, &mut scratch).expect("split");
            plan.compute_energies(&ir, &mut energies, &mut scratch).expect("energies");
            let whole: f64 = ir.iter().map(|x| x * x).sum();
            let split: f64 = bands.iter().map(|x| x * x).sum();
            assert!((split / whole - 1.0).abs() < 1e-12, "{len}: {split} {whole}");
            for (band, energy) in bands.chunks_exact(len).zip(&energies) {
                let direct: f64 = band.iter().map(|x| x * x).sum();
                assert!((direct - energy).abs() <= 1e-12 * whole, "{len}: {direct} {energy}");
            }
            plan.compute_spectrum(&ir, &mut scratch).expect("a spectrum");
            let spectrum = &scratch.spectrum;
            assert!((plan.spectrum_energy(spectrum) / whole - 1.0).abs() < 1e-12, "{len}");
            // Bin by bin, in their order.
            for (number, energy) in energies.iter().enumerate() {
                let gain = |k: usize| band_gain(&PAPER, number, k as f64 * 96e3 / len as f64);
                let images = |k: usize| if k == 0 || 2 * k == len { 1.0 } else { 2.0 };
                let power = |(k, x): (usize, &Complex<f64>)| images(k) * (gain(k) * x.norm()).powi(2) / len as f64;
                let summed: f64 = spectrum.iter().enumerate().map(power).sum();
                assert!((summed - energy).abs() <= 1e-13 * whole, "{len}: {summed} {energy}");
            }
        }
    }

    #[test]
    fn centres_must_be_octaves() {
        for bad in [&[][..], &[1e3, 3e3], &[2e3, 1e3], &[0.0, 0.0], &[f64::NAN], &[f64::INFINITY], &[-1e3, -2e3]] {
            assert!(FilterBankPlan::<f32>::new(384, 96e3, bad).is_err(), "{bad:?}");
        }
        for bad in [0.0, -96e3, f64::NAN, f64::INFINITY] {
            assert!(FilterBankPlan::<f32>::new(384, bad, &PAPER).is_err(), "{bad} Hz");
        }
        assert!(FilterBankPlan::<f32>::new(0, 96e3, &PAPER).is_err());
        assert_eq!((band_gain(&[], 0, 1e3), band_gain(&PAPER, 5, 1e3)), (0.0, 0.0));
    }

    #[test]
    fn signals_that_are_not_finite_are_refused() {
        let plan = FilterBankPlan::<f32>::new(16, 96e3, &PAPER).expect("a plan");
        let (mut bands, mut energies, mut scratch) = (vec![0.0; 80], vec![0.0; 5], plan.make_scratch());
        for bad in [f32::NAN, f32::INFINITY] {
            let mut ir = [1.0; 16];
            ir[9] = bad;
            assert_eq!(plan.split_bands(&ir, &mut bands, &mut scratch), Err(Error::NotFinite { what: "the response" }));
            assert_eq!(
                plan.compute_energies(&ir, &mut energies, &mut scratch),
                Err(Error::NotFinite { what: "the response" })
            );
        }
    }

    // A single centre passes everything, whatever it is.
    #[test]
    fn one_band_is_the_signal() {
        for len in [1, 15, 16] {
            let plan = FilterBankPlan::<f64>::new(len, 48e3, &[1e3]).expect("a plan");
            let ir: Vec<f64> = (0..len).map(|i| f64::from(i as u32) - 3.5).collect();
            let mut bands = vec![f64::NAN; len];
            plan.split_bands(&ir, &mut bands, &mut plan.make_scratch()).expect("split");
            assert!(ir.iter().zip(&bands).all(|(a, b)| (a - b).abs() < 1e-12), "{len}: {bands:?}");
        }
    }
}
