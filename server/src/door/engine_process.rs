//! One engine: a child process, its folder with sockets, and how it ended.

use std::collections::HashMap;
use std::ffi::{OsStr, OsString};
use std::io;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Duration;

use axum::body::Body;
use echolake_lake::CacheFolder;
use echolake_service::{
    DoorMessage, EngineEnd, EngineReport, EngineRole, EngineSocket, RequestFault, ServerProtocol, counted_bytes,
};
use hyper::client::conn::{http1, http2};
use hyper_util::rt::TokioIo;
use rustix::process::{Pid, PidfdFlags, Signal, pidfd_open, pidfd_send_signal};
use tokio::io::{AsyncBufReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::UnixStream;
use tokio::process::{Child, ChildStdin, ChildStdout, Command};
use tokio::sync::SetOnce;
use tokio::task::JoinSet;

use crate::door::activity::ServerActivity;
use crate::process_memory::private_bytes;

/// Time for which a request that lost its engine waits for the reason.
const REASON_WAIT: Duration = Duration::from_secs(2);

/// Share of the memory for decoded columns that the engine of pages has.
const PAGES_SHARE: usize = 2;
/// Idle connections that are kept to an engine.
const IDLE_CONNECTIONS: usize = 32;

/// The engines' program and their limits.
#[derive(Debug, Clone)]
pub struct EngineSettings {
    /// The program that has the command `engine`.
    pub program: PathBuf,
    /// Bytes of memory that queries may hold, all of them together.
    pub memory: usize,
    /// Bytes of decoded columns that the engine of statements keeps; that of pages keeps half as much.
    pub column_bytes: usize,
    /// Variables of their environment beside the server's own.
    pub environment: Vec<(String, String)>,
    /// Variables of the engine of statements alone, such as the token of workers.
    pub statement_environment: Vec<(String, String)>,
    /// The folder for temporary files; None for one in the lake.
    pub temp: Option<PathBuf>,
    /// Time from which a query is logged as slow; None for never.
    pub slow: Option<Duration>,
    /// The folder in which they cache what they read of an object store.
    pub cache: Option<CacheFolder>,
}

/// The reason for which an engine ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum EndReason {
    /// The door needed it no more.
    Retired,
    /// A query, or a defect; the engine itself may have named whose.
    Failed(EngineEnd),
}

impl EndReason {
    /// The reason for people.
    pub fn text(&self) -> String {
        match self {
            Self::Retired => "the server is ending".to_owned(),
            Self::Failed(end) => end.reason.clone(),
        }
    }

    /// The fault of a request that the engine had.
    pub fn fault(&self, request: Option<u64>) -> RequestFault {
        let reason = self.text();
        match self.is_for(request) {
            true => RequestFault::EngineEnded { reason },
            false => RequestFault::EngineLost { reason },
        }
    }

    /// Returns whether the engine says that it ended for this request.
    pub fn is_for(&self, request: Option<u64>) -> bool {
        let culprit = match self {
            Self::Retired => None,
            Self::Failed(end) => end.culprit.as_ref().and_then(|culprit| culprit.request),
        };
        culprit.is_some() && culprit == request
    }

    /// Returns whether the engine failed without saying for whom.
    pub fn is_unknown(&self) -> bool {
        matches!(self, Self::Failed(end) if end.culprit.is_none())
    }
}

/// An engine.
pub(crate) struct EngineProcess {
    pid: u32,
    folder: PathBuf,
    stdin: tokio::sync::Mutex<ChildStdin>,
    ready: SetOnce<()>,
    /// Its process, even if another has its number after its end.
    process: OwnedFd,
    why_killed: OnceLock<EndReason>,
    ended: SetOnce<EndReason>,
    pub flight: tokio::sync::Mutex<Option<http2::SendRequest<Body>>>,
    /// Connections of HTTP/1.1 whose last answer was received whole.
    idle_connections: Mutex<Vec<HttpConnection>>,
}

/// A connection of HTTP/1.1 to an engine. Dropping it ends what was requested on it.
pub(crate) struct HttpConnection {
    pub sender: http1::SendRequest<Body>,
    _driver: JoinSet<()>,
}

/// Parameters with which an engine is started.
pub(crate) struct EngineStart<'a> {
    pub settings: &'a EngineSettings,
    pub role: EngineRole,
    pub lake: &'a str,
    /// The lake's folder, if it is in one.
    pub lake_folder: Option<&'a Path>,
    /// Folders that are the engine's own.
    pub sockets: PathBuf,
    pub spills: PathBuf,
}

// Pages read few columns.
fn column_bytes(role: EngineRole, settings: &EngineSettings) -> usize {
    match role {
        EngineRole::Pages => settings.column_bytes / PAGES_SHARE,
        EngineRole::Statements => settings.column_bytes,
    }
}

fn cache_arguments(cache: &CacheFolder) -> [OsString; 4] {
    ["--cache".into(), cache.path.clone().into(), "--cache-size".into(), cache.bytes.to_string().into()]
}

impl EngineProcess {
    /// Starts a process that reads the lake and waits for requests.
    ///
    /// # Errors
    /// The system gives no folder or process.
    pub fn spawn_process(start: EngineStart<'_>, activity: Arc<ServerActivity>) -> io::Result<Arc<Self>> {
        let of_role = match start.role {
            EngineRole::Pages => &[][..],
            EngineRole::Statements => &start.settings.statement_environment,
        };
        let environment = start.settings.environment.iter().chain(of_role);
        std::fs::create_dir(&start.sockets)?;
        std::fs::create_dir(&start.spills)?;
        let mut child = Command::new(&start.settings.program)
            .args(["--lake", start.lake, "engine", "--sockets"])
            .arg(&start.sockets)
            .args(start.lake_folder.iter().flat_map(|folder| [OsStr::new("--confine-to"), folder.as_os_str()]))
            .args(["--role", start.role.name(), "--memory-bytes"])
            .arg(counted_bytes(start.settings.memory).to_string())
            .arg("--column-bytes")
            .arg(column_bytes(start.role, start.settings).to_string())
            .args(
                start.settings.slow.iter().flat_map(|slow| ["--log-slow-ms".to_owned(), slow.as_millis().to_string()]),
            )
            .args(start.settings.cache.iter().flat_map(cache_arguments))
            .envs(environment.map(|(name, value)| (name, value)))
            .env("TMPDIR", &start.spills)
            // Memory that is reserved and not used would count against the limit.
            .env("MIMALLOC_ARENA_EAGER_COMMIT", "0")
            // Ctrl-C in a terminal is for the door, which lets answers end.
            .process_group(0)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .kill_on_drop(true)
            .spawn()?;
        let (Some(stdin), Some(stdout), Some(pid)) = (child.stdin.take(), child.stdout.take(), child.id()) else {
            return Err(io::Error::other("the engine has no pipes"));
        };
        let number = Pid::from_raw(pid.cast_signed()).ok_or(io::ErrorKind::InvalidData)?;
        let process = pidfd_open(number, PidfdFlags::empty())?;
        let engine = Arc::new(Self {
            pid,
            folder: start.sockets,
            stdin: tokio::sync::Mutex::new(stdin),
            ready: SetOnce::new(),
            process,
            why_killed: OnceLock::new(),
            ended: SetOnce::new(),
            flight: tokio::sync::Mutex::default(),
            idle_connections: Mutex::default(),
        });
        tokio::spawn(supervise_engine(engine.clone(), child, stdout, start.spills, activity));
        Ok(engine)
    }

    /// Waits until it is ready.
    ///
    /// # Errors
    /// It ended before that.
    pub async fn wait_until_ready(&self) -> Result<(), EndReason> {
        tokio::select! {
            _ = self.ready.wait() => Ok(()),
            reason = self.ended.wait() => Err(reason.clone()),
        }
    }

    /// Sends it a message.
    ///
    /// # Errors
    /// It has ended.
    pub async fn send_message(&self, message: &DoorMessage) -> io::Result<()> {
        let mut line = serde_json::to_vec(message)?;
        line.push(b'\n');
        self.stdin.lock().await.write_all(&line).await
    }

    /// Its process id.
    pub fn pid(&self) -> u32 {
        self.pid
    }

    /// Connects to one of its sockets.
    ///
    /// # Errors
    /// The engine is not there any more.
    pub async fn connect_socket(&self, socket: EngineSocket) -> io::Result<UnixStream> {
        UnixStream::connect(socket.path_in(&self.folder)).await
    }

    /// Returns a connection for one request: an idle one, or a new one.
    ///
    /// # Errors
    /// The engine is not there any more.
    pub async fn take_connection(&self) -> Result<HttpConnection, String> {
        while let Some(idle) = self.lock_idle().pop() {
            if idle.sender.is_ready() {
                return Ok(idle);
            }
        }
        let stream = self.connect_socket(EngineSocket::Http).await.map_err(|e| e.to_string())?;
        let (sender, driver) = http1::handshake(TokioIo::new(stream)).await.map_err(|e| e.to_string())?;
        let mut tasks = JoinSet::new();
        tasks.spawn(async move { drop(driver.await) });
        Ok(HttpConnection { sender, _driver: tasks })
    }

    /// Keeps a connection for the next request; its last answer was received whole.
    pub fn keep_connection(&self, connection: HttpConnection) {
        let mut idle = self.lock_idle();
        if idle.len() < IDLE_CONNECTIONS {
            idle.push(connection);
        }
    }

    fn lock_idle(&self) -> MutexGuard<'_, Vec<HttpConnection>> {
        self.idle_connections.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Kills it; the first reason counts.
    pub fn kill_process(&self, why: EndReason) {
        let _ = self.why_killed.set(why);
        // One that is gone already needs no kill.
        let _ = pidfd_send_signal(&self.process, Signal::KILL);
    }

    /// Returns whether its process has ended.
    pub fn has_ended(&self) -> bool {
        self.ended.get().is_some()
    }

    /// Returns the reason of its end, if it has ended.
    pub fn end_reason(&self) -> Option<&EndReason> {
        self.ended.get()
    }

    /// Waits a moment for how it ended; None if it lives.
    pub async fn why_ended(&self) -> Option<EndReason> {
        tokio::time::timeout(REASON_WAIT, self.ended.wait()).await.ok().cloned()
    }

    /// Waits until it has ended; returns why.
    pub async fn wait_for_end(&self) -> EndReason {
        self.ended.wait().await.clone()
    }

    /// Returns whether it takes no more requests: it has ended, or is being killed.
    pub fn is_ending(&self) -> bool {
        self.why_killed.get().is_some() || self.has_ended()
    }

    /// Bytes of memory that it occupies: resident pages without those of files, which all engines share.
    pub fn private_bytes(&self) -> usize {
        private_bytes(&self.pid.to_string()).unwrap_or(0)
    }
}

// Reads what the engine reports until it ends, and says then how.
async fn supervise_engine(
    engine: Arc<EngineProcess>,
    mut child: Child,
    stdout: ChildStdout,
    spills: PathBuf,
    activity: Arc<ServerActivity>,
) {
    let mut reports = EngineReports { activity, protocols: HashMap::new(), end: None };
    let mut lines = BufReader::new(stdout).lines();
    while let Ok(Some(line)) = lines.next_line().await {
        reports.take_report(&line, &engine);
    }
    // Its output has ended, so that it is ending, too, or was never meant to.
    let _ = child.start_kill();
    let status = child.wait().await;
    reports.activity.metrics.count_lost(reports.activity.queries.end_engine(engine.pid));
    let found = || {
        let reason = || status.map_or_else(|e| e.to_string(), |status| format!("it ended by {status}"));
        reports.end.clone().unwrap_or_else(|| EngineEnd { reason: reason(), culprit: None })
    };
    let why = engine.why_killed.get().cloned().unwrap_or_else(|| EndReason::Failed(found()));
    for folder in [&engine.folder, &spills] {
        // The server's folder is removed at its end.
        let _ = std::fs::remove_dir_all(folder);
    }
    let _ = engine.ended.set(why);
}

struct EngineReports {
    activity: Arc<ServerActivity>,
    /// Protocols of the queries that run.
    protocols: HashMap<u64, ServerProtocol>,
    /// What the engine has said of its end.
    end: Option<EngineEnd>,
}

impl EngineReports {
    fn take_report(&mut self, line: &str, engine: &Arc<EngineProcess>) {
        let activity = &self.activity;
        match serde_json::from_str(line) {
            Ok(EngineReport::Ready) => drop(engine.ready.set(())),
            Ok(EngineReport::Ending(end)) => self.end = Some(end),
            Ok(EngineReport::Started(start)) => {
                activity.metrics.count_begin(start.protocol);
                self.protocols.insert(start.number, start.protocol);
                activity.queries.log_begin(engine.pid, start);
            }
            Ok(EngineReport::Ended(end)) => {
                if let Some(protocol) = self.protocols.remove(&end.number) {
                    activity.metrics.count_end(protocol, &end);
                    activity.queries.log_end(engine.pid, &end);
                }
            }
            Ok(EngineReport::Failure(code)) => activity.metrics.count_failure(code),
            Ok(EngineReport::Lake(figures)) => activity.set_lake(figures),
            Ok(EngineReport::Cache(counts)) => activity.metrics.count_cached(&counts),
            Ok(EngineReport::Workers { counts, workers }) => activity.metrics.set_workers(&counts, &workers),
            Ok(EngineReport::Ask { number, table, client, sees_all }) => {
                let message = DoorMessage::Rows { number, rows: activity.visible_rows(table, &client, sees_all) };
                let engine = engine.clone();
                // Beside this: an engine that does not read must not keep its reports from being read.
                tokio::spawn(async move { drop(engine.send_message(&message).await) });
            }
            Err(_) => tracing::warn!(line, "an engine wrote what is no report"),
        }
    }
}
