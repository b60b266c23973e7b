//! Arrow columns under construction: what messages of any encoding are decoded into, value by value.

use std::sync::Arc;

use arrow::array::builder::{BooleanBufferBuilder, NullBufferBuilder};
use arrow::array::{
    Array as _, ArrayRef, ArrowPrimitiveType, BinaryArray, BooleanArray, ListArray, MapArray, NullArray,
    PrimitiveArray, StringArray, StructArray,
};
use arrow::buffer::{NullBuffer, OffsetBuffer, ScalarBuffer};
use arrow::datatypes::{
    DataType, Decimal128Type, DurationNanosecondType, FieldRef, Fields, Float32Type, Float64Type, Int8Type, Int16Type,
    Int32Type, Int64Type, TimeUnit, TimestampNanosecondType, UInt8Type, UInt16Type, UInt32Type, UInt64Type,
};
use arrow::error::ArrowError;

/// Columns of one message type, nested ones included; no table has more.
pub(super) const MOST_LEAVES: usize = 4096;
/// How deep messages are taken apart.
pub(super) const DEEPEST: usize = 16;

/// Digits of 2^64 - 1.
const INTEGER_DIGITS: u8 = 20;

/// Times are UTC.
pub(super) const UTC: &str = "UTC";

/// The type of times.
pub(super) fn time_type() -> DataType {
    DataType::Timestamp(TimeUnit::Nanosecond, Some(UTC.into()))
}

/// The type of durations.
pub(super) fn duration_type() -> DataType {
    DataType::Duration(TimeUnit::Nanosecond)
}

/// The type of integers of 64 bits, with a sign or without.
pub(super) fn integer_type() -> DataType {
    DataType::Decimal128(INTEGER_DIGITS, 0)
}

/// A column, of one of the types that messages have.
pub(super) enum Column {
    Bool(Bits),
    I8(Numbers<Int8Type>),
    I16(Numbers<Int16Type>),
    I32(Numbers<Int32Type>),
    I64(Numbers<Int64Type>),
    U8(Numbers<UInt8Type>),
    U16(Numbers<UInt16Type>),
    U32(Numbers<UInt32Type>),
    U64(Numbers<UInt64Type>),
    F32(Numbers<Float32Type>),
    F64(Numbers<Float64Type>),
    /// Integers of [`integer_type`].
    Decimal(Numbers<Decimal128Type>),
    Time(Numbers<TimestampNanosecondType>),
    Duration(Numbers<DurationNanosecondType>),
    Text(Strings),
    Binary(Strings),
    Struct(Record),
    List(List),
    /// Its child is the record of key and value.
    Map(List),
    /// A type that no message has.
    Nothing(usize),
}

/// Truth values.
pub(super) struct Bits {
    values: BooleanBufferBuilder,
    nulls: NullBufferBuilder,
}

/// Numbers of one type.
pub(super) struct Numbers<T: ArrowPrimitiveType> {
    pub(super) values: Vec<T::Native>,
    nulls: NullBufferBuilder,
}

/// Texts, or bytes.
pub(super) struct Strings {
    offsets: Vec<i32>,
    bytes: Vec<u8>,
    nulls: NullBufferBuilder,
}

/// Columns side by side.
pub(super) struct Record {
    fields: Fields,
    pub(super) columns: Vec<Column>,
    nulls: NullBufferBuilder,
}

/// Lists: the values of all of them, and where each ends.
pub(super) struct List {
    field: FieldRef,
    offsets: Vec<i32>,
    pub(super) values: Box<Column>,
    nulls: NullBufferBuilder,
}

impl Bits {
    fn new() -> Self {
        Self { values: BooleanBufferBuilder::new(0), nulls: NullBufferBuilder::new(0) }
    }

    pub(super) fn push(&mut self, value: bool) {
        self.values.append(value);
        self.nulls.append_non_null();
    }

    fn push_null(&mut self) {
        self.values.append(false);
        self.nulls.append_null();
    }
}

impl<T: ArrowPrimitiveType> Numbers<T> {
    fn new() -> Self {
        Self { values: Vec::new(), nulls: NullBufferBuilder::new(0) }
    }

    pub(super) fn push(&mut self, value: T::Native) {
        self.values.push(value);
        self.nulls.append_non_null();
    }

    /// Several at once; this is what a packed list of floats is decoded with.
    pub(super) fn extend(&mut self, values: impl ExactSizeIterator<Item = T::Native>) {
        self.nulls.append_n_non_nulls(values.len());
        self.values.extend(values);
    }

    /// A value, or a missing one.
    pub(super) fn push_option(&mut self, value: Option<T::Native>) {
        match value {
            Some(value) => self.push(value),
            None => self.push_null(),
        }
    }

    pub(super) fn push_null(&mut self) {
        self.values.push(T::Native::default());
        self.nulls.append_null();
    }

    fn finish(&mut self) -> PrimitiveArray<T> {
        PrimitiveArray::new(ScalarBuffer::from(take(&mut self.values)), self.nulls.finish())
    }
}

impl Strings {
    fn new() -> Self {
        Self { offsets: vec![0], bytes: Vec::new(), nulls: NullBufferBuilder::new(0) }
    }

    pub(super) fn push(&mut self, value: &[u8]) {
        self.bytes.extend_from_slice(value);
        self.offsets.push(offset(self.bytes.len()));
        self.nulls.append_non_null();
    }

    /// A text; what is no UTF-8 in it is replaced, as a text is shown, so that one of them does not end a scan.
    pub(super) fn push_text(&mut self, value: &[u8]) {
        self.push(String::from_utf8_lossy(value).as_bytes());
    }

    fn push_null(&mut self) {
        self.offsets.push(offset(self.bytes.len()));
        self.nulls.append_null();
    }

    fn take(&mut self) -> (OffsetBuffer<i32>, Vec<u8>, Option<NullBuffer>) {
        (offsets(&mut self.offsets), take(&mut self.bytes), self.nulls.finish())
    }
}

impl Record {
    /// Columns of these fields.
    pub(super) fn new(fields: &Fields) -> Self {
        let columns = fields.iter().map(|f| Column::new(f.data_type())).collect();
        Self { fields: fields.clone(), columns, nulls: NullBufferBuilder::new(0) }
    }

    /// All columns have got one more value, which together are one that is there.
    pub(super) fn end_row(&mut self) {
        self.nulls.append_non_null();
    }

    fn push_null(&mut self) {
        self.columns.iter_mut().for_each(Column::push_null);
        self.nulls.append_null();
    }

    fn finish(&mut self) -> Result<StructArray, ArrowError> {
        let length = self.nulls.len();
        let columns = self.columns.iter_mut().map(Column::finish).collect::<Result<_, _>>()?;
        StructArray::try_new_with_length(self.fields.clone(), columns, self.nulls.finish(), length)
    }
}

impl List {
    fn new(field: &FieldRef) -> Self {
        let values = Box::new(Column::new(field.data_type()));
        Self { field: field.clone(), offsets: vec![0], values, nulls: NullBufferBuilder::new(0) }
    }

    /// What came to the values since the last list is one.
    pub(super) fn end_row(&mut self) {
        self.offsets.push(offset(self.values.len()));
        self.nulls.append_non_null();
    }

    fn push_null(&mut self) {
        self.offsets.push(offset(self.values.len()));
        self.nulls.append_null();
    }
}

impl Column {
    /// An empty column of a type.
    pub(super) fn new(kind: &DataType) -> Self {
        match kind {
            DataType::Boolean => Self::Bool(Bits::new()),
            DataType::Int8 => Self::I8(Numbers::new()),
            DataType::Int16 => Self::I16(Numbers::new()),
            DataType::Int32 => Self::I32(Numbers::new()),
            DataType::Int64 => Self::I64(Numbers::new()),
            DataType::UInt8 => Self::U8(Numbers::new()),
            DataType::UInt16 => Self::U16(Numbers::new()),
            DataType::UInt32 => Self::U32(Numbers::new()),
            DataType::UInt64 => Self::U64(Numbers::new()),
            DataType::Float32 => Self::F32(Numbers::new()),
            DataType::Float64 => Self::F64(Numbers::new()),
            DataType::Decimal128(_, _) => Self::Decimal(Numbers::new()),
            DataType::Timestamp(_, _) => Self::Time(Numbers::new()),
            DataType::Duration(_) => Self::Duration(Numbers::new()),
            DataType::Utf8 => Self::Text(Strings::new()),
            DataType::Binary => Self::Binary(Strings::new()),
            DataType::Struct(fields) => Self::Struct(Record::new(fields)),
            DataType::List(field) => Self::List(List::new(field)),
            DataType::Map(entry, _) => Self::Map(List::new(entry)),
            _ => Self::Nothing(0),
        }
    }

    /// Values so far.
    pub(super) fn len(&self) -> usize {
        match self {
            Self::Bool(c) => c.values.len(),
            Self::I8(c) => c.values.len(),
            Self::I16(c) => c.values.len(),
            Self::I32(c) => c.values.len(),
            Self::I64(c) => c.values.len(),
            Self::U8(c) => c.values.len(),
            Self::U16(c) => c.values.len(),
            Self::U32(c) => c.values.len(),
            Self::U64(c) => c.values.len(),
            Self::F32(c) => c.values.len(),
            Self::F64(c) => c.values.len(),
            Self::Decimal(c) => c.values.len(),
            Self::Time(c) => c.values.len(),
            Self::Duration(c) => c.values.len(),
            Self::Text(c) | Self::Binary(c) => c.offsets.len() - 1,
            Self::Struct(c) => c.nulls.len(),
            Self::List(c) | Self::Map(c) => c.offsets.len() - 1,
            Self::Nothing(count) => *count,
        }
    }

    /// One value that is missing.
    pub(super) fn push_null(&mut self) {
        match self {
            Self::Bool(c) => c.push_null(),
            Self::I8(c) => c.push_null(),
            Self::I16(c) => c.push_null(),
            Self::I32(c) => c.push_null(),
            Self::I64(c) => c.push_null(),
            Self::U8(c) => c.push_null(),
            Self::U16(c) => c.push_null(),
            Self::U32(c) => c.push_null(),
            Self::U64(c) => c.push_null(),
            Self::F32(c) => c.push_null(),
            Self::F64(c) => c.push_null(),
            Self::Decimal(c) => c.push_null(),
            Self::Time(c) => c.push_null(),
            Self::Duration(c) => c.push_null(),
            Self::Text(c) | Self::Binary(c) => c.push_null(),
            Self::Struct(c) => c.push_null(),
            Self::List(c) | Self::Map(c) => c.push_null(),
            Self::Nothing(count) => *count += 1,
        }
    }

    /// The array of all values; the column is empty afterwards.
    pub(super) fn finish(&mut self) -> Result<ArrayRef, ArrowError> {
        Ok(match self {
            Self::Bool(c) => Arc::new(BooleanArray::new(c.values.finish(), c.nulls.finish())),
            Self::I8(c) => Arc::new(c.finish()),
            Self::I16(c) => Arc::new(c.finish()),
            Self::I32(c) => Arc::new(c.finish()),
            Self::I64(c) => Arc::new(c.finish()),
            Self::U8(c) => Arc::new(c.finish()),
            Self::U16(c) => Arc::new(c.finish()),
            Self::U32(c) => Arc::new(c.finish()),
            Self::U64(c) => Arc::new(c.finish()),
            Self::F32(c) => Arc::new(c.finish()),
            Self::F64(c) => Arc::new(c.finish()),
            Self::Decimal(c) => Arc::new(c.finish().with_precision_and_scale(INTEGER_DIGITS, 0)?),
            Self::Time(c) => Arc::new(c.finish().with_timezone(UTC)),
            Self::Duration(c) => Arc::new(c.finish()),
            Self::Text(c) => {
                let (offsets, bytes, nulls) = c.take();
                Arc::new(StringArray::try_new(offsets, bytes.into(), nulls)?)
            }
            Self::Binary(c) => {
                let (offsets, bytes, nulls) = c.take();
                Arc::new(BinaryArray::try_new(offsets, bytes.into(), nulls)?)
            }
            Self::Struct(c) => Arc::new(c.finish()?),
            Self::List(c) => {
                let (ends, values) = (offsets(&mut c.offsets), c.values.finish()?);
                Arc::new(ListArray::try_new(c.field.clone(), ends, values, c.nulls.finish())?)
            }
            Self::Map(c) => {
                let (ends, values) = (offsets(&mut c.offsets), c.values.finish()?);
                let Some(entries) = values.as_any().downcast_ref::<StructArray>() else {
                    return Err(ArrowError::SchemaError("a map's child is no record of key and value".to_owned()));
                };
                Arc::new(MapArray::try_new(c.field.clone(), ends, entries.clone(), c.nulls.finish(), false)?)
            }
            Self::Nothing(count) => Arc::new(NullArray::new(std::mem::take(count))),
        })
    }
}

/// Bytes that one value of a type takes, what is in its lists and texts aside: they are what a message of few bytes can
/// make many of.
pub(super) fn width(kind: &DataType) -> usize {
    match kind {
        DataType::Struct(fields) => fields.iter().map(|f| width(f.data_type())).sum::<usize>() + 1,
        other => other.primitive_width().unwrap_or(4),
    }
}

// Batches end long before this many bytes, and a message that expands to more is refused.
fn offset(length: usize) -> i32 {
    i32::try_from(length).unwrap_or(i32::MAX)
}

fn offsets(taken: &mut Vec<i32>) -> OffsetBuffer<i32> {
    let ends = take(taken);
    taken.push(0);
    OffsetBuffer::new(ScalarBuffer::from(ends))
}

// The next batch is about as large, and does not have to grow to it.
fn take<T>(values: &mut Vec<T>) -> Vec<T> {
    let next = Vec::with_capacity(values.len());
    std::mem::replace(values, next)
}
