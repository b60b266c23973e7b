//! Groups of panels: parameters spread over ranges, and the ranges of the next group from the spread of the last one's
//! results.
//!
//! Results that are alike say that the group was made too narrow, so its ranges widen; results that lie far apart say
//! that something between them was missed, so the ranges narrow about their middles. One group is made, printed and
//! measured before the next is chosen.

use std::collections::BTreeMap;

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

/// Ranges of the next group, with the reasons.
#[derive(Debug, Clone, PartialEq)]
pub struct GroupStep {
    /// The next group's.
    pub ranges: GroupRanges,
    /// Spread of the results, dB.
    pub spread_db: f64,
    /// Factor by which the ranges became wider; below 1 narrower.
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
/// Largest factor of a step; its inverse is the smallest.
const LARGEST_STEP: f64 = 2.0;

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
        Ok(())
    }

    /// The file's text.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).unwrap_or_default()
    }

    /// `count` reliefs whose parameters fill the ranges evenly: each parameter's range is cut into `count` parts, and
    /// every part has one relief (Latin hypercube; McKay, Beckman, Conover 1979). The same seed draws the same.
    /// If the seed of the wall is not given, each relief has its own.
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
            let place = chance.random_order(count);
            for (n, relief) in drawn.iter_mut().enumerate() {
                let part = (place[n] as f64 + chance.at_place(n as i64, 0).unit_number(0)) / count as f64;
                relief.set_parameter(key, &range.value_at(key, &known, part, place[n])?)?;
            }
        }
        drawn.iter().try_for_each(PanelRelief::check_depth)?;
        Ok(drawn)
    }

    /// Computes the next group's ranges from this one's results.
    ///
    /// # Errors
    /// [`Error::Results`] for fewer than two surfaces or levels that are no numbers, else as [`Self::draw_reliefs`].
    pub fn next_step(&self, results: &[BandLevel]) -> Result<GroupStep, Error> {
        let spread_db = level_spread(results)?;
        let factor = (self.target_spread_db / spread_db.max(1e-9)).clamp(1.0 / LARGEST_STEP, LARGEST_STEP);
        let known = PanelRelief::by_name(&self.relief)?.describe_parameters();
        let (judgement, change) = if factor > 1.0 { ("too alike", "wider") } else { ("far apart", "narrower") };
        let mut reasons = vec![format!(
            "The last group's results lie {spread_db:.2} dB apart, {:.2} dB are wanted: {judgement}, so ranges become \
             {factor:.2} times as wide ({change}).",
            self.target_spread_db
        )];
        let mut next = Self { seed: self.seed.wrapping_add(1), ..self.clone() };
        for (key, range) in &mut next.ranges {
            let before = range.clone();
            if let (ParameterRange::Numbers(range), Some([low, high])) = (&mut *range, parameter_limits(key, &known)) {
                *range = stretch_range(*range, factor, [low, high]);
            }
            reasons.push(match (&before, &*range) {
                (ParameterRange::Numbers(a), ParameterRange::Numbers(b)) if a == b => {
                    format!("{key}: stays {} to {}, its limits.", a[0], a[1])
                }
                (ParameterRange::Numbers(a), ParameterRange::Numbers(b)) => {
                    format!("{key}: {} to {} becomes {} to {}.", a[0], a[1], b[0], b[1])
                }
                _ => format!("{key}: words stay as they are."),
            });
        }
        next.check_ranges()?;
        Ok(GroupStep { ranges: next, spread_db, factor, reasons })
    }
}

impl ParameterRange {
    /// Returns the value at a share of the range, or the `place`-th word.
    fn value_at(&self, key: &str, known: &[ReliefParameter], share: f64, place: usize) -> Result<String, Error> {
        match self {
            Self::Words(words) if !words.is_empty() => Ok(words[place % words.len()].clone()),
            Self::Words(_) => Err(self.range_error(key, known)),
            Self::Numbers([from, to]) => {
                // What is no number of the relief's is refused by name when it is set.
                let Some([low, high]) = parameter_limits(key, known) else { return Ok(from.to_string()) };
                if !(low <= *from && from < to && *to <= high) {
                    return Err(self.range_error(key, known));
                }
                let value = from + (to - from) * share;
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

// Widens about the middle, within the limits; a part that is cut off on one side is not added on the other.
fn stretch_range([from, to]: [f64; 2], factor: f64, [low, high]: [f64; 2]) -> [f64; 2] {
    let middle = (from + to) / 2.0;
    let half = (to - from) / 2.0 * factor;
    [(middle - half).max(low), (middle + half).min(high)].map(|x| round_in_range(x, to - from))
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
        [ranges]\njoint_depth_mm = [10.0, 20.0]\njoint_shape = [\"recessed\", \"v\"]\nstone_length_mm = [400, 800]\n";

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

    #[test]
    fn a_group_fills_its_ranges_evenly() {
        let ranges = GroupRanges::from_toml(TEXT).expect("ranges");
        let group = ranges.draw_reliefs(8).expect("a group");
        assert_eq!(group, ranges.draw_reliefs(8).expect("a group"));
        for (key, low, width) in [("joint_depth_mm", 10.0, 10.0), ("stone_length_mm", 400.0, 400.0)] {
            let mut parts: Vec<_> =
                group.iter().map(|r| ((number(r, key) - low - 0.05) / width * 8.0) as i64).collect();
            parts.sort_unstable();
            assert_eq!(parts, (0..8).collect::<Vec<_>>(), "{key}");
        }
        assert!(group.iter().all(|r| r.parameters()["macrostructure"] == "wavy_x"));
        let pointed = group.iter().filter(|r| r.parameters()["joint_shape"] == "v").count();
        assert_eq!(pointed, 4);
        let seeds: std::collections::BTreeSet<_> = group.iter().map(|r| r.parameters()["seed"].to_string()).collect();
        assert_eq!(seeds.len(), 8);
        let other = GroupRanges { seed: 4, ..ranges };
        assert_ne!(other.draw_reliefs(8).expect("a group"), group);
    }

    #[test]
    fn alike_results_widen_and_different_ones_narrow() {
        let ranges = GroupRanges::from_toml(TEXT).expect("ranges");
        // Standard deviation 0.5 dB, 1 is wanted: twice as wide.
        let wider = ranges.next_step(&results([0.0, 0.5, 1.0])).expect("a step");
        assert_eq!((wider.spread_db, wider.factor), (0.5, 2.0));
        assert_eq!(wider.ranges.ranges["joint_depth_mm"], ParameterRange::Numbers([5.0, 25.0]));
        assert_eq!(wider.ranges.seed, 4);
        let narrower = ranges.next_step(&results([-1.25, 0.0, 1.25])).expect("a step");
        assert_eq!(narrower.ranges.ranges["stone_length_mm"], ParameterRange::Numbers([440.0, 760.0]));
        assert!(narrower.reasons[0].contains("far apart") && narrower.reasons.len() == 4, "{:?}", narrower.reasons);
        // Six steps meet the parameter's limits; results that are the same are no division by zero.
        let mut last = ranges;
        for _ in 0..6 {
            last = last.next_step(&results([1.0, 1.0, 1.0])).expect("a step").ranges;
        }
        assert_eq!(last.ranges["joint_depth_mm"], ParameterRange::Numbers([0.0, 80.0]));
        assert_eq!(GroupRanges::from_toml(&last.to_toml()), Ok(last));
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
        let ranges = GroupRanges::from_toml(TEXT).expect("ranges");
        assert!(matches!(ranges.next_step(&results([0.0; 3])[..1]), Err(Error::Results { .. })));
        assert!(matches!(ranges.next_step(&results([0.0, f64::NAN, 1.0])), Err(Error::Results { .. })));
    }
}
