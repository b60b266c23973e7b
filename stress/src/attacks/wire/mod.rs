//! Hostile bytes: what is sent on how many connections, and how.

mod flight;
mod http;
mod postgres;
mod uploads;

use std::io::{self, Read as _, Write as _};
use std::net::{Shutdown, TcpStream};
use std::time::Duration;

use super::super::observed_server::QueryClient;

pub(crate) use uploads::UploadAttack;

/// Between two bytes of those that come slowly.
const DRIP_EVERY: Duration = Duration::from_millis(100);
/// Bytes of an answer that are kept, to classify it.
const KEPT_BYTES: usize = 4096;

/// The attacked protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum WirePort {
    Http,
    Postgres,
    FlightSql,
}

/// Makes bytes for a client, whose token may be in them.
type BytesMaker = fn(&QueryClient) -> Vec<u8>;
/// Makes the block of a number.
type BlockMaker = fn(&QueryClient, usize) -> Vec<u8>;

/// Traffic that follows the first bytes of a connection.
#[derive(Debug, Clone, Copy)]
pub(crate) enum WireFlow {
    /// The answer is read to its end.
    ReadAnswer,
    /// So many blocks are sent, and what comes is read.
    Flood(BlockMaker, usize),
    /// The same, but nothing is read.
    FloodUnread(BlockMaker, usize),
    /// A block is sent one byte at a time.
    Drip(BytesMaker),
    /// Nothing: the connection stays open, and nothing is read.
    Hold,
    /// The connection is closed and opened again, so many times.
    Reconnect(usize),
}

/// Hostile bytes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct WireAttack {
    pub name: &'static str,
    /// Connections at once.
    connections: usize,
    /// The first bytes of each.
    opening: BytesMaker,
    flow: WireFlow,
}

/// The attacks by bytes, by protocol.
pub(crate) const WIRE_FAMILIES: [(WirePort, &[WireAttack]); 3] =
    [(WirePort::Postgres, postgres::ATTACKS), (WirePort::Http, http::ATTACKS), (WirePort::FlightSql, flight::ATTACKS)];
/// The attacks by what Flight SQL's DoPut carries.
pub(crate) const UPLOADS: &[UploadAttack] = uploads::ATTACKS;

impl WirePort {
    pub fn name(self) -> &'static str {
        match self {
            Self::Http => "http",
            Self::Postgres => "postgres",
            Self::FlightSql => "flight-sql",
        }
    }

    fn address(self, client: &QueryClient) -> &str {
        match self {
            Self::Http => &client.addresses.http,
            Self::Postgres => &client.addresses.postgres,
            Self::FlightSql => &client.addresses.flight_sql,
        }
    }

    // Postgres' server answers all before it sees the end; those of HTTP take an end for a client that is gone.
    fn flood(self, client: &QueryClient, stream: &TcpStream, block: BlockMaker, count: usize) -> io::Result<()> {
        (0..count).try_for_each(|number| send_bytes(stream, &block(client, number)))?;
        self.end_writing(stream)
    }

    fn end_writing(self, stream: &TcpStream) -> io::Result<()> {
        if self == Self::Postgres { stream.shutdown(Shutdown::Write) } else { Ok(()) }
    }
}

const fn define_attack(name: &'static str, connections: usize, opening: BytesMaker, flow: WireFlow) -> WireAttack {
    WireAttack { name, connections, opening, flow }
}

impl WireAttack {
    /// Runs it until it ends or the client's connections are closed; returns how each connection ended.
    pub fn run(&self, port: WirePort, client: &QueryClient) -> Vec<String> {
        let opening = (self.opening)(client);
        std::thread::scope(|scope| {
            let run = || self.run_connection(port, client, &opening);
            let connections: Vec<_> = (0..self.connections).map(|_| scope.spawn(run)).collect();
            connections.into_iter().map(|c| c.join().unwrap_or_else(|_| "panicked".to_owned())).collect()
        })
    }

    fn run_connection(&self, port: WirePort, client: &QueryClient, opening: &[u8]) -> String {
        let rounds = if let WireFlow::Reconnect(times) = self.flow { times } else { 1 };
        let mut heard = Vec::new();
        for _ in 0..rounds {
            match client.connections.connect(port.address(client)) {
                Ok(stream) => heard = self.talk(port, client, &stream, opening),
                Err(_) => break,
            }
        }
        match heard.as_slice() {
            [] if client.connections.is_closed() => "time limit".to_owned(),
            [] => "connection closed".to_owned(),
            bytes => answer_name(port, bytes),
        }
    }

    // Sends all; returns the beginning of what came back.
    fn talk(&self, port: WirePort, client: &QueryClient, stream: &TcpStream, opening: &[u8]) -> Vec<u8> {
        // A server may close as soon as it has seen enough, so that no failure to send is one of the attack's.
        let _ = send_bytes(stream, opening);
        match self.flow {
            WireFlow::ReadAnswer => read_meanwhile(stream, || port.end_writing(stream)),
            WireFlow::Hold => wait_for_close(client),
            WireFlow::Reconnect(_) => Vec::new(),
            WireFlow::FloodUnread(block, count) => {
                let _ = port.flood(client, stream, block, count);
                wait_for_close(client)
            }
            WireFlow::Flood(block, count) => read_meanwhile(stream, || port.flood(client, stream, block, count)),
            WireFlow::Drip(block) => read_meanwhile(stream, || drip_bytes(stream, &block(client))),
        }
    }
}

fn send_bytes(mut stream: &TcpStream, bytes: &[u8]) -> io::Result<()> {
    stream.write_all(bytes)
}

fn drip_bytes(stream: &TcpStream, bytes: &[u8]) -> io::Result<()> {
    bytes.iter().try_for_each(|byte| {
        std::thread::sleep(DRIP_EVERY);
        send_bytes(stream, &[*byte])
    })
}

fn read_meanwhile(stream: &TcpStream, write: impl FnOnce() -> io::Result<()>) -> Vec<u8> {
    std::thread::scope(|scope| {
        let reader = scope.spawn(|| read_to_end(stream));
        let _ = write();
        reader.join().unwrap_or_default()
    })
}

fn read_to_end(mut stream: &TcpStream) -> Vec<u8> {
    let mut kept = Vec::new();
    let mut block = [0; 64 << 10];
    while let Ok(count @ 1..) = stream.read(&mut block) {
        let wanted = count.min(KEPT_BYTES - kept.len());
        kept.extend_from_slice(&block[..wanted]);
    }
    kept
}

fn wait_for_close(client: &QueryClient) -> Vec<u8> {
    let _ = client.connections.run(std::future::pending::<()>());
    Vec::new()
}

// The status of HTTP, the state of Postgres' error; HTTP/2's headers are packed, and are not unpacked here.
fn answer_name(port: WirePort, bytes: &[u8]) -> String {
    let text = String::from_utf8_lossy(bytes);
    let code = match port {
        WirePort::Http => text.strip_prefix("HTTP/1.1 ").and_then(|rest| rest.split(' ').next()),
        // The severity, again without translation, and the state.
        WirePort::Postgres => text.split("\0C").nth(1).and_then(|rest| rest.split('\0').next()),
        WirePort::FlightSql => None,
    };
    code.map_or_else(|| "answer".to_owned(), |code| format!("answer {code}"))
}
