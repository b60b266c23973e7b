//! Levels of two signals that share a transform, and the power of one of them over its bins.

use crate::{Error, RealSample};

/// Samples that levels are taken from, of each eight times as many.
const BLOCK: usize = 64;
/// Sums side by side, so that an addition need not wait for the one before.
const LANES: usize = 8;

/// Levels of the two signals, from an eighth of their samples.
pub(crate) struct SignalLevels {
    /// Powers of two that bring the recording and the loopback to an energy of 1: in one transform, the rounding of the
    /// louder signal is noise in the other.
    pub gains: [f64; 2],
    /// Power of a bin that rounding alone may leave.
    pub rounding: f64,
}

impl SignalLevels {
    pub fn from_signals<T: RealSample>(recording: &[T], loopback: &[T]) -> Result<Self, Error> {
        let x = sampled_energy(recording);
        let s = sampled_energy(loopback);
        for (what, energy) in [("the recording", x), ("the loopback", s)] {
            if !energy.is_finite() {
                return Err(Error::NotFinite { what });
            }
        }
        if loopback.iter().all(|s| *s == T::default()) {
            return Err(Error::NoLoopback);
        }
        let recording_gain = root_power_of_two(1.0 / x);
        let loopback_gain = recording_gain * root_power_of_two(x / s);
        let energy = recording_gain.powi(2) * x + loopback_gain.powi(2) * s;
        Ok(Self { gains: [recording_gain, loopback_gain], rounding: (16.0 * T::epsilon()).powi(2) * energy })
    }
}

// The power of two next to a ratio of energies as one of amplitudes; 1 for what is no level.
fn root_power_of_two(energy: f64) -> f64 {
    let exponent = (energy.log2() / 2.0).round();
    if exponent.abs() <= 60.0 { exponent.exp2() } else { 1.0 }
}

// Blocks that are long enough to be read at full speed, close enough to each other to miss no sweep.
fn sampled_energy<T: RealSample>(signal: &[T]) -> f64 {
    let mut sums = [T::default(); LANES];
    for block in signal.chunks(8 * BLOCK) {
        for lanes in block[..block.len().min(BLOCK)].as_chunks::<LANES>().0 {
            sums.iter_mut().zip(lanes).for_each(|(sum, x)| *sum = *sum + *x * *x);
        }
    }
    8.0 * sums.into_iter().map(T::f64).sum::<f64>()
}

/// Power of the divisor over some bins.
pub(crate) struct BinPower<T: RealSample> {
    sums: [T; LANES],
    least: [T; LANES],
}

impl<T: RealSample> BinPower<T> {
    pub fn none() -> Self {
        Self { sums: [T::default(); LANES], least: [T::max_value(); LANES] }
    }

    pub fn add_powers(&mut self, powers: &[T]) {
        let (whole, rest) = powers.as_chunks::<LANES>();
        whole.iter().for_each(|lanes| self.add_lanes(lanes));
        self.add_lanes(rest);
    }

    #[inline]
    fn add_lanes(&mut self, powers: &[T]) {
        for ((sum, least), power) in self.sums.iter_mut().zip(&mut self.least).zip(powers) {
            *sum = *sum + *power;
            *least = if *power < *least { *power } else { *least };
        }
    }

    pub fn power_sum(&self) -> f64 {
        self.sums.into_iter().map(T::f64).sum()
    }

    pub fn least_power(&self) -> f64 {
        self.least.into_iter().map(T::f64).fold(f64::INFINITY, f64::min)
    }
}
