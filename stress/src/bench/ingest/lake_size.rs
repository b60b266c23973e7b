//! Size of a lake's tables against the same numbers without any encoding.

use std::fs::File;
use std::path::Path;

use anyhow::{Context as _, Result};
use echolake_lake::Lake;
use echolake_schema::tables::Table;
use parquet::file::metadata::ParquetMetaDataReader;

use super::super::FULL_LAKE_RESPONSES;
use super::super::report::{BenchReport, FigureGoal};
use super::parquet_files::raw_bytes;

pub(crate) async fn measure_lake_size(lake: &Lake, report: &mut BenchReport) -> Result<()> {
    let folder = lake.folder().context("the lake is no folder")?;
    let snapshot = lake.snapshot().await?;
    let mut sizes = Vec::new();
    let mut responses = 0.0;
    let mut nce = 0;
    for table in Table::ALL {
        let mut rows = 0;
        let mut bytes = 0;
        let mut raw = 0;
        for file in snapshot.files(table) {
            let file = File::open(folder.join(file.path.as_ref()))?;
            let metadata = ParquetMetaDataReader::new().parse_and_finish(&file)?;
            rows += metadata.file_metadata().num_rows();
            bytes += file.metadata()?.len();
            raw += raw_bytes(&metadata);
        }
        match table {
            Table::Measurements => responses = rows as f64,
            Table::Nce => nce = bytes,
            _ => {}
        }
        sizes.push((table, rows, bytes, raw));
    }
    report.group("Size of the lake");
    report.note(format!(
        "`tables/` of {responses} responses, logs included; scaled to the {FULL_LAKE_RESPONSES} responses of 350 \
         surfaces."
    ));
    let scale = FULL_LAKE_RESPONSES as f64 / responses.max(1.0) / 1e9;
    let raw: u64 = sizes.iter().map(|(.., raw)| raw).sum();
    report
        .figure("lake without runs, 350 surfaces", folder_bytes(&folder.join("tables"))? as f64 * scale, "GB")
        .beside("its numbers, raw", raw as f64 * scale)
        .goal(FigureGoal::AtMost(4.6));
    report.figure("`nce` of it", nce as f64 * scale, "GB");
    for (table, rows, bytes, raw) in sizes.into_iter().filter(|(_, rows, ..)| *rows > 0) {
        let name = format!("`{}`, {rows} rows", table.name());
        let each = |bytes: u64| bytes as f64 / rows as f64;
        let figure = report.figure(name, each(bytes), "B a row");
        if raw > 0 {
            figure.beside("its numbers, raw", each(raw));
        }
    }
    Ok(())
}

fn folder_bytes(folder: &Path) -> Result<u64> {
    let mut bytes = 0;
    for entry in std::fs::read_dir(folder)? {
        let (path, meta) = entry.and_then(|e| Ok((e.path(), e.metadata()?)))?;
        bytes += if meta.is_dir() { folder_bytes(&path)? } else { meta.len() };
    }
    Ok(bytes)
}
