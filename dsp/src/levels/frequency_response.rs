//! Level, phase and group delay of a response over frequency.

use std::sync::Arc;

use realfft::RealToComplex;
use realfft::num_complex::Complex;

use crate::error::{check_finite, check_len};
use crate::level::plotted_power_to_db;
use crate::{Error, RealSample};

/// Zeros that are appended: phase then turns by a quarter of a circle at most from bin to bin.
const PADDING: usize = 4;

/// Responses of one length over a range of frequencies.
///
/// ```
/// use echolake_dsp::frequency_response::{FrequencyResponse, FrequencyResponsePlan};
///
/// let plan = FrequencyResponsePlan::new(64, 96e3, [2e3, 40e3])?;
/// let mut impulse = [0.0; 64];
/// impulse[48] = 10.0;
/// let mut found = FrequencyResponse::default();
/// plan.compute_response(&impulse, 1.0 / 3.0, 0.5e-3, &mut found, &mut plan.make_scratch())?;
/// assert!(found.level_db.iter().all(|level| (level - 20.0).abs() < 1e-9));
/// assert!(found.phase_deg.iter().chain(&found.group_delay_secs).all(|x| x.abs() < 1e-6));
/// # Ok::<(), echolake_dsp::Error>(())
/// ```
pub struct FrequencyResponsePlan {
    len: usize,
    padded_len: usize,
    rate_hz: f64,
    /// First and last bin of the range.
    range: [usize; 2],
    forward: Arc<dyn RealToComplex<f64>>,
}

/// A response over frequency, by bin of the range.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FrequencyResponse {
    /// Level re 1 of the mean power over the octaves, dB; -200 dB at least.
    pub level_db: Vec<f64>,
    /// Phase after the removed delay, unwrapped upwards from the range's lowest frequency; not smoothed.
    pub phase_deg: Vec<f64>,
    /// Group delay after the removed delay: a mean over the octaves, weighted by power.
    pub group_delay_secs: Vec<f64>,
}

/// Buffers of a [`FrequencyResponsePlan`].
pub struct FrequencyResponseScratch {
    signal: Vec<f64>,
    spectrum: Vec<Complex<f64>>,
    delayed: Vec<Complex<f64>>,
    work: Vec<Complex<f64>>,
    values: Vec<f64>,
    sums: Vec<f64>,
    power: Vec<f64>,
}

impl FrequencyResponsePlan {
    /// Plans for responses of `len` samples, between two frequencies.
    ///
    /// # Errors
    /// [`Error::Setting`] if there are no samples, or no bins in the range.
    pub fn new(len: usize, rate_hz: f64, [low_hz, high_hz]: [f64; 2]) -> Result<Self, Error> {
        let padded_len = (PADDING * len.max(2)).next_power_of_two();
        let bin = |frequency_hz: f64| frequency_hz * padded_len as f64 / rate_hz;
        let first = (bin(low_hz).ceil() as usize).max(1);
        let last = (bin(high_hz).floor() as usize).min(padded_len / 2);
        if len == 0 || first > last {
            let actual = format!("{low_hz} to {high_hz} Hz of {len} samples");
            return Err(Error::Setting { what: "the range", actual, expected: "frequencies below half the rate" });
        }
        Ok(Self { len, padded_len, rate_hz, range: [first, last], forward: f64::plan_real_forward(padded_len) })
    }

    /// Frequencies of the range's bins, Hz.
    pub fn frequencies_hz(&self) -> impl Iterator<Item = f64> {
        let [first, last] = self.range;
        let width_hz = self.rate_hz / self.padded_len as f64;
        (first..=last).map(move |bin| bin as f64 * width_hz)
    }

    /// Buffers for [`Self::compute_response`]; one per thread.
    pub fn make_scratch(&self) -> FrequencyResponseScratch {
        let bins = self.padded_len / 2 + 1;
        FrequencyResponseScratch {
            signal: self.forward.make_input_vec(),
            spectrum: self.forward.make_output_vec(),
            delayed: self.forward.make_output_vec(),
            work: self.forward.make_scratch_vec(),
            values: vec![0.0; bins],
            sums: vec![0.0; bins],
            power: vec![0.0; bins],
        }
    }

    /// Computes level, phase and group delay.
    ///
    /// response      `[len]`
    /// octaves       width of the means, rectangular on a logarithmic axis; 0: none are taken
    /// removed_secs  delay that is taken off phase and group delay
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn compute_response(
        &self,
        response: &[f64],
        octaves: f64,
        removed_secs: f64,
        found: &mut FrequencyResponse,
        scratch: &mut FrequencyResponseScratch,
    ) -> Result<(), Error> {
        check_len("the response", response.len(), self.len)?;
        check_finite("the response", response)?;
        let FrequencyResponseScratch { signal, spectrum, delayed, work, values, sums, power } = scratch;
        self.transform_samples(response.iter().copied(), signal, spectrum, work);
        let times = (0..self.len).map(|n| n as f64 / self.rate_hz);
        self.transform_samples(response.iter().zip(times).map(|(x, time)| x * time), signal, delayed, work);
        let [first, last] = self.range;

        values.iter_mut().zip(&*spectrum).for_each(|(out, x)| *out = x.norm_sqr());
        add_up(values, sums);
        power.fill(0.0);
        (first..=last).for_each(|bin| power[bin] = mean_around(values, sums, bin, octaves));
        found.level_db.clear();
        found.level_db.extend(power[first..=last].iter().map(|power| plotted_power_to_db(*power)));

        // Group delay is the real part of the spectrum of t h(t) over that of h(t); here times the power.
        let products = delayed.iter().zip(&*spectrum).map(|(delayed, own)| (delayed * own.conj()).re);
        values.iter_mut().zip(products).for_each(|(out, product)| *out = product);
        add_up(values, sums);
        found.group_delay_secs.clear();
        found.group_delay_secs.extend(
            (first..=last)
                .map(|bin| mean_around(values, sums, bin, octaves) / (power[bin] + f64::MIN_POSITIVE) - removed_secs),
        );

        let turn = std::f64::consts::TAU * removed_secs * self.rate_hz / self.padded_len as f64;
        found.phase_deg.clear();
        found.phase_deg.extend((first..=last).map(|bin| (spectrum[bin].arg() + turn * bin as f64).to_degrees()));
        unwrap_phase(&mut found.phase_deg);
        Ok(())
    }

    fn transform_samples(
        &self,
        samples: impl Iterator<Item = f64>,
        signal: &mut [f64],
        spectrum: &mut [Complex<f64>],
        work: &mut [Complex<f64>],
    ) {
        signal.fill(0.0);
        signal.iter_mut().zip(samples).for_each(|(to, x)| *to = x);
        // It fails for other lengths alone, and these are the plan's.
        let _ = self.forward.process_with_scratch(signal, spectrum, work);
    }
}

/// Integrates values over the logarithm of frequency, up to each bin from the first above 0 Hz; between two bins the
/// values are linear over the logarithm.
fn add_up(values: &[f64], sums: &mut [f64]) {
    sums[..2].fill(0.0);
    for bin in 1..values.len() - 1 {
        let step = ((bin + 1) as f64 / bin as f64).ln();
        sums[bin + 1] = sums[bin] + (values[bin] + values[bin + 1]) / 2.0 * step;
    }
}

/// Mean of values over `octaves` around a bin, by their integral.
fn mean_around(values: &[f64], sums: &[f64], bin: usize, octaves: f64) -> f64 {
    let half = (octaves / 2.0).exp2();
    let low = (bin as f64 / half).max(1.0);
    let high = (bin as f64 * half).min((values.len() - 1) as f64);
    if low >= high {
        return values[bin];
    }
    (sum_up_to(values, sums, high) - sum_up_to(values, sums, low)) / (high / low).ln()
}

fn sum_up_to(values: &[f64], sums: &[f64], position: f64) -> f64 {
    let bin = (position.floor() as usize).clamp(1, values.len() - 2);
    let share = (position / bin as f64).ln();
    let step = ((bin + 1) as f64 / bin as f64).ln();
    sums[bin] + values[bin] * share + (values[bin + 1] - values[bin]) * share * share / (2.0 * step)
}

/// Removes jumps of more than half a circle; the first angle comes within half a circle of zero.
fn unwrap_phase(degrees: &mut [f64]) {
    let mut turns = 0.0;
    let mut before = 0.0;
    for angle in degrees {
        turns -= 360.0 * ((*angle - before) / 360.0).round();
        before = *angle;
        *angle += turns;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE_HZ: f64 = 96e3;

    fn impulse(at: usize, height: f64) -> Vec<f64> {
        let mut samples = vec![0.0; 384];
        samples[at] = height;
        samples
    }

    fn analysed(response: &[f64], octaves: f64, removed_secs: f64) -> (Vec<f64>, FrequencyResponse) {
        let plan = FrequencyResponsePlan::new(response.len(), RATE_HZ, [2e3, 40e3]).expect("a plan");
        let mut scratch = plan.make_scratch();
        let mut found = FrequencyResponse { level_db: vec![f64::NAN; 3], ..FrequencyResponse::default() };
        plan.compute_response(&impulse(3, 2.0)[..response.len()], 0.5, 0.1, &mut found, &mut scratch)
            .expect("a dirty scratch");
        plan.compute_response(response, octaves, removed_secs, &mut found, &mut scratch).expect("a response");
        let frequencies: Vec<f64> = plan.frequencies_hz().collect();
        assert_eq!(frequencies.len(), found.level_db.len());
        (frequencies, found)
    }

    fn assert_near(actual: &[f64], expected: impl Fn(usize) -> f64, tolerance: f64) {
        for (i, value) in actual.iter().enumerate() {
            assert!((value - expected(i)).abs() <= tolerance, "{i}: {value}, expected {}", expected(i));
        }
    }

    #[test]
    fn an_impulse_has_a_flat_level_and_its_delay_also_smoothed() {
        for octaves in [0.0, 1.0 / 12.0, 1.0 / 3.0, 1.0] {
            let (frequencies, found) = analysed(&impulse(59, 0.5), octaves, 0.0);
            assert_near(&found.level_db, |_| 20.0 * 0.5f64.log10(), 1e-9);
            assert_near(&found.group_delay_secs, |_| 59.0 / RATE_HZ, 1e-12);
            assert!((frequencies[0] - 2e3).abs() < 47.0 && (frequencies[frequencies.len() - 1] - 40e3).abs() < 47.0);
        }
    }

    #[test]
    fn phase_is_a_straight_line_of_what_is_left_of_the_delay() {
        let removed_secs = 59.0 / RATE_HZ;
        let (_, still) = analysed(&impulse(59, 1.0), 0.0, removed_secs);
        assert_near(&still.phase_deg, |_| 0.0, 1e-6);
        assert_near(&still.group_delay_secs, |_| 0.0, 1e-12);
        let (frequencies, moving) = analysed(&impulse(62, 1.0), 0.0, removed_secs);
        assert_near(&moving.phase_deg, |i| -360.0 * frequencies[i] * 3.0 / RATE_HZ, 1e-6);
        let (_, negative) = analysed(&impulse(59, -1.0), 0.0, removed_secs);
        assert!(negative.phase_deg.iter().all(|phase| (phase.abs() - 180.0).abs() < 1e-6));
    }

    #[test]
    fn two_impulses_make_a_comb() {
        let mut samples = impulse(40, 1.0);
        samples[60] = 0.5;
        let (frequencies, found) = analysed(&samples, 0.0, 0.0);
        let cosine = |i: usize| (std::f64::consts::TAU * frequencies[i] * 20.0 / RATE_HZ).cos();
        assert_near(&found.level_db, |i| 10.0 * (1.25 + cosine(i)).log10(), 1e-9);
        let late = |i: usize| (0.25 + 0.5 * cosine(i)) / (1.25 + cosine(i));
        assert_near(&found.group_delay_secs, |i| (40.0 + 20.0 * late(i)) / RATE_HZ, 1e-12);
    }

    #[test]
    fn a_power_that_grows_with_frequency_has_its_mean_over_the_logarithm() {
        let power: Vec<f64> = (0..2049).map(f64::from).collect();
        let mut sums = vec![f64::NAN; power.len()];
        add_up(&power, &mut sums);
        for octaves in [1.0 / 12.0, 1.0 / 3.0, 1.0] {
            let half = f64::exp2(octaves / 2.0);
            let expected = (half - 1.0 / half) / (octaves * std::f64::consts::LN_2);
            // Between bins it is linear over the logarithm: 1/8k of the width off.
            for bin in 40..1400 {
                let mean = mean_around(&power, &sums, bin, octaves) / bin as f64;
                assert!((mean - expected).abs() < 1e-4, "bin {bin} over {octaves} octaves: {mean}");
            }
        }
        assert_eq!(mean_around(&power, &sums, 7, 0.0), 7.0, "a mean over no octaves");
    }

    #[test]
    fn angles_are_unwrapped_upwards() {
        let mut degrees = [350.0, 10.0, 200.0, -170.0];
        unwrap_phase(&mut degrees);
        assert_eq!(degrees, [-10.0, 10.0, -160.0, -170.0]);
        unwrap_phase(&mut []);
    }

    #[test]
    fn bad_settings_and_signals_are_refused() {
        for (len, range) in [(0, [2e3, 40e3]), (64, [40e3, 2e3]), (64, [60e3, 70e3])] {
            assert!(FrequencyResponsePlan::new(len, RATE_HZ, range).is_err(), "{len} {range:?}");
        }
        let plan = FrequencyResponsePlan::new(2, RATE_HZ, [2e3, 40e3]).expect("a plan");
        let mut found = FrequencyResponse::default();
        let mut scratch = plan.make_scratch();
        let short = plan.compute_response(&[0.0], 0.0, 0.0, &mut found, &mut scratch);
        assert!(matches!(short, Err(Error::Length { .. })));
        let infinite = plan.compute_response(&[0.0, f64::INFINITY], 0.0, 0.0, &mut found, &mut scratch);
        assert_eq!(infinite, Err(Error::NotFinite { what: "the response" }));
        plan.compute_response(&[0.0; 2], 1.0, 0.0, &mut found, &mut scratch).expect("silence");
        assert!(found.level_db.iter().all(|level| *level == -200.0), "{found:?}");
        assert!(found.group_delay_secs.iter().all(|delay| *delay == 0.0), "{found:?}");
    }
}
