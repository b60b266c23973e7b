//! Sweeps in a recording: when they arrive in it, found by the sweep's own file.

#[cfg(test)]
mod tests;

use echolake_dsp::deconvolution::{DeconvolutionParams, DeconvolutionPlan, SpectralDivision, TransformLength};
use echolake_schema::Rig;

use crate::wav_file::WavChannel;

/// Sweeps that a part of a recording is as long as. Those that begin in all but the last of it are whole in it.
const PART_SWEEPS: usize = 4;
/// Attenuation of the response outside of the sweep's range, dB: only the range counts.
const OUT_OF_RANGE_DB: f64 = 60.0;
/// Least height of an arrival over the median of its part: eight standard deviations of noise, which chance does not
/// reach in a recording of any length.
const LEAST_OVER_MEDIAN: f32 = 12.0;
/// Least share of the highest arrival at which another one is a sweep, too, if a sweep's length lies between them: no
/// reflection is as strong.
const SWEEP_SHARE: f32 = 0.5;
/// Least share of a peak at which what precedes it is the direct sound.
const DIRECT_SHARE: f32 = 0.3;

/// A sweep in a recording.
#[derive(Debug, Clone, Copy, PartialEq)]
struct FoundSweep {
    /// Sample at which its direct sound's first sample arrives.
    arrival: u64,
    height: f32,
}

/// Finds the one sweep in a recording, and returns the sample at which it arrives; the text of an error says how many
/// there are instead. `reach` is the number of samples by which the direct sound may precede the strongest one.
pub(crate) fn find_sweep(recording: &WavChannel, sweep: &[f32], reach: usize, rig: &Rig) -> Result<u64, String> {
    let rate_hz = rig.sweep.rate_hz.get();
    let secs = |sample: u64| format!("{:.3}", sample as f64 / rate_hz);
    let sweeps = find_sweeps(recording, sweep, reach, rig)?;
    let label = recording.label();
    match sweeps.as_slice() {
        [] => Err(format!(
            "{label} does not have the sweep that the loopback's file is: no arrival is {LEAST_OVER_MEDIAN} times as \
             high as what is around it; hint: are the file and the rig's `sweep` those that were played?"
        )),
        [one] if one.arrival + sweep.len() as u64 > recording.layout.samples => Err(format!(
            "{label} has {} s, and a sweep of {} s that arrives at {} s: it is cut off",
            secs(recording.layout.samples),
            secs(sweep.len() as u64),
            secs(one.arrival)
        )),
        [one] => Ok(one.arrival),
        several => {
            let times: Vec<_> = several.iter().map(|sweep| secs(sweep.arrival)).collect();
            Err(format!(
                "{label} has {} sweeps, at {} s, expected one; hint: cut it into a file for each, and number them in \
                 the column `attempt`",
                several.len(),
                times.join(", ")
            ))
        }
    }
}

// In the order of their arrivals. One part of the recording is in memory at a time.
fn find_sweeps(recording: &WavChannel, sweep: &[f32], reach: usize, rig: &Rig) -> Result<Vec<FoundSweep>, String> {
    let part_len = PART_SWEEPS * sweep.len();
    let searched_len = part_len - sweep.len();
    let plan = DeconvolutionPlan::<f32>::new(DeconvolutionParams {
        recording_len: part_len,
        output_len: searched_len,
        rate_hz: rig.sweep.rate_hz.get(),
        low_hz: rig.sweep.low_hz,
        high_hz: rig.sweep.high_hz,
        division: SpectralDivision::Floored { floor_db: OUT_OF_RANGE_DB },
        taper_hz: 0.0,
        length: TransformLength::Fast,
    })
    .map_err(|e| e.to_string())?;
    let mut scratch = plan.make_scratch();
    let mut response = vec![0.0; searched_len];
    let mut padded = sweep.to_vec();
    padded.resize(part_len, 0.0);
    let mut found: Vec<FoundSweep> = Vec::new();
    for start in (0..recording.layout.samples).step_by(searched_len) {
        let part = recording.read_samples(recording.sample_format(), start..start + part_len as u64)?;
        plan.deconvolve_recording(&part.fractions, &padded, &mut response, &mut scratch).map_err(|e| e.to_string())?;
        response.iter_mut().for_each(|x| *x = x.abs());
        // Behind the recording's end there is no noise to compare with.
        let recorded = (recording.layout.samples - start).min(searched_len as u64) as usize;
        let in_part = find_arrivals(&response[..recorded], sweep.len(), reach);
        found.extend(in_part.into_iter().map(|(at, height)| FoundSweep { arrival: start + at as u64, height }));
    }
    found.sort_by(|a, b| b.height.total_cmp(&a.height));
    let mut sweeps: Vec<FoundSweep> = Vec::new();
    for one in found {
        let is_strong = sweeps.first().is_none_or(|strongest| one.height >= SWEEP_SHARE * strongest.height);
        if is_strong && sweeps.iter().all(|other| one.arrival.abs_diff(other.arrival) >= sweep.len() as u64) {
            sweeps.push(one);
        }
    }
    sweeps.sort_by_key(|sweep| sweep.arrival);
    Ok(sweeps)
}

// Arrivals at least a sweep apart, and their heights, the highest first.
fn find_arrivals(magnitudes: &[f32], sweep_len: usize, reach: usize) -> Vec<(usize, f32)> {
    let mut sorted = magnitudes.to_vec();
    let (_, median, _) = sorted.select_nth_unstable_by(magnitudes.len() / 2, f32::total_cmp);
    let mut least = LEAST_OVER_MEDIAN * *median;
    let mut free = magnitudes.to_vec();
    let mut arrivals = Vec::new();
    while let Some((peak, height)) = free.iter().copied().enumerate().max_by(|a, b| a.1.total_cmp(&b.1)) {
        if height <= least {
            break;
        }
        least = least.max(SWEEP_SHARE * height);
        arrivals.push((find_direct(magnitudes, peak, reach, LEAST_OVER_MEDIAN * *median), height));
        free[peak.saturating_sub(sweep_len)..(peak + sweep_len).min(magnitudes.len())].fill(0.0);
    }
    arrivals
}

// The local maximum that follows the first sample before a peak that is strong enough.
fn find_direct(magnitudes: &[f32], peak: usize, reach: usize, least: f32) -> usize {
    let least = least.max(DIRECT_SHARE * magnitudes[peak]);
    let first = (peak.saturating_sub(reach)..peak).find(|n| magnitudes[*n] >= least).unwrap_or(peak);
    (first..peak).find(|n| magnitudes[n + 1] <= magnitudes[*n]).unwrap_or(peak)
}
