//! Parameters of reliefs: their names, meanings and domains.

use serde::{Deserialize, Serialize};

use super::Error;

/// Layer of the wall that a parameter shapes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Layer {
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
pub enum Domain {
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
pub struct Parameter {
    /// Its name, as in `--set`.
    pub key: &'static str,
    /// The layer that it shapes.
    pub layer: Layer,
    /// Its unit; empty for words and counts.
    pub unit: &'static str,
    /// Its domain.
    pub domain: Domain,
    /// Its meaning.
    pub about: &'static str,
}

/// Value of a parameter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Setting {
    /// A whole number.
    Whole(u64),
    /// A number.
    Number(f64),
    /// A word.
    Word(String),
}

impl Parameter {
    /// A number in millimetres of the full-scale wall.
    pub(super) const fn mm(
        key: &'static str,
        layer: Layer,
        [low, high, default]: [f64; 3],
        about: &'static str,
    ) -> Self {
        Self { key, layer, unit: "mm full scale", domain: Domain::Number { low, high, default }, about }
    }

    /// A number of another unit.
    pub(super) const fn number(
        key: &'static str,
        layer: Layer,
        unit: &'static str,
        [low, high, default]: [f64; 3],
        about: &'static str,
    ) -> Self {
        Self { key, layer, unit, domain: Domain::Number { low, high, default }, about }
    }

    /// A word; the first is the default.
    pub(super) const fn choice(
        key: &'static str,
        layer: Layer,
        options: &'static [&'static str],
        about: &'static str,
    ) -> Self {
        Self { key, layer, unit: "", domain: Domain::Choice { options, default: options[0] }, about }
    }

    /// A whole number.
    pub(super) const fn whole(
        key: &'static str,
        layer: Layer,
        [low, high, default]: [u64; 3],
        about: &'static str,
    ) -> Self {
        Self { key, layer, unit: "", domain: Domain::Whole { low, high, default }, about }
    }

    /// Returns its default.
    pub fn default_setting(&self) -> Setting {
        match self.domain {
            Domain::Number { default, .. } => Setting::Number(default),
            Domain::Whole { default, .. } => Setting::Whole(default),
            Domain::Choice { default, .. } => Setting::Word(default.to_owned()),
        }
    }

    /// Parses a value of it; `relief` is for messages.
    ///
    /// # Errors
    /// [`Error::Value`], which names the domain.
    pub fn parse(&self, relief: &'static str, text: &str) -> Result<Setting, Error> {
        let setting = match self.domain {
            Domain::Number { low, high, .. } => {
                text.parse().ok().filter(|x: &f64| (low..=high).contains(x)).map(Setting::Number)
            }
            Domain::Whole { low, high, .. } => {
                text.parse().ok().filter(|x: &u64| (low..=high).contains(x)).map(Setting::Whole)
            }
            Domain::Choice { options, .. } => options.contains(&text).then(|| Setting::Word(text.to_owned())),
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

impl std::fmt::Display for Domain {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Number { low, high, .. } => write!(f, "{low} to {high}"),
            Self::Whole { low, high, .. } => write!(f, "a whole number from {low} to {high}"),
            Self::Choice { options, .. } => f.write_str(&options.join(", ")),
        }
    }
}

impl std::fmt::Display for Setting {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Whole(x) => write!(f, "{x}"),
            Self::Number(x) => write!(f, "{x}"),
            Self::Word(x) => f.write_str(x),
        }
    }
}
