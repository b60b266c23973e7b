//! Cursors: a query that runs as far as its rows are fetched.

use std::sync::Arc;

use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use echolake_service::running::{RunningQuery, SessionTimeLimit};
use echolake_service::{RequestFault, StopSignal};
use futures::stream;
use pgwire::api::portal::Format;
use pgwire::api::results::QueryResponse;
use pgwire::error::PgWireError;
use pgwire::messages::data::DataRow;
use tokio::sync::Mutex;

use super::rows::{RowEncoder, column_fields, flatten_rows};
use super::sqlstate::failure;

/// Stop signal and time limit of a command.
#[derive(Clone)]
pub(super) struct CommandRun {
    pub stop: StopSignal,
    pub limit: Option<SessionTimeLimit>,
}

/// A cursor.
pub(super) struct QueryCursor {
    /// Its columns.
    pub schema: SchemaRef,
    /// True if it outlives its transaction (WITH HOLD).
    pub held: bool,
    rows: Arc<Mutex<RemainingRows>>,
}

// The remaining rows.
struct RemainingRows {
    running: RunningQuery<RecordBatch>,
    begun: Option<RecordBatch>,
}

impl RemainingRows {
    // Encodes the next rows, at most this many.
    async fn next_rows(&mut self, most: usize, encoder: &RowEncoder) -> Result<Option<Vec<DataRow>>, RequestFault> {
        if most == 0 {
            return Ok(None);
        }
        let batch = match self.begun.take() {
            Some(batch) => batch,
            None => match self.running.next_part().await? {
                Some(batch) => batch,
                None => return Ok(None),
            },
        };
        let count = most.min(batch.num_rows());
        if count < batch.num_rows() {
            self.begun = Some(batch.slice(count, batch.num_rows() - count));
        }
        encoder.encode_rows(batch.slice(0, count)).map(Some)
    }
}

impl QueryCursor {
    pub fn new(running: RunningQuery<RecordBatch>, held: bool) -> Self {
        let schema = running.schema.clone();
        Self { schema, held, rows: Arc::new(Mutex::new(RemainingRows { running, begun: None })) }
    }

    /// The next rows; None for all.
    pub async fn fetch_rows(
        &self,
        count: Option<u64>,
        run: &CommandRun,
        format: &Format,
    ) -> Result<QueryResponse, RequestFault> {
        let rows = self.rows.clone();
        {
            // A fetch has a time of its own, and a CancelRequest ends what is fetched.
            let mut left = rows.lock().await;
            left.running.limit = run.limit;
            left.running.stop = run.stop.clone();
        }
        let encoder = Arc::new(RowEncoder::new(&self.schema, format)?);
        let most = count.map_or(usize::MAX, |count| usize::try_from(count).unwrap_or(usize::MAX));
        let parts = stream::try_unfold((rows, most), move |(rows, most)| {
            let encoder = encoder.clone();
            async move {
                let Some(part) = rows.lock().await.next_rows(most, &encoder).await.map_err(failure)? else {
                    return Ok(None);
                };
                let left = most - part.len();
                Ok::<_, PgWireError>(Some((part, (rows, left))))
            }
        });
        let mut response = QueryResponse::new(column_fields(&self.schema, format)?, flatten_rows(parts));
        response.set_command_tag("FETCH");
        Ok(response)
    }
}
