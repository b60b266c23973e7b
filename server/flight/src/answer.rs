//! Answers as Flight data: schemas, tickets, and batches cut to what gRPC carries.

use std::pin::Pin;
use std::sync::Arc;

use arrow::array::RecordBatch;
use arrow::compute::cast;
use arrow::datatypes::{DataType, Schema, SchemaRef};
use arrow::error::ArrowError;
use arrow::ipc::writer::IpcWriteOptions;
use arrow_flight::encode::FlightDataEncoderBuilder;
use arrow_flight::error::FlightError;
use arrow_flight::sql::ProstMessageExt;
use arrow_flight::{FlightData, FlightDescriptor, FlightEndpoint, FlightInfo, IpcMessage, SchemaAsIpc, Ticket};
use bytes::Bytes;
use echolake_service::RequestFault;
use echolake_service::running::{AnswerEncoder, RunningQuery};
use futures::{Stream, StreamExt as _, TryStreamExt as _, stream};
use prost::Message as _;
use tonic::{Response, Status};

use super::status::grpc_status;

/// The stream that DoGet sends.
pub(super) type FlightStream = Pin<Box<dyn Stream<Item = Result<FlightData, Status>> + Send>>;

/// Encodes rows with the columns that were announced: the plan's, which may differ from those of its run in
/// nullability.
pub(super) struct AnnouncedColumns(pub SchemaRef);

impl AnswerEncoder for AnnouncedColumns {
    type Item = RecordBatch;

    fn encode_batch(&mut self, batch: RecordBatch) -> Result<Vec<RecordBatch>, RequestFault> {
        let wrong = RequestFault::defect::<ArrowError>("an answer does not have the announced columns");
        let columns = batch.columns().iter().zip(self.0.fields()).map(|(column, field)| {
            if column.data_type() == field.data_type() { Ok(column.clone()) } else { cast(column, field.data_type()) }
        });
        let columns = columns.collect::<Result<Vec<_>, _>>().map_err(wrong)?;
        Ok(vec![RecordBatch::try_new(self.0.clone(), columns).map_err(wrong)?])
    }

    fn encode_end(self) -> Result<Vec<RecordBatch>, RequestFault> {
        Ok(Vec::new())
    }
}

/// Returns whether these columns can be announced: a placeholder without a value has no type yet.
pub(super) fn is_settled(schema: &Schema) -> bool {
    schema.fields().iter().all(|f| *f.data_type() != DataType::Null)
}

/// The rows of a run. The answer begins with the first of them: until then, the door may ask another engine.
pub(super) async fn query_response(
    schema: SchemaRef,
    mut running: RunningQuery<RecordBatch>,
) -> Result<Response<FlightStream>, RequestFault> {
    let first = running.next_part().await?;
    let batches = stream::try_unfold((first, running), |(first, mut running)| async move {
        let batch = match first {
            Some(batch) => Ok(Some(batch)),
            None => running.next_part().await,
        };
        let batch = batch.map_err(|fault| FlightError::Tonic(Box::new(grpc_status(&fault))))?;
        Ok(batch.map(|batch| (batch, (None, running))))
    });
    Ok(stream_response(schema, batches))
}

/// The rows of a batch.
pub(super) fn batch_response(batch: Result<RecordBatch, FlightError>) -> Result<Response<FlightStream>, Status> {
    let batch = batch.map_err(|e| Status::internal(e.to_string()))?;
    Ok(stream_response(batch.schema(), stream::iter([Ok(batch)])))
}

// The encoder cuts batches to 2 MiB, half of what gRPC's clients take by default.
fn stream_response(
    schema: SchemaRef,
    batches: impl Stream<Item = Result<RecordBatch, FlightError>> + Send + 'static,
) -> Response<FlightStream> {
    let data = FlightDataEncoderBuilder::new().with_schema(schema).build(batches);
    Response::new(data.map_err(Status::from).boxed())
}

/// The ticket and the columns with which an answer is fetched.
pub(super) fn info_response(
    schema: Option<&Schema>,
    ticket: &impl ProstMessageExt,
    descriptor: FlightDescriptor,
) -> Result<Response<FlightInfo>, Status> {
    let ticket = Ticket { ticket: ticket.as_any().encode_to_vec().into() };
    let info = FlightInfo::new().with_endpoint(FlightEndpoint::new().with_ticket(ticket)).with_descriptor(descriptor);
    Ok(Response::new(match schema {
        Some(schema) => info.try_with_schema(schema).map_err(|e| Status::internal(e.to_string()))?,
        None => info,
    }))
}

/// Columns as a message.
pub(super) fn schema_bytes(schema: &Schema) -> Result<Bytes, Status> {
    let options = IpcWriteOptions::default();
    let message: Result<IpcMessage, ArrowError> = SchemaAsIpc::new(schema, &options).try_into();
    message.map(|m| m.0).map_err(|e| Status::internal(e.to_string()))
}

/// Columns, shared.
pub(super) fn share_schema(schema: Schema) -> SchemaRef {
    Arc::new(schema)
}
