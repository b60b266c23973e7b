//! `system.queries` and `system.connections` in an engine: the door has their rows, and is asked for them.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use arrow::datatypes::{DataType, Field, Schema, SchemaRef, TimeUnit};
use arrow::record_batch::RecordBatch;
use async_trait::async_trait;
use echolake_query::SystemSource;
use echolake_schema::tables::{COMMENT, UNIT};
use serde::Serialize;
use tokio::sync::oneshot;

use crate::activity::{ActivityRows, ActivityTable};
use crate::engine_report::EngineReport;

/// Time for which an engine waits for rows.
const ANSWER_LIMIT: Duration = Duration::from_secs(10);
/// The tables.
const TABLES: [(&str, ActivityTable); 2] =
    [("queries", ActivityTable::Queries), ("connections", ActivityTable::Connections)];

/// Rows that the door is asked for.
#[derive(Debug, Default)]
pub(crate) struct DoorRows {
    last: AtomicU64,
    waiting: Mutex<HashMap<u64, oneshot::Sender<ActivityRows>>>,
}

impl DoorRows {
    /// Takes the door's answer.
    pub fn take_answer(&self, number: u64, rows: ActivityRows) {
        if let Some(waiting) = self.lock_waiting().remove(&number) {
            // Who asked may be gone.
            let _ = waiting.send(rows);
        }
    }

    async fn ask_door(&self, table: ActivityTable, client: String, sees_all: bool) -> Result<ActivityRows, String> {
        let number = self.last.fetch_add(1, Ordering::Relaxed);
        let (send, answer) = oneshot::channel();
        self.lock_waiting().insert(number, send);
        EngineReport::Ask { number, table, client, sees_all }.send_line();
        let rows = tokio::time::timeout(ANSWER_LIMIT, answer).await;
        self.lock_waiting().remove(&number);
        rows.ok().and_then(Result::ok).ok_or_else(|| "the server did not list its activity".to_owned())
    }

    fn lock_waiting(&self) -> MutexGuard<'_, HashMap<u64, oneshot::Sender<ActivityRows>>> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The rows that one client sees.
#[derive(Debug)]
pub(crate) struct ClientRows {
    pub door: Arc<DoorRows>,
    /// Name of the client.
    pub client: String,
    /// Whether it sees other clients' rows, too.
    pub sees_all: bool,
}

#[async_trait]
impl SystemSource for ClientRows {
    fn table_schemas(&self) -> Vec<(&'static str, SchemaRef)> {
        TABLES.map(|(name, table)| (name, activity_schema(table))).to_vec()
    }

    async fn read_rows(&self, table: &'static str) -> Result<RecordBatch, String> {
        let Some((_, table)) = TABLES.into_iter().find(|(name, _)| *name == table) else {
            return Err(format!("there is no table system.{table}"));
        };
        match self.door.ask_door(table, self.client.clone(), self.sees_all).await? {
            ActivityRows::Queries(queries) => row_batch(table, &queries),
            ActivityRows::Connections(connections) => row_batch(table, &connections),
        }
    }
}

fn activity_schema(table: ActivityTable) -> SchemaRef {
    let column = |(name, kind, is_nullable, unit, comment): (&str, DataType, bool, &str, &str)| {
        let metadata = [(UNIT.to_owned(), unit.to_owned()), (COMMENT.to_owned(), comment.to_owned())];
        Field::new(name, kind, is_nullable).with_metadata(HashMap::from(metadata))
    };
    let (text, count, flag) = (|| DataType::Utf8, || DataType::UInt64, || DataType::Boolean);
    let (seconds, time) = (|| DataType::Float64, || DataType::Timestamp(TimeUnit::Microsecond, Some("UTC".into())));
    let columns = match table {
        ActivityTable::Queries => vec![
            ("id", count(), false, "", "Number since the start of the server, by which it is cancelled"),
            ("client", text(), false, "", "Name of the token, or of the client of a server without tokens"),
            ("protocol", text(), false, "", "http, flight_sql, postgres or mcp"),
            ("statement", text(), true, "", "Text, its first 2000 characters; null for queries of other clients"),
            ("outcome", text(), false, "", "running, answered, or the code of the failure"),
            ("started", time(), false, "", "Start, UTC"),
            ("plan_seconds", seconds(), true, "s", "Time until it was planned"),
            ("first_row_seconds", seconds(), true, "s", "Time until it had its first rows"),
            ("seconds", seconds(), true, "s", "Time until its last row was sent; null while it runs"),
            ("rows", count(), true, "1", "Rows of the answer; null while it runs"),
            ("bytes", count(), true, "B", "Bytes of these rows before they are encoded"),
            ("memory_bytes", count(), true, "B", "The most that its operators held"),
        ],
        ActivityTable::Connections => vec![
            ("id", count(), false, "", "Number since the start of the server"),
            ("client", text(), true, "", "Client of its last request; null before the first"),
            ("protocol", text(), false, "", "http, flight_sql or postgres"),
            ("peer", text(), false, "", "Address of the other side"),
            ("started", time(), false, "", "Start, UTC"),
            ("requests", count(), false, "1", "Requests so far; a session of Postgres' protocol is one"),
            ("is_working", flag(), false, "", "Whether a request is being answered"),
        ],
    };
    Arc::new(Schema::new(columns.into_iter().map(column).collect::<Vec<_>>()))
}

fn row_batch<T: Serialize>(table: ActivityTable, rows: &[T]) -> Result<RecordBatch, String> {
    let schema = activity_schema(table);
    let batch = serde_arrow::to_record_batch(schema.fields(), &rows).map_err(|e| e.to_string())?;
    RecordBatch::try_new(schema, batch.columns().to_vec()).map_err(|e| e.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::activity::LoggedQuery;
    use crate::activity::OpenConnection;

    #[test]
    fn rows_fit_their_schemas() {
        let query = LoggedQuery {
            id: 1,
            client: "ann".to_owned(),
            protocol: "http".to_owned(),
            statement: None,
            outcome: "running".to_owned(),
            started: 5,
            plan_seconds: None,
            first_row_seconds: None,
            seconds: Some(0.5),
            rows: None,
            bytes: None,
            memory_bytes: None,
        };
        assert_eq!(row_batch(ActivityTable::Queries, &[query.clone(), query]).map(|batch| batch.num_rows()), Ok(2));
        assert_eq!(row_batch::<LoggedQuery>(ActivityTable::Queries, &[]).map(|batch| batch.num_rows()), Ok(0));
        let connection = OpenConnection {
            id: 1,
            client: None,
            protocol: "http".to_owned(),
            peer: "127.0.0.1:4000".to_owned(),
            started: 5,
            requests: 1,
            is_working: true,
        };
        assert_eq!(row_batch(ActivityTable::Connections, &[connection]).map(|batch| batch.num_rows()), Ok(1));
    }
}
