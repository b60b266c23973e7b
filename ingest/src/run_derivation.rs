//! From a run's impulse responses and references to reflected responses, curves and energies, in one pass.
//!
//! Uncertainties follow from what the direct sound's subtraction leaves of all pairs: the pass keeps how sensitive the
//! energies of each pair are, and they are computed at its end.

use std::ops::Range;

use echolake_dsp::air::AirState;
use echolake_dsp::air_correction::{AirScratch, TransformedResponse};
use echolake_dsp::chain::{DerivationPlan, DerivationScratch, DerivedResponse};
use echolake_dsp::full_scale_octave::bin_shares_of_octaves;
use echolake_dsp::mean::SignalMean;
use echolake_dsp::scattering::{ScatteringPath, ScatteringSums};
use echolake_dsp::temperature::ReferenceAir;
use echolake_dsp::uncertainty::{EnergySensitivity, LevelUncertainty, ResidualFit};
use echolake_dsp::{Complex, Error};
use echolake_lake::Lake;
use echolake_schema::AirTreatment;

use crate::derived_values::{DerivedColumns, DerivedLists, RunResponses, derivation_plan, residual_fit, round_lists};
use crate::references::LoadedReferences;
use crate::rows::stats::SurfaceLevels;

/// Gain of the direct sound over Foam's below which a take's polarity is inverted: nothing else turns its sign.
const INVERTED_GAIN: f64 = -0.3;

/// A run whose responses are derived part by part: plans, buffers, and what is derived so far.
pub(crate) struct RunDerivation<'a> {
    lake: &'a Lake,
    references: &'a LoadedReferences,
    plan: DerivationPlan<f32>,
    buffers: DerivationBuffers,
    reference_air: ReferenceAir,
    /// Greatest coordinate of the grid along a side of the panel.
    widest_mm: f64,
    columns: DerivedColumns,
    /// True for each pair of the columns that the run's statistics count.
    counted: Vec<bool>,
    /// Pairs whose direct sound has the other sign than Foam's.
    pub inverted: usize,
    curves: Vec<SignalMean>,
    scattering: ScatteringSums,
    residual: ResidualFit<f32>,
    /// Sums over the counted pairs: of kelvins above Flat's air, and of logarithms of the ratio of speeds of sound by
    /// which times were corrected.
    warmer_sum_k: f64,
    ln_ratio_sum: f64,
}

struct DerivationBuffers {
    plan: DerivationScratch<f32>,
    air: AirScratch<f32>,
    reflected: TransformedResponse<f32>,
    derived: DerivedResponse<f32>,
    spectrum: Vec<Complex<f32>>,
    energies: Vec<f64>,
    sensitivities: Vec<EnergySensitivity>,
}

impl<'a> RunDerivation<'a> {
    /// Begins with no response.
    ///
    /// # Errors
    /// [`Error::Setting`] of the lake's rig.
    pub fn new(lake: &'a Lake, references: &'a LoadedReferences) -> Result<Self, Error> {
        let rig = lake.rig();
        let bands = rig.bands.centres_hz.len();
        let plan = derivation_plan(rig)?;
        let correction = references.correction();
        let sides = lake.grid().points().iter().flat_map(|point| [point.position_mm[0], point.position_mm[1]]);
        let buffers = DerivationBuffers {
            plan: plan.make_scratch(),
            air: correction.make_scratch(),
            reflected: correction.make_reflected(),
            derived: plan.make_derived(),
            spectrum: correction.make_reflected().spectrum,
            energies: vec![0.0; bands],
            sensitivities: vec![EnergySensitivity::default(); bands],
        };
        Ok(Self {
            lake,
            references,
            plan,
            buffers,
            reference_air: ReferenceAir::from_response(&rig.impulse_response),
            widest_mm: sides.map(f64::abs).fold(1.0, f64::max),
            columns: DerivedColumns::new(bands, references.estimate_count),
            counted: Vec::new(),
            inverted: 0,
            curves: vec![SignalMean::default(); bands],
            scattering: ScatteringSums::default(),
            residual: residual_fit(rig)?,
            warmer_sum_k: 0.0,
            ln_ratio_sum: 0.0,
        })
    }

    /// Derives some of the responses: those of pairs that the references have. Returns their lists; other values are
    /// kept for [`Self::finish`]. `is_counted` tells whether the run's statistics count a pair.
    ///
    /// # Errors
    /// [`Error::NotFinite`].
    pub fn derive_part(
        &mut self,
        responses: &RunResponses,
        part: Range<usize>,
        is_counted: impl Fn(u32) -> bool,
    ) -> Result<DerivedLists, Error> {
        let length = self.lake.rig().impulse_response.length;
        let precision = self.lake.config().samples;
        let mut lists = DerivedLists::with_capacity(part.len(), self.curves.len(), length);
        let irs = responses.irs.chunks_exact(length).skip(part.start);
        let measured = responses.pairs[part.clone()].iter().zip(irs).zip(&responses.airs[part]);
        for ((pair, ir), air) in measured {
            let is_counted = is_counted(*pair);
            if !self.derive_response(*pair, ir, air, is_counted)? {
                continue;
            }
            let derived = &mut self.buffers.derived;
            round_lists(derived, precision);
            if is_counted {
                let curves = derived.curves.chunks_exact(length);
                self.curves.iter_mut().zip(curves).try_for_each(|(mean, curve)| mean.add_signal(curve))?;
            }
            lists.push(*pair, derived);
        }
        Ok(lists)
    }

    // Returns false if the references lack the pair, or its polarity is inverted.
    fn derive_response(&mut self, number: u32, ir: &[f32], air: &AirState, is_counted: bool) -> Result<bool, Error> {
        let Some(pair) = self.references.find_pair(number) else { return Ok(false) };
        let correction = self.references.correction();
        let DerivationBuffers {
            plan: scratch,
            air: air_scratch,
            reflected,
            derived,
            spectrum,
            energies,
            sensitivities,
        } = &mut self.buffers;
        pair.subtract_direct(correction, ir, air, reflected, air_scratch)?;
        if air_scratch.direct_gain(&pair.direct.spectrum) < INVERTED_GAIN {
            self.inverted += 1;
            return Ok(false);
        }
        self.plan.run_over(reflected, &pair.flat.energies, derived, scratch)?;
        self.columns.push(number, derived);
        self.counted.push(is_counted);
        if self.references.flat_residual.is_some() {
            let by_air = |bin| correction.energy_changes(bin, pair.paths.reflected_m);
            let direct = &pair.direct.spectrum;
            self.plan.compute_sensitivities(&reflected.spectrum, direct, by_air, sensitivities, scratch)?;
            self.columns.push_sensitivities(sensitivities);
            if is_counted {
                self.residual.add_pair(&reflected.spectrum, &pair.waveform)?;
                self.warmer_sum_k += air.temperature_c - pair.flat.air.temperature_c;
                self.ln_ratio_sum += self.reference_air.time_ratio(air).ln();
            }
        }
        for (estimate, unbiased) in pair.unbiased.iter().enumerate() {
            correction.reflected_spectrum(&unbiased.direct, spectrum, air_scratch);
            self.plan.spectrum_energies(spectrum, energies);
            self.columns.push_unbiased(estimate, energies, unbiased.flat_total);
            if estimate == 0 && is_counted {
                let specular = pair.paths.specular_mm.map(|mm| mm / self.widest_mm);
                let path = ScatteringPath { incidence_deg: pair.paths.incidence_deg, specular };
                self.scattering.add_pair(spectrum, &unbiased.flat, path)?;
            }
        }
        Ok(true)
    }

    /// Computes the uncertainties, and the levels that the surface's statistics are made of. `is_flat` tells whether
    /// Flat's energies are of this run alone.
    ///
    /// # Errors
    /// [`Error::Setting`] of the lake's rig.
    pub fn finish(self, is_flat: bool) -> Result<(DerivedColumns, SurfaceLevels), Error> {
        let uncertainty = self.level_uncertainty(is_flat);
        let Self { lake, references, mut columns, counted, curves, scattering, .. } = self;
        if let Some(uncertainty) = &uncertainty {
            columns
                .fill_errors(uncertainty, |pair| references.find_pair(pair).map(|pair| &pair.flat.sensitivities[..]));
        }
        let rig = lake.rig();
        let keep_estimate = |estimate| keep_counted(estimate, &counted);
        let levels = SurfaceLevels {
            tnce: keep_counted(columns.tnce.clone(), &counted),
            unbiased: std::mem::take(&mut columns.unbiased).into_iter().map(keep_estimate).collect(),
            errors: keep_counted(std::mem::take(&mut columns.errors), &counted),
            uncertainty,
            curves,
            scattering: scattering.octave_coefficients(&bin_shares_of_octaves(rig)?),
        };
        Ok((columns, levels))
    }

    // None if what the direct sound's subtraction leaves cannot be measured.
    fn level_uncertainty(&self, is_flat: bool) -> Option<LevelUncertainty> {
        let flat = self.references.flat_residual?;
        let run = self.residual.finish()?;
        let response = &self.lake.rig().impulse_response;
        let pairs = self.counted.iter().filter(|is_counted| **is_counted).count() as f64;
        // Where energies are not corrected for the air, its difference to Flat's is part of their uncertainty.
        let [difference_k, ln_ratio] = match response.air {
            AirTreatment::Complete => [0.0, self.ln_ratio_sum / pairs],
            AirTreatment::Paper => [self.warmer_sum_k / pairs, 0.0],
        };
        let flat = (!is_flat).then_some(flat);
        let temperature_k = response.temperature_u_k.hypot(difference_k);
        Some(LevelUncertainty { run, flat, temperature_k, ln_ratio })
    }
}

// Keeps the counted values of each column.
fn keep_counted<T>(columns: Vec<Vec<T>>, counted: &[bool]) -> Vec<Vec<T>> {
    let keep = |column: Vec<T>| {
        column.into_iter().zip(counted).filter(|(_, is_counted)| **is_counted).map(|(value, _)| value).collect()
    };
    columns.into_iter().map(keep).collect()
}
