//! Distortion of a recorded sweep: by order for exponential sweeps, as a single doubt for linear ones.

use echolake_schema::SweepShape;

use super::{RINGING_SECS, SweepResponse, TakeAnalyzer, TakeFault};
use crate::level::power_to_db;

/// Orders of harmonics that are measured.
pub const HARMONIC_ORDERS: std::ops::RangeInclusive<usize> = 2..=5;
/// Share of the time to the next lower order that belongs to a harmonic.
const HARMONIC_SHARE: f64 = 0.8;
/// Segments of the time before a linear sweep's response.
const SEGMENTS: usize = 16;
/// Least power of the loudest segments over that of the softest one, and least energy re the response's: distortion
/// rises over noise.
const OVER_SOFTEST: f64 = 4.0;
const DISTORTION_SHARE: f64 = 3e-5;

/// Distortion of a response to an exponential sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct TakeDistortion {
    /// Order, and level re the linear response at the same frequencies, dB: the mean from `order` times the sweep's
    /// lowest frequency to its highest. Orders that begin above it are left out.
    pub harmonics: Vec<(usize, f64)>,
    /// Level that noise has in the same windows, dB: harmonics below it are not seen.
    pub noise_db: f64,
}

impl TakeAnalyzer {
    /// Measures harmonics of an exponential sweep; for a linear one adds a fault if what precedes the response is not
    /// even, as noise is.
    pub(super) fn measure_distortion(
        &self,
        faults: &mut Vec<TakeFault>,
        response: &SweepResponse,
    ) -> Option<TakeDistortion> {
        match self.sweep.shape {
            SweepShape::Exponential => Some(self.separate_harmonics(response)),
            SweepShape::Linear => {
                faults.extend(self.find_distortion(response));
                None
            }
        }
    }

    fn separate_harmonics(&self, response: &SweepResponse) -> TakeDistortion {
        let early = |order: usize| self.sweep.efold_secs() * (order as f64).ln();
        let guard = self.seconds(RINGING_SECS) as i64;
        // Samples of an order: from a little before its arrival on.
        let window = |order: usize| {
            let gap = if order == 1 { early(2) } else { early(order) - early(order - 1) };
            let from = response.onset - self.seconds(early(order)) as i64 - 2 * guard;
            from..from + ((HARMONIC_SHARE * gap * self.sweep.rate_hz) as i64).max(4 * guard)
        };
        let noise = self.noise_power(response);
        let density = |order: usize| {
            let range = window(order);
            let lowest = order as f64 * self.sweep.low_hz;
            let step = self.sweep.rate_hz / response.samples.len() as f64;
            let gains = self.tapered.gains.iter().enumerate().filter(|(k, _)| *k as f64 * step >= lowest);
            let width: f64 = gains.map(|(_, gain)| f64::from(*gain).powi(2)).sum();
            let expected_noise = noise * (range.end - range.start) as f64;
            ((response.energy_of(range) - expected_noise) / width, expected_noise / width)
        };
        let (linear, _) = density(1);
        let orders = HARMONIC_ORDERS.filter(|order| *order as f64 * self.sweep.low_hz < self.sweep.high_hz);
        let found: Vec<_> = orders.map(|order| (order, density(order))).collect();
        let noise_db = power_to_db(found.iter().fold(0.0f64, |most, (_, (_, noise))| most.max(*noise)) / linear);
        let level = |harmonic: f64, noise: f64| power_to_db(harmonic.max(noise) / linear);
        TakeDistortion {
            harmonics: found.iter().map(|(order, (x, noise))| (*order, level(*x, *noise))).collect(),
            noise_db,
        }
    }

    // Power of a sample of noise: the median of those half a recording away, over ln 2 as powers of noise have it.
    fn noise_power(&self, response: &SweepResponse) -> f64 {
        let n = response.samples.len() as i64;
        let middle = response.onset + n / 2;
        let mut powers: Vec<f64> = response.powers_in(middle - n / 16..middle + n / 16).collect();
        powers.sort_by(f64::total_cmp);
        powers.get(powers.len() / 2).map_or(0.0, |median| median / std::f64::consts::LN_2)
    }

    fn find_distortion(&self, response: &SweepResponse) -> Option<TakeFault> {
        let n = response.samples.len() as i64;
        let gone = self.sweep.low_hz / (self.sweep.high_hz - self.sweep.low_hz) * self.sweep.duration_secs;
        let end = response.onset - self.seconds(gone + RINGING_SECS) as i64;
        let start = response.onset - n / 2;
        let segment = (end - start) / SEGMENTS as i64;
        if segment < 1 {
            return None;
        }
        let powers: Vec<f64> =
            (0..SEGMENTS as i64).map(|i| response.energy_of(start + i * segment..start + (i + 1) * segment)).collect();
        let softest = powers.iter().fold(f64::INFINITY, |least, x| least.min(*x));
        let loudest = powers.iter().fold(0.0f64, |most, x| most.max(*x));
        let share = powers.iter().map(|x| x - softest).sum::<f64>() / response.energy;
        (loudest > OVER_SOFTEST * softest && share > DISTORTION_SHARE)
            .then(|| TakeFault::Distortion { level_db: power_to_db(share) })
    }
}
