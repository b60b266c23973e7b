//! Rows under construction: what is known of every message, and what its decoder makes of it.

use std::collections::VecDeque;
use std::sync::Arc;

use arrow::array::{ArrayRef, new_null_array};
use arrow::datatypes::{DataType, Field, SchemaRef};
use arrow::error::ArrowError;
use arrow::record_batch::{RecordBatch, RecordBatchOptions};
use echolake_recording::MessageHeader;

use super::column::{Column, time_type};
use super::encodings::{Malformed, MessageLayout, RowDecoder};

/// Bytes that the rows of a batch take, roughly. Batches of this size are allocated in the memory of earlier ones; for
/// larger ones the allocator takes new pages, which the system clears.
const BATCH_BYTES: usize = 512 << 10;

/// A column that every message has, whatever its schema.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Head {
    Surface,
    Run,
    Topic,
    Time,
    TimeNanos,
    Published,
    Sequence,
    Size,
    Data,
}

impl Head {
    /// Those in front of a message's own columns.
    pub const OF_COLUMNS: [Self; 6] =
        [Self::Surface, Self::Run, Self::Time, Self::TimeNanos, Self::Published, Self::Sequence];
    /// Those of messages that are given as they are.
    pub const OF_MESSAGES: [Self; 9] = [
        Self::Surface,
        Self::Run,
        Self::Topic,
        Self::Time,
        Self::TimeNanos,
        Self::Published,
        Self::Sequence,
        Self::Size,
        Self::Data,
    ];

    pub fn column_field(self) -> Field {
        match self {
            Self::Surface => Field::new("surface_id", DataType::Utf8, true),
            Self::Run => Field::new("run_id", DataType::Utf8, true),
            Self::Topic => Field::new("topic", DataType::Utf8, false),
            Self::Time => Field::new("log_time", time_type(), true),
            Self::TimeNanos => Field::new("log_time_ns", DataType::Int64, true),
            Self::Published => Field::new("publish_time", time_type(), true),
            Self::Sequence => Field::new("sequence", DataType::Int64, false),
            Self::Size => Field::new("size", DataType::Int64, false),
            Self::Data => Field::new("data", DataType::Binary, false),
        }
    }
}

/// A message and where it comes from.
pub(super) struct Message<'a> {
    pub run: Option<&'a (String, String)>,
    pub topic: &'a str,
    pub header: &'a MessageHeader,
    pub data: &'a [u8],
}

/// A schema of some files, and where the table's own columns are in it.
#[derive(Debug, Clone)]
pub(super) struct Mapping {
    pub layout: Arc<MessageLayout>,
    /// For each column of the messages in the table, its place in the layout.
    pub columns: Vec<Option<usize>>,
}

/// Makes batches of messages.
pub(super) struct Rows {
    /// What is asked for, in its order.
    schema: SchemaRef,
    output: Vec<Output>,
    heads: Vec<(Head, Column)>,
    /// The schema that rows are decoded with now; another one begins another batch.
    current: Option<Current>,
    count: usize,
    bytes: usize,
    most: usize,
    /// Values that are null because they are not of their column's type.
    unfit: usize,
    ready: VecDeque<RecordBatch>,
}

struct Current {
    mapping: usize,
    decoder: RowDecoder,
    /// Which columns of the output it has.
    has: Vec<bool>,
}

#[derive(Debug, Clone, Copy)]
enum Output {
    Head(usize),
    /// A message's own column, by its place among those of the table.
    Own(usize),
}

impl Rows {
    /// Rows with some of the columns of a table that begins with `heads`.
    pub fn new(schema: SchemaRef, heads: &[Head], projection: &[usize], most: usize) -> Self {
        let mut output = Vec::new();
        let mut wanted = Vec::new();
        for place in projection {
            match heads.get(*place) {
                Some(head) => {
                    output.push(Output::Head(wanted.len()));
                    wanted.push((*head, Column::new(head.column_field().data_type())));
                }
                None => output.push(Output::Own(place - heads.len())),
            }
        }
        Self {
            schema,
            output,
            heads: wanted,
            current: None,
            count: 0,
            bytes: 0,
            most,
            unfit: 0,
            ready: VecDeque::new(),
        }
    }

    /// Adds a message; true once a batch is ready.
    pub fn push_message(
        &mut self,
        message: &Message<'_>,
        mapping: Option<(usize, &Mapping)>,
    ) -> Result<Result<bool, Malformed>, ArrowError> {
        if let Some((id, mapping)) = mapping
            && self.current.as_ref().is_none_or(|current| current.mapping != id)
        {
            self.finish_batch()?;
            self.current = Some(self.create_current(id, mapping));
        }
        let mut bytes = 0;
        if let Some(current) = &mut self.current {
            if let Err(e) = current.decoder.push_message(message.data) {
                return Ok(Err(e));
            }
            bytes = current.decoder.buffered_bytes();
            self.unfit += current.decoder.take_unfit();
        }
        for (head, column) in &mut self.heads {
            self.bytes += head.push_value(message, column);
        }
        self.count += 1;
        if self.count >= self.most || self.bytes + bytes >= BATCH_BYTES {
            self.finish_batch()?;
        }
        Ok(Ok(!self.ready.is_empty()))
    }

    /// Takes the number of values since the last call that are null because they are not of their column's type.
    pub fn take_unfit(&mut self) -> usize {
        std::mem::take(&mut self.unfit)
    }

    /// A batch that is ready.
    pub fn take_batch(&mut self) -> Option<RecordBatch> {
        self.ready.pop_front()
    }

    /// Makes a batch of the rows so far.
    pub fn finish_batch(&mut self) -> Result<(), ArrowError> {
        let count = std::mem::take(&mut self.count);
        self.bytes = 0;
        if count == 0 {
            return Ok(());
        }
        let heads = self.heads.iter_mut().map(|(_, c)| c.finish()).collect::<Result<Vec<_>, _>>()?;
        let own = match &mut self.current {
            Some(current) => current.decoder.finish()?,
            None => Vec::new(),
        };
        let arrays = self.output_arrays(&heads, own, count);
        let options = RecordBatchOptions::new().with_row_count(Some(count));
        self.ready.push_back(RecordBatch::try_new_with_options(self.schema.clone(), arrays, &options)?);
        Ok(())
    }
}

impl Head {
    // The bytes that the value takes.
    fn push_value(self, message: &Message<'_>, column: &mut Column) -> usize {
        // A time that 64 bits with a sign do not hold, from the year 2262 on, is null.
        let nanos = |time: u64| i64::try_from(time).ok();
        match (self, column) {
            (Self::Time, Column::Time(c)) => c.append_option(nanos(message.header.log_time)),
            (Self::TimeNanos, Column::I64(c)) => c.append_option(nanos(message.header.log_time)),
            (Self::Published, Column::Time(c)) => c.append_option(nanos(message.header.publish_time)),
            (Self::Sequence, Column::I64(c)) => c.append_value(i64::from(message.header.sequence)),
            (Self::Size, Column::I64(c)) => c.append_value(message.data.len() as i64),
            (Self::Data, Column::Binary(c)) => {
                c.append_value(message.data);
                return message.data.len();
            }
            (Self::Topic, Column::Text(c)) => c.append_value(message.topic.as_bytes()),
            (Self::Surface, Column::Text(c)) if message.run.is_some() => {
                c.append_value(message.run.map_or("", |(surface, _)| surface.as_str()));
            }
            (Self::Run, Column::Text(c)) if message.run.is_some() => {
                c.append_value(message.run.map_or("", |(_, run)| run.as_str()));
            }
            (_, column) => column.append_null(),
        }
        8
    }
}

impl Rows {
    // Of the layout's columns those that are asked for.
    fn create_current(&self, id: usize, mapping: &Mapping) -> Current {
        let place = |output: &Output| match output {
            Output::Own(i) => mapping.columns.get(*i).copied().flatten(),
            Output::Head(_) => None,
        };
        let places: Vec<_> = self.output.iter().map(place).collect();
        let wanted: Vec<_> = places.iter().copied().flatten().collect();
        let has = places.iter().map(Option::is_some).collect();
        Current { mapping: id, decoder: mapping.layout.create_decoder(&wanted), has }
    }

    fn output_arrays(&self, heads: &[ArrayRef], own: Vec<ArrayRef>, count: usize) -> Vec<ArrayRef> {
        let mut own = own.into_iter();
        let has = |i: usize| self.current.as_ref().is_some_and(|current| current.has[i]);
        let one = |(i, (output, field)): (usize, (&Output, &Arc<Field>))| match output {
            Output::Head(head) => heads[*head].clone(),
            Output::Own(_) => {
                let array = if has(i) { own.next() } else { None };
                array.unwrap_or_else(|| new_null_array(field.data_type(), count))
            }
        };
        self.output.iter().zip(self.schema.fields()).enumerate().map(one).collect()
    }
}
