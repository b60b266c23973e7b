//! Columns of types that Postgres has not, as JSON: lists of lists and of rows, and maps.

use std::sync::Arc;

use arrow::array::{ArrayRef, StringBuilder};
use arrow::datatypes::{DataType, Field};
use arrow::error::ArrowError;
use arrow::json::writer::{EncoderOptions, make_encoder};

/// Returns whether a column of this type is sent as JSON.
pub(super) fn is_json(kind: &DataType) -> bool {
    match kind {
        DataType::List(element) | DataType::LargeList(element) | DataType::FixedSizeList(element, _) => {
            element.data_type().is_nested()
        }
        DataType::Map(..) => true,
        _ => false,
    }
}

/// The values as texts of JSON; numbers that are not finite are null there.
///
/// # Errors
/// If a type within them has no JSON.
pub(super) fn json_texts(column: &ArrayRef) -> Result<ArrayRef, ArrowError> {
    let field = Arc::new(Field::new("", column.data_type().clone(), true));
    let options = EncoderOptions::default().with_explicit_nulls(true);
    let mut encoder = make_encoder(&field, column, &options)?;
    let mut texts = StringBuilder::new();
    let mut json = Vec::new();
    for row in 0..column.len() {
        if encoder.is_null(row) {
            texts.append_null();
            continue;
        }
        json.clear();
        encoder.encode(row, &mut json);
        texts.append_value(std::str::from_utf8(&json).map_err(|e| ArrowError::JsonError(e.to_string()))?);
    }
    Ok(Arc::new(texts.finish()))
}

#[cfg(test)]
mod tests {
    use arrow::array::{Array as _, AsArray as _, ListArray};
    use arrow::buffer::OffsetBuffer;
    use arrow::datatypes::Float32Type;

    use super::*;

    #[test]
    fn lists_of_lists_are_json() {
        let inner = [Some(vec![Some(1.0), None]), Some(vec![]), Some(vec![Some(f32::NAN)])];
        let inner = ListArray::from_iter_primitive::<Float32Type, _, _>(inner);
        let field = Arc::new(Field::new("item", inner.data_type().clone(), true));
        let offsets = OffsetBuffer::from_lengths([2, 0, 1]);
        let nulls = Some(vec![true, false, true].into());
        let outer: ArrayRef = Arc::new(ListArray::new(field, offsets, Arc::new(inner.clone()), nulls));
        assert!(is_json(outer.data_type()) && !is_json(inner.data_type()));
        let texts = json_texts(&outer).expect("JSON");
        let texts: Vec<_> = texts.as_string::<i32>().iter().collect();
        assert_eq!(texts, [Some("[[1.0,null],[]]"), None, Some("[[null]]")]);
    }
}
