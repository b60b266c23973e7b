//! Size of a lake's tables against the same numbers without any encoding.

use std::path::Path;

use anyhow::Result;
use echolake_schema::tables::Table;
use parquet::basic::Type;
use parquet::file::metadata::{ParquetMetaData, ParquetMetaDataReader};

use super::parquet_files::{StoredTableFile, raw_bytes};
use super::report::{FigureGoal, FigureReport};
use super::simulated::IngestedLake;

pub(crate) fn measure_lake_size(
    ingested: &IngestedLake,
    files: &[StoredTableFile],
    report: &mut FigureReport,
) -> Result<()> {
    report.title("Size of tables/, logs included, against the same numbers as raw f32 and f64")?;
    report.line(&format!("{:<14} {:>9} {:>12} {:>12} {:>8}", "table", "rows", "bytes a row", "raw a row", "ratio"))?;
    let mut all_raw = 0;
    let mut all_arrays = 0;
    // Much of what is derived of the references is zero.
    let mut panels_bytes = 0;
    let mut panels_raw = 0;
    for table in Table::ALL {
        let mut rows = 0;
        let mut bytes = 0;
        let mut raw = 0;
        for file in files.iter().filter(|f| f.table == table) {
            let metadata = ParquetMetaDataReader::new().parse_and_finish(&file.bytes)?;
            rows += metadata.file_metadata().num_rows();
            bytes += file.bytes.len();
            raw += raw_bytes(&metadata);
            if !file.of_reference {
                panels_bytes += file.bytes.len();
                panels_raw += raw_bytes(&metadata);
            }
            all_arrays += array_bytes(&metadata);
        }
        all_raw += raw;
        if rows > 0 {
            let each = |bytes: f64| bytes / rows as f64;
            let ratio = if raw == 0 { "-".into() } else { format!("{:.1} %", 100.0 * bytes as f64 / raw as f64) };
            let a = each(bytes as f64);
            let b = each(raw as f64);
            report.line(&format!("{:<14} {rows:>9} {a:>12.1} {b:>12.1} {ratio:>8}", table.name()))?;
        }
    }
    let tables = folder_bytes(&ingested.folder.join("tables"))? as f64;
    report.figure("tables/", tables / 1e6, "MB")?;
    report.figure("its arrays and other numbers, raw", all_raw as f64 / 1e6, "MB")?;
    report.goal(
        "tables/ / its arrays and other numbers, raw",
        100.0 * tables / all_raw as f64,
        "%",
        FigureGoal::AtMost(80.0),
    )?;
    let panels = 100.0 * panels_bytes as f64 / panels_raw as f64;
    report.goal("the same of the runs that are no references", panels, "%", FigureGoal::AtMost(80.0))?;
    report.figure("tables/ / its f32 arrays alone, raw", 100.0 * tables / all_arrays as f64, "%")
}

// The lists' values alone.
fn array_bytes(metadata: &ParquetMetaData) -> u64 {
    let columns = metadata.row_groups().iter().flat_map(|group| group.columns());
    let arrays = columns.filter(|c| c.column_descr().max_rep_level() > 0 && c.column_type() == Type::FLOAT);
    arrays.map(|c| 4 * c.num_values() as u64).sum()
}

fn folder_bytes(folder: &Path) -> Result<u64> {
    let mut bytes = 0;
    for entry in std::fs::read_dir(folder)? {
        let (path, meta) = entry.and_then(|e| Ok((e.path(), e.metadata()?)))?;
        bytes += if meta.is_dir() { folder_bytes(&path)? } else { meta.len() };
    }
    Ok(bytes)
}
