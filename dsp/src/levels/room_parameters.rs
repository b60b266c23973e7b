//! Reverberation times, clarity, definition and centre time of a room's impulse response.

use super::noise_crossing::{FittedLine, NoiseCrossing, find_noise_crossing, fit_line};
use crate::RealSample;
use crate::arrival::first_arrival;
use crate::octave_filter::{ARRIVAL_DB, OctaveBand, OctaveFilter};

/// Shortest response that has parameters, s after its arrival: the early time of C50 and D50.
const SHORTEST_SECS: f64 = 0.05;
/// Early times of C50 and C80, s.
const EARLY_SECS: [f64; 2] = [0.05, 0.08];
/// Range of the decay curve that EDT, and the energies, need: the evaluated range and 15 dB, ISO 3382-1:2009, 5.3.3.
const EDT_RANGE_DB: f64 = 25.0;
/// As [`EDT_RANGE_DB`], of T20.
const T20_RANGE_DB: f64 = 35.0;
/// As [`EDT_RANGE_DB`], of T30.
const T30_RANGE_DB: f64 = 45.0;
/// Range of the decay curve over which it is silence that nobody measured: that of 24 bits.
const GREATEST_RANGE_DB: f64 = 144.0;
/// Bandwidth times reverberation time at least; less is the filter's own decay. ISO 3382-2:2008, 7.3.
const LEAST_BANDWIDTH_TIME: f64 = 16.0;
/// Standard deviations of T20 and T30 over the root of T / bandwidth, of one integrated response, which stands for ten
/// decays. ISO 3382-2:2008, 7.1, formulas 4 and 5.
const DEVIATIONS: [[f64; 2]; 2] = [[0.88, 1.90], [0.55, 1.52]];
/// Decays that an integrated response stands for. ISO 3382-2:2008, 7.1.
const INTEGRATED_DECAYS: f64 = 10.0;
/// Curvature from which a decay has no one reverberation time, per cent. ISO 3382-2:2008, annex B.
const GREATEST_CURVATURE_PERCENT: f64 = 10.0;
/// Non-linearity from which a decay is no line, per mille. ISO 3382-2:2008, annex B.
const GREATEST_NON_LINEARITY: f64 = 10.0;
/// Periods of a band's midband frequency over which its early and its late part are parted, so that what is below the
/// band does not click in it.
const PARTING_PERIODS: f64 = 2.0;
/// Time for which a filter rings, over its bandwidth.
const RINGING: f64 = 4.0;
/// Uncertainty of the energy that a late decay's line foretells, as a share of it.
const FORETOLD_U: f64 = 0.3;
/// Standard uncertainty of a late energy from which C50 and C80 are in doubt: 0.3 dB.
const GREATEST_LATE_U: f64 = 0.07;
/// Share of all energy behind the crossing, over what is foretold, that a second slope in the noise has.
const HIDDEN_SHARE: f64 = 3e-3;
/// Standard deviations of the noise's energy that such a share exceeds.
const HIDDEN_DEVIATIONS: f64 = 2.5;
/// Time behind the crossing in which a second slope may be, over the time before it.
const HIDDEN_TIMES: usize = 2;
/// Time for which noise is seen over that of the decay, below which it may be none.
const LEAST_NOISE_SHARE: f64 = 0.5;

/// Parameters of a response; None where the response does not have what one needs.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RoomParameters {
    /// Early decay time: of 60 dB at the slope between 0 and -10 dB, s.
    pub edt_secs: Option<f64>,
    /// Reverberation time: of 60 dB at the slope between -5 and -25 dB, s.
    pub t20_secs: Option<f64>,
    /// Reverberation time: of 60 dB at the slope between -5 and -35 dB, s.
    pub t30_secs: Option<f64>,
    /// Standard deviation of T20 by the band's width, s; None of all frequencies.
    pub t20_deviation_secs: Option<f64>,
    /// Standard deviation of T30 by the band's width, s; None of all frequencies.
    pub t30_deviation_secs: Option<f64>,
    /// Non-linearity of the decay that T20 is fitted to, per mille.
    pub t20_non_linearity: Option<f64>,
    /// Non-linearity of the decay that T30 is fitted to, per mille.
    pub t30_non_linearity: Option<f64>,
    /// Curvature: by how much T30 is longer than T20, per cent.
    pub curvature_percent: Option<f64>,
    /// Clarity: energy of the first 50 ms over the later, dB.
    pub c50_db: Option<f64>,
    /// Clarity: energy of the first 80 ms over the later, dB.
    pub c80_db: Option<f64>,
    /// Definition: share of the energy in the first 50 ms, 0 to 1.
    pub d50: Option<f64>,
    /// Centre time: centre of gravity of the energy, s after the arrival.
    pub ts_secs: Option<f64>,
    /// Range of the decay curve: from its start to where the decay meets the noise, dB.
    pub range_db: Option<f64>,
    /// Why values are missing; empty if none is.
    pub refusals: Vec<String>,
    /// Reasons for which values may not mean what they are taken for; empty if there are none.
    pub doubts: Vec<String>,
}

/// The measured samples of a response, in all its frequencies, and the band of it that is looked at.
struct MeasuredResponse<'a> {
    /// Without zeros at its end.
    samples: Vec<f64>,
    /// First sample of the sound.
    start: usize,
    rate_hz: f64,
    band: Option<(&'a OctaveBand, &'a OctaveFilter)>,
}

/// Schroeder's curve from the arrival to the crossing with the noise.
struct CompensatedDecay {
    /// The sample of the response with which it begins.
    start: usize,
    /// Energy from each sample to the end of all time.
    left: Vec<f64>,
    /// The last of it, which the crossing's line foretells.
    compensation: f64,
    crossing: NoiseCrossing,
    /// Energy behind the crossing over the noise's and over what is foretold, and its standard deviation by the noise.
    hidden: [f64; 2],
    /// Samples behind the crossing.
    behind: usize,
    rate_hz: f64,
    /// Width of the band, Hz.
    width_hz: f64,
}

/// The early share of a band's energy.
#[derive(Clone, Copy)]
struct EarlyShare {
    share: f64,
    /// Standard uncertainty of the late energy, relative.
    late_u: f64,
}

/// A time of 60 dB.
struct FittedTime {
    secs: f64,
    /// 1000 (1 - r^2).
    non_linearity: f64,
}

/// Computes the parameters of a response, in all its frequencies or in a band, for which a filter is given.
///
/// Time counts from the arrival: the first sample at -20 dB re the greatest. The response ends where its last zeros
/// begin. The noise's power is subtracted, the integral ends where the late decay meets the noise, and the energy after
/// that is added as the late decay's. The early and the late part of a band's energy are parted before they are
/// filtered, so that the filter's delay moves nothing from one to the other.
///
/// ir  `[n]`, any unit
///
/// Source: ISO 3382-1:2009, 5.3.3 and annex A; ISO 3382-2:2008, 7.1, 7.3 and annexes B and C; Guski and Vorlaender
/// 2014, Acta Acustica united with Acustica 100:320-327, for the subtraction together with truncation and compensation.
///
/// ```
/// // A decay of 60 dB a second, without noise.
/// let ir: Vec<f64> = (0..8000).map(|n| 10f64.powf(-3.0 * f64::from(n) / 8000.0)).collect();
/// let room = echolake_dsp::room_parameters::compute_room_parameters(&ir, 8e3, None);
/// assert!(room.t20_secs.is_some_and(|secs| (secs - 1.0).abs() < 1e-3));
/// ```
pub fn compute_room_parameters<T: RealSample>(
    ir: &[T],
    rate_hz: f64,
    band: Option<(&OctaveBand, &OctaveFilter)>,
) -> RoomParameters {
    let mut room = RoomParameters::default();
    let Some(arrival) = first_arrival(ir, ARRIVAL_DB) else {
        room.refusals.push("there is no sound".into());
        return room;
    };
    let start = arrival.ceil() as usize;
    let silent = ir.iter().rev().take_while(|x| **x == T::default()).count();
    let samples: Vec<f64> = ir[..ir.len() - silent].iter().map(|x| x.f64()).collect();
    let response = MeasuredResponse { samples, start, rate_hz, band };
    let secs = response.samples.len().saturating_sub(start) as f64 / rate_hz;
    if secs < SHORTEST_SECS {
        room.refusals.push(format!("it is {:.1} ms long after its arrival, of at least 50 ms", secs * 1e3));
        return room;
    }
    let Some(decay) = response.compensated_decay() else {
        room.refusals.push("it does not decay into its noise on a line".into());
        return room;
    };
    let range_db = decay.range_db();
    if range_db > GREATEST_RANGE_DB {
        let cause = "its end was not measured";
        room.refusals.push(format!("the decay has a range of {range_db:.0} dB, of at most 144 dB: {cause}"));
        return room;
    }
    room.range_db = Some(range_db);
    room.evaluate_decay(&decay, band.map(|(band, _)| band.width_hz()));
    if range_db >= EDT_RANGE_DB {
        room.evaluate_energies(&response, &decay);
    }
    room
}

/// Returns whether responses of so many samples can have parameters.
pub fn is_long_enough(samples: usize, rate_hz: f64) -> bool {
    samples as f64 >= SHORTEST_SECS * rate_hz
}

impl RoomParameters {
    fn evaluate_decay(&mut self, decay: &CompensatedDecay, width_hz: Option<f64>) {
        let range_db = decay.range_db();
        let needs = [("EDT, C50, C80, D50 and Ts", EDT_RANGE_DB), ("T20", T20_RANGE_DB), ("T30", T30_RANGE_DB)];
        let missing: Vec<_> = needs.iter().filter(|(_, least)| range_db < *least).collect();
        if !missing.is_empty() {
            let needs: Vec<_> = missing.iter().map(|(what, least)| format!("{least} dB for {what}")).collect();
            self.refusals.push(format!("the decay has a range of {range_db:.1} dB, of at least {}", needs.join(", ")));
        }
        let mut accept = |name, least: f64, range| {
            let fitted = (range_db >= least).then(|| decay.fit_time(range))?;
            self.accept_time(name, fitted, width_hz)
        };
        let edt = accept("EDT", EDT_RANGE_DB, [0.0, 10.0]);
        let t20 = accept("T20", T20_RANGE_DB, [5.0, 25.0]);
        let t30 = accept("T30", T30_RANGE_DB, [5.0, 35.0]);
        let secs = |time: &Option<FittedTime>| time.as_ref().map(|time| time.secs);
        let non_linearity = |time: &Option<FittedTime>| time.as_ref().map(|time| time.non_linearity);
        let deviation = |time: &Option<FittedTime>, [factor, share]: [f64; 2]| {
            let root = (time.as_ref()?.secs * (1.0 + share / INTEGRATED_DECAYS) / width_hz?).sqrt();
            Some(factor * root)
        };
        self.edt_secs = secs(&edt);
        self.t20_secs = secs(&t20);
        self.t30_secs = secs(&t30);
        self.t20_deviation_secs = deviation(&t20, DEVIATIONS[0]);
        self.t30_deviation_secs = deviation(&t30, DEVIATIONS[1]);
        self.t20_non_linearity = non_linearity(&t20);
        self.t30_non_linearity = non_linearity(&t30);
        self.curvature_percent = self.t20_secs.zip(self.t30_secs).map(|(t20, t30)| (t30 / t20 - 1.0) * 100.0);
        self.doubt_times();
    }

    fn doubt_times(&mut self) {
        if let Some(percent) = self.curvature_percent.filter(|percent| percent.abs() > GREATEST_CURVATURE_PERCENT) {
            let longer = if percent > 0.0 { "longer" } else { "shorter" };
            let cause = "the decay has more than one slope";
            self.doubts.push(format!("T30 is {:.0} % {longer} than T20, more than 10 %: {cause}", percent.abs()));
        }
        for (name, non_linearity) in [("T20", self.t20_non_linearity), ("T30", self.t30_non_linearity)] {
            if let Some(per_mille) = non_linearity.filter(|per_mille| *per_mille > GREATEST_NON_LINEARITY) {
                let cause = "it is no line";
                self.doubts
                    .push(format!("the decay of {name} has a non-linearity of {per_mille:.0}, over 10: {cause}"));
            }
        }
    }

    fn evaluate_energies(&mut self, response: &MeasuredResponse<'_>, decay: &CompensatedDecay) {
        let [definition, share] = EARLY_SECS.map(|secs| response.early_share(decay, secs));
        if share.is_none() {
            let ms = decay.left.len() as f64 / decay.rate_hz * 1e3;
            self.refusals.push(format!("the noise is reached after {ms:.1} ms: C50 and D50 need 50 ms, C80 80 ms"));
        }
        for (name, share) in [("C50", definition), ("C80", share)] {
            if let Some(EarlyShare { late_u, .. }) = share.filter(|share| share.late_u > GREATEST_LATE_U) {
                let db = 10.0 * (1.0 + late_u).log10();
                self.doubts.push(format!("{name} is uncertain by {db:.1} dB: its late energy is near the noise's"));
            }
        }
        if decay.noise_secs() < LEAST_NOISE_SHARE * decay.left.len() as f64 / decay.rate_hz
            && decay.subtracted_share() > GREATEST_LATE_U
        {
            let ms = decay.noise_secs() * 1e3;
            self.doubts.push(format!("the noise is seen for {ms:.0} ms alone: it may be a decay that is slower"));
        }
        let [hidden, deviation] = decay.hidden.map(|energy| energy / decay.total());
        if hidden.abs() > HIDDEN_SHARE.max(HIDDEN_DEVIATIONS * deviation) {
            let percent = 100.0 * hidden;
            self.doubts.push(format!("{percent:.1} % of the energy is in the noise: a slope is hidden there"));
        }
        let clarity = |early: EarlyShare| 10.0 * (early.share / (1.0 - early.share)).log10();
        self.c50_db = definition.map(clarity);
        self.c80_db = share.map(clarity);
        self.d50 = definition.map(|early| early.share);
        self.ts_secs = Some(response.centre_secs(decay));
    }

    fn accept_time(&mut self, name: &str, fitted: Option<FittedTime>, width_hz: Option<f64>) -> Option<FittedTime> {
        let least = width_hz.map_or(0.0, |hz| LEAST_BANDWIDTH_TIME / hz);
        match fitted {
            Some(fitted) if fitted.secs >= least => return Some(fitted),
            Some(FittedTime { secs, .. }) => {
                let cause = "which the band's filter needs";
                self.refusals.push(format!("{name} is {secs:.3} s, less than {least:.3} s, {cause}"));
            }
            None => self.refusals.push(format!("{name} has too few samples")),
        }
        None
    }
}

impl MeasuredResponse<'_> {
    // Of the band: from its own arrival, to where the filter knows all that it needs.
    fn compensated_decay(&self) -> Option<CompensatedDecay> {
        let filtered = self.filter_part(self.samples.clone());
        let known = filtered.len() - self.band.map_or(0, |(_, filter)| filter.delay()).min(filtered.len());
        let filtered = &filtered[..known];
        let start = first_arrival(filtered, ARRIVAL_DB)?.ceil() as usize;
        let power = filtered[start..].iter().map(|x| x * x).collect();
        let width_hz = self.band.map_or(self.rate_hz / 2.0, |(band, _)| band.width_hz());
        CompensatedDecay::new(power, start, self.rate_hz, width_hz)
    }

    fn filter_part(&self, part: Vec<f64>) -> Vec<f64> {
        let Some((_, filter)) = self.band else { return part };
        let mut filtered = vec![0.0; part.len()];
        // Both are equally long.
        let _ = filter.filter_samples(&part, &mut filtered);
        filtered
    }

    // Samples that are filtered, with the ringing behind them.
    fn filter_with_ringing(&self, mut part: Vec<f64>) -> Vec<f64> {
        if let Some((band, _)) = self.band {
            part.resize(part.len() + (RINGING * self.rate_hz / band.width_hz()).ceil() as usize, 0.0);
        }
        self.filter_part(part)
    }

    // The sample at which the late decay meets the noise.
    fn noise_begin(&self, decay: &CompensatedDecay) -> usize {
        (decay.start + decay.left.len()).clamp(self.start, self.samples.len())
    }

    /// Share of the energy that is there until a time, below 1; None if the noise is reached before.
    fn early_share(&self, decay: &CompensatedDecay, secs: f64) -> Option<EarlyShare> {
        let (parting, end) = (self.start as f64 + secs * self.rate_hz, self.noise_begin(decay));
        if parting.round() as usize >= end {
            return None;
        }
        // Both parts' squares add up to the whole's.
        let width = self.band.map_or(1.0, |(band, _)| PARTING_PERIODS * self.rate_hz / band.midband_hz).max(1.0);
        let angle = |n: usize| ((n as f64 - parting + 0.5) / width + 0.5).clamp(0.0, 1.0) * std::f64::consts::FRAC_PI_2;
        let energy = |weight: fn(f64) -> f64| {
            let part = (self.start..end).map(|n| self.samples[n] * weight(angle(n))).collect();
            let noisy: f64 = self.filter_with_ringing(part).iter().map(|x| x * x).sum();
            noisy - decay.crossing.noise * (self.start..end).map(|n| weight(angle(n)).powi(2)).sum::<f64>()
        };
        let early = energy(f64::cos);
        let late = energy(f64::sin) + decay.compensation;
        // The noise's own energy, and its product with the decay.
        let noise = decay.noise_deviation(end as f64 - parting).hypot(decay.mixed_deviation(late));
        let late_u = noise.hypot(FORETOLD_U * decay.compensation) / late;
        (early > 0.0 && late > 0.0).then(|| EarlyShare { share: early / (early + late), late_u })
    }

    /// Centre of gravity of the energy after the arrival, s, without the delay of the band's filter.
    fn centre_secs(&self, decay: &CompensatedDecay) -> f64 {
        let part = &self.samples[self.start..self.noise_begin(decay)];
        let centre = |part: Vec<f64>| {
            let filtered = self.filter_with_ringing(part);
            let moments = filtered
                .iter()
                .enumerate()
                .fold([0.0; 2], |[energy, moment], (n, x)| [energy + x * x, moment + n as f64 * x * x]);
            moments[1] / moments[0]
        };
        // Forwards the filter delays, backwards it advances as much.
        let backwards = (part.len() - 1) as f64 - centre(part.iter().rev().copied().collect());
        let delay = (centre(part.to_vec()) - backwards) / 2.0;
        let filtered = decay.start as f64 + decay.centre_samples();
        (filtered - self.start as f64 - delay) / self.rate_hz
    }
}

impl CompensatedDecay {
    fn new(mut power: Vec<f64>, start: usize, rate_hz: f64, width_hz: f64) -> Option<Self> {
        let crossing = find_noise_crossing(&power, rate_hz, width_hz)?;
        let behind = power.split_off((crossing.samples.round() as usize).min(power.len()));
        let compensation = crossing.power / -(-crossing.rate).exp_m1();
        let mut sum = compensation;
        for x in power.iter_mut().rev() {
            sum += *x - crossing.noise;
            *x = sum;
        }
        let is_decay = compensation > 0.0 && sum > compensation;
        let left = power;
        let hidden = [0.0; 2];
        let mut decay = Self { start, left, compensation, crossing, hidden, behind: behind.len(), rate_hz, width_hz };
        if crossing.noise > 0.0 {
            // Farther behind there is noise alone.
            let near = &behind[..behind.len().min(HIDDEN_TIMES * decay.left.len())];
            let energy = near.iter().map(|x| x - crossing.noise).sum::<f64>();
            let known = (near.len() as f64 / behind.len() as f64 + 1.0).sqrt();
            decay.hidden = [energy - compensation, decay.noise_deviation(near.len() as f64) * known];
        }
        is_decay.then_some(decay)
    }

    // Standard deviation of the noise's energy in so many samples. How many are independent, the band's width says.
    fn noise_deviation(&self, samples: f64) -> f64 {
        self.crossing.noise * (samples * self.rate_hz / self.width_hz).sqrt()
    }

    // Time behind the crossing, s.
    fn noise_secs(&self) -> f64 {
        self.behind as f64 / self.rate_hz
    }

    // The noise's energy that is taken away, over the energy 25 dB below the start.
    fn subtracted_share(&self) -> f64 {
        self.crossing.noise * self.left.len() as f64 / self.total() * 10f64.powf(2.5)
    }

    // Standard deviation of twice the product of the noise and a signal of this energy.
    fn mixed_deviation(&self, energy: f64) -> f64 {
        (2.0 * energy.max(0.0) * self.crossing.noise * self.rate_hz / self.width_hz).sqrt()
    }

    fn total(&self) -> f64 {
        self.left[0]
    }

    fn range_db(&self) -> f64 {
        10.0 * (self.total() / self.compensation).log10()
    }

    /// Time of 60 dB at the slope between two levels below the start of the curve.
    fn fit_time(&self, range_db: [f64; 2]) -> Option<FittedTime> {
        let [begin, end] = range_db.map(|db| self.total() * 10f64.powf(-db / 10.0));
        let first = self.left.iter().position(|x| *x <= begin)?;
        let last = first + self.left[first..].iter().position(|x| *x < end)?;
        let points = (first..last).map(|n| (n as f64, 10.0 * self.left[n].log10()));
        let FittedLine { slope, unexplained, .. } = fit_line(points)?;
        let secs = -60.0 / slope / self.rate_hz;
        (slope < 0.0).then_some(FittedTime { secs, non_linearity: 1e3 * unexplained })
    }

    fn centre_samples(&self) -> f64 {
        // Summed by parts: the energy left after each sample, and the late decay after the crossing.
        let after: f64 = self.left[1..].iter().sum();
        let late = self.compensation / -(-self.crossing.rate).exp_m1();
        (after + late) / self.total()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::octave_filter::{BandWidth, OctaveBand, OctaveFilter};

    const RATE_HZ: f64 = 48e3;
    /// Samples before the arrival.
    const BEFORE: usize = 480;

    /// White noise from -1 to 1: Knuth's linear congruential generator, the upper 31 bits.
    fn white_noise(seed: u64) -> impl Iterator<Item = f64> {
        let step = |x: &u64| Some(x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407));
        std::iter::successors(Some(seed), step).skip(1).map(|x| (x >> 33) as f64 / f64::from(1 << 30) - 1.0)
    }

    /// Noise that decays at two rates, the second from 20 dB below the first, over noise at `floor_db`.
    fn noisy_decay(times_secs: [f64; 2], floor_db: f64, secs: f64) -> Vec<f64> {
        let len = (secs * RATE_HZ) as usize;
        let floor = 10f64.powf(-floor_db / 20.0);
        let mut ir: Vec<f64> = white_noise(2).take(BEFORE + len).map(|x| floor * x).collect();
        for (n, (x, noise)) in ir[BEFORE..].iter_mut().zip(white_noise(1)).enumerate() {
            let [first, second] = times_secs.map(|secs| 10f64.powf(-6.0 * n as f64 / RATE_HZ / secs));
            let late = if times_secs[0] == times_secs[1] { 0.0 } else { second / 100.0 };
            *x += noise * (first + late).sqrt();
        }
        ir
    }

    fn check_parameters(room: &RoomParameters, expected: [f64; 7]) {
        let actual = [room.edt_secs, room.t20_secs, room.t30_secs, room.c50_db, room.c80_db, room.d50, room.ts_secs];
        for (i, (actual, expected)) in actual.into_iter().zip(expected).enumerate() {
            let actual = actual.unwrap_or(f64::NAN);
            let tolerance = if (3..5).contains(&i) { 0.05 } else { 0.01 * expected };
            assert!((actual - expected).abs() <= tolerance, "{i}: {actual} for {expected}; {room:?}");
        }
        assert_eq!(room.refusals, [""; 0]);
    }

    // EDT, C50, C80, D50 and Ts by phonometry 3.3.0, `room_parameters(ir, 48000, limits=None)`; T20 and T30 by pyrato
    // 1.1.0, `energy_decay_curve_chu_lundeby`: phonometry subtracts no noise, and reads up to 0.2 % more here.
    #[test]
    fn parameters_agree_with_phonometry_and_pyrato() {
        let cases = [
            ([0.3; 2], 60.0, 0.6, [0.2954, 0.2991, 0.3000, 9.6091, 15.9005, 0.9014, 0.02192]),
            ([1.0; 2], 60.0, 1.5, [0.9976, 1.0057, 1.0024, 0.0584, 3.0958, 0.5034, 0.07213]),
            ([2.5; 2], 60.0, 3.6, [2.5165, 2.4999, 2.5015, -4.9089, -2.5265, 0.2441, 0.18131]),
            ([0.4, 1.6], 75.0, 2.6, [0.4267, 0.8023, 1.2067, 6.2019, 10.6414, 0.8066, 0.03234]),
        ];
        for (times_secs, floor_db, secs, expected) in cases {
            let ir = noisy_decay(times_secs, floor_db, secs);
            check_parameters(&compute_room_parameters(&ir, RATE_HZ, None), expected);
        }
    }

    fn octave(nominal_hz: f64) -> (OctaveBand, OctaveFilter) {
        let band = OctaveBand::from_nominal(nominal_hz, BandWidth::Octave).expect("a band");
        let filter = OctaveFilter::new(&band, RATE_HZ).expect("a filter");
        (band, filter)
    }

    // EDT, T20 and T30 by the same programs, through pyfar 0.8.1's `fractional_octave_bands(order=6)`. The energies by
    // NumPy from the spectra of both parts, weighted by the squares of SciPy's `butter(6)`: no filter delays there.
    #[test]
    fn parameters_of_bands_agree_with_others() {
        let ir = noisy_decay([1.0; 2], 60.0, 1.5);
        let cases = [
            (125.0, [1.2371, 0.8589, 0.9124, -3.6973, -1.0903, 0.29915, 0.10202]),
            (1000.0, [1.0360, 1.0465, 1.0262, -0.0896, 2.8125, 0.49484, 0.075_325]),
            (8000.0, [1.0068, 0.9957, 1.0068, -0.2644, 3.0965, 0.48479, 0.073_630]),
        ];
        for (nominal_hz, expected) in cases {
            let (band, filter) = octave(nominal_hz);
            check_parameters(&compute_room_parameters(&ir, RATE_HZ, Some((&band, &filter))), expected);
        }
    }

    // Values beside those of the same decay that is neither cut nor noisy: what differs by more than 5 %, 1.96 standard
    // deviations or 0.3 dB, and is not doubted, is wrong in silence.
    #[test]
    fn nothing_is_wrong_in_silence() {
        let [mut rows, mut given, mut doubted] = [0; 3];
        let mut wrong = Vec::new();
        for nominal_hz in [125.0, 250.0, 500.0, 1e3, 2e3, 4e3, 8e3] {
            let (band, filter) = octave(nominal_hz);
            let compute = |ir: &[f64]| compute_room_parameters(ir, RATE_HZ, Some((&band, &filter)));
            for times_secs in [[0.3; 2], [0.4; 2], [1.0; 2], [0.3, 2.0], [0.5, 1.5]] {
                let whole_secs = times_secs[1] * 2.0;
                let truth = compute(&noisy_decay(times_secs, 400.0, whole_secs));
                for (kind, floor_db, share, zeros) in [
                    ("padded", 400.0, 0.3, 1.0),
                    ("padded", 400.0, 0.7, 1.0),
                    ("padded", 400.0, 1.1, 0.1),
                    ("padded", 60.0, 1.2, 2.0),
                    ("cut", 400.0, 0.45, 0.0),
                    ("cut", 400.0, 0.7, 0.0),
                    ("cut", 400.0, 1.0, 0.0),
                    ("noisy", 30.0, 1.2, 0.0),
                    ("noisy", 40.0, 1.2, 0.0),
                    ("noisy", 50.0, 1.5, 0.0),
                    ("noisy", 60.0, 1.5, 0.0),
                ] {
                    let mut ir = noisy_decay(times_secs, floor_db, times_secs[1] * share);
                    ir.resize(ir.len() + (zeros * RATE_HZ) as usize, 0.0);
                    let room = compute(&ir);
                    let case = format!("{kind} {floor_db} dB, {share} of {times_secs:?} s at {nominal_hz} Hz");
                    rows += 1;
                    given += usize::from(room.t20_secs.is_some());
                    doubted += usize::from(!room.doubts.is_empty());
                    for (name, value, truth, deviation) in [
                        ("EDT", room.edt_secs, truth.edt_secs, None),
                        ("T20", room.t20_secs, truth.t20_secs, room.t20_deviation_secs),
                        ("T30", room.t30_secs, truth.t30_secs, room.t30_deviation_secs),
                        ("C50", room.c50_db, truth.c50_db, Some(0.3 / 1.96)),
                        ("C80", room.c80_db, truth.c80_db, Some(0.3 / 1.96)),
                        ("Ts", room.ts_secs, truth.ts_secs, None),
                    ] {
                        let Some((value, truth)) = value.zip(truth) else { continue };
                        let is_level = name.starts_with('C');
                        let limit =
                            f64::max(if is_level { 0.0 } else { 0.05 * truth }, 1.96 * deviation.unwrap_or(0.0));
                        let is_right = (value - truth).abs() <= limit;
                        if !is_right && room.doubts.is_empty() {
                            wrong.push(format!("{case}: {name} {value} for {truth}, range {:?}", room.range_db));
                        }
                    }
                }
            }
        }
        assert!(wrong.is_empty(), "{} of {rows} rows:\n{}", wrong.len(), wrong.join("\n"));
        assert!(rows > 380 && given > rows / 2 && doubted < rows / 2, "{rows} {given} {doubted}");
    }

    // The true times, whatever the floor; what the floor does not allow is refused.
    #[test]
    fn noise_moves_no_time() {
        for secs in [0.3, 1.0, 2.5] {
            for floor_db in [28.0, 37.0, 47.0, 80.0] {
                let ir = noisy_decay([secs; 2], floor_db, secs * floor_db / 60.0 * 1.4 + 0.1);
                let room = compute_room_parameters(&ir, RATE_HZ, None);
                assert!(room.range_db.is_some_and(|db| (db - floor_db).abs() < 0.6), "{room:?}");
                assert!(room.edt_secs.is_some_and(|edt| (edt / secs - 1.0).abs() < 0.03), "{room:?}");
                for (time, least_db) in [(room.t20_secs, T20_RANGE_DB), (room.t30_secs, T30_RANGE_DB)] {
                    let is_right = time.map(|time| (time / secs - 1.0).abs() < 0.01);
                    assert_eq!(is_right, (floor_db > least_db).then_some(true), "{floor_db} dB: {room:?}");
                }
                assert_eq!(room.refusals.is_empty(), floor_db > T30_RANGE_DB, "{room:?}");
            }
        }
    }

    // e^(-n/1000) without noise, cut off 48 dB down: T = 1000 * 6 ln 10 samples, Ts = 1000 samples.
    #[test]
    fn an_exponential_has_its_parameters() {
        let ir: Vec<f64> = (0..11_000).map(|n| (-f64::from(n) / 2000.0).exp()).collect();
        let secs = 6000.0 * 10f64.ln() / RATE_HZ;
        let late = [-2.4f64, -3.84].map(f64::exp);
        let [c50, c80] = late.map(|late| 10.0 * ((1.0 - late) / late).log10());
        let room = compute_room_parameters(&ir, RATE_HZ, None);
        check_parameters(&room, [secs, secs, secs, c50, c80, 1.0 - late[0], 1000.0 / RATE_HZ]);
    }

    #[test]
    fn what_has_no_parameters_says_why() {
        let refusal = |ir: &[f64], nominal_hz: Option<f64>| {
            let octave = nominal_hz.map(octave);
            let room = compute_room_parameters(ir, RATE_HZ, octave.as_ref().map(|(band, filter)| (band, filter)));
            (room.t20_secs, room.refusals.join("; "))
        };
        let noise: Vec<f64> = white_noise(3).take(48_000).collect();
        let decay = noisy_decay([0.1; 2], 70.0, 0.3);
        let endless: Vec<f64> = (0..48_000).map(|n| 10f64.powf(-9.0 * f64::from(n) / 48e3)).collect();
        let cases = [
            (&[0.0; 4800][..], None, "there is no sound"),
            (&noise[..384], None, "it is 8.0 ms long after its arrival, of at least 50 ms"),
            (&noise[..], None, "it does not decay into its noise on a line"),
            (&decay, Some(125.0), "less than 0.180 s, which the band's filter needs"),
            (&endless, None, "a range of 180 dB, of at most 144 dB: its end was not measured"),
            (&noisy_decay([0.1; 2], 30.0, 0.3), None, "of at least 35 dB for T20, 45 dB for T30"),
            (&noisy_decay([0.1; 2], 37.0, 0.3), None, "C50 and D50 need 50 ms, C80 80 ms"),
        ];
        for (ir, width_hz, expected) in cases {
            let (t20, actual) = refusal(ir, width_hz);
            assert!(actual.contains(expected), "{actual}");
            assert!(t20.is_none() || expected.contains("C80"), "{actual}");
        }
    }
}
