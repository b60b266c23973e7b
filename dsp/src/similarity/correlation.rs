//! Similarity of two signals.

use std::sync::Arc;

use realfft::num_complex::Complex;
use realfft::{ComplexToReal, RealToComplex};

use crate::energy::energy;
use crate::error::check_len;
use crate::{Error, RealSample};

/// Sums that are computed side by side.
const LANES: usize = 8;

/// Pearson's coefficient of correlation, -1 to 1. None if one does not vary, if there are fewer than two values, or if
/// one is not finite.
///
/// x, y  `[n]`
///
/// ```
/// let r = echolake_dsp::correlation::pearson(&[1.0, 2.0, 4.0], &[-1.0, -3.0, -7.0])?;
/// assert!(r.is_some_and(|r| (r + 1.0).abs() < 1e-12));
/// # Ok::<(), echolake_dsp::Error>(())
/// ```
///
/// # Errors
/// [`Error::Length`] if they are not equally long.
pub fn pearson<T: RealSample>(x: &[T], y: &[T]) -> Result<Option<f64>, Error> {
    check_len("the second signal", y.len(), x.len())?;
    let count = x.len() as f64;
    let mean_x = sum_terms(x, x, |x, _| x) / count;
    let mean_y = sum_terms(y, y, |y, _| y) / count;
    let xx = sum_terms(x, x, |x, _| (x - mean_x) * (x - mean_x));
    let yy = sum_terms(y, y, |y, _| (y - mean_y) * (y - mean_y));
    let xy = sum_terms(x, y, |x, y| (x - mean_x) * (y - mean_y));
    // Of equal values, the rounding of their sum alone is left, up to count times that of one.
    let varies = |sum: f64, mean: f64| sum.is_finite() && sum > count * (count * f64::EPSILON * mean).powi(2);
    if !(varies(xx, mean_x) && varies(yy, mean_y)) {
        return Ok(None);
    }
    Ok(Some((xy / xx.sqrt() / yy.sqrt()).clamp(-1.0, 1.0)))
}

/// Root mean square of the differences of two signals, in their unit. None of no samples, or if it is not finite.
///
/// x, y  `[n]`
///
/// ```
/// let difference = echolake_dsp::correlation::rms_difference(&[1.0, 2.0], &[4.0, -2.0])?;
/// assert!(difference.is_some_and(|rms| (rms - 12.5f64.sqrt()).abs() < 1e-12));
/// # Ok::<(), echolake_dsp::Error>(())
/// ```
///
/// # Errors
/// [`Error::Length`] if they are not equally long.
pub fn rms_difference<T: RealSample>(x: &[T], y: &[T]) -> Result<Option<f64>, Error> {
    check_len("the second signal", y.len(), x.len())?;
    let square = sum_terms(x, y, |x, y| (x - y) * (x - y));
    Ok(Some((square / x.len() as f64).sqrt()).filter(|rms| rms.is_finite()))
}

// Sums a term of each pair of samples, in several sums that do not wait for each other.
fn sum_terms<T: RealSample>(x: &[T], y: &[T], term: impl Fn(f64, f64) -> f64) -> f64 {
    let mut sums = [0.0; LANES];
    let (x_blocks, x_rest) = x.as_chunks::<LANES>();
    let (y_blocks, y_rest) = y.as_chunks::<LANES>();
    for (x, y) in x_blocks.iter().zip(y_blocks) {
        for k in 0..LANES {
            sums[k] += term(x[k].f64(), y[k].f64());
        }
    }
    let rest: f64 = x_rest.iter().zip(y_rest).map(|(x, y)| term(x.f64(), y.f64())).sum();
    sums.iter().sum::<f64>() + rest
}

/// Spearman's coefficient of correlation: Pearson's of the ranks, so that it is 1 for any rising relation and one
/// outlier counts no more than another value. Equal values have their mean rank. None as of [`pearson`].
///
/// x, y  `[n]`
///
/// ```
/// let r = echolake_dsp::correlation::spearman(&[1.0, 2.0, 3.0, 4.0], &[1.0, 10.0, 100.0, 1e9])?;
/// assert!(r.is_some_and(|r| (r - 1.0).abs() < 1e-12));
/// # Ok::<(), echolake_dsp::Error>(())
/// ```
///
/// # Errors
/// [`Error::Length`] if they are not equally long.
pub fn spearman<T: RealSample>(x: &[T], y: &[T]) -> Result<Option<f64>, Error> {
    check_len("the second signal", y.len(), x.len())?;
    if x.iter().chain(y).any(|value| !value.f64().is_finite()) {
        return Ok(None);
    }
    pearson(&value_ranks(x), &value_ranks(y))
}

// Ranks from 0 on; equal values have their mean rank.
fn value_ranks<T: RealSample>(values: &[T]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|i, j| values[*i].f64().total_cmp(&values[*j].f64()));
    let mut ranks = vec![0.0; values.len()];
    let mut first = 0;
    for equal in order.chunk_by(|i, j| values[*i].f64() == values[*j].f64()) {
        let rank = first as f64 + (equal.len() - 1) as f64 / 2.0;
        equal.iter().for_each(|i| ranks[*i] = rank);
        first += equal.len();
    }
    ranks
}

/// Greatest cross-correlation of signals of one length over all shifts.
///
/// Signals are padded so that nothing wraps around.
///
/// ```
/// let plan = echolake_dsp::correlation::CorrelationPlan::new(4)?;
/// let mut scratch = plan.make_scratch();
/// let later_and_louder = plan.compute_similarity(&[1.0, 2.0, 0.0, 0.0], &[0.0, 0.0, 3.0, 6.0], &mut scratch)?;
/// assert!(later_and_louder.is_some_and(|x| (x - 1.0).abs() < 1e-9));
/// # Ok::<(), echolake_dsp::Error>(())
/// ```
pub struct CorrelationPlan<T: RealSample> {
    len: usize,
    forward: Arc<dyn RealToComplex<T>>,
    inverse: Arc<dyn ComplexToReal<T>>,
}

/// Buffers of a [`CorrelationPlan`].
pub struct CorrelationScratch<T> {
    signal: Vec<T>,
    spectra: [Vec<Complex<T>>; 2],
    work: Vec<Complex<T>>,
}

impl<T: RealSample> CorrelationPlan<T> {
    /// Plans for signals of `len` samples.
    ///
    /// # Errors
    /// [`Error::Setting`] for none.
    pub fn new(len: usize) -> Result<Self, Error> {
        if len == 0 {
            return Err(Error::Setting { what: "the signal's length", actual: "0".into(), expected: "1 or more" });
        }
        let padded = padded_len(2 * len - 1);
        Ok(Self { len, forward: T::plan_real_forward(padded), inverse: T::plan_real_inverse(padded) })
    }

    /// Buffers for [`Self::compute_similarity`]; one per thread.
    pub fn make_scratch(&self) -> CorrelationScratch<T> {
        let work = self.forward.get_scratch_len().max(self.inverse.get_scratch_len());
        CorrelationScratch {
            signal: self.forward.make_input_vec(),
            spectra: [self.forward.make_output_vec(), self.forward.make_output_vec()],
            work: vec![Complex::default(); work],
        }
    }

    /// max over m of sum_n x\[n\] y\[n + m\], over the root of both energies: 1 if one is the other, later or
    /// louder; at least 0 but for signals of a single sample. None if one has no energy.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn compute_similarity(
        &self,
        x: &[T],
        y: &[T],
        scratch: &mut CorrelationScratch<T>,
    ) -> Result<Option<f64>, Error> {
        let scales = [self.signal_scale("the first signal", x)?, self.signal_scale("the second signal", y)?];
        let [Some(x_scale), Some(y_scale)] = scales else { return Ok(None) };
        let CorrelationScratch { signal, spectra, work } = scratch;
        for ((values, scale), spectrum) in [(x, x_scale), (y, y_scale)].into_iter().zip(spectra.iter_mut()) {
            signal[self.len..].fill(T::default());
            signal.iter_mut().zip(values).for_each(|(to, from)| *to = T::of(from.f64() * scale));
            let done = self.forward.process_with_scratch(signal, spectrum, work);
            done.map_err(|_| Error::NotFinite { what: "a signal" })?;
        }
        let [first, second] = spectra;
        first.iter_mut().zip(&*second).for_each(|(x, y)| *x = x.conj() * *y);
        // Both ends are real already; only their rounding could be complained of.
        for edge in [0, first.len() - 1] {
            first[edge].im = T::default();
        }
        let done = self.inverse.process_with_scratch(first, signal, work);
        done.map_err(|_| Error::NotFinite { what: "a signal" })?;
        let greatest = signal.iter().fold(f64::NEG_INFINITY, |most, x| most.max(x.f64()));
        Ok(Some((greatest / signal.len() as f64).clamp(-1.0, 1.0)))
    }

    // Factor that scales a signal to an energy of 1; None if it has none.
    fn signal_scale(&self, what: &'static str, signal: &[T]) -> Result<Option<f64>, Error> {
        check_len(what, signal.len(), self.len)?;
        let energy = energy(signal);
        if !energy.is_finite() {
            return Err(Error::NotFinite { what });
        }
        Ok((energy > 0.0).then(|| energy.sqrt().recip()).filter(|scale| scale.is_finite()))
    }
}

/// The shortest length from `least` on that is a power of two, or three quarters of one: fast to transform, and even
/// but for 1, so that the last bin is real.
fn padded_len(least: usize) -> usize {
    let power = least.next_power_of_two();
    if power >= 8 && power / 4 * 3 >= least { power / 4 * 3 } else { power }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn linear_data_correlate_fully() {
        let x: Vec<f64> = (0..50).map(f64::from).collect();
        let y: Vec<f64> = x.iter().map(|x| 1e6 + 3.0 * x).collect();
        let falling: Vec<f64> = x.iter().map(|x| -0.5 * x).collect();
        assert!((pearson(&x, &y).expect("equally long").expect("one") - 1.0).abs() < 1e-12);
        assert!((pearson(&x, &falling).expect("equally long").expect("one") + 1.0).abs() < 1e-12);
        // Worked out on paper: deviations -1.5 -0.5 0.5 1.5 and -1 1 -1 1 give 2 / sqrt(5 x 4).
        let r = pearson(&[1.0, 2.0, 3.0, 4.0], &[0.0f32, 2.0, 0.0, 2.0]).expect("equally long");
        assert!((r.expect("one") - 2.0 / 20f64.sqrt()).abs() < 1e-12);
    }

    #[test]
    fn what_does_not_vary_has_no_correlation() {
        for (x, y) in [(&[][..], &[][..]), (&[1.0], &[2.0]), (&[0.1, 0.1, 0.1], &[1.0, 2.0, 3.0])] {
            assert_eq!((pearson(x, y), spearman(x, y)), (Ok(None), Ok(None)), "{x:?}");
        }
        assert_eq!(pearson(&[1.0, f64::NAN], &[1.0, 2.0]), Ok(None));
        assert_eq!(spearman(&[1.0, f64::NAN, 2.0], &[1.0, 2.0, 3.0]), Ok(None));
        assert_eq!(value_ranks(&[3.0, 1.0, 3.0, -0.0, 0.0]), [3.5, 2.0, 3.5, 0.5, 0.5]);
        assert!(matches!(pearson(&[1.0], &[1.0, 2.0]), Err(Error::Length { .. })));
    }

    // Against the plain sums, at lengths around whole blocks.
    #[test]
    fn sums_side_by_side_are_the_plain_ones() {
        for len in (2..=3 * LANES + 1).chain([383, 384, 385]) {
            let x: Vec<f32> = (0..len).map(|n| ((n * n * 7 + 3 * n) % 31) as f32 - 12.0).collect();
            let y: Vec<f32> = (0..len).map(|n| ((n * 13 + 5) % 23) as f32 * 0.37).collect();
            let count = len as f64;
            let pairs = || x.iter().zip(&y).map(|(x, y)| (f64::from(*x), f64::from(*y)));
            let square: f64 = pairs().map(|(x, y)| (x - y).powi(2)).sum();
            let found = rms_difference(&x, &y).expect("equally long").expect("finite");
            assert!((found - (square / count).sqrt()).abs() < 1e-12 * found, "{len}: {found}");
            let [sum_x, sum_y, sum_xx, sum_yy, sum_xy] =
                pairs().fold([0.0; 5], |[a, b, c, d, e], (x, y)| [a + x, b + y, c + x * x, d + y * y, e + x * y]);
            let r = (count * sum_xy - sum_x * sum_y)
                / ((count * sum_xx - sum_x * sum_x) * (count * sum_yy - sum_y * sum_y)).sqrt();
            let found = pearson(&x, &y).expect("equally long").expect("both vary");
            assert!((found - r).abs() < 1e-12, "{len}: {found} {r}");
        }
    }

    #[test]
    fn differences_are_numbers_or_none() {
        assert_eq!(rms_difference(&[0.0f32; 3], &[0.0; 3]), Ok(Some(0.0)));
        assert_eq!(rms_difference(&[f32::MAX; 9], &[-f32::MAX; 9]), Ok(Some(2.0 * f64::from(f32::MAX))));
        for (x, y) in [(&[][..], &[][..]), (&[1.0, f64::NAN], &[1.0, 2.0]), (&[f64::INFINITY], &[f64::INFINITY])] {
            assert_eq!(rms_difference(x, y), Ok(None), "{x:?}");
        }
        assert!(matches!(rms_difference(&[1.0], &[1.0, 2.0]), Err(Error::Length { actual: 2, expected: 1, .. })));
    }

    #[test]
    fn a_later_and_louder_copy_is_the_same() {
        for len in [1usize, 2, 7, 64, 384] {
            let plan = CorrelationPlan::<f32>::new(len).expect("a plan");
            let x: Vec<f32> = (0..len).map(|n| if n < len.div_ceil(2) { 1.0 + n as f32 } else { 0.0 }).collect();
            let shift = len / 2;
            let y: Vec<f32> = (0..len).map(|n| n.checked_sub(shift).map_or(0.0, |n| 7.0 * x[n])).collect();
            let mut scratch = plan.make_scratch();
            for (a, b) in [(&x, &y), (&y, &x), (&x, &x)] {
                let alike = plan.compute_similarity(a, b, &mut scratch).expect("finite").expect("some");
                assert!((alike - 1.0).abs() < 1e-5, "{len}: {alike}");
            }
            assert_eq!(plan.compute_similarity(&x, &vec![0.0; len], &mut scratch), Ok(None));
            assert!(plan.compute_similarity(&x, &vec![f32::NAN; len], &mut scratch).is_err());
        }
    }

    // Against the sum itself, at every shift.
    #[test]
    fn the_greatest_is_that_of_the_plain_sum() {
        let len = 31;
        let signal = |factor: u32| -> Vec<f64> { (0..len).map(|n| f64::from((n * factor + 11) % 37) - 18.0).collect() };
        let (x, y) = (signal(17), signal(29));
        let at = |shift: i32| -> f64 {
            let pairs =
                x.iter().enumerate().filter_map(|(n, x)| Some(x * y.get(usize::try_from(n as i32 + shift).ok()?)?));
            pairs.sum::<f64>()
        };
        let greatest = (-30..=30).map(at).fold(f64::NEG_INFINITY, f64::max);
        let plan = CorrelationPlan::<f64>::new(x.len()).expect("a plan");
        let alike = plan.compute_similarity(&x, &y, &mut plan.make_scratch()).expect("finite").expect("some");
        assert!((alike - greatest / (energy(&x) * energy(&y)).sqrt()).abs() < 1e-12);
    }

    #[test]
    fn padded_lengths_are_short_and_fast() {
        for (least, expected) in [(1, 1), (2, 2), (3, 4), (5, 6), (767, 768), (769, 1024)] {
            assert_eq!(padded_len(least), expected, "{least}");
        }
    }
}
