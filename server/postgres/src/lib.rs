//! Postgres' wire protocol, for psql, drivers and tools that speak it: reading only, one session per connection.

mod catalog;
mod catalog_statement;
mod catalog_tables;
mod columns;
mod command;
mod connection;
mod copy;
mod cursor;
mod extended;
mod fixed_tables;
mod functions;
mod names;
mod rows;
mod settings;
mod simple;
mod sqlstate;
mod startup;
mod statement;

use std::io;
use std::sync::Arc;

use async_trait::async_trait;
use echolake_service::request_span::continue_connection;
use echolake_service::{ConnectionOpening, EngineServices, Error, RequestFault, answer_numbered};
use pgwire::api::PgWireServerHandlers;
use pgwire::api::auth::StartupHandler;
use pgwire::api::cancel::CancelHandler;
use pgwire::api::query::{ExtendedQueryHandler, SimpleQueryHandler};
use pgwire::messages::cancel::CancelRequest;
use pgwire::tokio::process_socket_unix;
use tokio::io::Interest;
use tokio::net::{UnixListener, UnixStream};
use tracing::Instrument as _;

use connection::{PostgresConnection, PostgresState, RunningCommands};
pub use sqlstate::fatal_message;
use startup::LoginHandler;

/// Parameter of a startup packet from the door: the number that the client knows its connection by.
pub const PID_PARAMETER: &str = "echolake.pid";

/// Answers Postgres' protocol on an engine's socket that all clients share. The door begins each connection with a
/// [`ConnectionOpening`], which names its client.
///
/// # Errors
/// [`Error::System`] if the socket accepts no connection.
pub async fn serve_postgres_socket(services: EngineServices, listener: UnixListener) -> Result<(), Error> {
    let running = RunningCommands::default();
    loop {
        let (socket, _) = listener.accept().await.map_err(Error::System)?;
        let services = services.clone();
        let running = running.clone();
        let attend = async move {
            // A connection that the door breaks off at its beginning wants nothing.
            let Ok((socket, opening)) = ConnectionOpening::read_from(socket).await else { return };
            let shared = services.find_client(&opening.client).and_then(|client| {
                client.protocol_state(|service| {
                    let state = PostgresState::new(service.clone(), running);
                    state.map_err(RequestFault::defect("Postgres' catalogue cannot be laid out"))
                })
            });
            // Logged already; the door sees the connection end.
            let Ok(shared) = shared else { return };
            let connection = Arc::new(PostgresConnection::new(shared));
            answer_numbered(opening.number, attend_socket(socket, connection)).await;
        };
        tokio::spawn(attend.instrument(continue_connection()));
    }
}

// A connection's queries end with it: dropping the handlers drops the answers that they send.
async fn attend_socket(socket: UnixStream, connection: Arc<PostgresConnection>) {
    let Ok((socket, watched)) = duplicate_socket(socket) else { return };
    tokio::select! {
        // What breaks the protocol is the client's own affair.
        _ = process_socket_unix(socket, ProtocolHandlers(connection.clone())) => {}
        () = wait_for_hangup(&watched, &connection) => {}
    }
}

fn duplicate_socket(socket: UnixStream) -> io::Result<(UnixStream, UnixStream)> {
    let socket = socket.into_std()?;
    let watched = socket.try_clone()?;
    Ok((UnixStream::from_std(socket)?, UnixStream::from_std(watched)?))
}

// While a query runs, the connection is not read, so that its end must be watched for. Nothing runs before a login, and
// a client that sends a CancelRequest hangs up behind it: it is read all the same.
async fn wait_for_hangup(socket: &UnixStream, connection: &PostgresConnection) {
    connection.logged_in().await;
    while let Ok(ready) = socket.ready(Interest::READABLE).await
        && !ready.is_read_closed()
    {
        // Takes the readiness back, so that the next wait is for news.
        let _ = socket.try_io(Interest::READABLE, || -> io::Result<()> { Err(io::ErrorKind::WouldBlock.into()) });
    }
}

struct ProtocolHandlers(Arc<PostgresConnection>);

impl PgWireServerHandlers for ProtocolHandlers {
    fn simple_query_handler(&self) -> Arc<impl SimpleQueryHandler> {
        Arc::new(simple::SimpleQueries(self.0.clone()))
    }

    fn extended_query_handler(&self) -> Arc<impl ExtendedQueryHandler> {
        Arc::new(extended::ExtendedQueries::new(self.0.clone()))
    }

    fn startup_handler(&self) -> Arc<impl StartupHandler> {
        Arc::new(LoginHandler(self.0.clone()))
    }

    fn cancel_handler(&self) -> Arc<impl CancelHandler> {
        Arc::new(CancelRequestHandler(self.0.clone()))
    }
}

struct CancelRequestHandler(Arc<PostgresConnection>);

#[async_trait]
impl CancelHandler for CancelRequestHandler {
    async fn on_cancel_request(&self, request: CancelRequest) {
        self.0.shared().cancel_query(request.pid, &request.secret_key);
    }
}
