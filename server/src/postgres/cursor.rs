//! Cursors: a query that runs as far as its rows are fetched.

use std::sync::Arc;

use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use futures::stream;
use pgwire::api::portal::Format;
use pgwire::api::results::QueryResponse;
use pgwire::error::PgWireResult;
use pgwire::messages::data::DataRow;
use tokio::sync::Mutex;

use super::connection::CommandRun;
use super::rows::{RowEncoder, fields, flat};
use super::sqlstate::error;
use crate::fault::RequestFault;
use crate::running::RunningQuery;

/// A cursor.
pub(super) struct QueryCursor {
    /// Its columns.
    pub(super) schema: SchemaRef,
    /// True if it outlives its transaction (WITH HOLD).
    pub(super) held: bool,
    rows: Arc<Mutex<RemainingRows>>,
}

// The remaining rows.
struct RemainingRows {
    running: RunningQuery<RecordBatch>,
    begun: Option<RecordBatch>,
}

impl RemainingRows {
    // The next rows, at most this many.
    async fn take(&mut self, most: usize) -> Result<Option<RecordBatch>, RequestFault> {
        let batch = match self.begun.take() {
            Some(batch) => batch,
            None => match self.running.next().await? {
                Some(batch) => batch,
                None => return Ok(None),
            },
        };
        let count = most.min(batch.num_rows());
        if count < batch.num_rows() {
            self.begun = Some(batch.slice(count, batch.num_rows() - count));
        }
        Ok(Some(batch.slice(0, count)))
    }
}

impl QueryCursor {
    pub(super) fn new(running: RunningQuery<RecordBatch>, held: bool) -> Self {
        let schema = running.schema.clone();
        Self { schema, held, rows: Arc::new(Mutex::new(RemainingRows { running, begun: None })) }
    }

    /// The next rows; None for all.
    pub(super) async fn fetch(
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
        let parts = stream::try_unfold((rows, count), move |(rows, wanted)| {
            let encoder = encoder.clone();
            async move {
                let part: PgWireResult<_> = next(&rows, wanted, &encoder).await.map_err(|fault| error(&fault));
                Ok(part?.map(|(part, wanted)| (part, (rows, wanted))))
            }
        });
        let mut response = QueryResponse::new(fields(&self.schema, format)?, flat(parts));
        response.set_command_tag("FETCH");
        Ok(response)
    }
}

async fn next(
    rows: &Mutex<RemainingRows>,
    wanted: Option<u64>,
    encoder: &RowEncoder,
) -> Result<Option<(Vec<DataRow>, Option<u64>)>, RequestFault> {
    let most = wanted.map_or(usize::MAX, |n| usize::try_from(n).unwrap_or(usize::MAX));
    if most == 0 {
        return Ok(None);
    }
    let Some(batch) = rows.lock().await.take(most).await? else { return Ok(None) };
    let left = wanted.map(|n| n - batch.num_rows() as u64);
    Ok(Some((encoder.encode(batch)?, left)))
}
