//! Doing what a statement asks: the same for both of the protocol's ways to ask.

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

use super::connection::{Connection, Kept, Run};
use super::copy::{Copied, CopyAs};
use super::cursor::Cursor;
use super::rows::{Rows, fields, response, text_fields, texts};
use super::sqlstate::error;
use super::statement::Statement;
use crate::fault::Fault;
use crate::running::{Batches, Running};

/// Columns of `SHOW ALL`.
const ALL: [&str; 2] = ["name", "setting"];

/// The answer to a statement.
pub(super) enum Reply {
    Rows(QueryResponse),
    Copy(CopyAs, Running<Vec<CopyData>>),
    Done(Tag),
}

/// The columns that a statement gives.
pub(super) fn columns(
    connection: &Connection,
    statement: &Statement,
    format: &Format,
) -> Result<Vec<FieldInfo>, Fault> {
    let fields = match statement {
        Statement::Query(planned) => fields(&planned.prepared.schema(), format)?,
        Statement::Fetch { name, .. } => fields(&connection.cursor(name)?.schema, format)?,
        Statement::Show(Some(name)) => text_fields(&[name]),
        Statement::Show(None) => text_fields(&ALL),
        _ => return Ok(Vec::new()),
    };
    Ok(fields.to_vec())
}

/// Does what a statement asks.
pub(super) async fn act<C>(
    connection: &Connection,
    client: &mut C,
    run: &Run,
    statement: &Statement,
    values: ParamValues,
    format: &Format,
) -> PgWireResult<Reply>
where
    C: ClientInfo + ClientPortalStore + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
    C::PortalStore: PortalStore,
    C::Error: Debug,
    PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
{
    let ends = matches!(statement, Statement::Commit | Statement::Rollback | Statement::Savepoint("ROLLBACK"));
    if client.transaction_status() == TransactionStatus::Error && !ends {
        return Err(aborted());
    }
    match statement {
        Statement::Begin | Statement::Commit | Statement::Rollback | Statement::Savepoint(_) => {
            transaction(connection, client, statement).await
        }
        Statement::Discard(DiscardObject::ALL) => {
            client.portal_store().clear_portals();
            connection.forget_portals();
            settle(connection, statement).map_err(|fault| error(&fault))
        }
        Statement::Deallocate(name) => {
            if let Some(name) = name {
                client.portal_store().rm_statement(name);
                connection.forget(Kept::Statement, name);
            }
            Ok(Reply::Done(Tag::new("DEALLOCATE")))
        }
        other => ask(connection, run, other, values, format).await.map_err(|fault| error(&fault)),
    }
}

async fn ask(
    connection: &Connection,
    run: &Run,
    statement: &Statement,
    values: ParamValues,
    format: &Format,
) -> Result<Reply, Fault> {
    match statement {
        Statement::Query(planned) => {
            let encode = format.clone();
            let running = connection.run(run, planned, values, move |schema| Rows::new(schema, &encode)).await?;
            Ok(Reply::Rows(response(running, format)?))
        }
        Statement::Copy(planned, form) => {
            let encode = form.clone();
            let running = connection.run(run, planned, values, move |schema| Copied::new(schema, &encode)).await?;
            Ok(Reply::Copy(form.clone(), running))
        }
        Statement::Declare { name, planned, held } => {
            let running = connection.run(run, planned, values, |_| Ok(Batches)).await?;
            connection.declare(name, Cursor::new(running, *held))?;
            Ok(Reply::Done(Tag::new("DECLARE CURSOR")))
        }
        Statement::Fetch { name, rows } => Ok(Reply::Rows(connection.cursor(name)?.fetch(*rows, run, format).await?)),
        other => settle(connection, other),
    }
}

fn settle(connection: &Connection, statement: &Statement) -> Result<Reply, Fault> {
    let settings = &connection.settings;
    let tag = match statement {
        Statement::Close(name) => {
            connection.close(name.as_deref())?;
            if name.is_some() { "CLOSE CURSOR" } else { "CLOSE CURSOR ALL" }
        }
        Statement::Set(pairs) => {
            pairs.iter().try_for_each(|(name, value)| match value.eq_ignore_ascii_case("default") {
                true => settings.reset(Some(name)),
                false => settings.set(name, value),
            })?;
            "SET"
        }
        Statement::Reset(name) => {
            settings.reset(name.as_deref())?;
            "RESET"
        }
        Statement::Discard(DiscardObject::ALL) => {
            settings.reset(None)?;
            connection.close(None)?;
            "DISCARD ALL"
        }
        Statement::Discard(_) => "DISCARD",
        Statement::Show(Some(name)) => {
            let mut rows = texts(&[name], &[vec![settings.get(name)?]])?;
            rows.set_command_tag("SHOW");
            return Ok(Reply::Rows(rows));
        }
        Statement::Show(None) => {
            let all: Vec<_> = settings.all().into_iter().map(|(name, value)| vec![name.to_owned(), value]).collect();
            return Ok(Reply::Rows(texts(&ALL, &all)?));
        }
        // Those that ask or end a transaction were done before.
        _ => return Err(Fault::Internal),
    };
    Ok(Reply::Done(Tag::new(tag)))
}

// Transactions are kept as far as clients see them: there is nothing to commit, and nothing to roll back.
async fn transaction<C>(connection: &Connection, client: &mut C, statement: &Statement) -> PgWireResult<Reply>
where
    C: ClientInfo + ClientPortalStore + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
    C::PortalStore: PortalStore,
    C::Error: Debug,
    PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
{
    let before = client.transaction_status();
    let (tag, after) = match statement {
        Statement::Begin => {
            if before == TransactionStatus::Transaction {
                warn(client, "25001", "there is already a transaction in progress").await?;
            }
            ("BEGIN", TransactionStatus::Transaction)
        }
        Statement::Savepoint(tag) => {
            if before == TransactionStatus::Idle {
                return Err(outside(tag));
            }
            (*tag, TransactionStatus::Transaction)
        }
        ended => {
            if before == TransactionStatus::Idle {
                warn(client, "25P01", "there is no transaction in progress").await?;
            }
            let committed = matches!(ended, Statement::Commit) && before != TransactionStatus::Error;
            connection.end_transaction();
            connection.forget_portals();
            client.portal_store().clear_portals();
            (if committed { "COMMIT" } else { "ROLLBACK" }, TransactionStatus::Idle)
        }
    };
    client.set_transaction_status(after);
    Ok(Reply::Done(Tag::new(tag)))
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
