//! The calls of Flight SQL. Every one of them looks at the token; a ticket is a handle, never a text to run.

use std::pin::Pin;
use std::sync::Arc;

use arrow::datatypes::Schema;
use arrow_flight::error::FlightError;
use arrow_flight::flight_service_server::FlightService;
use arrow_flight::sql::metadata::{SqlInfoData, XdbcTypeInfoData};
use arrow_flight::sql::server::{FlightSqlService, PeekableFlightDataStream};
use arrow_flight::sql::{
    ActionBeginTransactionRequest, ActionBeginTransactionResult, ActionCancelQueryRequest, ActionCancelQueryResult,
    ActionClosePreparedStatementRequest, ActionCreatePreparedStatementRequest, ActionCreatePreparedStatementResult,
    Any, CommandGetCatalogs, CommandGetCrossReference, CommandGetDbSchemas, CommandGetExportedKeys,
    CommandGetImportedKeys, CommandGetPrimaryKeys, CommandGetSqlInfo, CommandGetTableTypes, CommandGetTables,
    CommandGetXdbcTypeInfo, CommandPreparedStatementQuery, CommandPreparedStatementUpdate, CommandStatementIngest,
    CommandStatementQuery, CommandStatementUpdate, DoPutPreparedStatementResult, SqlInfo, TicketStatementQuery,
};
use arrow_flight::{
    Action, CancelFlightInfoRequest, CancelFlightInfoResult, CancelStatus, FlightDescriptor, FlightInfo,
    HandshakeRequest, HandshakeResponse, Ticket,
};
use bytes::Bytes;
use datafusion::common::{ParamValues, ScalarValue};
use echolake_query::{EngineClient, Error as QueryError, PreparedQuery, SYSTEM_SCHEMA, Session};
use echolake_service::authorization::of_header;
use echolake_service::{
    CATALOG, QueryJob, QueryService, QueryWork, RequestFault, SCHEMA, ServerProtocol, StopSignal, TokenScope,
};
use futures::{Stream, StreamExt as _, stream};
use prost::Message as _;
use tonic::metadata::MetadataValue;
use tonic::{Request, Response, Status, Streaming};

use super::answer::{self, AnnouncedColumns, FlightStream, is_settled};
use super::statements::{HeldStatement, HeldStatements};
use super::status::grpc_status;
use super::{info, values};

/// The action that ends a query by what GetFlightInfo gave.
const CANCEL_FLIGHT_INFO: &str = "CancelFlightInfo";
/// `ActionCancelQueryResult.CancelResult.CANCEL_RESULT_CANCELLED`, which the crate keeps to itself.
const CANCELLED: i32 = 1;
/// The only kind of table.
const TABLE: &str = "TABLE";

/// Flight SQL on the shared service.
pub(super) struct LakeFlightService {
    service: QueryService,
    statements: HeldStatements,
    sql_info: SqlInfoData,
    types: XdbcTypeInfoData,
}

impl LakeFlightService {
    pub fn new(service: QueryService) -> Result<Self, FlightError> {
        Ok(Self {
            service,
            statements: HeldStatements::default(),
            sql_info: info::sql_info()?,
            types: info::column_types()?,
        })
    }

    fn sql_client(&self) -> Result<Arc<EngineClient>, Status> {
        self.service.authorised_client(TokenScope::Sql).map_err(|fault| grpc_status(&fault))
    }

    async fn plan_sql(&self, client: &Arc<EngineClient>, sql: String) -> Result<HeldStatement, Status> {
        let (session, sql): (_, Arc<str>) = (Arc::new(self.service.begin_session(client)), sql.into());
        let prepared = self.prepare_sql(&session, &sql).await?;
        let values = ParamValues::from(Vec::<ScalarValue>::new());
        let schema = prepared.schema();
        Ok(HeldStatement { session, sql, prepared, schema, values, stop: StopSignal::new() })
    }

    async fn prepare_sql(&self, session: &Arc<Session>, sql: &Arc<str>) -> Result<Arc<PreparedQuery>, Status> {
        let planner = session.clone();
        let sql = sql.clone();
        let planned = self.service.plan_query(session.client(), async move { Ok(planner.prepare(&sql).await?) }).await;
        Ok(Arc::new(planned.map_err(|f| grpc_status(&f))?))
    }

    // The statement of a handle. An engine that replaced another one plans it again, without bound values.
    async fn find_statement(&self, client: &Arc<EngineClient>, handle: &[u8]) -> Result<HeldStatement, Status> {
        let lost = match self.statements.find_statement(client.name(), handle) {
            Ok(found) => return Ok(found),
            Err(fault) => grpc_status(&fault),
        };
        let sql = HeldStatements::carried_text(handle).ok_or(lost)?;
        let statement = self.plan_sql(client, sql).await?;
        self.statements.keep_as(handle, statement.clone()).map_err(|f| grpc_status(&f))?;
        Ok(statement)
    }

    // A statement of a client's handle, for a run of its own.
    async fn statement_for_run(&self, client: &Arc<EngineClient>, handle: &[u8]) -> Result<HeldStatement, Status> {
        Ok(HeldStatement { stop: StopSignal::new(), ..self.find_statement(client, handle).await? })
    }

    // A ticket of its own for each run, so that binding other values meanwhile does not change it.
    fn ticket_info(
        &self,
        statement: HeldStatement,
        descriptor: FlightDescriptor,
    ) -> Result<Response<FlightInfo>, Status> {
        let schema = statement.schema.clone();
        let handle = self.statements.keep_statement(statement).map_err(|f| grpc_status(&f))?;
        let ticket = TicketStatementQuery { statement_handle: handle };
        answer::info_response(is_settled(&schema).then_some(schema.as_ref()), &ticket, descriptor)
    }

    // Plans the statement again if the lake has changed since it was planned.
    async fn run_statement(&self, mut statement: HeldStatement) -> Result<Response<FlightStream>, Status> {
        let is_current = statement.session.is_current(&statement.prepared).await;
        if !is_current.map_err(|error| grpc_status(&error.into()))? {
            statement.prepared = self.prepare_sql(&statement.session, &statement.sql).await?;
        }
        let told = is_settled(&statement.schema).then(|| statement.schema.clone());
        let job = QueryJob {
            protocol: ServerProtocol::FlightSql,
            session: statement.session,
            work: QueryWork::Prepared(statement.prepared, statement.values),
            limit: None,
            stop: statement.stop,
        };
        let given = told.clone();
        let begun = self
            .service
            .begin_query(job, move |schema| Ok(AnnouncedColumns(given.unwrap_or_else(|| schema.clone()))))
            .await;
        let running = begun.map_err(|f| grpc_status(&f))?;
        let schema = told.unwrap_or_else(|| running.schema.clone());
        answer::query_response(schema, running).await.map_err(|f| grpc_status(&f))
    }

    fn cancel_query(&self, client: &EngineClient, info: &FlightInfo) -> Result<(), Status> {
        for endpoint in &info.endpoint {
            let ticket = endpoint.ticket.as_ref().map(|t| t.ticket.clone()).unwrap_or_default();
            let handle = Any::decode(ticket).ok().and_then(|any| any.unpack::<TicketStatementQuery>().ok().flatten());
            let handle = handle.ok_or_else(|| Status::invalid_argument("this ticket is of no query"))?;
            let found = self.statements.find_statement(client.name(), &handle.statement_handle);
            found.map_err(|f| grpc_status(&f))?.stop.stop();
        }
        Ok(())
    }
}

fn read_only() -> Status {
    grpc_status(&RequestFault::Query(QueryError::NotReading { statement: "an update".to_owned() }))
}

fn batch_info<T: arrow_flight::sql::ProstMessageExt>(
    query: &T,
    schema: &Schema,
    request: Request<FlightDescriptor>,
) -> Result<Response<FlightInfo>, Status> {
    answer::info_response(Some(schema), query, request.into_inner())
}

// Nothing in a lake is declared a key.
fn no_keys() -> Result<Response<FlightStream>, Status> {
    answer::batch_response(Ok(arrow::array::RecordBatch::new_empty(answer::share_schema(info::key_schema()))))
}

#[tonic::async_trait]
impl FlightSqlService for LakeFlightService {
    type FlightService = Self;

    // What a driver does with a user and password: the password is the token, and becomes the bearer's.
    async fn do_handshake(
        &self,
        request: Request<Streaming<HandshakeRequest>>,
    ) -> Result<Response<Pin<Box<dyn Stream<Item = Result<HandshakeResponse, Status>> + Send>>>, Status> {
        self.sql_client()?;
        let token = request.metadata().get("authorization").and_then(|v| v.to_str().ok()).and_then(of_header);
        let token = token.unwrap_or_default();
        let payload = Bytes::from(token.clone().into_bytes());
        let mut response =
            Response::new(stream::iter([Ok(HandshakeResponse { protocol_version: 0, payload })]).boxed());
        if let Ok(value) = MetadataValue::try_from(format!("Bearer {token}")) {
            response.metadata_mut().insert("authorization", value);
        }
        Ok(response)
    }

    async fn get_flight_info_statement(
        &self,
        query: CommandStatementQuery,
        request: Request<FlightDescriptor>,
    ) -> Result<Response<FlightInfo>, Status> {
        let client = self.sql_client()?;
        let statement = self.plan_sql(&client, query.query).await?;
        self.ticket_info(statement, request.into_inner())
    }

    async fn do_get_statement(
        &self,
        ticket: TicketStatementQuery,
        _: Request<Ticket>,
    ) -> Result<Response<<Self as FlightService>::DoGetStream>, Status> {
        let client = self.sql_client()?;
        let found = self.find_statement(&client, &ticket.statement_handle).await?;
        self.run_statement(found).await
    }

    async fn do_action_create_prepared_statement(
        &self,
        query: ActionCreatePreparedStatementRequest,
        _: Request<Action>,
    ) -> Result<ActionCreatePreparedStatementResult, Status> {
        let client = self.sql_client()?;
        let statement = self.plan_sql(&client, query.query).await?;
        let parameters = values::parameter_schema(&statement.prepared).map_err(|f| grpc_status(&f))?;
        let dataset_schema = match is_settled(&statement.schema) {
            true => answer::schema_bytes(&statement.schema)?,
            false => Bytes::new(),
        };
        Ok(ActionCreatePreparedStatementResult {
            dataset_schema,
            parameter_schema: answer::schema_bytes(&parameters)?,
            prepared_statement_handle: self.statements.keep_statement(statement).map_err(|f| grpc_status(&f))?,
        })
    }

    async fn do_put_prepared_statement_query(
        &self,
        query: CommandPreparedStatementQuery,
        request: Request<PeekableFlightDataStream>,
    ) -> Result<DoPutPreparedStatementResult, Status> {
        let client = self.sql_client()?;
        let handle = query.prepared_statement_handle;
        let statement = self.find_statement(&client, &handle).await?;
        let values =
            values::read_values(request.into_inner(), &statement.prepared).await.map_err(|f| grpc_status(&f))?;
        self.statements.bind_values(client.name(), &handle, values).map_err(|f| grpc_status(&f))?;
        Ok(DoPutPreparedStatementResult { prepared_statement_handle: Some(handle) })
    }

    async fn get_flight_info_prepared_statement(
        &self,
        query: CommandPreparedStatementQuery,
        request: Request<FlightDescriptor>,
    ) -> Result<Response<FlightInfo>, Status> {
        let client = self.sql_client()?;
        let statement = self.statement_for_run(&client, &query.prepared_statement_handle).await?;
        self.ticket_info(statement, request.into_inner())
    }

    async fn do_get_prepared_statement(
        &self,
        query: CommandPreparedStatementQuery,
        _: Request<Ticket>,
    ) -> Result<Response<<Self as FlightService>::DoGetStream>, Status> {
        let client = self.sql_client()?;
        let statement = self.statement_for_run(&client, &query.prepared_statement_handle).await?;
        self.run_statement(statement).await
    }

    async fn do_action_close_prepared_statement(
        &self,
        query: ActionClosePreparedStatementRequest,
        _: Request<Action>,
    ) -> Result<(), Status> {
        let client = self.sql_client()?;
        self.statements.forget_statement(client.name(), &query.prepared_statement_handle);
        Ok(())
    }

    async fn do_action_cancel_query(
        &self,
        query: ActionCancelQueryRequest,
        _: Request<Action>,
    ) -> Result<ActionCancelQueryResult, Status> {
        let client = self.sql_client()?;
        let info = FlightInfo::decode(query.info).map_err(|e| Status::invalid_argument(e.to_string()))?;
        self.cancel_query(&client, &info)?;
        Ok(ActionCancelQueryResult { result: CANCELLED })
    }

    async fn do_action_fallback(
        &self,
        request: Request<Action>,
    ) -> Result<Response<<Self as FlightService>::DoActionStream>, Status> {
        let client = self.sql_client()?;
        let action = request.into_inner();
        if action.r#type != CANCEL_FLIGHT_INFO {
            return Err(grpc_status(&RequestFault::unsupported(format!("the action `{}`", action.r#type))));
        }
        let asked =
            CancelFlightInfoRequest::decode(action.body).map_err(|e| Status::invalid_argument(e.to_string()))?;
        let info = asked.info.ok_or_else(|| Status::invalid_argument("no FlightInfo to cancel"))?;
        self.cancel_query(&client, &info)?;
        let body = CancelFlightInfoResult::new(CancelStatus::Cancelled).encode_to_vec().into();
        Ok(Response::new(stream::iter([Ok(arrow_flight::Result { body })]).boxed()))
    }

    async fn get_flight_info_catalogs(
        &self,
        query: CommandGetCatalogs,
        request: Request<FlightDescriptor>,
    ) -> Result<Response<FlightInfo>, Status> {
        self.sql_client()?;
        batch_info(&query, &query.into_builder().schema(), request)
    }

    async fn do_get_catalogs(
        &self,
        query: CommandGetCatalogs,
        _: Request<Ticket>,
    ) -> Result<Response<<Self as FlightService>::DoGetStream>, Status> {
        self.sql_client()?;
        let mut catalogs = query.into_builder();
        catalogs.append(CATALOG);
        answer::batch_response(catalogs.build())
    }

    async fn get_flight_info_schemas(
        &self,
        query: CommandGetDbSchemas,
        request: Request<FlightDescriptor>,
    ) -> Result<Response<FlightInfo>, Status> {
        self.sql_client()?;
        batch_info(&query, &query.clone().into_builder().schema(), request)
    }

    async fn do_get_schemas(
        &self,
        query: CommandGetDbSchemas,
        _: Request<Ticket>,
    ) -> Result<Response<<Self as FlightService>::DoGetStream>, Status> {
        self.sql_client()?;
        let mut schemas = query.into_builder();
        schemas.append(CATALOG, SCHEMA);
        schemas.append(CATALOG, SYSTEM_SCHEMA);
        answer::batch_response(schemas.build())
    }

    async fn get_flight_info_tables(
        &self,
        query: CommandGetTables,
        request: Request<FlightDescriptor>,
    ) -> Result<Response<FlightInfo>, Status> {
        self.sql_client()?;
        batch_info(&query, &query.clone().into_builder().schema(), request)
    }

    async fn do_get_tables(
        &self,
        query: CommandGetTables,
        _: Request<Ticket>,
    ) -> Result<Response<<Self as FlightService>::DoGetStream>, Status> {
        self.sql_client()?;
        let mut tables = query.into_builder();
        let own = self.service.lake_tables().into_iter().map(|table| (SCHEMA, table));
        let system = self.service.system_tables().into_iter().map(|table| (SYSTEM_SCHEMA, table));
        for (of, (name, schema)) in own.chain(system) {
            tables.append(CATALOG, of, name, TABLE, &schema).map_err(|e| Status::internal(e.to_string()))?;
        }
        answer::batch_response(tables.build())
    }

    async fn get_flight_info_table_types(
        &self,
        query: CommandGetTableTypes,
        request: Request<FlightDescriptor>,
    ) -> Result<Response<FlightInfo>, Status> {
        self.sql_client()?;
        batch_info(&query, &query.into_builder().schema(), request)
    }

    async fn do_get_table_types(
        &self,
        query: CommandGetTableTypes,
        _: Request<Ticket>,
    ) -> Result<Response<<Self as FlightService>::DoGetStream>, Status> {
        self.sql_client()?;
        let mut kinds = query.into_builder();
        kinds.append(TABLE);
        answer::batch_response(kinds.build())
    }

    async fn get_flight_info_sql_info(
        &self,
        query: CommandGetSqlInfo,
        request: Request<FlightDescriptor>,
    ) -> Result<Response<FlightInfo>, Status> {
        self.sql_client()?;
        batch_info(&query, &self.sql_info.schema(), request)
    }

    async fn do_get_sql_info(
        &self,
        query: CommandGetSqlInfo,
        _: Request<Ticket>,
    ) -> Result<Response<<Self as FlightService>::DoGetStream>, Status> {
        self.sql_client()?;
        answer::batch_response(query.into_builder(&self.sql_info).build())
    }

    async fn get_flight_info_xdbc_type_info(
        &self,
        query: CommandGetXdbcTypeInfo,
        request: Request<FlightDescriptor>,
    ) -> Result<Response<FlightInfo>, Status> {
        self.sql_client()?;
        batch_info(&query, &self.types.schema(), request)
    }

    async fn do_get_xdbc_type_info(
        &self,
        query: CommandGetXdbcTypeInfo,
        _: Request<Ticket>,
    ) -> Result<Response<<Self as FlightService>::DoGetStream>, Status> {
        self.sql_client()?;
        answer::batch_response(query.into_builder(&self.types).build())
    }

    async fn get_flight_info_primary_keys(
        &self,
        query: CommandGetPrimaryKeys,
        request: Request<FlightDescriptor>,
    ) -> Result<Response<FlightInfo>, Status> {
        self.sql_client()?;
        batch_info(&query, &info::primary_key_schema(), request)
    }

    async fn do_get_primary_keys(
        &self,
        _: CommandGetPrimaryKeys,
        _: Request<Ticket>,
    ) -> Result<Response<<Self as FlightService>::DoGetStream>, Status> {
        self.sql_client()?;
        answer::batch_response(Ok(arrow::array::RecordBatch::new_empty(answer::share_schema(
            info::primary_key_schema(),
        ))))
    }

    async fn get_flight_info_exported_keys(
        &self,
        query: CommandGetExportedKeys,
        request: Request<FlightDescriptor>,
    ) -> Result<Response<FlightInfo>, Status> {
        self.sql_client()?;
        batch_info(&query, &info::key_schema(), request)
    }

    async fn do_get_exported_keys(
        &self,
        _: CommandGetExportedKeys,
        _: Request<Ticket>,
    ) -> Result<Response<<Self as FlightService>::DoGetStream>, Status> {
        self.sql_client()?;
        no_keys()
    }

    async fn get_flight_info_imported_keys(
        &self,
        query: CommandGetImportedKeys,
        request: Request<FlightDescriptor>,
    ) -> Result<Response<FlightInfo>, Status> {
        self.sql_client()?;
        batch_info(&query, &info::key_schema(), request)
    }

    async fn do_get_imported_keys(
        &self,
        _: CommandGetImportedKeys,
        _: Request<Ticket>,
    ) -> Result<Response<<Self as FlightService>::DoGetStream>, Status> {
        self.sql_client()?;
        no_keys()
    }

    async fn get_flight_info_cross_reference(
        &self,
        query: CommandGetCrossReference,
        request: Request<FlightDescriptor>,
    ) -> Result<Response<FlightInfo>, Status> {
        self.sql_client()?;
        batch_info(&query, &info::key_schema(), request)
    }

    async fn do_get_cross_reference(
        &self,
        _: CommandGetCrossReference,
        _: Request<Ticket>,
    ) -> Result<Response<<Self as FlightService>::DoGetStream>, Status> {
        self.sql_client()?;
        no_keys()
    }

    async fn do_put_statement_update(
        &self,
        query: CommandStatementUpdate,
        _: Request<PeekableFlightDataStream>,
    ) -> Result<i64, Status> {
        let client = self.sql_client()?;
        // What is wrong with the statement itself is worth more than that updates are not for here.
        self.plan_sql(&client, query.query).await?;
        Err(read_only())
    }

    async fn do_put_statement_ingest(
        &self,
        _: CommandStatementIngest,
        _: Request<PeekableFlightDataStream>,
    ) -> Result<i64, Status> {
        self.sql_client()?;
        Err(read_only())
    }

    async fn do_put_prepared_statement_update(
        &self,
        _: CommandPreparedStatementUpdate,
        _: Request<PeekableFlightDataStream>,
    ) -> Result<i64, Status> {
        self.sql_client()?;
        Err(read_only())
    }

    async fn do_action_begin_transaction(
        &self,
        _: ActionBeginTransactionRequest,
        _: Request<Action>,
    ) -> Result<ActionBeginTransactionResult, Status> {
        self.sql_client()?;
        Err(grpc_status(&RequestFault::unsupported("a transaction (each query sees one frozen view of the lake)")))
    }

    // What the server is, is not for others to say.
    async fn register_sql_info(&self, _: i32, _: &SqlInfo) {}
}
