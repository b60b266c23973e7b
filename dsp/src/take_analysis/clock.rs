//! The ratio of two clocks, from the chirp that it makes of a response.

use std::f64::consts::TAU;

use realfft::num_complex::Complex;

use super::{MAX_CLOCK_RATIO, SweepResponse, TakeAnalyzer, index_of_greatest};

/// Rounds of the fit: each is exact to some thousandths of the ratio that is left.
const FIT_ROUNDS: usize = 3;
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
            ratio = (ratio + self.fit_residual_ratio(response, ratio)).clamp(-MAX_CLOCK_RATIO, MAX_CLOCK_RATIO);
        }
        ratio
    }

    fn fit_residual_ratio(&self, response: &SweepResponse, ratio: f64) -> f64 {
        let mut spectrum = self.align_clocks(response, ratio);
        let power: Vec<f64> = spectrum.iter().map(Complex::norm_sqr).collect();
        let peak = index_of_greatest(&power) as f64 / self.short.len as f64;
        self.short.forward.process(&mut spectrum);
        let bins = self.core_bins();
        let mut phase = Vec::with_capacity(bins.len());
        let mut last = 0.0;
        for k in bins.clone() {
            let angle = (spectrum[k] * Complex::from_polar(1.0, TAU * (k as f64 * peak).fract())).arg();
            last = angle - TAU * ((angle - last) / TAU).round();
            phase.push(last);
        }
        let relative = |k: usize| k as f64 * self.short.step_hz / self.sweep.high_hz;
        let column = |power: i32| bins.clone().map(|k| relative(k).powi(power)).collect::<Vec<f64>>();
        let mut drift: Vec<f64> =
            bins.clone().map(|k| k as f64 * self.short.step_hz).map(|hz| TAU * hz * self.sweep.time_at(hz)).collect();
        let mut basis: Vec<Vec<f64>> = Vec::new();
        for power in [0, 1, -1, 3, 5] {
            let mut column = column(power);
            project_out(&basis, &mut column);
            let norm = dot(&column, &column).sqrt();
            column.iter_mut().for_each(|x| *x /= norm);
            basis.push(column);
        }
        project_out(&basis, &mut drift);
        dot(&drift, &phase) / dot(&drift, &drift)
    }

    /// Searches the clock ratio at which a response with many arrivals is sharpest, as a fraction.
    pub(super) fn search_clock_ratio(&self, response: &SweepResponse) -> f64 {
        let unit = SEARCH_CYCLES / (self.sweep.duration_secs * self.sweep.high_hz);
        let sharpness = |ratio: f64| {
            let power = self.align_clocks(response, ratio).into_iter().map(|z| z.norm_sqr());
            let sums = power.fold([0.0, 0.0], |[first, second], p| [first + p, second + p * p]);
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
            let mut spectrum = response.vicinity.clone();
            for (k, z) in spectrum.iter_mut().enumerate() {
                let later = (std::f64::consts::FRAC_PI_2 * share(k)).sin().powi(2);
                *z *= if half == 0 { 1.0 - later } else { later };
            }
            // Delay by a ratio of 1: the derivative of frequency times time.
            let mut sums = [0.0, 0.0];
            for k in self.core_bins() {
                let hz = k as f64 * self.short.step_hz;
                let next = hz + self.short.step_hz;
                let delay = (next * self.sweep.time_at(next) - hz * self.sweep.time_at(hz)) / self.short.step_hz;
                let power = spectrum[k].norm_sqr();
                sums = [sums[0] + power * delay, sums[1] + power];
            }
            self.short.inverse.process(&mut spectrum);
            (spectrum.iter().map(Complex::norm_sqr).collect::<Vec<f64>>(), sums[0] / sums[1])
        });
        let [(early, early_delay), (late, late_delay)] = halves;
        let per_ratio = (late_delay - early_delay) * self.sweep.rate_hz;
        let reach = ((MAX_CLOCK_RATIO * per_ratio).abs().ceil() as usize).min(self.short.len / 4);
        let middle = reach..self.short.len - reach;
        let product = |lag: usize| -> f64 {
            early[middle.clone()].iter().zip(&late[middle.start + lag - reach..]).map(|(a, b)| a * b).sum()
        };
        let products: Vec<f64> = (0..=2 * reach).map(product).collect();
        let lag = index_of_greatest(&products) as f64 - reach as f64;
        if per_ratio == 0.0 { 0.0 } else { (-lag / per_ratio).clamp(-MAX_CLOCK_RATIO, MAX_CLOCK_RATIO) }
    }

    // Bins whose taper is at least a half.
    pub(super) fn core_bins(&self) -> std::ops::Range<usize> {
        let inside = |k: &usize| super::taper_gain(&self.sweep, *k as f64 * self.short.step_hz) >= 0.5;
        let first = (1..self.short.len / 2).find(inside).unwrap_or(1);
        let last = (first..self.short.len / 2).rev().find(inside).unwrap_or(first);
        first..last + 1
    }
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
