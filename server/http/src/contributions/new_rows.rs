//! Rows of predictions that are sent again: those that are stored are stored once, others are added, and none changes.

use std::collections::HashMap;

use arrow::array::{Array as _, AsArray as _, BooleanArray};
use arrow::compute::filter_record_batch;
use arrow::datatypes::{DataType, Float64Type, Int32Type};
use arrow::record_batch::RecordBatch;
use echolake_service::RequestFault;

/// Model, version, surface and pair.
type PredictionKey<'a> = (&'a str, &'a str, &'a str, i32);
/// A row's key, and its values in some columns.
type KeyedValues<'a> = (PredictionKey<'a>, Vec<Option<f64>>);

/// Returns those of `rows` that are not among the `known` ones. Both have the columns of table `predictions`: a row is
/// named by model, version, surface and pair, and its values are the columns of numbers. Who sent it, when, and in
/// which request does not count.
///
/// # Errors
/// [`RequestFault::Taken`] if a row is known with other values.
pub(super) fn select_new_rows(known: &[RecordBatch], rows: &RecordBatch) -> Result<RecordBatch, RequestFault> {
    let numbers = rows.schema_ref().fields().iter().filter(|field| *field.data_type() == DataType::Float64);
    let names: Vec<&str> = numbers.map(|field| field.name().as_str()).collect();
    let mut stored = HashMap::new();
    for batch in known {
        stored.extend(read_keyed_values(batch, &names)?);
    }
    let mut is_new = Vec::with_capacity(rows.num_rows());
    for (key, values) in read_keyed_values(rows, &names)? {
        let known = stored.get(&key);
        if known.is_some_and(|known| *known != values) {
            let (model, version, surface, pair) = key;
            return Err(RequestFault::Taken {
                what: format!("a prediction of `{model}`, version `{version}`, for surface `{surface}`, pair {pair}"),
                hint: "stored predictions never change; send them with another version",
            });
        }
        is_new.push(known.is_none());
    }
    filter_record_batch(rows, &BooleanArray::from(is_new)).map_err(RequestFault::defect("rows are not filtered"))
}

// All rows, with their values in the columns of these names.
fn read_keyed_values<'a>(rows: &'a RecordBatch, names: &[&str]) -> Result<Vec<KeyedValues<'a>>, RequestFault> {
    let text = |name: &str| rows.column_by_name(name)?.as_string_opt::<i32>();
    let read = || {
        let [models, versions, surfaces] = [text("model")?, text("model_version")?, text("surface_id")?];
        let pairs = rows.column_by_name("pair_id")?.as_primitive_opt::<Int32Type>()?;
        let numbers = names.iter().map(|name| rows.column_by_name(name)?.as_primitive_opt::<Float64Type>());
        let numbers: Vec<_> = numbers.collect::<Option<_>>()?;
        let keyed = (0..rows.num_rows()).map(|row| {
            let values = numbers.iter().map(|column| column.is_valid(row).then(|| column.value(row)));
            ((models.value(row), versions.value(row), surfaces.value(row), pairs.value(row)), values.collect())
        });
        Some(keyed.collect())
    };
    read().ok_or_else(|| {
        tracing::error!("predictions have not the columns of their table");
        RequestFault::Internal
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use arrow::array::{ArrayRef, Float64Array, Int32Array, StringArray};

    use super::*;

    fn rows(version: &str, rows: &[(&str, i32, Option<f64>)]) -> RecordBatch {
        let texts = |text: &str| Arc::new(StringArray::from(vec![text; rows.len()])) as ArrayRef;
        let surfaces = StringArray::from_iter_values(rows.iter().map(|row| row.0));
        let pairs = Int32Array::from_iter_values(rows.iter().map(|row| row.1));
        let values = Float64Array::from_iter(rows.iter().map(|row| row.2));
        let empty = Float64Array::new_null(rows.len());
        RecordBatch::try_from_iter_with_nullable([
            ("model", texts("cnn"), false),
            ("model_version", texts(version), false),
            ("surface_id", Arc::new(surfaces) as ArrayRef, false),
            ("pair_id", Arc::new(pairs), false),
            ("tnce_2500", Arc::new(values), true),
            ("tnce_total", Arc::new(empty), true),
            ("author", texts("ann"), false),
        ])
        .expect("rows")
    }

    /// E9: rows that are sent again in another grouping are stored once, others are added.
    #[test]
    fn rows_that_are_sent_again_are_stored_once() {
        let known = [
            rows("1", &[("flat", 0, Some(0.5)), ("wood", 0, Some(0.25))]),
            rows("1", &[("flat", 1, None)]),
            rows("2", &[("brick", 0, Some(0.75))]),
        ];
        let check = |version: &str, sent: &[(&str, i32, Option<f64>)], expected: &[(&str, i32, Option<f64>)]| {
            let found = select_new_rows(&known, &rows(version, sent)).expect("no conflict");
            assert_eq!(found, rows(version, expected), "{version} {sent:?}");
        };
        let [flat, next, wood, brick] =
            [("flat", 0, Some(0.5)), ("flat", 1, None), ("wood", 0, Some(0.25)), ("brick", 0, Some(0.125))];
        check("1", &[flat], &[]);
        check("1", &[wood, next, flat], &[]);
        check("1", &[flat, brick], &[brick]);
        check("1", &[brick, flat, ("flat", 2, Some(0.5))], &[brick, ("flat", 2, Some(0.5))]);
        check("3", &[flat, wood], &[flat, wood]);
        check("1", &[], &[]);
    }

    /// E9: what is stored never changes.
    #[test]
    fn rows_that_are_stored_with_other_values_are_refused() {
        let known = [rows("1", &[("flat", 0, Some(0.5)), ("flat", 1, None)])];
        for changed in [("flat", 0, Some(0.25)), ("flat", 0, None), ("flat", 1, Some(0.0))] {
            let sent = rows("1", &[("brick", 0, Some(1.0)), changed]);
            let fault = select_new_rows(&known, &sent).expect_err("it is stored").to_string();
            let place = format!("for surface `flat`, pair {}", changed.1);
            assert!(fault.contains("`cnn`, version `1`") && fault.contains(&place), "{fault}");
        }
        let other = select_new_rows(&known, &rows("2", &[("flat", 0, Some(0.25))])).expect("another version");
        assert_eq!(other.num_rows(), 1);
    }
}
