//! From a run's impulse responses and its references to reflected responses, curves and energies, and their files.

use std::collections::HashMap;
use std::sync::Arc;

use echolake_dsp::chain::{DerivationPlan, Derived, FlatEnergies};
use echolake_lake::{EncodedFile, FileEncoder, Lake, Staged, encode};
use echolake_schema::Rig;
use echolake_schema::tables::Table;

use crate::context::Context;
use crate::error::{Error, Result};
use crate::references::{SharedFinder, Wanted};
use crate::rows::derived::Versions;
use crate::rows::runs::References;
use crate::rows::{self, Keys};

/// Measurements that are derived and encoded at a time: memory is bounded by them, not by the run.
const SLICE: usize = 256;

/// Mean impulse response of each pair of a reference.
pub(crate) type Means = HashMap<u32, Vec<f32>>;

/// Energies of each pair of Flat, its Foam subtracted.
pub(crate) type Flats = HashMap<u32, FlatEnergies>;

/// The plan of a rig's responses.
pub(crate) fn derivation_plan(rig: &Rig) -> std::result::Result<DerivationPlan<f32>, echolake_dsp::Error> {
    DerivationPlan::new(rig.impulse_response.length, rig.sweep.rate_hz.get(), &rig.bands.centres_hz)
}

/// A run's impulse responses.
#[derive(Debug, Clone, Default)]
pub(crate) struct Responses {
    pub(crate) pairs: Vec<u32>,
    /// `[pairs x length]`.
    pub(crate) irs: Vec<f32>,
}

/// What is derived of some of a run's measurements.
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

/// References, loaded, and the name of what is derived with them.
pub(crate) struct Derivation {
    pub(crate) name: String,
    flat_version: String,
    foam_version: String,
    flat: Arc<Flats>,
    foam: Arc<Means>,
}

impl DerivedRows {
    fn new(bands: usize) -> Self {
        Self { bands, curves: vec![Vec::new(); bands], ..Self::default() }
    }

    fn push(&mut self, pair: u32, derived: &Derived<f32>) {
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

    /// Responses and curves, which are left empty here.
    fn take_lists(&mut self) -> DerivedLists {
        DerivedLists {
            pairs: self.pairs.clone(),
            reflected: std::mem::take(&mut self.reflected),
            curves: std::mem::take(&mut self.curves),
        }
    }

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

impl Derivation {
    /// With the references that are wanted; None while one is missing.
    pub(crate) async fn new(run_derivation: &str, wanted: &Wanted, finder: &SharedFinder) -> Result<Option<Self>> {
        let (Some((flat_version, foam_version)), Some(name)) = (wanted.versions(), wanted.derivation(run_derivation))
        else {
            return Ok(None);
        };
        let Some((foam, flat)) = finder.lock().await.load(wanted).await? else { return Ok(None) };
        Ok(Some(Self { name, flat_version, foam_version, flat, foam }))
    }

    /// Derives all of a run that both references have, and stages its files. Returns what the run's row says of it.
    pub(crate) async fn stage(
        self,
        context: &Context,
        keys: &Keys,
        responses: Responses,
    ) -> Result<(Vec<Staged>, References)> {
        let (this, for_rows, lake) = (Arc::new(self), keys.clone(), context.lake.clone());
        let derivation = this.clone();
        let (files, unpaired) = context.cores.compute(move || derivation.encode(&lake, &for_rows, &responses)).await?;
        let staged = context.stage_rows(keys, &this.name, files).await?;
        let references = References {
            missing: if unpaired == 0 { String::new() } else { format!("references of {unpaired} pairs") },
            derivation: Some(this.name.clone()),
            flat_version: Some(this.flat_version.clone()),
            foam_version: Some(this.foam_version.clone()),
        };
        Ok((staged, references))
    }

    // The files, and how many pairs a reference lacks.
    fn encode(&self, lake: &Lake, keys: &Keys, responses: &Responses) -> Result<(Vec<(Table, EncodedFile)>, usize)> {
        let (rig, grid) = (lake.rig(), lake.grid());
        let moved = rows::derived::Moved::of(grid);
        let of = Versions { flat: &self.flat_version, foam: &self.foam_version };
        let mut encoders =
            [Table::Nce, Table::Tnce, Table::TnceD4].map(|table| (table, FileEncoder::new(table, table.schema(rig))));
        let mut totals: Vec<Vec<f64>> = vec![Vec::new(); rig.bands.centres_hz.len() + 1];
        let mut paired = 0;
        self.slices(rig, keys, responses, &mut |slice| {
            paired += slice.pairs.len();
            totals.iter_mut().zip(slice.tnce_columns()).for_each(|(all, some)| all.extend(some));
            let [nce, tnce, tnce_d4] = &mut encoders;
            let lists = slice.take_lists();
            // Lists are most of it, and the rest is for another core that has nothing else to do.
            let (first, second) = rayon::join(
                || Ok(nce.1.write(&rows::derived::nce(rig, grid, keys, lists, of)?)?),
                || {
                    tnce.1.write(&rows::derived::tnce(rig, grid, keys, slice, of)?)?;
                    Ok(tnce_d4.1.write(&rows::derived::tnce_d4(rig, grid, &moved, keys, slice, of)?)?)
                },
            );
            first.and(second)
        })?;
        let mut files = Vec::with_capacity(4);
        for (table, encoder) in encoders {
            files.push((table, encoder.finish()?));
        }
        let stats = rows::stats::rows(rig, keys, &totals, of)?;
        files.push((Table::SurfaceStats, encode(Table::SurfaceStats, &Table::SurfaceStats.schema(rig), &[stats])?));
        Ok((files, responses.pairs.len() - paired))
    }

    fn slices(
        &self,
        rig: &Rig,
        keys: &Keys,
        responses: &Responses,
        take: &mut dyn FnMut(&mut DerivedRows) -> Result<()>,
    ) -> Result<()> {
        let (bands, length) = (rig.bands.centres_hz.len(), rig.impulse_response.length);
        let failed = |cause| Error::Kernel { file: keys.run.to_string(), cause };
        let plan = derivation_plan(rig).map_err(failed)?;
        let (mut scratch, mut derived) = (plan.scratch(), plan.derived());
        let irs = responses.pairs.chunks(SLICE).zip(responses.irs.chunks(SLICE * length));
        for (pairs, irs) in irs {
            let mut slice = DerivedRows::new(bands);
            for (pair, ir) in pairs.iter().zip(irs.chunks_exact(length)) {
                if let (Some(foam), Some(flat)) = (self.foam.get(pair), self.flat.get(pair)) {
                    plan.run_over(ir, foam, flat, &mut derived, &mut scratch).map_err(failed)?;
                    slice.push(*pair, &derived);
                }
            }
            take(&mut slice)?;
        }
        Ok(())
    }
}
