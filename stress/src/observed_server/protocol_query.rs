//! Queries over any of the protocols.

use super::query_client::{QueryClient, QueryOutcome, QueryProtocol};
use super::{flight_query, http_query, postgres_query};

impl QueryClient {
    /// Runs a query and reads its answer to the end.
    pub fn query(&self, protocol: QueryProtocol, sql: &str) -> QueryOutcome {
        let outcome = match protocol {
            QueryProtocol::Http => http_query::query_http(self, sql),
            QueryProtocol::SliceFilter => http_query::query_slice(self, &slice_filter(sql)),
            QueryProtocol::PostgresSimple => postgres_query::query_simple(self, sql),
            QueryProtocol::PostgresExtended => postgres_query::query_extended(self, sql),
            QueryProtocol::FlightSql => flight_query::query_flight(self, sql),
        };
        let is_lost = matches!(outcome, QueryOutcome::Truncated | QueryOutcome::Disconnected);
        if is_lost && self.connections.is_closed() { QueryOutcome::Abandoned } else { outcome }
    }
}

// A predicate that needs the query's rows.
fn slice_filter(sql: &str) -> String {
    format!("exists ({sql})")
}
