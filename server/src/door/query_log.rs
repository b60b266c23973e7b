//! Queries that run or ran, as the door knows them from its engines.

use std::collections::{HashMap, VecDeque};
use std::sync::{Mutex, MutexGuard, PoisonError};

use echolake_service::{FaultCode, LoggedQuery, QueryEnd, QueryStart};

use crate::random_id::random_id;

/// Queries that are remembered after their end, of all clients together.
const REMEMBERED: usize = 1_000;

/// Queries that run, and the last ones that ran.
#[derive(Default)]
pub(crate) struct QueryLog(Mutex<LoggedQueries>);

#[derive(Default)]
struct LoggedQueries {
    /// By engine, and number in it.
    running: HashMap<(u32, u64), LoggedQuery>,
    ended: VecDeque<LoggedQuery>,
}

/// A query that runs in an engine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct RunningPlace {
    pub client: String,
    /// Process of its engine, and its number there.
    pub engine: u32,
    pub number: u64,
}

impl QueryLog {
    /// Takes note of a query that begins in an engine.
    pub fn log_begin(&self, engine: u32, start: QueryStart) {
        let mut queries = self.lock_queries();
        let query = LoggedQuery {
            id: random_id(),
            client: start.client,
            protocol: start.protocol.name().to_owned(),
            statement: Some(start.statement),
            outcome: "running".to_owned(),
            started: start.started,
            plan_seconds: None,
            first_row_seconds: None,
            seconds: None,
            rows: None,
            bytes: None,
            memory_bytes: None,
        };
        queries.running.insert((engine, start.number), query);
    }

    /// Takes note of the end of a query.
    pub fn log_end(&self, engine: u32, end: &QueryEnd) {
        let mut queries = self.lock_queries();
        let Some(mut query) = queries.running.remove(&(engine, end.number)) else { return };
        query.outcome = end.failure.map_or("answered", FaultCode::name).to_owned();
        query.plan_seconds = end.plan_seconds;
        query.first_row_seconds = end.first_row_seconds;
        query.seconds = Some(end.seconds);
        (query.rows, query.bytes) = (Some(end.rows), Some(end.bytes));
        query.memory_bytes = Some(end.memory);
        queries.remember_query(query);
    }

    /// Takes note of the end of an engine, and of all that it ran; returns how many queries these were.
    pub fn end_engine(&self, engine: u32) -> usize {
        let mut queries = self.lock_queries();
        let lost: Vec<_> = queries.running.extract_if(|(of, _), _| *of == engine).map(|(_, query)| query).collect();
        let count = lost.len();
        for mut query in lost {
            query.outcome = FaultCode::EngineEnded.name().to_owned();
            queries.remember_query(query);
        }
        count
    }

    /// Finds a query that runs.
    pub fn find_running(&self, id: u64) -> Option<RunningPlace> {
        let queries = self.lock_queries();
        let mut running = queries.running.iter().filter(|(_, query)| query.id == id);
        running.next().map(|((engine, number), query)| RunningPlace {
            client: query.client.clone(),
            engine: *engine,
            number: *number,
        })
    }

    /// The queries of a client, the latest first. With `all`, those of the others too, without their texts.
    pub fn query_rows(&self, client: &str, all: bool) -> Vec<LoggedQuery> {
        let queries = self.lock_queries();
        let known = queries.running.values().chain(&queries.ended);
        let mut rows: Vec<_> = known.filter(|query| all || query.client == client).cloned().collect();
        rows.iter_mut().filter(|query| query.client != client).for_each(|query| query.statement = None);
        rows.sort_by_key(|query| std::cmp::Reverse(query.started));
        rows
    }

    fn lock_queries(&self) -> MutexGuard<'_, LoggedQueries> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl LoggedQueries {
    fn remember_query(&mut self, query: LoggedQuery) {
        if self.ended.len() >= REMEMBERED {
            self.ended.pop_front();
        }
        self.ended.push_back(query);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echolake_service::ServerProtocol;

    fn begin(log: &QueryLog, client: &str, engine: u32, number: u64) {
        let statement = format!("select {number}");
        let started = log.query_rows(client, true).len() as i64;
        let client = client.to_owned();
        log.log_begin(engine, QueryStart { number, client, protocol: ServerProtocol::Http, statement, started });
    }

    fn end(number: u64, failure: Option<FaultCode>) -> QueryEnd {
        let (plan_seconds, first_row_seconds) = (Some(0.5), None);
        QueryEnd { number, failure, plan_seconds, first_row_seconds, seconds: 1.0, rows: 2, bytes: 3, memory: 4 }
    }

    #[test]
    fn a_client_sees_its_own_queries() {
        let log = QueryLog::default();
        begin(&log, "ann", 7, 0);
        begin(&log, "bob", 8, 0);
        let ann = log.query_rows("ann", false);
        assert_eq!((ann.len(), ann[0].statement.as_deref()), (1, Some("select 0")));
        let all = log.query_rows("ann", true);
        let told: Vec<_> = all.iter().map(|q| (q.client.as_str(), q.statement.is_some())).collect();
        assert_eq!(told, [("bob", false), ("ann", true)], "texts are their client's alone");
        let bobs = RunningPlace { client: "bob".to_owned(), engine: 8, number: 0 };
        assert_eq!(log.find_running(all[0].id), Some(bobs));
    }

    #[test]
    fn queries_end_by_themselves_or_with_their_engine() {
        let log = QueryLog::default();
        begin(&log, "ann", 7, 0);
        begin(&log, "ann", 7, 1);
        begin(&log, "ann", 7, 2);
        log.log_end(7, &end(0, None));
        log.log_end(7, &end(1, Some(FaultCode::TimeLimit)));
        log.log_end(9, &end(2, None));
        assert_eq!(log.end_engine(7), 1);
        let rows = log.query_rows("ann", false);
        let outcomes: Vec<_> = rows.iter().map(|query| query.outcome.as_str()).collect();
        assert_eq!(outcomes, ["query_ended_engine", "time_limit", "answered"]);
        assert_eq!(log.find_running(rows[0].id), None);
    }

    #[test]
    fn the_oldest_are_forgotten() {
        let log = QueryLog::default();
        for number in 0..REMEMBERED as u64 + 10 {
            begin(&log, "ann", 7, number);
            log.log_end(7, &end(number, None));
        }
        let rows = log.query_rows("ann", false);
        let oldest = rows.last().and_then(|query| query.statement.as_deref());
        assert_eq!((rows.len(), oldest), (REMEMBERED, Some("select 10")));
    }

    #[test]
    fn ids_do_not_tell_what_others_ask() {
        let log = QueryLog::default();
        (0..9).for_each(|number| begin(&log, "ann", 7, number));
        let ids: Vec<_> = log.query_rows("ann", false).iter().map(|query| query.id).collect();
        assert!(ids.windows(2).all(|pair| pair[0].abs_diff(pair[1]) > 1_000), "{ids:?}");
        assert!(ids.iter().all(|id| *id < 1 << 53), "pages compute with them");
    }
}
