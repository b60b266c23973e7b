//! `echolake serve` and `echolake token`: the lake over HTTP, Flight SQL and Postgres, with access control.

use std::fs::OpenOptions;
use std::io::Write as _;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Duration;

use anyhow::Context as _;
use echolake_lake::{Lake, remote_access};
use echolake_query::ClusterSettings;
use echolake_schema::ProjectName;
use echolake_server::certificate::self_signed;
use echolake_server::engine::{EngineOptions, confinement, run_engine};
use echolake_server::tokens::{self, TokenFile, TokenScope};
use echolake_server::{
    CataloguePages, CertificateFiles, EngineRole, EngineSettings, Error, LakeServer, ServerSettings,
};
use tokio::signal::unix::{SignalKind, signal};

use super::cache::CacheArgs;
use super::workers::{WorkerArgs, read_engine_workers};
use crate::CommandOutcome;
use crate::duration::parse_duration;
use crate::logging::child_variable;
use crate::signals::StopRequest;

/// Memory for queries by default.
const MEMORY_MIB: u32 = 4096;
/// Default of `--column-memory`.
const COLUMNS_MIB: u32 = 256;
/// Time for which the demo's answers may go on after Ctrl-C.
const CATALOGUE_DRAIN: Duration = Duration::from_secs(5);

#[derive(Debug, clap::Args)]
pub(crate) struct ServeArgs {
    /// Address for HTTP, or `off`; port 0 picks a free one (also for the two below).
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8080")]
    listen: ListenAddress,
    /// Address for Arrow Flight SQL.
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8081")]
    flight_sql: ListenAddress,
    /// Address for Postgres' protocol.
    #[cfg(feature = "postgres")]
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:5433")]
    postgres: ListenAddress,
    /// File of tokens; without it only this machine has access. `echolake token` makes its lines.
    #[arg(long, value_name = "FILE")]
    tokens: Option<PathBuf>,
    /// Certificate of the server or worker (PEM), with which all connections to it are encrypted; renewed files are
    /// taken while it runs.
    #[arg(long, value_name = "FILE", requires = "key")]
    certificate: Option<PathBuf>,
    /// Private key of the certificate (PEM).
    #[arg(long, value_name = "FILE", requires = "certificate")]
    key: Option<PathBuf>,
    /// Listen without encryption beyond this machine, because a proxy encrypts.
    #[arg(long, conflicts_with = "certificate")]
    plain_text_behind_a_proxy: bool,
    /// Without effect: all clients share two engines. Kept for scripts that have it.
    #[arg(long, value_name = "N", hide = true)]
    engines: Option<u32>,
    /// Time for which answers may go on after SIGTERM or Ctrl-C, as 30s or 5m; nothing new is taken meanwhile.
    #[arg(long, value_name = "TIME", default_value = "30s", value_parser = parse_duration)]
    drain: Duration,
    #[command(flatten)]
    workers: WorkerArgs,
    #[command(flatten)]
    queries: QueryArgs,
}

/// Options of commands that start engines.
#[derive(Debug, clap::Args)]
pub(super) struct QueryArgs {
    /// Memory limit of all queries together, MiB; if it is exceeded, the largest query is ended.
    #[arg(long, value_name = "MIB", default_value_t = MEMORY_MIB, value_parser = clap::value_parser!(u32).range(64..))]
    memory: u32,
    /// Memory for decoded columns of tables beside that of queries, MiB: that of statements; pages have half as much.
    #[arg(long, value_name = "MIB", default_value_t = COLUMNS_MIB)]
    column_memory: u32,
    /// Log queries that take this long or longer, with their statements, as 1s or 500ms.
    #[arg(long, value_name = "TIME", value_parser = parse_duration)]
    log_slow: Option<Duration>,
    /// Folder for temporary files, such as sorts that do not fit into memory; by default `temp` in the lake.
    #[arg(long, value_name = "DIR")]
    temp: Option<PathBuf>,
    #[command(flatten)]
    cache: CacheArgs,
}

impl QueryArgs {
    /// Opens a lake with the cache.
    pub async fn open_lake(&self, url: &str) -> anyhow::Result<Lake> {
        self.cache.open_lake(url).await
    }

    /// Returns the settings of a lake's engines.
    pub fn engine_settings(&self, lake: &Lake) -> anyhow::Result<EngineSettings> {
        Ok(EngineSettings {
            temp: self.temp.clone(),
            slow: self.log_slow,
            cache: self.cache.cache_folder().filter(|_| lake.is_remote()),
            ..default_engine_settings(self.memory, self.column_memory)?
        })
    }
}

/// Arguments with which `serve` starts its engines.
#[derive(Debug, clap::Args)]
pub(crate) struct EngineArgs {
    /// Folder for its sockets.
    #[arg(long)]
    sockets: PathBuf,
    /// The lake's folder, where it is one: the system keeps the engine from all other files.
    #[arg(long)]
    confine_to: Option<PathBuf>,
    /// What it answers: pages or statements.
    #[arg(long)]
    role: EngineRole,
    /// Bytes that its queries may hold.
    #[arg(long)]
    memory_bytes: usize,
    /// Bytes of decoded columns that it keeps.
    #[arg(long)]
    column_bytes: usize,
    /// Milliseconds from which a query is logged.
    #[arg(long)]
    log_slow_ms: Option<u64>,
    #[command(flatten)]
    cache: CacheArgs,
}

impl EngineArgs {
    /// Gives up what an engine does not need. To be called before there are threads.
    pub fn confine_process(&self, lake_url: &str) -> anyhow::Result<()> {
        let temp = std::env::temp_dir();
        let cache = self.cache.cache_folder();
        let own: Vec<_> = [self.sockets.as_path(), &temp]
            .into_iter()
            .chain(cache.as_ref().map(|cache| cache.path.as_path()))
            .collect();
        let workers = self.read_workers()?.map_or_else(Vec::new, |workers| workers.ports());
        let confined = match (&self.confine_to, remote_access(lake_url)) {
            (Some(lake), _) => confinement::confine_files(lake, &own, &workers),
            (None, Some(store)) => confinement::confine_to_store(&store, &own, &workers),
            (None, None) => Ok(()),
        };
        confined.context("the engine cannot be confined")
    }

    // The program's own statements are light, so that the engine of pages connects to no workers.
    fn read_workers(&self) -> anyhow::Result<Option<ClusterSettings>> {
        match self.role {
            EngineRole::Pages => Ok(None),
            EngineRole::Statements => read_engine_workers(),
        }
    }
}

/// Answers queries of all clients, until the door that started it ends.
pub(crate) async fn serve_engine(args: &EngineArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    // A service manager may signal all processes of a service: an engine ends with its door.
    let _ignored = signal(SignalKind::terminate()).context("cannot listen to SIGTERM")?;
    let lake = args.cache.open_lake(lake_url).await?;
    let slow = args.log_slow_ms.map(Duration::from_millis);
    let workers = args.read_workers()?;
    let options = EngineOptions {
        role: args.role,
        sockets: &args.sockets,
        memory: args.memory_bytes,
        column_bytes: args.column_bytes,
        slow,
        workers,
    };
    run_engine(&lake, options).await?;
    Ok(CommandOutcome::Whole)
}

/// A listening address, or none.
#[derive(Debug, Clone, Copy)]
enum ListenAddress {
    Off,
    On(SocketAddr),
}

impl FromStr for ListenAddress {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "off" => Ok(Self::Off),
            _ => text.parse().map(Self::On).map_err(|_| "not as 127.0.0.1:8080, [::1]:8080 or off".to_owned()),
        }
    }
}

impl ListenAddress {
    fn socket_address(self) -> Option<SocketAddr> {
        match self {
            Self::Off => None,
            Self::On(address) => Some(address),
        }
    }
}

/// The default address of HTTP.
const HTTP: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 8080);

impl ServeArgs {
    /// Gives up what a worker does not need; a server's engines do so themselves. To be called before there are
    /// threads.
    pub fn confine_process(&self, lake_url: &str) -> anyhow::Result<()> {
        match self.workers.worker_address() {
            Some(_) => self.workers.confine_worker(lake_url, &self.queries.cache, self.certificate_files().as_ref()),
            None => Ok(()),
        }
    }

    /// Returns whether it has no clients but servers.
    #[cfg(feature = "otlp")]
    pub fn is_worker(&self) -> bool {
        self.workers.worker_address().is_some()
    }

    fn certificate_files(&self) -> Option<CertificateFiles> {
        let (certificate, key) = self.certificate.clone().zip(self.key.clone())?;
        Some(CertificateFiles { certificate, key })
    }
}

pub(crate) async fn run_serve(args: &ServeArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    if let Some(address) = args.workers.worker_address() {
        let memory = (args.queries.memory as usize) << 20;
        let worker = args.workers.run_worker(address, lake_url, &args.queries.cache, args.certificate_files(), memory);
        return worker.await;
    }
    let reply = format!("stopping: answers may go on for {:?}; Ctrl-C again stops at once", args.drain);
    let stop = StopRequest::listen(reply)?;
    let lake = args.queries.open_lake(lake_url).await?;
    let mut engines = args.queries.engine_settings(&lake)?;
    engines.statement_environment.extend(args.workers.engine_variable()?);
    let settings = ServerSettings {
        http: args.listen.socket_address(),
        flight_sql: args.flight_sql.socket_address(),
        #[cfg(feature = "postgres")]
        postgres: args.postgres.socket_address(),
        tokens: args.tokens.as_deref().map(TokenFile::read_from).transpose()?,
        certificate: args.certificate_files(),
        is_behind_proxy: args.plain_text_behind_a_proxy,
        drain: args.drain,
        engines,
    };
    let addresses = [
        args.listen,
        args.flight_sql,
        #[cfg(feature = "postgres")]
        args.postgres,
    ];
    let listens_everywhere =
        addresses.into_iter().filter_map(ListenAddress::socket_address).any(|one| one.ip().is_unspecified());
    if args.engines.is_some() {
        eprintln!("warning: --engines has no effect: all clients share two engines");
    }
    let server = LakeServer::bind(&lake, settings)?;
    anyhow::ensure!(!server.listening_urls().is_empty(), "nothing to listen on; hint: all three are off");
    eprintln!("lake {}", lake.location());
    if listens_everywhere {
        eprintln!("note: other machines reach it at all addresses and names of this one");
    }
    if let Some(missing) = confinement::missing_support() {
        eprintln!("note: {missing}");
    }
    run_server(server, &stop).await
}

/// Serves the catalogue alone, at the default address or, if that is taken, on any free port.
pub(crate) async fn serve_catalogue(lake: &Lake, stop: &StopRequest) -> anyhow::Result<CommandOutcome> {
    let engines = default_engine_settings(MEMORY_MIB, COLUMNS_MIB)?;
    let settings = |http| ServerSettings {
        http: Some(http),
        flight_sql: None,
        #[cfg(feature = "postgres")]
        postgres: None,
        tokens: None,
        certificate: None,
        is_behind_proxy: false,
        drain: CATALOGUE_DRAIN,
        engines: engines.clone(),
    };
    let server = match LakeServer::bind(lake, settings(HTTP)) {
        Err(Error::Bind { .. }) => LakeServer::bind(lake, settings(SocketAddr::new(HTTP.ip(), 0)))?,
        bound => bound?,
    };
    eprintln!("the catalogue, until Ctrl-C:");
    run_server(server, stop).await
}

fn default_engine_settings(memory_mib: u32, column_mib: u32) -> anyhow::Result<EngineSettings> {
    let program = std::env::current_exe().context("this program does not know its own path")?;
    let (name, value) = child_variable();
    Ok(EngineSettings {
        program,
        environment: vec![(name.to_owned(), value.to_owned())],
        statement_environment: Vec::new(),
        memory: (memory_mib as usize) << 20,
        column_bytes: (column_mib as usize) << 20,
        temp: None,
        slow: None,
        cache: None,
    })
}

async fn run_server(server: LakeServer, stop: &StopRequest) -> anyhow::Result<CommandOutcome> {
    if let Some(problem) = CataloguePages::THIS_BUILD.missing_reason() {
        eprintln!("note: this program was {problem}");
    }
    for address in server.listening_urls() {
        eprintln!("  {address}");
    }
    server.serve_until(stop.wait_until_made()).await?;
    Ok(CommandOutcome::Whole)
}

/// Arguments of `echolake certificate`.
#[derive(Debug, clap::Args)]
pub(crate) struct CertificateArgs {
    /// Names and addresses under which clients reach the server.
    #[arg(value_name = "NAME", required = true)]
    names: Vec<String>,
    /// Folder for certificate.pem and key.pem; files that are there are not overwritten.
    #[arg(short, long, value_name = "DIR", default_value = ".")]
    output: PathBuf,
}

/// Writes a self-signed certificate and its key.
pub(crate) fn write_certificate(args: &CertificateArgs) -> anyhow::Result<CommandOutcome> {
    let made = self_signed(&args.names)?;
    std::fs::create_dir_all(&args.output).with_context(|| format!("cannot make `{}`", args.output.display()))?;
    // The key first: nobody but its owner reads it, from its first byte on.
    for (name, text, mode) in [("key.pem", &made.key, 0o600), ("certificate.pem", &made.certificate, 0o644)] {
        let path = args.output.join(name);
        let failed = || format!("cannot write `{}`; hint: another folder, -o DIR", path.display());
        let mut file = OpenOptions::new().write(true).create_new(true).mode(mode).open(&path).with_context(failed)?;
        file.write_all(text.as_bytes()).and_then(|()| file.sync_all()).with_context(failed)?;
        super::print_line(&path.display().to_string())?;
    }
    eprintln!("clients trust it by having certificate.pem; the key stays on the server");
    Ok(CommandOutcome::Whole)
}

// What the file has so far that stdout is appended to; None if stdout is no file.
fn read_stdout_file() -> Option<String> {
    let stdout = Path::new("/dev/stdout");
    std::fs::metadata(stdout).ok().filter(std::fs::Metadata::is_file)?;
    std::fs::read_to_string(stdout).ok()
}

/// Prints a new token to stderr, once, and its lines for the file of tokens to stdout.
pub(crate) fn print_token(
    name: &str,
    days: Option<u32>,
    projects: &[ProjectName],
    scopes: &[TokenScope],
) -> anyhow::Result<CommandOutcome> {
    anyhow::ensure!(
        projects.is_empty() || !scopes.contains(&TokenScope::Metrics),
        "a token of projects cannot have the scope metrics, whose figures are of all projects; hint: make two tokens"
    );
    let fresh = tokens::generate_token(name, days, projects, scopes)?;
    eprintln!("{}\nthis token is kept nowhere: only its hash is, in the lines for the file of --tokens", fresh.token);
    if let Some(line) = read_stdout_file().and_then(|text| tokens::find_name_lines(&text, name).first().copied()) {
        eprintln!(
            "warning: line {line} of this file has the name `{name}` already, and `serve` refuses a name that is there \
             twice; hint: remove the [[token]] of one"
        );
    }
    super::print_line(fresh.lines.trim_end())?;
    Ok(CommandOutcome::Whole)
}
