//! The two kinds of sample: f32 for the product, f64 for its oracle.

use realfft::FftNum;

/// A sample.
pub trait Real: FftNum + PartialOrd + Default {
    /// Nearest to an f64.
    fn of(value: f64) -> Self;
    /// As f64, exactly.
    fn f64(self) -> f64;
    /// Distance from 1 to the next sample value.
    fn epsilon() -> f64;
    /// The largest that is finite.
    fn max_value() -> Self;
}

impl Real for f32 {
    fn of(value: f64) -> Self {
        value as Self
    }

    fn f64(self) -> f64 {
        f64::from(self)
    }

    fn epsilon() -> f64 {
        f64::from(Self::EPSILON)
    }

    fn max_value() -> Self {
        Self::MAX
    }
}

impl Real for f64 {
    fn of(value: f64) -> Self {
        value
    }

    fn f64(self) -> f64 {
        self
    }

    fn epsilon() -> f64 {
        Self::EPSILON
    }

    fn max_value() -> Self {
        Self::MAX
    }
}
