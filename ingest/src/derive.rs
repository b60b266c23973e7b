//! From a run's impulse responses and its references to reflected responses, curves and energies.

use std::collections::HashMap;

use echolake_dsp::chain::{DerivationPlan, Derived};
use echolake_schema::Rig;
use rayon::prelude::*;

use crate::error::{Error, Result};

/// Mean impulse response of each pair of a reference.
pub(crate) type Means = HashMap<u32, Vec<f32>>;

/// A run's impulse responses.
#[derive(Debug, Clone, Default)]
pub(crate) struct Responses {
    pub(crate) pairs: Vec<u32>,
    /// `[pairs x length]`.
    pub(crate) irs: Vec<f32>,
}

/// What is derived of a run, a row a pair that both references have.
#[derive(Debug, Clone, Default)]
pub(crate) struct DerivedRun {
    bands: usize,
    pub(crate) pairs: Vec<u32>,
    /// `[pairs x length]`.
    pub(crate) reflected: Vec<f32>,
    /// `[pairs x bands x length]`.
    pub(crate) curves: Vec<f32>,
    /// `[pairs x bands]`.
    energies: Vec<f64>,
    tnce: Vec<f64>,
    tnce_over_band: Vec<f64>,
}

impl DerivedRun {
    /// Values of every column from `tnce_*` to `energy_total`, in the tables' order.
    pub(crate) fn energy_columns(&self) -> Vec<Vec<f64>> {
        let mut columns = self.tnce_columns();
        columns.extend((0..self.bands).map(|b| self.column(&self.tnce_over_band, b)));
        columns.extend((0..self.bands).map(|b| self.column(&self.energies, b)));
        columns.push(self.totals(&self.energies));
        columns
    }

    /// Values of `tnce_*` and `tnce_total`.
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

/// Derives all of a run that both references have. `flat` has Foam subtracted already.
pub(crate) fn derive(rig: &Rig, responses: &Responses, foam: &Means, flat: &Means, file: &str) -> Result<DerivedRun> {
    let (bands, length) = (rig.bands.centres_hz.len(), rig.impulse_response.length);
    let failed = |cause| Error::Kernel { file: file.to_owned(), cause };
    let plan = DerivationPlan::<f32>::new(length, rig.sweep.rate_hz.get(), &rig.bands.centres_hz).map_err(failed)?;
    let wanted: Vec<_> = responses
        .pairs
        .iter()
        .zip(responses.irs.chunks_exact(length))
        .filter_map(|(pair, ir)| Some((*pair, ir, foam.get(pair)?, flat.get(pair)?)))
        .collect();
    let count = wanted.len();
    let mut out = DerivedRun {
        bands,
        pairs: wanted.iter().map(|w| w.0).collect(),
        reflected: vec![0.0; count * length],
        curves: vec![0.0; count * bands * length],
        energies: vec![0.0; count * bands],
        tnce: vec![0.0; count * bands],
        tnce_over_band: vec![0.0; count * bands],
    };
    let rows = wanted
        .par_iter()
        .zip(out.reflected.par_chunks_exact_mut(length))
        .zip(out.curves.par_chunks_exact_mut(bands * length))
        .zip(out.energies.par_chunks_exact_mut(bands))
        .zip(out.tnce.par_chunks_exact_mut(bands))
        .zip(out.tnce_over_band.par_chunks_exact_mut(bands));
    rows.try_for_each_init(
        || (plan.scratch(), plan.derived()),
        |(scratch, derived), (((((row, reflected), curves), energies), tnce), over_band)| {
            let (_, ir, foam, flat) = *row;
            plan.run(ir, foam, flat, derived, scratch)?;
            let Derived { reflected: r, curves: c, energies: e, tnce: t, tnce_over_band: b, .. } = derived;
            reflected.copy_from_slice(r);
            curves.copy_from_slice(c);
            energies.copy_from_slice(e);
            tnce.copy_from_slice(t);
            over_band.copy_from_slice(b);
            Ok(())
        },
    )
    .map_err(failed)?;
    Ok(out)
}
