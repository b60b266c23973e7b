//! The ratio of two clocks, from the chirp that it makes of a response.

use std::f64::consts::{PI, TAU};

use realfft::num_complex::Complex;
use wide::f64x4;

use super::{LANES, MAX_CLOCK_RATIO, SweepResponse, TakeAnalyzer, index_of_greatest, powers_of, widen};
use crate::sweep::SineSweep;

/// Rounds of the fit: each is exact to some thousandths of the ratio that is left.
const FIT_ROUNDS: usize = 3;
/// Ratio that needs no further round: 0.01 ppm.
const SETTLED_RATIO: f64 = 1e-8;
/// First step of the search, periods of the highest frequency over the sweep, and the number of its halvings.
const SEARCH_CYCLES: f64 = 0.5;
const SEARCH_HALVINGS: usize = 4;

impl TakeAnalyzer {
    /// Fits the clock ratio of a loopback to its phase, as a fraction.
    ///
    /// The phase of amplifiers and converters is an odd function of frequency, that of a drift is not (for a linear
    /// sweep it is even), so both are told apart: with a pole at 60 kHz and sweeps of 0.5 s the error is under 0.2 ppm.
    pub(super) fn fit_clock_ratio(&self, response: &SweepResponse) -> f64 {
        let mut ratio = 0.0;
        for _ in 0..FIT_ROUNDS {
            let left = self.fit_residual_ratio(response, ratio);
            ratio = (ratio + left).clamp(-MAX_CLOCK_RATIO, MAX_CLOCK_RATIO);
            if left.abs() < SETTLED_RATIO {
                break;
            }
        }
        ratio
    }

    fn fit_residual_ratio(&self, response: &SweepResponse, ratio: f64) -> f64 {
        let aligned = self.align_clocks(response, ratio);
        let turn = TAU * index_of_greatest(&aligned.powers) as f64 / self.short.len as f64;
        let step = Complex::from_polar(1.0, turn);
        let mut turned = Complex::from_polar(1.0, turn * self.short.core.start as f64);
        let mut last = 0.0;
        let mut phase = 0.0;
        let mut ratio = 0.0;
        let bins = aligned.spectrum[self.short.core.clone()].chunks(LANES);
        for (bins, weights) in bins.zip(self.short.drift_weights.chunks(LANES)) {
            let mut parts = [[0.0; LANES]; 2];
            for (lane, z) in bins.iter().enumerate() {
                let z = widen(*z) * turned;
                parts[0][lane] = z.re;
                parts[1][lane] = z.im;
                turned *= step;
            }
            let [re, im] = parts.map(f64x4::new);
            for (angle, weight) in im.atan2(re).to_array().into_iter().zip(weights) {
                let change = angle - last;
                phase += if change.abs() > PI { change - TAU.copysign(change) } else { change };
                last = angle;
                ratio += phase * weight;
            }
        }
        ratio
    }

    /// Searches the clock ratio at which a response with many arrivals is sharpest, as a fraction.
    pub(super) fn search_clock_ratio(&self, response: &SweepResponse) -> f64 {
        let unit = SEARCH_CYCLES / (self.sweep.duration_secs * self.sweep.high_hz);
        let sharpness = |ratio: f64| {
            let aligned = self.align_clocks(response, ratio);
            let powers = aligned.powers.iter().map(|power| f64::from(*power));
            let sums = powers.fold([0.0, 0.0], |[first, second], p| [first + p, second + p * p]);
            sums[1] / (sums[0] * sums[0])
        };
        let guess = self.guess_clock_ratio(response);
        let mut best = [0.0, guess].map(|ratio| (ratio, sharpness(ratio)));
        best.sort_by(|a, b| b.1.total_cmp(&a.1));
        let (mut ratio, mut most) = best[0];
        let mut step = unit;
        for _ in 0..=SEARCH_HALVINGS {
            for _ in 0..2 * (MAX_CLOCK_RATIO / unit) as usize {
                let sides = [ratio - step, ratio + step].map(|side| (side, sharpness(side)));
                let better = sides.into_iter().find(|(side, sharp)| *sharp > most && side.abs() <= MAX_CLOCK_RATIO);
                let Some(better) = better else { break };
                (ratio, most) = better;
            }
            step /= 2.0;
        }
        // A parabola through the last three.
        let [below, above] = [ratio - step, ratio + step].map(sharpness);
        let bend = below - 2.0 * most + above;
        if bend < 0.0 { ratio + step * (0.5 * (below - above) / bend).clamp(-1.0, 1.0) } else { ratio }
    }

    // The distance of the envelopes of the sweep's earlier and later half, as a clock ratio.
    fn guess_clock_ratio(&self, response: &SweepResponse) -> f64 {
        let share = |k: usize| {
            let hz = (k as f64 * self.short.step_hz).clamp(self.sweep.low_hz, self.sweep.high_hz);
            (self.sweep.time_at(hz) / self.sweep.duration_secs).clamp(0.0, 1.0)
        };
        let halves = [0, 1].map(|half| {
            let mut spectrum = response.vicinity.spectrum.clone();
            for (k, z) in spectrum.iter_mut().enumerate() {
                let later = (std::f64::consts::FRAC_PI_2 * share(k)).sin().powi(2);
                *z *= (if half == 0 { 1.0 - later } else { later }) as f32;
            }
            // Delay by a ratio of 1: the derivative of frequency times time.
            let mut sums = [0.0, 0.0];
            for k in self.short.core.clone() {
                let hz = k as f64 * self.short.step_hz;
                let next = hz + self.short.step_hz;
                let delay = (next * self.sweep.time_at(next) - hz * self.sweep.time_at(hz)) / self.short.step_hz;
                let power = f64::from(spectrum[k].norm_sqr());
                sums = [sums[0] + power * delay, sums[1] + power];
            }
            self.short.inverse.process(&mut spectrum);
            (powers_of(&spectrum), sums[0] / sums[1])
        });
        let [(early, early_delay), (late, late_delay)] = halves;
        let per_ratio = (late_delay - early_delay) * self.sweep.rate_hz;
        let reach = ((MAX_CLOCK_RATIO * per_ratio).abs().ceil() as usize).min(self.short.len / 4);
        let middle = reach..self.short.len - reach;
        let product = |lag: usize| {
            let pairs = early[middle.clone()].iter().zip(&late[middle.start + lag - reach..]);
            pairs.map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>() as f32
        };
        let products: Vec<f32> = (0..=2 * reach).map(product).collect();
        let lag = index_of_greatest(&products) as f64 - reach as f64;
        if per_ratio == 0.0 { 0.0 } else { (-lag / per_ratio).clamp(-MAX_CLOCK_RATIO, MAX_CLOCK_RATIO) }
    }
}

/// Turns bins by these cycles at each, whose values past the last bin are not used.
pub(super) fn turn_bins(bins: &mut [Complex<f32>], cycles_at: impl Fn(usize) -> f64) {
    for (group, bins) in bins.chunks_mut(LANES).enumerate() {
        let angle = |lane: usize| TAU * cycles_at(LANES * group + lane).fract();
        let (sin, cos) = f64x4::new(std::array::from_fn(angle)).sin_cos();
        for (z, (sin, cos)) in bins.iter_mut().zip(sin.to_array().into_iter().zip(cos.to_array())) {
            *z *= Complex::new(cos as f32, sin as f32);
        }
    }
}

/// Weights of the phases at some frequencies in the clock ratio: what no odd function explains of a drift's phase.
pub(super) fn drift_weights(sweep: &SineSweep, core_hz: impl Iterator<Item = f64> + Clone) -> Vec<f64> {
    let mut basis: Vec<Vec<f64>> = Vec::new();
    for power in [0, 1, -1, 3, 5] {
        let mut column: Vec<f64> = core_hz.clone().map(|hz| (hz / sweep.high_hz).powi(power)).collect();
        project_out(&basis, &mut column);
        let norm = dot(&column, &column).sqrt();
        column.iter_mut().for_each(|x| *x /= norm);
        basis.push(column);
    }
    let mut drift: Vec<f64> = core_hz.map(|hz| TAU * hz * sweep.time_at(hz)).collect();
    project_out(&basis, &mut drift);
    let square = dot(&drift, &drift);
    drift.iter_mut().for_each(|x| *x /= square);
    drift
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

// Twice, because once leaves rounding.
fn project_out(basis: &[Vec<f64>], column: &mut [f64]) {
    for direction in basis.iter().chain(basis) {
        let share = dot(direction, column);
        column.iter_mut().zip(direction).for_each(|(x, d)| *x -= share * d);
    }
}
