//! Complex numbers that are computed with at once, their real and imaginary parts in a vector each.

use realfft::num_complex::Complex;

use crate::{RealSample, VECTOR_LANES};

/// As many complex numbers as a vector has lanes.
#[derive(Clone, Copy)]
pub(crate) struct ComplexVector<T: RealSample> {
    pub(crate) re: T::Vector,
    pub(crate) im: T::Vector,
}

impl<T: RealSample> ComplexVector<T> {
    /// The same number in all lanes.
    pub(crate) fn splat(value: Complex<T>) -> Self {
        Self { re: value.re.into(), im: value.im.into() }
    }

    #[inline]
    pub(crate) fn from_values([a, b, c, d]: &[Complex<T>; VECTOR_LANES]) -> Self {
        Self { re: [a.re, b.re, c.re, d.re].into(), im: [a.im, b.im, c.im, d.im].into() }
    }

    /// Of the first few; the others are zero.
    pub(crate) fn from_first(values: &[Complex<T>]) -> Self {
        let mut filled = [Complex::default(); VECTOR_LANES];
        filled.iter_mut().zip(values).for_each(|(to, from)| *to = *from);
        Self::from_values(&filled)
    }

    #[inline]
    pub(crate) fn values(self) -> [Complex<T>; VECTOR_LANES] {
        let ([r0, r1, r2, r3], [i0, i1, i2, i3]): ([T; VECTOR_LANES], [T; VECTOR_LANES]) =
            (self.re.into(), self.im.into());
        // Pairs as they lie in memory, so that they are stored as vectors.
        let ([r0, i0, r1, i1], [r2, i2, r3, i3]): ([T; VECTOR_LANES], [T; VECTOR_LANES]) =
            (T::Vector::from([r0, i0, r1, i1]).into(), T::Vector::from([r2, i2, r3, i3]).into());
        [Complex::new(r0, i0), Complex::new(r1, i1), Complex::new(r2, i2), Complex::new(r3, i3)]
    }
}
