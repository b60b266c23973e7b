//! Energy, its running sum along time, and both over Flat's.

use realfft::num_complex::Complex;
use wide::f64x2;

use crate::RealSample;
pub use crate::foam::subtract_foam;

/// Sum of squares.
pub fn energy<T: RealSample>(x: &[T]) -> f64 {
    T::dot_product(x, x)
}

/// Root of the mean square; 0 of no samples.
pub fn rms<T: RealSample>(x: &[T]) -> f64 {
    (energy(x) / x.len().max(1) as f64).sqrt()
}

/// Running sum of squares of one signal over `scale`: its NCE over Flat's total energy.
///
/// ir, curve  `[n]`
pub fn cumulate_whole<T: RealSample>(ir: &[T], scale: f64, curve: &mut [T]) {
    accumulate_energy(ir, scale.recip(), curve);
}

/// Running sum of squares of each band, summed up in f64.
///
/// bands, curves  `[bands x len]`
pub fn cumulative_energy<T: RealSample>(bands: &[T], curves: &mut [T], len: usize) {
    let len = len.max(1);
    for (band, curve) in bands.chunks_exact(len).zip(curves.chunks_exact_mut(len)) {
        accumulate_energy(band, 1.0, curve);
    }
}

/// Cumulative energy becomes NCE, in place: over Flat's total energy for the same pair. A Flat without energy
/// leaves values that are not finite.
pub fn nce<T: RealSample>(curves: &mut [T], flat_energy: f64) {
    curves.iter_mut().for_each(|x| *x = T::of(x.f64() / flat_energy));
}

/// TNCE, the last value of each NCE curve; returns their sum.
///
/// curves `[bands x len]`
/// out    `[bands]`
///
/// ```
/// use echolake_dsp::energy::{cumulative_energy, nce, tnce};
///
/// let mut curves = [0.0; 4];
/// cumulative_energy(&[1.0, 1.0, 2.0, 0.0], &mut curves, 2);
/// nce(&mut curves, 8.0);
/// assert_eq!(curves, [0.125, 0.25, 0.5, 0.5]);
/// let mut per_band = [0.0; 2];
/// assert_eq!((tnce(&curves, 2, &mut per_band), per_band), (0.75, [0.25, 0.5]));
/// ```
pub fn tnce<T: RealSample>(curves: &[T], len: usize, out: &mut [f64]) -> f64 {
    let last = curves.chunks_exact(len.max(1)).filter_map(<[T]>::last);
    let mut total = 0.0;
    for (out, last) in out.iter_mut().zip(last) {
        *out = last.f64();
        total += *out;
    }
    total
}

/// Energy of each band over Flat's of the same band. If Flat has none, the value is not finite.
///
/// energies, flat_energies, out  `[bands]`
pub fn tnce_over_band(energies: &[f64], flat_energies: &[f64], out: &mut [f64]) {
    out.iter_mut().zip(energies.iter().zip(flat_energies)).for_each(|(out, (energy, flat))| *out = energy / flat);
}

/// Samples that are summed up side by side.
const BLOCK: usize = 8;

/// Running sum of squares times `factor`; returns the sum itself.
///
/// Within a block the sums come from doubling (to each, the one 1, 2 and 4 before it), which leaves one dependent
/// addition a block instead of one a sample.
pub(crate) fn accumulate_energy<T: RealSample>(band: &[T], factor: f64, curve: &mut [T]) -> f64 {
    let (mut sum, (blocks, rest)) = (0.0, band.as_chunks::<BLOCK>());
    let (curve_blocks, curve_rest) = curve.as_chunks_mut::<BLOCK>();
    for (block, out) in blocks.iter().zip(curve_blocks) {
        let mut sums = block.map(|x| x.f64() * x.f64());
        for distance in [1, 2, 4] {
            let before = sums;
            for i in distance..BLOCK {
                sums[i] = before[i] + before[i - distance];
            }
        }
        for (out, within) in out.iter_mut().zip(&sums) {
            *out = T::of((sum + within) * factor);
        }
        sum += sums[BLOCK - 1];
    }
    for (x, out) in rest.iter().zip(curve_rest) {
        sum += x.f64() * x.f64();
        *out = T::of(sum * factor);
    }
    sum
}

/// Running sums of squares of two bands, the real and the imaginary parts of a signal, times `factor`; returns the sums
/// themselves.
///
/// coupled, first, second  `[len]`
///
/// Each is what [`accumulate_energy`] computes.
pub(crate) fn accumulate_couple<T: RealSample>(
    coupled: &[Complex<T>],
    factor: f64,
    first: &mut [T],
    second: &mut [T],
) -> [f64; 2] {
    let square = |x: &Complex<T>| {
        let x = f64x2::new([x.re.f64(), x.im.f64()]);
        x * x
    };
    let put = |sum: f64x2, first: &mut T, second: &mut T| [*first, *second] = (sum * factor).to_array().map(T::of);
    let mut sum = f64x2::ZERO;
    let (blocks, rest) = coupled.as_chunks::<BLOCK>();
    let (first_blocks, first_rest) = first.as_chunks_mut::<BLOCK>();
    let (second_blocks, second_rest) = second.as_chunks_mut::<BLOCK>();
    for (block, (first, second)) in blocks.iter().zip(first_blocks.iter_mut().zip(second_blocks)) {
        let mut sums: [f64x2; BLOCK] = std::array::from_fn(|i| square(&block[i]));
        for distance in [1, 2, 4] {
            let before = sums;
            for i in distance..BLOCK {
                sums[i] = before[i] + before[i - distance];
            }
        }
        for (within, (first, second)) in sums.iter().zip(first.iter_mut().zip(second)) {
            put(sum + *within, first, second);
        }
        sum += sums[BLOCK - 1];
    }
    for (x, (first, second)) in rest.iter().zip(first_rest.iter_mut().zip(second_rest)) {
        sum += square(x);
        put(sum, first, second);
    }
    sum.to_array()
}

#[cfg(test)]
mod tests {
    use super::*;

    // Two bands of three samples with squares that are exact: every number below can be checked on paper.
    const BANDS: [f64; 6] = [1.0, 2.0, 2.0, 0.0, -1.0, 3.0];

    #[test]
    fn curves_rise_to_each_bands_energy() {
        let mut curves = [f64::NAN; 6];
        cumulative_energy(&BANDS, &mut curves, 3);
        assert_eq!(curves, [1.0, 5.0, 9.0, 0.0, 1.0, 10.0]);
        nce(&mut curves, 20.0);
        let mut last = [f64::NAN; 2];
        assert!((tnce(&curves, 3, &mut last) - 0.95).abs() < 1e-15);
        assert_eq!(last, [0.45, 0.5]);
    }

    #[test]
    fn each_band_over_flats() {
        let mut over = [f64::NAN; 2];
        tnce_over_band(&[9.0, 10.0], &[18.0, 5.0], &mut over);
        assert_eq!(over, [0.5, 2.0]);
    }

    #[test]
    fn two_bands_at_once_are_each_by_itself() {
        for len in [0, 1, 7, 8, 30, 384] {
            let bands = [0.7, 1.9].map(|turn| (0..len).map(|n| (n as f32 * turn).sin()).collect::<Vec<f32>>());
            let coupled: Vec<_> = bands[0].iter().zip(&bands[1]).map(|(re, im)| Complex::new(*re, *im)).collect();
            let mut both = [vec![f32::NAN; len], vec![f32::NAN; len]];
            let [first, second] = &mut both;
            let sums = accumulate_couple(&coupled, 0.3, first, second);
            for ((band, curve), sum) in bands.iter().zip(&both).zip(sums) {
                let mut expected = vec![f32::NAN; len];
                assert_eq!(accumulate_energy(band, 0.3, &mut expected), sum, "{len}");
                assert_eq!(curve, &expected, "{len}");
            }
        }
    }

    // An f32 sum of a million equal squares would stall long before; ours is exact.
    #[test]
    fn long_sums_do_not_stall() {
        let band = vec![1.0f32; 20_000_000];
        let mut curve = vec![0.0f32; band.len()];
        cumulative_energy(&band, &mut curve, band.len());
        assert_eq!(curve.last(), Some(&20_000_000.0));
    }

    #[test]
    fn nothing_is_no_energy() {
        assert_eq!((energy::<f32>(&[]), rms::<f32>(&[]), rms(&[3.0, -3.0])), (0.0, 0.0, 3.0));
        assert_eq!(tnce::<f32>(&[], 0, &mut []), 0.0);
    }
}
