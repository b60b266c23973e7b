//! Commits in a log folder: their names, and the times in them.

use chrono::{DateTime, Utc};
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::path::Path;
use object_store::{GetOptions, GetRange, ObjectStore};
use serde_json::Value;

use crate::{Error, Result, TableVersion};

/// Bytes of a commit that are read for its time, which writers put first.
const COMMIT_HEAD: u64 = 4096;
/// Commits that are read concurrently.
const TOGETHER: usize = 16;

/// Lists the versions whose commits are in a log folder, oldest first.
pub(super) async fn list_versions(store: &dyn ObjectStore, folder: &Path) -> Result<Vec<TableVersion>> {
    let there = store.list_with_delimiter(Some(folder)).await.map_err(|e| Error::store_failure("list", folder, e))?;
    let mut commits: Vec<_> = there
        .objects
        .into_iter()
        .filter_map(|o| Some((commit_number(&o.location)?, o.location, o.last_modified)))
        .collect();
    commits.sort_by_key(|c| c.0);
    let times = futures::stream::iter(commits).map(|(version, path, modified)| async move {
        Ok::<_, Error>((version, commit_time(store, &path).await?.unwrap_or(modified)))
    });
    let times: Vec<_> = times.buffered(TOGETHER).try_collect().await?;
    let mut latest = DateTime::<Utc>::MIN_UTC;
    let monotonic = times.into_iter().map(|(version, time)| {
        latest = latest.max(time);
        TableVersion { version, committed: latest }
    });
    Ok(monotonic.collect())
}

/// Name of a version's commit in the log folder.
pub(super) fn commit_name(version: u64) -> String {
    format!("{version:020}.json")
}

/// The version of a commit's file; None if it is none.
pub(super) fn commit_number(path: &Path) -> Option<u64> {
    let digits = path.filename()?.strip_suffix(".json")?;
    (digits.len() == 20).then(|| digits.parse().ok()).flatten()
}

// The first line of a commit; one that is longer than what is read is searched as text.
async fn commit_time(store: &dyn ObjectStore, path: &Path) -> Result<Option<DateTime<Utc>>> {
    let range = Some(GetRange::Bounded(0..COMMIT_HEAD));
    let head = store.get_opts(path, GetOptions { range, ..GetOptions::default() }).await;
    let head = head.map_err(|e| Error::store_failure("read", path, e))?;
    let bytes = head.bytes().await.map_err(|e| Error::store_failure("read", path, e))?;
    let text = String::from_utf8_lossy(&bytes);
    let millis = text.lines().find_map(millis_of);
    Ok(millis.and_then(DateTime::from_timestamp_millis))
}

fn millis_of(line: &str) -> Option<i64> {
    let after = line.strip_prefix("{\"commitInfo\":")?;
    if let Some(whole) = after.strip_suffix('}')
        && let Ok(Value::Object(whole)) = serde_json::from_str::<Value>(whole)
    {
        return whole.get("timestamp")?.as_i64();
    }
    let (_, from) = after.split_once("\"timestamp\":")?;
    let digits: String = from.trim_start().chars().take_while(char::is_ascii_digit).collect();
    digits.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_of_commits_are_found_in_whole_and_cut_lines() {
        let check = |line: &str, expected: Option<i64>| assert_eq!(millis_of(line), expected, "{line}");
        check(r#"{"commitInfo":{"timestamp":1795256318599,"operation":"WRITE"}}"#, Some(1_795_256_318_599));
        check(r#"{"commitInfo":{"operation":"x","timestamp":5}}"#, Some(5));
        check(r#"{"commitInfo":{"timestamp":17,"operation":"CREATE TABLE","operationPar"#, Some(17));
        check(r#"{"add":{"path":"x"}}"#, None);
    }

    #[test]
    fn commits_are_told_from_checkpoints() {
        let check = |name: &str, expected| assert_eq!(commit_number(&Path::from(name)), expected, "{name}");
        check("tables/runs/_delta_log/00000000000000000012.json", Some(12));
        check("tables/runs/_delta_log/00000000000000000010.checkpoint.parquet", None);
        check("tables/runs/_delta_log/_commits/x.json", None);
        assert_eq!(commit_number(&Path::from(commit_name(7))), Some(7));
    }
}
