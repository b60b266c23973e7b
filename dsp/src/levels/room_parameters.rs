//! Reverberation times, clarity, definition and centre time of a room's impulse response.

use super::noise_crossing::{NoiseCrossing, find_noise_crossing, fit_line};
use crate::RealSample;
use crate::arrival::first_arrival;
use crate::octave_filter::ARRIVAL_DB;

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
/// Bandwidth times reverberation time at least; less is the filter's own decay. ISO 3382-2:2008, 7.3.
const LEAST_BANDWIDTH_TIME: f64 = 16.0;

/// Parameters of a response; None where the response does not have what one needs.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RoomParameters {
    /// Early decay time: of 60 dB at the slope between 0 and -10 dB, s.
    pub edt_secs: Option<f64>,
    /// Reverberation time: of 60 dB at the slope between -5 and -25 dB, s.
    pub t20_secs: Option<f64>,
    /// Reverberation time: of 60 dB at the slope between -5 and -35 dB, s.
    pub t30_secs: Option<f64>,
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
}

/// Schroeder's curve from the arrival to the crossing with the noise.
struct CompensatedDecay {
    /// Energy from each sample to the end of all time.
    left: Vec<f64>,
    /// The last of it, which the crossing's line foretells.
    compensation: f64,
    crossing: NoiseCrossing,
    rate_hz: f64,
}

/// Computes the parameters of a response, in all its frequencies or filtered to a band, whose width is then given.
///
/// Time counts from the arrival: the first sample at -20 dB re the greatest. The noise's power is subtracted, the
/// integral ends where the late decay meets the noise, and the energy after that is added as the late decay's.
///
/// ir  `[n]`, any unit
///
/// Source: ISO 3382-1:2009, 5.3.3 and annex A; ISO 3382-2:2008, 7.3 and annex C; Guski and Vorlaender 2014, Acta
/// Acustica united with Acustica 100:320-327, for the subtraction together with truncation and compensation.
///
/// ```
/// // A decay of 60 dB a second, without noise.
/// let ir: Vec<f64> = (0..8000).map(|n| 10f64.powf(-3.0 * f64::from(n) / 8000.0)).collect();
/// let room = echolake_dsp::room_parameters::compute_room_parameters(&ir, 8e3, None);
/// assert!(room.t20_secs.is_some_and(|secs| (secs - 1.0).abs() < 1e-3));
/// ```
pub fn compute_room_parameters<T: RealSample>(ir: &[T], rate_hz: f64, width_hz: Option<f64>) -> RoomParameters {
    let mut room = RoomParameters::default();
    let Some(arrival) = first_arrival(ir, ARRIVAL_DB) else {
        room.refusals.push("there is no sound".into());
        return room;
    };
    let arrived = &ir[arrival.ceil() as usize..];
    let silent = arrived.iter().rev().take_while(|x| **x == T::default()).count();
    let arrived = &arrived[..arrived.len() - silent];
    let secs = arrived.len() as f64 / rate_hz;
    if secs < SHORTEST_SECS {
        room.refusals.push(format!("it is {:.1} ms long after its arrival, of at least 50 ms", secs * 1e3));
        return room;
    }
    let power: Vec<f64> = arrived.iter().map(|x| x.f64() * x.f64()).collect();
    let Some(decay) = CompensatedDecay::new(power, rate_hz) else {
        room.refusals.push("it does not decay into its noise on a line".into());
        return room;
    };
    room.evaluate_decay(&decay, width_hz);
    room
}

/// Returns whether responses of so many samples can have parameters.
pub fn is_long_enough(samples: usize, rate_hz: f64) -> bool {
    samples as f64 >= SHORTEST_SECS * rate_hz
}

impl RoomParameters {
    fn evaluate_decay(&mut self, decay: &CompensatedDecay, width_hz: Option<f64>) {
        let range_db = decay.range_db();
        self.range_db = Some(range_db);
        let needs = [("EDT, C50, C80, D50 and Ts", EDT_RANGE_DB), ("T20", T20_RANGE_DB), ("T30", T30_RANGE_DB)];
        let missing: Vec<_> = needs.iter().filter(|(_, least)| range_db < *least).collect();
        if !missing.is_empty() {
            let needs: Vec<_> = missing.iter().map(|(what, least)| format!("{least} dB for {what}")).collect();
            self.refusals.push(format!("the decay has a range of {range_db:.1} dB, of at least {}", needs.join(", ")));
        }
        if range_db < EDT_RANGE_DB {
            return;
        }
        self.edt_secs = self.accept_time("EDT", decay.fit_time([0.0, 10.0]), width_hz);
        if range_db >= T20_RANGE_DB {
            self.t20_secs = self.accept_time("T20", decay.fit_time([5.0, 25.0]), width_hz);
        }
        if range_db >= T30_RANGE_DB {
            self.t30_secs = self.accept_time("T30", decay.fit_time([5.0, 35.0]), width_hz);
        }
        let [definition, share] = EARLY_SECS.map(|secs| decay.early_share(secs));
        if share.is_none() {
            let ms = decay.left.len() as f64 / decay.rate_hz * 1e3;
            self.refusals.push(format!("the noise is reached after {ms:.1} ms: C50 and D50 need 50 ms, C80 80 ms"));
        }
        let clarity = |share: f64| 10.0 * (share / (1.0 - share)).log10();
        self.c50_db = definition.map(clarity);
        self.c80_db = share.map(clarity);
        self.d50 = definition;
        self.ts_secs = Some(decay.centre_secs());
    }

    fn accept_time(&mut self, name: &str, secs: Option<f64>, width_hz: Option<f64>) -> Option<f64> {
        let least = width_hz.map_or(0.0, |hz| LEAST_BANDWIDTH_TIME / hz);
        match secs {
            Some(secs) if secs >= least => return Some(secs),
            Some(secs) => {
                let cause = "which the band's filter needs";
                self.refusals.push(format!("{name} is {secs:.3} s, less than {least:.3} s, {cause}"));
            }
            None => self.refusals.push(format!("{name} has too few samples")),
        }
        None
    }
}

impl CompensatedDecay {
    fn new(mut power: Vec<f64>, rate_hz: f64) -> Option<Self> {
        let crossing = find_noise_crossing(&power, rate_hz)?;
        power.truncate(crossing.samples.round() as usize);
        let compensation = crossing.power / -(-crossing.rate).exp_m1();
        let mut sum = compensation;
        for x in power.iter_mut().rev() {
            sum += *x - crossing.noise;
            *x = sum;
        }
        (compensation > 0.0 && sum > compensation).then_some(Self { left: power, compensation, crossing, rate_hz })
    }

    fn total(&self) -> f64 {
        self.left[0]
    }

    fn range_db(&self) -> f64 {
        10.0 * (self.total() / self.compensation).log10()
    }

    /// Time of 60 dB at the slope between two levels below the start of the curve, s.
    fn fit_time(&self, range_db: [f64; 2]) -> Option<f64> {
        let [begin, end] = range_db.map(|db| self.total() * 10f64.powf(-db / 10.0));
        let first = self.left.iter().position(|x| *x <= begin)?;
        let last = first + self.left[first..].iter().position(|x| *x < end)?;
        let points = (first..last).map(|n| (n as f64, 10.0 * self.left[n].log10()));
        let [_, slope] = fit_line(points)?;
        (slope < 0.0).then(|| -60.0 / slope / self.rate_hz)
    }

    /// Share of the energy that is there until a time, below 1; None if the noise is reached before.
    fn early_share(&self, secs: f64) -> Option<f64> {
        let late = *self.left.get((secs * self.rate_hz).round() as usize)?;
        (late > 0.0).then(|| 1.0 - late / self.total())
    }

    fn centre_secs(&self) -> f64 {
        // Summed by parts: the energy left after each sample, and the late decay after the crossing.
        let after: f64 = self.left[1..].iter().sum();
        let late = self.compensation / -(-self.crossing.rate).exp_m1();
        (after + late) / self.total() / self.rate_hz
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

    // The same programs, through pyfar 0.8.1's `fractional_octave_bands(order=6)`.
    #[test]
    fn parameters_of_bands_agree_with_pyfar() {
        let ir = noisy_decay([1.0; 2], 60.0, 1.5);
        let cases = [
            (125.0, [1.2371, 0.8589, 0.9124, -4.2684, -1.4978, 0.2723, 0.1081]),
            (1000.0, [1.0360, 1.0465, 1.0262, -0.1270, 2.8258, 0.4927, 0.0759]),
            (8000.0, [1.0068, 0.9957, 1.0068, -0.2659, 3.0888, 0.4847, 0.0736]),
        ];
        for (nominal_hz, expected) in cases {
            let band = OctaveBand::from_nominal(nominal_hz, BandWidth::Octave).expect("a band");
            let filter = OctaveFilter::new(&band, RATE_HZ).expect("a filter");
            let mut filtered = vec![0.0; ir.len()];
            filter.filter_samples(&ir, &mut filtered).expect("filtered");
            let whole = &filtered[..ir.len() - filter.delay()];
            check_parameters(&compute_room_parameters(whole, RATE_HZ, Some(band.width_hz())), expected);
        }
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
        let refusal = |ir: &[f64], width_hz| {
            let room = compute_room_parameters(ir, RATE_HZ, width_hz);
            (room.t20_secs, room.refusals.join("; "))
        };
        let noise: Vec<f64> = white_noise(3).take(48_000).collect();
        let decay = noisy_decay([0.1; 2], 70.0, 0.3);
        let cases = [
            (&[0.0; 4800][..], None, "there is no sound"),
            (&noise[..384], None, "it is 8.0 ms long after its arrival, of at least 50 ms"),
            (&noise[..], None, "it does not decay into its noise on a line"),
            (&decay, Some(88.7), "T20 is 0.098 s, less than 0.180 s, which the band's filter needs"),
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
