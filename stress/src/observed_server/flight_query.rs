//! Queries over Arrow Flight SQL: GetFlightInfo, then DoGet of each endpoint.

use arrow::array::RecordBatch;
use arrow::csv::WriterBuilder;
use arrow::error::ArrowError;
use arrow_flight::error::FlightError;
use arrow_flight::sql::client::FlightSqlServiceClient;
use futures::TryStreamExt as _;
use tonic::transport::{Channel, Endpoint};

use super::query_client::AnswerDigest;
use super::{QueryClient, QueryOutcome};

/// Bytes of one message: as many as a text of Arrow may have.
const LARGEST_MESSAGE: usize = 2 << 30;

/// A client of Flight SQL.
pub(crate) type FlightClient = FlightSqlServiceClient<Channel>;

/// Runs a query; rows are compared as CSV, which does not depend on how they are cut into batches.
pub(super) fn query_flight(client: &QueryClient, sql: &str) -> QueryOutcome {
    let mut digest = AnswerDigest::default();
    match client.connections.run(fetch_rows(client, sql, &mut digest)) {
        Some(Ok(())) => QueryOutcome::Answer(digest),
        failed => failure_outcome(failed.and_then(Result::err)),
    }
}

/// Returns the outcome of a call that failed by this error, or whose connections were closed.
pub(crate) fn failure_outcome(error: Option<FlightError>) -> QueryOutcome {
    // The server's own errors have a code; others come from a connection that ended.
    match error {
        None => QueryOutcome::Abandoned,
        Some(FlightError::Tonic(status)) => match status.metadata().get("echolake-code").map(|code| code.to_str()) {
            Some(Ok(code)) => QueryOutcome::Refused(code.to_owned()),
            _ if is_transport(&status) => QueryOutcome::Disconnected,
            _ => QueryOutcome::Refused(format!("grpc {:?}", status.code())),
        },
        Some(_) => QueryOutcome::Disconnected,
    }
}

/// Connects with the client's token.
///
/// # Errors
/// The connection is not accepted.
pub(crate) async fn flight_client(client: &QueryClient) -> Result<FlightClient, FlightError> {
    let failed = |error| FlightError::ExternalError(Box::new(error));
    let endpoint = Endpoint::from_shared(format!("http://{}", client.addresses.flight_sql)).map_err(failed)?;
    let channel = endpoint.local_address(Some(client.connections.source().into())).connect().await.map_err(failed)?;
    let inner = arrow_flight::flight_service_client::FlightServiceClient::new(channel);
    let mut flight = FlightClient::new_from_inner(inner.max_decoding_message_size(LARGEST_MESSAGE));
    flight.set_token(client.token.clone());
    Ok(flight)
}

async fn fetch_rows(client: &QueryClient, sql: &str, digest: &mut AnswerDigest) -> Result<(), FlightError> {
    let mut flight = flight_client(client).await?;
    let info = flight.execute(sql.to_owned(), None).await?;
    for ticket in info.endpoint.into_iter().filter_map(|endpoint| endpoint.ticket) {
        let mut rows = flight.do_get(ticket).await?;
        while let Some(batch) = rows.try_next().await? {
            write_rows(&batch, digest)?;
        }
    }
    Ok(())
}

// Lists have no CSV; of their rows only the number is compared.
fn write_rows(batch: &RecordBatch, digest: &mut AnswerDigest) -> Result<(), ArrowError> {
    let written = WriterBuilder::new().with_header(false).build(&mut *digest).write(batch);
    if let Err(ArrowError::CsvError(_)) = written {
        digest.update(&batch.num_rows().to_be_bytes());
        return Ok(());
    }
    written
}

fn is_transport(status: &tonic::Status) -> bool {
    matches!(status.code(), tonic::Code::Unavailable | tonic::Code::Unknown | tonic::Code::Internal)
}
