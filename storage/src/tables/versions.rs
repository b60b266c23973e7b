//! Time travel: the versions that a table's log still holds, and the lake as it was at one of them.
//!
//! The lake's version is that of its table `runs`, because `runs` decides the rest: it names the derivations of the
//! rows that are seen, and the same derivation means the same rows, whichever version of a table's log added their
//! file. So the other tables' files are looked for in all versions of their logs. A time selects a version of `runs`,
//! nothing else: the logs of two tables may have been written with clocks that differ.

use std::collections::HashSet;
use std::str::FromStr;
use std::sync::Arc;

use chrono::{DateTime, NaiveDate, NaiveDateTime, SecondsFormat, Utc};
use echolake_schema::tables::{Source, Table};
use object_store::path::Path;

use crate::tables::file_name::table_folder;
use crate::tables::snapshot::shown_view;
use crate::{DataFile, Error, Lake, LakeSnapshot, Result, TableVersion, TagName};

/// Formats of times beside RFC 3339.
const TIMES: [&str; 4] = ["%Y-%m-%dT%H:%M:%S%.f", "%Y-%m-%d %H:%M:%S%.f", "%Y-%m-%dT%H:%M", "%Y-%m-%d %H:%M"];

/// A moment of a lake.
///
/// ```
/// use echolake_lake::LakeMoment;
///
/// assert_eq!("12".parse(), Ok(LakeMoment::Version(12)));
/// assert_eq!("2026-01-05 08:00".parse::<LakeMoment>()?.to_string(), "2026-01-05T08:00:00Z");
/// assert_eq!("baseline".parse::<LakeMoment>()?.to_string(), "tag `baseline`");
/// assert!("2026-13-01".parse::<LakeMoment>().is_err());
/// # Ok::<(), echolake_lake::NoMoment>(())
/// ```
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum LakeMoment {
    /// A version of the lake, that of its table `runs`.
    Version(u64),
    /// The newest version at a time.
    Time(DateTime<Utc>),
    /// The version of a tag.
    Tag(TagName),
}

impl std::fmt::Display for LakeMoment {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Version(version) => write!(f, "version {version}"),
            Self::Time(time) => f.write_str(&time_text(time)),
            Self::Tag(name) => write!(f, "tag `{name}`"),
        }
    }
}

/// A text that is no moment.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{text}` is neither a version, a time, nor the name of a tag")]
pub struct NoMoment {
    /// The text.
    pub text: String,
}

impl FromStr for LakeMoment {
    type Err = NoMoment;

    /// Reads a version, a time as in RFC 3339 (without a zone it is UTC, without a time of day midnight), or a tag's
    /// name.
    fn from_str(text: &str) -> std::result::Result<Self, NoMoment> {
        let text = text.trim();
        if let Ok(version) = text.parse() {
            return Ok(Self::Version(version));
        }
        let zoned = DateTime::parse_from_rfc3339(text).ok().map(|t| t.to_utc());
        let naive = || TIMES.iter().find_map(|format| NaiveDateTime::parse_from_str(text, format).ok());
        let day = || NaiveDate::parse_from_str(text, "%Y-%m-%d").ok()?.and_hms_opt(0, 0, 0);
        let time = zoned.or_else(|| naive().or_else(day).map(|t| t.and_utc()));
        let tag = || text.parse().ok().map(Self::Tag);
        time.map(Self::Time).or_else(tag).ok_or_else(|| NoMoment { text: text.to_owned() })
    }
}

impl Lake {
    /// The versions of the lake that its log still holds, oldest first.
    ///
    /// # Errors
    /// What the store says.
    pub async fn list_versions(&self) -> Result<Vec<TableVersion>> {
        self.commit_log().list_versions(Table::Runs).await
    }

    /// The lake's version at a moment: for a time, the newest that was committed by then.
    ///
    /// # Errors
    /// [`Error::NoMoment`] if the log does not hold it; [`Error::NoTag`].
    pub async fn version_at(&self, moment: &LakeMoment) -> Result<u64> {
        Ok(self.find_version(moment).await?.version)
    }

    /// Finds the version at a moment.
    pub(super) async fn find_version(&self, moment: &LakeMoment) -> Result<TableVersion> {
        let tag = match moment {
            LakeMoment::Tag(name) => Some(self.find_tag(name).await?),
            LakeMoment::Version(_) | LakeMoment::Time(_) => None,
        };
        let versions = self.list_versions().await?;
        let found = match moment {
            LakeMoment::Version(number) => versions.iter().find(|v| v.version == *number),
            LakeMoment::Time(time) => versions.iter().rfind(|v| v.committed <= *time),
            // Tables that were made again count their versions from 0 again.
            LakeMoment::Tag(_) => versions.iter().find(|v| tag.as_ref().is_some_and(|tag| tag.is_of(v))),
        };
        found.cloned().ok_or_else(|| {
            let named = tag.map(|tag| format!("{moment}, version {} of {}", tag.version, time_text(&tag.committed)));
            no_moment(named.unwrap_or_else(|| moment.to_string()), &versions)
        })
    }

    /// One table as readers saw it at a version of the lake. Rows that come from the rig are as they are now.
    ///
    /// # Errors
    /// [`Error::Vacuumed`] if files of it are deleted, or what the store says.
    pub async fn snapshot_at(&self, version: u64, table: Table) -> Result<LakeSnapshot> {
        if table.source() == Source::Users {
            return self.user_snapshot_at(version, table).await;
        }
        let pointers = self.commit_log().files_at(Table::Runs, version).await?;
        let mut files = self.commit_log().list_files(table).await?;
        if table.source() != Source::Rig && !shows_all(&pointers, table, &files) {
            files = self.commit_log().files_of_all_versions(table).await?;
        }
        let there = self.list_files(table).await?;
        let wanted = LakeSnapshot::from_table_files(&pointers, table, files.clone());
        if let Some(lacking) = wanted.lacking_rows(table).first() {
            let moment = LakeMoment::Version(version).to_string();
            return Err(Error::Forgotten { moment, table: table.name(), lacking: lacking.to_string() });
        }
        files.retain(|file| there.contains(&file.path));
        let snapshot = LakeSnapshot::from_table_files(&pointers, table, files);
        let shown = snapshot.shown_runs(table);
        // Another file may have the same rows.
        let is_missing = |file: &&Arc<DataFile>| {
            let runs = file.shown_runs();
            !there.contains(&file.path) && (runs.is_empty() || runs.iter().any(|run| !shown.contains(run)))
        };
        let missing = wanted.files(table).iter().filter(is_missing).count();
        if missing == 0 {
            return Ok(snapshot);
        }
        let moment = LakeMoment::Version(version).to_string();
        let files = wanted.files(table).len();
        Err(Error::Vacuumed { moment, table: table.name(), missing, files })
    }

    // The version of `runs` names that of the table, whose files of then are there until `vacuum` deletes those that
    // were merged since.
    async fn user_snapshot_at(&self, version: u64, table: Table) -> Result<LakeSnapshot> {
        let log = self.commit_log();
        let pointers = log.view_at(Table::Runs, version).await?.unwrap_or_default();
        let shown = pointers.shown.of_table(table).table;
        let view = shown_view(log, table, Ok(log.view_at(table, shown).await?), shown).await?;
        let snapshot = LakeSnapshot::from_user_view(&pointers, table, view).with_restriction(self.is_restricted());
        snapshot.check_table(table)?;
        let files = snapshot.files(table);
        let there = self.list_files(table).await?;
        match files.iter().filter(|file| !there.contains(&file.path)).count() {
            0 => Ok(snapshot),
            missing => {
                let moment = LakeMoment::Version(version).to_string();
                Err(Error::Vacuumed { moment, table: table.name(), missing, files: files.len() })
            }
        }
    }

    async fn list_files(&self, table: Table) -> Result<HashSet<Path>> {
        let folder = table_folder(table);
        let there = self.store().list_with_delimiter(Some(&folder)).await;
        let there = there.map_err(|e| Error::store_failure("list", &folder, e))?;
        Ok(there.objects.into_iter().map(|o| o.location).collect())
    }
}

// Returns whether these files have the rows of all runs.
fn shows_all(pointers: &[Arc<DataFile>], table: Table, files: &[Arc<DataFile>]) -> bool {
    let snapshot = LakeSnapshot::from_table_files(pointers, table, files.to_vec());
    snapshot.shown_runs(table).len() == snapshot.runs().count()
}

fn time_text(time: &DateTime<Utc>) -> String {
    time.to_rfc3339_opts(SecondsFormat::AutoSi, true)
}

fn no_moment(moment: String, versions: &[TableVersion]) -> Error {
    let text = |v: &TableVersion| format!("version {} of {}", v.version, time_text(&v.committed));
    let held = match (versions.first(), versions.last()) {
        (Some(first), Some(last)) => format!("its log holds {} to {}", text(first), text(last)),
        _ => "its log holds no version".to_owned(),
    };
    Error::NoMoment { moment, held }
}

#[cfg(test)]
mod tests {
    use echolake_schema::{Rig, RunId};

    use super::*;
    use crate::{CommitOutcome, FileName, ReferenceSurfaces, StagedFile, VisibleRun, encode_batches};

    async fn stage(lake: &Lake, table: Table, name: &FileName) -> StagedFile {
        let file = encode_batches(table, &table.schema(lake.rig()), &[]).expect("encoded");
        lake.stage_file(table, name, file).await.expect("staged").made_from(&lake.snapshot().await.expect("a view"))
    }

    // Commits rows of `nce`, then the run's row in place of its present one; returns the lake's version.
    async fn ingest(lake: &Lake, run: &str, derivation: &str) -> u64 {
        let visible = VisibleRun {
            surface: "flat".parse().expect("an id"),
            run: RunId::from_str(run).expect("an id"),
            run_derivation: "run".to_owned(),
            reference_derivation: Some(derivation.to_owned()),
            verdicts: None,
        };
        let VisibleRun { surface, run, .. } = visible.clone();
        let rows = FileName::Rows { surface, run, derivation: derivation.to_owned() };
        let snapshot = lake.snapshot().await.expect("a view");
        let old: Vec<_> = snapshot.files_of(Table::Runs, &visible.run).cloned().collect();
        let pointer =
            stage(lake, Table::Runs, &FileName::Pointer(visible.clone())).await.with_replaced_rows(&visible, &old);
        let staged = [stage(lake, Table::Nce, &rows).await, pointer];
        assert_eq!(lake.commit_staged(&staged).await.expect("committed"), [CommitOutcome::Now; 2]);
        lake.snapshot().await.expect("a view").log_version(Table::Runs).expect("a log")
    }

    /// Writes the times of a table's commits: a minute from each to the next, by a clock that is off by some hours.
    fn set_commit_times(lake: &Lake, table: Table, hours: i64) {
        let folder = lake.folder().expect("a folder").join(format!("tables/{}/_delta_log", table.name()));
        for path in std::fs::read_dir(folder).expect("listed").map(|entry| entry.expect("an entry").path()) {
            if path.extension().is_none_or(|extension| extension != "json") {
                continue;
            }
            let version: i64 = path.file_stem().and_then(|stem| stem.to_str()?.parse().ok()).expect("a version");
            let text = std::fs::read_to_string(&path).expect("read");
            let (head, rest) = text.split_once("\"timestamp\":").expect("a time");
            let end = rest.find(|c: char| !c.is_ascii_digit()).expect("an end");
            let time = 1_795_000_000_000 + version * 60_000 + hours * 3_600_000;
            std::fs::write(&path, format!("{head}\"timestamp\":{time}{}", &rest[end..])).expect("written");
        }
    }

    #[tokio::test]
    async fn a_version_shows_the_rows_that_it_named_whatever_clocks_said() {
        for (table, hours) in [(Table::Nce, 1), (Table::Nce, -1), (Table::Runs, 1), (Table::Runs, -1)] {
            let folder = tempfile::tempdir().expect("a folder");
            let url = folder.path().join("lake").display().to_string();
            let made = Lake::open_or_create(&url, &Rig::paper(), &ReferenceSurfaces::default()).await.expect("made");
            let mut expected = vec![(ingest(&made, "r1", "a").await, vec!["flat.r1.a.parquet"])];
            expected.push((ingest(&made, "r2", "b").await, vec!["flat.r1.a.parquet", "flat.r2.b.parquet"]));
            expected.push((ingest(&made, "r1", "c").await, vec!["flat.r1.c.parquet", "flat.r2.b.parquet"]));
            assert!(made.remove_superseded().await.expect("removed") > 0, "the clean-up has something to do");
            set_commit_times(&made, Table::Runs, 0);
            set_commit_times(&made, table, hours);

            let lake = Lake::open(&url).await.expect("opened");
            let versions = lake.list_versions().await.expect("versions");
            for (version, names) in &expected {
                let committed = versions.iter().find(|v| v.version == *version).expect("held").committed;
                let at = lake.version_at(&LakeMoment::Time(committed)).await.expect("a version");
                let snapshot = lake.snapshot_at(at, Table::Nce).await.expect("seen");
                let seen: Vec<_> = snapshot.files(Table::Nce).iter().filter_map(|f| f.path.filename()).collect();
                assert_eq!((at, &seen), (*version, names), "{table:?} {hours} h");
            }
            // What is deleted is said, and only of the versions that had it.
            let gone = folder.path().join("lake/tables/nce/flat.r1.a.parquet");
            std::fs::remove_file(gone).expect("deleted");
            for (version, missing) in [(expected[0].0, true), (expected[1].0, true), (expected[2].0, false)] {
                let seen = lake.snapshot_at(version, Table::Nce).await;
                assert_eq!(matches!(seen, Err(Error::Vacuumed { missing: 1, .. })), missing, "{seen:?}");
            }
        }
    }

    #[test]
    fn times_without_a_zone_are_utc() {
        let ten = "2026-11-21T10:00:00Z".parse().expect("a time");
        for text in ["2026-11-21T10:00:00Z", "2026-11-21 10:00:00", "2026-11-21 10:00", "2026-11-21T11:00:00+01:00"] {
            assert_eq!(text.parse(), Ok(LakeMoment::Time(ten)), "{text}");
        }
        assert_eq!("12".parse(), Ok(LakeMoment::Version(12)));
        for text in ["last week", "-1", "", "2026-13-01"] {
            assert!(text.parse::<LakeMoment>().is_err(), "{text}");
        }
    }
}
