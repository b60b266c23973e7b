//! `echolake design --next`: panels whose measurement tells the most, because neither a measurement nor a simulation
//! has been near.

use std::collections::BTreeSet;

use anyhow::{Context as _, ensure};
use echolake_panel::mesh::FACETS;
use echolake_schema::simulation::UNTRUSTED_ERROR_DB;
use serde::Serialize;

use super::gaussian_process::{GaussianProcess, KnownFigure};
use super::measured::MeasuredPanel;
use super::search::{DesignCandidate, differing_candidates};
use super::target::DesignTarget;

/// Standard uncertainty of a level over Flat that is measured, dB.
const MEASURED_U_DB: f64 = 0.1;
/// Standard uncertainty of the difference of two simulated levels at the same few pairs, dB.
const SIMULATED_U_DB: f64 = 0.1;
/// Standard deviation of the levels of pairs, dB: over the root of their number it is the uncertainty of a mean.
const PAIR_SPREAD_DB: f64 = 2.0;
/// Simulated panels that are counted at most.
const MOST_SIMULATED: usize = 400;
/// Places that are compared.
const PLACES: usize = 1_000;
/// Steps of the iteration to the root of x^(d+1) = x + 1, whose powers are even steps along d axes (Roberts 2018, R
/// sequence).
const ROOT_STEPS: usize = 60;

/// A panel to measure next.
#[derive(Debug, Serialize)]
pub(super) struct NextPanel {
    pub parameters: serde_json::Value,
    /// Information that its measurement gives of the levels of all bands, bits.
    pub information_bits: f64,
    /// Level over Flat that is expected in each band, dB, and its standard deviation.
    pub expected_db: Vec<[f64; 2]>,
}

/// Returns so many panels, each the one that tells the most once those before it are measured.
pub(super) fn propose_panels(
    target: &DesignTarget,
    candidates: &[DesignCandidate],
    measured: &[MeasuredPanel],
    bands: usize,
    count: usize,
) -> anyhow::Result<Vec<NextPanel>> {
    let measured: Vec<_> =
        measured.iter().filter_map(|panel| Some((target.place_of(&panel.relief, &panel.parameters)?, panel))).collect();
    // The simulation has the same error for panels that are alike, so two of them tell no more than one does.
    let simulated = differing_candidates(target, candidates, MOST_SIMULATED);
    eprintln!(
        "within the ranges: {} surfaces of the lake, {} simulated panels that differ",
        measured.len(),
        simulated.len()
    );
    let difference_db = UNTRUSTED_ERROR_DB.hypot(PAIR_SPREAD_DB / (target.pairs as f64).sqrt());
    let fit = |band: usize| {
        let simulated = simulated.iter().map(|candidate| KnownFigure {
            place: target.coordinates_of(&candidate.values),
            value: candidate.bands[band].level_db,
            uncertainty: SIMULATED_U_DB,
            is_measured: false,
        });
        let found = measured.iter().filter_map(|(place, panel)| {
            let value = panel.levels_db()[band]?;
            Some(KnownFigure { place: place.clone(), value, uncertainty: MEASURED_U_DB, is_measured: true })
        });
        let known: Vec<_> = simulated.chain(found).collect();
        GaussianProcess::fit_figures(&known, difference_db).with_context(|| {
            format!(
                "{} panels tell nothing of the gaps between them, expected three that differ; hint: run the \
                 search, with more candidates or wider ranges",
                known.len()
            )
        })
    };
    let mut processes = (0..bands).map(fit).collect::<anyhow::Result<Vec<_>>>()?;
    let mut places = printable_places(target)?;
    ensure!(places.len() >= count, "the ranges have {} panels, {count} are wanted; hint: --next", places.len());
    let mut found = Vec::new();
    for _ in 0..count {
        let information = |place: &[f64]| -> f64 {
            let bits =
                |process: &GaussianProcess| (process.predict_figure(place).1 / MEASURED_U_DB).powi(2).ln_1p() / 2.0;
            processes.iter().map(bits).sum::<f64>() / std::f64::consts::LN_2
        };
        let told = places.iter().map(|values| information(&target.coordinates_of(values)));
        let best = told.enumerate().max_by(|(_, a), (_, b)| a.total_cmp(b));
        let (at, information_bits) = best.context("no place is left")?;
        let values = places.swap_remove(at);
        let place = &target.coordinates_of(&values)[..];
        let relief = target.relief_of(&values)?;
        found.push(NextPanel {
            parameters: relief.to_json(),
            information_bits,
            expected_db: processes
                .iter()
                .map(|process| process.predict_figure(place))
                .map(|(mean, s)| [mean, s])
                .collect(),
        });
        processes = processes
            .into_iter()
            .map(|process| process.expect_at(place, MEASURED_U_DB).context("two panels are one"))
            .collect::<anyhow::Result<Vec<_>>>()?;
    }
    Ok(found)
}

// Evenly from the ranges. Coarse heights tell a depth well enough.
fn printable_places(target: &DesignTarget) -> anyhow::Result<Vec<Vec<String>>> {
    let dimensions = target.ranges.len();
    let root = (0..ROOT_STEPS).fold(1.5f64, |x, _| (1.0 + x).powf(1.0 / (dimensions as f64 + 1.0)));
    let steps: Vec<f64> = (1..=dimensions).map(|axis| root.powi(-(axis as i32))).collect();
    let mut places = BTreeSet::new();
    for number in 0..PLACES {
        let place: Vec<f64> = steps.iter().map(|step| (0.5 + step * number as f64).fract()).collect();
        let values = target.values_at(&place)?;
        let relief = target.relief_of(&values)?;
        if relief.check_depth().is_ok()
            && (!target.limits_depth() || target.is_printable(&relief, &relief.height_field(FACETS / 4)))
        {
            places.insert(values);
        }
    }
    ensure!(!places.is_empty(), "nothing within the ranges can be printed; hint: ranges of less depth");
    Ok(places.into_iter().collect())
}
