//! The kernels in their order, planned once: recording to response, and response to curves and energies.

use echolake_schema::SpectralDivision;
use realfft::num_complex::Complex;

use crate::air::AirState;
use crate::air_correction::TransformedResponse;
use crate::deconvolution::{DeconvolutionParams, TransformLength};
use crate::energy::{energy, tnce_over_band};
use crate::error::check_len;
use crate::filter_bank::{FilterBankPlan, FilterBankScratch};
use crate::foam::subtract_foam;
use crate::response_deconvolution::{ResponseDeconvolution, ResponseScratch};
use crate::rise::{CurveShape, curve_shape};
use crate::temperature::{ReferenceAir, TemperatureCorrection, response_limits_hz};
use crate::uncertainty::{EnergyChanges, EnergySensitivity};
use crate::{Error, RealSample};

/// Coldest and warmest air that a plan is made for, C: the range of all temperatures that are accepted.
const TEMPERATURES: [f64; 2] = [-60.0, 80.0];

/// Settings of a [`MeasurementPlan`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasurementParams {
    /// Samples of recording and loopback.
    pub recording_len: usize,
    /// Samples of the response.
    pub ir_len: usize,
    /// Sampling rate, Hz.
    pub rate_hz: f64,
    /// Lowest frequency of the sweep, Hz.
    pub low_hz: f64,
    /// Highest frequency of the sweep, Hz.
    pub high_hz: f64,
    /// Treatment of frequencies at the limits of that range and beyond them; a taper is as wide as the response
    /// resolves.
    pub division: SpectralDivision,
    /// Air that responses are corrected to.
    pub reference: ReferenceAir,
}

/// Recording to response: deconvolve, correct the temperature, crop.
pub struct MeasurementPlan<T: RealSample> {
    deconvolution: ResponseDeconvolution<T>,
    correction: ResponseCorrection<T>,
    ir_len: usize,
    range_hz: [f64; 2],
}

/// Buffers of a [`MeasurementPlan`].
pub struct MeasurementScratch<T: RealSample> {
    deconvolution: ResponseScratch<T>,
    raw: Vec<T>,
}

impl<T: RealSample> MeasurementPlan<T> {
    /// Plans for recordings of one length.
    ///
    /// # Errors
    /// As [`ResponseDeconvolution::new`], and [`Error::Setting`] for a reference outside of -60 to 80 C.
    pub fn new(params: &MeasurementParams) -> Result<Self, Error> {
        check_celsius("the reference temperature (C)", params.reference.celsius)?;
        let raw_len = raw_len(params.ir_len, &params.reference).min(params.recording_len);
        let deconvolution = ResponseDeconvolution::new(DeconvolutionParams {
            recording_len: params.recording_len,
            output_len: raw_len,
            rate_hz: params.rate_hz,
            low_hz: params.low_hz,
            high_hz: params.high_hz,
            division: params.division,
            taper_hz: params.rate_hz / params.ir_len as f64,
            length: TransformLength::Fast,
        })?;
        Ok(Self {
            deconvolution,
            correction: ResponseCorrection::new(params.reference, params.division),
            ir_len: params.ir_len,
            range_hz: [params.low_hz, params.high_hz],
        })
    }

    /// Buffers for [`Self::compute_ir`]; one per thread.
    pub fn make_scratch(&self) -> MeasurementScratch<T> {
        let raw = vec![T::default(); self.deconvolution.output_len()];
        MeasurementScratch { deconvolution: self.deconvolution.make_scratch(), raw }
    }

    /// The response of one measurement at the reference temperature.
    ///
    /// # Errors
    /// As [`ResponseDeconvolution::run_within`], and [`Error::Setting`] for air outside of -60 to 80 C, for which the
    /// plan has deconvolved too little, 0 to 100 % or 300 to 1100 hPa.
    pub fn compute_ir(
        &self,
        recording: &[T],
        loopback: &[T],
        air: &AirState,
        ir: &mut [T],
        scratch: &mut MeasurementScratch<T>,
    ) -> Result<(), Error> {
        check_len("the response", ir.len(), self.ir_len)?;
        check_celsius("the temperature (C)", air.temperature_c)?;
        air.check_moisture()?;
        let limits_hz = response_limits_hz(self.range_hz, self.correction.time_ratio(air));
        let raw = &mut scratch.raw;
        let deconvolution = &mut scratch.deconvolution;
        self.deconvolution.run_within(limits_hz, recording, loopback, raw, deconvolution)?;
        self.correction.correct_response(raw, air, ir);
        Ok(())
    }

    /// The same response as measured, whatever the air: its time is that of the recording.
    ///
    /// # Errors
    /// As [`ResponseDeconvolution::run_within`].
    pub fn compute_measured(
        &self,
        recording: &[T],
        loopback: &[T],
        measured: &mut [T],
        scratch: &mut MeasurementScratch<T>,
    ) -> Result<(), Error> {
        check_len("the response", measured.len(), self.ir_len)?;
        let MeasurementScratch { deconvolution, raw } = scratch;
        self.deconvolution.run_within(self.range_hz, recording, loopback, raw, deconvolution)?;
        let kept = raw.len().min(measured.len());
        measured[..kept].copy_from_slice(&raw[..kept]);
        measured[kept..].fill(T::default());
        Ok(())
    }
}

/// Correction of responses to the reference temperature.
///
/// The paper's chain resamples a response and keeps its height: a stretched one has more energy, 0.007 dB a kelvin.
/// With [`SpectralDivision::Tapered`] its spectrum keeps its height instead, so that a reflection's energy does not
/// depend on the air; the other divisions stay what they are elsewhere.
///
/// ```
/// use echolake_dsp::air::AirState;
/// use echolake_dsp::chain::ResponseCorrection;
/// use echolake_dsp::temperature::ReferenceAir;
/// use echolake_schema::{Rig, SpectralDivision};
///
/// let reference = ReferenceAir::from_response(&Rig::paper().impulse_response);
/// let correction = ResponseCorrection::<f64>::new(reference, SpectralDivision::Tapered);
/// let (raw, mut corrected) = ([0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0], [0.0; 8]);
/// correction.correct_response(&raw, &AirState::with_known(26.0, None, None), &mut corrected);
/// assert!((corrected.iter().sum::<f64>() - 3.0).abs() < 0.01);
/// ```
pub struct ResponseCorrection<T: RealSample> {
    correction: TemperatureCorrection<T>,
    reference: ReferenceAir,
    keeps_spectrum: bool,
}

impl<T: RealSample> ResponseCorrection<T> {
    /// A correction to the reference air.
    pub fn new(reference: ReferenceAir, division: SpectralDivision) -> Self {
        let keeps_spectrum = division == SpectralDivision::Tapered;
        Self { correction: TemperatureCorrection::new(), reference, keeps_spectrum }
    }

    /// Returns the ratio by which times of a response in this air grow.
    pub fn time_ratio(&self, air: &AirState) -> f64 {
        self.reference.time_ratio(air)
    }

    /// Corrects one response.
    ///
    /// raw `[any]`, corrected `[wanted]`  from the same instant
    pub fn correct_response(&self, raw: &[T], air: &AirState, corrected: &mut [T]) {
        let rho = self.time_ratio(air);
        self.correction.correct_response(raw, rho, corrected);
        if self.keeps_spectrum {
            let factor = T::of(rho.recip());
            corrected.iter_mut().for_each(|sample| *sample = *sample * factor);
        }
    }
}

/// Samples before the correction that `ir_len` samples after it can depend on, at any temperature.
pub fn raw_len(ir_len: usize, reference: &ReferenceAir) -> usize {
    let air = |temperature_c| AirState { temperature_c, humidity_pct: 0.0, ..reference.air() };
    let len = |celsius| TemperatureCorrection::<f64>::input_len_for(ir_len, reference.time_ratio(&air(celsius)));
    TEMPERATURES.into_iter().map(len).max().unwrap_or(ir_len)
}

fn check_celsius(what: &'static str, celsius: f64) -> Result<(), Error> {
    let [coldest, warmest] = TEMPERATURES;
    if (coldest..=warmest).contains(&celsius) {
        return Ok(());
    }
    Err(Error::Setting { what, actual: celsius.to_string(), expected: "-60 to 80" })
}

/// Results that are derived from one response.
#[derive(Debug, Clone, PartialEq)]
pub struct DerivedResponse<T> {
    /// `[len]`: the response without the direct sound.
    pub reflected: Vec<T>,
    /// `[bands x len]`: NCE, over Flat's total energy.
    pub curves: Vec<T>,
    /// `[bands]`: energy.
    pub energies: Vec<f64>,
    /// `[bands]`: TNCE, over Flat's total energy; NaN or infinite if Flat has none.
    pub tnce: Vec<f64>,
    /// The sum of `tnce`.
    pub total: f64,
    /// `[bands]`: energy over Flat's of the same band.
    pub tnce_over_band: Vec<f64>,
    /// `[bands]`: shape of each curve; None without energy.
    pub shapes: Vec<Option<CurveShape>>,
}

/// Energies of Flat's response of a pair, which normalise all responses of that pair.
#[derive(Debug, Clone, PartialEq)]
pub struct FlatEnergies {
    /// Energy of the whole response.
    pub total: f64,
    /// `[bands]`: energy in each band.
    pub bands: Vec<f64>,
}

/// Response to reflected response, curves and energies.
///
/// ```
/// let plan = echolake_dsp::chain::DerivationPlan::new(384, 96e3, &[2_500.0, 5_000.0, 10_000.0, 20_000.0, 40_000.0])?;
/// let mut flat = vec![0.0; 384];
/// flat[100] = 1.0;
/// let (foam, ir) = (vec![0.0; 384], flat.iter().map(|x| 0.5 * x).collect::<Vec<f64>>());
/// let mut derived = plan.make_derived();
/// plan.derive_response(&ir, &foam, &flat, &mut derived, &mut plan.make_scratch())?;
/// assert!((derived.total - 0.25).abs() < 1e-9);
/// # Ok::<(), echolake_dsp::Error>(())
/// ```
pub struct DerivationPlan<T: RealSample> {
    bank: FilterBankPlan<T>,
}

/// Buffers of a [`DerivationPlan`].
pub struct DerivationScratch<T> {
    bank: FilterBankScratch<T>,
    flat: FlatEnergies,
}

impl<T: RealSample> DerivationPlan<T> {
    /// Plans for responses of `len` samples.
    ///
    /// # Errors
    /// As [`FilterBankPlan::new`].
    pub fn new(len: usize, rate_hz: f64, centres_hz: &[f64]) -> Result<Self, Error> {
        Ok(Self { bank: FilterBankPlan::new(len, rate_hz, centres_hz)? })
    }

    /// Buffers for [`Self::derive_response`]; one per thread.
    pub fn make_scratch(&self) -> DerivationScratch<T> {
        let flat = FlatEnergies { total: 0.0, bands: vec![0.0; self.bank.band_count()] };
        DerivationScratch { bank: self.bank.make_scratch(), flat }
    }

    /// A place for results, which runs fill again and again.
    pub fn make_derived(&self) -> DerivedResponse<T> {
        let bands = self.bank.band_count();
        let len = self.bank.len();
        DerivedResponse {
            reflected: vec![T::default(); len],
            curves: vec![T::default(); bands * len],
            energies: vec![0.0; bands],
            tnce: vec![0.0; bands],
            total: 0.0,
            tnce_over_band: vec![0.0; bands],
            shapes: vec![None; bands],
        }
    }

    /// Computes the energies that [`Self::run_over`] needs of a pair's Flat, Foam subtracted already: once per pair,
    /// because every response of that pair is normalised by the same.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn flat_energies(&self, flat: &[T], scratch: &mut DerivationScratch<T>) -> Result<FlatEnergies, Error> {
        self.measure_flat(flat, scratch)?;
        Ok(scratch.flat.clone())
    }

    /// Derives; `flat` has Foam subtracted already, all three are of the same pair.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn derive_response(
        &self,
        ir: &[T],
        foam: &[T],
        flat: &[T],
        derived: &mut DerivedResponse<T>,
        scratch: &mut DerivationScratch<T>,
    ) -> Result<(), Error> {
        check_len("the response", ir.len(), self.bank.len())?;
        check_len("Foam's response", foam.len(), self.bank.len())?;
        self.measure_flat(flat, scratch)?;
        subtract_foam(ir, foam, &mut derived.reflected);
        let DerivedResponse { reflected, curves, energies, .. } = derived;
        let factor = scratch.flat.total.recip();
        self.bank.accumulate_signal(reflected, factor, curves, energies, &mut scratch.bank)?;
        put_over(&scratch.flat, derived);
        Ok(())
    }

    /// Derives what [`Self::derive_response`] does from a response without the direct sound, over energies of Flat that
    /// are known already.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn run_over(
        &self,
        reflected: &TransformedResponse<T>,
        flat: &FlatEnergies,
        derived: &mut DerivedResponse<T>,
        scratch: &mut DerivationScratch<T>,
    ) -> Result<(), Error> {
        check_len("Flat's energies", flat.bands.len(), self.bank.band_count())?;
        check_len("the reflected response", reflected.samples.len(), self.bank.len())?;
        let DerivedResponse { curves, energies, .. } = derived;
        self.bank.accumulate_bands(&reflected.spectrum, flat.total.recip(), curves, energies, &mut scratch.bank)?;
        derived.reflected.copy_from_slice(&reflected.samples);
        put_over(flat, derived);
        Ok(())
    }

    /// Computes only the energies of what a surface reflected from its spectrum.
    ///
    /// spectrum  `[ir_len / 2 + 1]`, energies `[bands]`
    pub fn spectrum_energies(&self, spectrum: &[Complex<T>], energies: &mut [f64]) {
        self.bank.spectrum_energies(spectrum, energies);
    }

    /// Computes the energy of all bins of a spectrum `[ir_len / 2 + 1]`.
    pub fn spectrum_energy(&self, spectrum: &[Complex<T>]) -> f64 {
        self.bank.spectrum_energy(spectrum)
    }

    /// Computes what errors of the direct sound, and the air by its changes of each bin, do to the energies
    /// of a reflected response: `sensitivities[band]`.
    ///
    /// reflected, direct  `[ir_len / 2 + 1]`: their spectra
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn compute_sensitivities(
        &self,
        reflected: &[Complex<T>],
        direct: &[Complex<T>],
        by_air: impl Fn(usize) -> EnergyChanges,
        sensitivities: &mut [EnergySensitivity],
        scratch: &mut DerivationScratch<T>,
    ) -> Result<(), Error> {
        self.bank.compute_sensitivities(reflected, direct, by_air, sensitivities, &mut scratch.bank)
    }

    fn measure_flat(&self, flat: &[T], scratch: &mut DerivationScratch<T>) -> Result<(), Error> {
        check_len("Flat's response", flat.len(), self.bank.len())?;
        scratch.flat.total = energy(flat);
        self.bank.compute_energies(flat, &mut scratch.flat.bands, &mut scratch.bank)
    }
}

// Fills what follows from curves and energies.
fn put_over<T: RealSample>(flat: &FlatEnergies, derived: &mut DerivedResponse<T>) {
    let len = derived.reflected.len();
    let factor = flat.total.recip();
    derived.tnce.iter_mut().zip(&derived.energies).for_each(|(tnce, energy)| *tnce = energy * factor);
    derived.total = derived.tnce.iter().sum();
    tnce_over_band(&derived.energies, &flat.bands, &mut derived.tnce_over_band);
    derived
        .shapes
        .iter_mut()
        .zip(derived.curves.chunks_exact(len))
        .for_each(|(shape, curve)| *shape = curve_shape(curve));
}

#[cfg(test)]
mod tests {
    use echolake_schema::AirTreatment;

    use super::*;
    use crate::sweep::{SineSweep, SweepShape};
    use crate::temperature::resampling_ratio;

    fn air(celsius: f64) -> AirState {
        AirState::with_known(celsius, None, None)
    }

    fn params() -> MeasurementParams {
        MeasurementParams {
            recording_len: 1_000,
            ir_len: 384,
            rate_hz: 96e3,
            low_hz: 2e3,
            high_hz: 40e3,
            division: SpectralDivision::Floored { floor_db: -60.0 },
            reference: ReferenceAir { celsius: 20.0, treatment: AirTreatment::Paper },
        }
    }

    fn noise() -> Vec<f64> {
        (0..1_000).map(|i| f64::from((i * 7919) % 1013) - 506.0).collect()
    }

    #[test]
    fn temperatures_that_the_plan_is_not_for_are_refused() {
        let plan = MeasurementPlan::<f64>::new(&params()).expect("a plan");
        let (mut ir, mut scratch) = (vec![0.0; 384], plan.make_scratch());
        for bad in [-61.0, 81.0, -273.15, -300.0, 400.0, f64::NAN, f64::INFINITY] {
            let result = plan.compute_ir(&noise(), &noise(), &air(bad), &mut ir, &mut scratch);
            assert!(matches!(result, Err(Error::Setting { .. })), "{bad}: {result:?}");
            assert!(
                MeasurementPlan::<f64>::new(&MeasurementParams {
                    reference: ReferenceAir { celsius: bad, ..params().reference },
                    ..params()
                })
                .is_err()
            );
        }
        for good in [-60.0, 80.0] {
            plan.compute_ir(&noise(), &noise(), &air(good), &mut ir, &mut scratch).expect("a response");
            assert!(ir.iter().all(|x| x.is_finite()), "{good}");
        }
    }

    // What stands in the tables of a lake whose runs have sweeps of any length, dB: a reflection at 90 samples over
    // Flat's, each band over Flat's total.
    fn levels(division: SpectralDivision, duration_secs: f64) -> Vec<f64> {
        let sweep = SineSweep {
            shape: SweepShape::Linear,
            rate_hz: 96e3,
            duration_secs,
            low_hz: 2e3,
            high_hz: 40e3,
            fade_secs: 0.001,
        };
        let mut loopback = sweep.samples();
        loopback.resize(loopback.len() + 960, 0.0);
        let n = loopback.len();
        let heard = |reflections: &[(usize, f64)]| -> Vec<f64> {
            let part = |i: usize, (delay, r): &(usize, f64)| if i < *delay { 0.0 } else { r * loopback[i - delay] };
            (0..n).map(|i| reflections.iter().map(|reflection| part(i, reflection)).sum()).collect()
        };
        let params = MeasurementParams { recording_len: n, division, ..params() };
        let (plan, bands) = (MeasurementPlan::<f64>::new(&params).expect("a plan"), [2_500.0, 5e3, 10e3, 20e3, 40e3]);
        let response = |reflections: &[(usize, f64)]| {
            let mut ir = vec![0.0; 384];
            plan.compute_ir(&heard(reflections), &loopback, &air(21.3), &mut ir, &mut plan.make_scratch())
                .expect("a response");
            ir
        };
        let (flat, relief) = (response(&[(90, 1.0)]), response(&[(84, 0.4), (93, -0.3), (101, 0.5), (160, 0.1)]));
        let plan = DerivationPlan::new(384, 96e3, &bands).expect("a plan");
        let mut derived = plan.make_derived();
        plan.derive_response(&relief, &[0.0; 384], &flat, &mut derived, &mut plan.make_scratch()).expect("derived");
        derived.tnce.iter().chain([&derived.total]).map(|tnce| 10.0 * tnce.log10()).collect()
    }

    #[test]
    fn levels_do_not_depend_on_the_sweep_s_length() {
        let apart = |division| {
            let longest = levels(division, 2.0);
            let differences = [0.05, 0.5].map(|secs| {
                let differences = levels(division, secs).into_iter().zip(&longest).map(|(a, b)| (a - b).abs());
                differences.fold(0.0, f64::max)
            });
            differences[0].max(differences[1])
        };
        let tapered = apart(SpectralDivision::Tapered);
        assert!(tapered < 0.001, "{tapered} dB");
        // Why there is a taper.
        let floored = apart(SpectralDivision::Floored { floor_db: SpectralDivision::FLOOR_DB });
        assert!(floored > 0.1, "{floored} dB");
    }

    #[test]
    fn levels_do_not_depend_on_the_air() {
        let sweep = SineSweep {
            shape: SweepShape::Linear,
            rate_hz: 96e3,
            duration_secs: 0.05,
            low_hz: 2e3,
            high_hz: 40e3,
            fade_secs: 0.001,
        };
        let mut loopback = sweep.samples();
        loopback.resize(6_000, 0.0);
        let n = loopback.len();
        let forward = f64::plan_real_forward(n);
        let mut spectrum = forward.make_output_vec();
        forward.process(&mut loopback.clone(), &mut spectrum).expect("a spectrum");
        // Delays are samples at 20 C; the air makes them shorter or longer.
        let heard = |reflections: &[(f64, f64)], rho: f64| -> Vec<f64> {
            let turn = |bin: usize, delay: f64| {
                Complex::from_polar(1.0, -std::f64::consts::TAU * (bin as f64) * delay / rho / n as f64)
            };
            let gain = |bin| reflections.iter().map(|(delay, r)| turn(bin, *delay) * r).sum::<Complex<f64>>();
            let mut bins: Vec<_> = spectrum.iter().enumerate().map(|(bin, s)| s * gain(bin)).collect();
            (bins[0].im, bins[n / 2].im) = (0.0, 0.0);
            let mut signal = vec![0.0; n];
            f64::plan_real_inverse(n).process(&mut bins, &mut signal).expect("a signal");
            signal.into_iter().map(|x| x / n as f64).collect()
        };
        let flat = [(90.0, 1.0)];
        let relief = [(84.0, 0.4), (93.3, -0.3), (101.2, 0.5), (160.0, 0.1)];
        // The relief is measured in this air, Flat in air of 20 C.
        let levels = |division, celsius: f64| {
            let params = MeasurementParams { recording_len: n, division, ..params() };
            let plan = MeasurementPlan::<f64>::new(&params).expect("a plan");
            let response = |reflections: &[(f64, f64)], celsius: f64| {
                let (mut ir, rho) = (vec![0.0; 384], resampling_ratio(celsius, 20.0));
                let recording = heard(reflections, rho);
                plan.compute_ir(&recording, &loopback, &air(celsius), &mut ir, &mut plan.make_scratch())
                    .expect("a response");
                ir
            };
            let plan = DerivationPlan::new(384, 96e3, &[2_500.0, 5e3, 10e3, 20e3, 40e3]).expect("a plan");
            let mut derived = plan.make_derived();
            let (relief, flat) = (response(&relief, celsius), response(&flat, 20.0));
            plan.derive_response(&relief, &[0.0; 384], &flat, &mut derived, &mut plan.make_scratch()).expect("derived");
            derived.tnce.iter().map(|tnce| 10.0 * tnce.log10()).collect::<Vec<_>>()
        };
        let apart = |division| {
            let (warm, cold) = (levels(division, 25.0), levels(division, 15.0));
            warm.iter().zip(&cold).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
        };
        let tapered = apart(SpectralDivision::Tapered);
        assert!(tapered < 0.003, "{tapered} dB");
        let floored = apart(SpectralDivision::Floored { floor_db: SpectralDivision::FLOOR_DB });
        assert!(floored > 0.05, "{floored} dB");
    }

    // A surface that is Flat itself: bands that sum to 1 in all, and 1 in each band.
    #[test]
    fn flat_over_itself_is_one() {
        for len in [383, 384, 400, 401] {
            let plan = DerivationPlan::<f32>::new(len, 96e3, &[2_500.0, 5e3, 10e3, 20e3, 40e3]).expect("a plan");
            let flat: Vec<f32> = noise()[..len].iter().map(|x| *x as f32).collect();
            let (mut derived, silence) = (plan.make_derived(), vec![0.0; len]);
            plan.derive_response(&flat, &silence, &flat, &mut derived, &mut plan.make_scratch()).expect("derived");
            // f32 transforms of some 400 samples.
            assert!((derived.total - 1.0).abs() < 1e-5, "{len}: {}", derived.total);
            assert!(derived.tnce_over_band.iter().all(|x| (x - 1.0).abs() < 1e-5), "{:?}", derived.tnce_over_band);
        }
    }

    #[test]
    fn energies_of_flat_serve_every_response_of_a_pair() {
        let plan = DerivationPlan::<f32>::new(384, 96e3, &[2_500.0, 5e3, 10e3, 20e3, 40e3]).expect("a plan");
        let noise: Vec<f32> = noise().iter().map(|x| *x as f32).collect();
        let (mut scratch, foam, flat) = (plan.make_scratch(), &noise[..384], &noise[384..768]);
        let energies = plan.flat_energies(flat, &mut scratch).expect("energies");
        for ir in [&noise[100..484], &noise[500..884]] {
            let (mut once, mut again) = (plan.make_derived(), plan.make_derived());
            plan.derive_response(ir, foam, flat, &mut once, &mut plan.make_scratch()).expect("derived");
            let mut reflected = vec![0.0; 384];
            subtract_foam(ir, foam, &mut reflected);
            let forward = f32::plan_real_forward(384);
            let mut spectrum = forward.make_output_vec();
            forward.process(&mut reflected.clone(), &mut spectrum).expect("a spectrum");
            let transformed = TransformedResponse { samples: reflected.clone(), spectrum: spectrum.clone() };
            plan.run_over(&transformed, &energies, &mut again, &mut scratch).expect("derived");
            assert_eq!(once, again);
            let mut energies = [f64::NAN; 5];
            plan.spectrum_energies(&spectrum, &mut energies);
            let total = plan.spectrum_energy(&spectrum);
            assert!((total / energy(&reflected) - 1.0).abs() < 1e-5);
            // The sum over bins and the sum over samples, in single precision.
            let alike = |(a, b): (&f64, &f64)| (a / b - 1.0).abs() < 1e-5;
            assert!(energies.iter().zip(&once.energies).all(alike), "{energies:?} {:?}", once.energies);
        }
        let short = FlatEnergies { bands: vec![1.0; 4], ..energies };
        let flat = TransformedResponse { samples: flat.to_vec(), spectrum: vec![Complex::default(); 193] };
        let result = plan.run_over(&flat, &short, &mut plan.make_derived(), &mut scratch);
        assert!(matches!(result, Err(Error::Length { .. })), "{result:?}");
    }

    #[test]
    fn nan_and_wrong_lengths_are_refused() {
        let plan = DerivationPlan::<f64>::new(16, 96e3, &[1e3]).expect("a plan");
        let (mut derived, mut scratch) = (plan.make_derived(), plan.make_scratch());
        let (one, mut broken) = ([1.0; 16], [1.0; 16]);
        broken[3] = f64::NAN;
        for [ir, foam, flat] in [[&broken, &one, &one], [&one, &broken, &one], [&one, &one, &broken]] {
            let result = plan.derive_response(ir, foam, flat, &mut derived, &mut scratch);
            assert!(matches!(result, Err(Error::NotFinite { .. })), "{result:?}");
        }
        let result = plan.derive_response(&one[1..], &one, &one, &mut derived, &mut scratch);
        assert!(matches!(result, Err(Error::Length { .. })), "{result:?}");
    }
}
