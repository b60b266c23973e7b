//! Energy, its running sum along time, and both over Flat's.

use crate::Real;

/// Sum of squares.
pub fn energy<T: Real>(x: &[T]) -> f64 {
    x.iter().map(|x| x.f64() * x.f64()).sum()
}

/// Difference of two signals: a response without the direct sound, which is Foam's of the same pair.
pub fn subtract<T: Real>(ir: &[T], foam: &[T], out: &mut [T]) {
    out.iter_mut().zip(ir.iter().zip(foam)).for_each(|(out, (ir, foam))| *out = *ir - *foam);
}

/// Running sum of squares of each band over `scale`, summed up in f64.
///
/// bands  `[bands x len]`
/// curves `[bands x len]`  cumulative energy (scale 1), or NCE (scale: Flat's total energy)
/// last   `[bands]`        each curve's last value, in f64
pub fn cumulate<T: Real>(bands: &[T], len: usize, scale: f64, curves: &mut [T], last: &mut [f64]) {
    for ((band, curve), last) in bands.chunks_exact(len).zip(curves.chunks_exact_mut(len)).zip(last) {
        let mut sum = 0.0;
        for (x, c) in band.iter().zip(curve) {
            sum += x.f64() * x.f64();
            *c = T::of(sum / scale);
        }
        *last = sum / scale;
    }
}
