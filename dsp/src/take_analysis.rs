//! Judgement of a take: does the loopback match the played sweep, do the clocks agree, is any sample missing?
//!
//! Everything follows from two quotients of spectra, loopback over played sweep and recording over loopback, as
//! analytic responses. A sweep passes each frequency once, so that what is wrong at one time is wrong at one frequency:
//!
//! - a response to a sweep played by another clock is a chirp whose phase is known ([`SineSweep::phase_cycles`]);
//! - behind a lost sample all frequencies arrive earlier, and the step rings before the first arrival;
//! - distortion of an exponential sweep arrives earlier than the response, by a time per order (Farina 2000). That of a
//!   linear sweep is spread over all times before it.

mod clock;
mod dropout;
mod fault;
mod harmonics;

use std::borrow::Cow;
use std::f64::consts::TAU;
use std::ops::Range;
use std::sync::Arc;

use echolake_schema::SweepShape;
use realfft::num_complex::Complex;
use realfft::{ComplexToReal, RealToComplex};
use rustfft::{Fft, FftDirection};

use crate::deconvolution::{JointSpectrum, fast_length};
use crate::error::check_len;
use crate::level::power_to_db;
use crate::oversampling::{greatest_magnitude, oversampled_peak};
use crate::sweep::SineSweep;
use crate::{Error, RealSample};

pub use fault::{TakeChannel, TakeFault};
pub use harmonics::{HARMONIC_ORDERS, TakeDistortion};

/// Bins side by side.
const LANES: usize = 4;
/// Greatest clock ratio that is searched, as a fraction: 3000 ppm.
const MAX_CLOCK_RATIO: f64 = 3e-3;
/// Width of the sin^4 at both limits of the sweep's range, Hz: it rings for 0.5 ms. At most a quarter of the range.
const TAPER_HZ: f64 = 4e3;
/// Taper of an exponential sweep's second search for lost samples, as a part of [`TAPER_HZ`]; its windows are as many
/// times longer. Most of the time of such a sweep is within 4 kHz of its lower limit.
const FINE_PARTS: f64 = 16.0;
/// Time before an arrival that its own ringing fills, s.
const RINGING_SECS: f64 = 0.5e-3;
/// Time by which sound may seem to arrive before it is played: its own ringing.
const EARLY_SECS: f64 = 0.125e-3;
/// Least share of the greatest sample at which a response begins.
const ONSET_SHARE: f64 = 0.1;
/// Least energy of a loopback's response at its peak over its energy elsewhere, dB.
const MATCH_DB: f64 = 20.0;
/// The same of the two greatest peaks, if the loopback lost samples.
const TORN_MATCH_DB: f64 = 10.0;
/// Least energy at the peak over that elsewhere at which two channels are one signal, dB.
const SAME_SIGNAL_DB: f64 = 30.0;
/// Least energy behind an arrival over that before it, dB: noise alone has 0.
const CAUSAL_DB: f64 = 3.0;
/// Least power of a response's greatest sample over the mean, dB: that of noise is 10 to 12.
const PEAK_DB: f64 = 15.0;
/// Allowed drift of two clocks over the sweep, periods of its highest frequency, if the loopback is a digital copy of
/// the sweep or there is none: 45 ppm for the paper's rig.
const MAX_DRIFT_CYCLES: f64 = 0.9;
/// Least drift that is told from dispersion, periods.
const LEAST_DRIFT_CYCLES: f64 = 0.1;
/// Greatest share of a loopback that is no delayed copy of the sweep, if it is a digital one.
const DIGITAL_COPY_SHARE: f64 = 1e-7;

/// What a take is, apart from its response.
#[derive(Debug, Clone, PartialEq)]
pub struct TakeAnalysis {
    /// Energy of the loopback's response to the played sweep within 0.5 ms of its peak, over that of all the rest, dB;
    /// NaN without a loopback.
    pub loopback_match_db: f64,
    /// Rate of the playing clock over that of the recording one, less 1, ppm: of the loopback against the played sweep,
    /// and of the recording against the loopback if that is a digital copy of the sweep.
    /// NaN if neither shows the sweep.
    pub clock_ratio_ppm: f64,
    /// The same of the loopback, which is a digital copy of the sweep, against the recording, if it can be
    /// distinguished from dispersion: the recording is to be stretched by it.
    pub recording_clock_ppm: Option<f64>,
    /// Distortion of the recording by order; None if the sweep is linear, or not in the recording.
    pub distortion: Option<TakeDistortion>,
    /// Faults of the take.
    pub faults: Vec<TakeFault>,
}

impl TakeAnalysis {
    /// Makes the analysis of a take of which nothing is known.
    pub fn unknown() -> Self {
        Self {
            loopback_match_db: f64::NAN,
            clock_ratio_ppm: f64::NAN,
            recording_clock_ppm: None,
            distortion: None,
            faults: Vec::new(),
        }
    }
}

/// Analyses takes of one sweep and one length.
pub struct TakeAnalyzer {
    sweep: SineSweep,
    recording_len: usize,
    forward: Arc<dyn RealToComplex<f32>>,
    inverse: Arc<dyn Fft<f32>>,
    real_inverse: Arc<dyn ComplexToReal<f32>>,
    short: ShortTransform,
    /// Of exponential sweeps: gains of bins and transforms for lost samples near the limits of the range.
    fine: Option<(TaperedRange, ShortTransform)>,
    played: Vec<Complex<f32>>,
    tapered: TaperedRange,
    /// Squares of these bins' gains over the played sweep's powers.
    copy_weights: Vec<f64>,
}

/// Gains of bins, and those bins that have one.
struct TaperedRange {
    gains: Vec<f32>,
    range: Range<usize>,
}

/// Transforms of a response's vicinity, `[len]`, with its onset in the middle.
struct ShortTransform {
    len: usize,
    step_hz: f64,
    forward: Arc<dyn Fft<f32>>,
    inverse: Arc<dyn Fft<f32>>,
    /// Bins in the sweep's range.
    swept: Range<usize>,
    /// Bins whose taper is at least a half, and the weights of their phases in a clock ratio.
    core: Range<usize>,
    drift_weights: Vec<f64>,
    /// Bins of each part of the sweep, and the window before an arrival.
    parts: Vec<Range<usize>>,
    window: Vec<f32>,
    /// Samples between window and arrival.
    guard: usize,
}

/// Buffers of a [`TakeAnalyzer`].
#[derive(Default)]
pub struct TakeScratch {
    /// Spectra of the recording and the loopback.
    spectra: [Vec<Complex<f32>>; 2],
    signal: Vec<f32>,
    quotient: Vec<Complex<f32>>,
    transform: TransformScratch,
}

/// Memory for transforms.
#[derive(Default)]
struct TransformScratch {
    work: Vec<Complex<f32>>,
    /// Samples and powers of responses that are judged.
    judged: Vec<(Vec<Complex<f32>>, Vec<f32>)>,
}

/// A response to a sweep.
struct SweepResponse {
    /// `[n]`: the analytic response, sample 0 without delay, those before it at the end.
    samples: Vec<Complex<f32>>,
    /// `[n]`: their squares, and the sums of all and of those that are not in the vicinity.
    powers: Vec<f32>,
    energy: f64,
    farther_energy: f64,
    /// Samples of the peak and of the first arrival; negative if the recording began later.
    peak: i64,
    onset: i64,
    vicinity: OnsetVicinity,
}

/// Vicinity of an onset, `[short]`.
#[derive(Clone)]
struct OnsetVicinity {
    spectrum: Vec<Complex<f32>>,
    samples: Vec<Complex<f32>>,
    powers: Vec<f32>,
}

impl TakeAnalyzer {
    /// Plans for recordings of `recording_len` samples with this sweep in them.
    ///
    /// # Errors
    /// [`Error::Setting`] if there is no sweep or no recording.
    pub fn new(sweep: SineSweep, recording_len: usize) -> Result<Self, Error> {
        if sweep.len() < 2 || recording_len < 2 || !(0.0 < sweep.low_hz && sweep.low_hz < sweep.high_hz) {
            let actual = format!("{} samples in a recording of {recording_len}", sweep.len());
            return Err(Error::Setting { what: "the sweep", actual, expected: "2 samples or more, and a range" });
        }
        let n = fast_length(recording_len);
        let forward = f32::plan_real_forward(n);
        let spread = 8.0 * MAX_CLOCK_RATIO * sweep.duration_secs;
        let short = (sweep.rate_hz * spread.max(0.04)) as usize;
        let short = short.next_power_of_two().min(n);
        let mut played = forward.make_output_vec();
        let mut samples: Vec<f32> = sweep.samples().into_iter().map(|x| x as f32).collect();
        samples.resize(n, 0.0);
        // The lengths are the plan's own.
        let _ = forward.process(&mut samples, &mut played);
        let tapered = |taper_hz: f64| {
            let gain = |k: usize| taper_gain(&sweep, k as f64 * sweep.rate_hz / n as f64, taper_hz) as f32;
            let gains: Vec<f32> = (0..played.len()).map(gain).collect();
            let first = gains.iter().position(|gain| *gain > 0.0).unwrap_or(0);
            let count = gains.iter().filter(|gain| **gain > 0.0).count();
            TaperedRange { gains, range: first..first + count }
        };
        let fine = (sweep.shape == SweepShape::Exponential).then(|| {
            let secs = FINE_PARTS * 5.0 * dropout::WINDOW_SECS;
            let short = ((sweep.rate_hz * secs) as usize).next_power_of_two().min(n);
            (tapered(TAPER_HZ / FINE_PARTS), ShortTransform::new(&sweep, short, FINE_PARTS))
        });
        let tapered = tapered(TAPER_HZ);
        let TaperedRange { gains, range } = &tapered;
        let weight = |(gain, bin): (&f32, &Complex<f32>)| f64::from(*gain).powi(2) / widen(*bin).norm_sqr();
        Ok(Self {
            short: ShortTransform::new(&sweep, short, 1.0),
            fine,
            inverse: f32::plan_fft(n, FftDirection::Inverse),
            real_inverse: f32::plan_real_inverse(n),
            copy_weights: gains[range.clone()].iter().zip(&played[range.clone()]).map(weight).collect(),
            sweep,
            recording_len,
            forward,
            played,
            tapered,
        })
    }

    /// Analyses a take; samples are fractions of full scale.
    ///
    /// recording `[recording_len]`, loopback `[recording_len]` if there is one
    ///
    /// # Errors
    /// [`Error::Length`]; [`Error::NotFinite`].
    pub fn analyze_take(&self, recording: &[f32], loopback: Option<&[f32]>) -> Result<TakeAnalysis, Error> {
        let TakeScratch { spectra: [recorded, looped], signal, transform, .. } = &mut TakeScratch::default();
        self.transform_signal("the recording", recording, recorded, signal, transform)?;
        if let Some(loopback) = loopback {
            self.transform_signal("the loopback", loopback, looped, signal, transform)?;
        }
        let looped = loopback.is_some().then_some(looped.as_slice());
        Ok(self.analyze_spectra([Some(recording), loopback], recorded, looped, transform))
    }

    /// Gains of bins for [`Self::deconvolve_take`]: 1 in the sweep's range, with half cosines of this width, Hz, at
    /// both limits.
    pub fn taper_gains(&self, width_hz: f64) -> Vec<f32> {
        let width_hz = width_hz.min((self.sweep.high_hz - self.sweep.low_hz) / 2.0);
        let step_hz = self.sweep.rate_hz / self.forward.len() as f64;
        let gain = |k: usize| sine_taper(&self.sweep, k as f64 * step_hz, width_hz).powi(2) as f32;
        (0..self.played.len()).map(gain).collect()
    }

    /// Analyses a take, and divides its recording by its loopback with these gains. The spectra are taken from `joint`,
    /// if there is a joint transform of both channels of this analyzer's length.
    ///
    /// recording, loopback `[recording_len]`, gains `[bins]`
    /// response `[recording_len]`  the whole response
    ///
    /// # Errors
    /// [`Error::Length`]; [`Error::NotFinite`]; [`Error::NoLoopback`] if it has nothing at a frequency.
    pub fn deconvolve_take(
        &self,
        [recording, loopback]: [&[f32]; 2],
        joint: Option<JointSpectrum<'_, f32>>,
        gains: &[f32],
        response: &mut [f32],
        scratch: &mut TakeScratch,
    ) -> Result<TakeAnalysis, Error> {
        check_len("the response", response.len(), self.recording_len)?;
        check_len("the gains", gains.len(), self.played.len())?;
        let TakeScratch { spectra: [recorded, looped], signal, quotient, transform } = scratch;
        match joint.filter(|joint| joint.transform_len() == self.forward.len()) {
            Some(joint) => {
                check_len("the recording", recording.len(), self.recording_len)?;
                check_len("the loopback", loopback.len(), self.recording_len)?;
                joint.split_spectra(recorded, looped);
                check_finite("the recording", recorded)?;
                check_finite("the loopback", looped)?;
            }
            None => {
                self.transform_signal("the recording", recording, recorded, signal, transform)?;
                self.transform_signal("the loopback", loopback, looped, signal, transform)?;
            }
        }
        if looped.iter().zip(gains).any(|(z, gain)| *gain > 0.0 && z.norm_sqr() == 0.0) {
            return Err(Error::NoLoopback);
        }
        let scale = 1.0 / self.forward.len() as f32;
        let bins = recorded.iter().zip(&*looped).zip(gains);
        quotient.clear();
        quotient.extend(bins.map(|((of, by), gain)| divide_bin(of, by, gain * scale)));
        signal.resize(self.forward.len(), 0.0);
        // The sweep's range ends before both real bins.
        let _ = self.real_inverse.process_with_scratch(quotient, signal, self.transform_work(transform));
        response.copy_from_slice(&signal[..self.recording_len]);
        Ok(self.analyze_spectra([Some(recording), Some(loopback)], recorded, Some(looped), transform))
    }

    fn analyze_spectra(
        &self,
        [recording, loopback]: [Option<&[f32]>; 2],
        recorded: &[Complex<f32>],
        looped: Option<&[Complex<f32>]>,
        scratch: &mut TransformScratch,
    ) -> TakeAnalysis {
        let mut analysis = TakeAnalysis::unknown();
        for (channel, signal) in [(TakeChannel::Recording, recording), (TakeChannel::Loopback, loopback)] {
            let peak = signal.map_or(0.0, oversampled_peak);
            if peak > 1.0 {
                analysis.faults.push(TakeFault::BetweenSamples { channel, peak_dbfs: power_to_db(peak * peak) });
            }
        }
        let Some(looped) = looped else {
            self.analyze_recording(&mut analysis, &self.divide_by_sweep(recorded, scratch), 0.0, 0, true);
            return analysis;
        };
        let electrical = self.divide_by_sweep(looped, scratch);
        let response = self.divide_spectra(recorded, looped, self.forward.len() / 2, scratch);
        self.analyze_channels(&mut analysis, [recorded, looped], &electrical, &response, scratch);
        self.find_fine_dropout(&mut analysis, [recorded, looped], electrical.onset, scratch);
        // Drifts and lost samples spread a response, and more of it comes early.
        let early_secs = -self.secs_of(response.onset);
        let is_spoiled = analysis.faults.iter().any(TakeFault::spoils_response);
        let is_known = !is_spoiled && analysis.loopback_match_db >= MATCH_DB && response.peak_db() >= PEAK_DB;
        if is_known && early_secs > EARLY_SECS {
            analysis.faults.push(TakeFault::EarlyArrival { early_secs });
        }
        scratch.judged.extend([electrical, response].map(|judged| (judged.samples, judged.powers)));
        analysis
    }

    // Faults of a take, from the response of its loopback to the sweep and that of its recording to the loopback.
    fn analyze_channels(
        &self,
        analysis: &mut TakeAnalysis,
        [recorded, looped]: [&[Complex<f32>]; 2],
        electrical: &SweepResponse,
        response: &SweepResponse,
        scratch: &mut TransformScratch,
    ) {
        let loopback_ratio = self.fit_clock_ratio(electrical);
        let aligned = self.align_clocks(electrical, loopback_ratio);
        let match_db = self.match_db(electrical, &aligned, 1);
        analysis.loopback_match_db = match_db;
        let direct = self.match_db(response, &response.vicinity, 1);
        if direct > SAME_SIGNAL_DB && response.peak == 0 {
            let level_db = power_to_db(response.energy) - power_to_db(self.unit_energy());
            analysis.faults.push(TakeFault::SameSignal { level_db });
        } else if match_db >= MATCH_DB {
            let early_secs = -self.secs_of(response.onset);
            if early_secs > RINGING_SECS && self.is_played_sweep(recorded, scratch) {
                analysis.faults.push(TakeFault::Swapped { early_secs });
            } else {
                self.find_cut(analysis, electrical.onset);
                self.find_dropout(analysis, electrical.onset, &[&aligned], TakeChannel::Loopback);
                let is_copy = self.is_digital_copy(looped, electrical.peak);
                self.analyze_recording(analysis, response, loopback_ratio, electrical.onset, is_copy);
            }
        } else if self.match_db(electrical, &electrical.vicinity, 2) > TORN_MATCH_DB
            && self.find_dropout(analysis, electrical.onset, &[&electrical.vicinity], TakeChannel::Loopback)
        {
            // Its two parts arrive at different times.
        } else {
            let acoustical = self.divide_by_sweep(recorded, scratch);
            let aligned = self.align_clocks(&acoustical, self.fit_clock_ratio(&acoustical));
            let recording_db = self.match_db(&acoustical, &aligned, 1);
            analysis.faults.push(if recording_db >= MATCH_DB {
                TakeFault::Swapped { early_secs: self.secs_of(electrical.onset - acoustical.onset) }
            } else if self.causal_db(response) > CAUSAL_DB && response.peak_db() >= PEAK_DB {
                TakeFault::UnknownSweep { match_db, least_db: MATCH_DB }
            } else {
                TakeFault::Loopback { match_db, least_db: MATCH_DB }
            });
        }
    }

    // Faults of a recording over a loopback with the sweep in it, or over the played sweep itself; `known` is the
    // loopback's clock ratio, and `delay` its delay.
    fn analyze_recording(
        &self,
        analysis: &mut TakeAnalysis,
        response: &SweepResponse,
        known: f64,
        delay: i64,
        is_copy: bool,
    ) {
        if !analysis.loopback_match_db.is_nan() {
            analysis.clock_ratio_ppm = 1e6 * known;
        }
        let peak_db = response.peak_db();
        if !(peak_db >= PEAK_DB) {
            analysis.faults.push(TakeFault::NoResponse { peak_db, least_db: PEAK_DB });
            return;
        }
        // A recorded loopback has the recording's clock, and what looks like drift is dispersion by the surface.
        let drift = if is_copy { self.search_clock_ratio(response) } else { 0.0 };
        let drifted = self.align_clocks(response, drift);
        let vicinities = &[&response.vicinity, &*drifted][..if is_copy { 2 } else { 1 }];
        let limit = self.drift_ratio(MAX_DRIFT_CYCLES);
        let is_torn = self.find_dropout(analysis, response.onset + delay, vicinities, TakeChannel::Recording);
        let is_drifting = drift.abs() > limit && !is_torn;
        if is_drifting {
            analysis.faults.push(TakeFault::Clock { ppm: 1e6 * drift, limit_ppm: 1e6 * limit });
        }
        // A copy tells nothing of the clocks.
        let is_told = is_copy && !is_torn && drift.abs() > self.drift_ratio(LEAST_DRIFT_CYCLES);
        if is_drifting || is_told || analysis.loopback_match_db.is_nan() {
            analysis.clock_ratio_ppm = 1e6 * (known + drift);
        }
        analysis.recording_clock_ppm = (is_told && !is_drifting).then_some(1e6 * drift);
        analysis.distortion = self.measure_distortion(&mut analysis.faults, response);
    }

    // Whether a channel is the sweep itself, by the playing clock.
    fn is_played_sweep(&self, spectrum: &[Complex<f32>], scratch: &mut TransformScratch) -> bool {
        let response = self.divide_by_sweep(spectrum, scratch);
        let ratio = self.fit_clock_ratio(&response);
        self.match_db(&response, &self.align_clocks(&response, ratio), 1) >= MATCH_DB
            && ratio.abs() <= self.drift_ratio(MAX_DRIFT_CYCLES)
    }

    // Whether a channel is the sweep at a delay of whole samples, without the response of any converter.
    fn is_digital_copy(&self, spectrum: &[Complex<f32>], delay: i64) -> bool {
        let angle = TAU * delay as f64 / self.forward.len() as f64;
        let turn = |bins: usize| Complex::from_polar(1.0, angle * bins as f64);
        let step = turn(LANES);
        let mut turns: [Complex<f64>; LANES] = std::array::from_fn(turn);
        let mut products = [Complex::<f64>::default(); LANES];
        let mut energies = [0.0; LANES];
        let range = self.tapered.range.clone();
        let bins = lane_groups(&spectrum[range.clone()]).zip(lane_groups(&self.played[range]));
        for ((of, by), weights) in bins.zip(lane_groups(&self.copy_weights)) {
            for lane in 0..LANES {
                let of = widen(of[lane]);
                products[lane] += of * widen(by[lane]).conj() * turns[lane] * weights[lane];
                energies[lane] += of.norm_sqr() * weights[lane];
                turns[lane] *= step;
            }
        }
        let product: Complex<f64> = products.iter().sum();
        let energies = [energies.iter().sum::<f64>(), crate::energy::energy(&self.tapered.gains)];
        1.0 - product.norm_sqr() / (energies[0] * energies[1]) < DIGITAL_COPY_SHARE
    }

    // Clock ratio of a drift, as a fraction.
    fn drift_ratio(&self, cycles: f64) -> f64 {
        cycles / (self.sweep.duration_secs * self.sweep.high_hz)
    }

    fn transform_signal(
        &self,
        what: &'static str,
        signal: &[f32],
        spectrum: &mut Vec<Complex<f32>>,
        samples: &mut Vec<f32>,
        scratch: &mut TransformScratch,
    ) -> Result<(), Error> {
        check_len(what, signal.len(), self.recording_len)?;
        samples.clear();
        samples.extend_from_slice(signal);
        samples.resize(self.forward.len(), 0.0);
        spectrum.resize(self.played.len(), Complex::default());
        let _ = self.forward.process_with_scratch(samples, spectrum, self.transform_work(scratch));
        check_finite(what, spectrum)
    }

    fn transform_work<'a>(&self, scratch: &'a mut TransformScratch) -> &'a mut [Complex<f32>] {
        let lens = [self.forward.get_scratch_len(), self.real_inverse.get_scratch_len()];
        let len = lens.into_iter().fold(self.inverse.get_inplace_scratch_len(), usize::max);
        scratch.work.resize(len, Complex::default());
        &mut scratch.work
    }

    // A channel over the played sweep. Of the two places that a lag in a circle has, early and late, the sweep is where
    // the recording lost less of it: a sweep that is in it as a whole may begin at any sample.
    fn divide_by_sweep(&self, of: &[Complex<f32>], scratch: &mut TransformScratch) -> SweepResponse {
        let latest = (self.forward.len() + self.recording_len).saturating_sub(self.sweep.len()) / 2;
        self.divide_spectra(of, &self.played, latest, scratch)
    }

    // Lags over `latest` are negative.
    fn divide_spectra(
        &self,
        of: &[Complex<f32>],
        by: &[Complex<f32>],
        latest: usize,
        scratch: &mut TransformScratch,
    ) -> SweepResponse {
        self.divide_tapered([of, by], latest, (&self.tapered, &self.short), scratch)
    }

    fn divide_tapered(
        &self,
        [of, by]: [&[Complex<f32>]; 2],
        latest: usize,
        (tapered, short): (&TaperedRange, &ShortTransform),
        scratch: &mut TransformScratch,
    ) -> SweepResponse {
        let n = self.forward.len();
        let (mut samples, mut powers) = scratch.judged.pop().unwrap_or_default();
        let range = tapered.range.clone();
        samples.resize(n, Complex::default());
        samples[..range.start].fill(Complex::default());
        samples[range.end..].fill(Complex::default());
        let bins = of[range.clone()].iter().zip(&by[range.clone()]).zip(&tapered.gains[range.clone()]);
        for (to, ((of, by), gain)) in samples[range].iter_mut().zip(bins) {
            *to = divide_bin(of, by, gain / n as f32);
        }
        self.inverse.process_with_scratch(&mut samples, self.transform_work(scratch));
        powers.clear();
        powers.extend(samples.iter().map(Complex::norm_sqr));
        let energy = sum_of(&powers);
        let peak = index_of_greatest(&powers);
        let is_early = peak > latest;
        let [peak, middle, n] = [peak, short.len / 2, n].map(|index| index as i64);
        let peak = if is_early { peak - n } else { peak };
        let vicinity = OnsetVicinity { spectrum: Vec::new(), samples: Vec::new(), powers: Vec::new() };
        let mut response = SweepResponse { samples, powers, energy, farther_energy: 0.0, peak, onset: peak, vicinity };
        // The earliest sample, not too long before the peak, of a tenth of it.
        let least = ONSET_SHARE * ONSET_SHARE * response.powers_in(peak..peak + 1).sum::<f64>();
        let earlier = response.powers_in(peak - middle..peak).position(|power| power >= least);
        response.onset = earlier.map_or(peak, |index| peak - middle + index as i64);
        let start = response.onset - middle;
        let around = response.indices(start..start + short.len as i64);
        let samples: Vec<_> = around.flat_map(|part| response.samples[part].iter().copied()).collect();
        let mut spectrum = samples.clone();
        short.forward.process(&mut spectrum);
        response.vicinity = OnsetVicinity { powers: powers_of(&samples), spectrum, samples };
        response.farther_energy = response.energy_of(start + short.len as i64..start + n);
        response
    }

    // Energy of a response that is one sample of 1.
    fn unit_energy(&self) -> f64 {
        crate::energy::energy(&self.tapered.gains) / self.forward.len() as f64
    }

    // Energy within 0.5 ms of the greatest peaks over that of all other samples, dB.
    fn match_db(&self, response: &SweepResponse, vicinity: &OnsetVicinity, peaks: usize) -> f64 {
        let mut powers = vicinity.powers.clone();
        let reach = self.seconds(RINGING_SECS);
        let mut near = 0.0;
        for _ in 0..peaks {
            let peak = index_of_greatest(&powers);
            let around = &mut powers[peak.saturating_sub(reach)..(peak + reach).min(self.short.len)];
            near += sum_of(around);
            around.fill(0.0);
        }
        // What rounding leaves of nothing.
        power_to_db(near / (response.farther_energy + sum_of(&powers)).max(1e-15 * response.energy))
    }

    // Energy of the half behind the onset over that of the half before it, dB.
    fn causal_db(&self, response: &SweepResponse) -> f64 {
        let half = response.samples.len() as i64 / 2;
        let from = response.onset - self.seconds(RINGING_SECS) as i64;
        power_to_db(response.energy_of(from..from + half) / response.energy_of(from - half..from))
    }

    // The onset's vicinity as it would be if the recording's clock ran slower by `ratio`.
    fn align_clocks<'a>(&self, response: &'a SweepResponse, ratio: f64) -> Cow<'a, OnsetVicinity> {
        if ratio == 0.0 {
            return Cow::Borrowed(&response.vicinity);
        }
        let mut spectrum = response.vicinity.spectrum.clone();
        let cycles = |hz: f64| self.sweep.phase_cycles(hz / (1.0 + ratio)) - self.sweep.phase_cycles(hz);
        // Beyond the sweep's range bins are turned as at its limits.
        let Range { start, end } = self.short.swept;
        let (below, rest) = spectrum.split_at_mut(start);
        let (swept, above) = rest.split_at_mut(end - start);
        for (bins, hz) in [(below, self.sweep.low_hz), (above, self.sweep.high_hz)] {
            let turn = Complex::from_polar(1.0, TAU * cycles(hz).fract());
            let turn = Complex::new(turn.re as f32, turn.im as f32);
            bins.iter_mut().for_each(|z| *z *= turn);
        }
        clock::turn_bins(swept, |bin| cycles((start + bin) as f64 * self.short.step_hz));
        let scale = 1.0 / self.short.len as f32;
        let mut samples: Vec<_> = spectrum.iter().map(|z| z * scale).collect();
        self.short.inverse.process(&mut samples);
        Cow::Owned(OnsetVicinity { powers: powers_of(&samples), spectrum, samples })
    }

    fn find_cut(&self, analysis: &mut TakeAnalysis, delay: i64) {
        let fade = (self.sweep.fade_secs * self.sweep.rate_hz) as i64 + 1;
        let late = delay + self.sweep.len() as i64 - self.recording_len as i64;
        if delay < -fade {
            analysis.faults.push(TakeFault::CutStart { lost_secs: self.secs_of(-delay) });
        } else if late > fade {
            analysis.faults.push(TakeFault::CutEnd { lost_secs: self.secs_of(late) });
        }
    }

    fn seconds(&self, secs: f64) -> usize {
        (secs * self.sweep.rate_hz).round() as usize
    }

    fn secs_of(&self, samples: i64) -> f64 {
        samples as f64 / self.sweep.rate_hz
    }
}

impl ShortTransform {
    // For tapers that are `parts` times narrower, and windows as many times longer: then of frequencies alone at which
    // the wide tapers leave less than a half.
    fn new(sweep: &SineSweep, len: usize, parts: f64) -> Self {
        let step_hz = sweep.rate_hz / len as f64;
        let gain = |k: &usize| taper_gain(sweep, *k as f64 * step_hz, TAPER_HZ / parts);
        let is_searched = |k: &usize| parts == 1.0 || taper_gain(sweep, *k as f64 * step_hz, TAPER_HZ) < 0.5;
        let bins = 1..len / 2;
        let first = bins.clone().find(|k| gain(k) >= 0.5).unwrap_or(1);
        let core = first..bins.clone().rev().find(|k| gain(k) >= 0.5).unwrap_or(first) + 1;
        Self {
            len,
            step_hz,
            swept: swept_bins(sweep, len),
            forward: f32::plan_fft(len, FftDirection::Forward),
            inverse: f32::plan_fft(len, FftDirection::Inverse),
            drift_weights: clock::drift_weights(sweep, core.clone().map(|k| k as f64 * step_hz)),
            core,
            parts: dropout::split_sweep(sweep, bins.filter(|k| gain(k) > 0.0 && is_searched(k)), step_hz),
            window: dropout::hann_window(
                ((parts * dropout::WINDOW_SECS * sweep.rate_hz).round() as usize).min(len / 8),
            ),
            guard: (parts * RINGING_SECS * sweep.rate_hz).round() as usize,
        }
    }
}

impl SweepResponse {
    // Where samples of a range from -n on are: at most two parts.
    fn indices(&self, range: Range<i64>) -> impl Iterator<Item = Range<usize>> + use<> {
        let n = self.powers.len();
        let start = range.start.rem_euclid(n as i64) as usize;
        let len = ((range.end - range.start).max(0) as usize).min(n);
        [start..(start + len).min(n), 0..(start + len).saturating_sub(n)].into_iter()
    }

    fn powers_in(&self, range: Range<i64>) -> impl Iterator<Item = f64> {
        self.indices(range).flat_map(|part| &self.powers[part]).map(|power| f64::from(*power))
    }

    fn energy_of(&self, range: Range<i64>) -> f64 {
        self.indices(range).map(|part| sum_of(&self.powers[part])).sum()
    }

    // Power of the greatest sample over the mean, dB.
    fn peak_db(&self) -> f64 {
        power_to_db(self.energy_of(self.peak..self.peak + 1) * self.powers.len() as f64 / self.energy)
    }
}

// Bins of a transform that are in the sweep's range.
fn swept_bins(sweep: &SineSweep, len: usize) -> Range<usize> {
    let bin = |hz: f64| hz / sweep.rate_hz * len as f64;
    let start = (bin(sweep.low_hz).ceil() as usize).min(len);
    start..(bin(sweep.high_hz) as usize + 1).clamp(start, len)
}

// Gain of a frequency: 1 in the sweep's range, falling to 0 at its limits.
fn taper_gain(sweep: &SineSweep, hz: f64, taper_hz: f64) -> f64 {
    sine_taper(sweep, hz, taper_hz.min((sweep.high_hz - sweep.low_hz) / 4.0)).powi(4)
}

fn sine_taper(sweep: &SineSweep, hz: f64, width_hz: f64) -> f64 {
    let inside = ((hz - sweep.low_hz).min(sweep.high_hz - hz) / width_hz).clamp(0.0, 1.0);
    (std::f64::consts::FRAC_PI_2 * inside).sin()
}

fn check_finite(what: &'static str, spectrum: &[Complex<f32>]) -> Result<(), Error> {
    match spectrum.iter().all(|x| x.re.is_finite() && x.im.is_finite()) {
        true => Ok(()),
        false => Err(Error::NotFinite { what }),
    }
}

// Silence divided by silence is silence.
#[inline]
fn divide_bin(of: &Complex<f32>, by: &Complex<f32>, gain: f32) -> Complex<f32> {
    of * by.conj() * (gain / by.norm_sqr().max(f32::MIN_POSITIVE))
}

// Of values that are not negative.
fn index_of_greatest(values: &[f32]) -> usize {
    let greatest = greatest_magnitude(values);
    values.iter().rposition(|x| *x == greatest).unwrap_or(0)
}

fn powers_of(samples: &[Complex<f32>]) -> Vec<f32> {
    samples.iter().map(Complex::norm_sqr).collect()
}

fn sum_of(powers: &[f32]) -> f64 {
    let mut sums = [0.0; 64];
    powers.chunks(64).for_each(|chunk| f32::add_to(chunk, &mut sums));
    sums.iter().sum()
}

// The last group is filled up with zeros.
fn lane_groups<T: Copy + Default>(values: &[T]) -> impl Iterator<Item = [T; LANES]> {
    let (groups, last) = values.as_chunks();
    let mut filled = [T::default(); LANES];
    filled[..last.len()].copy_from_slice(last);
    groups.iter().copied().chain([filled])
}

fn widen(z: Complex<f32>) -> Complex<f64> {
    Complex::new(z.re.into(), z.im.into())
}

#[cfg(test)]
mod tests;
