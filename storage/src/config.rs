//! `lake.toml`: the lake's format, its rig and its references.

use echolake_schema::{ErrorCause, Rig, SurfaceId};
use serde::{Deserialize, Serialize};

use crate::{Error, Result};

/// Format of lakes that this version writes, and the newest that it reads.
pub const LAKE_FORMAT: u32 = 1;

/// Contents of `lake.toml`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LakeConfig {
    /// The lake's format.
    pub format: u32,
    /// Precision of responses and curves.
    #[serde(default, skip_serializing_if = "SamplePrecision::is_default")]
    pub samples: SamplePrecision,
    /// References of surfaces that name none of their own.
    pub references: ReferenceSurfaces,
    /// The rig that all of its runs share.
    pub rig: Rig,
}

/// The surfaces that normalise, and the direct sound that is subtracted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename = "References")]
pub struct ReferenceSurfaces {
    /// The surface that normalises.
    pub flat: SurfaceId,
    /// The surface whose response is the direct sound.
    pub foam: SurfaceId,
    /// The direct sound that is subtracted.
    #[serde(default, skip_serializing_if = "DirectSound::is_default")]
    pub direct_sound: DirectSound,
}

/// The direct sound that is subtracted from all responses of a lake.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DirectSound {
    /// Foam's response, with the little that Foam reflects (Rust et al. 2021).
    #[default]
    Foam,
    /// Foam's response without Foam's reflection, which is estimated from Foam and Flat.
    Estimated,
}

/// Precision of the responses and curves in tables `measurements` and `nce`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SamplePrecision {
    /// Rounded, so that they take 0.6 of the space.
    #[default]
    Rounded,
    /// As computed.
    Exact,
}

impl SamplePrecision {
    /// Its name, as `lake.toml` spells it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rounded => "rounded",
            Self::Exact => "exact",
        }
    }

    fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

impl DirectSound {
    /// Its name, as `lake.toml` spells it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Foam => "foam",
            Self::Estimated => "estimated",
        }
    }

    fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

impl Default for ReferenceSurfaces {
    #[allow(clippy::expect_used, reason = "two constants, checked by the test below")]
    fn default() -> Self {
        let [flat, foam] = ["flat", "foam"].map(|name| name.parse().expect("a valid id"));
        Self { flat, foam, direct_sound: DirectSound::default() }
    }
}

/// The part of any version's `lake.toml` that holds its format.
#[derive(Deserialize)]
struct FormatOnly {
    format: u32,
}

impl LakeConfig {
    pub(crate) fn to_toml(&self) -> Result<String> {
        let body = toml::to_string(self).map_err(|e| Error::Config { location: String::new(), source: e.into() })?;
        Ok(format!("# What this lake holds; written once, when it was made.\n{body}"))
    }

    pub(crate) fn from_toml(text: &str, location: &str) -> Result<Self> {
        let damaged = |source: ErrorCause| Error::Config { location: location.to_owned(), source };
        // A newer format may have any other fields, so its number is read first.
        let FormatOnly { format } = toml::from_str(text).map_err(|e| damaged(e.into()))?;
        if format > LAKE_FORMAT {
            return Err(Error::Newer { location: location.to_owned(), actual: format, newest: LAKE_FORMAT });
        }
        let config: Self = toml::from_str(text).map_err(|e| damaged(e.into()))?;
        config.rig.check_consistency().map_err(|e| damaged(e.into()))?;
        Ok(config)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn config_round_trips() {
        let config = LakeConfig {
            format: LAKE_FORMAT,
            samples: SamplePrecision::default(),
            references: ReferenceSurfaces::default(),
            rig: Rig::paper(),
        };
        let text = config.to_toml().expect("text");
        assert_eq!(LakeConfig::from_toml(&text, "x").expect("the same"), config);
        let estimated = text.replace("foam = \"foam\"\n", "foam = \"foam\"\ndirect_sound = \"estimated\"\n");
        let config = LakeConfig::from_toml(&format!("samples = \"exact\"\n{estimated}"), "x").expect("a choice");
        assert_eq!(config.references.direct_sound, DirectSound::Estimated);
        assert_eq!(config.samples, SamplePrecision::Exact);
        assert_eq!(LakeConfig::from_toml(&config.to_toml().expect("text"), "x").expect("the same"), config);
    }

    #[test]
    fn newer_and_damaged_files_are_told_apart() {
        let newer = LakeConfig::from_toml("format = 9\nfuture = true", "x").expect_err("newer");
        assert!(matches!(newer, Error::Newer { actual: 9, .. }), "{newer}");
        let damaged = LakeConfig::from_toml("format = 1", "x").expect_err("damaged");
        assert!(matches!(damaged, Error::Config { .. }), "{damaged}");
    }
}
