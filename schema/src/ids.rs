//! Names of surfaces, runs and projects, and the numbers of points and pairs.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::{Error, quoted_text};

const SURFACE_MAX: usize = 64;
const RUN_MAX: usize = 128;
/// The log's statistics of a run's row hold the whole name.
const PROJECT_MAX: usize = 31;

/// Name of one side of a panel (`0015_0`), of a reference (`flat`) or of anything else measured.
///
/// One to 64 of `A-Z a-z 0-9 _ -`, beginning with a letter or a digit: it names folders and files.
///
/// ```
/// use echolake_schema::SurfaceId;
///
/// let id: SurfaceId = "0015_1".parse()?;
/// assert_eq!((id.panel(), id.side()), ("0015", Some(1)));
/// assert!("../etc".parse::<SurfaceId>().is_err());
/// # Ok::<(), echolake_schema::Error>(())
/// ```
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct SurfaceId(String);

/// Name of one run: `<start, UTC>-<surface>-<tag>`, so that names sort by time.
///
/// One to 128 of `A-Z a-z 0-9 _ -`, beginning with a letter or a digit.
///
/// ```
/// use echolake_schema::{RunId, Timestamp};
///
/// let run = RunId::compose(Timestamp::parse("2026-01-05T08:00:00Z")?, &"flat".parse()?, 0x7c1e)?;
/// assert_eq!(run.as_str(), "20260105T080000Z-flat-0000000000007c1e");
/// assert_eq!(run.untagged_name(), "20260105T080000Z-flat");
/// # Ok::<(), echolake_schema::Error>(())
/// ```
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct RunId(String);

/// Name of a project: a label of surfaces that tokens of the query service may be limited to.
///
/// One to 31 of `A-Z a-z 0-9 _ -`, beginning with a letter or a digit.
///
/// ```
/// use echolake_schema::ProjectName;
///
/// assert_eq!("brick-walls".parse::<ProjectName>()?.as_str(), "brick-walls");
/// assert!("brick walls".parse::<ProjectName>().is_err());
/// # Ok::<(), echolake_schema::Error>(())
/// ```
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct ProjectName(String);

/// Number of a pair, 0-based in (microphone, speaker) order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct PairId(pub u32);

/// Number of a grid point, 0-based in (layer, gridx, gridy) order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct PointId(pub u32);

impl SurfaceId {
    /// Characters of the longest name, each of one byte.
    pub const LONGEST: usize = SURFACE_MAX;

    /// The physical panel that the surface is a side of: `0016` for `panel_0016_r180_0`, else the whole name.
    pub fn panel(&self) -> &str {
        self.split_name().map_or(&self.0, |(panel, _)| panel)
    }

    /// The side, 0 or 1, if the name follows the panels' pattern.
    pub fn side(&self) -> Option<u8> {
        self.split_name().map(|(_, side)| side)
    }

    /// The name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    // `[panel_]NNNN[_rDDD]_S`: only four digits make a panel, so that `mean_flat_rfl_1` stays whole.
    fn split_name(&self) -> Option<(&str, u8)> {
        let mut parts = self.0.strip_prefix("panel_").unwrap_or(&self.0).split('_');
        let panel = parts.next().filter(|p| p.len() == 4 && p.bytes().all(|b| b.is_ascii_digit()))?;
        let mut side = parts.next()?;
        if side.strip_prefix('r').is_some_and(|d| !d.is_empty() && d.bytes().all(|b| b.is_ascii_digit())) {
            side = parts.next()?;
        }
        match (side, parts.next()) {
            ("0", None) => Some((panel, 0)),
            ("1", None) => Some((panel, 1)),
            _ => None,
        }
    }
}

impl RunId {
    /// Composes the name of a run of `surface` that began at `start`. `tag` distinguishes runs of the same second; if
    /// it is random, the name cannot be guessed.
    ///
    /// # Errors
    /// [`Error::Id`] if the parts make no valid name.
    pub fn compose(start: crate::Timestamp, surface: &SurfaceId, tag: u64) -> Result<Self, Error> {
        format!("{}-{surface}-{tag:016x}", start.compact_text()).parse()
    }

    /// The name without its tag, which runs of the same surface and second share.
    pub fn untagged_name(&self) -> &str {
        self.0.rsplit_once('-').map_or(&self.0, |(untagged, _)| untagged)
    }

    /// The surface as the name tells it; the whole name if it has another form.
    pub fn surface_name(&self) -> &str {
        let untagged = self.untagged_name();
        untagged.split_once('-').map_or(untagged, |(_, surface)| surface)
    }

    /// The name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl ProjectName {
    /// The name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl PairId {
    /// As an index into `Grid::pairs`.
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

impl PointId {
    /// As an index into `Grid::points`.
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

fn check_id(kind: &'static str, value: &str, max: usize) -> Result<(), Error> {
    let reason = if value.is_empty() {
        "it is empty"
    } else if value.len() > max {
        "it is too long"
    } else if !value.as_bytes()[0].is_ascii_alphanumeric() {
        "it must begin with a letter or a digit"
    } else if !value.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_' || b == b'-') {
        "only A-Z, a-z, 0-9, `_` and `-` may stand in it"
    } else {
        return Ok(());
    };
    Err(Error::Id { kind, value: quoted_text(value).into_owned(), reason })
}

macro_rules! checked_name {
    ($name:ident, $kind:literal, $max:expr) => {
        impl FromStr for $name {
            type Err = Error;
            fn from_str(value: &str) -> Result<Self, Error> {
                check_id($kind, value, $max)?;
                Ok(Self(value.to_owned()))
            }
        }
        impl TryFrom<String> for $name {
            type Error = Error;
            fn try_from(value: String) -> Result<Self, Error> {
                value.parse()
            }
        }
        impl From<$name> for String {
            fn from(id: $name) -> String {
                id.0
            }
        }
        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.pad(&self.0)
            }
        }
    };
}
checked_name!(SurfaceId, "surface id", SURFACE_MAX);
checked_name!(RunId, "run id", RUN_MAX);
checked_name!(ProjectName, "project name", PROJECT_MAX);

impl fmt::Display for PairId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl fmt::Display for PointId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn surfaces_know_their_panel() {
        let check = |name: &str, panel: &str, side| {
            let id: SurfaceId = name.parse().expect("valid");
            assert_eq!((id.panel(), id.side()), (panel, side), "{name}");
        };
        check("0015_0", "0015", Some(0));
        check("panel_0015_1", "0015", Some(1));
        check("panel_0016_r180_0", "0016", Some(0));
        check("mean_flat_rfl_1", "mean_flat_rfl_1", None);
        check("flat", "flat", None);
        check("0015_2", "0015_2", None);
        check("panel_0015", "panel_0015", None);
    }

    #[test]
    fn names_that_could_leave_their_folder_are_refused() {
        for bad in ["", "..", "../x", "a/b", "a b", ".hidden", "-x", "ä", "a\0", &"x".repeat(65)] {
            assert!(bad.parse::<SurfaceId>().is_err(), "{bad:?}");
        }
        assert!("x".repeat(129).parse::<RunId>().is_err());
        assert!("x".repeat(32).parse::<crate::ProjectName>().is_err());
        assert!(serde_json_like("a/b").is_err());
    }

    fn serde_json_like(text: &str) -> Result<SurfaceId, Error> {
        SurfaceId::try_from(text.to_owned())
    }

    #[test]
    fn run_names_sort_by_time() {
        let surface = "flat".parse().expect("valid");
        let at = |nanos| RunId::compose(crate::Timestamp(nanos), &surface, 0x7c1e).expect("valid");
        let (early, late) = (at(1_767_600_000_000_000_000), at(1_767_600_001_000_000_000));
        assert_eq!(early.as_str(), "20260105T080000Z-flat-0000000000007c1e");
        assert!(early < late);
        let shorter: RunId = "20260105T080000Z-flat-7c1e".parse().expect("a name of older versions");
        assert_eq!(shorter.untagged_name(), early.untagged_name());
    }
}
