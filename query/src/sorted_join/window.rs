//! The window of a join by order: the rows of one side between the beginning of the range that is looked at and the
//! last row that was needed so far.

use std::cmp::Ordering;
use std::collections::VecDeque;
use std::ops::Range;
use std::sync::Arc;

use arrow::array::{ArrayRef, BooleanArray, RecordBatch, make_comparator};
use arrow::buffer::NullBuffer;
use arrow::compute::{SortOptions, filter, filter_record_batch, not};
use arrow::datatypes::Schema;
use arrow::row::{Row, RowConverter, Rows, SortField};
use datafusion::error::Result;
use datafusion::execution::SendableRecordBatchStream;
use datafusion::execution::memory_pool::MemoryReservation;
use futures::StreamExt as _;

use super::exec::{ExprRef, KEY_OPTIONS, MergedJoin};

/// Encodes keys and a position as bytes that compare as they are sorted. A null position is behind all others of its
/// key.
#[derive(Debug)]
pub(super) struct KeyEncoder(RowConverter);

impl KeyEncoder {
    /// # Errors
    /// If an expression does not fit the columns of the window.
    pub fn try_new(join: &MergedJoin, window: &Schema) -> Result<Self> {
        let fields = join.side_keys(true).map(|key| (key, KEY_OPTIONS));
        let fields = fields.chain([(&join.position, join.position_options())]);
        let fields = fields.map(|(expr, options)| Ok(SortField::new_with_options(expr.data_type(window)?, options)));
        Ok(Self(RowConverter::new(fields.collect::<Result<_>>()?)?))
    }

    /// Encodes rows, the position being last.
    ///
    /// # Errors
    /// If the columns have other types.
    pub fn encode(&self, columns: &[ArrayRef]) -> Result<Rows> {
        Ok(self.0.convert_columns(columns)?)
    }
}

/// Rows of a side, some of which match nothing.
pub(super) struct KeyedRows {
    /// Those whose values are not null.
    pub batch: RecordBatch,
    /// Their keys, positions or bounds.
    pub values: Vec<ArrayRef>,
    /// The others.
    pub nulls: Option<RecordBatch>,
}

impl KeyedRows {
    /// Evaluates expressions over a batch.
    ///
    /// # Errors
    /// If one fails.
    pub fn from_batch<'a>(batch: RecordBatch, exprs: impl Iterator<Item = &'a ExprRef>) -> Result<Self> {
        let values = exprs.map(|expr| expr.evaluate(&batch)?.into_array(batch.num_rows()));
        let values: Vec<ArrayRef> = values.collect::<Result<_>>()?;
        let valid = values.iter().fold(None::<NullBuffer>, |valid, column| {
            NullBuffer::union(valid.as_ref(), column.logical_nulls().as_ref())
        });
        let Some(valid) = valid.filter(|valid| valid.null_count() > 0) else {
            return Ok(Self { batch, values, nulls: None });
        };
        let valid = BooleanArray::new(valid.into_inner(), None);
        let nulls = Some(filter_record_batch(&batch, &not(&valid)?)?);
        let values = values.iter().map(|column| Ok(filter(column, &valid)?)).collect::<Result<_>>()?;
        Ok(Self { batch: filter_record_batch(&batch, &valid)?, values, nulls })
    }
}

/// Returns the memory of the rows of a batch, bytes. Sorted batches may be slices of one array.
pub(super) fn held_bytes(batch: &RecordBatch, rows: &Rows) -> usize {
    let columns = batch
        .columns()
        .iter()
        .map(|column| column.to_data().get_slice_memory_size().unwrap_or_else(|_| column.get_array_memory_size()));
    columns.sum::<usize>() + rows.size()
}

/// A row of the window, by the number of its batch since the beginning.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct WindowPlace {
    pub batch: usize,
    pub row: usize,
}

/// A batch of the window.
pub(super) struct WindowBatch {
    pub rows: RecordBatch,
    pub keys: Rows,
    /// Which rows were joined; empty if nobody asks.
    pub is_joined: Vec<bool>,
    bytes: usize,
}

impl WindowBatch {
    /// Returns the first row of a range of this batch for which `is_before` is false, given that all before it are
    /// true.
    pub fn find_first(&self, rows: Range<usize>, is_before: impl Fn(Row<'_>) -> bool) -> usize {
        let Range { mut start, mut end } = rows;
        while start < end {
            let middle = start + (end - start) / 2;
            if is_before(self.keys.row(middle)) { start = middle + 1 } else { end = middle }
        }
        start
    }
}

/// The window.
pub(super) struct JoinWindow {
    pub join: Arc<MergedJoin>,
    pub encoder: Arc<KeyEncoder>,
    /// None at its end.
    input: Option<SendableRecordBatchStream>,
    batches: VecDeque<WindowBatch>,
    /// The first row that later ranges can have.
    pub head: WindowPlace,
    /// Rows that match nothing, if they are in the result.
    pub unmatched: Vec<RecordBatch>,
    memory: MemoryReservation,
}

impl JoinWindow {
    pub fn new(
        input: SendableRecordBatchStream,
        join: Arc<MergedJoin>,
        encoder: Arc<KeyEncoder>,
        memory: MemoryReservation,
    ) -> Self {
        let head = WindowPlace { batch: 0, row: 0 };
        Self { join, encoder, input: Some(input), batches: VecDeque::new(), head, unmatched: Vec::new(), memory }
    }

    /// Returns whether there are no more rows.
    pub fn is_exhausted(&self) -> bool {
        self.input.is_none() && self.batches.is_empty()
    }

    /// Returns a batch that [`JoinWindow::read_to`] has found, and that was not dropped.
    pub fn batch(&self, number: usize) -> &WindowBatch {
        &self.batches[number - self.head.batch]
    }

    /// Returns the key of a row.
    pub fn key(&self, place: WindowPlace) -> Row<'_> {
        self.batch(place.batch).keys.row(place.row)
    }

    /// Reads on until there is a batch of this number; returns false at the end.
    ///
    /// # Errors
    /// Those of the input, and if there is no memory left.
    pub async fn read_to(&mut self, number: usize) -> Result<bool> {
        while number - self.head.batch >= self.batches.len() {
            let Some(input) = &mut self.input else { return Ok(false) };
            match input.next().await {
                Some(batch) => self.add_batch(batch?)?,
                None => self.input = None,
            }
        }
        Ok(true)
    }

    fn add_batch(&mut self, batch: RecordBatch) -> Result<()> {
        let join = self.join.clone();
        let exprs = join.side_keys(true).chain([&join.position]);
        let KeyedRows { batch, values, nulls } = KeyedRows::from_batch(batch, exprs)?;
        let keeps = join.keeps_window();
        self.unmatched.extend(nulls.filter(|_| keeps));
        if batch.num_rows() == 0 {
            return Ok(());
        }
        let keys = self.encoder.encode(&values)?;
        let bytes = held_bytes(&batch, &keys);
        self.memory.try_grow(bytes)?;
        let is_joined = if keeps { vec![false; batch.num_rows()] } else { Vec::new() };
        self.batches.push_back(WindowBatch { rows: batch, keys, is_joined, bytes });
        Ok(())
    }

    /// Marks a row as joined.
    pub fn mark_joined(&mut self, place: WindowPlace) {
        if let Some(is_joined) = self.batches[place.batch - self.head.batch].is_joined.get_mut(place.row) {
            *is_joined = true;
        }
    }

    /// Drops the first batch; its rows that were not joined are [`JoinWindow::unmatched`] if they are in the result.
    ///
    /// # Errors
    /// If its rows cannot be copied.
    pub fn drop_first(&mut self) -> Result<()> {
        let Some(first) = self.batches.pop_front() else { return Ok(()) };
        self.memory.shrink(first.bytes);
        self.head = WindowPlace { batch: self.head.batch + 1, row: 0 };
        if self.join.keeps_window() {
            let unmatched = filter_record_batch(&first.rows, &not(&BooleanArray::from(first.is_joined))?)?;
            self.unmatched.extend(Some(unmatched).filter(|rows| rows.num_rows() > 0));
        }
        Ok(())
    }

    /// Returns the row after another one, which may have to be read.
    ///
    /// # Errors
    /// As [`JoinWindow::read_to`].
    pub async fn next_place(&mut self, place: WindowPlace) -> Result<Option<WindowPlace>> {
        if place.row + 1 < self.batch(place.batch).rows.num_rows() {
            return Ok(Some(WindowPlace { row: place.row + 1, ..place }));
        }
        let next = WindowPlace { batch: place.batch + 1, row: 0 };
        Ok(self.read_to(next.batch).await?.then_some(next))
    }

    /// Compares two rows by all of their columns whose values have an order.
    pub fn compare_rows(&self, a: WindowPlace, b: WindowPlace) -> Ordering {
        let [a_rows, b_rows] = [a, b].map(|place| &self.batch(place.batch).rows);
        let columns = a_rows.columns().iter().zip(b_rows.columns());
        let mut orders = columns.filter_map(|(a_column, b_column)| {
            let compare = make_comparator(a_column, b_column, SortOptions::default()).ok()?;
            Some(compare(a.row, b.row))
        });
        orders.find(|order| order.is_ne()).unwrap_or(Ordering::Equal)
    }
}
