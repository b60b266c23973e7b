//! Copies of a lake's tables in files of one run each.

use std::fs::File;
use std::io::Write as _;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context as _, Result};
use arrow::record_batch::RecordBatch;
use echolake_lake::{DataFile, Lake, encode_batches};
use echolake_schema::tables::Table;
use futures::{StreamExt as _, TryStreamExt as _};

/// Files that are written at once.
const COPIES_AT_ONCE: usize = 2;

/// Writes the rows of each run that shares a file into a file of their own, encoded as ingest encodes it; other files
/// are taken as they are. Returns the files of each table.
///
/// # Errors
/// The lake is in no folder, a file of it cannot be read, or the copies cannot be written.
pub(super) async fn write_run_files(lake: &Lake, folder: &Path) -> Result<Vec<(String, Vec<String>)>> {
    let own = lake.folder().context("the peer reads lakes in folders")?;
    let snapshot = lake.snapshot().await?;
    let mut tables = Vec::new();
    for table in Table::ALL {
        let mut paths = Vec::new();
        let mut copies = Vec::new();
        for file in snapshot.files(table) {
            if file.parts.is_empty() {
                paths.push(own.join(file.path.as_ref()).display().to_string());
            }
            for (part, rows) in file.visible_parts() {
                let path = folder.join(format!("{}.{}.parquet", table.name(), part.run));
                paths.push(path.display().to_string());
                let (lake, file) = (lake.clone(), file.clone());
                copies.push(async move { tokio::spawn(write_rows(lake, table, file, rows, path)).await? });
            }
        }
        futures::stream::iter(copies).buffer_unordered(COPIES_AT_ONCE).try_collect::<()>().await?;
        if !paths.is_empty() {
            tables.push((table.name().to_owned(), paths));
        }
    }
    Ok(tables)
}

async fn write_rows(lake: Lake, table: Table, file: Arc<DataFile>, rows: Range<u64>, path: PathBuf) -> Result<()> {
    let rows: Vec<RecordBatch> = lake.read_rows(table, &file, &[], rows).await?.try_collect().await?;
    let encoded = encode_batches(table, &table.schema(lake.rig()), &rows)?;
    let mut copy = File::create_new(&path)?;
    encoded.byte_blocks().iter().try_for_each(|block| copy.write_all(block))?;
    Ok(())
}
