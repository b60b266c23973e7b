//! Arrow columns under construction: what messages of any encoding are decoded into, value by value.

use std::sync::Arc;

use arrow::array::builder::{ArrayBuilder as _, BinaryBuilder, BooleanBuilder, NullBufferBuilder, NullBuilder};
use arrow::array::{
    Array as _, ArrayRef, ArrowPrimitiveType, BinaryArray, ListArray, MapArray, PrimitiveArray, StringArray,
    StructArray,
};
use arrow::buffer::{OffsetBuffer, ScalarBuffer};
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
    Bool(BooleanBuilder),
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
    /// The bytes of texts in UTF-8.
    Text(BinaryBuilder),
    Binary(BinaryBuilder),
    Struct(Record),
    List(List),
    /// Its child is the record of key and value.
    Map(List),
    /// A type that no message has.
    Nothing(NullBuilder),
}

/// Evaluates an expression with a column's builder, whatever its type.
macro_rules! with_builder {
    ($column:expr, $builder:ident => $value:expr) => {
        match $column {
            Self::Bool($builder) => $value,
            Self::I8($builder) => $value,
            Self::I16($builder) => $value,
            Self::I32($builder) => $value,
            Self::I64($builder) => $value,
            Self::U8($builder) => $value,
            Self::U16($builder) => $value,
            Self::U32($builder) => $value,
            Self::U64($builder) => $value,
            Self::F32($builder) => $value,
            Self::F64($builder) => $value,
            Self::Decimal($builder) => $value,
            Self::Time($builder) => $value,
            Self::Duration($builder) => $value,
            Self::Text($builder) | Self::Binary($builder) => $value,
            Self::Struct($builder) => $value,
            Self::List($builder) | Self::Map($builder) => $value,
            Self::Nothing($builder) => $value,
        }
    };
}

/// Numbers of one type. Arrow's own builder has no safe way to add many that are not in memory as they are.
pub(super) struct Numbers<T: ArrowPrimitiveType> {
    values: Vec<T::Native>,
    nulls: NullBufferBuilder,
}

/// Columns side by side.
pub(super) struct Record {
    fields: Fields,
    pub columns: Vec<Column>,
    nulls: NullBufferBuilder,
}

/// Lists: the values of all of them, and where each ends.
pub(super) struct List {
    field: FieldRef,
    offsets: Vec<i32>,
    pub values: Box<Column>,
    nulls: NullBufferBuilder,
}

impl<T: ArrowPrimitiveType> Numbers<T> {
    fn new() -> Self {
        Self { values: Vec::new(), nulls: NullBufferBuilder::new(0) }
    }

    fn len(&self) -> usize {
        self.values.len()
    }

    /// Adds a value.
    pub fn append_value(&mut self, value: T::Native) {
        self.values.push(value);
        self.nulls.append_non_null();
    }

    /// Adds several values at once, as those of a packed list of floats.
    pub fn append_values(&mut self, values: impl ExactSizeIterator<Item = T::Native>) {
        self.nulls.append_n_non_nulls(values.len());
        self.values.extend(values);
    }

    /// Adds a value, or a missing one.
    pub fn append_option(&mut self, value: Option<T::Native>) {
        match value {
            Some(value) => self.append_value(value),
            None => self.append_null(),
        }
    }

    fn append_null(&mut self) {
        self.values.push(T::Native::default());
        self.nulls.append_null();
    }

    fn finish(&mut self) -> PrimitiveArray<T> {
        PrimitiveArray::new(ScalarBuffer::from(take_values(&mut self.values)), self.nulls.finish())
    }
}

impl Record {
    /// Makes columns of these fields.
    pub fn new(fields: &Fields) -> Self {
        let columns = fields.iter().map(|f| Column::new(f.data_type())).collect();
        Self { fields: fields.clone(), columns, nulls: NullBufferBuilder::new(0) }
    }

    fn len(&self) -> usize {
        self.nulls.len()
    }

    /// Ends a record that is there, for which each column has got a value.
    pub fn end_row(&mut self) {
        self.nulls.append_non_null();
    }

    fn append_null(&mut self) {
        self.columns.iter_mut().for_each(Column::append_null);
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

    fn len(&self) -> usize {
        self.nulls.len()
    }

    /// Ends a list, of the values that were added since the last one.
    pub fn end_row(&mut self) {
        self.push_offset();
        self.nulls.append_non_null();
    }

    fn append_null(&mut self) {
        self.push_offset();
        self.nulls.append_null();
    }

    // Batches end long before this many values, and a message that expands to more is refused.
    fn push_offset(&mut self) {
        self.offsets.push(i32::try_from(self.values.len()).unwrap_or(i32::MAX));
    }

    fn finish_offsets(&mut self) -> OffsetBuffer<i32> {
        let ends = take_values(&mut self.offsets);
        self.offsets.push(0);
        OffsetBuffer::new(ScalarBuffer::from(ends))
    }
}

impl Column {
    /// Makes an empty column of a type.
    pub fn new(kind: &DataType) -> Self {
        match kind {
            DataType::Boolean => Self::Bool(BooleanBuilder::new()),
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
            DataType::Utf8 => Self::Text(BinaryBuilder::new()),
            DataType::Binary => Self::Binary(BinaryBuilder::new()),
            DataType::Struct(fields) => Self::Struct(Record::new(fields)),
            DataType::List(field) => Self::List(List::new(field)),
            DataType::Map(entry, _) => Self::Map(List::new(entry)),
            _ => Self::Nothing(NullBuilder::new()),
        }
    }

    fn len(&self) -> usize {
        with_builder!(self, builder => builder.len())
    }

    /// Adds a value that is missing.
    pub fn append_null(&mut self) {
        with_builder!(self, builder => builder.append_null());
    }

    /// Returns the array of all values, and empties the column.
    pub fn finish(&mut self) -> Result<ArrayRef, ArrowError> {
        Ok(match self {
            Self::Bool(c) => Arc::new(c.finish()),
            Self::I8(c) => Arc::new(c.finish()),
            Self::I16(c) => Arc::new(c.finish()),
            Self::I32(c) => Arc::new(c.finish()),
            Self::I64(c) => Arc::new(c.finish()),
            Self::U8(c) => Arc::new(c.finish()),
            Self::U16(c) => Arc::new(c.finish()),
            Self::U32(c) => Arc::new(c.finish()),
            Self::U64(c) => Arc::new(c.finish()),
            // One NaN, as in results of queries: the sign that a file's NaN has depends on the recorder's processor.
            // All values are written, so that the loop has no branches and is compiled into vectors.
            Self::F32(c) => {
                c.values.iter_mut().for_each(|x| *x = if x.is_nan() { f32::NAN } else { *x });
                Arc::new(c.finish())
            }
            Self::F64(c) => {
                c.values.iter_mut().for_each(|x| *x = if x.is_nan() { f64::NAN } else { *x });
                Arc::new(c.finish())
            }
            Self::Decimal(c) => Arc::new(c.finish().with_precision_and_scale(INTEGER_DIGITS, 0)?),
            Self::Time(c) => Arc::new(c.finish().with_timezone(UTC)),
            Self::Duration(c) => Arc::new(c.finish()),
            Self::Text(c) => Arc::new(StringArray::try_from_binary(finish_bytes(c))?),
            Self::Binary(c) => Arc::new(finish_bytes(c)),
            Self::Struct(c) => Arc::new(c.finish()?),
            Self::List(c) => {
                let values = c.values.finish()?;
                Arc::new(ListArray::try_new(c.field.clone(), c.finish_offsets(), values, c.nulls.finish())?)
            }
            Self::Map(c) => {
                let values = c.values.finish()?;
                let Some(entries) = values.as_any().downcast_ref::<StructArray>() else {
                    return Err(ArrowError::SchemaError("a map's child is no record of key and value".to_owned()));
                };
                let offsets = c.finish_offsets();
                Arc::new(MapArray::try_new(c.field.clone(), offsets, entries.clone(), c.nulls.finish(), false)?)
            }
            Self::Nothing(c) => Arc::new(c.finish()),
        })
    }
}

/// Adds a text. What is no UTF-8 in it is replaced, as a text is shown, so that one of them does not end a scan.
pub(super) fn append_text(column: &mut BinaryBuilder, text: &[u8]) {
    column.append_value(String::from_utf8_lossy(text).as_bytes());
}

/// Bytes that one value of a type takes, what is in its lists and texts aside: they are what a message of few bytes can
/// make many of.
pub(super) fn value_width(kind: &DataType) -> usize {
    match kind {
        DataType::Struct(fields) => fields.iter().map(|f| value_width(f.data_type())).sum::<usize>() + 1,
        other => other.primitive_width().unwrap_or(4),
    }
}

// The next batch is about as large, and does not have to grow to it.
fn finish_bytes(column: &mut BinaryBuilder) -> BinaryArray {
    let next = BinaryBuilder::with_capacity(column.len(), column.values_slice().len());
    std::mem::replace(column, next).finish()
}

// As for bytes.
fn take_values<T>(values: &mut Vec<T>) -> Vec<T> {
    let next = Vec::with_capacity(values.len());
    std::mem::replace(values, next)
}
