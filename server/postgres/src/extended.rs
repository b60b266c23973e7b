//! The extended query protocol: parse, bind, describe, execute, with values and in parts.

use std::fmt::Debug;
use std::sync::{Arc, Mutex, PoisonError, Weak};

use arrow::datatypes::DataType;
use arrow_pg::datatypes::df::deserialize_parameters;
use arrow_pg::datatypes::into_pg_type;
use async_trait::async_trait;
use datafusion::common::{ParamValues, ScalarValue};
use echolake_service::RequestFault;
use futures::{Sink, SinkExt as _};
use pgwire::api::portal::{Format, Portal, PortalExecutionState};
use pgwire::api::query::{ExtendedQueryHandler, send_describe_response, send_partial_query_response};
use pgwire::api::results::{DescribePortalResponse, FieldInfo, Response, Tag};
use pgwire::api::stmt::QueryParser;
use pgwire::api::store::{Entry, PortalStore};
use pgwire::api::{ClientInfo, ClientPortalStore, DEFAULT_NAME, PgWireConnectionState, Type};
use pgwire::error::{PgWireError, PgWireResult};
use pgwire::messages::PgWireBackendMessage;
use pgwire::messages::extendedquery::{Describe, Execute, Sync as PgSync, TARGET_TYPE_BYTE_PORTAL};
use pgwire::messages::response::{EmptyQueryResponse, ReadyForQuery, TransactionStatus};

use super::columns::array_elements;
use super::command::{execute_statement, find_columns};
use super::connection::PostgresConnection;
use super::names::OID;
use super::rows::column_fields;
use super::sqlstate::failure;
use super::statement::{ClientStatement, PlannedQuery};

/// Prepared statements of a connection at once.
const PREPARED: usize = 500;

/// Answers extended queries.
pub(super) struct ExtendedQueries {
    connection: Arc<PostgresConnection>,
    parser: Arc<StatementPlanner>,
}

impl ExtendedQueries {
    pub fn new(connection: Arc<PostgresConnection>) -> Self {
        Self {
            parser: Arc::new(StatementPlanner { connection: connection.clone(), kept: Mutex::default() }),
            connection,
        }
    }
}

/// Plans statements that a client prepares, and counts those that it keeps.
pub(super) struct StatementPlanner {
    connection: Arc<PostgresConnection>,
    kept: Mutex<Vec<Weak<PlannedQuery>>>,
}

impl StatementPlanner {
    fn keep_query(&self, planned: &Arc<PlannedQuery>) -> Result<(), RequestFault> {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.retain(|query| query.strong_count() > 0);
        if kept.len() >= PREPARED {
            return Err(RequestFault::TooMany { what: "prepared statements", limit: PREPARED });
        }
        kept.push(Arc::downgrade(planned));
        Ok(())
    }
}

#[async_trait]
impl QueryParser for StatementPlanner {
    type Statement = ClientStatement;

    async fn parse_sql<C>(&self, _: &C, sql: &str, _: &[Option<Type>]) -> PgWireResult<Option<ClientStatement>>
    where
        C: ClientInfo + Unpin + Send + Sync,
    {
        let run = self.connection.begin_command();
        let mut statements = self.connection.plan_statements(sql, &run).await.map_err(failure)?;
        if let [statement] = &statements[..]
            && let Some(planned) = planned_query(statement)
        {
            self.keep_query(planned).map_err(failure)?;
        }
        match statements.len() {
            0 | 1 => Ok(statements.pop()),
            _ => Err(failure(RequestFault::bad_request("cannot insert multiple commands into a prepared statement"))),
        }
    }

    fn get_parameter_types(&self, statement: &ClientStatement) -> PgWireResult<Vec<Type>> {
        let kinds = parameter_types(statement).map_err(failure)?;
        // If the query does not determine the type, Postgres takes a text.
        let one = |kind: Option<DataType>| match kind {
            Some(DataType::List(element)) if element.name() == OID => Ok(Type::OID_ARRAY),
            kind => kind.map_or(Ok(Type::TEXT), |kind| into_pg_type(&kind)),
        };
        kinds.into_iter().map(one).collect()
    }

    fn get_result_schema(&self, statement: &ClientStatement, format: Option<&Format>) -> PgWireResult<Vec<FieldInfo>> {
        let format = format.unwrap_or(&Format::UnifiedText);
        find_columns(&self.connection, statement, format).map_err(failure)
    }
}

fn planned_query(statement: &ClientStatement) -> Option<&Arc<PlannedQuery>> {
    match statement {
        ClientStatement::Query(planned)
        | ClientStatement::Copy(planned, _)
        | ClientStatement::Declare { planned, .. } => Some(planned),
        _ => None,
    }
}

fn parameter_types(statement: &ClientStatement) -> Result<Vec<Option<DataType>>, RequestFault> {
    planned_query(statement).map_or(Ok(Vec::new()), |planned| Ok(planned.prepared.parameter_types()?))
}

// The value of a placeholder for a list that is sent as a text. The library takes `""` and `"NULL"` in it for NULL.
fn list_value(
    portal: &Portal<ClientStatement>,
    at: usize,
    kind: Option<&DataType>,
) -> Result<Option<ScalarValue>, RequestFault> {
    let told = portal.statement.parameter_types.get(at).and_then(Option::as_ref);
    let is_text = matches!(told, Some(told) if matches!(*told, Type::TEXT | Type::VARCHAR));
    let list = match (kind, told) {
        (Some(list @ DataType::List(_)), _) => list.clone(),
        (None, Some(told)) if matches!(*told, Type::TEXT_ARRAY | Type::VARCHAR_ARRAY) => {
            DataType::new_list(DataType::Utf8, true)
        }
        _ => return Ok(None),
    };
    let Some(Some(bytes)) = portal.parameters.get(at) else { return Ok(None) };
    // Bytes of a text are the same in both formats.
    if portal.parameter_format.is_binary(at) && !is_text {
        return Ok(None);
    }
    let refused = || RequestFault::bad_request(format!("the value of ${} is no array of one dimension", at + 1));
    let elements = str::from_utf8(bytes).ok().and_then(array_elements).ok_or_else(refused)?;
    let elements: Vec<_> = elements.into_iter().map(ScalarValue::Utf8).collect();
    let texts = ScalarValue::List(ScalarValue::new_list_nullable(&elements, &DataType::Utf8));
    let value =
        texts.cast_to(&list).map_err(|e| RequestFault::bad_request(format!("the value of ${}: {e}", at + 1)))?;
    Ok(Some(value))
}

fn read_values(portal: &Portal<ClientStatement>) -> Result<ParamValues, RequestFault> {
    let kinds = parameter_types(&portal.statement.statement)?;
    let given = portal.parameter_len();
    if given != kinds.len() {
        return Err(RequestFault::bad_request(format!("{given} values for {} placeholders", kinds.len())));
    }
    if let Format::Individual(codes) = &portal.parameter_format
        && codes.len() != given
    {
        return Err(RequestFault::bad_request(format!("{} formats for {given} values", codes.len())));
    }
    // If neither side gives the type, it is the text that was advertised.
    let told = |i: usize| {
        portal.statement.parameter_types.get(i).is_some_and(|t| t.as_ref().is_some_and(|t| *t != Type::UNKNOWN))
    };
    let lists = kinds.iter().enumerate().map(|(i, kind)| list_value(portal, i, kind.as_ref()));
    let lists = lists.collect::<Result<Vec<_>, _>>()?;
    let settled = |(i, kind): (usize, Option<DataType>)| kind.or_else(|| (!told(i)).then_some(DataType::Utf8));
    let kinds: Vec<_> = kinds.into_iter().enumerate().map(settled).collect();
    let hints: Vec<_> = kinds.iter().map(Option::as_ref).collect();
    // The library reads the others.
    let mut others = Portal::new_cursor(portal.name.clone(), portal.statement.clone());
    others.parameter_format = portal.parameter_format.clone();
    let unread = portal.parameters.iter().zip(&lists);
    others.parameters = unread.map(|(value, list)| value.clone().filter(|_| list.is_none())).collect();
    let values = deserialize_parameters(&others, &hints).map_err(|e| match e {
        PgWireError::UserError(info) => RequestFault::bad_request(info.message.clone()),
        other => RequestFault::bad_request(other.to_string()),
    })?;
    let ParamValues::List(mut values) = values else { return Ok(values) };
    for (value, list) in values.iter_mut().zip(lists) {
        if let Some(list) = list {
            value.value = list;
        }
    }
    Ok(ParamValues::List(values))
}

#[async_trait]
impl ExtendedQueryHandler for ExtendedQueries {
    type Statement = ClientStatement;
    type QueryParser = StatementPlanner;

    fn query_parser(&self) -> Arc<StatementPlanner> {
        self.parser.clone()
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
            Some(Entry::Value(portal)) => self.execute_portal(client, &portal, message.max_rows).await?,
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
            && let Ok(cursor) = self.connection.find_cursor(name)
        {
            let columns = column_fields(&cursor.schema, &Format::UnifiedText).map_err(failure)?;
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
            TransactionStatus::Idle => client.portal_store().clear_portals(),
            _ => client.portal_store().rm_portal(DEFAULT_NAME),
        }
        client.send(PgWireBackendMessage::ReadyForQuery(ReadyForQuery::new(status))).await?;
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
    async fn execute_portal<C>(&self, client: &mut C, portal: &Portal<ClientStatement>, most: i32) -> PgWireResult<()>
    where
        C: ClientInfo + ClientPortalStore + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
        C::PortalStore: PortalStore<Statement = ClientStatement>,
        C::Error: Debug,
        PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
    {
        let state = portal.state();
        let mut state = state.lock().await;
        if matches!(*state, PortalExecutionState::Initial) {
            let values = read_values(portal).map_err(failure)?;
            let run = self.connection.begin_command();
            let statement = &portal.statement.statement;
            let format = &portal.result_column_format;
            match execute_statement(&self.connection, client, &run, statement, values, format).await? {
                Some(rows) => *state = PortalExecutionState::Suspended(rows),
                None => return Ok(()),
            }
        }
        if let PortalExecutionState::Suspended(rows) = &mut *state {
            if !send_partial_query_response(client, rows, usize::try_from(most).unwrap_or(0)).await? {
                *state = PortalExecutionState::Finished;
            }
        } else {
            let tag = Tag::new("SELECT").with_rows(0);
            client.feed(PgWireBackendMessage::CommandComplete(tag.into())).await?;
        }
        Ok(())
    }
}
