//! The search for a design's parameters: CMA-ES on the simulation, and the file of its candidates, from which a search
//! that was stopped goes on.

use std::collections::HashMap;
use std::fs::File;
use std::io::{Read as _, Write as _};
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};

use anyhow::{Context as _, bail, ensure};
use cmaes::{CMAESOptions, DVector};
use echolake_acquisition::design::{BandFigures, DesignSimulation};
use echolake_dsp::scattering::UncertainNumber;
use echolake_panel::mesh::FACETS;

use super::target::DesignTarget;
use crate::progress::TaskProgress;
use crate::signals::StopRequest;

/// First steps of a search over the whole ranges and beside a good candidate, and the step under which it begins again
/// elsewhere, as shares of a range.
const WIDE_STEP: f64 = 0.3;
const NARROW_STEP: f64 = 0.1;
const LAST_STEP: f64 = 2e-3;
/// Distance of panels that count as different, as a share of a parameter's range.
const LEAST_DISTANCE: f64 = 0.05;
/// Ratio of the golden section: multiples of it spread over the ranges.
const GOLDEN_RATIO: f64 = 0.618_033_988_749_894_9;
/// Misfit of a panel that cannot be printed, to which the distance to the ranges is added.
const UNPRINTABLE: f64 = 100.0;
/// Values per band in the file of candidates.
const COLUMNS_PER_BAND: usize = 3;

/// A panel that was simulated.
#[derive(Debug, Clone)]
pub(super) struct DesignCandidate {
    /// Values of the searched parameters.
    pub values: Vec<String>,
    /// At the pairs of the search; what [`DesignSearch::run`] returns is corrected for all pairs.
    pub bands: Vec<BandFigures>,
}

/// A search, which threads share.
pub(super) struct DesignSearch<'a> {
    target: &'a DesignTarget,
    simulation: &'a DesignSimulation,
    stop: &'a StopRequest,
    state: Mutex<SearchState>,
}

struct SearchState {
    candidates: Vec<DesignCandidate>,
    by_values: HashMap<Vec<String>, usize>,
    /// Difference of the figures at all pairs from those at the pairs of the search, by band; nothing before a panel
    /// was simulated at all pairs.
    corrections: Vec<BandFigures>,
    file: File,
    progress: TaskProgress,
    evaluations: usize,
    /// The best of these evaluations, and its misfit.
    best: Option<(f64, Vec<String>)>,
    /// The first error; the search ends with it.
    failed: Option<anyhow::Error>,
}

impl<'a> DesignSearch<'a> {
    /// Opens the file of candidates, behind those of before.
    pub fn open_file(
        path: &Path,
        header: &str,
        candidates: Vec<DesignCandidate>,
        target: &'a DesignTarget,
        simulation: &'a DesignSimulation,
        stop: &'a StopRequest,
        mut progress: TaskProgress,
    ) -> anyhow::Result<Self> {
        let failed = || format!("cannot write `{}`", path.display());
        let mut file = File::options().append(true).read(true).create(true).open(path).with_context(failed)?;
        file.try_lock().with_context(|| format!("another search writes `{}`", path.display()))?;
        // A line that was cut off is written again.
        let mut text = Vec::new();
        file.read_to_end(&mut text).with_context(failed)?;
        let whole = text.iter().rposition(|byte| *byte == b'\n').map_or(0, |end| end + 1);
        file.set_len(whole as u64).with_context(failed)?;
        if whole == 0 {
            file.write_all(format!("{header}\n").as_bytes()).with_context(failed)?;
        }
        progress.begin_at(candidates.len() as u64);
        let by_values = candidates.iter().enumerate().map(|(at, c)| (c.values.clone(), at)).collect();
        let state = SearchState {
            candidates,
            by_values,
            corrections: Vec::new(),
            file,
            progress,
            evaluations: 0,
            best: None,
            failed: None,
        };
        Ok(Self { target, simulation, stop, state: Mutex::new(state) })
    }

    /// Tries as many candidates as the target says; those of before count and cost nothing. After half of them, the
    /// best is simulated at all pairs, and what these add to its figures is added to all. Returns all, the best first.
    pub fn run(self, whole: &DesignSimulation) -> anyhow::Result<Vec<DesignCandidate>> {
        let middle = vec![0.5; self.target.ranges.len()];
        self.search_ranges(middle.clone(), WIDE_STEP, self.target.candidates / 2)?;
        match self.correct_by(whole)? {
            Some(best) => {
                self.search_ranges(self.target.shares_of(&best.values), NARROW_STEP, self.target.candidates)?;
            }
            None => self.search_ranges(middle, WIDE_STEP, self.target.candidates)?,
        }
        let state = self.state.into_inner().unwrap_or_else(PoisonError::into_inner);
        ensure!(
            !state.candidates.is_empty(),
            "none of {} candidates can be printed; hint: ranges of less depth, or a larger greatest_depth_mm",
            state.evaluations
        );
        let mut candidates = state.candidates;
        candidates.iter_mut().for_each(|candidate| add_figures(&mut candidate.bands, &state.corrections));
        let misfit = |candidate: &DesignCandidate| self.target.figures_misfit(&candidate.bands);
        // Threads end in any order; values decide among those that fit alike.
        candidates.sort_by(|a, b| misfit(a).total_cmp(&misfit(b)).then_with(|| a.values.cmp(&b.values)));
        state.progress.finish_with(format!("{} panels simulated", candidates.len()));
        Ok(candidates)
    }

    // Searches from a middle with a first step, and elsewhere where it converges, up to so many evaluations in all.
    fn search_ranges(&self, middle: Vec<f64>, step: f64, most: usize) -> anyhow::Result<()> {
        let mut start = (middle, step);
        for attempt in 1u64.. {
            let done = self.lock_state().evaluations;
            if done >= most {
                break;
            }
            let (middle, step) = start;
            let mut search = CMAESOptions::new(middle, step)
                .max_function_evals(most - done)
                .tol_x(LAST_STEP)
                .seed(self.target.seed.wrapping_add(done as u64 + attempt))
                .build(|point: &DVector<f64>| self.evaluate_point(point.as_slice()))
                .map_err(|e| anyhow::anyhow!("the search cannot begin: {e:?}"))?;
            search.run_parallel();
            drop(search);
            if let Some(error) = self.lock_state().failed.take() {
                return Err(error);
            }
            let along = |number: usize| (0.5 + GOLDEN_RATIO * attempt as f64 * (number + 1) as f64).fract();
            start = ((0..self.target.ranges.len()).map(along).collect(), WIDE_STEP);
        }
        Ok(())
    }

    // Returns the best so far; None if nothing could be printed.
    fn correct_by(&self, whole: &DesignSimulation) -> anyhow::Result<Option<DesignCandidate>> {
        let mut state = self.lock_state();
        let Some((_, values)) = state.best.take() else { return Ok(None) };
        let best = state.candidates[state.by_values[&values]].clone();
        let relief = self.target.relief_of(&values)?;
        let mut figures = whole.compute_figures(&relief.height_field(FACETS), relief.material())?.bands;
        for (all, some) in figures.iter_mut().zip(&best.bands) {
            all.level_db -= some.level_db;
            all.spread_db -= some.spread_db;
            all.scattering.value -= some.scattering.value;
        }
        state.corrections = figures;
        Ok(Some(best))
    }

    fn lock_state(&self) -> MutexGuard<'_, SearchState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    // NaN ends the search.
    fn evaluate_point(&self, point: &[f64]) -> f64 {
        let outside: f64 = point.iter().map(|x| (x - x.clamp(0.0, 1.0)).powi(2)).sum::<f64>().sqrt();
        let evaluated = self.evaluate_inside(point);
        let mut state = self.lock_state();
        state.evaluations += 1;
        match evaluated {
            Ok(misfit) => {
                if let Some((best, _)) = &state.best {
                    let note = format!("best so far: {best:.2}");
                    state.progress.set_note(note);
                }
                let done = state.evaluations as u64;
                state.progress.set_done(done);
                misfit + outside * UNPRINTABLE.sqrt()
            }
            Err(error) => {
                state.failed.get_or_insert(error);
                f64::NAN
            }
        }
    }

    fn evaluate_inside(&self, point: &[f64]) -> anyhow::Result<f64> {
        super::super::ensure_wanted(self.stop)?;
        let values = self.target.values_at(point)?;
        let known = self.lock_state().figures_of(&values);
        let figures = match known {
            Some(figures) => figures,
            None => {
                let relief = self.target.relief_of(&values)?;
                let heights = relief.height_field(FACETS);
                if !self.target.is_printable(&relief, &heights) {
                    let [low, high] = heights.extent_mm().map(f64::from);
                    return Ok(UNPRINTABLE + high - low);
                }
                let figures = self.simulation.compute_figures(&heights, relief.material())?;
                self.lock_state().add_candidate(DesignCandidate { values: values.clone(), bands: figures.bands })?
            }
        };
        let misfit = self.target.figures_misfit(&figures);
        let mut state = self.lock_state();
        let is_better = |(best, of): &(f64, Vec<String>)| misfit < *best || (misfit == *best && values < *of);
        if state.best.as_ref().is_none_or(is_better) {
            state.best = Some((misfit, values));
        }
        Ok(misfit)
    }
}

impl SearchState {
    // Corrected.
    fn figures_of(&self, values: &[String]) -> Option<Vec<BandFigures>> {
        let mut bands = self.candidates[*self.by_values.get(values)?].bands.clone();
        add_figures(&mut bands, &self.corrections);
        Some(bands)
    }

    // Another thread may have tried the same values meanwhile. Returns the corrected figures.
    fn add_candidate(&mut self, candidate: DesignCandidate) -> anyhow::Result<Vec<BandFigures>> {
        let mut bands = candidate.bands.clone();
        add_figures(&mut bands, &self.corrections);
        if !self.by_values.contains_key(&candidate.values) {
            let line = candidate_line(self.candidates.len() + 1, &candidate);
            self.file.write_all(line.as_bytes()).context("cannot write candidates.csv")?;
            self.by_values.insert(candidate.values.clone(), self.candidates.len());
            self.candidates.push(candidate);
        }
        Ok(bands)
    }
}

fn add_figures(bands: &mut [BandFigures], corrections: &[BandFigures]) {
    for (band, correction) in bands.iter_mut().zip(corrections) {
        band.level_db += correction.level_db;
        band.spread_db += correction.spread_db;
        band.scattering.value += correction.scattering.value;
    }
}

/// Returns the first candidates that differ from each other, in their order and at most so many.
pub(super) fn differing_candidates<'a>(
    target: &DesignTarget,
    candidates: &'a [DesignCandidate],
    most: usize,
) -> Vec<&'a DesignCandidate> {
    let mut chosen: Vec<&DesignCandidate> = Vec::new();
    for candidate in candidates {
        if chosen.len() == most {
            break;
        }
        if chosen.iter().all(|other| target.panel_distance(&other.values, &candidate.values) >= LEAST_DISTANCE) {
            chosen.push(candidate);
        }
    }
    chosen
}

/// Reads the candidates of a folder; none if it has no search.
pub(super) fn read_candidates(
    path: &Path,
    target: &DesignTarget,
    bands: &[String],
) -> anyhow::Result<Vec<DesignCandidate>> {
    let text = match std::fs::read_to_string(path) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        text => text.with_context(|| format!("cannot read `{}`", path.display()))?,
    };
    let parsed = parse_candidates(&text, &candidate_header(target, bands), target, bands.len());
    parsed.with_context(|| format!("candidates `{}`", path.display()))
}

/// Returns the names of the columns of the file of candidates.
pub(super) fn candidate_header(target: &DesignTarget, bands: &[String]) -> String {
    let parameters = target.ranges.iter().map(|(key, _)| key.clone());
    let figures =
        bands.iter().flat_map(|band| ["level_db", "spread_db", "scattering"].map(|name| format!("{name}_{band}")));
    let columns = ["candidate".to_owned()].into_iter().chain(parameters).chain(figures);
    columns.chain(["origin".to_owned()]).collect::<Vec<_>>().join(",")
}

// The shortest numbers that are read back exactly.
fn candidate_line(number: usize, candidate: &DesignCandidate) -> String {
    let figures = candidate
        .bands
        .iter()
        .flat_map(|band| [band.level_db, band.spread_db, band.scattering.value])
        .map(|x| x.to_string());
    let fields = [number.to_string()].into_iter().chain(candidate.values.clone()).chain(figures);
    fields.chain(["simulated".to_owned()]).collect::<Vec<_>>().join(",") + "\n"
}

// Whole lines alone.
fn parse_candidates(
    text: &str,
    header: &str,
    target: &DesignTarget,
    bands: usize,
) -> anyhow::Result<Vec<DesignCandidate>> {
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    let mut lines = whole.lines();
    if lines.next().is_some_and(|first| first != header) {
        bail!("its columns are another search's, expected {header}; hint: another folder");
    }
    let parameters = target.ranges.len();
    let parse = |(line, number): (&str, usize)| {
        let fields: Vec<&str> = line.split(',').collect();
        let expected = parameters + COLUMNS_PER_BAND * bands + 2;
        ensure!(fields.len() == expected, "line {number} has {} fields, expected {expected}", fields.len());
        let values: Vec<String> = fields[1..=parameters].iter().map(|value| (*value).to_owned()).collect();
        target.relief_of(&values).with_context(|| format!("line {number}"))?;
        let numbers = fields[parameters + 1..expected - 1].iter().map(|field| field.parse::<f64>());
        let numbers: Vec<f64> = numbers
            .collect::<Result<_, _>>()
            .with_context(|| format!("line {number} has a field that is no number"))?;
        let figures = |of: &[f64]| BandFigures {
            level_db: of[0],
            spread_db: of[1],
            scattering: UncertainNumber { value: of[2], uncertainty: None },
        };
        let bands: Vec<BandFigures> = numbers.chunks(COLUMNS_PER_BAND).map(figures).collect();
        Ok(DesignCandidate { values, bands })
    };
    lines.zip(2..).map(parse).collect()
}
