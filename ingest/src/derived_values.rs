//! Values computed from impulse responses: means and energies of references; responses, curves and energies of runs.

use std::collections::HashMap;

use echolake_dsp::air::AirState;
use echolake_dsp::air_correction::AirCorrectionFit;
use echolake_dsp::chain::{DerivationPlan, DerivedResponse, FlatEnergies};
use echolake_dsp::mean::SignalMean;
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

/// Values of each pair of Flat.
pub(crate) type FlatPairs = HashMap<u32, FlatPair>;

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

/// Values derived from some of a run's measurements.
#[derive(Debug, Clone, Default)]
pub(crate) struct DerivedRows {
    bands: usize,
    pub pairs: Vec<u32>,
    /// `[pairs x length]`.
    reflected: Vec<f32>,
    /// `[bands][pairs x length]`.
    curves: Vec<Vec<f32>>,
    /// `[pairs x bands]`.
    energies: Vec<f64>,
    tnce: Vec<f64>,
    tnce_over_band: Vec<f64>,
    /// `[pairs x bands]`: shapes of the curves.
    shapes: Vec<Option<CurveShape>>,
    /// `[estimates][pairs x bands]`: TNCE without Foam's reflection, by the best estimate and its variants; empty if
    /// that is not known.
    unbiased: Vec<Vec<f64>>,
    /// `[pairs x (bands + 1)]`: relative errors of TNCE, the total's last; empty if they are not known.
    errors: Vec<LevelError>,
    /// `[pairs x (2 bands + 1)]`: standard uncertainties of levels over Flat's total, of the total, and of levels over
    /// Flat's same band; null without energy; empty if they are not known.
    uncertainties: Vec<Option<f64>>,
}

/// Responses and curves of [`DerivedRows`].
#[derive(Debug, Clone, Default)]
pub(crate) struct DerivedLists {
    pub pairs: Vec<u32>,
    /// `[pairs x length]`.
    pub reflected: Vec<f32>,
    /// `[bands][pairs x length]`.
    pub curves: Vec<Vec<f32>>,
}

impl DerivedLists {
    /// Adds the curves of the counted pairs, `length` samples each, to the means of their bands.
    pub fn add_curves(
        &self,
        length: usize,
        counted: &[bool],
        means: &mut [SignalMean],
    ) -> Result<(), echolake_dsp::Error> {
        for (mean, curves) in means.iter_mut().zip(&self.curves) {
            let curves = curves.chunks_exact(length).zip(counted).filter(|(_, is_counted)| **is_counted);
            curves.map(|(curve, _)| curve).try_for_each(|curve| mean.add_signal(curve))?;
        }
        Ok(())
    }
}

impl DerivedRows {
    /// Returns an empty set of rows with this number of bands.
    pub fn new(bands: usize) -> Self {
        Self { bands, curves: vec![Vec::new(); bands], ..Self::default() }
    }

    /// Appends the values of one measurement.
    pub fn push(&mut self, pair: u32, derived: &DerivedResponse<f32>) {
        self.pairs.push(pair);
        self.reflected.extend_from_slice(&derived.reflected);
        let length = derived.reflected.len();
        for (all, curve) in self.curves.iter_mut().zip(derived.curves.chunks_exact(length)) {
            all.extend_from_slice(curve);
        }
        self.energies.extend_from_slice(&derived.energies);
        self.tnce.extend_from_slice(&derived.tnce);
        self.tnce_over_band.extend_from_slice(&derived.tnce_over_band);
        self.shapes.extend_from_slice(&derived.shapes);
    }

    /// Appends the TNCE of one measurement without Foam's reflection, by the estimate of this number.
    pub fn push_unbiased(&mut self, estimate: usize, energies: &[f64], flat_total: f64) {
        self.unbiased.resize(self.unbiased.len().max(estimate + 1), Vec::new());
        self.unbiased[estimate].extend(energies.iter().map(|energy| energy / flat_total));
    }

    /// Appends the errors of one measurement from its sensitivities and Flat's.
    pub fn push_errors(&mut self, levels: &LevelUncertainty, of: &[EnergySensitivity], flat: &FlatPair) {
        let (total, flat_total) =
            (EnergySensitivity::sum_of_bands(of), EnergySensitivity::sum_of_bands(&flat.sensitivities));
        let over_total = || of.iter().chain([&total]);
        self.errors.extend(over_total().map(|of| levels.relative_error(of, &flat_total)));
        self.uncertainties.extend(over_total().map(|of| levels.level_db(of, &flat_total)));
        self.uncertainties.extend(of.iter().zip(&flat.sensitivities).map(|(of, flat)| levels.level_db(of, flat)));
    }

    /// Moves out the responses and curves, which are empty afterwards.
    pub fn take_lists(&mut self, precision: SamplePrecision) -> DerivedLists {
        let mut lists = DerivedLists {
            pairs: self.pairs.clone(),
            reflected: std::mem::take(&mut self.reflected),
            curves: std::mem::take(&mut self.curves),
        };
        if precision == SamplePrecision::Rounded {
            for samples in lists.curves.iter_mut().chain([&mut lists.reflected]) {
                let length = samples.len() / self.pairs.len().max(1);
                for one in samples.chunks_exact_mut(length.max(1)) {
                    round_samples(one, CURVE_BITS);
                }
            }
        }
        lists
    }

    /// Returns the values of every column from `tnce_*` to `energy_total`, by its name.
    pub fn energy_columns(&self, bands: &[String]) -> Vec<(String, Vec<f64>)> {
        let mut columns = vec![
            ("tnce_total".into(), self.sum_bands(&self.tnce)),
            ("energy_total".into(), self.sum_bands(&self.energies)),
        ];
        for (b, band) in bands.iter().enumerate() {
            columns.push((format!("tnce_{band}"), self.band_values(&self.tnce, b)));
            columns.push((format!("tnce_band_{band}"), self.band_values(&self.tnce_over_band, b)));
            columns.push((format!("energy_{band}"), self.band_values(&self.energies, b)));
        }
        columns
    }

    /// Returns the values of `rise_*_ms`, `centre_*_ms` and `slope_*_per_ms`, by their names; null without energy.
    pub fn shape_columns(&self, bands: &[String], rate_hz: f64) -> Vec<(String, Vec<Option<f32>>)> {
        let per_ms = rate_hz / 1e3;
        let column = |band: usize, value: &dyn Fn(&CurveShape) -> f64| {
            let shapes = self.shapes.iter().skip(band).step_by(self.bands);
            shapes.map(|shape| shape.as_ref().map(|shape| value(shape) as f32)).collect()
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

    /// Returns the values of every column `*_u_db`, by its name; null if they are not known.
    pub fn uncertainty_columns(&self, bands: &[String]) -> Vec<(String, Vec<Option<f32>>)> {
        let over_total = bands.iter().map(|band| format!("tnce_{band}_u_db")).chain(["tnce_total_u_db".to_owned()]);
        let names: Vec<_> = over_total.chain(bands.iter().map(|band| format!("tnce_band_{band}_u_db"))).collect();
        let each = names.len();
        let column = |at: usize| match self.uncertainties.len() {
            0 => vec![None; self.pairs.len()],
            _ => self.uncertainties.iter().skip(at).step_by(each).map(|u| u.map(|u| u as f32)).collect(),
        };
        names.into_iter().enumerate().map(|(at, name)| (name, column(at))).collect()
    }

    /// Returns the relative errors of `tnce_*` and `tnce_total`; without values if they are not known.
    pub fn error_columns(&self) -> Vec<Vec<LevelError>> {
        let each = self.bands + 1;
        (0..each).map(|at| self.errors.iter().skip(at).step_by(each).copied().collect()).collect()
    }

    /// Returns the values of `tnce_*` and `tnce_total`.
    pub fn tnce_columns(&self) -> Vec<Vec<f64>> {
        self.band_columns(&self.tnce)
    }

    /// Returns the same without Foam's reflection by each estimate; empty if that is not known.
    pub fn unbiased_columns(&self) -> Vec<Vec<Vec<f64>>> {
        self.unbiased.iter().map(|values| self.band_columns(values)).collect()
    }

    fn band_columns(&self, values: &[f64]) -> Vec<Vec<f64>> {
        let bands = (0..self.bands).map(|band| self.band_values(values, band));
        bands.chain([self.sum_bands(values)]).collect()
    }

    fn band_values(&self, values: &[f64], band: usize) -> Vec<f64> {
        values.iter().skip(band).step_by(self.bands).copied().collect()
    }

    fn sum_bands(&self, values: &[f64]) -> Vec<f64> {
        values.chunks_exact(self.bands).map(|row| row.iter().sum()).collect()
    }
}
