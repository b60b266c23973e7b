//! Listening: three addresses, refused where others could reach them without a token, and an end that lets answers
//! finish.

use std::net::SocketAddr;
use std::time::Duration;

use echolake_lake::Lake;
use echolake_query::Limits;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinSet;

use crate::service::Service;
use crate::tokens::Tokens;
use crate::{Error, flight, http, postgres};

/// How long answers may go on when the server is told to stop.
const GRACE: Duration = Duration::from_secs(5);

/// Where a server listens, and whom it lets in.
pub struct Settings {
    /// HTTP; None for none, as below. Port 0 for any that is free.
    pub http: Option<SocketAddr>,
    /// Arrow Flight SQL.
    pub flight_sql: Option<SocketAddr>,
    /// Postgres' protocol.
    pub postgres: Option<SocketAddr>,
    /// Who is let in; None for everybody, on loopback only.
    pub tokens: Option<Tokens>,
    /// What all queries together may use.
    pub limits: Limits,
}

impl Default for Settings {
    /// All three on loopback, on ports that are free.
    fn default() -> Self {
        let any = Some(SocketAddr::from(([127, 0, 0, 1], 0)));
        Self { http: any, flight_sql: any, postgres: any, tokens: None, limits: Limits::default() }
    }
}

/// A server that listens and does not answer yet.
pub struct Server {
    service: Service,
    http: Option<TcpListener>,
    flight_sql: Option<TcpListener>,
    postgres: Option<TcpListener>,
}

impl Server {
    /// Listens.
    ///
    /// # Errors
    /// [`Error::Open`], [`Error::Bind`], [`Error::Query`].
    pub async fn bind(lake: &Lake, settings: Settings) -> Result<Self, Error> {
        let addresses = [settings.http, settings.flight_sql, settings.postgres];
        if settings.tokens.is_none()
            && let Some(address) = addresses.into_iter().flatten().find(|a| !a.ip().is_loopback())
        {
            return Err(Error::Open { address });
        }
        Ok(Self {
            service: Service::new(lake, settings.tokens, settings.limits)?,
            http: listen(settings.http).await?,
            flight_sql: listen(settings.flight_sql).await?,
            postgres: listen(settings.postgres).await?,
        })
    }

    /// Where it listens, as URLs.
    pub fn addresses(&self) -> Vec<String> {
        let url = |scheme: &str, listener: &Option<TcpListener>, path: &str| {
            let address = listener.as_ref()?.local_addr().ok()?;
            Some(format!("{scheme}://{address}{path}"))
        };
        let all = [
            url("http", &self.http, ""),
            url("grpc", &self.flight_sql, ""),
            url("postgresql", &self.postgres, "/datafusion"),
        ];
        all.into_iter().flatten().collect()
    }

    /// Answers until `stop`, then lets answers go on for five seconds.
    ///
    /// # Errors
    /// [`Error::System`], [`Error::Transport`].
    pub async fn run(self, stop: impl Future<Output = ()>) -> Result<(), Error> {
        let stopping = watch::Sender::new(false);
        let mut tasks = JoinSet::new();
        if let Some(listener) = self.http {
            tasks.spawn(http::serve(self.service.clone(), listener, stopped(&stopping)));
        }
        if let Some(listener) = self.flight_sql {
            tasks.spawn(flight::serve(self.service.clone(), listener, stopped(&stopping)));
        }
        if let Some(listener) = self.postgres {
            tasks.spawn(postgres::serve(self.service.clone(), listener, stopped(&stopping)));
        }
        tokio::select! {
            () = stop => {}
            ended = tasks.join_next() => flatten(ended)?,
        }
        stopping.send_replace(true);
        let rest = async {
            while let Some(ended) = tasks.join_next().await {
                flatten(Some(ended))?;
            }
            Ok(())
        };
        // What is not done by then ends with the process.
        tokio::time::timeout(GRACE, rest).await.unwrap_or(Ok(()))
    }
}

fn flatten(ended: Option<Result<Result<(), Error>, tokio::task::JoinError>>) -> Result<(), Error> {
    match ended {
        None => Ok(()),
        Some(Ok(done)) => done,
        Some(Err(failed)) => Err(Error::System(std::io::Error::other(failed))),
    }
}

fn stopped(stopping: &watch::Sender<bool>) -> impl Future<Output = ()> + Send + 'static {
    let mut stopping = stopping.subscribe();
    async move {
        // Where the sender is gone, the server is too.
        let _ = stopping.wait_for(|stopping| *stopping).await;
    }
}

async fn listen(address: Option<SocketAddr>) -> Result<Option<TcpListener>, Error> {
    match address {
        None => Ok(None),
        Some(address) => TcpListener::bind(address).await.map(Some).map_err(|source| Error::Bind { address, source }),
    }
}
