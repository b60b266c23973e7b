//! The file of a design: a relief, ranges of its parameters, and what is wanted of it by band.

use std::collections::BTreeMap;
use std::f64::consts::FRAC_1_SQRT_2;
use std::path::Path;

use anyhow::{Context as _, bail, ensure};
use echolake_acquisition::design::{BandFigures, PanelFigures};
use echolake_acquisition::disk::read_text_file;
use echolake_panel::relief::group::ParameterRange;
use echolake_panel::relief::{HeightField, PanelRelief, ParameterDomain, ReliefParameter};
use echolake_schema::SurfaceId;
use serde::{Deserialize, Serialize};

/// Deviations that count as much as one of a level by 1 dB.
const SPREAD_UNIT_DB: f64 = 1.0;
const SCATTERING_UNIT: f64 = 0.1;
/// Targets and weights are no larger.
const MOST_DB: f64 = 200.0;
const MOST_WEIGHT: f64 = 1e6;
/// Distance of one seed from the next, in ranges: what one makes tells nothing of another.
const FAR_APART: f64 = 10.0;

/// A target, as its TOML file has it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct TargetFile {
    #[serde(default)]
    about: String,
    relief: String,
    /// The surface whose levels over Flat are wanted in every band that `bands` give no level for.
    levels_of: Option<SurfaceId>,
    #[serde(default = "default_pairs")]
    pairs: usize,
    #[serde(default = "default_candidates")]
    candidates: usize,
    #[serde(default = "default_best")]
    best: usize,
    #[serde(default = "default_seed")]
    seed: u64,
    /// Greatest depth of the printed panel, mm.
    greatest_depth_mm: Option<f64>,
    #[serde(default)]
    fixed: BTreeMap<String, toml::Value>,
    ranges: BTreeMap<String, ParameterRange>,
    #[serde(default)]
    bands: BTreeMap<String, BandTarget>,
}

/// The wanted figures of one band.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct BandTarget {
    level_db: Option<f64>,
    spread_db: Option<f64>,
    scattering: Option<f64>,
    #[serde(default = "default_weight")]
    weight: f64,
}

/// A figure of a panel in a band.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub(super) enum FigureKind {
    Level,
    Spread,
    Scattering,
}

/// A wanted figure.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct DesignGoal {
    pub band: usize,
    pub kind: FigureKind,
    pub value: f64,
    pub weight: f64,
}

/// A target that has been checked.
#[derive(Debug)]
pub(super) struct DesignTarget {
    pub about: String,
    pub levels_of: Option<SurfaceId>,
    pub pairs: usize,
    pub candidates: usize,
    pub best: usize,
    pub seed: u64,
    pub goals: Vec<DesignGoal>,
    /// Of each band, for the levels of a surface.
    weights: Vec<f64>,
    /// Names and ranges of the parameters that are searched.
    pub ranges: Vec<(String, ParameterRange)>,
    greatest_depth_mm: f64,
    start: PanelRelief,
    known: Vec<ReliefParameter>,
}

fn default_pairs() -> usize {
    120
}

fn default_candidates() -> usize {
    400
}

fn default_best() -> usize {
    3
}

fn default_seed() -> u64 {
    1
}

fn default_weight() -> f64 {
    1.0
}

impl DesignTarget {
    /// Parses a target and checks it against the names of the rig's bands.
    pub fn from_toml(text: &str, bands: &[String]) -> anyhow::Result<Self> {
        let file: TargetFile = toml::from_str(text).map_err(|e| {
            anyhow::anyhow!("{e}hint: relief = \"NAME\", [ranges] with key = [low, high], [bands.2500] with level_db")
        })?;
        for (key, number, most) in
            [("pairs", file.pairs, 100_000), ("candidates", file.candidates, 100_000), ("best", file.best, 20)]
        {
            ensure!((1..=most).contains(&number), "`{key}` is {number}, expected 1 to {most}");
        }
        ensure!(
            !file.ranges.is_empty(),
            "`ranges` is empty, expected a parameter; hint: echolake panel {0} --list",
            file.relief
        );
        let depth_mm = file.greatest_depth_mm.unwrap_or(f64::INFINITY);
        ensure!(depth_mm > 0.0, "`greatest_depth_mm` is {depth_mm}, expected above 0");
        let mut start = PanelRelief::by_name(&file.relief)?;
        for (key, value) in &file.fixed {
            ensure!(!file.ranges.contains_key(key), "`{key}` is in [fixed] and in [ranges]; hint: one of them");
            start.set_parameter(key, value.as_str().unwrap_or(&value.to_string()))?;
        }
        let goals = read_goals(&file, bands)?;
        let known = start.describe_parameters();
        for parameter in &known {
            let is_choice = matches!(parameter.domain, ParameterDomain::Choice { .. });
            if let (true, Some(ParameterRange::Numbers(_))) = (is_choice, file.ranges.get(parameter.key)) {
                bail!(
                    "range of `{0}` is of numbers, expected words; hint: {0} = [\"{1}\"]",
                    parameter.key,
                    parameter.domain
                );
            }
        }
        let weights = bands.iter().map(|band| file.bands.get(band).map_or(1.0, |target| target.weight)).collect();
        let target = Self {
            about: file.about,
            levels_of: file.levels_of,
            pairs: file.pairs,
            candidates: file.candidates,
            best: file.best,
            seed: file.seed,
            goals,
            weights,
            ranges: file.ranges.into_iter().collect(),
            greatest_depth_mm: depth_mm,
            start,
            known,
        };
        // Every word is tried by itself, and five of the numbers.
        for (number, (_, range)) in target.ranges.iter().enumerate() {
            let tried = match range {
                ParameterRange::Words(words) => words.len().max(2),
                ParameterRange::Numbers(_) => 5,
            };
            for step in 0..tried {
                let mut shares = vec![0.5; target.ranges.len()];
                shares[number] = step as f64 / (tried - 1) as f64;
                target.relief_of(&target.values_at(&shares)?)?;
            }
        }
        Ok(target)
    }

    /// Adds the levels of the measured surface that the file names, by band.
    pub fn add_levels(&mut self, levels_db: &[Option<f64>]) {
        for (band, level) in levels_db.iter().enumerate() {
            let is_given = self.goals.iter().any(|goal| goal.band == band && goal.kind == FigureKind::Level);
            if let Some(value) = level.filter(|_| !is_given) {
                self.goals.push(DesignGoal { band, kind: FigureKind::Level, value, weight: self.weights[band] });
            }
        }
        self.goals.sort_by_key(|goal| goal.band);
    }

    /// Returns the parameters' values at shares of their ranges, 0 to 1.
    pub fn values_at(&self, shares: &[f64]) -> anyhow::Result<Vec<String>> {
        let pairs = self.ranges.iter().zip(shares);
        let values = pairs.map(|((key, range), share)| range.value_at_share(key, &self.known, share.clamp(0.0, 1.0)));
        Ok(values.collect::<Result<_, _>>()?)
    }

    /// Returns the shares of their ranges at which some values are.
    pub fn shares_of(&self, values: &[String]) -> Vec<f64> {
        let share = |((_, range), value): (&(String, ParameterRange), &String)| match range {
            ParameterRange::Numbers([low, high]) => {
                value.parse().map_or(0.5, |value: f64| (value - low) / (high - low))
            }
            ParameterRange::Words(words) => {
                let place = words.iter().position(|word| word == value).unwrap_or(0);
                (place as f64 + 0.5) / words.len() as f64
            }
        };
        self.ranges.iter().zip(values).map(share).collect()
    }

    /// Returns coordinates of some values, as far from each other as the shares of their ranges; words are all 1 apart.
    pub fn coordinates_of(&self, values: &[String]) -> Vec<f64> {
        let shares = self.shares_of(values);
        let of_range = |((key, range), share): (&(String, ParameterRange), f64)| match range {
            // A seed is a name, not a quantity.
            ParameterRange::Numbers(_) if key != "seed" => vec![share],
            ParameterRange::Numbers([low, high]) => vec![share * (high - low) * FAR_APART],
            ParameterRange::Words(words) => {
                let place = (share * words.len() as f64) as usize;
                (0..words.len()).map(|word| if word == place { FRAC_1_SQRT_2 } else { 0.0 }).collect()
            }
        };
        self.ranges.iter().zip(shares).flat_map(of_range).collect()
    }

    /// Returns how far two panels are from each other: the greatest share of a range, 1 for other words.
    pub fn panel_distance(&self, values: &[String], others: &[String]) -> f64 {
        let shares = [values, others].map(|values| self.shares_of(values));
        let parts = self.ranges.iter().zip(shares[0].iter().zip(&shares[1]));
        let parts = parts.map(|((_, range), (share, other))| match range {
            ParameterRange::Words(_) => f64::from(u8::from(share != other)),
            ParameterRange::Numbers(_) => (share - other).abs(),
        });
        parts.fold(0.0, f64::max)
    }

    /// Makes the relief of some values; they may be too deep together.
    pub fn relief_of(&self, values: &[String]) -> anyhow::Result<PanelRelief> {
        let mut relief = self.start.clone();
        for ((key, _), value) in self.ranges.iter().zip(values) {
            relief.set_parameter(key, value)?;
        }
        Ok(relief)
    }

    /// Returns whether a relief can be printed: a panel has room for it, and it is no deeper than the file says.
    pub fn is_printable(&self, relief: &PanelRelief, heights: &HeightField) -> bool {
        let [low, high] = heights.extent_mm().map(f64::from);
        relief.check_depth().is_ok() && high - low <= self.greatest_depth_mm
    }

    /// Returns whether the file limits the depth.
    pub fn limits_depth(&self) -> bool {
        self.greatest_depth_mm.is_finite()
    }

    /// Returns the coordinates of a surface in the ranges; None if it is another relief, not within them, or differs in
    /// what is fixed. Of reliefs that are drawn by chance, the seed tells nothing.
    pub fn place_of(&self, relief: &str, parameters: &str) -> Option<Vec<f64>> {
        let parameters: serde_json::Map<String, serde_json::Value> = serde_json::from_str(parameters).ok()?;
        let is_searched = |key: &String| self.ranges.iter().any(|(searched, _)| searched == key);
        let same = |(key, value): (String, serde_json::Value)| {
            key == "seed" || is_searched(&key) || parameters.get(&key) == Some(&value)
        };
        if relief != self.start.name() || !self.start.parameters().into_iter().all(same) {
            return None;
        }
        let text = |value: &serde_json::Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        let values = self.ranges.iter().map(|(key, _)| parameters.get(key).map(text));
        let values = values.collect::<Option<Vec<_>>>()?;
        let is_within = self.ranges.iter().zip(&values).all(|((_, range), value)| match range {
            ParameterRange::Words(words) => words.contains(value),
            ParameterRange::Numbers([low, high]) => value.parse().is_ok_and(|value| (low..=high).contains(&&value)),
        });
        is_within.then(|| self.coordinates_of(&values))
    }

    /// Returns how far figures are from the target: weighted root mean square of the deviations, 1 dB of a level each.
    pub fn figures_misfit(&self, bands: &[BandFigures]) -> f64 {
        let weights: f64 = self.goals.iter().map(|goal| goal.weight).sum();
        let sum: f64 = self.goals.iter().map(|goal| goal.weight * goal.figure_deviation(bands).powi(2)).sum();
        (sum / weights).sqrt()
    }

    /// Returns the root mean square of the levels' deviations over bands that `is_counted`, dB; None if there is none.
    pub fn level_misfit_db(&self, figures: &PanelFigures, is_counted: impl Fn(usize) -> bool) -> Option<f64> {
        let levels = self.goals.iter().filter(|goal| goal.kind == FigureKind::Level && is_counted(goal.band));
        let squares: Vec<f64> = levels.map(|goal| goal.figure_deviation(&figures.bands).powi(2)).collect();
        (!squares.is_empty()).then(|| (squares.iter().sum::<f64>() / squares.len() as f64).sqrt())
    }
}

fn read_goals(file: &TargetFile, bands: &[String]) -> anyhow::Result<Vec<DesignGoal>> {
    let mut goals = Vec::new();
    for (name, target) in &file.bands {
        let Some(band) = bands.iter().position(|band| band == name) else {
            bail!("there is no band `{name}`; hint: {}", bands.join(", "));
        };
        let BandTarget { level_db, spread_db, scattering, weight } = *target;
        ensure!(weight > 0.0 && weight <= MOST_WEIGHT, "`weight` of band `{name}` is {weight}, expected above 0");
        let is_wanted = level_db.or(spread_db).or(scattering).is_some() || file.levels_of.is_some();
        ensure!(is_wanted, "band `{name}` has no target; hint: level_db, spread_db, scattering, or levels_of");
        let is_share = scattering.is_none_or(|share| (0.0..=1.0).contains(&share));
        ensure!(is_share, "`scattering` of band `{name}` is not from 0 to 1");
        let is_spread = spread_db.is_none_or(|spread| spread >= 0.0);
        ensure!(is_spread, "`spread_db` of band `{name}` is not 0 or more");
        let wanted =
            [(FigureKind::Level, level_db), (FigureKind::Spread, spread_db), (FigureKind::Scattering, scattering)];
        for (kind, value) in wanted {
            let Some(value) = value else { continue };
            ensure!(value.abs() <= MOST_DB, "band `{name}` has the target {value}, expected a number up to {MOST_DB}");
            goals.push(DesignGoal { band, kind, value, weight });
        }
    }
    ensure!(
        !goals.is_empty() || file.levels_of.is_some(),
        "there is no target; hint: [bands.{}] with level_db, spread_db or scattering, or levels_of = \"SURFACE\"",
        bands.first().map_or("2500", String::as_str)
    );
    goals.sort_by_key(|goal| goal.band);
    Ok(goals)
}

impl DesignGoal {
    /// Returns its figure of a panel.
    pub fn figure_of(&self, bands: &[BandFigures]) -> f64 {
        let figures = &bands[self.band];
        match self.kind {
            FigureKind::Level => figures.level_db,
            FigureKind::Spread => figures.spread_db,
            FigureKind::Scattering => figures.scattering.value,
        }
    }

    /// Returns the deviation of a panel, in units that count as much as 1 dB of a level.
    pub fn figure_deviation(&self, bands: &[BandFigures]) -> f64 {
        let unit = match self.kind {
            FigureKind::Level => 1.0,
            FigureKind::Spread => SPREAD_UNIT_DB,
            FigureKind::Scattering => SCATTERING_UNIT,
        };
        (self.figure_of(bands) - self.value) / unit
    }

    /// Returns its name, for a table or an axis.
    pub fn describe_goal(&self, bands: &[String]) -> String {
        let band = &bands[self.band];
        match self.kind {
            FigureKind::Level => format!("level over Flat, {band} Hz, dB"),
            FigureKind::Spread => format!("spread, {band} Hz, dB"),
            FigureKind::Scattering => format!("scattering, {band} Hz"),
        }
    }
}

/// Reads a target's text.
pub(super) fn read_target(path: &Path) -> anyhow::Result<String> {
    read_text_file(path).with_context(|| format!("cannot read target `{}`", path.display()))
}

#[cfg(test)]
mod tests {
    use echolake_dsp::scattering::UncertainNumber;

    use super::*;

    fn parse(text: &str) -> anyhow::Result<DesignTarget> {
        DesignTarget::from_toml(text, &["2500", "5000"].map(str::to_owned))
    }

    const WAVES: &str = "relief = \"macrostructure\"\n[ranges]\nmacro_depth_mm = [20, 100]\n";

    #[test]
    fn misfit_weighs_deviations() {
        let text = format!("{WAVES}[bands.2500]\nlevel_db = -1\n[bands.5000]\nscattering = 0.5\nweight = 3\n");
        let target = parse(&text).expect("a target");
        let figures = |level_db, scattering| BandFigures {
            level_db,
            spread_db: 0.0,
            scattering: UncertainNumber { value: scattering, uncertainty: None },
        };
        assert_eq!(target.figures_misfit(&[figures(-1.0, 0.0), figures(9.0, 0.5)]), 0.0);
        // 2 dB once, and 0.1 thrice.
        let misfit = target.figures_misfit(&[figures(1.0, 0.0), figures(0.0, 0.6)]);
        assert!((misfit - (7.0f64 / 4.0).sqrt()).abs() < 1e-9, "{misfit}");
        assert_eq!(target.values_at(&[0.5]).expect("values"), ["60"]);
        assert_eq!(target.values_at(&[7.0]).expect("values"), ["100"]);
    }

    #[test]
    fn examples_are_right() {
        let bands = echolake_schema::Rig::paper().band_names();
        let files = std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/designs")).expect("a folder");
        let texts = files.map(|file| std::fs::read_to_string(file.expect("a file").path()).expect("text"));
        let targets: Vec<_> = texts.map(|text| DesignTarget::from_toml(&text, &bands).expect("a target")).collect();
        assert_eq!(targets.len(), 3);
    }

    #[test]
    fn wrong_targets_are_refused_by_what_is_wrong() {
        let with_band = |band: &str| format!("{WAVES}{band}");
        for (text, expected) in [
            ("relief = \"macrostructure\"\n[ranges]\n[bands.2500]\nlevel_db = 1\n".to_owned(), "`ranges` is empty"),
            (with_band(""), "there is no target"),
            (with_band("[bands.2501]\nlevel_db = 1\n"), "there is no band `2501`"),
            (with_band("[bands.2500]\nlevel_db = nan\n"), "expected a number"),
            (with_band("[bands.2500]\nscattering = 2\n"), "not from 0 to 1"),
            (with_band("[bands.2500]\nlevel_db = 1\nweight = 0\n"), "`weight` of band `2500`"),
            (with_band("[bands.2500]\nlevel = 1\n"), "unknown field"),
            (with_band("[bands.2500]\nweight = 2\n"), "band `2500` has no target"),
            (with_band("macrostructure = [1, 2]\n[bands.2500]\nlevel_db = 1\n"), "`macrostructure` is of numbers"),
            ("relief = \"prd\"\n[ranges]\nprime = [31, 157]\n[bands.2500]\nlevel_db = 1\n".to_owned(), "prime"),
            (with_band("[bands.2500]\nlevel_db = 1\n").replace("100", "1e6"), "macro_depth_mm"),
            (with_band("[bands.2500]\nlevel_db = 1\n").replace("macro_depth", "makro"), "makro"),
            (format!("candidates = 0\n{}", with_band("[bands.2500]\nlevel_db = 1\n")), "`candidates` is 0"),
        ] {
            let refused = format!("{:#}", parse(&text).expect_err("wrong"));
            assert!(refused.contains(expected), "{refused}");
        }
    }
}
