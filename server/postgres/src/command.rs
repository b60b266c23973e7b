//! Execution of statements, for both the simple and the extended query protocol.

use std::fmt::Debug;

use datafusion::common::ParamValues;
use datafusion::sql::sqlparser::ast::DiscardObject;
use echolake_service::RequestFault;
use echolake_service::running::BatchEncoder;
use futures::{Sink, SinkExt as _};
use pgwire::api::portal::Format;
use pgwire::api::results::{FieldInfo, QueryResponse, Tag};
use pgwire::api::store::PortalStore;
use pgwire::api::{ClientInfo, ClientPortalStore};
use pgwire::error::{ErrorInfo, PgWireError, PgWireResult};
use pgwire::messages::PgWireBackendMessage;
use pgwire::messages::response::{NoticeResponse, TransactionStatus};

use super::connection::PostgresConnection;
use super::copy::{CopyRowEncoder, send_copy};
use super::cursor::{CommandRun, QueryCursor};
use super::rows::{RowEncoder, column_fields, rows_response, text_fields, text_response};
use super::settings::SessionSettings;
use super::sqlstate::failure;
use super::statement::ClientStatement;

/// Columns of `SHOW ALL`.
const ALL: [&str; 2] = ["name", "setting"];

/// Returns the columns that a statement gives.
pub(super) fn find_columns(
    connection: &PostgresConnection,
    statement: &ClientStatement,
    format: &Format,
) -> Result<Vec<FieldInfo>, RequestFault> {
    let fields = match statement {
        ClientStatement::Query(planned) => column_fields(&planned.prepared.schema(), format)?,
        ClientStatement::Fetch { name, .. } => column_fields(&connection.find_cursor(name)?.schema, format)?,
        ClientStatement::Show(Some(name)) => text_fields(&[name]),
        ClientStatement::Show(None) => text_fields(&ALL),
        _ => return Ok(Vec::new()),
    };
    Ok(fields.to_vec())
}

/// Executes a statement. Returns its rows, which the caller sends; what is no rows is sent.
pub(super) async fn execute_statement<C>(
    connection: &PostgresConnection,
    client: &mut C,
    run: &CommandRun,
    statement: &ClientStatement,
    values: ParamValues,
    format: &Format,
) -> PgWireResult<Option<QueryResponse>>
where
    C: ClientInfo + ClientPortalStore + Sink<PgWireBackendMessage> + Unpin + Send + Sync,
    C::PortalStore: PortalStore,
    C::Error: Debug,
    PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
{
    let status = client.transaction_status();
    let rolls_back = matches!(
        statement,
        ClientStatement::Commit | ClientStatement::Rollback | ClientStatement::Savepoint("ROLLBACK")
    );
    if status == TransactionStatus::Error && !rolls_back {
        let message = "current transaction is aborted, commands ignored until end of transaction block";
        return Err(PgWireError::UserError(transaction_info("ERROR", "25P02", message)));
    }
    let tag = match statement {
        ClientStatement::Query(planned) => {
            let encode = format.clone();
            let running = connection
                .run_planned(run, planned, values, move |schema| RowEncoder::new(schema, &encode))
                .await
                .map_err(failure)?;
            return Ok(Some(rows_response(running, format).map_err(failure)?));
        }
        ClientStatement::Copy(planned, form) => {
            let encode = form.clone();
            let running = connection
                .run_planned(run, planned, values, move |schema| CopyRowEncoder::new(schema, &encode))
                .await
                .map_err(failure)?;
            send_copy(client, form, running).await?;
            return Ok(None);
        }
        ClientStatement::Declare { name, planned, held } => {
            let running = connection.run_planned(run, planned, values, |_| Ok(BatchEncoder)).await.map_err(failure)?;
            connection.declare_cursor(name, QueryCursor::new(running, *held)).map_err(failure)?;
            "DECLARE CURSOR"
        }
        ClientStatement::Fetch { name, rows } => {
            return Ok(Some(
                connection.find_cursor(name).map_err(failure)?.fetch_rows(*rows, run, format).await.map_err(failure)?,
            ));
        }
        ClientStatement::Show(name) => {
            return Ok(Some(show_settings(&connection.settings, name.as_deref()).map_err(failure)?));
        }
        // Transactions are kept as far as clients see them: there is nothing to commit, and nothing to roll back.
        ClientStatement::Begin => {
            if status == TransactionStatus::Transaction {
                send_warning(client, "25001", "there is already a transaction in progress").await?;
            }
            client.set_transaction_status(TransactionStatus::Transaction);
            "BEGIN"
        }
        ClientStatement::Savepoint(tag) => {
            if status == TransactionStatus::Idle {
                let message = format!("{tag} can only be used in transaction blocks");
                return Err(PgWireError::UserError(transaction_info("ERROR", "25P01", &message)));
            }
            client.set_transaction_status(TransactionStatus::Transaction);
            *tag
        }
        ClientStatement::Commit | ClientStatement::Rollback => {
            if status == TransactionStatus::Idle {
                send_warning(client, "25P01", "there is no transaction in progress").await?;
            }
            connection.end_transaction();
            client.portal_store().clear_portals();
            client.set_transaction_status(TransactionStatus::Idle);
            let is_committed = matches!(statement, ClientStatement::Commit) && status != TransactionStatus::Error;
            if is_committed { "COMMIT" } else { "ROLLBACK" }
        }
        ClientStatement::Deallocate(name) => {
            name.iter().for_each(|name| client.portal_store().rm_statement(name));
            "DEALLOCATE"
        }
        ClientStatement::Discard(DiscardObject::ALL) => {
            client.portal_store().clear_portals();
            connection.settings.reset_values(None).map_err(failure)?;
            connection.close_cursors(None).map_err(failure)?;
            "DISCARD ALL"
        }
        ClientStatement::Discard(_) => "DISCARD",
        ClientStatement::Unlisten => "UNLISTEN",
        ClientStatement::Close(name) => {
            connection.close_cursors(name.as_deref()).map_err(failure)?;
            if name.is_some() { "CLOSE CURSOR" } else { "CLOSE CURSOR ALL" }
        }
        ClientStatement::Set(pairs) => {
            pairs
                .iter()
                .try_for_each(|(name, value)| match value.eq_ignore_ascii_case("default") {
                    true => connection.settings.reset_values(Some(name)),
                    false => connection.settings.set_value(name, value),
                })
                .map_err(failure)?;
            "SET"
        }
        ClientStatement::Reset(name) => {
            connection.settings.reset_values(name.as_deref()).map_err(failure)?;
            "RESET"
        }
    };
    client.feed(PgWireBackendMessage::CommandComplete(Tag::new(tag).into())).await?;
    Ok(None)
}

fn show_settings(settings: &SessionSettings, name: Option<&str>) -> Result<QueryResponse, RequestFault> {
    let Some(name) = name else {
        let all: Vec<_> = settings.all_values().into_iter().map(|(name, value)| vec![name.to_owned(), value]).collect();
        return text_response(&ALL, &all);
    };
    let mut rows = text_response(&[name], &[vec![settings.get(name)?]])?;
    rows.set_command_tag("SHOW");
    Ok(rows)
}

async fn send_warning<C>(client: &mut C, state: &str, message: &str) -> PgWireResult<()>
where
    C: Sink<PgWireBackendMessage> + Unpin,
    PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
{
    let info = transaction_info("WARNING", state, message);
    client.feed(PgWireBackendMessage::NoticeResponse(NoticeResponse::from(*info))).await?;
    Ok(())
}

fn transaction_info(severity: &str, state: &str, message: &str) -> Box<ErrorInfo> {
    Box::new(ErrorInfo::new(severity.to_owned(), state.to_owned(), message.to_owned()))
}
