//! The merge of a join by order: one pass over the probe, beside the window.

use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _, BooleanArray, UInt32Array, new_null_array};
use arrow::compute::{BatchCoalescer, interleave, take};
use arrow::datatypes::SchemaRef;
use arrow::record_batch::{RecordBatch, RecordBatchOptions};
use arrow::row::{Row, Rows};
use datafusion::error::Result;
use datafusion::execution::SendableRecordBatchStream;
use datafusion::execution::memory_pool::MemoryReservation;
use datafusion::physical_plan::metrics::BaselineMetrics;
use futures::StreamExt as _;
use tokio::task::coop::consume_budget;

use super::exec::{ExprRef, MergedJoin};
use super::window::{JoinWindow, KeyEncoder, KeyedRows, WindowPlace, held_bytes};
use super::{MatchedRows, WindowSide};

/// The columns of inputs and result.
pub(super) struct MergeSides {
    pub window_schema: SchemaRef,
    /// Columns of the left.
    pub width: usize,
    /// The result's columns, among those of the left and then those of the right.
    pub projection: Vec<usize>,
    pub schema: SchemaRef,
    /// The columns of a filter, and the filter over these alone.
    pub filter: Option<(Vec<usize>, SchemaRef, ExprRef)>,
}

/// A column of an input.
enum SideColumn {
    Window(usize),
    Probe(usize),
}

impl MergeSides {
    fn column(&self, join: &MergedJoin, number: usize) -> SideColumn {
        let (is_left, index) = if number < self.width { (true, number) } else { (false, number - self.width) };
        if (join.window == WindowSide::Left) == is_left { SideColumn::Window(index) } else { SideColumn::Probe(index) }
    }
}

/// A batch of the probe.
struct ProbeBatch {
    rows: RecordBatch,
    /// Keys and beginnings of ranges.
    first: Rows,
    /// Keys and ends.
    last: Rows,
    /// The row that is joined now.
    row: usize,
    /// The row of the window with which it goes on; None before its first one.
    place: Option<WindowPlace>,
    /// Which rows were joined; empty if nobody asks.
    is_joined: Vec<bool>,
}

/// Pairs of rows that were found.
#[derive(Default)]
struct FoundPairs {
    /// Rows of the probe's batch.
    probe: Vec<u32>,
    window: Vec<WindowPlace>,
}

/// A merge of one partition.
pub(super) struct SortedMerge {
    join: Arc<MergedJoin>,
    sides: MergeSides,
    encoder: Arc<KeyEncoder>,
    /// None at its end.
    probe: Option<SendableRecordBatchStream>,
    window: JoinWindow,
    memory: MemoryReservation,
    batch_rows: usize,
    metrics: BaselineMetrics,
    current: Option<ProbeBatch>,
    pairs: FoundPairs,
    /// The nearest row of the window if its head is at this place.
    nearest: Option<(WindowPlace, WindowPlace)>,
    output: BatchCoalescer,
}

impl SortedMerge {
    pub fn new(
        sides: MergeSides,
        probe: SendableRecordBatchStream,
        window: JoinWindow,
        memory: MemoryReservation,
        batch_rows: usize,
        metrics: BaselineMetrics,
    ) -> Self {
        let output = BatchCoalescer::new(sides.schema.clone(), batch_rows);
        let output = output.with_biggest_coalesce_batch_size(Some(batch_rows / 2));
        Self {
            join: window.join.clone(),
            sides,
            encoder: window.encoder.clone(),
            probe: Some(probe),
            window,
            memory,
            batch_rows,
            metrics,
            current: None,
            pairs: FoundPairs::default(),
            nearest: None,
            output,
        }
    }

    /// Returns the next rows of the result.
    ///
    /// # Errors
    /// Those of the inputs and of the filter, and if there is no memory left.
    pub async fn next_batch(&mut self) -> Result<Option<RecordBatch>> {
        loop {
            if let Some(batch) = self.output.next_completed_batch() {
                self.metrics.record_output(batch.num_rows());
                return Ok(Some(batch));
            }
            // A query that is cancelled ends here, if no rows are found for long.
            consume_budget().await;
            if !self.step().await? {
                self.output.finish_buffered_batch()?;
                let last = self.output.next_completed_batch();
                self.metrics.record_output(last.as_ref().map_or(0, RecordBatch::num_rows));
                return Ok(last);
            }
        }
    }

    // Finds about a batch of pairs; returns false at the end.
    async fn step(&mut self) -> Result<bool> {
        let current = match self.current.take() {
            Some(current) => Some(current),
            None => self.read_probe().await?,
        };
        let Some(mut probe) = current else { return self.drain_window().await };
        self.find_pairs(&mut probe).await?;
        self.flush_pairs(&mut probe)?;
        if probe.row < probe.rows.num_rows() {
            self.current = Some(probe);
        } else if self.join.keeps_probe() {
            let unmatched = (0..).zip(&probe.is_joined).filter(|(_, is_joined)| !**is_joined).map(|(row, _)| row);
            let unmatched = FoundPairs { probe: unmatched.collect(), window: Vec::new() };
            self.push_rows(&probe.rows, &unmatched)?;
        }
        self.push_unmatched()?;
        Ok(true)
    }

    // Rows of the window that were not joined are in the result of some joins.
    async fn drain_window(&mut self) -> Result<bool> {
        if !self.join.keeps_window() {
            return Ok(false);
        }
        let is_more = self.window.read_to(self.window.head.batch).await?;
        self.window.drop_first()?;
        self.push_unmatched()?;
        Ok(is_more)
    }

    async fn read_probe(&mut self) -> Result<Option<ProbeBatch>> {
        let join = self.join.clone();
        // What is left of the probe would match nothing.
        if self.window.is_exhausted() && !join.keeps_probe() {
            self.probe = None;
        }
        while let Some(input) = &mut self.probe {
            let Some(batch) = input.next().await else { break };
            let bounds = [&join.first].into_iter().chain(&join.last).map(|bound| &bound.expr);
            let KeyedRows { batch, mut values, nulls } =
                KeyedRows::from_batch(batch?, join.side_keys(false).chain(bounds))?;
            if let Some(nulls) = nulls.filter(|_| join.keeps_probe()) {
                let all = FoundPairs { probe: (0..nulls.num_rows() as u32).collect(), window: Vec::new() };
                self.push_rows(&nulls, &all)?;
            }
            if batch.num_rows() == 0 {
                consume_budget().await;
                continue;
            }
            let last = join.last.as_ref().and_then(|_| values.pop());
            let first = self.encoder.encode(&values)?;
            // A null is behind all positions of the key.
            let end = values.pop().map(|first| new_null_array(first.data_type(), first.len()));
            values.extend(last.or(end));
            let last = self.encoder.encode(&values)?;
            self.memory.try_resize(held_bytes(&batch, &first) + last.size())?;
            let is_joined = if join.keeps_probe() { vec![false; batch.num_rows()] } else { Vec::new() };
            return Ok(Some(ProbeBatch { rows: batch, first, last, row: 0, place: None, is_joined }));
        }
        self.probe = None;
        Ok(None)
    }

    // Goes through the probe's batch until enough pairs are found.
    async fn find_pairs(&mut self, probe: &mut ProbeBatch) -> Result<()> {
        while probe.row < probe.rows.num_rows() {
            let mut place = match probe.place.take() {
                Some(place) => place,
                None => {
                    self.move_head(probe).await?;
                    self.window.head
                }
            };
            if self.join.matched == MatchedRows::Nearest {
                if let Some(nearest) = self.find_nearest(probe).await? {
                    self.pairs.probe.push(probe.row as u32);
                    self.pairs.window.push(nearest);
                }
            } else {
                let is_strict = self.join.last.as_ref().is_some_and(|last| last.is_strict);
                let last = probe.last.row(probe.row);
                while self.window.read_to(place.batch).await? {
                    let batch = self.window.batch(place.batch);
                    let end = batch.find_first(place.row..batch.rows.num_rows(), |key| is_within(key, last, is_strict));
                    let is_last = end < batch.rows.num_rows();
                    let taken = (end - place.row).min(self.batch_rows - self.pairs.probe.len());
                    self.pairs.probe.extend(std::iter::repeat_n(probe.row as u32, taken));
                    let rows = place.row..place.row + taken;
                    self.pairs.window.extend(rows.map(|row| WindowPlace { row, ..place }));
                    place.row += taken;
                    if place.row < end {
                        probe.place = Some(place);
                        return Ok(());
                    }
                    if is_last {
                        break;
                    }
                    place = WindowPlace { batch: place.batch + 1, row: 0 };
                }
            }
            probe.row += 1;
            if self.pairs.probe.len() >= self.batch_rows {
                return Ok(());
            }
        }
        Ok(())
    }

    // Moves the window's head to the first row of the range.
    async fn move_head(&mut self, probe: &mut ProbeBatch) -> Result<()> {
        let is_strict = self.join.first.is_strict;
        while self.window.read_to(self.window.head.batch).await? {
            let batch = self.window.batch(self.window.head.batch);
            let count = batch.rows.num_rows();
            let first = probe.first.row(probe.row);
            let head = self.window.head.row;
            // The next one is often it.
            let is_before = |key: Row<'_>| is_within(key, first, !is_strict);
            let row = match is_before(batch.keys.row(head)) {
                true => batch.find_first(head + 1..count, is_before),
                false => head,
            };
            if row < count {
                self.window.head.row = row;
                return Ok(());
            }
            self.flush_pairs(probe)?;
            self.window.drop_first()?;
        }
        Ok(())
    }

    async fn find_nearest(&mut self, probe: &ProbeBatch) -> Result<Option<WindowPlace>> {
        let head = self.window.head;
        if !self.window.read_to(head.batch).await? || self.window.key(head) > probe.last.row(probe.row) {
            return Ok(None);
        }
        if let Some((_, nearest)) = self.nearest.filter(|(of, _)| *of == head) {
            return Ok(Some(nearest));
        }
        let mut nearest = head;
        let mut place = head;
        while let Some(next) = self.window.next_place(place).await? {
            if self.window.key(next) != self.window.key(head) {
                break;
            }
            if self.window.compare_rows(next, nearest).is_lt() {
                nearest = next;
            }
            place = next;
        }
        self.nearest = Some((head, nearest));
        Ok(Some(nearest))
    }

    // Adds the pairs that were found to the result, if they pass the filter.
    fn flush_pairs(&mut self, probe: &mut ProbeBatch) -> Result<()> {
        if self.pairs.probe.is_empty() {
            return Ok(());
        }
        let mut pairs = std::mem::take(&mut self.pairs);
        if let Some((columns, schema, filter)) = &self.sides.filter {
            let values = self.gather_columns(&probe.rows, &pairs, columns)?;
            let passed = filter.evaluate(&RecordBatch::try_new(schema.clone(), values)?)?;
            let passed = passed.into_array(pairs.probe.len())?;
            pairs.keep(passed.as_boolean());
        }
        if self.join.keeps_probe() {
            pairs.probe.iter().for_each(|row| probe.is_joined[*row as usize] = true);
        }
        if self.join.keeps_window() {
            pairs.window.iter().for_each(|place| self.window.mark_joined(*place));
        }
        self.push_rows(&probe.rows, &pairs)?;
        pairs.clear();
        self.pairs = pairs;
        Ok(())
    }

    // Adds rows of the window that were dropped without a match.
    fn push_unmatched(&mut self) -> Result<()> {
        for rows in std::mem::take(&mut self.window.unmatched) {
            let columns = self.sides.projection.iter().zip(self.sides.schema.fields());
            let columns = columns.map(|(number, field)| match self.sides.column(&self.join, *number) {
                SideColumn::Window(index) => rows.column(index).clone(),
                SideColumn::Probe(_) => new_null_array(field.data_type(), rows.num_rows()),
            });
            let columns = columns.collect();
            self.push_columns(columns, rows.num_rows())?;
        }
        Ok(())
    }

    // Adds pairs to the result; without rows of the window they are rows of the probe without a match.
    fn push_rows(&mut self, probe: &RecordBatch, pairs: &FoundPairs) -> Result<()> {
        if pairs.probe.is_empty() {
            return Ok(());
        }
        let columns = self.gather_columns(probe, pairs, &self.sides.projection)?;
        self.push_columns(columns, pairs.probe.len())
    }

    fn push_columns(&mut self, columns: Vec<ArrayRef>, rows: usize) -> Result<()> {
        let options = RecordBatchOptions::new().with_row_count(Some(rows));
        let batch = RecordBatch::try_new_with_options(self.sides.schema.clone(), columns, &options)?;
        Ok(self.output.push_batch(batch)?)
    }

    fn gather_columns(&self, probe: &RecordBatch, pairs: &FoundPairs, columns: &[usize]) -> Result<Vec<ArrayRef>> {
        let probe_rows = UInt32Array::from_iter_values(pairs.probe.iter().copied());
        let window_rows = WindowRows::of_pairs(&self.window, &pairs.window);
        let gather = |number: &usize| match (self.sides.column(&self.join, *number), &window_rows) {
            (SideColumn::Probe(index), _) => Ok(take(probe.column(index), &probe_rows, None)?),
            (SideColumn::Window(index), Some(rows)) => rows.gather_column(index),
            (SideColumn::Window(index), None) => {
                Ok(new_null_array(self.sides.window_schema.field(index).data_type(), pairs.probe.len()))
            }
        };
        columns.iter().map(gather).collect()
    }
}

/// Rows of the window, of one batch or of several in a row.
enum WindowRows<'a> {
    One(&'a RecordBatch, UInt32Array),
    Several(Vec<&'a RecordBatch>, Vec<(usize, usize)>),
}

impl<'a> WindowRows<'a> {
    // None if there are none.
    fn of_pairs(window: &'a JoinWindow, places: &[WindowPlace]) -> Option<Self> {
        let first = places.iter().map(|place| place.batch).min()?;
        let last = places.iter().map(|place| place.batch).max()?;
        if first == last {
            let rows = places.iter().map(|place| place.row as u32);
            return Some(Self::One(&window.batch(first).rows, UInt32Array::from_iter_values(rows)));
        }
        let batches = (first..=last).map(|number| &window.batch(number).rows).collect();
        Some(Self::Several(batches, places.iter().map(|place| (place.batch - first, place.row)).collect()))
    }

    fn gather_column(&self, index: usize) -> Result<ArrayRef> {
        match self {
            Self::One(batch, rows) => Ok(take(batch.column(index), rows, None)?),
            Self::Several(batches, rows) => {
                let columns: Vec<_> = batches.iter().map(|batch| batch.column(index).as_ref()).collect();
                Ok(interleave(&columns, rows)?)
            }
        }
    }
}

// Whether a key is before a bound, or at one that is not strict.
fn is_within(key: Row<'_>, bound: Row<'_>, is_strict: bool) -> bool {
    if is_strict { key < bound } else { key <= bound }
}

impl FoundPairs {
    fn keep(&mut self, passed: &BooleanArray) {
        let is_kept = |row: usize| passed.is_valid(row) && passed.value(row);
        let mut row = 0..;
        self.probe.retain(|_| row.next().is_some_and(is_kept));
        let mut row = 0..;
        self.window.retain(|_| row.next().is_some_and(is_kept));
    }

    fn clear(&mut self) {
        self.probe.clear();
        self.window.clear();
    }
}
