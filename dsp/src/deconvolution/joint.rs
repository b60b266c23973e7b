//! Levels of two signals that share a transform, and the power of one of them over its bins.

use crate::{Error, RealSample, SampleVector as _, VECTOR_LANES};

/// Samples that levels are taken from, of each eight times as many.
const BLOCK: usize = 64;

/// Levels of the two signals, from an eighth of their samples.
pub(crate) struct SignalLevels {
    /// Powers of two that bring the recording and the loopback to an energy of 1: in one transform, the rounding of the
    /// louder signal is noise in the other.
    pub(crate) gains: [f64; 2],
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
    let mut sums = VectorPair::<T>::splat(T::default());
    for block in signal.chunks(8 * BLOCK) {
        for pair in block[..block.len().min(BLOCK)].as_chunks().0 {
            let VectorPair(a, b) = VectorPair::<T>::from_samples(pair);
            sums = VectorPair(sums.0 + a * a, sums.1 + b * b);
        }
    }
    8.0 * sums.samples().map(|x| x.f64()).sum::<f64>()
}

/// Power of the divisor over some bins.
pub(crate) struct BinPower<T: RealSample> {
    sums: VectorPair<T>,
    least: VectorPair<T>,
}

impl<T: RealSample> BinPower<T> {
    pub(crate) fn none() -> Self {
        Self { sums: VectorPair::splat(T::default()), least: VectorPair::splat(T::max_value()) }
    }

    pub(crate) fn add(&mut self, powers: &[T]) {
        let (whole, rest) = powers.as_chunks();
        for pair in whole {
            let powers = VectorPair::from_samples(pair);
            self.add_pair(powers, powers);
        }
        // The first lane alone.
        for power in rest {
            let (mut sum, mut least) = ([T::default(); 2 * VECTOR_LANES], [T::max_value(); 2 * VECTOR_LANES]);
            (sum[0], least[0]) = (*power, *power);
            self.add_pair(VectorPair::from_samples(&sum), VectorPair::from_samples(&least));
        }
    }

    fn add_pair(&mut self, powers: VectorPair<T>, least: VectorPair<T>) {
        self.sums = VectorPair(self.sums.0 + powers.0, self.sums.1 + powers.1);
        self.least = VectorPair(least.0.lesser(self.least.0), least.1.lesser(self.least.1));
    }

    pub(crate) fn sum(&self) -> f64 {
        self.sums.samples().map(|x| x.f64()).sum()
    }

    pub(crate) fn least(&self) -> f64 {
        self.least.samples().map(|x| x.f64()).fold(f64::INFINITY, f64::min)
    }
}

/// Eight lanes, so that an addition need not wait for the one before.
#[derive(Clone, Copy)]
struct VectorPair<T: RealSample>(T::Vector, T::Vector);

impl<T: RealSample> VectorPair<T> {
    fn splat(value: T) -> Self {
        Self(value.into(), value.into())
    }

    #[inline]
    fn from_samples([a, b, c, d, e, f, g, h]: &[T; 2 * VECTOR_LANES]) -> Self {
        Self([*a, *b, *c, *d].into(), [*e, *f, *g, *h].into())
    }

    fn samples(&self) -> impl Iterator<Item = T> {
        let (first, second): ([T; VECTOR_LANES], [T; VECTOR_LANES]) = (self.0.into(), self.1.into());
        first.into_iter().chain(second)
    }
}
