//! Values computed from impulse responses: means and energies of references; responses, curves and energies of runs.

use std::collections::HashMap;
use std::ops::Range;

use echolake_dsp::air::AirState;
use echolake_dsp::air_correction::AirCorrectionFit;
use echolake_dsp::chain::{DerivationPlan, DerivedResponse, FlatEnergies};
use echolake_dsp::rise::CurveShape;
use echolake_dsp::rounding::{CURVE_BITS, round_samples};
use echolake_dsp::temperature::ReferenceAir;
use echolake_dsp::uncertainty::{EnergySensitivity, LevelError, LevelUncertainty, ResidualFit};
use echolake_lake::SamplePrecision;
use echolake_schema::Rig;

/// Mean impulse response of each pair of a reference.
pub(crate) type MeanResponses = HashMap<u32, MeanResponse>;

/// Mean of a pair's responses.
#[derive(Debug, Clone)]
pub(crate) struct MeanResponse {
    pub ir: Vec<f32>,
    /// Mean air.
    pub air: AirState,
}

/// Values of a pair of Flat without the direct sound.
#[derive(Debug, Clone)]
pub(crate) struct FlatPair {
    pub energies: FlatEnergies,
    /// `[bands]`.
    pub sensitivities: Vec<EnergySensitivity>,
    pub air: AirState,
}

/// Returns the derivation plan for a rig's responses.
pub(crate) fn derivation_plan(rig: &Rig) -> std::result::Result<DerivationPlan<f32>, echolake_dsp::Error> {
    DerivationPlan::new(rig.impulse_response.length, rig.sweep.rate_hz.get(), &rig.bands.centres_hz)
}

/// Returns a fit of what the direct sound's subtraction leaves of a rig's responses.
pub(crate) fn residual_fit(rig: &Rig) -> std::result::Result<ResidualFit<f32>, echolake_dsp::Error> {
    let range_hz = [rig.sweep.low_hz, rig.sweep.high_hz];
    ResidualFit::new(rig.impulse_response.length, rig.sweep.rate_hz.get(), range_hz)
}

/// Returns a fit of the correction of a rig's responses for the air.
pub(crate) fn air_correction_fit(rig: &Rig) -> AirCorrectionFit<f32> {
    let response = &rig.impulse_response;
    let range_hz = [rig.sweep.low_hz, rig.sweep.high_hz];
    AirCorrectionFit::new(response.length, rig.sweep.rate_hz.get(), range_hz, ReferenceAir::from_response(response))
}

/// A run's impulse responses.
#[derive(Debug, Clone, Default)]
pub(crate) struct RunResponses {
    pub pairs: Vec<u32>,
    /// `[pairs x length]`.
    pub irs: Vec<f32>,
    /// `[pairs]`.
    pub airs: Vec<AirState>,
}

/// Values derived from a run's measurements, column by column. Those of bands are in the order of the bands, and end
/// with their sum if there is a total.
#[derive(Debug, Default)]
pub(crate) struct DerivedColumns {
    pub pairs: Vec<u32>,
    /// `[bands + 1][pairs]`.
    energies: Vec<Vec<f64>>,
    pub tnce: Vec<Vec<f64>>,
    /// `[bands][pairs]`.
    tnce_over_band: Vec<Vec<f64>>,
    /// `[bands][pairs]`: shapes of the curves.
    shapes: Vec<Vec<Option<CurveShape>>>,
    /// `[estimates][bands + 1][pairs]`: TNCE without Foam's reflection, by the best estimate and its variants.
    pub unbiased: Vec<Vec<Vec<f64>>>,
    /// `[pairs x bands]`: of the energies; empty if no uncertainty will be known.
    sensitivities: Vec<EnergySensitivity>,
    /// `[bands + 1][pairs]`: relative errors of TNCE; without values if they are not known.
    pub errors: Vec<Vec<LevelError>>,
    /// `[2 bands + 1][pairs]`: standard uncertainties of levels over Flat's total, of the total, and of levels over
    /// Flat's same band; null without energy; without values if they are not known.
    uncertainties: Vec<Vec<Option<f32>>>,
}

/// Responses and curves of some of a run's measurements.
#[derive(Debug)]
pub(crate) struct DerivedLists {
    pub pairs: Vec<u32>,
    /// `[pairs x length]`.
    pub reflected: Vec<f32>,
    /// `[bands][pairs x length]`.
    pub curves: Vec<Vec<f32>>,
}

impl DerivedLists {
    /// Returns an empty set for up to `pairs` measurements of as many bands, each of `length` samples.
    pub fn with_capacity(pairs: usize, bands: usize, length: usize) -> Self {
        let samples = || Vec::with_capacity(pairs * length);
        Self { pairs: Vec::with_capacity(pairs), reflected: samples(), curves: (0..bands).map(|_| samples()).collect() }
    }

    /// Appends the lists of one measurement.
    pub fn push(&mut self, pair: u32, derived: &DerivedResponse<f32>) {
        self.pairs.push(pair);
        self.reflected.extend_from_slice(&derived.reflected);
        let curves = derived.curves.chunks_exact(derived.reflected.len());
        self.curves.iter_mut().zip(curves).for_each(|(all, curve)| all.extend_from_slice(curve));
    }
}

/// Rounds responses and curves as a lake stores them.
pub(crate) fn round_lists(derived: &mut DerivedResponse<f32>, precision: SamplePrecision) {
    if precision == SamplePrecision::Rounded {
        let length = derived.reflected.len().max(1);
        round_samples(&mut derived.reflected, CURVE_BITS);
        derived.curves.chunks_exact_mut(length).for_each(|curve| round_samples(curve, CURVE_BITS));
    }
}

impl DerivedColumns {
    /// Returns empty columns of this number of bands, and of estimates of Foam's reflection.
    pub fn new(bands: usize, estimates: usize) -> Self {
        let with_total = vec![Vec::new(); bands + 1];
        Self {
            energies: with_total.clone(),
            tnce: with_total.clone(),
            tnce_over_band: vec![Vec::new(); bands],
            shapes: vec![Vec::new(); bands],
            unbiased: vec![with_total; estimates],
            errors: vec![Vec::new(); bands + 1],
            uncertainties: vec![Vec::new(); 2 * bands + 1],
            ..Self::default()
        }
    }

    /// Appends the values of one measurement.
    pub fn push(&mut self, pair: u32, derived: &DerivedResponse<f32>) {
        self.pairs.push(pair);
        push_with_sum(&mut self.energies, derived.energies.iter().copied());
        push_with_sum(&mut self.tnce, derived.tnce.iter().copied());
        self.tnce_over_band.iter_mut().zip(&derived.tnce_over_band).for_each(|(all, value)| all.push(*value));
        self.shapes.iter_mut().zip(&derived.shapes).for_each(|(all, shape)| all.push(*shape));
    }

    /// Appends the TNCE of one measurement without Foam's reflection, by the estimate of this number.
    pub fn push_unbiased(&mut self, estimate: usize, energies: &[f64], flat_total: f64) {
        push_with_sum(&mut self.unbiased[estimate], energies.iter().map(|energy| energy / flat_total));
    }

    /// Appends the sensitivities of one measurement, `[bands]`.
    pub fn push_sensitivities(&mut self, of: &[EnergySensitivity]) {
        self.sensitivities.extend_from_slice(of);
    }

    /// Computes the errors of all measurements from their sensitivities and from Flat's, `[bands]`, of each pair.
    pub fn fill_errors<'a>(
        &mut self,
        levels: &LevelUncertainty,
        of_flat: impl Fn(u32) -> Option<&'a [EnergySensitivity]>,
    ) {
        let bands = self.shapes.len();
        let pairs = self.pairs.iter().filter_map(|pair| of_flat(*pair));
        for (of, flat) in self.sensitivities.chunks_exact(bands).zip(pairs) {
            let total = &EnergySensitivity::sum_of_bands(of);
            let flat_total = &EnergySensitivity::sum_of_bands(flat);
            let over_total = of.iter().chain([total]).map(|of| (of, flat_total));
            for (all, (of, flat)) in self.errors.iter_mut().zip(over_total.clone()) {
                all.push(levels.relative_error(of, flat));
            }
            for (all, (of, flat)) in self.uncertainties.iter_mut().zip(over_total.chain(of.iter().zip(flat))) {
                all.push(levels.level_db(of, flat).map(|u_db| u_db as f32));
            }
        }
    }

    /// Returns every column from `tnce_*` to `energy_total`, by its name.
    pub fn energy_columns(&self, bands: &[String]) -> Vec<(String, &[f64])> {
        let total = bands.len();
        let mut columns =
            vec![("tnce_total".into(), &self.tnce[total][..]), ("energy_total".into(), &self.energies[total][..])];
        for (b, band) in bands.iter().enumerate() {
            columns.push((format!("tnce_{band}"), &self.tnce[b][..]));
            columns.push((format!("tnce_band_{band}"), &self.tnce_over_band[b][..]));
            columns.push((format!("energy_{band}"), &self.energies[b][..]));
        }
        columns
    }

    /// Returns the values of `rise_*_ms`, `centre_*_ms` and `slope_*_per_ms` of some rows, by their names; null without
    /// energy.
    pub fn shape_columns(&self, bands: &[String], rate_hz: f64, rows: Range<usize>) -> Vec<(String, Vec<Option<f32>>)> {
        let per_ms = rate_hz / 1e3;
        let column = |band: usize, value: &dyn Fn(&CurveShape) -> f64| {
            let shapes = &self.shapes[band][rows.clone()];
            shapes.iter().map(|shape| shape.as_ref().map(|shape| value(shape) as f32)).collect()
        };
        let named = |(b, band): (usize, &String)| {
            [
                (format!("rise_{band}_ms"), column(b, &|shape| shape.rise / per_ms)),
                (format!("centre_{band}_ms"), column(b, &|shape| shape.centre / per_ms)),
                (format!("slope_{band}_per_ms"), column(b, &|shape| shape.slope * per_ms)),
            ]
        };
        bands.iter().enumerate().flat_map(named).collect()
    }

    /// Returns the values of every column `*_u_db` of some rows, by its name; null if they are not known.
    pub fn uncertainty_columns(&self, bands: &[String], rows: Range<usize>) -> Vec<(String, Vec<Option<f32>>)> {
        let over_total = bands.iter().map(|band| format!("tnce_{band}_u_db")).chain(["tnce_total_u_db".to_owned()]);
        let names = over_total.chain(bands.iter().map(|band| format!("tnce_band_{band}_u_db")));
        let column = |values: &Vec<Option<f32>>| match values.get(rows.clone()) {
            Some(values) => values.to_vec(),
            None => vec![None; rows.len()],
        };
        names.zip(&self.uncertainties).map(|(name, values)| (name, column(values))).collect()
    }
}

// Appends a value to each column, and their sum to the last one.
fn push_with_sum(columns: &mut [Vec<f64>], values: impl Iterator<Item = f64>) {
    let Some((total, bands)) = columns.split_last_mut() else { return };
    let mut sum = 0.0;
    for (all, value) in bands.iter_mut().zip(values) {
        all.push(value);
        sum += value;
    }
    total.push(sum);
}
