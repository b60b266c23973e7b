//! Values of a statement's placeholders, as a client puts them: one row of a batch.

use arrow::array::RecordBatch;
use arrow::datatypes::{DataType, Field, Schema};
use arrow::ipc::root_as_message;
use arrow_flight::FlightData;
use arrow_flight::decode::FlightRecordBatchStream;
use arrow_flight::error::FlightError;
use arrow_flight::sql::server::PeekableFlightDataStream;
use datafusion::common::{ParamValues, ScalarValue};
use echolake_query::PreparedQuery;
use echolake_service::RequestFault;
use futures::TryStreamExt as _;

/// The placeholders as columns.
pub(super) fn parameter_schema(prepared: &PreparedQuery) -> Result<Schema, RequestFault> {
    let fields = prepared.parameter_types()?.into_iter().enumerate().map(|(i, kind)| {
        let kind = kind.unwrap_or(DataType::Null);
        Field::new(format!("${}", i + 1), kind, true)
    });
    Ok(Schema::new(fields.collect::<Vec<_>>()))
}

// What a compressed body says of its own length is believed, and allocated, before anything is unpacked.
fn require_uncompressed(message: FlightData) -> Result<FlightData, FlightError> {
    let header = root_as_message(&message.data_header).map_err(|e| FlightError::DecodeError(e.to_string()))?;
    let batch = header.header_as_dictionary_batch().and_then(|dictionary| dictionary.data());
    let batch = header.header_as_record_batch().or(batch);
    match batch.and_then(|batch| batch.compression()) {
        None => Ok(message),
        Some(_) => {
            Err(FlightError::DecodeError("their body is compressed; hint: one row needs no compression".to_owned()))
        }
    }
}

/// The values that a client puts.
pub(super) async fn read_values(
    stream: PeekableFlightDataStream,
    prepared: &PreparedQuery,
) -> Result<ParamValues, RequestFault> {
    let wrong = |e: FlightError| RequestFault::bad_request(format!("the values cannot be read: {e}"));
    let data = stream.into_peekable().map_err(|status| FlightError::Tonic(Box::new(status)));
    let data = data.and_then(async |message| require_uncompressed(message));
    let mut batches = FlightRecordBatchStream::new_from_flight_data(data);
    let mut row: Option<RecordBatch> = None;
    while let Some(batch) = batches.try_next().await.map_err(wrong)? {
        match batch.num_rows() {
            0 => {}
            1 if row.is_none() => row = Some(batch),
            _ => return Err(RequestFault::unsupported("more than one row of values; a query takes one")),
        }
    }
    let Some(row) = row else { return Ok(ParamValues::from(Vec::<ScalarValue>::new())) };
    let kinds = prepared.parameter_types()?;
    if row.num_columns() != kinds.len() {
        let given = row.num_columns();
        let wanted = kinds.len();
        return Err(RequestFault::bad_request(format!("{given} values for {wanted} placeholders")));
    }
    let values = row.columns().iter().zip(kinds).enumerate().map(|(i, (column, kind))| {
        let wrong = |e| RequestFault::bad_request(format!("the value of ${}: {e}", i + 1));
        let value = ScalarValue::try_from_array(column, 0).map_err(wrong)?;
        match kind {
            Some(kind) if kind != value.data_type() => value.cast_to(&kind).map_err(wrong),
            _ => Ok(value),
        }
    });
    Ok(ParamValues::from(values.collect::<Result<Vec<_>, RequestFault>>()?))
}
