//! A server in this process, its door and one engine behind it, to which targets send bytes.

use std::backtrace::Backtrace;
use std::collections::HashSet;
use std::io::{Read as _, Write as _};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::os::unix::fs::PermissionsExt as _;
use std::path::PathBuf;
use std::sync::Mutex;
use std::time::Duration;

use echolake_server::fuzzing::serve_engine;
use echolake_server::{EngineSettings, LakeServer, ServerSettings};
use tokio::signal::unix::{self, SignalKind};

use crate::FuzzedLake;

/// The program that the door starts for an engine: it says that it is ready, and leads to the engine in this process.
const ENGINE_PROGRAM: &str = "#!/bin/sh\nwhile [ \"$1\" != --sockets ]; do shift; done\n\
                              ln -s \"$FUZZED_ENGINE\"/* \"$2\"\necho '\"ready\"'\nexec cat > /dev/null\n";
/// Sockets of an engine.
const PROTOCOLS: usize = 3;
/// Bytes that queries may hold.
const MEMORY: usize = 200 << 20;
/// Silence after which this side ends a connection: many inputs are the beginning of a request, and get no answer.
const QUIET: Duration = Duration::from_millis(20);
/// Time to wait for the server's end of a connection that this side has ended.
const PATIENCE: Duration = Duration::from_secs(1);
/// A function of pgwire that panics on some messages; the connection that it decodes for ends by it, and nothing else.
const PGWIRE_DECODER: &str = "PgWireFrontendMessage";

/// A protocol of the server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ServerWire {
    /// HTTP/1.1.
    Http,
    /// Arrow Flight SQL.
    Flight,
    /// Postgres' protocol.
    Postgres,
}

/// A server of an empty lake, without tokens.
pub struct FuzzedServer {
    addresses: Vec<SocketAddr>,
    _lake: FuzzedLake,
}

impl FuzzedServer {
    /// Starts it. From now on a panic ends the process, in whatever thread or task it is.
    ///
    /// # Panics
    /// It does not start.
    pub fn start() -> Self {
        abort_on_panics();
        let lake = FuzzedLake::new();
        let sockets = lake.path().join("engine");
        std::fs::create_dir(&sockets).expect("a folder");
        lake.write("engine.sh", ENGINE_PROGRAM.as_bytes());
        let program = lake.path().join("engine.sh");
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o700)).expect("a program");
        let any = Some(SocketAddr::from(([127, 0, 0, 1], 0)));
        let settings = ServerSettings {
            http: any,
            flight_sql: any,
            postgres: any,
            tokens: None,
            certificate: None,
            is_behind_proxy: false,
            drain: Duration::ZERO,
            engines: engine_settings(program, sockets.to_str().expect("a path in UTF-8")),
        };
        let served = lake.lake.clone();
        let engine = sockets.clone();
        lake.runtime.spawn(async move { serve_engine(&served, &engine, MEMORY).await.expect("an engine") });
        // The script leads to sockets that are there.
        while std::fs::read_dir(&sockets).expect("a folder").count() < PROTOCOLS {
            std::thread::sleep(QUIET);
        }
        let entered = lake.runtime.enter();
        // Without Rust's own `main` a client that is gone ends the process; a handler that is set stays.
        unix::signal(SignalKind::pipe()).expect("a handler");
        let server = LakeServer::bind(&lake.lake, settings).expect("a server");
        drop(entered);
        let addresses = server.listening_urls().iter().map(|url| address(url)).collect();
        lake.runtime.spawn(async move { server.serve_until(std::future::pending()).await.expect("a server") });
        Self { addresses, _lake: lake }
    }

    /// Sends bytes, reads until the server ends the connection or is quiet, and ends it, which cancels what runs.
    ///
    /// # Panics
    /// The server takes no connections any more.
    pub fn send(&self, wire: ServerWire, bytes: &[u8]) {
        let mut stream = TcpStream::connect(self.addresses[wire as usize]).expect("connected");
        stream.set_write_timeout(Some(PATIENCE)).expect("a time");
        // A server may close as soon as it has seen enough.
        let _ = stream.write_all(bytes);
        read_all(&mut stream, QUIET);
        let _ = stream.shutdown(Shutdown::Write);
        read_all(&mut stream, PATIENCE);
    }
}

// Up to the end, or a silence of so long.
fn read_all(stream: &mut TcpStream, silence: Duration) {
    stream.set_read_timeout(Some(silence)).expect("a time");
    let mut buffer = [0; 4096];
    while let Ok(1..) = stream.read(&mut buffer) {}
}

fn engine_settings(program: PathBuf, sockets: &str) -> EngineSettings {
    EngineSettings {
        program,
        memory: MEMORY,
        column_bytes: 64 << 20,
        environment: vec![("FUZZED_ENGINE".to_owned(), sockets.to_owned())],
        temp: None,
        slow: None,
        cache: None,
    }
}

// Of `http://127.0.0.1:8080` and the like.
fn address(url: &str) -> SocketAddr {
    let behind = url.split("://").nth(1).and_then(|rest| rest.split('/').next()).expect("a URL");
    behind.parse().expect("an address")
}

/// Makes libFuzzer's own hook, which ends the process, hear of panics in all threads, but not of those of pgwire's
/// decoder.
pub fn abort_on_panics() {
    let abort = std::panic::take_hook();
    let known = Mutex::new(HashSet::new());
    std::panic::set_hook(Box::new(move |panic| {
        let place = panic.location().map(ToString::to_string);
        let mut known = known.lock().expect("no panic here");
        // A backtrace takes a while.
        let is_decoder = known.contains(&place) || Backtrace::force_capture().to_string().contains(PGWIRE_DECODER);
        match is_decoder {
            true => drop(known.insert(place)),
            false => abort(panic),
        }
    }));
}
