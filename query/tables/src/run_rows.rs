//! Rows of a table by the runs that have them, read without a plan.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _, UInt32Array};
use arrow::compute::{concat_batches, take_record_batch};
use arrow::datatypes::{Int32Type, Schema, SchemaRef};
use arrow::record_batch::RecordBatch;
use datafusion::error::{DataFusionError, Result};
use datafusion::physical_plan::metrics::ExecutionPlanMetricsSet;
use echolake_lake::{DataFile, Error as LakeError, LakeSnapshot};
use echolake_schema::RunId;
use echolake_schema::tables::Table;
use object_store::path::Path;

use crate::column_store::{ScanMetrics, StoreRoom, WantedColumns, batch_of_rows};
use crate::lake_table::FileReaders;
use crate::placed_rows::read_placed_rows;
use crate::scan_files::{RUN, partitioned_file};

/// The column that tells the rows of a run apart, and in whose order they are.
pub(crate) const PAIR: &str = "pair_id";

/// A table in one snapshot, whose rows are those of runs, as its reader sees it: they are read by their places in files.
///
/// 1. The snapshot tells which files show rows of a run, and which rows of a merged file these are.
/// 2. The pairs beside these rows, which the process keeps decoded, tell which rows are wanted.
/// 3. Of other columns, the pages that have the rows are decoded; those of runs that many ask for are kept, too.
///
/// Of merged files the name of the run beside each row is checked, once: the log alone says which rows are whose.
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

/// Reading of rows of pairs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RowReading {
    /// The pages that have them are decoded each time, unless all their columns are kept, or have room.
    Places,
    /// All rows of their runs are decoded and kept, if there is room: they are a reference's, which all surfaces share.
    Kept,
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
            self.check_owners(file, &ranges).await?;
            for range in ranges {
                found.extend(self.readers.columns.read_range(file, range.rows, &wanted).await?);
            }
        }
        Ok(found)
    }

    /// Returns columns of the rows of some pairs in some runs, in the order in which scans have them.
    ///
    /// # Errors
    /// As [`RunRows::read_run`].
    pub async fn read_pairs(
        &self,
        runs: &[RunId],
        pairs: &[i32],
        columns: &[&str],
        reading: RowReading,
    ) -> Result<RecordBatch> {
        let wanted = WantedColumns::from_names(&self.schema, columns)?;
        let stored = PairColumns::new(&self.schema, columns, RowReading::Kept)?;
        let placed = PairColumns::new(&self.schema, columns, RowReading::Places)?;
        let has_lists = wanted.schema().fields().iter().any(|field| field.data_type().is_nested());
        let mut found = Vec::new();
        for (file, ranges) in self.find_ranges(runs)? {
            self.check_owners(file, &ranges).await?;
            for RunRange { rows, .. } in ranges {
                let room = match reading {
                    RowReading::Kept => StoreRoom::Share,
                    RowReading::Places if has_lists => StoreRoom::None,
                    RowReading::Places => StoreRoom::Free,
                };
                let has_room = self.readers.columns.has_room(file, rows.clone(), &stored.stored, room).await?;
                let columns = if has_room { &stored } else { &placed };
                if let Some(rows) = self.read_range_pairs(file, rows, pairs, columns).await? {
                    found.push(batch_of_rows(wanted.schema(), columns.in_order(&rows), rows.num_rows())?);
                }
            }
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

    // The stored columns of some pairs, then those of the pages that have these rows; None if there is no such row.
    async fn read_range_pairs(
        &self,
        file: &DataFile,
        rows: Range<u64>,
        pairs: &[i32],
        columns: &PairColumns,
    ) -> Result<Option<RecordBatch>> {
        let mut start = rows.start as usize;
        let mut places = Vec::new();
        let mut kept = Vec::new();
        for batch in self.readers.columns.read_range(file, rows, &columns.stored).await? {
            let numbers = batch.column(0).as_primitive::<Int32Type>();
            let is_wanted = |row: &usize| numbers.is_valid(*row) && pairs.contains(&numbers.value(*row));
            let rows: Vec<_> = (0..batch.num_rows()).filter(is_wanted).collect();
            if !rows.is_empty() {
                places.extend(rows.iter().map(|row| start + row));
                let rows = UInt32Array::from_iter_values(rows.into_iter().map(|row| row as u32));
                kept.push(take_record_batch(&batch, &rows)?);
            }
            start += batch.num_rows();
        }
        let Some(schema) = kept.first().map(RecordBatch::schema) else { return Ok(None) };
        let stored = concat_batches(&schema, &kept)?;
        let Some(placed) = &columns.placed else { return Ok(Some(stored)) };
        let placed = self.read_places(file, placed, &places).await?;
        let fields = [schema.fields().as_ref(), placed.schema().fields().as_ref()].concat();
        let all = [stored.columns(), placed.columns()].concat();
        Ok(Some(batch_of_rows(&Arc::new(Schema::new(fields)), all, places.len())?))
    }

    async fn read_places(&self, file: &DataFile, wanted: &WantedColumns, places: &[usize]) -> Result<RecordBatch> {
        let metrics = ExecutionPlanMetricsSet::new();
        let metrics = ScanMetrics { metrics: &metrics, partition: 0 };
        let reader = self.readers.columns.open_file(&partitioned_file(file), metrics)?;
        read_placed_rows(reader, wanted, places).await
    }

    // Checks that these rows of a merged file are those of their runs, unless it was done before.
    async fn check_owners(&self, file: &DataFile, ranges: &[RunRange<'_>]) -> Result<()> {
        if file.parts.is_empty() {
            return Ok(());
        }
        let wanted = WantedColumns::from_names(&self.schema, &[RUN])?;
        for RunRange { run, rows } in ranges {
            if self.readers.columns.is_owner_known(&file.path, run, rows) {
                continue;
            }
            let places: Vec<_> = (rows.start as usize..rows.end as usize).collect();
            let named = self.read_places(file, &wanted, &places).await?;
            let mut names = named.column(0).as_string::<i32>().iter();
            if let Some(row) = names.position(|name| name != Some(run.as_str())) {
                let source = format!("row {} is not of run `{run}`, as its log says", places[row]).into();
                let damaged = LakeError::DataFile { file: file.path.to_string(), source };
                return Err(DataFusionError::External(damaged.into()));
            }
            self.readers.columns.note_owner(&file.path, run, rows);
        }
        Ok(())
    }
}

/// Wanted columns of pairs, by their reading.
struct PairColumns {
    /// Columns that the process keeps: the pairs first.
    stored: WantedColumns,
    /// Columns whose pages are decoded.
    placed: Option<WantedColumns>,
    /// For each wanted column its place in those that are stored and then placed.
    places: Vec<usize>,
}

impl PairColumns {
    fn new(schema: &SchemaRef, columns: &[&str], reading: RowReading) -> Result<Self> {
        let others = columns.iter().copied().filter(|name| *name != PAIR);
        let (placed, mut stored): (Vec<_>, Vec<_>) = others.partition(|_| reading == RowReading::Places);
        stored.insert(0, PAIR);
        let all = [&*stored, &placed].concat();
        Ok(Self {
            stored: WantedColumns::from_names(schema, &stored)?,
            placed: (!placed.is_empty()).then(|| WantedColumns::from_names(schema, &placed)).transpose()?,
            places: columns.iter().filter_map(|name| all.iter().position(|known| known == name)).collect(),
        })
    }

    fn in_order(&self, rows: &RecordBatch) -> Vec<ArrayRef> {
        self.places.iter().map(|place| rows.column(*place).clone()).collect()
    }
}
