//! Reads rows back from the lake, for ingest itself.

use arrow::array::{Array as _, AsArray as _};
use arrow::compute::concat_batches;
use arrow::datatypes::{Float32Type, Float64Type, Int32Type};
use arrow::record_batch::RecordBatch;
use echolake_dsp::air::AirState;
use echolake_lake::{DataFile, Lake, LakeSnapshot, add_missing_columns, reader_metadata, wanted_schema};
use echolake_schema::RunId;
use echolake_schema::tables::Table;
use futures::TryStreamExt as _;
use object_store::ObjectStoreExt as _;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::{ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReaderBuilder};

use crate::derived_values::RunResponses;
use crate::error::{Error, Result};

/// Columns of `measurements` that responses are read from.
const COLUMNS: [&str; 5] = ["pair_id", "temperature_c", "humidity_pct", "pressure_hpa", "ir"];

/// Reads a run's impulse responses from `measurements`.
pub(crate) async fn read_responses(lake: &Lake, snapshot: &LakeSnapshot, run: &RunId) -> Result<RunResponses> {
    // References without all of their measurements would be others.
    if snapshot.lacking_rows(Table::Measurements).iter().any(|lacking| lacking.run == *run) {
        snapshot.check_table(Table::Measurements)?;
    }
    let mut out = RunResponses::default();
    let files: Vec<_> = snapshot.files_of(Table::Measurements, run).cloned().collect();
    for file in files {
        for batch in rows_of_run(lake, Table::Measurements, &file, run, &COLUMNS).await? {
            let lost = |what: &str| Error::DataFile { file: file.path.to_string(), reason: format!("no `{what}`") };
            let pairs = batch.column_by_name("pair_id").ok_or_else(|| lost("pair_id"))?.as_primitive::<Int32Type>();
            let [celsius, humidity, pressure] = ["temperature_c", "humidity_pct", "pressure_hpa"].map(|name| {
                let column = batch.column_by_name(name).ok_or_else(|| lost(name))?;
                Ok::<_, Error>(column.as_primitive::<Float64Type>().iter().map(|x| x.unwrap_or(f64::NAN)))
            });
            let airs = celsius?.zip(humidity?).zip(pressure?);
            out.airs.extend(
                airs.map(|((celsius, humidity), pressure)| {
                    AirState::with_known(celsius, Some(humidity), Some(pressure))
                }),
            );
            let irs = batch.column_by_name("ir").ok_or_else(|| lost("ir"))?.as_list::<i32>();
            let from = irs.value_offsets()[0] as usize;
            let to = irs.value_offsets()[irs.len()] as usize;
            out.pairs.extend(pairs.values().iter().map(|p| *p as u32));
            out.irs.extend_from_slice(&irs.values().as_primitive::<Float32Type>().values()[from..to]);
        }
    }
    if out.irs.len() != out.pairs.len() * lake.rig().impulse_response.length {
        let reason = "its responses do not have the lake's length".to_owned();
        return Err(Error::DataFile { file: format!("tables/measurements, run {run}"), reason });
    }
    Ok(out)
}

/// Reads a run's rows from a file that shows them. A file of this run alone is read and checked as a whole; of a file
/// of several runs only the run's pages are read.
pub(crate) async fn rows_of_run(
    lake: &Lake,
    table: Table,
    file: &DataFile,
    run: &RunId,
    columns: &[&str],
) -> Result<Vec<RecordBatch>> {
    let place = file.visible_parts().find(|(part, _)| part.run == *run).map(|(_, rows)| rows);
    match place {
        Some(rows) => Ok(lake.read_rows(table, file, columns, rows).await?.try_collect().await?),
        None => read_batches(lake, table, file, columns).await,
    }
}

/// Reads a run's row of `runs` from a file that shows it.
pub(crate) async fn run_row(lake: &Lake, file: &DataFile, run: &RunId) -> Result<RecordBatch> {
    let batches = rows_of_run(lake, Table::Runs, file, run, &[]).await?;
    concat_batches(&Table::Runs.schema(lake.rig()), &batches)
        .map_err(|e| Error::DataFile { file: file.path.to_string(), reason: e.to_string() })
}

/// Reads the named columns of a file; all if `columns` is empty.
pub(crate) async fn read_batches(
    lake: &Lake,
    table: Table,
    file: &DataFile,
    columns: &[&str],
) -> Result<Vec<RecordBatch>> {
    let damaged = |reason: String| Error::DataFile { file: file.path.to_string(), reason };
    let bytes = async { lake.store().get(&file.path).await?.bytes().await };
    let bytes = bytes.await.map_err(|e| echolake_lake::Error::unread_file(&file.path, e))?;
    if bytes.len() as u64 != file.bytes {
        return Err(damaged(format!("it has {} bytes, its log says {}", bytes.len(), file.bytes)));
    }
    let schema = table.schema(lake.rig());
    let metadata = ArrowReaderMetadata::load(&bytes, ArrowReaderOptions::new())
        .and_then(|metadata| reader_metadata(metadata.metadata().clone(), &schema))
        .map_err(|e| damaged(e.to_string()))?;
    let builder = ParquetRecordBatchReaderBuilder::new_with_metadata(bytes, metadata);
    let mask = match columns {
        [] => ProjectionMask::all(),
        some => ProjectionMask::columns(builder.parquet_schema(), some.iter().copied()),
    };
    let reader = builder.with_projection(mask).build().map_err(|e| damaged(e.to_string()))?;
    let wanted = wanted_schema(&schema, columns);
    let complete = |batch: std::result::Result<RecordBatch, _>| batch.and_then(|b| add_missing_columns(&b, &wanted));
    reader.map(complete).collect::<std::result::Result<_, _>>().map_err(|e| damaged(e.to_string()))
}
