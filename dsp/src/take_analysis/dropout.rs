//! Lost and repeated samples, from the ringing that they make before the first arrival.

use std::ops::Range;

use realfft::num_complex::Complex;

use super::{
    ONSET_SHARE, OnsetVicinity, ShortTransform, TakeAnalysis, TakeAnalyzer, TakeChannel, TakeFault, TransformScratch,
    greatest_magnitude,
};
use crate::level::power_to_db;
use crate::sweep::SineSweep;

/// Length of the windows before the arrival, s.
pub(super) const WINDOW_SECS: f64 = 5e-3;
/// Parts of the sweep that are compared.
const PARTS: usize = 100;
/// Least power of a part's ringing, re the mean power of the response: a lost sample has -38 dB and more, a clean take
/// -60 dB and less.
const RINGING_SHARE: f64 = 3.2e-5;
/// The same near the limits of an exponential sweep, where hum of -20 dBFS has -44 dB.
const FINE_RINGING_SHARE: f64 = 3.2e-4;
/// Least power of the ringing over that of the window farther before the arrival: a tone or a click has as much there.
const OVER_FARTHER: f64 = 3.2;
/// Least power of the ringing over the median of all parts: noise has less than 9 dB.
const OVER_MEDIAN: f64 = 32.0;

impl TakeAnalyzer {
    /// Adds a fault if samples are missing or repeated, whichever vicinity has the true clock ratio; returns whether it
    /// did.
    pub(super) fn find_dropout(
        &self,
        analysis: &mut TakeAnalysis,
        onset: i64,
        vicinities: &[&OnsetVicinity],
        channel: TakeChannel,
    ) -> bool {
        let mut found = None;
        for vicinity in vicinities {
            found = self.locate_dropout(vicinity, &self.short, RINGING_SHARE);
            if found.is_none() {
                return false;
            }
        }
        if let Some((sweep_secs, ringing_db)) = found {
            let at_secs = sweep_secs + self.secs_of(onset);
            analysis.faults.push(TakeFault::Dropout { channel, at_secs, ringing_db });
        }
        found.is_some()
    }

    /// Adds a fault if an exponential sweep's recording lost samples while it was near the limits of its range, and no
    /// other fault was found. Which of the channels it was cannot be told.
    pub(super) fn find_fine_dropout(
        &self,
        analysis: &mut TakeAnalysis,
        spectra: [&[Complex<f32>]; 2],
        delay: i64,
        scratch: &mut TransformScratch,
    ) {
        let Some((tapered, short)) = &self.fine else { return };
        if analysis.faults.iter().any(TakeFault::spoils_response) {
            return;
        }
        let response = self.divide_tapered(spectra, self.forward.len() / 2, (tapered, short), scratch);
        if let Some((sweep_secs, ringing_db)) = self.locate_dropout(&response.vicinity, short, FINE_RINGING_SHARE) {
            let at_secs = sweep_secs + self.secs_of(response.onset + delay);
            analysis.faults.push(TakeFault::Dropout { channel: TakeChannel::Recording, at_secs, ringing_db });
        }
        scratch.judged.push((response.samples, response.powers));
    }

    // Time in the sweep, s, and level of the ringing, dB.
    fn locate_dropout(&self, vicinity: &OnsetVicinity, short: &ShortTransform, least: f64) -> Option<(f64, f64)> {
        let arrived = (ONSET_SHARE * ONSET_SHARE) as f32 * greatest_magnitude(&vicinity.powers);
        let onset = vicinity.powers.iter().position(|x| *x >= arrived)?;
        let (window, guard) = (short.window.len(), short.guard);
        let near = short.part_powers(&short.window_spectrum(&vicinity.samples, onset, guard));
        let farther = short.part_powers(&short.window_spectrum(&vicinity.samples, onset, guard + window * 3 / 2));
        let mean = mean_of(&short.part_powers(&vicinity.spectrum));
        let mut sorted: Vec<f64> = near.iter().flatten().copied().collect();
        sorted.sort_by(f64::total_cmp);
        let median = *sorted.get(sorted.len() / 2)?;
        let part = (0..PARTS).max_by(|a, b| near[*a].unwrap_or(0.0).total_cmp(&near[*b].unwrap_or(0.0)))?;
        let ringing = near[part]?;
        let neighbours = farther[part.saturating_sub(1)..(part + 2).min(PARTS)].iter().flatten();
        let beyond = neighbours.fold(0.0, |most: f64, x| most.max(*x));
        let is_dropout = ringing > least * mean && ringing > OVER_FARTHER * beyond && ringing > OVER_MEDIAN * median;
        let at_secs = (part as f64 + 0.5) / PARTS as f64 * self.sweep.duration_secs;
        is_dropout.then(|| (at_secs, power_to_db(ringing / mean)))
    }
}

impl ShortTransform {
    // Spectrum of a window that ends `before` samples before the onset.
    fn window_spectrum(&self, samples: &[Complex<f32>], onset: usize, before: usize) -> Vec<Complex<f32>> {
        let mut windowed = vec![Complex::default(); self.len];
        for (i, gain) in self.window.iter().enumerate() {
            let index = (onset + 2 * self.len - before - i) % self.len;
            windowed[index] = samples[index] * gain;
        }
        self.forward.process(&mut windowed);
        windowed
    }

    // Mean power of each part of the sweep; None if no bin is in it.
    fn part_powers(&self, spectrum: &[Complex<f32>]) -> Vec<Option<f64>> {
        let mean = |part: &Range<usize>| {
            spectrum[part.clone()].iter().map(|z| f64::from(z.norm_sqr())).sum::<f64>() / part.len() as f64
        };
        self.parts.iter().map(|part| (!part.is_empty()).then(|| mean(part))).collect()
    }
}

/// Bins of each part of a sweep, of ascending ones.
pub(super) fn split_sweep(sweep: &SineSweep, bins: impl Iterator<Item = usize>, step_hz: f64) -> Vec<Range<usize>> {
    let mut parts = vec![0..0; PARTS];
    for k in bins {
        let share = sweep.time_at(k as f64 * step_hz) / sweep.duration_secs;
        let part = &mut parts[((share * PARTS as f64) as usize).min(PARTS - 1)];
        *part = if part.end == 0 { k } else { part.start }..k + 1;
    }
    parts
}

/// Hann's window.
pub(super) fn hann_window(len: usize) -> Vec<f32> {
    (0..len).map(|i| (std::f64::consts::PI * (i as f64 + 0.5) / len as f64).sin().powi(2) as f32).collect()
}

fn mean_of(parts: &[Option<f64>]) -> f64 {
    let sum: f64 = parts.iter().flatten().sum();
    sum / parts.iter().flatten().count().max(1) as f64
}
