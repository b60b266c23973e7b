//! Lakes without runs: they depend on no rig, and nothing is lost with them.

use std::path::Path as FsPath;

use futures::TryStreamExt as _;
use object_store::path::Path;
use object_store::{ObjectMeta, ObjectStoreExt as _};

use crate::location_text::object_text;
use crate::{Error, Lake, Result};

/// Folder of the tables.
const TABLES: &str = "tables";
/// Tables that are made from the rig alone.
const RIG_TABLES: [&str; 2] = ["points", "pairs"];

/// Returns whether a lake holds no runs, no recordings and no rows of runs.
///
/// # Errors
/// [`Error::Store`].
pub(crate) async fn is_unused(lake: &Lake) -> Result<bool> {
    let used = |meta: &ObjectMeta| {
        let parts: Vec<_> = meta.location.parts().collect();
        match parts.iter().map(AsRef::as_ref).collect::<Vec<_>>().as_slice() {
            ["runs" | "inbox" | "annotations" | "predictions", ..] => true,
            [TABLES, table, ..] => meta.location.extension() == Some("parquet") && !RIG_TABLES.contains(table),
            _ => false,
        }
    };
    Ok(!list_objects(lake, None).await?.iter().any(used))
}

/// Deletes all tables.
///
/// # Errors
/// [`Error::Store`].
pub(crate) async fn delete_tables(lake: &Lake) -> Result<()> {
    for meta in list_objects(lake, Some(&Path::from(TABLES))).await? {
        let failed = |e| Error::store_failure("delete", object_text(lake.location(), &meta.location), e);
        lake.store().delete(&meta.location).await.map_err(failed)?;
    }
    Ok(())
}

/// Removes the empty folders below a folder.
pub(crate) fn remove_empty_folders(folder: &FsPath) {
    let Ok(entries) = std::fs::read_dir(folder) else { return };
    for entry in entries.flatten().filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir())) {
        remove_empty_folders(&entry.path());
        // The system refuses a folder that holds something.
        let _ = std::fs::remove_dir(entry.path());
    }
}

async fn list_objects(lake: &Lake, below: Option<&Path>) -> Result<Vec<ObjectMeta>> {
    lake.store().list(below).try_collect().await.map_err(|e| Error::store_failure("list", lake.location(), e))
}
