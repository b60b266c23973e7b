//! The extended query protocol: parse, bind, describe, execute, with values and in parts.

use std::borrow::Cow;
use std::fmt::Debug;
use std::sync::Arc;

use arrow::datatypes::DataType;
use arrow_pg::datatypes::df::deserialize_parameters;
use arrow_pg::datatypes::into_pg_type;
use async_trait::async_trait;
use datafusion::common::ParamValues;
use futures::{Sink, SinkExt as _};
use pgwire::api::portal::{Format, Portal, PortalExecutionState};
use pgwire::api::query::{ExtendedQueryHandler, send_describe_response, send_partial_query_response};
use pgwire::api::results::{DescribePortalResponse, FieldInfo, Response, Tag};
use pgwire::api::stmt::{QueryParser, StoredStatement};
use pgwire::api::store::{Entry, PortalStore};
use pgwire::api::{ClientInfo, ClientPortalStore, DEFAULT_NAME, PgWireConnectionState, Type};
use pgwire::error::{PgWireError, PgWireResult};
use pgwire::messages::PgWireBackendMessage;
use pgwire::messages::extendedquery::{
    Bind, BindComplete, Close, CloseComplete, Describe, Execute, Parse, ParseComplete, Sync as PgSync,
    TARGET_TYPE_BYTE_PORTAL, TARGET_TYPE_BYTE_STATEMENT,
};
use pgwire::messages::response::{EmptyQueryResponse, ReadyForQuery, TransactionStatus};

use super::array_texts::without_spaces;
use super::catalog::OID;
use super::command::{StatementReply, act, columns};
use super::connection::{NamedObject, PostgresConnection};
use super::copy;
use super::rows::fields;
use super::sqlstate::error;
use super::statement::ClientStatement;
use crate::fault::RequestFault;

/// Answers extended queries.
pub(super) struct ExtendedQueries {
    connection: Arc<PostgresConnection>,
    parser: Arc<StatementPlanner>,
}

impl ExtendedQueries {
    pub(super) fn new(connection: Arc<PostgresConnection>) -> Self {
        Self { parser: Arc::new(StatementPlanner(connection.clone())), connection }
    }
}

/// Plans parsed statements.
pub(super) struct StatementPlanner(Arc<PostgresConnection>);

#[async_trait]
impl QueryParser for StatementPlanner {
    type Statement = ClientStatement;

    async fn parse_sql<C>(&self, _: &C, sql: &str, types: &[Option<Type>]) -> PgWireResult<Option<ClientStatement>>
    where
        C: ClientInfo + Unpin + Send + Sync,
    {
        let run = self.0.command();
        let mut statements = self.0.statements(sql, types, &run).await.map_err(|fault| error(&fault))?;
        match statements.len() {
            0 | 1 => Ok(statements.pop()),
            _ => Err(error(&RequestFault::request("cannot insert multiple commands into a prepared statement"))),
        }
    }

    fn get_parameter_types(&self, statement: &ClientStatement) -> PgWireResult<Vec<Type>> {
        let kinds = kinds(statement).map_err(|fault| error(&fault))?;
        // If the query does not determine the type, Postgres takes a text.
        let one = |kind: Option<DataType>| match kind {
            Some(DataType::List(element)) if element.name() == OID => Ok(Type::OID_ARRAY),
            kind => kind.map_or(Ok(Type::TEXT), |kind| into_pg_type(&kind)),
        };
        kinds.into_iter().map(one).collect()
    }

    fn get_result_schema(&self, statement: &ClientStatement, format: Option<&Format>) -> PgWireResult<Vec<FieldInfo>> {
        let format = format.unwrap_or(&Format::UnifiedText);
        columns(&self.0, statement, format).map_err(|fault| error(&fault))
    }
}

fn kinds(statement: &ClientStatement) -> Result<Vec<Option<DataType>>, RequestFault> {
    match statement {
        ClientStatement::Query(planned)
        | ClientStatement::Copy(planned, _)
        | ClientStatement::Declare { planned, .. } => Ok(planned.prepared.parameters()?),
        _ => Ok(Vec::new()),
    }
}

// Lists that are sent as texts.
fn tidy_lists(message: &mut Bind, statement: &StoredStatement<ClientStatement>) {
    let kinds = kinds(&statement.statement).unwrap_or_default();
    for (i, value) in message.parameters.iter_mut().enumerate() {
        let is_text = match message.parameter_format_codes.as_slice() {
            [] => true,
            [all] => *all == 0,
            codes => codes.get(i) == Some(&0),
        };
        let is_list = match statement.parameter_types.get(i).and_then(Option::as_ref) {
            // Postgres writes a type of arrays so.
            Some(told) if *told != Type::UNKNOWN => told.name().starts_with('_'),
            _ => matches!(kinds.get(i), Some(Some(DataType::List(_)))),
        };
        if let (true, true, Some(text)) = (is_text, is_list, value.as_deref().and_then(|v| str::from_utf8(v).ok()))
            && let Cow::Owned(dense) = without_spaces(text)
        {
            *value = Some(dense.into());
        }
    }
}

fn values(portal: &Portal<ClientStatement>) -> Result<ParamValues, RequestFault> {
    let kinds = kinds(&portal.statement.statement)?;
    let given = portal.parameter_len();
    if given != kinds.len() {
        return Err(RequestFault::request(format!("{given} values for {} placeholders", kinds.len())));
    }
    if let Format::Individual(codes) = &portal.parameter_format
        && codes.len() != given
    {
        return Err(RequestFault::request(format!("{} formats for {given} values", codes.len())));
    }
    // If neither side gives the type, it is the text that was advertised.
    let told = |i: usize| {
        portal.statement.parameter_types.get(i).is_some_and(|t| t.as_ref().is_some_and(|t| *t != Type::UNKNOWN))
    };
    let settled = |(i, kind): (usize, Option<DataType>)| kind.or_else(|| (!told(i)).then_some(DataType::Utf8));
    let kinds: Vec<_> = kinds.into_iter().enumerate().map(settled).collect();
    let hints: Vec<_> = kinds.iter().map(Option::as_ref).collect();
    deserialize_parameters(portal, &hints).map_err(|e| match e {
        PgWireError::UserError(info) => RequestFault::request(info.message.clone()),
        other => RequestFault::request(other.to_string()),
    })
}

#[async_trait]
impl ExtendedQueryHandler for ExtendedQueries {
    type Statement = ClientStatement;
    type QueryParser = StatementPlanner;

    fn query_parser(&self) -> Arc<StatementPlanner> {
        self.parser.clone()
    }

    async fn on_parse<C>(&self, client: &mut C, message: Parse) -> PgWireResult<()>
    where
        C: ClientInfo + ClientPortalStore + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
        C::PortalStore: PortalStore<Statement = ClientStatement>,
        C::Error: Debug,
        PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
    {
        let name = message.name.clone().unwrap_or_else(|| DEFAULT_NAME.to_owned());
        let parsed = StoredStatement::parse(client, &message, self.parser.clone()).await?;
        self.connection.remember(NamedObject::Statement, &name).map_err(|fault| error(&fault))?;
        match parsed {
            Some(statement) => client.portal_store().put_statement(Arc::new(statement)),
            None => client.portal_store().put_empty_statement(&name),
        }
        client.feed(PgWireBackendMessage::ParseComplete(ParseComplete::new())).await?;
        Ok(())
    }

    // As the library's own, but that portals are counted.
    async fn on_bind<C>(&self, client: &mut C, mut message: Bind) -> PgWireResult<()>
    where
        C: ClientInfo + ClientPortalStore + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
        C::PortalStore: PortalStore<Statement = ClientStatement>,
        C::Error: Debug,
        PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
    {
        let name = message.statement_name.clone().unwrap_or_else(|| DEFAULT_NAME.to_owned());
        let portal = message.portal_name.clone().unwrap_or_else(|| DEFAULT_NAME.to_owned());
        self.connection.remember(NamedObject::Portal, &portal).map_err(|fault| error(&fault))?;
        match client.portal_store().get_statement(&name) {
            Some(Entry::Value(statement)) => {
                tidy_lists(&mut message, &statement);
                client.portal_store().put_portal(Arc::new(Portal::try_new(&message, statement)?));
            }
            Some(Entry::Empty) => client.portal_store().put_empty_portal(&portal),
            None => return Err(PgWireError::StatementNotFound(name)),
        }
        client.feed(PgWireBackendMessage::BindComplete(BindComplete::new())).await?;
        Ok(())
    }

    // The library's own gathers a whole answer before it sends the first row.
    async fn on_execute<C>(&self, client: &mut C, message: Execute) -> PgWireResult<()>
    where
        C: ClientInfo + ClientPortalStore + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
        C::PortalStore: PortalStore<Statement = ClientStatement>,
        C::Error: Debug,
        PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
    {
        if !matches!(client.state(), PgWireConnectionState::ReadyForQuery) {
            return Err(PgWireError::NotReadyForQuery);
        }
        client.set_state(PgWireConnectionState::QueryInProgress);
        let name = message.name.as_deref().unwrap_or(DEFAULT_NAME);
        match client.portal_store().get_portal(name) {
            Some(Entry::Value(portal)) => {
                let most = usize::try_from(message.max_rows).unwrap_or(0);
                self.execute(client, &portal, most).await?;
            }
            Some(Entry::Empty) => {
                client.feed(PgWireBackendMessage::EmptyQueryResponse(EmptyQueryResponse::new())).await?;
            }
            None => return Err(PgWireError::PortalNotFound(name.to_owned())),
        }
        client.set_state(PgWireConnectionState::ReadyForQuery);
        Ok(())
    }

    // A cursor can be described by its name, as psycopg does.
    async fn on_describe<C>(&self, client: &mut C, message: Describe) -> PgWireResult<()>
    where
        C: ClientInfo + ClientPortalStore + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
        C::PortalStore: PortalStore<Statement = ClientStatement>,
        C::Error: Debug,
        PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
    {
        if let Some(name) = message.name.as_deref().filter(|_| message.target_type == TARGET_TYPE_BYTE_PORTAL)
            && client.portal_store().get_portal(name).is_none()
            && let Ok(cursor) = self.connection.cursor(name)
        {
            let columns = fields(&cursor.schema, &Format::UnifiedText).map_err(|fault| error(&fault))?;
            return send_describe_response(client, &DescribePortalResponse::new(columns.to_vec())).await;
        }
        self._on_describe(client, message).await
    }

    // What is not held ends with its transaction, and without one with the next Sync.
    async fn on_sync<C>(&self, client: &mut C, _: PgSync) -> PgWireResult<()>
    where
        C: ClientInfo + ClientPortalStore + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
        C::PortalStore: PortalStore<Statement = ClientStatement>,
        C::Error: Debug,
        PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
    {
        let status = client.transaction_status();
        match status {
            TransactionStatus::Idle => {
                client.portal_store().clear_portals();
                self.connection.forget_portals();
            }
            _ => client.portal_store().rm_portal(DEFAULT_NAME),
        }
        client.send(PgWireBackendMessage::ReadyForQuery(ReadyForQuery::new(status))).await?;
        Ok(())
    }

    async fn on_close<C>(&self, client: &mut C, message: Close) -> PgWireResult<()>
    where
        C: ClientInfo + ClientPortalStore + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
        C::PortalStore: PortalStore<Statement = ClientStatement>,
        C::Error: Debug,
        PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
    {
        let name = message.name.as_deref().unwrap_or(DEFAULT_NAME);
        match message.target_type {
            TARGET_TYPE_BYTE_STATEMENT => {
                client.portal_store().rm_statement(name);
                self.connection.forget(NamedObject::Statement, name);
            }
            _ => {
                client.portal_store().rm_portal(name);
                self.connection.forget(NamedObject::Portal, name);
            }
        }
        client.feed(PgWireBackendMessage::CloseComplete(CloseComplete::new())).await?;
        Ok(())
    }

    async fn do_query<C>(&self, _: &mut C, _: &Portal<ClientStatement>, _: usize) -> PgWireResult<Response>
    where
        C: ClientInfo + ClientPortalStore + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
        C::PortalStore: PortalStore<Statement = ClientStatement>,
        C::Error: Debug,
        PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
    {
        // `on_execute` does all.
        Err(PgWireError::NotReadyForQuery)
    }
}

impl ExtendedQueries {
    async fn execute<C>(&self, client: &mut C, portal: &Portal<ClientStatement>, most: usize) -> PgWireResult<()>
    where
        C: ClientInfo + ClientPortalStore + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
        C::PortalStore: PortalStore<Statement = ClientStatement>,
        C::Error: Debug,
        PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
    {
        let state = portal.state();
        let mut state = state.lock().await;
        if matches!(*state, PortalExecutionState::Initial) {
            let values = values(portal).map_err(|fault| error(&fault))?;
            let run = self.connection.command();
            let statement = &portal.statement.statement;
            match act(&self.connection, client, &run, statement, values, &portal.result_column_format).await? {
                StatementReply::Rows(rows) => *state = PortalExecutionState::Suspended(rows),
                StatementReply::Copy(form, running) => return copy::send(client, &form, running).await,
                StatementReply::Done(tag) => {
                    client.feed(PgWireBackendMessage::CommandComplete(tag.into())).await?;
                    return Ok(());
                }
            }
        }
        match &mut *state {
            PortalExecutionState::Suspended(rows) => {
                if !send_partial_query_response(client, rows, most).await? {
                    *state = PortalExecutionState::Finished;
                }
            }
            _ => {
                let tag = Tag::new("SELECT").with_rows(0);
                client.feed(PgWireBackendMessage::CommandComplete(tag.into())).await?;
            }
        }
        Ok(())
    }
}
