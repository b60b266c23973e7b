//! Converts Arrow arrays to the arguments of kernels: checked slices of samples, numbers and texts.

use std::fmt::Debug;
use std::sync::Arc;

use arrow::array::{Array, ArrayRef, ArrowPrimitiveType, AsArray as _, BooleanArray, ListArray, StringArray};
use arrow::buffer::NullBuffer;
use arrow::datatypes::{ArrowNativeType, DataType, Field, Float32Type, Float64Type, Int64Type};
use datafusion::error::{DataFusionError, Result};
use datafusion::logical_expr::ColumnarValue;
use echolake_dsp::RealSample;

use super::description::{ArgumentKind, FunctionDescription, FunctionParameter};

/// A sample type with an Arrow type.
pub(crate) trait SampleElement: RealSample + ArrowNativeType {
    type Arrow: ArrowPrimitiveType<Native = Self>;
}

impl SampleElement for f32 {
    type Arrow = Float32Type;
}

impl SampleElement for f64 {
    type Arrow = Float64Type;
}

/// The arguments of one call: arrays with one value per row, or with a single value for all rows.
pub(crate) struct CallArguments<'a> {
    description: &'a FunctionDescription,
    columns: Vec<ArgumentColumn>,
    rows: usize,
    /// Rows in which an argument is null.
    nulls: Option<NullBuffer>,
}

struct ArgumentColumn {
    array: ArrayRef,
    constant: bool,
}

/// Lists of samples.
pub(crate) struct SampleLists<'a, T> {
    list: &'a ListArray,
    values: &'a [T],
    nulls: Option<&'a NullBuffer>,
    constant: bool,
    function: &'a str,
    parameter: &'a str,
}

/// Numbers, or whole numbers.
pub(crate) struct NumberValues<'a, N> {
    values: &'a [N],
    constant: bool,
}

/// Returns an argument as texts.
pub(crate) struct TextValues<'a> {
    values: &'a StringArray,
    constant: bool,
}

/// Returns the types to which a call's arguments are cast. Unsuitable types are kept: [`check_arguments`] refuses them.
pub(crate) fn coerced_types(description: &FunctionDescription, types: &[DataType]) -> Vec<DataType> {
    let kind = |i: usize| description.parameters.get(i).map(|p| p.kind);
    let samples = types.iter().enumerate().filter(|(i, _)| kind(*i) == Some(ArgumentKind::Samples));
    let narrow = samples.clone().any(|(_, t)| element_type(t) == Some(&DataType::Float32))
        && samples
            .into_iter()
            .all(|(_, t)| matches!(element_type(t), Some(DataType::Float32 | DataType::Null)) || t.is_null());
    let wanted = if narrow { DataType::Float32 } else { DataType::Float64 };
    let coerce = |(i, given): (usize, &DataType)| match kind(i) {
        Some(ArgumentKind::Samples) if given.is_null() || element_type(given).is_some_and(is_number) => match given {
            DataType::List(child) if *child.data_type() == wanted => given.clone(),
            _ => list_of(wanted.clone()),
        },
        Some(ArgumentKind::Number) if is_number(given) => DataType::Float64,
        Some(ArgumentKind::Integer) if given.is_integer() || given.is_null() => DataType::Int64,
        Some(ArgumentKind::Text) if is_text(given) => DataType::Utf8,
        Some(ArgumentKind::Flag) if given.is_null() => DataType::Boolean,
        _ => given.clone(),
    };
    types.iter().enumerate().map(coerce).collect()
}

/// Checks the number of arguments and their types, after [`coerced_types`].
pub(crate) fn check_arguments(description: &FunctionDescription, types: &[DataType]) -> Result<()> {
    let most = description.parameters.len();
    let name = description.name;
    if !(most - description.optional..=most).contains(&types.len()) {
        let given = match types.len() {
            1 => "1 argument is".to_owned(),
            count => format!("{count} arguments are"),
        };
        return Err(DataFusionError::Plan(format!("`{name}`: {given} given; hint: {}", description.call_syntax())));
    }
    for (i, (given, FunctionParameter { name: parameter, kind, about })) in
        types.iter().zip(description.parameters).enumerate()
    {
        let fits = match kind {
            ArgumentKind::Samples => matches!(element_type(given), Some(DataType::Float32 | DataType::Float64)),
            ArgumentKind::Number => *given == DataType::Float64,
            ArgumentKind::Integer => *given == DataType::Int64,
            ArgumentKind::Text => *given == DataType::Utf8,
            ArgumentKind::Flag => *given == DataType::Boolean,
            ArgumentKind::Value => true,
        };
        if !fits {
            let i = i + 1;
            let words = kind.display_words();
            let message =
                format!("`{name}`: argument {i}, `{parameter}`, is {given}, not {words}; hint: it is {about}");
            return Err(DataFusionError::Plan(message));
        }
    }
    Ok(())
}

/// Returns the list type of our functions' answers.
pub(crate) fn list_of(element: DataType) -> DataType {
    DataType::List(Arc::new(Field::new_list_field(element, true)))
}

/// Returns the type of a list with the same element type.
pub(crate) fn same_list_type(list: &DataType) -> DataType {
    list_of(element_type(list).cloned().unwrap_or(DataType::Float64))
}

/// Returns the element type of a list.
pub(crate) fn element_type(list: &DataType) -> Option<&DataType> {
    match list {
        DataType::List(child)
        | DataType::LargeList(child)
        | DataType::ListView(child)
        | DataType::LargeListView(child)
        | DataType::FixedSizeList(child, _) => Some(child.data_type()),
        _ => None,
    }
}

fn is_number(kind: &DataType) -> bool {
    kind.is_numeric() || kind.is_null()
}

fn is_text(kind: &DataType) -> bool {
    match kind {
        DataType::Dictionary(_, values) => is_text(values),
        kind => kind.is_string() || kind.is_null(),
    }
}

impl<'a> CallArguments<'a> {
    /// Arguments of a call of a scalar function; constants are kept as one value.
    pub fn new(description: &'a FunctionDescription, values: &[ColumnarValue], rows: usize) -> Result<Self> {
        let column = |value: &ColumnarValue| match value {
            ColumnarValue::Array(array) => Ok(ArgumentColumn { array: array.clone(), constant: false }),
            ColumnarValue::Scalar(value) => Ok(ArgumentColumn { array: value.to_array_of_size(1)?, constant: true }),
        };
        Ok(Self::from_columns(description, values.iter().map(column).collect::<Result<_>>()?, rows))
    }

    /// Arguments from a batch of an aggregate's input.
    pub fn from_batch(description: &'a FunctionDescription, arrays: &[ArrayRef]) -> Self {
        let rows = arrays.first().map_or(0, |a| a.len());
        let column = |array: &ArrayRef| ArgumentColumn { array: array.clone(), constant: false };
        Self::from_columns(description, arrays.iter().map(column).collect(), rows)
    }

    fn from_columns(description: &'a FunctionDescription, columns: Vec<ArgumentColumn>, rows: usize) -> Self {
        let nulls = columns.iter().fold(None, |nulls: Option<NullBuffer>, column| match column.constant {
            true if column.array.is_null(0) => Some(NullBuffer::new_null(rows)),
            true => nulls,
            false => NullBuffer::union(nulls.as_ref(), column.array.nulls()),
        });
        Self { description, columns, rows, nulls }
    }

    /// Returns the number of rows of the answer.
    pub fn row_count(&self) -> usize {
        self.rows
    }

    /// Returns the number of given arguments.
    pub fn argument_count(&self) -> usize {
        self.columns.len()
    }

    /// Returns whether an argument of the row is null, and so its answer.
    pub fn is_null(&self, row: usize) -> bool {
        self.nulls.as_ref().is_some_and(|nulls| nulls.is_null(row))
    }

    /// Returns an argument as lists of `T`.
    pub fn sample_lists<T: SampleElement>(&self, argument: usize) -> Result<SampleLists<'_, T>> {
        let ArgumentColumn { array, constant } = &self.columns[argument];
        let list = array.as_list_opt::<i32>().ok_or_else(|| self.other_type(argument))?;
        let values = list.values().as_primitive_opt::<T::Arrow>().ok_or_else(|| self.other_type(argument))?;
        Ok(SampleLists {
            list,
            values: values.values(),
            nulls: values.nulls().filter(|nulls| nulls.null_count() > 0),
            constant: *constant,
            function: self.description.name,
            parameter: self.description.parameters[argument].name,
        })
    }

    /// Returns an argument as numbers.
    pub fn number_values(&self, argument: usize) -> Result<NumberValues<'_, f64>> {
        let ArgumentColumn { array, constant } = &self.columns[argument];
        let values = array.as_primitive_opt::<Float64Type>().ok_or_else(|| self.other_type(argument))?;
        Ok(NumberValues { values: values.values(), constant: *constant })
    }

    /// Returns an argument as whole numbers.
    pub fn integer_values(&self, argument: usize) -> Result<NumberValues<'_, i64>> {
        let ArgumentColumn { array, constant } = &self.columns[argument];
        let values = array.as_primitive_opt::<Int64Type>().ok_or_else(|| self.other_type(argument))?;
        Ok(NumberValues { values: values.values(), constant: *constant })
    }

    /// Returns an argument as texts.
    pub fn text_values(&self, argument: usize) -> Result<TextValues<'_>> {
        let ArgumentColumn { array, constant } = &self.columns[argument];
        let values = array.as_string_opt::<i32>().ok_or_else(|| self.other_type(argument))?;
        Ok(TextValues { values, constant: *constant })
    }

    /// Returns an argument as flags, one per row of a batch.
    pub fn flag_values(&self, argument: usize) -> Result<&BooleanArray> {
        self.columns[argument].array.as_boolean_opt().ok_or_else(|| self.other_type(argument))
    }

    /// Returns the error for an invalid argument of a row, with a hint.
    pub fn invalid_argument(&self, argument: usize, row: usize, is: impl Debug, hint: &str) -> DataFusionError {
        let name = self.description.name;
        let parameter = self.description.parameters[argument].name;
        let row = row + 1;
        DataFusionError::Execution(format!("`{name}`: `{parameter}` is {is:?} in row {row} of its batch; hint: {hint}"))
    }

    /// Returns the error for a row that a kernel refused.
    pub fn refused_row(&self, row: usize, error: &echolake_dsp::Error) -> DataFusionError {
        let hint = match error {
            echolake_dsp::Error::Length { .. } => "the lists of a row must be equally long",
            echolake_dsp::Error::NotFinite { .. } => {
                "leave out rows with NaN or infinity, as WHERE list_energy(ir) < 1e300"
            }
            _ => self.description.about,
        };
        let name = self.description.name;
        let row = row + 1;
        DataFusionError::Execution(format!("`{name}`, row {row} of its batch: {error}; hint: {hint}"))
    }

    // Planning casts to the right types, so only plans built without it get here.
    fn other_type(&self, argument: usize) -> DataFusionError {
        let name = self.description.name;
        let kind = self.columns[argument].array.data_type();
        DataFusionError::Execution(format!(
            "`{name}`: argument {} is {kind}; hint: {}",
            argument + 1,
            self.description.call_syntax()
        ))
    }
}

impl<'a, T> SampleLists<'a, T> {
    /// Returns the samples of a row that is not null.
    pub fn samples_at(&self, row: usize) -> Result<&'a [T]> {
        let row = if self.constant { 0 } else { row };
        let offsets = self.list.value_offsets();
        let from = offsets[row] as usize;
        let to = offsets[row + 1] as usize;
        match self.nulls {
            Some(nulls) if nulls.slice(from, to - from).null_count() > 0 => Err(self.null_inside(row, from, to)),
            _ => Ok(&self.values[from..to]),
        }
    }

    /// Returns the approximate number of samples of all rows, as capacity for an answer of the same size.
    pub fn sample_capacity(&self, rows: usize) -> usize {
        let offsets = self.list.value_offsets();
        let whole = (offsets[offsets.len() - 1] - offsets[0]) as usize;
        if self.constant { whole.saturating_mul(rows) } else { whole }
    }

    fn null_inside(&self, row: usize, from: usize, to: usize) -> DataFusionError {
        let at = self.nulls.and_then(|nulls| (from..to).find(|i| nulls.is_null(*i))).unwrap_or(from) - from;
        let function = self.function;
        let parameter = self.parameter;
        let row = row + 1;
        let at = at + 1;
        let hint = "array_compact() takes nulls out, or leave such rows out";
        DataFusionError::Execution(format!(
            "`{function}`: element {at} of `{parameter}` is null in row {row} of its batch; hint: {hint}"
        ))
    }
}

impl<N: Copy> NumberValues<'_, N> {
    /// Returns the number of a row that is not null.
    pub fn value_at(&self, row: usize) -> N {
        self.values[if self.constant { 0 } else { row }]
    }
}

impl TextValues<'_> {
    /// Returns the text of a row that is not null.
    pub fn text_at(&self, row: usize) -> &str {
        self.values.value(if self.constant { 0 } else { row })
    }
}

#[cfg(test)]
mod tests {
    use arrow::array::Float32Array;

    use super::*;
    use crate::adapters::answers::list_array;
    use crate::adapters::description::FunctionFamily;

    // A slice of an array keeps its whole parent, and offsets that do not begin at 0.
    #[test]
    fn slices_of_arrays_are_read_where_they_begin() {
        static DESCRIPTION: FunctionDescription = FunctionDescription {
            name: "f",
            family: FunctionFamily::Lists,
            about: "",
            parameters: &[FunctionParameter { name: "x", kind: ArgumentKind::Samples, about: "" }],
            optional: 0,
            example: "",
            answer: "",
            related: &[],
        };
        let values = Float32Array::from(vec![Some(1.0), None, Some(3.0), Some(4.0), Some(5.0)]);
        let lists = list_array::<f32>(vec![1.0; 5], vec![0, 2, 3, 5], None).expect("lists");
        let (field, offsets, ..) = lists.into_parts();
        let lists = ListArray::new(field, offsets, Arc::new(values), None).slice(1, 2);
        let arguments =
            CallArguments::new(&DESCRIPTION, &[ColumnarValue::Array(Arc::new(lists))], 2).expect("arguments");
        let samples = arguments.sample_lists::<f32>(0).expect("f32");
        assert_eq!(
            (samples.samples_at(0).expect("whole"), samples.samples_at(1).expect("whole")),
            (&[3.0][..], &[4.0, 5.0][..])
        );
        assert_eq!(samples.sample_capacity(2), 3);
        assert!(arguments.sample_lists::<f64>(0).is_err());
    }
}
