//! Removal of the direct sound, which is what a surface that absorbs everything leaves over.

use crate::RealSample;

/// A response minus Foam's of the same pair (Rust et al. 2021, appendix, step 3): what the surface reflected.
///
/// ir, foam, out  `[n]`, all at the reference temperature; past the shortest, `out` stays as it was
///
/// ```
/// let mut reflected = [0.0; 2];
/// echolake_dsp::foam::subtract_foam(&[1.0, 2.0], &[1.0, 0.5], &mut reflected);
/// assert_eq!(reflected, [0.0, 1.5]);
/// ```
pub fn subtract_foam<T: RealSample>(ir: &[T], foam: &[T], out: &mut [T]) {
    out.iter_mut().zip(ir.iter().zip(foam)).for_each(|(out, (ir, foam))| *out = *ir - *foam);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_difference_is_taken_sample_by_sample() {
        let mut out = [f64::NAN; 3];
        subtract_foam(&[3.0, 2.0, 1.0], &[1.0, 2.0, 4.0], &mut out);
        assert_eq!(out, [2.0, 0.0, -3.0]);
    }
}
