//! Lost and repeated samples, from the ringing that they make before the first arrival.

use realfft::num_complex::Complex;

use super::{ONSET_SHARE, RINGING_SECS, SweepResponse, TakeAnalysis, TakeAnalyzer, TakeChannel, TakeFault};
use crate::level::power_to_db;

/// Length of the windows before the arrival, s.
const WINDOW_SECS: f64 = 5e-3;
/// Parts of the sweep that are compared.
const PARTS: usize = 100;
/// Least power of a part's ringing, re the mean power of the response: a lost sample has -38 dB and more, a clean take
/// -60 dB and less.
const RINGING_SHARE: f64 = 3.2e-5;
/// Least power of the ringing over that of the window farther before the arrival: a tone or a click has as much there.
const OVER_FARTHER: f64 = 3.2;
/// Least power of the ringing over the median of all parts: noise has less than 9 dB.
const OVER_MEDIAN: f64 = 32.0;

impl TakeAnalyzer {
    /// Adds a fault if samples are missing or repeated, whichever of the clock ratios is true; returns whether it did.
    pub(super) fn find_dropout(
        &self,
        analysis: &mut TakeAnalysis,
        response: &SweepResponse,
        ratios: &[f64],
        channel: TakeChannel,
        delay: i64,
    ) -> bool {
        let mut found = None;
        for ratio in ratios {
            found = self.locate_dropout(&self.align_clocks(response, *ratio));
            if found.is_none() {
                return false;
            }
        }
        if let Some((sweep_secs, ringing_db)) = found {
            let at_secs = sweep_secs + self.secs_of(response.onset + delay);
            analysis.faults.push(TakeFault::Dropout { channel, at_secs, ringing_db });
        }
        found.is_some()
    }

    // Time in the sweep, s, and level of the ringing, dB.
    fn locate_dropout(&self, vicinity: &[Complex<f64>]) -> Option<(f64, f64)> {
        let power: Vec<f64> = vicinity.iter().map(Complex::norm_sqr).collect();
        let least = ONSET_SHARE * ONSET_SHARE * power.iter().fold(0.0, |most: f64, x| most.max(*x));
        let onset = power.iter().position(|x| *x >= least)?;
        let window = self.seconds(WINDOW_SECS).min(self.short.len / 8);
        let guard = self.seconds(RINGING_SECS);
        let mut whole = vicinity.to_vec();
        self.short.forward.process(&mut whole);
        let near = self.part_powers(&self.window_spectrum(vicinity, onset, guard, window));
        let farther = self.part_powers(&self.window_spectrum(vicinity, onset, guard + window * 3 / 2, window));
        let mean = mean_of(&self.part_powers(&whole));
        let mut sorted: Vec<f64> = near.iter().flatten().copied().collect();
        sorted.sort_by(f64::total_cmp);
        let median = *sorted.get(sorted.len() / 2)?;
        let part = (0..PARTS).max_by(|a, b| near[*a].unwrap_or(0.0).total_cmp(&near[*b].unwrap_or(0.0)))?;
        let ringing = near[part]?;
        let neighbours = farther[part.saturating_sub(1)..(part + 2).min(PARTS)].iter().flatten();
        let beyond = neighbours.fold(0.0, |most: f64, x| most.max(*x));
        let is_dropout =
            ringing > RINGING_SHARE * mean && ringing > OVER_FARTHER * beyond && ringing > OVER_MEDIAN * median;
        let at_secs = (part as f64 + 0.5) / PARTS as f64 * self.sweep.duration_secs;
        is_dropout.then(|| (at_secs, power_to_db(ringing / mean)))
    }

    // Spectrum of a Hann window that ends `before` samples before the onset.
    fn window_spectrum(
        &self,
        vicinity: &[Complex<f64>],
        onset: usize,
        before: usize,
        window: usize,
    ) -> Vec<Complex<f64>> {
        let mut windowed = vec![Complex::default(); self.short.len];
        for i in 0..window {
            let index = (onset + 2 * self.short.len - before - i) % self.short.len;
            let gain = (std::f64::consts::PI * (i as f64 + 0.5) / window as f64).sin().powi(2);
            windowed[index] = vicinity[index] * gain;
        }
        self.short.forward.process(&mut windowed);
        windowed
    }

    // Mean power of each part of the sweep; None if no bin is in it.
    fn part_powers(&self, spectrum: &[Complex<f64>]) -> Vec<Option<f64>> {
        let mut sums = [(0.0, 0usize); PARTS];
        for (k, z) in spectrum.iter().enumerate().take(self.short.len / 2).skip(1) {
            let hz = k as f64 * self.short.step_hz;
            if super::taper_gain(&self.sweep, hz) > 0.0 {
                let share = self.sweep.time_at(hz) / self.sweep.duration_secs;
                let (sum, count) = &mut sums[((share * PARTS as f64) as usize).min(PARTS - 1)];
                *sum += z.norm_sqr();
                *count += 1;
            }
        }
        sums.map(|(sum, count)| (count > 0).then(|| sum / count as f64)).to_vec()
    }
}

fn mean_of(parts: &[Option<f64>]) -> f64 {
    let sum: f64 = parts.iter().flatten().sum();
    sum / parts.iter().flatten().count().max(1) as f64
}
