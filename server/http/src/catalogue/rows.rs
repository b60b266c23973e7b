//! Rows of a query as structs, by the names of their columns.

use std::marker::PhantomData;
use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _, ListArray};
use arrow::datatypes::{DataType, Float32Type, Float64Type};
use arrow::error::ArrowError;
use arrow::record_batch::RecordBatch;
use echolake_service::RequestFault;
use echolake_service::running::AnswerEncoder;
use serde::de::DeserializeOwned;

/// Bytes of one query's rows, as columns; the largest that endpoints ask for are a run's events or a few responses.
const MOST_BYTES: usize = 64 << 20;

/// Decodes batches into structs, on the threads that encode answers.
pub(super) struct RowDecoder<T> {
    sql: String,
    bytes: usize,
    rows: PhantomData<fn() -> T>,
}

impl<T> RowDecoder<T> {
    /// Begins the rows of a query.
    pub fn new(sql: String) -> Self {
        Self { sql, bytes: 0, rows: PhantomData }
    }
}

impl<T: DeserializeOwned + Send + 'static> AnswerEncoder for RowDecoder<T> {
    type Item = Vec<T>;

    fn encode_batch(&mut self, batch: RecordBatch) -> Result<Vec<Vec<T>>, RequestFault> {
        self.bytes += batch.columns().iter().map(slice_bytes).sum::<usize>();
        if self.bytes > MOST_BYTES {
            return Err(RequestFault::TooLarge { limit: MOST_BYTES });
        }
        Ok(vec![decode_rows(&self.sql, &batch)?])
    }

    fn encode_end(self) -> Result<Vec<Vec<T>>, RequestFault> {
        Ok(Vec::new())
    }
}

/// Decodes a batch into structs; numbers that are not finite are null. `sql` is for the log.
///
/// # Errors
/// [`RequestFault::Internal`] if the columns are not those of the structs.
pub(super) fn decode_rows<T: DeserializeOwned>(sql: &str, batch: &RecordBatch) -> Result<Vec<T>, RequestFault> {
    let rows = finite_batch(batch).map_err(|e| e.to_string());
    let rows = rows.and_then(|batch| serde_arrow::from_record_batch(&batch).map_err(|e| e.to_string()));
    rows.map_err(|e| {
        tracing::error!(sql, error = e, "the rows of a query are not as expected");
        RequestFault::Internal
    })
}

// Without what a slice leaves out of its buffers.
fn slice_bytes(column: &ArrayRef) -> usize {
    column.to_data().get_slice_memory_size().unwrap_or_else(|_| column.get_array_memory_size())
}

// Answers are JSON, which has no numbers that are not finite: they become null.
fn finite_batch(batch: &RecordBatch) -> Result<RecordBatch, ArrowError> {
    let schema = batch.schema();
    let columns = schema.fields().iter().zip(batch.columns());
    let columns = columns.map(|(field, column)| Ok::<_, ArrowError>((field.name(), finite_values(column)?, true)));
    RecordBatch::try_from_iter_with_nullable(columns.collect::<Result<Vec<_>, ArrowError>>()?)
}

fn finite_values(column: &ArrayRef) -> Result<ArrayRef, ArrowError> {
    Ok(match column.data_type() {
        DataType::Float32 => {
            let numbers = column.as_primitive::<Float32Type>();
            Arc::new(numbers.unary_opt::<_, Float32Type>(|x| x.is_finite().then_some(x)))
        }
        DataType::Float64 => {
            let numbers = column.as_primitive::<Float64Type>();
            Arc::new(numbers.unary_opt::<_, Float64Type>(|x| x.is_finite().then_some(x)))
        }
        DataType::List(item) => {
            let list = column.as_list::<i32>();
            let item = Arc::new(item.as_ref().clone().with_nullable(true));
            Arc::new(ListArray::try_new(
                item,
                list.offsets().clone(),
                finite_values(list.values())?,
                list.nulls().cloned(),
            )?)
        }
        _ => column.clone(),
    })
}

#[cfg(test)]
mod tests {
    use arrow::array::{Float32Array, Int32Array, StringArray, TimestampMicrosecondArray};
    use serde::Deserialize;

    use super::*;

    #[derive(Debug, PartialEq, Deserialize)]
    struct NamedRow {
        name: Option<String>,
        count: usize,
        time: String,
        level: Option<f32>,
        levels: Vec<Option<f32>>,
    }

    fn batch() -> RecordBatch {
        let items = |values: [Option<f32>; 2]| Some(values.to_vec());
        let lists = [items([Some(1.5), None]), items([Some(f32::NAN), Some(f32::NEG_INFINITY)])];
        let times = TimestampMicrosecondArray::from(vec![1_767_758_400_000_000, 1_767_758_400_000_001]);
        let columns: [(&str, ArrayRef); 6] = [
            ("name", Arc::new(StringArray::from(vec![Some("a"), None]))),
            ("unknown", Arc::new(Int32Array::from(vec![1, 2]))),
            ("count", Arc::new(Int32Array::from(vec![3, 4]))),
            ("time", Arc::new(times.with_timezone("UTC"))),
            ("level", Arc::new(Float32Array::from(vec![f32::INFINITY, 0.1]))),
            ("levels", Arc::new(ListArray::from_iter_primitive::<Float32Type, _, _>(lists))),
        ];
        RecordBatch::try_from_iter(columns).expect("a batch")
    }

    #[test]
    fn rows_have_the_values_of_their_columns() {
        let expected = [
            NamedRow {
                name: Some("a".into()),
                count: 3,
                time: "2026-01-07T04:00:00Z".into(),
                level: None,
                levels: vec![Some(1.5), None],
            },
            NamedRow {
                name: None,
                count: 4,
                time: "2026-01-07T04:00:00.000001Z".into(),
                level: Some(0.1),
                levels: vec![None, None],
            },
        ];
        let mut decoder = RowDecoder::<NamedRow>::new(String::new());
        let rows = |decoded: Vec<Vec<NamedRow>>| decoded.into_iter().flatten().collect::<Vec<_>>();
        assert_eq!(rows(decoder.encode_batch(batch()).expect("rows")), expected);
        // A part of a batch counts without the rest.
        assert_eq!(rows(decoder.encode_batch(batch().slice(1, 1)).expect("rows")), expected[1..]);
    }

    #[test]
    fn rows_are_bounded_and_a_null_is_no_number() {
        let mut decoder = RowDecoder::<NamedRow> { bytes: MOST_BYTES, ..RowDecoder::new(String::new()) };
        assert!(matches!(decoder.encode_batch(batch()), Err(RequestFault::TooLarge { .. })));
        #[derive(Deserialize)]
        struct LevelRow {
            #[expect(dead_code, reason = "it is only read")]
            level: f32,
        }
        assert!(matches!(
            RowDecoder::<LevelRow>::new(String::new()).encode_batch(batch()),
            Err(RequestFault::Internal)
        ));
    }
}
