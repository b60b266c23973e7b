//! Levels of two signals that share a transform, and the power of one of them over its bins.

use crate::{Error, RealSample};

/// Sums and minima that are kept side by side, as the compiler makes vectors of them.
const LANES: usize = 8;
/// Samples that levels are taken from, of each eight times as many.
const BLOCK: usize = 64;

/// Levels of the two signals, from an eighth of their samples.
pub(crate) struct SignalLevels {
    /// Power of two that brings the loopback to the recording's level: in one transform, the rounding of the louder
    /// signal is noise in the other.
    pub(crate) gain: f64,
    /// Power of a bin that rounding alone may leave.
    pub(crate) rounding: f64,
}

impl SignalLevels {
    pub(crate) fn of<T: RealSample>(recording: &[T], loopback: &[T]) -> Result<Self, Error> {
        let (x, s) = (sampled_energy(recording), sampled_energy(loopback));
        for (what, energy) in [("the recording", x), ("the loopback", s)] {
            if !energy.is_finite() {
                return Err(Error::NotFinite { what });
            }
        }
        if loopback.iter().all(|s| *s == T::default()) {
            return Err(Error::NoLoopback);
        }
        let exponent = ((x / s).log2() / 2.0).round();
        let gain = if exponent.abs() <= 60.0 { exponent.exp2() } else { 1.0 };
        Ok(Self { gain, rounding: (16.0 * T::epsilon()).powi(2) * (x + gain * gain * s) })
    }
}

// Blocks that are long enough to be read at full speed, close enough to each other to miss no sweep.
fn sampled_energy<T: RealSample>(signal: &[T]) -> f64 {
    let mut sums = [T::default(); LANES];
    for block in signal.chunks(8 * BLOCK) {
        for lanes in block[..block.len().min(BLOCK)].chunks_exact(LANES) {
            sums.iter_mut().zip(lanes).for_each(|(sum, x)| *sum = *sum + *x * *x);
        }
    }
    8.0 * sums.iter().map(|x| x.f64()).sum::<f64>()
}

/// Power of the divisor over some bins, in lanes that the compiler makes vectors of.
pub(crate) struct BinPower<T> {
    sums: [T; LANES],
    least: [T; LANES],
}

impl<T: RealSample> BinPower<T> {
    pub(crate) fn none() -> Self {
        Self { sums: [T::default(); LANES], least: [T::max_value(); LANES] }
    }

    pub(crate) fn add(&mut self, powers: &[T]) {
        let (whole, rest) = powers.as_chunks();
        for lanes in whole {
            self.add_lanes(lanes);
        }
        for power in rest {
            self.sums[0] = self.sums[0] + *power;
            self.least[0] = if *power < self.least[0] { *power } else { self.least[0] };
        }
    }

    fn add_lanes(&mut self, lanes: &[T; LANES]) {
        for ((power, sum), least) in lanes.iter().zip(&mut self.sums).zip(&mut self.least) {
            *sum = *sum + *power;
            *least = if *power < *least { *power } else { *least };
        }
    }

    pub(crate) fn sum(&self) -> f64 {
        self.sums.iter().map(|x| x.f64()).sum()
    }

    pub(crate) fn least(&self) -> f64 {
        self.least.iter().map(|x| x.f64()).fold(f64::INFINITY, f64::min)
    }
}
