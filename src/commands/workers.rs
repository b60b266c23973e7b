//! Options of `serve` for queries over several machines: a worker, and a server with workers.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use echolake_lake::remote_access;
use echolake_query::{ClusterSettings, WorkerLink, WorkerToken};
use echolake_server::engine::confinement;
use echolake_server::{CertificateFiles, LakeWorker, WorkerSettings, program_build};

use super::cache::CacheArgs;
use crate::CommandOutcome;
use crate::signals::StopRequest;

/// Least MiB that a query reads to be spread, by default: a second of one core's work.
const SPREAD_MIB: u32 = 64;
/// The variable in which engines find their workers: arguments are visible to everybody on a machine, and a token is
/// among them.
const VARIABLE: &str = "ECHOLAKE_ENGINE_WORKERS";

/// Options of workers.
#[derive(Debug, clap::Args)]
pub(super) struct WorkerArgs {
    /// Workers for heavy queries, as https://10.0.0.7:7070; light queries run here.
    #[arg(long, value_name = "URL,...", value_delimiter = ',')]
    workers: Vec<String>,
    /// MiB that a query must read to be spread over workers.
    #[arg(long, value_name = "MIB", default_value_t = SPREAD_MIB, requires = "workers")]
    spread_from: u32,
    /// Be a worker of other servers of this lake, at this address; nothing else is served.
    #[arg(
        long,
        value_name = "ADDRESS",
        conflicts_with_all = ["listen", "flight_sql", "tokens", "temp", "log_slow", "workers"]
    )]
    #[cfg_attr(feature = "postgres", arg(conflicts_with = "postgres"))]
    worker: Option<SocketAddr>,
    /// File of the token that servers and workers share; without it, workers are on this machine.
    #[arg(long, value_name = "FILE")]
    worker_token: Option<PathBuf>,
    /// Certificates of the workers, or of their issuers (PEM).
    #[arg(long, value_name = "FILE")]
    worker_ca: Option<PathBuf>,
}

impl WorkerArgs {
    /// Returns the address of the worker that this process is to be, if it is one.
    pub fn worker_address(&self) -> Option<SocketAddr> {
        self.worker
    }

    /// Returns the variable by which engines find the workers, if there are some.
    pub fn engine_variable(&self) -> anyhow::Result<Option<(String, String)>> {
        if self.workers.is_empty() {
            return Ok(None);
        }
        let settings = ClusterSettings {
            workers: self.workers.clone(),
            token: self.read_token()?,
            authorities: self.read_authorities()?,
            least_bytes: u64::from(self.spread_from) << 20,
            build: program_build().context("cannot read this program")?,
        };
        settings.check_workers()?;
        Ok(Some((VARIABLE.to_owned(), serde_json::to_string(&settings)?)))
    }

    /// Gives up what a worker does not need. To be called before there are threads.
    pub fn confine_worker(
        &self,
        lake_url: &str,
        cache: &CacheArgs,
        certificate: Option<&CertificateFiles>,
    ) -> anyhow::Result<()> {
        let temp = std::env::temp_dir();
        let cache = cache.cache_folder();
        let own: Vec<_> = std::iter::once(temp.as_path()).chain(cache.as_ref().map(|cache| &*cache.path)).collect();
        let mut readable = match remote_access(lake_url) {
            Some(store) => store.files,
            None => confinement::lake_folders(Path::new(lake_url.strip_prefix("file://").unwrap_or(lake_url))),
        };
        readable.extend(self.worker_token.iter().chain(&self.worker_ca).cloned());
        readable.extend(certificate.into_iter().flat_map(CertificateFiles::folders));
        confinement::confine_worker(readable, &own).context("the worker cannot be confined")
    }

    /// Runs stages of other servers' queries until it is asked to stop.
    pub async fn run_worker(
        &self,
        address: SocketAddr,
        lake_url: &str,
        cache: &CacheArgs,
        certificate: Option<CertificateFiles>,
        memory: usize,
    ) -> anyhow::Result<CommandOutcome> {
        let stop = StopRequest::listen("stopping: engines run their queries elsewhere".to_owned())?;
        let lake = cache.open_lake(lake_url).await?;
        let link = WorkerLink::new(self.read_token()?, self.read_authorities()?.as_deref())?;
        let worker = LakeWorker::bind(&lake, WorkerSettings { address, link, certificate, memory }).await?;
        // What panics in a task would end the task's rows, as if there were no more.
        let default = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            default(panic);
            std::process::abort();
        }));
        eprintln!("lake {}", lake.location());
        if let Some(missing) = confinement::missing_support() {
            eprintln!("note: {missing}");
        }
        eprintln!("  worker {}", worker.listening_url()?);
        worker.serve_until(stop.wait_until_made()).await?;
        Ok(CommandOutcome::Whole)
    }

    fn read_token(&self) -> anyhow::Result<Option<WorkerToken>> {
        let Some(path) = &self.worker_token else { return Ok(None) };
        let failed = || format!("cannot use the token in `{}`", path.display());
        let text = std::fs::read_to_string(path).with_context(failed)?;
        Ok(Some(WorkerToken::parse(&text).with_context(failed)?))
    }

    fn read_authorities(&self) -> anyhow::Result<Option<String>> {
        let Some(path) = &self.worker_ca else { return Ok(None) };
        Ok(Some(std::fs::read_to_string(path).with_context(|| format!("cannot read `{}`", path.display()))?))
    }
}

/// Returns the workers of an engine, as the server that started it has them.
pub(super) fn read_engine_workers() -> anyhow::Result<Option<ClusterSettings>> {
    let text = std::env::var(VARIABLE).ok();
    text.map(|text| serde_json::from_str(&text).with_context(|| format!("the variable {VARIABLE}"))).transpose()
}
