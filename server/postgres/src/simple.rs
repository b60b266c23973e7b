//! The simple query protocol: a text of one or more statements, executed one after the other.

use std::fmt::Debug;
use std::sync::Arc;

use async_trait::async_trait;
use datafusion::common::{ParamValues, ScalarValue};
use futures::{Sink, SinkExt as _};
use pgwire::api::portal::Format;
use pgwire::api::query::{SimpleQueryHandler, send_query_response, send_ready_for_query};
use pgwire::api::results::Response;
use pgwire::api::store::PortalStore;
use pgwire::api::{ClientInfo, ClientPortalStore, PgWireConnectionState};
use pgwire::error::{PgWireError, PgWireResult};
use pgwire::messages::PgWireBackendMessage;
use pgwire::messages::response::EmptyQueryResponse;
use pgwire::messages::simplequery::Query;

use super::command::execute_statement;
use super::connection::PostgresConnection;
use super::sqlstate::failure;

/// Answers simple queries.
pub(super) struct SimpleQueries(pub Arc<PostgresConnection>);

#[async_trait]
impl SimpleQueryHandler for SimpleQueries {
    // The library's own plans and begins all statements of a text before the first is answered.
    async fn on_query<C>(&self, client: &mut C, query: Query) -> PgWireResult<()>
    where
        C: ClientInfo + ClientPortalStore + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
        C::PortalStore: PortalStore,
        C::Error: Debug,
        PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
    {
        if !matches!(client.state(), PgWireConnectionState::ReadyForQuery) {
            return Err(PgWireError::NotReadyForQuery);
        }
        client.set_state(PgWireConnectionState::QueryInProgress);
        let run = self.0.begin_command();
        let statements = self.0.plan_statements(&query.query, &run).await.map_err(failure)?;
        if statements.is_empty() {
            client.feed(PgWireBackendMessage::EmptyQueryResponse(EmptyQueryResponse::new())).await?;
        }
        for statement in &statements {
            let values = ParamValues::from(Vec::<ScalarValue>::new());
            if let Some(rows) =
                execute_statement(&self.0, client, &run, statement, values, &Format::UnifiedText).await?
            {
                send_query_response(client, rows, true).await?;
            }
        }
        client.set_state(PgWireConnectionState::ReadyForQuery);
        let status = client.transaction_status();
        send_ready_for_query(client, status).await
    }

    async fn do_query<C>(&self, _: &mut C, _: &str) -> PgWireResult<Vec<Response>>
    where
        C: ClientInfo + ClientPortalStore + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
        C::PortalStore: PortalStore,
        C::Error: Debug,
        PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
    {
        // `on_query` does all.
        Err(PgWireError::NotReadyForQuery)
    }
}
