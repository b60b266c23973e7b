//! Which files a call means: runs of one view of the lake, or a file by its place in the lake.

use std::collections::BTreeMap;
use std::sync::Arc;

use echolake_lake::{Lake, LakeSnapshot, VisibleRun};
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::path::Path;

use super::error::Fault;
use super::file::{McapFile, McapFiles};

/// Files that are opened at once.
const OPENED_AT_ONCE: usize = 16;
/// The end of a run file's name.
const EXTENSION: &str = ".mcap";
const FORMS: &str = "a surface (`0015_0`), a run, either with * and ?, or a file in the lake (`inbox/x.mcap`); \
                     several with commas between them";

const RUNS_ALONE: &str = "tokens of projects read files of their runs alone; select file from runs";

/// A file that a call means.
#[derive(Debug, Clone)]
pub(super) struct Target {
    /// Surface and run; None for a file that is no run of the lake.
    pub run: Option<(String, String)>,
    pub file: Arc<McapFile>,
}

impl Target {
    /// Opens the files that `pattern` means, each once.
    pub async fn open_all(pattern: &str, snapshot: &LakeSnapshot, files: &McapFiles) -> Result<Vec<Self>, Fault> {
        let mut meant = BTreeMap::new();
        for part in pattern.split(',').map(str::trim) {
            if part.contains('/') || part.ends_with(EXTENSION) {
                let path = parse_path(part)?;
                let run = snapshot.runs().find(|r| Lake::run_path(&r.surface, &r.run) == path);
                if run.is_none() && snapshot.is_restricted() {
                    return Err(Fault::invalid_call(
                        format!("`{part}` is the file of no run that you may see"),
                        RUNS_ALONE,
                    ));
                }
                meant.insert(path, run.map(run_names));
            } else {
                meant.extend(matching_runs(part, snapshot)?);
            }
        }
        let sizes = &files.known_sizes(snapshot).await;
        let open = |(path, run)| async move {
            let file = files.open_file(&path, sizes.get(&path).copied()).await?;
            Ok(Self { run, file })
        };
        futures::stream::iter(meant).map(open).buffered(OPENED_AT_ONCE).try_collect().await
    }
}

/// A file, and the surface and run that it is; None of a foreign one.
type Meant = (Path, Option<(String, String)>);

fn run_names(run: &VisibleRun) -> (String, String) {
    (run.surface.to_string(), run.run.to_string())
}

fn matching_runs(pattern: &str, snapshot: &LakeSnapshot) -> Result<Vec<Meant>, Fault> {
    let meant =
        |r: &&VisibleRun| matches_pattern(pattern, r.surface.as_str()) || matches_pattern(pattern, r.run.as_str());
    let found = snapshot.runs().filter(meant).map(|r| (Lake::run_path(&r.surface, &r.run), Some(run_names(r))));
    let found: Vec<_> = found.collect();
    match found.is_empty() {
        true => Err(Fault::invalid_call(
            format!("no surface and no run is called `{pattern}`"),
            format!("it may be {FORMS}"),
        )),
        false => Ok(found),
    }
}

// Only files that are named as recordings are, by the very place that they have in the lake's store.
pub(super) fn parse_path(text: &str) -> Result<Path, Fault> {
    let wrong = |why: &str| {
        Fault::invalid_call(format!("`{text}` is no file in the lake: {why}"), format!("it may be {FORMS}"))
    };
    if text.contains(['*', '?']) {
        return Err(wrong("patterns are for surfaces and runs"));
    }
    if !text.ends_with(EXTENSION) {
        return Err(wrong("its name does not end with .mcap"));
    }
    let climbs = text.split('/').any(|part| matches!(part, "" | "." | ".."));
    if climbs || text.contains(|c: char| c.is_control() || matches!(c, '\\' | '%' | ':')) {
        return Err(wrong("it is not written as a place below the lake's own"));
    }
    Path::parse(text).map_err(|e| wrong(&e.to_string()))
}

/// Whether a text is of a pattern in which `*` stands for anything and `?` for one character.
fn matches_pattern(pattern: &str, text: &str) -> bool {
    let (pattern, text): (Vec<_>, Vec<_>) = (pattern.chars().collect(), text.chars().collect());
    let mut p = 0;
    let mut t = 0;
    // The last star, and where what it stands for ends: one character more each time the rest does not fit.
    let mut star: Option<(usize, usize)> = None;
    while t < text.len() {
        match pattern.get(p) {
            Some('*') => {
                star = Some((p, t));
                p += 1;
            }
            Some(c) if *c == '?' || *c == text[t] => {
                p += 1;
                t += 1;
            }
            _ => match &mut star {
                Some((at, end)) => {
                    *end += 1;
                    (p, t) = (*at + 1, *end);
                }
                None => return false,
            },
        }
    }
    pattern[p..].iter().all(|c| *c == '*')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_match_whole_names() {
        for (pattern, text, expected) in [
            ("flat", "flat", true),
            ("flat", "flat_2", false),
            ("fl*", "flat", true),
            ("*", "", true),
            ("?", "", false),
            ("00?5_*", "0015_0", true),
            ("00?5_*", "0115_0", false),
            ("*a*b*", "xaxxbx", true),
            ("*a*b", "xaxxbx", false),
            ("", "flat", false),
        ] {
            assert_eq!(matches_pattern(pattern, text), expected, "{pattern} {text}");
        }
    }

    #[test]
    fn a_path_stays_in_the_lake() {
        assert_eq!(parse_path("inbox/a b.mcap").expect("a path").as_ref(), "inbox/a b.mcap");
        for outside in [
            "../x.mcap",
            "inbox/../../x.mcap",
            "/etc/x.mcap",
            "inbox//x.mcap",
            "./x.mcap",
            "file:///x.mcap",
            "inbox\\..\\x.mcap",
            "%2e%2e/x.mcap",
            "inbox/..%2fx.mcap",
            "lake.toml/",
            "tables/runs/a.parquet",
            "inbox/*.mcap",
            "inbox/x\0.mcap",
            "/",
        ] {
            assert!(parse_path(outside).is_err(), "{outside}");
        }
    }
}
