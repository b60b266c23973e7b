//! Rows of a table by the runs that have them, read without a plan.

use std::collections::BTreeMap;
use std::ops::Range;

use arrow::array::{Array as _, AsArray as _, BooleanArray};
use arrow::compute::{concat_batches, filter_record_batch};
use arrow::datatypes::{Int32Type, SchemaRef};
use arrow::record_batch::RecordBatch;
use datafusion::error::{DataFusionError, Result};
use datafusion::physical_plan::metrics::ExecutionPlanMetricsSet;
use echolake_lake::{DataFile, Error as LakeError, LakeSnapshot};
use echolake_schema::RunId;
use echolake_schema::tables::Table;
use object_store::path::Path;

use crate::column_store::{ScanMetrics, WantedColumns, batch_of_rows};
use crate::lake_table::FileReaders;
use crate::placed_rows::read_placed_rows;
use crate::scan_files::{RUN, partitioned_file};

/// The column that tells the rows of a run apart, and in whose order they are.
pub(crate) const PAIR: &str = "pair_id";

/// A table in one snapshot, whose rows are those of runs, as its reader sees it: they are read by their places in files.
///
/// 1. The snapshot tells which files show rows of a run, and which rows of a merged file these are.
/// 2. The pairs of these rows, and other columns without lists, are those that the process has decoded.
/// 3. Of rows with lists, the pages that have them are decoded.
///
/// Of merged files the name of the run beside each row is checked: which rows are whose is said by the log alone.
pub struct RunRows<'a> {
    /// The table.
    pub table: Table,
    /// Its columns.
    pub schema: SchemaRef,
    /// The snapshot of the reader.
    pub snapshot: &'a LakeSnapshot,
    /// Readers of its files.
    pub readers: &'a FileReaders,
}

/// Rows of a run in a file.
struct RunRange<'a> {
    run: &'a RunId,
    rows: Range<u64>,
}

impl RunRows<'_> {
    /// Returns columns without lists of all rows of a run, in batches in the order of its files.
    ///
    /// # Errors
    /// The table's fault, or that of a file.
    pub async fn read_run(&self, run: &RunId, columns: &[&str]) -> Result<Vec<RecordBatch>> {
        let wanted = WantedColumns::from_names(&self.schema, columns)?;
        let mut found = Vec::new();
        for (file, ranges) in self.find_ranges(std::slice::from_ref(run))? {
            for range in ranges {
                found.extend(self.readers.columns.read_range(file, range.rows.clone(), &wanted).await?);
                // The first one, and the last one if it is another.
                let places = range.rows.start as usize..range.rows.end as usize;
                let mut ends: Vec<_> = places.clone().take(1).chain(places.last()).collect();
                ends.dedup();
                self.check_runs(file, &ends, &[run, run]).await?;
            }
        }
        Ok(found)
    }

    /// Returns columns of the rows of some pairs in some runs, in the order in which scans have them.
    ///
    /// # Errors
    /// As [`RunRows::read_run`].
    pub async fn read_pairs(&self, runs: &[RunId], pairs: &[i32], columns: &[&str]) -> Result<RecordBatch> {
        let wanted = WantedColumns::from_names(&self.schema, columns)?;
        let has_lists = wanted.schema().fields().iter().any(|field| field.data_type().is_nested());
        let stored = if has_lists { &[] } else { columns };
        let stored: Vec<_> = std::iter::once(PAIR).chain(stored.iter().copied()).collect();
        let stored = WantedColumns::from_names(&self.schema, &stored)?;
        let mut found = Vec::new();
        for (file, ranges) in self.find_ranges(runs)? {
            let mut places = Vec::new();
            let mut owners = Vec::new();
            for RunRange { run, rows } in ranges {
                let mut start = rows.start as usize;
                for batch in self.readers.columns.read_range(file, rows, &stored).await? {
                    let numbers = batch.column(0).as_primitive::<Int32Type>();
                    let is_wanted: BooleanArray =
                        numbers.iter().map(|pair| Some(pair.is_some_and(|pair| pairs.contains(&pair)))).collect();
                    places.extend(is_wanted.values().set_indices().map(|row| start + row));
                    owners.resize(places.len(), run);
                    start += batch.num_rows();
                    if !has_lists && is_wanted.true_count() > 0 {
                        let kept = filter_record_batch(&batch, &is_wanted)?;
                        let columns = kept.columns()[1..].to_vec();
                        found.push(batch_of_rows(wanted.schema(), columns, kept.num_rows())?);
                    }
                }
            }
            if has_lists && !places.is_empty() {
                found.push(self.read_places(file, &wanted, &places).await?);
            }
            self.check_runs(file, &places, &owners).await?;
        }
        Ok(concat_batches(wanted.schema(), &found)?)
    }

    // The files that show rows of these runs, with the places of these rows in order: first the files without hidden
    // rows, as scans have them.
    fn find_ranges<'b>(&'b self, runs: &'b [RunId]) -> Result<Vec<(&'b DataFile, Vec<RunRange<'b>>)>> {
        self.snapshot.check_table(self.table).map_err(|fault| DataFusionError::External(fault.into()))?;
        let mut files: BTreeMap<(bool, &Path), (&DataFile, Vec<RunRange<'b>>)> = BTreeMap::new();
        for run in runs {
            for file in self.snapshot.files_of(self.table, run) {
                let key = (!file.hidden.is_empty(), &file.path);
                let (_, ranges) = files.entry(key).or_insert_with(|| (file, Vec::new()));
                if file.parts.is_empty() {
                    ranges.push(RunRange { run, rows: 0..file.rows });
                } else {
                    let of_run = file.visible_parts().filter(|(part, _)| part.run == *run);
                    ranges.extend(of_run.map(|(_, rows)| RunRange { run, rows }));
                }
            }
        }
        let mut ordered: Vec<_> = files.into_values().collect();
        ordered.iter_mut().for_each(|(_, ranges)| ranges.sort_by_key(|range| range.rows.start));
        Ok(ordered)
    }

    async fn read_places(&self, file: &DataFile, wanted: &WantedColumns, places: &[usize]) -> Result<RecordBatch> {
        let metrics = ExecutionPlanMetricsSet::new();
        let metrics = ScanMetrics { metrics: &metrics, partition: 0 };
        let reader = self.readers.columns.open_file(&partitioned_file(file), metrics)?;
        read_placed_rows(reader, wanted, places).await
    }

    // Checks that rows of a merged file are those of their owners.
    async fn check_runs(&self, file: &DataFile, places: &[usize], owners: &[&RunId]) -> Result<()> {
        if file.parts.is_empty() || places.is_empty() {
            return Ok(());
        }
        let wanted = WantedColumns::from_names(&self.schema, &[RUN])?;
        let named = self.read_places(file, &wanted, places).await?;
        let names = named.column(0).as_string::<i32>();
        for (row, (place, run)) in places.iter().zip(owners).enumerate() {
            if names.is_null(row) || names.value(row) != run.as_str() {
                let source = format!("row {place} is not of run `{run}`, as its log says").into();
                let damaged = LakeError::DataFile { file: file.path.to_string(), source };
                return Err(DataFusionError::External(damaged.into()));
            }
        }
        Ok(())
    }
}
