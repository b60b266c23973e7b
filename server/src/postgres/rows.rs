//! Rows as Postgres sends them.

use std::sync::Arc;

use arrow::datatypes::{Schema, SchemaRef};
use arrow::record_batch::RecordBatch;
use arrow_pg::datatypes::arrow_schema_to_pg_fields;
use arrow_pg::encode_recordbatch;
use echolake_query::Error as QueryError;
use futures::{Stream, TryStreamExt as _, stream};
use pgwire::api::Type;
use pgwire::api::portal::Format;
use pgwire::api::results::{DataRowEncoder, FieldFormat, FieldInfo, QueryResponse};
use pgwire::error::{PgWireError, PgWireResult};
use pgwire::messages::data::DataRow;

use super::sqlstate::error;
use crate::fault::RequestFault;
use crate::running::{AnswerEncoder, RunningQuery};

/// Columns as fields.
pub(super) fn fields(schema: &Schema, format: &Format) -> Result<Arc<Vec<FieldInfo>>, RequestFault> {
    let count = schema.fields().len();
    if let Format::Individual(codes) = format
        && codes.len() != count
    {
        return Err(RequestFault::request(format!("{} formats for {count} columns", codes.len())));
    }
    let fields = arrow_schema_to_pg_fields(schema, format, None).map_err(|e| encoding(&e))?;
    // A column of nothing but NULL is a text to Postgres' clients.
    let settled = |field: FieldInfo| match *field.datatype() {
        Type::UNKNOWN => FieldInfo::new(field.name().to_owned(), None, None, Type::TEXT, field.format()),
        _ => field,
    };
    Ok(Arc::new(fields.into_iter().map(settled).collect()))
}

/// The fault for a value that cannot be sent to a Postgres client.
pub(super) fn encoding(error: &PgWireError) -> RequestFault {
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
    pub(super) fn new(schema: &SchemaRef, format: &Format) -> Result<Self, RequestFault> {
        Ok(Self(fields(schema, format)?))
    }

    /// The rows of a batch.
    pub(super) fn encode(&self, batch: RecordBatch) -> Result<Vec<DataRow>, RequestFault> {
        let rows: PgWireResult<Vec<_>> = encode_recordbatch(self.0.clone(), batch).collect();
        rows.map_err(|e| encoding(&e))
    }
}

impl AnswerEncoder for RowEncoder {
    type Item = Vec<DataRow>;

    fn batch(&mut self, batch: RecordBatch) -> Result<Vec<Vec<DataRow>>, RequestFault> {
        Ok(vec![self.encode(batch)?])
    }

    fn end(self) -> Result<Vec<Vec<DataRow>>, RequestFault> {
        Ok(Vec::new())
    }
}

/// The rows of a run, as they come.
pub(super) fn response(running: RunningQuery<Vec<DataRow>>, format: &Format) -> Result<QueryResponse, RequestFault> {
    let fields = fields(&running.schema, format)?;
    let parts = stream::try_unfold(running, |mut running| async move {
        let part = running.next().await.map_err(|fault| error(&fault))?;
        Ok(part.map(|part| (part, running)))
    });
    Ok(QueryResponse::new(fields, flat(parts)))
}

/// Rows one by one.
pub(super) fn flat(
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
pub(super) fn texts(names: &[&str], rows: &[Vec<String>]) -> Result<QueryResponse, RequestFault> {
    let fields = text_fields(names);
    let mut encoder = DataRowEncoder::new(fields.clone());
    let mut encoded = Vec::with_capacity(rows.len());
    for row in rows {
        for value in row {
            encoder.encode_field(value).map_err(|e| encoding(&e))?;
        }
        encoded.push(Ok(encoder.take_row()));
    }
    Ok(QueryResponse::new(fields, stream::iter(encoded)))
}
