//! The first samples of a real inverse transform, without the price of all the others.

use std::sync::Arc;

use realfft::num_complex::Complex;
use rustfft::{Fft, FftDirection};

use crate::RealSample;

/// Room behind each strand: rows of whole KiB would all fall into the same few lines of the cache.
const GAP: usize = 8;

/// x\[m\] = sum_k X\[k\] e^(2 pi i k m / n) for the first m only, X the spectrum of a real signal.
///
/// With k = r + p q, each r is a short inverse transform over q, a *strand*, of n / p samples:
/// x\[m\] = sum_r w^r (strand r)\[m\], w = e^(2 pi i m / n). The signal is real, so strand p - r is the conjugate
/// of strand r, and half of them are enough. Their sum is a polynomial in w, for which Horner's rule needs no
/// more twiddles than there are samples wanted.
pub(crate) struct PrunedInverse<T: RealSample> {
    strands: usize,
    strand_len: usize,
    inverse: Arc<dyn Fft<T>>,
    /// `[samples wanted]`: w of each sample.
    turns: Vec<Complex<T>>,
}

impl<T: RealSample> PrunedInverse<T> {
    pub fn new(n: usize, output_len: usize) -> Self {
        let strand_len = strand_len(n, output_len);
        let turn = |m: usize| {
            let (im, re) = (std::f64::consts::TAU * m as f64 / n as f64).sin_cos();
            Complex::new(T::of(re), T::of(im))
        };
        Self {
            strands: n / strand_len,
            strand_len,
            inverse: T::plan_fft(strand_len, FftDirection::Inverse),
            turns: (0..output_len.min(n)).map(turn).collect(),
        }
    }

    /// Values of the spectrum's strands, with the gaps between them.
    pub fn spectrum_len(&self) -> usize {
        (self.strands / 2 + 1) * (self.strand_len + GAP)
    }

    pub fn scratch_len(&self) -> usize {
        self.inverse.get_inplace_scratch_len()
    }

    /// Room for sums between strands.
    pub fn make_sums(&self) -> Vec<Complex<T>> {
        vec![Complex::default(); self.turns.len()]
    }

    /// Lays bins from `first` on, none of them past n / 2, into their strands; all from 0 to n / 2 must be laid.
    pub fn lay_bins(&self, first: usize, mut bins: &[Complex<T>], spectrum: &mut [Complex<T>]) {
        let mut q = first / self.strands;
        let mut r = first % self.strands;
        while !bins.is_empty() {
            let (now, later) = bins.split_at(bins.len().min(self.strands - r));
            self.lay_across(q, r, now, spectrum);
            (bins, q, r) = (later, q + 1, 0);
        }
    }

    // Bin q of strands r and on; the bin of a strand that is not kept counts for its mirror image, n - k.
    fn lay_across(&self, q: usize, r: usize, bins: &[Complex<T>], spectrum: &mut [Complex<T>]) {
        let p = self.strands;
        let row = self.strand_len + GAP;
        let last = self.strand_len - 1;
        let direct = spectrum.chunks_exact_mut(row).skip(r);
        direct.zip(bins).for_each(|(strand, bin)| strand[q] = *bin);
        let skipped = p.div_ceil(2).saturating_sub(r);
        if let Some(mirrored) = bins.get(skipped..).filter(|bins| !bins.is_empty()) {
            let images = spectrum[..(p - r - skipped + 1) * row].chunks_exact_mut(row).rev();
            images.zip(mirrored).for_each(|(strand, bin)| strand[last - q] = bin.conj());
        }
        if r == 0 && q > 0 {
            spectrum[self.strand_len - q] = bins[0].conj();
        }
    }

    /// Computes the samples, times `scale`; what was laid is used up.
    ///
    /// out `[samples wanted]`
    pub fn compute_samples(
        &self,
        spectrum: &mut [Complex<T>],
        scale: T,
        out: &mut [T],
        sums: &mut [Complex<T>],
        work: &mut [Complex<T>],
    ) {
        sums.fill(Complex::default());
        let rows = spectrum.chunks_exact_mut(self.strand_len + GAP).enumerate();
        for (r, row) in rows.rev() {
            let strand = &mut row[..self.strand_len];
            self.inverse.process_with_scratch(strand, work);
            let outputs = sums.iter_mut().zip(&*strand);
            if r == 0 {
                for (out, (sum, x)) in out.iter_mut().zip(outputs) {
                    *out = (T::of(2.0) * sum.re + x.re) * scale;
                }
                return;
            }
            // A strand that is its own mirror image counts once.
            let weight = T::of(if 2 * r == self.strands { 0.5 } else { 1.0 });
            for ((sum, x), w) in outputs.zip(&self.turns) {
                *sum = (*sum + x * weight) * w;
            }
        }
    }
}

/// Length of the strands: a divisor of n that holds the samples. Of those up to twice as long as the shortest it is
/// the one with the smallest odd part, as powers of two are transformed the fastest.
fn strand_len(n: usize, output_len: usize) -> usize {
    let divisors = || (output_len.max(1)..=n).filter(|len| n.is_multiple_of(*len));
    let shortest = divisors().next().unwrap_or(n);
    divisors().take_while(|len| *len <= 2 * shortest).min_by_key(|len| len >> len.trailing_zeros()).unwrap_or(n)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_those_of_the_whole_transform() {
        // Odd and even, with an odd and an even number of strands, and with a single one.
        for (n, output_len) in [(480, 30), (450, 30), (495, 33), (375, 20), (17, 5), (16, 16), (12, 20), (1, 1), (2, 1)]
        {
            let spectrum = |k: usize| {
                let edge = k == 0 || 2 * k == n;
                Complex::new(((k * 37) % 19) as f64 - 9.0, if edge { 0.0 } else { ((k * 53) % 23) as f64 - 11.0 })
            };
            let bins: Vec<_> = (0..=n / 2).map(spectrum).collect();
            let plan = PrunedInverse::new(n, output_len);
            let mut strands = vec![Complex::new(f64::NAN, f64::NAN); plan.spectrum_len()];
            // In two pieces, the later one first.
            let half = bins.len() / 2;
            plan.lay_bins(half, &bins[half..], &mut strands);
            plan.lay_bins(0, &bins[..half], &mut strands);
            let mut out = vec![f64::NAN; output_len];
            let mut work = vec![Complex::default(); plan.scratch_len()];
            plan.compute_samples(&mut strands, 1.0 / n as f64, &mut out, &mut plan.make_sums(), &mut work);
            for (m, x) in out.iter().take(n).enumerate() {
                let term = |k: usize| {
                    let weight = if k == 0 || 2 * k == n { 1.0 } else { 2.0 };
                    let angle = std::f64::consts::TAU * ((k * m) % n) as f64 / n as f64;
                    weight * (bins[k] * Complex::from_polar(1.0, angle)).re
                };
                let expected = (0..bins.len()).map(term).sum::<f64>() / n as f64;
                assert!((x - expected).abs() < 1e-11, "{n}, sample {m}: {x} {expected}");
            }
        }
    }

    #[test]
    fn strands_hold_the_samples_and_divide_the_length() {
        for (n, output_len, expected) in [(48_000, 431, 640), (49_152, 431, 512), (97, 5, 97), (8, 9, 8)] {
            assert_eq!(strand_len(n, output_len), expected, "{n}");
        }
    }
}
