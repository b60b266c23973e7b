//! Values computed from impulse responses: means and energies of references; responses, curves and energies of runs.

use std::collections::HashMap;

use echolake_dsp::chain::{DerivationPlan, DerivedResponse, FlatEnergies};
use echolake_dsp::rise::CurveShape;
use echolake_schema::Rig;

/// Mean impulse response of each pair of a reference.
pub(crate) type MeanResponses = HashMap<u32, Vec<f32>>;

/// Energies of each pair of Flat, with its Foam subtracted.
pub(crate) type FlatEnergyMap = HashMap<u32, FlatEnergies>;

/// Returns the derivation plan for a rig's responses.
pub(crate) fn derivation_plan(rig: &Rig) -> std::result::Result<DerivationPlan<f32>, echolake_dsp::Error> {
    DerivationPlan::new(rig.impulse_response.length, rig.sweep.rate_hz.get(), &rig.bands.centres_hz)
}

/// A run's impulse responses.
#[derive(Debug, Clone, Default)]
pub(crate) struct RunResponses {
    pub(crate) pairs: Vec<u32>,
    /// `[pairs x length]`.
    pub(crate) irs: Vec<f32>,
}

/// Values derived from some of a run's measurements.
#[derive(Debug, Clone, Default)]
pub(crate) struct DerivedRows {
    bands: usize,
    pub(crate) pairs: Vec<u32>,
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
    /// `[pairs x bands]`: TNCE without Foam's reflection; empty if that is not known.
    unbiased: Vec<f64>,
}

/// Responses and curves of [`DerivedRows`].
#[derive(Debug, Clone, Default)]
pub(crate) struct DerivedLists {
    pub(crate) pairs: Vec<u32>,
    /// `[pairs x length]`.
    pub(crate) reflected: Vec<f32>,
    /// `[bands][pairs x length]`.
    pub(crate) curves: Vec<Vec<f32>>,
}

impl DerivedRows {
    /// Returns an empty set of rows with this number of bands.
    pub(crate) fn new(bands: usize) -> Self {
        Self { bands, curves: vec![Vec::new(); bands], ..Self::default() }
    }

    /// Appends the values of one measurement.
    pub(crate) fn push(&mut self, pair: u32, derived: &DerivedResponse<f32>) {
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

    /// Appends the TNCE of one measurement without Foam's reflection.
    pub(crate) fn push_unbiased(&mut self, energies: &[f64], flat: &FlatEnergies) {
        self.unbiased.extend(energies.iter().map(|energy| energy / flat.total));
    }

    /// Moves out the responses and curves, which are empty afterwards.
    pub(crate) fn take_lists(&mut self) -> DerivedLists {
        DerivedLists {
            pairs: self.pairs.clone(),
            reflected: std::mem::take(&mut self.reflected),
            curves: std::mem::take(&mut self.curves),
        }
    }

    /// Returns the values of every column from `tnce_*` to `energy_total`, by its name.
    pub(crate) fn energy_columns(&self, bands: &[String]) -> Vec<(String, Vec<f64>)> {
        let mut columns =
            vec![("tnce_total".into(), self.totals(&self.tnce)), ("energy_total".into(), self.totals(&self.energies))];
        for (b, band) in bands.iter().enumerate() {
            columns.push((format!("tnce_{band}"), self.column(&self.tnce, b)));
            columns.push((format!("tnce_band_{band}"), self.column(&self.tnce_over_band, b)));
            columns.push((format!("energy_{band}"), self.column(&self.energies, b)));
        }
        columns
    }

    /// Returns the values of `rise_ms_*`, `centre_ms_*` and `slope_per_ms_*`, by their names; null without energy.
    pub(crate) fn shape_columns(&self, bands: &[String], rate_hz: f64) -> Vec<(String, Vec<Option<f32>>)> {
        let per_ms = rate_hz / 1e3;
        let quantities: [(&str, fn(&CurveShape, f64) -> f64); 3] = [
            ("rise_ms", |shape, per_ms| shape.rise / per_ms),
            ("centre_ms", |shape, per_ms| shape.centre / per_ms),
            ("slope_per_ms", |shape, per_ms| shape.slope * per_ms),
        ];
        let column = |band: usize, value: fn(&CurveShape, f64) -> f64| {
            let shapes = self.shapes.iter().skip(band).step_by(self.bands);
            shapes.map(|shape| shape.as_ref().map(|shape| value(shape, per_ms) as f32)).collect()
        };
        let named =
            |(b, band): (usize, &String)| quantities.map(|(name, value)| (format!("{name}_{band}"), column(b, value)));
        bands.iter().enumerate().flat_map(named).collect()
    }

    /// Returns the values of `tnce_*` and `tnce_total`.
    pub(crate) fn tnce_columns(&self) -> Vec<Vec<f64>> {
        self.band_columns(&self.tnce)
    }

    /// Returns the same without Foam's reflection; without values if that is not known.
    pub(crate) fn unbiased_columns(&self) -> Vec<Vec<f64>> {
        self.band_columns(&self.unbiased)
    }

    fn band_columns(&self, values: &[f64]) -> Vec<Vec<f64>> {
        let bands = (0..self.bands).map(|band| self.column(values, band));
        bands.chain([self.totals(values)]).collect()
    }

    fn column(&self, values: &[f64], band: usize) -> Vec<f64> {
        values.iter().skip(band).step_by(self.bands).copied().collect()
    }

    fn totals(&self, values: &[f64]) -> Vec<f64> {
        values.chunks_exact(self.bands).map(|row| row.iter().sum()).collect()
    }
}
