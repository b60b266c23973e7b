//! Time travel: the versions that a table's log still holds, and the lake as it was at one of them.
//!
//! The lake's version is that of its table `runs`, because `runs` decides the rest. The other tables are seen as of
//! the time of that version; whatever it names was committed before it.

use std::str::FromStr;

use chrono::{DateTime, NaiveDate, NaiveDateTime, SecondsFormat, Utc};
use echolake_schema::tables::Table;

use crate::tables::delta::folder;
use crate::{Error, Lake, LakeSnapshot, Result, TableVersion};

/// Formats of times beside RFC 3339.
const TIMES: [&str; 4] = ["%Y-%m-%dT%H:%M:%S%.f", "%Y-%m-%d %H:%M:%S%.f", "%Y-%m-%dT%H:%M", "%Y-%m-%d %H:%M"];

/// A moment of a lake.
///
/// ```
/// use echolake_lake::LakeMoment;
///
/// assert_eq!("12".parse(), Ok(LakeMoment::Version(12)));
/// assert_eq!("2026-01-05 08:00".parse::<LakeMoment>()?.to_string(), "2026-01-05T08:00:00Z");
/// assert!("yesterday".parse::<LakeMoment>().is_err());
/// # Ok::<(), echolake_lake::NoMoment>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum LakeMoment {
    /// A version of the lake, that of its table `runs`.
    Version(u64),
    /// The newest version at a time.
    Time(DateTime<Utc>),
}

impl std::fmt::Display for LakeMoment {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Version(version) => write!(f, "version {version}"),
            Self::Time(time) => f.write_str(&time.to_rfc3339_opts(SecondsFormat::AutoSi, true)),
        }
    }
}

/// A text that is no moment.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{text}` is neither a version nor a time")]
pub struct NoMoment {
    /// The text.
    pub text: String,
}

impl FromStr for LakeMoment {
    type Err = NoMoment;

    /// Reads a version, or a time as in RFC 3339; without a zone it is UTC, without a time of day midnight.
    fn from_str(text: &str) -> std::result::Result<Self, NoMoment> {
        let text = text.trim();
        if let Ok(version) = text.parse() {
            return Ok(Self::Version(version));
        }
        let zoned = DateTime::parse_from_rfc3339(text).ok().map(|t| t.to_utc());
        let naive = || TIMES.iter().find_map(|format| NaiveDateTime::parse_from_str(text, format).ok());
        let day = || NaiveDate::parse_from_str(text, "%Y-%m-%d").ok()?.and_hms_opt(0, 0, 0);
        let time = zoned.or_else(|| naive().or_else(day).map(|t| t.and_utc()));
        time.map(Self::Time).ok_or_else(|| NoMoment { text: text.to_owned() })
    }
}

impl Lake {
    /// The versions of the lake that its log still holds, oldest first.
    ///
    /// # Errors
    /// What the store says.
    pub async fn versions(&self) -> Result<Vec<TableVersion>> {
        self.log().versions(Table::Runs).await
    }

    /// One table as readers saw it at a moment.
    ///
    /// # Errors
    /// [`Error::NoMoment`] if the log does not hold it, [`Error::Vacuumed`] if files of it are deleted.
    pub async fn snapshot_at(&self, moment: LakeMoment, table: Table) -> Result<LakeSnapshot> {
        let versions = self.versions().await?;
        let found = match moment {
            LakeMoment::Version(number) => versions.iter().find(|v| v.version == number),
            LakeMoment::Time(time) => versions.iter().rfind(|v| v.committed <= time),
        };
        let found = found.ok_or_else(|| no_moment(moment, &versions))?;
        let pointers = self.log().files_at(Table::Runs, found.version).await?;
        let files = match table {
            Table::Runs => pointers.clone(),
            _ => {
                let then = self.log().versions(table).await?;
                match then.iter().rfind(|v| v.committed <= found.committed) {
                    Some(version) => self.log().files_at(table, version.version).await?,
                    None => Vec::new(),
                }
            }
        };
        let snapshot = LakeSnapshot::of(&pointers, table, files);
        self.are_there(moment, table, &snapshot).await?;
        Ok(snapshot)
    }

    async fn are_there(&self, moment: LakeMoment, table: Table, snapshot: &LakeSnapshot) -> Result<()> {
        let folder = folder(table);
        let there = self.store().list_with_delimiter(Some(&folder)).await;
        let there = there.map_err(|e| Error::store("list", &folder, e))?;
        let there: std::collections::HashSet<_> = there.objects.into_iter().map(|o| o.location).collect();
        let files = snapshot.files(table);
        let missing = files.iter().filter(|f| !there.contains(&f.path)).count();
        if missing == 0 {
            return Ok(());
        }
        Err(Error::Vacuumed { moment: moment.to_string(), table: table.name(), missing, files: files.len() })
    }
}

fn no_moment(moment: LakeMoment, versions: &[TableVersion]) -> Error {
    let text = |v: &TableVersion| {
        format!("version {} of {}", v.version, v.committed.to_rfc3339_opts(SecondsFormat::AutoSi, true))
    };
    let held = match (versions.first(), versions.last()) {
        (Some(first), Some(last)) => format!("its log holds {} to {}", text(first), text(last)),
        _ => "its log holds no version".to_owned(),
    };
    Error::NoMoment { moment: moment.to_string(), held }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_without_a_zone_are_utc() {
        let ten = "2026-11-21T10:00:00Z".parse().expect("a time");
        for text in ["2026-11-21T10:00:00Z", "2026-11-21 10:00:00", "2026-11-21 10:00", "2026-11-21T11:00:00+01:00"] {
            assert_eq!(text.parse(), Ok(LakeMoment::Time(ten)), "{text}");
        }
        assert_eq!("12".parse(), Ok(LakeMoment::Version(12)));
        for text in ["yesterday", "-1", "", "2026-13-01"] {
            assert!(text.parse::<LakeMoment>().is_err(), "{text}");
        }
    }
}
