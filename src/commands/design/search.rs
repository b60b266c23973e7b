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
use echolake_acquisition::disk::read_text_file;
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
/// Column of the digest of a search's inputs in the file of candidates.
const INPUTS: &str = "inputs";
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
    file: CandidateFile,
    progress: TaskProgress,
    evaluations: usize,
    /// The best of these evaluations, and its misfit.
    best: Option<(f64, Vec<String>)>,
    /// The first error; the search ends with it.
    failed: Option<anyhow::Error>,
}

impl<'a> DesignSearch<'a> {
    /// Continues a search behind the candidates of its file.
    pub fn from_candidates(
        file: CandidateFile,
        candidates: Vec<DesignCandidate>,
        target: &'a DesignTarget,
        simulation: &'a DesignSimulation,
        stop: &'a StopRequest,
        mut progress: TaskProgress,
    ) -> Self {
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
        Self { target, simulation, stop, state: Mutex::new(state) }
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
                ensure!(
                    self.target.figures_misfit(&figures.bands).is_finite(),
                    "the simulation has no level, spread or scattering of a band for {}; hint: more `pairs`",
                    values.join(", ")
                );
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
            self.file.append_candidate(self.candidates.len() + 1, &candidate)?;
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

/// The columns of a search's file of candidates, and the digest of its inputs, which each line has: a file may have
/// been copied, or written by two searches.
pub(super) struct CandidateColumns {
    header: String,
    inputs: String,
    bands: usize,
}

/// The file of candidates, which is locked.
pub(super) struct CandidateFile {
    file: File,
    /// The digest of each line; None in a file of an earlier version.
    inputs: Option<String>,
}

impl CandidateColumns {
    /// Returns the columns of a search for `target` with such inputs.
    pub fn new(target: &DesignTarget, bands: &[String], inputs: &str) -> Self {
        let parameters = target.ranges.iter().map(|(key, _)| key.clone());
        let figures =
            bands.iter().flat_map(|band| ["level_db", "spread_db", "scattering"].map(|name| format!("{name}_{band}")));
        let columns = ["candidate".to_owned()].into_iter().chain(parameters).chain(figures);
        let header = columns.chain(["origin".to_owned()]).collect::<Vec<_>>().join(",");
        Self { header, inputs: digest_inputs(inputs), bands: bands.len() }
    }

    /// Opens the file for this search alone.
    ///
    /// # Errors
    /// If another search has it.
    pub fn lock_file(&self, path: &Path) -> anyhow::Result<CandidateFile> {
        let failed = || format!("cannot write `{}`", path.display());
        let mut file = File::options().append(true).read(true).create(true).open(path).with_context(failed)?;
        ensure!(file.metadata().with_context(failed)?.is_file(), "{}: it is no plain file", failed());
        file.try_lock().with_context(|| format!("another search writes `{}`", path.display()))?;
        // A line that was cut off is written again.
        let mut text = Vec::new();
        file.read_to_end(&mut text).with_context(failed)?;
        let whole = text.iter().rposition(|byte| *byte == b'\n').map_or(0, |end| end + 1);
        file.set_len(whole as u64).with_context(failed)?;
        if whole == 0 {
            file.write_all(format!("{},{INPUTS}\n", self.header).as_bytes()).with_context(failed)?;
        }
        let is_earlier = text[..whole].starts_with(format!("{}\n", self.header).as_bytes());
        Ok(CandidateFile { file, inputs: (!is_earlier).then(|| self.inputs.clone()) })
    }

    /// Reads the candidates of a file; none if it is not there.
    ///
    /// # Errors
    /// If a line is of another search, or has no numbers.
    pub fn read_candidates(&self, path: &Path, target: &DesignTarget) -> anyhow::Result<Vec<DesignCandidate>> {
        let text = match read_text_file(path) {
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
            text => text.with_context(|| format!("cannot read `{}`", path.display()))?,
        };
        self.parse_candidates(&text, target).with_context(|| format!("candidates `{}`", path.display()))
    }

    // Whole lines alone.
    fn parse_candidates(&self, text: &str, target: &DesignTarget) -> anyhow::Result<Vec<DesignCandidate>> {
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        let mut lines = whole.lines();
        let Some(first) = lines.next() else { return Ok(Vec::new()) };
        let has_inputs = first.strip_prefix(&self.header).map(|more| more.strip_prefix(',') == Some(INPUTS));
        let Some(has_inputs) = has_inputs.filter(|has_inputs| *has_inputs || first == self.header) else {
            bail!("its columns are another search's, expected {}; hint: another folder for -o", self.header);
        };
        lines.zip(2..).map(|(line, number)| self.parse_line(line, number, has_inputs, target)).collect()
    }

    fn parse_line(
        &self,
        line: &str,
        number: usize,
        has_inputs: bool,
        target: &DesignTarget,
    ) -> anyhow::Result<DesignCandidate> {
        let fields: Vec<&str> = line.split(',').collect();
        let parameters = target.ranges.len();
        let figures = 1 + parameters..1 + parameters + COLUMNS_PER_BAND * self.bands;
        let expected = figures.end + 1 + usize::from(has_inputs);
        ensure!(fields.len() == expected, "line {number} has {} fields, expected {expected}", fields.len());
        if let Some(inputs) = fields.get(figures.end + 1) {
            ensure!(
                *inputs == self.inputs,
                "line {number} is of another target, levels or rig: its {INPUTS} are {inputs}, expected {}; hint: \
                 another folder for -o",
                self.inputs
            );
        }
        let values: Vec<String> = fields[1..=parameters].iter().map(|value| (*value).to_owned()).collect();
        target.relief_of(&values).with_context(|| format!("line {number}"))?;
        let figure = |at: usize| {
            // A band whose octave the sweep does not have has no scattering.
            if fields[at].is_empty() && (at - parameters).is_multiple_of(COLUMNS_PER_BAND) {
                return Ok(f64::NAN);
            }
            let value = fields[at].parse::<f64>().ok().filter(|value| value.is_finite());
            value.with_context(|| {
                let column = self.header.split(',').nth(at).unwrap_or_default();
                format!("line {number}: `{column}` is {}, expected a number; hint: remove the line", fields[at])
            })
        };
        let numbers = figures.map(figure).collect::<anyhow::Result<Vec<f64>>>()?;
        let band = |of: &[f64]| BandFigures {
            level_db: of[0],
            spread_db: of[1],
            scattering: UncertainNumber { value: of[2], uncertainty: None },
        };
        Ok(DesignCandidate { values, bands: numbers.chunks(COLUMNS_PER_BAND).map(band).collect() })
    }
}

impl CandidateFile {
    // The shortest numbers that are read back exactly.
    fn append_candidate(&mut self, number: usize, candidate: &DesignCandidate) -> anyhow::Result<()> {
        ensure!(
            candidate.bands.iter().all(|band| band.level_db.is_finite() && band.spread_db.is_finite()),
            "the simulation has no level or spread of a band for {}; hint: more `pairs`",
            candidate.values.join(", ")
        );
        let figures = candidate.bands.iter().flat_map(|band| [band.level_db, band.spread_db, band.scattering.value]);
        let texts = figures.map(|figure| if figure.is_nan() { String::new() } else { figure.to_string() });
        let fields = [number.to_string()].into_iter().chain(candidate.values.clone());
        let fields = fields.chain(texts).chain(["simulated".to_owned()]);
        let line = fields.chain(self.inputs.clone()).collect::<Vec<_>>().join(",") + "\n";
        self.file.write_all(line.as_bytes()).context("cannot write candidates.csv")
    }
}

// FNV-1a: the same in every version of the program, and no secret.
fn digest_inputs(inputs: &str) -> String {
    let mix = |hash: u64, byte: u8| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
    format!("{:016x}", inputs.bytes().fold(0xcbf2_9ce4_8422_2325, mix))
}

#[cfg(test)]
mod tests {
    use super::*;

    const WAVES: &str =
        "relief = \"macrostructure\"\n[ranges]\nmacro_depth_mm = [20, 100]\n[bands.2500]\nlevel_db = 1\n";

    fn columns_of(inputs: &str) -> (CandidateColumns, DesignTarget) {
        let bands = ["2500".to_owned()];
        let target = DesignTarget::from_toml(WAVES, &bands).expect("a target");
        (CandidateColumns::new(&target, &bands, inputs), target)
    }

    fn candidate(depth_mm: &str) -> DesignCandidate {
        let scattering = UncertainNumber { value: 0.5, uncertainty: None };
        DesignCandidate {
            values: vec![depth_mm.to_owned()],
            bands: vec![BandFigures { level_db: -1.5, spread_db: 0.25, scattering }],
        }
    }

    // E32: a search of other inputs neither has the folder meanwhile, nor goes on with its candidates later.
    #[test]
    fn candidates_of_another_search_are_refused_by_line() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("candidates.csv");
        let (own, target) = columns_of("fixed = 1");
        let (other, _) = columns_of("fixed = 2");
        let mut file = own.lock_file(&path).expect("a file");
        file.append_candidate(1, &candidate("20")).expect("written");
        let refused = format!("{:#}", other.lock_file(&path).err().expect("it is locked"));
        assert!(refused.contains("another search writes"), "{refused}");
        drop(file);
        let mut file = other.lock_file(&path).expect("unlocked");
        file.append_candidate(2, &candidate("30")).expect("written");
        let refused = format!("{:#}", own.read_candidates(&path, &target).expect_err("of two searches"));
        assert!(
            refused.contains("line 3 is of another target, levels or rig") && refused.contains("hint: another folder"),
            "{refused}"
        );
        let refused = format!("{:#}", other.read_candidates(&path, &target).expect_err("of two searches"));
        assert!(refused.contains("line 2 is of another target, levels or rig"), "{refused}");
    }

    // E32: NaN fitted no target, so another panel won.
    #[test]
    fn numbers_that_are_none_are_refused_by_line_and_column() {
        let (columns, target) = columns_of("inputs");
        let line =
            |level: &str| format!("{},{INPUTS}\n1,20,{level},0.25,0.5,simulated,{}\n", columns.header, columns.inputs);
        let read = columns.parse_candidates(&line("-1.5"), &target).expect("a candidate");
        assert_eq!((read[0].values.as_slice(), read[0].bands[0].level_db), (&["20".to_owned()][..], -1.5));
        for wrong in ["NaN", "inf", "1e999", "", "x"] {
            let refused = format!("{:#}", columns.parse_candidates(&line(wrong), &target).expect_err("no number"));
            assert!(refused.contains(&format!("line 2: `level_db_2500` is {wrong}, expected a number")), "{refused}");
        }
        let folder = tempfile::tempdir().expect("a folder");
        let mut file = columns.lock_file(&folder.path().join("candidates.csv")).expect("a file");
        let mut worn = candidate("20");
        worn.bands[0].spread_db = f64::NAN;
        assert!(file.append_candidate(1, &worn).is_err());
    }

    #[test]
    fn a_file_of_candidates_that_never_ends_is_refused() {
        let (columns, target) = columns_of("inputs");
        let device = Path::new("/dev/zero");
        let refused = format!("{:#}", columns.read_candidates(device, &target).expect_err("endless"));
        assert!(refused.contains("does not end within"), "{refused}");
        let refused = format!("{:#}", columns.lock_file(device).err().expect("no file"));
        assert!(refused.contains("`/dev/zero`: it is no plain file"), "{refused}");
    }

    // Files of 0.1.0 have no inputs in their lines.
    #[test]
    fn a_search_of_an_earlier_version_goes_on_in_its_columns() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("candidates.csv");
        let (columns, target) = columns_of("inputs");
        std::fs::write(&path, format!("{}\n1,20,-1.5,0.25,0.5,simulated\n2,3", columns.header)).expect("written");
        columns.lock_file(&path).expect("a file").append_candidate(2, &candidate("30")).expect("written");
        let read = columns.read_candidates(&path, &target).expect("candidates");
        assert_eq!(read.iter().map(|candidate| candidate.values[0].as_str()).collect::<Vec<_>>(), ["20", "30"]);
        let text = std::fs::read_to_string(&path).expect("text");
        assert!(text.lines().skip(1).all(|line| line.ends_with(",simulated")), "{text}");
    }
}
