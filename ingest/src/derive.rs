//! Derives reflected responses, curves and energies from a run's impulse responses and references.

use std::sync::Arc;

use echolake_dsp::Complex;
use echolake_dsp::air_correction::SLOPE_UNCERTAINTY;
use echolake_dsp::filter_bank::FilterBankPlan;
use echolake_dsp::mean::SignalMean;
use echolake_dsp::scattering::{ScatteringPath, ScatteringSums};
use echolake_dsp::temperature::ReferenceAir;
use echolake_dsp::uncertainty::{EnergySensitivity, LevelUncertainty};
use echolake_lake::{EncodedFile, FileEncoder, Lake, encode_batches, verdict_mark};
use echolake_schema::annotations::RejectedMeasurements;
use echolake_schema::tables::Table;
use echolake_schema::{AirTreatment, RunId};

use crate::context::IngestContext;
use crate::derived_values::{DerivedRows, RunResponses, derivation_plan, residual_fit};
use crate::error::{Error, Result};
use crate::references::{LoadedReferences, PairPaths, WantedReferences};
use crate::rows::derived::ReferenceVersions;
use crate::rows::runs::RunReferences;
use crate::rows::stats::SurfaceLevels;
use crate::rows::{self, RunKeys};

/// Number of measurements derived and encoded at a time: it bounds memory independently of the run's length.
const SLICE: usize = 256;

/// Loaded references, and the name of the derivation with them.
pub(crate) struct ReferenceDerivation {
    pub name: String,
    flat_version: String,
    foam_version: String,
    references: LoadedReferences,
    /// Measurements that have rows, and that statistics leave out.
    rejected: Arc<RejectedMeasurements>,
}

impl ReferenceDerivation {
    /// Loads the references wanted for a run; None if one is missing.
    pub async fn new(
        context: &IngestContext,
        run: &RunId,
        run_derivation: &str,
        wanted: &WantedReferences,
    ) -> Result<Option<Self>> {
        let mark = verdict_mark(&context.rejected, run);
        let (Some((flat_version, foam_version)), Some(name)) =
            (wanted.version_pair(), wanted.derivation_name(run_derivation, mark.as_deref()))
        else {
            return Ok(None);
        };
        let Some(references) = context.finder.lock().await.load_references(wanted, &context.cores).await? else {
            return Ok(None);
        };
        let rejected = context.rejected.clone();
        Ok(Some(Self { name, flat_version, foam_version, references, rejected }))
    }

    /// Derives every pair that both references have. Returns the files, and the run row's references.
    pub async fn derive_run(
        self,
        context: &IngestContext,
        keys: &RunKeys,
        responses: RunResponses,
    ) -> Result<(Vec<(Table, EncodedFile)>, RunReferences)> {
        let this = Arc::new(self);
        let for_rows = keys.clone();
        let lake = context.lake.clone();
        let derivation = this.clone();
        let (files, unpaired) =
            context.cores.compute_on_core(move || derivation.encode_tables(&lake, &for_rows, &responses)).await?;
        let references = RunReferences {
            missing: if unpaired == 0 { String::new() } else { format!("references of {unpaired} pairs") },
            derivation: Some(this.name.clone()),
            flat_version: Some(this.flat_version.clone()),
            foam_version: Some(this.foam_version.clone()),
        };
        Ok((files, references))
    }

    // Returns the files, and the number of pairs that a reference lacks.
    fn encode_tables(
        &self,
        lake: &Lake,
        keys: &RunKeys,
        responses: &RunResponses,
    ) -> Result<(Vec<(Table, EncodedFile)>, usize)> {
        let rig = lake.rig();
        let grid = lake.grid();
        let failed = |cause| Error::Kernel { file: keys.run.to_string(), cause };
        let moved = rows::derived::SymmetryPairs::from_grid(grid);
        let of = ReferenceVersions { flat: &self.flat_version, foam: &self.foam_version };
        let mut encoders =
            [Table::Nce, Table::Tnce, Table::TnceD4].map(|table| (table, FileEncoder::new(table, table.schema(rig))));
        let mut totals: Vec<Vec<f64>> = vec![Vec::new(); rig.bands.centres_hz.len() + 1];
        let mut unbiased = vec![totals.clone(); self.references.estimate_count()];
        let mut errors = vec![Vec::new(); totals.len()];
        let mut curves = vec![SignalMean::default(); rig.bands.centres_hz.len()];
        let mut scattering = ScatteringSums::default();
        let mut paired = 0;
        let uncertainty = self.level_uncertainty(lake, keys, responses)?;
        self.derive_slices(lake, keys, responses, uncertainty.as_ref(), &mut scattering, &mut |slice| {
            paired += slice.pairs.len();
            let counted: Vec<bool> = slice.pairs.iter().map(|pair| self.is_counted(keys, *pair)).collect();
            extend_columns(&mut totals, slice.tnce_columns(), &counted);
            for (estimate, columns) in unbiased.iter_mut().zip(slice.unbiased_columns()) {
                extend_columns(estimate, columns, &counted);
            }
            extend_columns(&mut errors, slice.error_columns(), &counted);
            let [nce, tnce, tnce_d4] = &mut encoders;
            let lists = slice.take_lists(lake.config().samples);
            lists.add_curves(rig.impulse_response.length, &counted, &mut curves).map_err(failed)?;
            // Lists take most of the time; an idle core can encode the rest meanwhile.
            let (first, second) = rayon::join(
                || Ok(nce.1.write_batch(&rows::derived::nce_rows(rig, grid, keys, lists, of)?)?),
                || {
                    tnce.1.write_batch(&rows::derived::tnce_rows(rig, grid, keys, slice, of)?)?;
                    Ok(tnce_d4.1.write_batch(&rows::derived::tnce_d4(rig, grid, &moved, keys, slice, of)?)?)
                },
            );
            first.and(second)
        })?;
        let mut files = Vec::with_capacity(4);
        for (table, encoder) in encoders {
            files.push((table, encoder.finish()?));
        }
        let bank = FilterBankPlan::new(rig.impulse_response.length, rig.sweep.rate_hz.get(), &rig.bands.centres_hz);
        let scattering = scattering.band_coefficients(&bank.map_err(failed)?).unwrap_or_default();
        let levels = SurfaceLevels { tnce: totals, unbiased, errors, uncertainty, curves, scattering };
        // Of a rejected run there are none: they would be those of the surface's newest run.
        let mut stats = Vec::new();
        if !self.rejected.is_run_rejected(keys.run.as_str()) {
            stats.push(rows::stats::stats_rows(rig, keys, &levels, of)?);
        }
        let schema = Table::SurfaceStats.schema(rig);
        files.push((Table::SurfaceStats, encode_batches(Table::SurfaceStats, &schema, &stats)?));
        Ok((files, responses.pairs.len() - paired))
    }

    fn derive_slices(
        &self,
        lake: &Lake,
        keys: &RunKeys,
        responses: &RunResponses,
        uncertainty: Option<&LevelUncertainty>,
        scattering: &mut ScatteringSums,
        take: &mut dyn FnMut(&mut DerivedRows) -> Result<()>,
    ) -> Result<()> {
        let rig = lake.rig();
        let bands = rig.bands.centres_hz.len();
        let length = rig.impulse_response.length;
        let failed = |cause| Error::Kernel { file: keys.run.to_string(), cause };
        let plan = derivation_plan(rig).map_err(failed)?;
        let chosen = &self.references.chosen;
        let mut scratch = plan.make_scratch();
        let mut air_scratch = chosen.make_scratch();
        let mut derived = plan.make_derived();
        let mut reflected = vec![0.0; length];
        let mut spectrum = vec![Complex::default(); length / 2 + 1];
        let mut energies = vec![0.0; bands];
        let mut sensitivities = vec![EnergySensitivity::default(); bands];
        let sides = lake.grid().points().iter().flat_map(|point| [point.position_mm[0], point.position_mm[1]]);
        let widest_mm = sides.map(f64::abs).fold(1.0, f64::max);
        let slices = responses.pairs.chunks(SLICE).zip(responses.irs.chunks(SLICE * length));
        for ((pairs, irs), airs) in slices.zip(responses.airs.chunks(SLICE)) {
            let mut slice = DerivedRows::new(bands);
            for ((pair, ir), air) in pairs.iter().zip(irs.chunks_exact(length)).zip(airs) {
                let (Some((direct, flat)), Some(paths)) = (chosen.of_pair(*pair), PairPaths::new(lake, *pair)) else {
                    continue;
                };
                chosen.subtract_direct(ir, direct, air, &paths, &mut reflected, &mut air_scratch).map_err(failed)?;
                plan.run_over(&reflected, &flat.energies, &mut derived, &mut scratch).map_err(failed)?;
                slice.push(*pair, &derived);
                if let Some(uncertainty) = uncertainty {
                    plan.compute_sensitivities(
                        &reflected,
                        &direct.ir,
                        |bin| chosen.energy_per_kelvin(bin, paths.reflected_m),
                        &mut sensitivities,
                        &mut scratch,
                    )
                    .map_err(failed)?;
                    slice.push_errors(uncertainty, &sensitivities, flat);
                }
                for (number, unbiased) in self.references.unbiased_pair(*pair).iter().enumerate() {
                    chosen.reflected_spectrum(&unbiased.direct, &mut spectrum, &air_scratch);
                    plan.spectrum_energies(&spectrum, &mut energies);
                    slice.push_unbiased(number, &energies, unbiased.flat_total);
                    if number == 0 && self.is_counted(keys, *pair) {
                        let specular = paths.specular_mm.map(|mm| mm / widest_mm);
                        let path = ScatteringPath { incidence_deg: paths.incidence_deg, specular };
                        scattering.add_pair(&spectrum, &unbiased.flat, path).map_err(failed)?;
                    }
                }
            }
            take(&mut slice)?;
        }
        Ok(())
    }

    // Returns whether a run's statistics count a pair.
    fn is_counted(&self, keys: &RunKeys, pair: u32) -> bool {
        !self.rejected.is_rejected(keys.run.as_str(), pair)
    }

    // None if what the direct sound's subtraction leaves cannot be measured.
    fn level_uncertainty(
        &self,
        lake: &Lake,
        keys: &RunKeys,
        responses: &RunResponses,
    ) -> Result<Option<LevelUncertainty>> {
        let failed = |cause| Error::Kernel { file: keys.run.to_string(), cause };
        let chosen = &self.references.chosen;
        let Some(flat) = chosen.flat_residual else { return Ok(None) };
        let response = &lake.rig().impulse_response;
        let mut fit = residual_fit(lake.rig()).map_err(failed)?;
        let mut reflected = vec![0.0; response.length];
        let mut scratch = chosen.make_scratch();
        let measured = responses.pairs.iter().zip(responses.irs.chunks_exact(response.length)).zip(&responses.airs);
        let reference = ReferenceAir::from_response(response);
        // Of kelvins above Flat's air, and of logarithms of the ratio of speeds of sound by which times were corrected.
        let mut pairs = 0.0;
        let [mut warmer_sum, mut ln_ratio_sum] = [0.0; 2];
        for ((pair, ir), air) in measured {
            let (Some((direct, flat)), Some(paths)) = (chosen.of_pair(*pair), PairPaths::new(lake, *pair)) else {
                continue;
            };
            if !self.is_counted(keys, *pair) {
                continue;
            }
            chosen.subtract_direct(ir, direct, air, &paths, &mut reflected, &mut scratch).map_err(failed)?;
            let [direct_secs, reflected_secs] = paths.arrival_secs(lake.rig());
            fit.add_pair(&reflected, &direct.ir, direct_secs, reflected_secs).map_err(failed)?;
            pairs += 1.0;
            warmer_sum += air.temperature_c - flat.air.temperature_c;
            ln_ratio_sum += reference.time_ratio(air).ln();
        }
        // Where energies are not corrected for the air, its difference to Flat's is part of their uncertainty.
        let [difference_k, correction] = match response.air {
            AirTreatment::Complete => [0.0, 2.0 * SLOPE_UNCERTAINTY * ln_ratio_sum / pairs],
            AirTreatment::Paper => [warmer_sum / pairs, 0.0],
        };
        let is_flat = self.references.only_flat.as_ref() == Some(&keys.surface);
        Ok(fit.finish().map(|run| LevelUncertainty {
            run,
            flat: (!is_flat).then_some(flat),
            temperature_k: response.temperature_u_k.hypot(difference_k),
            correction,
        }))
    }
}

// Adds the counted rows of each column.
fn extend_columns<T>(all: &mut [Vec<T>], columns: Vec<Vec<T>>, counted: &[bool]) {
    for (all, column) in all.iter_mut().zip(columns) {
        all.extend(column.into_iter().zip(counted).filter(|(_, is_counted)| **is_counted).map(|(value, _)| value));
    }
}
