//! Moves refused files to `quarantine/`, each with its reason beside it.

use echolake_lake::{Lake, digest_record_path};
use object_store::path::Path;
use object_store::{ObjectStoreExt as _, PutMode, PutOptions};

use super::file_state::can_have_record;
use super::run_place::{StoreFault, delete_object, move_object, write_error};
use super::run_source::RunSource;
use crate::error::{Error, Result};

/// Folder of refused files.
const QUARANTINE: &str = "quarantine";
/// End of the name of the reason beside a refused file.
const REASON: &str = ".reason.txt";
/// Maximum length of a refused file's name, bytes.
const LONGEST_NAME: usize = 200;

/// Moves a refused file of the inbox to `quarantine/`, the reason first; returns its path. Files outside the inbox
/// stay, and those that may be read later.
pub(crate) async fn quarantine_file(lake: &Lake, source: &RunSource, why: &Error) -> Result<Option<Path>> {
    let RunSource::Lake(from) = source else { return Ok(None) };
    if !source.is_in_inbox() || why.keeps_place() {
        return Ok(None);
    }
    set_file_aside(lake, from, &why.to_string()).await
}

/// Moves a file of the lake to `quarantine/`, the reason first; returns its path, or None if the file is gone.
///
/// # Errors
/// An error of the lake.
pub(crate) async fn set_file_aside(lake: &Lake, from: &Path, reason: &str) -> Result<Option<Path>> {
    let store = lake.store();
    let bytes = match store.head(from).await {
        Ok(meta) => meta.size,
        Err(object_store::Error::NotFound { .. }) => return Ok(None),
        Err(e) => return Err(write_error(from, e)),
    };
    let name = from.filename().unwrap_or("run");
    // Only the end of a long name, because the name of the reason's file is longer.
    let start = (name.len().saturating_sub(LONGEST_NAME)..name.len()).find(|at| name.is_char_boundary(*at));
    let to = reserve_name(lake, &name[start.unwrap_or(0)..], reason).await?;
    // The name is free for another upload.
    if can_have_record(from) {
        delete_object(lake, &digest_record_path(from)).await.map_err(|e| write_error(from, e))?;
    }
    match move_object(lake, from, &to, bytes, None).await {
        // Another process moved it.
        Err(StoreFault::Store(object_store::Error::NotFound { .. })) => {
            delete_object(lake, &reason_path(&to)).await.map_err(|e| write_error(&to, e))?;
            Ok(None)
        }
        moved => moved.map(|()| Some(to)).map_err(|fault| fault.into_error(from)),
    }
}

fn reason_path(refused: &Path) -> Path {
    let text = format!("{refused}{REASON}");
    // A path is encoded already.
    Path::parse(&text).unwrap_or_else(|_| Path::from(text))
}

// Of several processes that create a reason's file, one succeeds: two refused files of one name get two names.
async fn reserve_name(lake: &Lake, name: &str, reason: &str) -> Result<Path> {
    let store = lake.store();
    let mut number = 1;
    loop {
        let text = match number {
            1 => format!("{QUARANTINE}/{name}"),
            _ => format!("{QUARANTINE}/{number}-{name}"),
        };
        let path = Path::parse(&text).unwrap_or_else(|_| Path::from(text));
        number += 1;
        match store.head(&path).await {
            Err(object_store::Error::NotFound { .. }) => {}
            Err(e) => return Err(write_error(&path, e)),
            Ok(_) => continue,
        }
        let reserved = PutOptions::from(PutMode::Create);
        match store.put_opts(&reason_path(&path), format!("{reason}\n").into(), reserved).await {
            Err(object_store::Error::AlreadyExists { .. }) => {}
            Err(e) => return Err(write_error(&path, e)),
            Ok(_) => return Ok(path),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use echolake_lake::ReferenceSurfaces;
    use echolake_schema::Rig;
    use object_store::memory::InMemory;

    use super::*;

    #[tokio::test]
    async fn two_refused_files_of_one_name_get_two_names() {
        let store = Arc::new(InMemory::new());
        let (rig, references) = (Rig::paper(), ReferenceSurfaces::default());
        let lake = Lake::open_or_create_in(store.clone(), "a lake", &rig, &references).await.expect("a lake");
        let paths = ["a", "b", "c"].map(|folder| Path::from(format!("inbox/{folder}/x.mcap")));
        for path in &paths {
            store.put(path, path.to_string().into()).await.expect("written");
        }
        let [a, b, c] = &paths;
        let (a, b, c) = tokio::join!(
            set_file_aside(&lake, a, "why a"),
            set_file_aside(&lake, b, "why b"),
            set_file_aside(&lake, c, "why c")
        );
        let mut names = Vec::new();
        for (moved, letter) in [(a, "a"), (b, "b"), (c, "c")] {
            let moved = moved.expect("moved").expect("it was there");
            let text = async |path: &Path| store.get(path).await.expect("there").bytes().await.expect("bytes");
            assert_eq!(text(&moved).await, format!("inbox/{letter}/x.mcap"));
            assert_eq!(text(&reason_path(&moved)).await, format!("why {letter}\n"));
            names.push(moved.to_string());
        }
        names.sort();
        assert_eq!(names, ["quarantine/2-x.mcap", "quarantine/3-x.mcap", "quarantine/x.mcap"]);
        assert_eq!(set_file_aside(&lake, &paths[0], "again").await.expect("nothing to do"), None);
    }
}
