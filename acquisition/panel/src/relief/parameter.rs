//! Parameters of reliefs: their names, meanings and domains.

use serde::Serialize;

use super::Error;

/// Layer of the wall that a parameter shapes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ParameterLayer {
    /// The large shape of the wall.
    Macrostructure,
    /// Its stones.
    Mesostructure,
    /// Their joints and their skin.
    Microstructure,
    /// A relief that is not made in layers.
    Whole,
}

/// Domain and default of a parameter.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ParameterDomain {
    /// A number.
    Number {
        /// Least.
        low: f64,
        /// Greatest.
        high: f64,
        /// Default.
        default: f64,
    },
    /// A whole number.
    Whole {
        /// Least.
        low: u64,
        /// Greatest.
        high: u64,
        /// Default.
        default: u64,
    },
    /// One of some words.
    Choice {
        /// The words.
        options: &'static [&'static str],
        /// Default.
        default: &'static str,
    },
}

/// A named parameter.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ReliefParameter {
    /// Its name, as in `--set`.
    pub key: &'static str,
    /// The layer that it shapes.
    pub layer: ParameterLayer,
    /// Its unit; empty for words and counts.
    pub unit: &'static str,
    /// Its domain.
    pub domain: ParameterDomain,
    /// Its meaning.
    pub about: &'static str,
}

/// Value of a parameter.
#[derive(Debug, Clone, PartialEq)]
pub enum ParameterValue {
    /// A whole number.
    Whole(u64),
    /// A number.
    Number(f64),
    /// A word.
    Word(String),
}

impl ReliefParameter {
    /// A number in millimetres of the full-scale wall.
    pub(super) const fn new_mm(
        key: &'static str,
        layer: ParameterLayer,
        [low, high, default]: [f64; 3],
        about: &'static str,
    ) -> Self {
        Self { key, layer, unit: "mm full scale", domain: ParameterDomain::Number { low, high, default }, about }
    }

    /// A number of another unit.
    pub(super) const fn new_number(
        key: &'static str,
        layer: ParameterLayer,
        unit: &'static str,
        [low, high, default]: [f64; 3],
        about: &'static str,
    ) -> Self {
        Self { key, layer, unit, domain: ParameterDomain::Number { low, high, default }, about }
    }

    /// A word; the first is the default.
    pub(super) const fn new_choice(
        key: &'static str,
        layer: ParameterLayer,
        options: &'static [&'static str],
        about: &'static str,
    ) -> Self {
        Self { key, layer, unit: "", domain: ParameterDomain::Choice { options, default: options[0] }, about }
    }

    /// A whole number.
    pub(super) const fn new_whole(
        key: &'static str,
        layer: ParameterLayer,
        [low, high, default]: [u64; 3],
        about: &'static str,
    ) -> Self {
        Self { key, layer, unit: "", domain: ParameterDomain::Whole { low, high, default }, about }
    }

    /// Returns its default.
    pub fn default_setting(&self) -> ParameterValue {
        match self.domain {
            ParameterDomain::Number { default, .. } => ParameterValue::Number(default),
            ParameterDomain::Whole { default, .. } => ParameterValue::Whole(default),
            ParameterDomain::Choice { default, .. } => ParameterValue::Word(default.to_owned()),
        }
    }

    /// Parses a value of it; `relief` is for messages.
    ///
    /// # Errors
    /// [`Error::Value`], which names the domain.
    pub fn parse_value(&self, relief: &'static str, text: &str) -> Result<ParameterValue, Error> {
        let setting = match self.domain {
            ParameterDomain::Number { low, high, .. } => {
                text.parse().ok().filter(|x: &f64| (low..=high).contains(x)).map(ParameterValue::Number)
            }
            ParameterDomain::Whole { low, high, .. } => {
                text.parse().ok().filter(|x: &u64| (low..=high).contains(x)).map(ParameterValue::Whole)
            }
            ParameterDomain::Choice { options, .. } => {
                options.contains(&text).then(|| ParameterValue::Word(text.to_owned()))
            }
        };
        setting.ok_or_else(|| Error::Value {
            relief,
            key: self.key.to_owned(),
            given: text.to_owned(),
            expected: self.domain.to_string() + if self.unit.is_empty() { "" } else { " " } + self.unit,
            hint: self.about,
        })
    }
}

impl ParameterDomain {
    /// Returns the value at a share of the domain, from 0 to below 1. Seeds stay below a million.
    pub(super) fn value_at(&self, share: f64) -> ParameterValue {
        match *self {
            Self::Number { low, high, .. } => {
                ParameterValue::Number(round_in_range(low + (high - low) * share, high - low).clamp(low, high))
            }
            Self::Whole { low, high, .. } => {
                ParameterValue::Whole(low + ((high.min(999_999) - low) as f64 * share) as u64)
            }
            Self::Choice { options, .. } => {
                ParameterValue::Word(options[(options.len() as f64 * share) as usize].to_owned())
            }
        }
    }
}

/// Rounds a value of a range, so that it is easy to read.
pub(super) fn round_in_range(value: f64, width: f64) -> f64 {
    let steps = if width < 10.0 { 1_000.0 } else { 10.0 };
    (value * steps).round() / steps
}

impl std::fmt::Display for ParameterDomain {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Number { low, high, .. } => write!(f, "{low} to {high}"),
            Self::Whole { low, high, .. } => write!(f, "a whole number from {low} to {high}"),
            Self::Choice { options, .. } => f.write_str(&options.join(", ")),
        }
    }
}

impl From<ParameterValue> for serde_json::Value {
    fn from(value: ParameterValue) -> Self {
        match value {
            ParameterValue::Whole(x) => x.into(),
            ParameterValue::Number(x) => x.into(),
            ParameterValue::Word(x) => x.into(),
        }
    }
}
