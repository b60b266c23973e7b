//! Rows as Postgres sends them.

use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _, StringArray, StringBuilder};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Field, FieldRef, Int32Type, Schema, SchemaRef};
use arrow::error::ArrowError;
use arrow::json::writer::{EncoderOptions, make_encoder};
use arrow::record_batch::{RecordBatch, RecordBatchOptions};
use arrow_pg::datatypes::{PG_OID_ALIAS_KEY, arrow_schema_to_pg_fields};
use arrow_pg::encode_recordbatch;
use echolake_query::Error as QueryError;
use echolake_service::RequestFault;
use echolake_service::running::{AnswerEncoder, RunningQuery};
use futures::{Stream, TryStreamExt as _, stream};
use pgwire::api::Type;
use pgwire::api::portal::Format;
use pgwire::api::results::{DataRowEncoder, FieldFormat, FieldInfo, QueryResponse};
use pgwire::error::{PgWireError, PgWireResult};
use pgwire::messages::data::DataRow;

use super::columns::REPEATED;
use super::fixed_tables::{VECTOR_KEY, function_name};
use super::sqlstate::failure;

/// Columns as fields.
pub(super) fn column_fields(schema: &Schema, format: &Format) -> Result<Arc<Vec<FieldInfo>>, RequestFault> {
    let count = schema.fields().len();
    if let Format::Individual(codes) = format
        && codes.len() != count
    {
        return Err(RequestFault::bad_request(format!("{} formats for {count} columns", codes.len())));
    }
    // A cast keeps the metadata of what it casts: numbers alone are those of the catalogue.
    let own = |field: &FieldRef| match field.data_type() {
        DataType::List(_) if field.metadata().contains_key(VECTOR_KEY) => field.clone(),
        DataType::Int32 | DataType::Utf8 if !is_cast_number(field) => field.clone(),
        kind if is_json(kind) => Arc::new(Field::new(field.name(), DataType::Utf8, field.is_nullable())),
        kind => Arc::new(Field::new(field.name(), kind.clone(), field.is_nullable())),
    };
    let sent = Schema::new(schema.fields().iter().map(own).collect::<Vec<_>>());
    let fields = arrow_schema_to_pg_fields(&sent, format, None).map_err(|e| encoding_fault(&e))?;
    let settled = |(field, (own, column)): (FieldInfo, (&FieldRef, &FieldRef))| {
        // A column of nothing but NULL is a text to Postgres' clients.
        let kind = match *field.datatype() {
            Type::UNKNOWN => Type::TEXT,
            _ if is_json(column.data_type()) => Type::JSON,
            _ if own.metadata().contains_key(VECTOR_KEY) && field.format() == FieldFormat::Text => Type::TEXT,
            ref kind => kind.clone(),
        };
        let name = field.name().split(REPEATED).next().unwrap_or_default();
        FieldInfo::new(name.to_owned(), None, None, kind, field.format())
    };
    Ok(Arc::new(fields.into_iter().zip(sent.fields().iter().zip(schema.fields())).map(settled).collect()))
}

// The numbers of a list, with spaces between them.
fn spaced_numbers(list: ArrayRef) -> Option<String> {
    let numbers = cast(&list, &DataType::Utf8).ok()?;
    let numbers: Vec<_> = numbers.as_string::<i32>().iter().flatten().collect();
    Some(numbers.join(" "))
}

fn is_cast_number(field: &FieldRef) -> bool {
    *field.data_type() == DataType::Utf8 && field.metadata().contains_key(PG_OID_ALIAS_KEY)
}

/// The fault for a value that cannot be sent to a Postgres client.
pub(super) fn encoding_fault(error: &PgWireError) -> RequestFault {
    let message = match error {
        PgWireError::UserError(info) => info.message.clone(),
        other => other.to_string(),
    };
    RequestFault::Query(QueryError::Format { format: "a row of Postgres", source: message.into() })
}

/// Encodes rows.
pub(super) struct RowEncoder(Arc<Vec<FieldInfo>>);

impl RowEncoder {
    /// For an answer of these columns.
    pub fn new(schema: &SchemaRef, format: &Format) -> Result<Self, RequestFault> {
        Ok(Self(column_fields(schema, format)?))
    }

    /// The rows of a batch.
    pub fn encode_rows(&self, batch: RecordBatch) -> Result<Vec<DataRow>, RequestFault> {
        let batch = sent_columns(&self.0, batch)?;
        let rows: PgWireResult<Vec<_>> = encode_recordbatch(self.0.clone(), batch).collect();
        rows.map_err(|e| encoding_fault(&e))
    }
}

/// Columns as Postgres has them: in texts a function's number is its name, and some lists have no brackets; what
/// Postgres has no type for is JSON.
///
/// # Errors
/// If a value has no JSON.
pub(super) fn sent_columns(infos: &[FieldInfo], batch: RecordBatch) -> Result<RecordBatch, RequestFault> {
    let columns = infos.iter().zip(batch.columns()).map(|(info, column)| sent_column(info, column));
    let columns: Result<Vec<_>, ArrowError> = columns.collect();
    let refused = |e: ArrowError| encoding_fault(&PgWireError::ApiError(e.into()));
    let columns = columns.map_err(refused)?;
    let own = batch.schema();
    let field = |(field, column): (&FieldRef, &ArrayRef)| match column.data_type() {
        kind if kind == field.data_type() => field.clone(),
        kind => Arc::new(Field::new(field.name(), kind.clone(), true)),
    };
    let fields: Vec<_> = own.fields().iter().zip(&columns).map(field).collect();
    let options = RecordBatchOptions::new().with_row_count(Some(batch.num_rows()));
    RecordBatch::try_new_with_options(Arc::new(Schema::new(fields)), columns, &options).map_err(refused)
}

fn sent_column(info: &FieldInfo, column: &ArrayRef) -> Result<ArrayRef, ArrowError> {
    if is_json(column.data_type()) {
        return json_texts(column);
    }
    let is_text = info.format() == FieldFormat::Text;
    Ok(match (column.as_primitive_opt::<Int32Type>(), column.as_list_opt::<i32>()) {
        (Some(numbers), _) if is_text && *info.datatype() == Type::REGPROC => {
            Arc::new(numbers.iter().map(|number| function_name(number?)).collect::<StringArray>())
        }
        (_, Some(lists)) if is_text && *info.datatype() == Type::TEXT => {
            Arc::new(lists.iter().map(|list| list.and_then(spaced_numbers)).collect::<StringArray>())
        }
        _ => column.clone(),
    })
}

impl AnswerEncoder for RowEncoder {
    type Item = Vec<DataRow>;

    fn encode_batch(&mut self, batch: RecordBatch) -> Result<Vec<Vec<DataRow>>, RequestFault> {
        Ok(vec![self.encode_rows(batch)?])
    }

    fn encode_end(self) -> Result<Vec<Vec<DataRow>>, RequestFault> {
        Ok(Vec::new())
    }
}

/// The rows of a run, as they come.
pub(super) fn rows_response(
    running: RunningQuery<Vec<DataRow>>,
    format: &Format,
) -> Result<QueryResponse, RequestFault> {
    let fields = column_fields(&running.schema, format)?;
    let parts = stream::try_unfold(running, |mut running| async move {
        let part = running.next_part().await.map_err(failure)?;
        Ok::<_, PgWireError>(part.map(|part| (part, running)))
    });
    Ok(QueryResponse::new(fields, flatten_rows(parts)))
}

/// Rows one by one.
pub(super) fn flatten_rows(
    parts: impl Stream<Item = PgWireResult<Vec<DataRow>>> + Send + 'static,
) -> impl Stream<Item = PgWireResult<DataRow>> + Send + 'static {
    parts.map_ok(|rows| stream::iter(rows.into_iter().map(Ok))).try_flatten()
}

/// Columns of text.
pub(super) fn text_fields(names: &[&str]) -> Arc<Vec<FieldInfo>> {
    let field = |name: &&str| FieldInfo::new((*name).to_owned(), None, None, Type::TEXT, FieldFormat::Text);
    Arc::new(names.iter().map(field).collect())
}

/// Rows of text.
pub(super) fn text_response(names: &[&str], rows: &[Vec<String>]) -> Result<QueryResponse, RequestFault> {
    let fields = text_fields(names);
    let mut encoder = DataRowEncoder::new(fields.clone());
    let mut encoded = Vec::with_capacity(rows.len());
    for row in rows {
        for value in row {
            encoder.encode_field(value).map_err(|e| encoding_fault(&e))?;
        }
        encoded.push(Ok(encoder.take_row()));
    }
    Ok(QueryResponse::new(fields, stream::iter(encoded)))
}

// A type that Postgres has not: lists of lists and of rows, and maps.
fn is_json(kind: &DataType) -> bool {
    match kind {
        DataType::List(element) | DataType::LargeList(element) | DataType::FixedSizeList(element, _) => {
            element.data_type().is_nested()
        }
        DataType::Map(..) => true,
        _ => false,
    }
}

// The values as texts of JSON; numbers that are not finite are null there.
fn json_texts(column: &ArrayRef) -> Result<ArrayRef, ArrowError> {
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
    use arrow::array::ListArray;
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
