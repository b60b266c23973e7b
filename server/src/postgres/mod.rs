//! Postgres' wire protocol, for psql, drivers and tools that speak it: reading only, a session a connection.

mod catalog;
mod command;
mod connection;
mod copy;
mod cursor;
mod extended;
mod functions;
mod information;
mod rewrite;
mod rows;
mod settings;
mod simple;
mod sqlstate;
mod startup;
mod statement;

use std::io;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use pgwire::api::PgWireServerHandlers;
use pgwire::api::auth::StartupHandler;
use pgwire::api::cancel::CancelHandler;
use pgwire::api::query::{ExtendedQueryHandler, SimpleQueryHandler};
use pgwire::messages::cancel::CancelRequest;
use pgwire::tokio::process_socket;
use tokio::io::Interest;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinSet;

use crate::Error;
use crate::service::Service;
use connection::Connection;
use startup::Startup;

/// Connections at once; one more is told so and closed.
const CONNECTIONS: usize = 128;
/// Pause after the system could not accept a connection, as when files run out.
const PAUSE: Duration = Duration::from_millis(100);

/// Answers Postgres' protocol until `stop`; then until the queries that run are answered.
pub(crate) async fn serve(
    service: Service,
    listener: TcpListener,
    stop: impl Future<Output = ()> + Send + 'static,
) -> Result<(), Error> {
    let shared = Arc::new(connection::Shared::new(service)?);
    let places = Arc::new(Semaphore::new(CONNECTIONS));
    let stopping = watch::Sender::new(false);
    let mut connections = JoinSet::new();
    tokio::pin!(stop);
    loop {
        tokio::select! {
            () = &mut stop => break,
            Some(_) = connections.join_next() => {}
            accepted = listener.accept() => match accepted {
                Ok((socket, _)) => {
                    let place = places.clone().try_acquire_owned().ok();
                    let connection = Arc::new(Connection::new(shared.clone(), place));
                    connections.spawn(attend(socket, connection, stopping.subscribe()));
                }
                Err(failed) => {
                    eprintln!("cannot accept a connection: {failed}");
                    tokio::time::sleep(PAUSE).await;
                }
            },
        }
    }
    stopping.send_replace(true);
    while connections.join_next().await.is_some() {}
    Ok(())
}

// What a connection asks ends with it: dropping the handlers drops the answers that they send.
async fn attend(socket: TcpStream, connection: Arc<Connection>, mut stopping: watch::Receiver<bool>) {
    let Ok((socket, watched)) = twice(socket) else { return };
    let idle = async {
        let _ = stopping.wait_for(|stopping| *stopping).await;
        connection.idle().await;
    };
    tokio::select! {
        // A client that breaks the protocol is its own affair.
        _ = process_socket(socket, None, Handlers(connection.clone())) => {}
        () = gone(&watched, &connection) => {}
        () = idle => {}
    }
}

fn twice(socket: TcpStream) -> io::Result<(TcpStream, TcpStream)> {
    let socket = socket.into_std()?;
    let watched = socket.try_clone()?;
    Ok((TcpStream::from_std(socket)?, TcpStream::from_std(watched)?))
}

// While a query runs nobody reads from the connection, so that its end must be watched for. Nothing runs before a
// login, and who sends a CancelRequest hangs up behind it: it is read all the same.
async fn gone(socket: &TcpStream, connection: &Connection) {
    connection.logged_in().await;
    while let Ok(ready) = socket.ready(Interest::READABLE).await
        && !ready.is_read_closed()
    {
        // Takes the readiness back, so that the next wait is for news.
        let _ = socket.try_io(Interest::READABLE, || -> io::Result<()> { Err(io::ErrorKind::WouldBlock.into()) });
    }
}

struct Handlers(Arc<Connection>);

impl PgWireServerHandlers for Handlers {
    fn simple_query_handler(&self) -> Arc<impl SimpleQueryHandler> {
        Arc::new(simple::Simple(self.0.clone()))
    }

    fn extended_query_handler(&self) -> Arc<impl ExtendedQueryHandler> {
        Arc::new(extended::Extended::new(self.0.clone()))
    }

    fn startup_handler(&self) -> Arc<impl StartupHandler> {
        Arc::new(Startup(self.0.clone()))
    }

    fn cancel_handler(&self) -> Arc<impl CancelHandler> {
        Arc::new(Canceller(self.0.clone()))
    }
}

struct Canceller(Arc<Connection>);

#[async_trait]
impl CancelHandler for Canceller {
    async fn on_cancel_request(&self, request: CancelRequest) {
        self.0.shared().cancel(request.pid, &request.secret_key);
    }
}
