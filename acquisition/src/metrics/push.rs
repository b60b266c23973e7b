//! Push of a run's metrics to InfluxDB, or any store of its line protocol: by UDP, or by HTTP without encryption.

use std::io::{self, Read as _, Write as _};
use std::net::{TcpStream, ToSocketAddrs as _, UdpSocket};
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::thread::JoinHandle;
use std::time::Duration;

use echolake_schema::Timestamp;

use super::RunMetrics;

/// Timeout of a store; after it the next interval is waited for.
const PATIENCE: Duration = Duration::from_secs(5);

/// Destination of metrics.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PushTarget {
    /// One datagram per line.
    Udp {
        /// `host:port`.
        host: String,
    },
    /// One POST per line.
    Http {
        /// `host:port`.
        host: String,
        /// Path and query, as `/write?db=lab`.
        path: String,
    },
}

/// An address that is no destination of metrics.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{given}` takes no metrics; hint: udp://HOST:PORT or http://HOST:PORT/write?db=NAME")]
pub struct TargetError {
    /// The given address.
    pub given: String,
}

impl std::str::FromStr for PushTarget {
    type Err = TargetError;

    fn from_str(given: &str) -> Result<Self, TargetError> {
        let wrong = || TargetError { given: given.to_owned() };
        // Characters that could end a request's line early are no part of an address.
        if given.chars().any(|c| c.is_whitespace() || c.is_control()) {
            return Err(wrong());
        }
        if let Some(host) = given.strip_prefix("udp://") {
            let host = host.trim_end_matches('/').to_owned();
            return if has_port(&host) { Ok(Self::Udp { host }) } else { Err(wrong()) };
        }
        let rest = given.strip_prefix("http://").ok_or_else(wrong)?;
        let (host, path) = rest.split_once('/').ok_or_else(wrong)?;
        match has_port(host) {
            true => Ok(Self::Http { host: host.to_owned(), path: format!("/{path}") }),
            false => Err(wrong()),
        }
    }
}

fn has_port(host: &str) -> bool {
    host.rsplit_once(':').is_some_and(|(name, port)| !name.is_empty() && port.parse::<u16>().is_ok())
}

impl PushTarget {
    /// Sends one line.
    ///
    /// # Errors
    /// The system's, or the store's refusal in its words.
    pub fn send(&self, line: &str) -> io::Result<()> {
        match self {
            Self::Udp { host } => {
                let socket = UdpSocket::bind("0.0.0.0:0")?;
                socket.send_to(line.as_bytes(), host.as_str()).map(drop)
            }
            Self::Http { host, path } => post(host, path, line),
        }
    }
}

fn post(host: &str, path: &str, line: &str) -> io::Result<()> {
    let nowhere = || io::Error::new(io::ErrorKind::NotFound, format!("`{host}` has no address"));
    let address = host.to_socket_addrs()?.next().ok_or_else(nowhere)?;
    let mut stream = TcpStream::connect_timeout(&address, PATIENCE)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let length = line.len();
    write!(
        stream,
        "POST {path} HTTP/1.1\r\nHost: {host}\r\nContent-Type: text/plain; charset=utf-8\r\nContent-Length: {length}\r\n\
         Connection: close\r\n\r\n{line}"
    )?;
    let mut answer = Vec::new();
    stream.take(4 << 10).read_to_end(&mut answer)?;
    let answer = String::from_utf8_lossy(&answer);
    // `HTTP/1.1 204 No Content`.
    match answer.split(' ').nth(1) {
        Some(status) if status.starts_with('2') => Ok(()),
        _ => Err(io::Error::other(answer.lines().next().unwrap_or("no answer").to_owned())),
    }
}

/// A thread that pushes metrics at an interval. Dropped, it pushes them a last time.
pub struct InfluxPush {
    end: Option<Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl InfluxPush {
    /// Starts the thread; `failed` gets the first failure, and the first after each success.
    pub fn start(
        target: PushTarget,
        metrics: RunMetrics,
        every: Duration,
        failed: impl Fn(&io::Error) + Send + 'static,
    ) -> Self {
        let (end, ended) = mpsc::channel();
        let thread = std::thread::spawn(move || {
            let mut worked = true;
            loop {
                let is_last = ended.recv_timeout(every) != Err(RecvTimeoutError::Timeout);
                let sent = target.send(&metrics.influx(Timestamp::now().0));
                if let (Err(error), true) = (&sent, worked) {
                    failed(error);
                }
                worked = sent.is_ok();
                if is_last {
                    return;
                }
            }
        });
        Self { end: Some(end), thread: Some(thread) }
    }
}

impl Drop for InfluxPush {
    fn drop(&mut self) {
        drop(self.end.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}
