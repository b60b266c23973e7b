//! Values computed from impulse responses: means and energies of references; responses, curves and energies of runs.

use std::collections::HashMap;

use echolake_dsp::chain::{DerivationPlan, DerivedResponse, FlatEnergies};
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

    /// Returns the values of `tnce_*` and `tnce_total`.
    pub(crate) fn tnce_columns(&self) -> Vec<Vec<f64>> {
        let mut columns: Vec<_> = (0..self.bands).map(|b| self.column(&self.tnce, b)).collect();
        columns.push(self.totals(&self.tnce));
        columns
    }

    fn column(&self, values: &[f64], band: usize) -> Vec<f64> {
        values.iter().skip(band).step_by(self.bands).copied().collect()
    }

    fn totals(&self, values: &[f64]) -> Vec<f64> {
        values.chunks_exact(self.bands).map(|row| row.iter().sum()).collect()
    }
}
