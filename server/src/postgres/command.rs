//! Execution of statements, for both the simple and the extended query protocol.

use std::fmt::Debug;

use datafusion::common::ParamValues;
use datafusion::sql::sqlparser::ast::DiscardObject;
use futures::{Sink, SinkExt as _};
use pgwire::api::portal::Format;
use pgwire::api::results::{FieldInfo, QueryResponse, Tag};
use pgwire::api::store::PortalStore;
use pgwire::api::{ClientInfo, ClientPortalStore};
use pgwire::error::{ErrorInfo, PgWireError, PgWireResult};
use pgwire::messages::PgWireBackendMessage;
use pgwire::messages::copy::CopyData;
use pgwire::messages::response::{NoticeResponse, TransactionStatus};

use super::connection::{CommandRun, NamedObject, PostgresConnection};
use super::copy::{CopyAs, CopyRowEncoder};
use super::cursor::QueryCursor;
use super::rows::{RowEncoder, fields, response, text_fields, texts};
use super::sqlstate::error;
use super::statement::ClientStatement;
use crate::fault::RequestFault;
use crate::running::{BatchEncoder, RunningQuery};

/// Columns of `SHOW ALL`.
const ALL: [&str; 2] = ["name", "setting"];

/// The answer to a statement.
pub(super) enum StatementReply {
    Rows(QueryResponse),
    Copy(CopyAs, RunningQuery<Vec<CopyData>>),
    Done(Tag),
}

/// The columns that a statement gives.
pub(super) fn columns(
    connection: &PostgresConnection,
    statement: &ClientStatement,
    format: &Format,
) -> Result<Vec<FieldInfo>, RequestFault> {
    let fields = match statement {
        ClientStatement::Query(planned) => fields(&planned.prepared.schema(), format)?,
        ClientStatement::Fetch { name, .. } => fields(&connection.cursor(name)?.schema, format)?,
        ClientStatement::Show(Some(name)) => text_fields(&[name]),
        ClientStatement::Show(None) => text_fields(&ALL),
        _ => return Ok(Vec::new()),
    };
    Ok(fields.to_vec())
}

/// Executes a statement.
pub(super) async fn act<C>(
    connection: &PostgresConnection,
    client: &mut C,
    run: &CommandRun,
    statement: &ClientStatement,
    values: ParamValues,
    format: &Format,
) -> PgWireResult<StatementReply>
where
    C: ClientInfo + ClientPortalStore + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
    C::PortalStore: PortalStore,
    C::Error: Debug,
    PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
{
    let ends = matches!(
        statement,
        ClientStatement::Commit | ClientStatement::Rollback | ClientStatement::Savepoint("ROLLBACK")
    );
    if client.transaction_status() == TransactionStatus::Error && !ends {
        return Err(aborted());
    }
    match statement {
        ClientStatement::Begin
        | ClientStatement::Commit
        | ClientStatement::Rollback
        | ClientStatement::Savepoint(_) => transaction(connection, client, statement).await,
        ClientStatement::Discard(DiscardObject::ALL) => {
            client.portal_store().clear_portals();
            connection.forget_portals();
            settle(connection, statement).map_err(|fault| error(&fault))
        }
        ClientStatement::Deallocate(name) => {
            if let Some(name) = name {
                client.portal_store().rm_statement(name);
                connection.forget(NamedObject::Statement, name);
            }
            Ok(StatementReply::Done(Tag::new("DEALLOCATE")))
        }
        other => ask(connection, run, other, values, format).await.map_err(|fault| error(&fault)),
    }
}

async fn ask(
    connection: &PostgresConnection,
    run: &CommandRun,
    statement: &ClientStatement,
    values: ParamValues,
    format: &Format,
) -> Result<StatementReply, RequestFault> {
    match statement {
        ClientStatement::Query(planned) => {
            let encode = format.clone();
            let running = connection.run(run, planned, values, move |schema| RowEncoder::new(schema, &encode)).await?;
            Ok(StatementReply::Rows(response(running, format)?))
        }
        ClientStatement::Copy(planned, form) => {
            let encode = form.clone();
            let running =
                connection.run(run, planned, values, move |schema| CopyRowEncoder::new(schema, &encode)).await?;
            Ok(StatementReply::Copy(form.clone(), running))
        }
        ClientStatement::Declare { name, planned, held } => {
            let running = connection.run(run, planned, values, |_| Ok(BatchEncoder)).await?;
            connection.declare(name, QueryCursor::new(running, *held))?;
            Ok(StatementReply::Done(Tag::new("DECLARE CURSOR")))
        }
        ClientStatement::Fetch { name, rows } => {
            Ok(StatementReply::Rows(connection.cursor(name)?.fetch(*rows, run, format).await?))
        }
        other => settle(connection, other),
    }
}

fn settle(connection: &PostgresConnection, statement: &ClientStatement) -> Result<StatementReply, RequestFault> {
    let settings = &connection.settings;
    let tag = match statement {
        ClientStatement::Close(name) => {
            connection.close(name.as_deref())?;
            if name.is_some() { "CLOSE CURSOR" } else { "CLOSE CURSOR ALL" }
        }
        ClientStatement::Set(pairs) => {
            pairs.iter().try_for_each(|(name, value)| match value.eq_ignore_ascii_case("default") {
                true => settings.reset(Some(name)),
                false => settings.set(name, value),
            })?;
            "SET"
        }
        ClientStatement::Reset(name) => {
            settings.reset(name.as_deref())?;
            "RESET"
        }
        ClientStatement::Discard(DiscardObject::ALL) => {
            settings.reset(None)?;
            connection.close(None)?;
            "DISCARD ALL"
        }
        ClientStatement::Discard(_) => "DISCARD",
        ClientStatement::Unlisten => "UNLISTEN",
        ClientStatement::Show(Some(name)) => {
            let mut rows = texts(&[name], &[vec![settings.get(name)?]])?;
            rows.set_command_tag("SHOW");
            return Ok(StatementReply::Rows(rows));
        }
        ClientStatement::Show(None) => {
            let all: Vec<_> = settings.all().into_iter().map(|(name, value)| vec![name.to_owned(), value]).collect();
            return Ok(StatementReply::Rows(texts(&ALL, &all)?));
        }
        // Queries and transaction statements were handled before.
        _ => return Err(RequestFault::Internal),
    };
    Ok(StatementReply::Done(Tag::new(tag)))
}

// Transactions are kept as far as clients see them: there is nothing to commit, and nothing to roll back.
async fn transaction<C>(
    connection: &PostgresConnection,
    client: &mut C,
    statement: &ClientStatement,
) -> PgWireResult<StatementReply>
where
    C: ClientInfo + ClientPortalStore + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
    C::PortalStore: PortalStore,
    C::Error: Debug,
    PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
{
    let before = client.transaction_status();
    let (tag, after) = match statement {
        ClientStatement::Begin => {
            if before == TransactionStatus::Transaction {
                warn(client, "25001", "there is already a transaction in progress").await?;
            }
            ("BEGIN", TransactionStatus::Transaction)
        }
        ClientStatement::Savepoint(tag) => {
            if before == TransactionStatus::Idle {
                return Err(outside(tag));
            }
            (*tag, TransactionStatus::Transaction)
        }
        ended => {
            if before == TransactionStatus::Idle {
                warn(client, "25P01", "there is no transaction in progress").await?;
            }
            let committed = matches!(ended, ClientStatement::Commit) && before != TransactionStatus::Error;
            connection.end_transaction();
            connection.forget_portals();
            client.portal_store().clear_portals();
            (if committed { "COMMIT" } else { "ROLLBACK" }, TransactionStatus::Idle)
        }
    };
    client.set_transaction_status(after);
    Ok(StatementReply::Done(Tag::new(tag)))
}

async fn warn<C>(client: &mut C, state: &str, message: &str) -> PgWireResult<()>
where
    C: Sink<PgWireBackendMessage> + Unpin,
    PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
{
    let info = ErrorInfo::new("WARNING".to_owned(), state.to_owned(), message.to_owned());
    client.feed(PgWireBackendMessage::NoticeResponse(NoticeResponse::from(info))).await?;
    Ok(())
}

fn aborted() -> PgWireError {
    let message = "current transaction is aborted, commands ignored until end of transaction block";
    PgWireError::UserError(Box::new(ErrorInfo::new("ERROR".to_owned(), "25P02".to_owned(), message.to_owned())))
}

fn outside(what: &str) -> PgWireError {
    let message = format!("{what} can only be used in transaction blocks");
    PgWireError::UserError(Box::new(ErrorInfo::new("ERROR".to_owned(), "25P01".to_owned(), message)))
}
