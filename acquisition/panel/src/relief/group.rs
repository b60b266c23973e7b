//! Groups of panels: ranges of parameters that are sampled in steps, and the next group's steps from the spread of the
//! last one's results (Rust et al. 2021, section "Computational generation of diffusive surface structures").
//!
//! Ranges stay as they are. The first steps are random. Results that are alike make the next steps larger; results
//! that lie far apart make them smaller, because something between them was missed. Each group begins where the last
//! one ended, and again at the low end behind the high one, so that no part of a range stays unexplored. One group is
//! made, printed and measured before the next is chosen.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use super::chance::SeededRandom;
use super::parameter::round_in_range;
use super::{Error as ReliefError, PanelRelief, ParameterDomain, ReliefParameter};

/// Ranges that a group is drawn from; `ranges.toml`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GroupRanges {
    /// The relief.
    pub relief: String,
    /// Seed of the draw.
    #[serde(default)]
    pub seed: u64,
    /// Wanted spread of a group's results, dB: standard deviation over surfaces, mean over bands.
    #[serde(default = "default_target")]
    pub target_spread_db: f64,
    /// Parameters with one value for the whole group.
    #[serde(default)]
    pub fixed: BTreeMap<String, toml::Value>,
    /// Parameters that vary: `[low, high]`, or words, which are taken in turn.
    pub ranges: BTreeMap<String, ParameterRange>,
    /// Step of a parameter between values of a group; by default a random one, a sixteenth to a quarter of the range.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub steps: BTreeMap<String, f64>,
    /// Value of a parameter at which the steps begin; by default the low end of its range.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub begin: BTreeMap<String, f64>,
}

/// Range of one parameter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "data did not match any variant of untagged enum Range")]
pub enum ParameterRange {
    /// From, to.
    Numbers([f64; 2]),
    /// One of these.
    Words(Vec<String>),
}

/// One surface's result in one band.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct BandLevel {
    /// The surface.
    pub surface_id: String,
    /// The band.
    pub band: String,
    /// Its level over Flat, dB.
    #[serde(alias = "p90_mean_db")]
    pub level_db: f64,
}

/// Steps of the next group, with the reasons.
#[derive(Debug, Clone, PartialEq)]
pub struct GroupStep {
    /// The next group's.
    pub ranges: GroupRanges,
    /// Spread of the results, dB.
    pub spread_db: f64,
    /// Factor by which the steps became larger; below 1 smaller.
    pub factor: f64,
    /// One sentence for the step and one for each parameter.
    pub reasons: Vec<String>,
}

/// An error of making a group.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// The relief or one of its parameters is refused.
    #[error(transparent)]
    Relief(#[from] ReliefError),
    /// The file of ranges is not one.
    #[error("these are no ranges: {reason}; hint: relief = \"NAME\", then [ranges] with key = [low, high]")]
    Text {
        /// The fault.
        reason: String,
    },
    /// A range outside of the parameter's domain, or an empty one.
    #[error("range of `{key}` is {given}, expected {expected}; hint: low and high within it, low below high")]
    Range {
        /// The parameter.
        key: String,
        /// The given range.
        given: String,
        /// The parameter's domain.
        expected: String,
    },
    /// Results that give no spread.
    #[error("{actual} cannot say how alike a group is, expected {expected}; hint: {RESULTS_HINT}")]
    Results {
        /// The given results.
        actual: String,
        /// The expected results.
        expected: &'static str,
    },
}

/// Hint with the query for results.
const RESULTS_HINT: &str =
    "echolake sql --format csv \"select surface_id, band, p90_mean_db from surface_stats where surface_id like '...'\"";
/// Largest factor by which steps change; its inverse is the smallest.
const LARGEST_FACTOR: f64 = 2.0;
/// Random steps, as shares of the range.
const FIRST_STEPS: [f64; 2] = [1.0 / 16.0, 1.0 / 4.0];
/// Largest step, as a share of the range: beyond half of it, steps that begin again at the low end become smaller.
const LARGEST_STEP: f64 = 0.5;

fn default_target() -> f64 {
    1.5
}

impl GroupRanges {
    /// Parses ranges from TOML and checks them.
    ///
    /// # Errors
    /// [`Error`].
    pub fn from_toml(text: &str) -> Result<Self, Error> {
        let ranges: Self = toml::from_str(text).map_err(|e| Error::Text { reason: e.to_string() })?;
        if !(ranges.target_spread_db > 0.0 && ranges.target_spread_db.is_finite()) {
            return Err(Error::Text { reason: "target_spread_db must be above 0".to_owned() });
        }
        ranges.check_ranges()?;
        Ok(ranges)
    }

    // One draw tries the numbers; every word is tried by itself.
    fn check_ranges(&self) -> Result<(), Error> {
        let mut relief = self.draw_reliefs(1)?.swap_remove(0);
        for (key, range) in &self.ranges {
            if let ParameterRange::Words(words) = range {
                words.iter().try_for_each(|word| relief.set_parameter(key, word))?;
            }
        }
        for (key, step) in &self.steps {
            let [from, to] = self.range_of_numbers("steps", key)?;
            let most = LARGEST_STEP * (to - from);
            if !(*step > 0.0 && *step <= most) {
                let reason =
                    format!("`{key}` in [steps] is {step}, expected above 0, and {most} or less, half its range");
                return Err(Error::Text { reason });
            }
        }
        for (key, begin) in &self.begin {
            let [from, to] = self.range_of_numbers("begin", key)?;
            if !(from..=to).contains(begin) {
                return Err(Error::Text { reason: format!("`{key}` in [begin] is {begin}, expected {from} to {to}") });
            }
        }
        Ok(())
    }

    fn range_of_numbers(&self, table: &str, key: &str) -> Result<[f64; 2], Error> {
        match self.ranges.get(key) {
            Some(ParameterRange::Numbers(range)) => Ok(*range),
            _ => Err(Error::Text { reason: format!("[{table}] has `{key}`, which has no range of numbers") }),
        }
    }

    /// The file's text.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).unwrap_or_default()
    }

    /// `count` reliefs. Each parameter has `count` values, a step from each other, which begin again at the range's low
    /// end behind its high one; reliefs have them in any order. The same seed draws the same. If the seed of the wall
    /// is not given, each relief has its own.
    ///
    /// # Errors
    /// [`Error`], if a parameter is none of the relief's, or is refused.
    pub fn draw_reliefs(&self, count: usize) -> Result<Vec<PanelRelief>, Error> {
        let mut shared = PanelRelief::by_name(&self.relief)?;
        for (key, value) in &self.fixed {
            shared.set_parameter(key, value.as_str().unwrap_or(&value.to_string()))?;
        }
        let known = shared.describe_parameters();
        let mut drawn = vec![shared; count];
        let own_seed = |p: &&ReliefParameter| p.key == "seed" && !self.fixed.contains_key("seed");
        if let Some(seed) = known.iter().find(own_seed) {
            let chance = SeededRandom::new(self.seed, 0x5EED);
            for (n, relief) in drawn.iter_mut().enumerate() {
                relief.set_parameter(seed.key, &(chance.whole_number(n as u64) % 1_000_000).to_string())?;
            }
        }
        for (number, (key, range)) in self.ranges.iter().enumerate() {
            let chance = SeededRandom::new(self.seed, number as u64);
            let places = chance.random_order(count);
            let step = self.step_size(number, key, range);
            for (relief, place) in drawn.iter_mut().zip(places) {
                let along = self.place_in_range(key, range, place as f64 * step);
                relief.set_parameter(key, &range.value_at(key, &known, along, place)?)?;
            }
        }
        drawn.iter().try_for_each(PanelRelief::check_depth)?;
        Ok(drawn)
    }

    // The given step of the range of this number, or a random one.
    fn step_size(&self, number: usize, key: &str, range: &ParameterRange) -> f64 {
        let [least, most] = FIRST_STEPS.map(|share| share * range.width());
        let drawn =
            || least + (most - least) * SeededRandom::new(self.seed, number as u64).at_place(0, 2).unit_number(0);
        self.steps.get(key).copied().unwrap_or_else(drawn)
    }

    // How far over the low end of its range a parameter is that has gone this far.
    fn place_in_range(&self, key: &str, range: &ParameterRange, gone: f64) -> f64 {
        let ParameterRange::Numbers([from, _]) = range else { return 0.0 };
        let begin = self.begin.get(key).map_or(0.0, |begin| begin - from);
        (begin + gone).rem_euclid(range.width())
    }

    /// Computes the next group's steps from this one's results.
    ///
    /// # Errors
    /// [`Error::Results`] for fewer than two surfaces or levels that are no numbers, else as [`Self::draw_reliefs`].
    pub fn next_step(&self, results: &[BandLevel]) -> Result<GroupStep, Error> {
        let spread_db = level_spread(results)?;
        let factor = (self.target_spread_db / spread_db.max(1e-9)).clamp(1.0 / LARGEST_FACTOR, LARGEST_FACTOR);
        let surfaces: BTreeSet<_> = results.iter().map(|result| &result.surface_id).collect();
        let (judgement, change) = if factor > 1.0 { ("too alike", "larger") } else { ("far apart", "smaller") };
        let mut reasons = vec![format!(
            "The last group's results lie {spread_db:.2} dB apart, {:.2} dB are wanted: {judgement}, so steps become \
             {factor:.2} times as large ({change}).",
            self.target_spread_db
        )];
        let mut next = Self { seed: self.seed.wrapping_add(1), ..self.clone() };
        for (number, (key, range)) in self.ranges.iter().enumerate() {
            let ParameterRange::Numbers([from, to]) = range else {
                reasons.push(format!("{key}: words are taken in turn."));
                continue;
            };
            let width = range.width();
            let last = self.step_size(number, key, range);
            let most = LARGEST_STEP * width;
            let step = round_in_range(last * factor, width).clamp(most / 1e3, most);
            let gone = surfaces.len() as f64 * last;
            let begin = round_in_range(from + self.place_in_range(key, range, gone), width);
            let last = round_in_range(last, width);
            reasons.push(format!("{key}: steps of {last} become {step}, from {begin} on within {from} to {to}."));
            next.steps.insert(key.clone(), step);
            next.begin.insert(key.clone(), begin);
        }
        next.check_ranges()?;
        Ok(GroupStep { ranges: next, spread_db, factor, reasons })
    }
}

impl ParameterRange {
    /// Returns the width of a range of numbers, 0 for words.
    fn width(&self) -> f64 {
        match self {
            Self::Numbers([from, to]) => to - from,
            Self::Words(_) => 0.0,
        }
    }

    /// Returns the value at a share of the range, from 0 to 1: a rounded number, or one of the words.
    ///
    /// # Errors
    /// [`Error::Range`] if the range is empty, or not within the parameter's domain.
    pub fn value_at_share(&self, key: &str, known: &[ReliefParameter], share: f64) -> Result<String, Error> {
        let place = match self {
            Self::Words(words) => (share * words.len() as f64).min(words.len() as f64 - 1.0) as usize,
            Self::Numbers(_) => 0,
        };
        self.value_at(key, known, share * self.width(), place)
    }

    /// Returns the value so far over the low end of the range, or the `place`-th word.
    fn value_at(&self, key: &str, known: &[ReliefParameter], along: f64, place: usize) -> Result<String, Error> {
        match self {
            Self::Words(words) if !words.is_empty() => Ok(words[place % words.len()].clone()),
            Self::Words(_) => Err(self.range_error(key, known)),
            Self::Numbers([from, to]) => {
                // What is no number of the relief's is refused by name when it is set.
                let Some([low, high]) = parameter_limits(key, known) else { return Ok(from.to_string()) };
                if !(low <= *from && from < to && *to <= high) {
                    return Err(self.range_error(key, known));
                }
                let value = from + along;
                let whole = known.iter().any(|p| p.key == key && matches!(p.domain, ParameterDomain::Whole { .. }));
                let value = if whole { value.round() } else { round_in_range(value, to - from) };
                Ok(value.clamp(*from, *to).to_string())
            }
        }
    }

    fn range_error(&self, key: &str, known: &[ReliefParameter]) -> Error {
        let given = match self {
            Self::Numbers([from, to]) => format!("{from} to {to}"),
            Self::Words(words) => format!("{words:?}"),
        };
        let expected = known.iter().find(|p| p.key == key).map_or_else(String::new, |p| p.domain.to_string());
        Error::Range { key: key.to_owned(), given, expected }
    }
}

fn parameter_limits(key: &str, known: &[ReliefParameter]) -> Option<[f64; 2]> {
    known.iter().find(|p| p.key == key).and_then(|p| match p.domain {
        ParameterDomain::Number { low, high, .. } => Some([low, high]),
        ParameterDomain::Whole { low, high, .. } => Some([low as f64, high as f64]),
        ParameterDomain::Choice { .. } => None,
    })
}

/// Standard deviation of the surfaces' levels in each band, mean over the bands, dB.
fn level_spread(results: &[BandLevel]) -> Result<f64, Error> {
    let mut bands: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
    for result in results {
        if !result.level_db.is_finite() {
            let actual = format!("level {} of surface {}", result.level_db, result.surface_id);
            return Err(Error::Results { actual, expected: "finite levels" });
        }
        bands.entry(&result.band).or_default().push(result.level_db);
    }
    let fewest = bands.values().map(Vec::len).min().unwrap_or(0);
    if fewest < 2 {
        let actual = format!("a band with {fewest} surfaces");
        return Err(Error::Results { actual, expected: "two surfaces or more in every band" });
    }
    let deviation = |levels: &Vec<f64>| {
        let n = levels.len() as f64;
        let mean = levels.iter().sum::<f64>() / n;
        (levels.iter().map(|x| (x - mean) * (x - mean)).sum::<f64>() / (n - 1.0)).sqrt()
    };
    Ok(bands.values().map(deviation).sum::<f64>() / bands.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "relief = \"coursed_ashlar\"\nseed = 3\ntarget_spread_db = 1.0\n\
        [fixed]\nmacrostructure = \"wavy_x\"\n\
        [ranges]\njoint_depth_mm = [10.0, 20.0]\njoint_shape = [\"recessed\", \"v\"]\nstone_length_mm = [400, 800]\n\
        [steps]\njoint_depth_mm = 1.5\n";

    fn number(relief: &PanelRelief, key: &str) -> f64 {
        relief.parameters()[key].as_f64().expect("a number")
    }

    fn results(levels: [f64; 3]) -> Vec<BandLevel> {
        let of = |(n, level_db): (usize, &f64)| BandLevel {
            surface_id: format!("000{n}_0"),
            band: "2500".to_owned(),
            level_db: *level_db,
        };
        levels.iter().enumerate().map(of).collect()
    }

    fn sorted_values(group: &[PanelRelief], key: &str) -> Vec<f64> {
        let mut values: Vec<_> = group.iter().map(|relief| number(relief, key)).collect();
        values.sort_unstable_by(f64::total_cmp);
        values
    }

    #[test]
    fn a_group_goes_through_its_ranges_in_steps() {
        let ranges = GroupRanges::from_toml(TEXT).expect("ranges");
        let group = ranges.draw_reliefs(8).expect("a group");
        assert_eq!(group, ranges.draw_reliefs(8).expect("a group"));
        // 10, 11.5, ... 19, then 20.5 less the range.
        let depths = [10.0, 10.5, 11.5, 13.0, 14.5, 16.0, 17.5, 19.0];
        assert_eq!(sorted_values(&group, "joint_depth_mm"), depths);
        // A random step is a sixteenth to a quarter of the range; five values cannot come round.
        let lengths = sorted_values(&ranges.draw_reliefs(5).expect("a group"), "stone_length_mm");
        let steps: Vec<_> = lengths.windows(2).map(|two| two[1] - two[0]).collect();
        assert!(lengths[0] == 400.0 && (25.0..=100.0).contains(&steps[0]), "{lengths:?}");
        assert!(steps.iter().all(|step| (step - steps[0]).abs() < 0.11), "{steps:?}");
        assert!(group.iter().all(|r| r.parameters()["macrostructure"] == "wavy_x"));
        let pointed = group.iter().filter(|r| r.parameters()["joint_shape"] == "v").count();
        assert_eq!(pointed, 4);
        let seeds: std::collections::BTreeSet<_> = group.iter().map(|r| r.parameters()["seed"].to_string()).collect();
        assert_eq!(seeds.len(), 8);
        let other = GroupRanges { seed: 4, ..ranges };
        assert_ne!(other.draw_reliefs(8).expect("a group"), group);
    }

    #[test]
    fn alike_results_make_steps_larger_and_different_ones_smaller() {
        let ranges = GroupRanges::from_toml(TEXT).expect("ranges");
        // Standard deviation 0.5 dB, 1 is wanted: twice as large, from where three steps end.
        let larger = ranges.next_step(&results([0.0, 0.5, 1.0])).expect("a step");
        assert_eq!((larger.spread_db, larger.factor), (0.5, 2.0));
        assert_eq!((larger.ranges.steps["joint_depth_mm"], larger.ranges.begin["joint_depth_mm"]), (3.0, 14.5));
        assert_eq!((larger.ranges.seed, &larger.ranges.ranges), (4, &ranges.ranges));
        let group = larger.ranges.draw_reliefs(3).expect("a group");
        assert_eq!(sorted_values(&group, "joint_depth_mm"), [10.5, 14.5, 17.5]);
        let smaller = ranges.next_step(&results([-1.25, 0.0, 1.25])).expect("a step");
        assert_eq!(smaller.ranges.steps["joint_depth_mm"], 1.2);
        assert!(smaller.reasons[0].contains("far apart") && smaller.reasons.len() == 4, "{:?}", smaller.reasons);
        // Results that are the same are no division by zero, and steps are half of a range at most.
        let mut last = ranges.clone();
        for _ in 0..6 {
            last = last.next_step(&results([1.0, 1.0, 1.0])).expect("a step").ranges;
        }
        assert_eq!((last.steps["joint_depth_mm"], &last.ranges), (5.0, &ranges.ranges));
        assert_eq!(GroupRanges::from_toml(&last.to_toml()), Ok(last));
    }

    // Groups whose results are far apart go on as well: in the end a value stands in each tenth of the range.
    #[test]
    fn no_part_of_a_range_stays_unexplored() {
        let mut ranges = GroupRanges::from_toml(TEXT).expect("ranges");
        let mut depths = Vec::new();
        for _ in 0..8 {
            depths.extend(sorted_values(&ranges.draw_reliefs(3).expect("a group"), "joint_depth_mm"));
            ranges = ranges.next_step(&results([-1.1, 0.0, 1.1])).expect("a step").ranges;
        }
        let tenths: BTreeSet<_> = depths.iter().map(|depth| (depth - 10.0) as i64).collect();
        assert_eq!(tenths.len(), 10, "{depths:?}");
    }

    #[test]
    fn what_is_no_group_is_refused() {
        let check = |from: &str, to: &str, expected: &str| {
            let error = GroupRanges::from_toml(&TEXT.replace(from, to)).expect_err(to).to_string();
            assert!(error.contains(expected), "{error}");
        };
        check("[10.0, 20.0]", "[10.0, 90.0]", "range of `joint_depth_mm` is 10 to 90, expected 0 to 80");
        check("[10.0, 20.0]", "[20.0, 10.0]", "low below high");
        check("[10.0, 20.0]", "[nan, 20.0]", "range of `joint_depth_mm`");
        check("joint_depth_mm", "jiont_depth_mm", "no parameter `jiont_depth_mm`");
        check("\"v\"", "\"u\"", "`u`, expected recessed");
        check("coursed_ashlar", "marble", "no relief");
        check("= 1.0", "= 0.0", "target_spread_db");
        check("mm = 1.5", "mm = 6", "`joint_depth_mm` in [steps] is 6, expected above 0, and 5 or less");
        check("[steps]", "[begin]", "`joint_depth_mm` in [begin] is 1.5, expected 10 to 20");
        check("joint_depth_mm = 1.5", "joint_shape = 1", "[steps] has `joint_shape`, which has no range of numbers");
        let ranges = GroupRanges::from_toml(TEXT).expect("ranges");
        assert!(matches!(ranges.next_step(&results([0.0; 3])[..1]), Err(Error::Results { .. })));
        assert!(matches!(ranges.next_step(&results([0.0, f64::NAN, 1.0])), Err(Error::Results { .. })));
    }
}
