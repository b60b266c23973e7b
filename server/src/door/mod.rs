//! The door: the process that clients reach. It holds connections, finds out who asks, and forwards requests to one of
//! two engines, with the name of their client. It parses no SQL and decodes no file, so that no request can end it.

pub(crate) mod activity;
mod agent;
mod audit;
mod body_reader;
#[cfg(feature = "postgres")]
mod certificate_hash;
pub(crate) mod connection_places;
#[cfg(feature = "postgres")]
mod der_element;
pub(crate) mod drain;
pub(crate) mod encryption;
mod engine_ends;
mod engine_process;
mod failed_logins;
mod flight;
mod forward;
mod http;
pub(crate) mod http_connection;
#[cfg(feature = "postgres")]
mod postgres;
mod query_log;
mod readiness;
pub(crate) mod server_door;
mod server_engines;
mod temp_folder;

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::time::Duration;

use echolake_access::TokenAccess;
use echolake_access::tokens::TokenFile;
use echolake_lake::Lake;
use echolake_service::Error;
use tokio::net::{TcpListener, TcpSocket};
use tokio::task::JoinSet;

pub use agent::AgentDoor;
pub use encryption::CertificateFiles;
use encryption::{ProtocolEncryption, ServerEncryption};
pub use engine_process::EngineSettings;
use http_connection::HTTP_2;
use server_door::ServerDoor;

/// Bytes that the system keeps for a connection until they are read, and connections until they are accepted.
const RECEIVED_BYTES: u32 = 128 << 10;
const BACKLOG: u32 = 1024;

/// Addresses, access rules and engine limits of a server.
pub struct ServerSettings {
    /// HTTP; None for none, as below. Port 0 for any that is free.
    pub http: Option<SocketAddr>,
    /// Arrow Flight SQL.
    pub flight_sql: Option<SocketAddr>,
    /// Postgres' protocol.
    #[cfg(feature = "postgres")]
    pub postgres: Option<SocketAddr>,
    /// The accepted tokens; None for open access, on loopback only.
    pub tokens: Option<TokenFile>,
    /// The certificate with which connections are encrypted; None for plain text.
    pub certificate: Option<CertificateFiles>,
    /// True if plain text may leave this machine, because a proxy encrypts it.
    pub is_behind_proxy: bool,
    /// Time for which answers may continue after the server was asked to stop.
    pub drain: Duration,
    /// The engines.
    pub engines: EngineSettings,
}

/// A server that listens and does not answer yet.
pub struct LakeServer {
    door: ServerDoor,
    http: Option<TcpListener>,
    flight_sql: Option<TcpListener>,
    #[cfg(feature = "postgres")]
    postgres: Option<TcpListener>,
    encryption: Option<ServerEncryption>,
    drain_limit: Duration,
}

impl LakeServer {
    /// Listens.
    ///
    /// # Errors
    /// [`Error::Open`], [`Error::PlainText`], [`Error::Certificate`], [`Error::Bind`], [`Error::Temp`].
    pub fn bind(lake: &Lake, settings: ServerSettings) -> Result<Self, Error> {
        let addresses = [
            settings.http,
            settings.flight_sql,
            #[cfg(feature = "postgres")]
            settings.postgres,
        ];
        if let Some(address) = addresses.into_iter().flatten().find(|a| !a.ip().is_loopback()) {
            if settings.tokens.is_none() {
                return Err(Error::Open { address });
            }
            if settings.certificate.is_none() && !settings.is_behind_proxy {
                return Err(Error::PlainText { address });
            }
        }
        let access = Arc::new(TokenAccess::new(settings.tokens));
        Ok(Self {
            encryption: settings.certificate.map(ServerEncryption::new).transpose()?,
            door: ServerDoor::new(lake, access, settings.is_behind_proxy, settings.engines)?,
            http: optional_listener(settings.http)?,
            flight_sql: optional_listener(settings.flight_sql)?,
            #[cfg(feature = "postgres")]
            postgres: optional_listener(settings.postgres)?,
            drain_limit: settings.drain,
        })
    }

    /// Returns the listening addresses, as URLs that a client can use: instead of `0.0.0.0`, which stands for all
    /// addresses of this machine, one of these.
    pub fn listening_urls(&self) -> Vec<String> {
        let is_encrypted = self.encryption.is_some();
        let url = |schemes: [&str; 2], listener: &Option<TcpListener>, path: &str| {
            let address = reachable_address(listener.as_ref()?.local_addr().ok()?);
            Some(format!("{}://{address}{path}", schemes[usize::from(is_encrypted)]))
        };
        #[cfg(feature = "postgres")]
        let database = if is_encrypted { "/datafusion?sslmode=verify-full" } else { "/datafusion" };
        let all = [
            url(["http", "https"], &self.http, ""),
            url(["grpc", "grpc+tls"], &self.flight_sql, ""),
            #[cfg(feature = "postgres")]
            url(["postgresql"; 2], &self.postgres, database),
        ];
        all.into_iter().flatten().collect()
    }

    /// Answers until `stop`, then takes nothing new and lets answers continue, for as long as the settings say.
    ///
    /// # Errors
    /// [`Error::System`].
    pub async fn serve_until(self, stop: impl Future<Output = ()>) -> Result<(), Error> {
        let mut tasks = JoinSet::new();
        let mut upkeep = JoinSet::new();
        upkeep.spawn(self.door.engines().clone().keep_up());
        upkeep.spawn(self.door.clone().watch_tokens());
        let mut encryption = self.encryption;
        let mut encrypted = |names| match &mut encryption {
            Some(encryption) => encryption.of_protocol(names),
            None => Ok(ProtocolEncryption::default()),
        };
        let http_tls = encrypted(&[HTTP_2, b"http/1.1"])?;
        let flight_tls = encrypted(&[HTTP_2])?;
        #[cfg(feature = "postgres")]
        let postgres_tls = encrypted(&[b"postgresql"])?;
        if let Some(encryption) = encryption {
            upkeep.spawn(encryption.keep_up());
        }
        if let Some(listener) = self.http {
            tasks.spawn(http::serve_http_clients(self.door.clone(), listener, http_tls));
        }
        if let Some(listener) = self.flight_sql {
            tasks.spawn(flight::serve_flight_clients(self.door.clone(), listener, flight_tls));
        }
        #[cfg(feature = "postgres")]
        if let Some(listener) = self.postgres {
            tasks.spawn(postgres::serve_postgres_clients(self.door.clone(), listener, postgres_tls));
        }
        tokio::select! {
            () = stop => {}
            Some(Err(failed)) = tasks.join_next() => return Err(Error::System(std::io::Error::other(failed))),
        }
        let drain = self.door.drain();
        drain.begin_drain();
        // Connections that come now are told so, until the others have their answers.
        if tokio::time::timeout(self.drain_limit, drain.wait_until_empty()).await.is_err() {
            tracing::warn!(connections = drain.open_connections(), "answers that took too long are broken off");
        }
        self.door.engines().end_all().await;
        Ok(())
    }
}

fn optional_listener(address: Option<SocketAddr>) -> Result<Option<TcpListener>, Error> {
    match address {
        None => Ok(None),
        Some(address) => bind_listener(address).map(Some).map_err(|source| Error::Bind { address, source }),
    }
}

// Another machine's address, to which nothing is sent: the system tells which of its own it would send from.
fn reachable_address(listening: SocketAddr) -> SocketAddr {
    if !listening.ip().is_unspecified() {
        return listening;
    }
    let (any, far) = match listening {
        SocketAddr::V4(_) => (IpAddr::V4(Ipv4Addr::UNSPECIFIED), IpAddr::V4(Ipv4Addr::new(192, 0, 2, 1))),
        SocketAddr::V6(_) => {
            (IpAddr::V6(Ipv6Addr::UNSPECIFIED), IpAddr::V6(Ipv6Addr::new(0x2001, 0xdb8, 0, 0, 0, 0, 0, 1)))
        }
    };
    let own = UdpSocket::bind((any, 0)).and_then(|socket| {
        socket.connect((far, 9))?;
        socket.local_addr()
    });
    let loopback = match listening {
        SocketAddr::V4(_) => IpAddr::V4(Ipv4Addr::LOCALHOST),
        SocketAddr::V6(_) => IpAddr::V6(Ipv6Addr::LOCALHOST),
    };
    let own = own.map(|address| address.ip()).ok().filter(|ip| !ip.is_unspecified());
    SocketAddr::new(own.unwrap_or(loopback), listening.port())
}

fn bind_listener(address: SocketAddr) -> std::io::Result<TcpListener> {
    let socket = if address.is_ipv4() { TcpSocket::new_v4() } else { TcpSocket::new_v6() }?;
    socket.set_reuseaddr(true)?;
    // Connections have what their listener has.
    socket.set_recv_buffer_size(RECEIVED_BYTES)?;
    socket.bind(address)?;
    socket.listen(BACKLOG)
}

#[cfg(test)]
mod tests {
    use super::*;

    // B11: whoever reads the line on this machine reaches the server by it.
    #[test]
    fn addresses_of_everywhere_are_printed_as_one_that_can_be_reached() {
        let known: SocketAddr = "127.0.0.1:8080".parse().expect("an address");
        assert_eq!(reachable_address(known), known);
        let listener = std::net::TcpListener::bind("0.0.0.0:0").expect("a port");
        let listening = listener.local_addr().expect("an address");
        let printed = reachable_address(listening);
        assert!(!printed.ip().is_unspecified() && printed.port() == listening.port(), "{printed}");
        std::net::TcpStream::connect(printed).expect("it is reached");
        let printed = reachable_address("[::]:8080".parse().expect("an address"));
        assert!(printed.is_ipv6() && !printed.ip().is_unspecified(), "{printed}");
    }
}
