//! A server on a small simulated lake, watched from outside: its processes, their memory and processor time, and the
//! answers that its clients get.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use echolake_testing::{SMALL_RIG, run_command};

use crate::serve::server::ServedLake;

mod client_connections;
mod flight_query;
mod http_query;
mod light_load;
mod memory_watch;
mod postgres_query;
mod process_tree;
mod protocol_query;
mod query_client;
mod repeated_work;
mod right_answers;

pub(crate) use client_connections::ClientConnections;
pub(crate) use flight_query::{FlightClient, failure_outcome, flight_client};
pub(crate) use light_load::{LightLoad, LightReport};
pub(crate) use memory_watch::{MemoryPeak, MemoryWatch};
pub(crate) use postgres_query::{PostgresClient, startup_message, tagged_message};
pub(crate) use process_tree::{ProcessTree, kill_process};
pub(crate) use query_client::{QueryClient, QueryOutcome, QueryProtocol, percent_encoded};
pub(crate) use right_answers::{AnswerTally, RightAnswers, take_right_answers};

/// Memory of all queries together, MiB: `--memory`.
const QUERY_MEMORY_MIB: &str = "2048";
/// Surfaces of the lake; each has one run with its sweeps.
const SURFACES: [&str; 3] = ["flat", "foam", "wood"];
/// Queries that a server answers before it counts as started, so that what is loaded at first use is loaded.
const WARM_UP_QUERIES: usize = 5;

/// Clients with the same limits.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ClientGroup {
    /// The token file has `NAME-0`, `NAME-1`, ...
    pub name: &'static str,
    pub count: usize,
    /// Lines of the token file: `seconds = 10`.
    pub limits: &'static str,
}

/// A token and whose it is.
#[derive(Debug, Clone)]
struct ClientToken {
    name: String,
    token: String,
}

/// Addresses of the protocols.
#[derive(Debug, Clone)]
pub(crate) struct ServerAddresses {
    pub http: String,
    pub flight_sql: String,
    pub postgres: String,
}

/// A server, restarted if it dies.
pub(crate) struct ObservedServer {
    folder: tempfile::TempDir,
    binary: PathBuf,
    tokens: Vec<ClientToken>,
    served: ServedLake,
    runs: Vec<String>,
    /// Number of restarts.
    pub restarts: usize,
}

impl ObservedServer {
    /// Measures and ingests the lake, makes a token for each client, and serves.
    ///
    /// # Errors
    /// A command fails.
    pub fn start(binary: &Path, groups: &[ClientGroup]) -> Result<Self> {
        let folder = tempfile::tempdir()?;
        std::fs::write(folder.path().join("rig.toml"), SMALL_RIG)?;
        for surface in SURFACES {
            run_echolake(binary, folder.path(), &["acquire", "--surface", surface, "--rig", "rig.toml"])?;
        }
        run_echolake(binary, folder.path(), &["ingest"])?;
        let tokens = make_tokens(binary, folder.path(), groups)?;
        let served = serve_lake(binary, folder.path());
        let mut server = Self { folder, binary: binary.to_owned(), tokens, served, runs: Vec::new(), restarts: 0 };
        server.runs = server.list_runs()?;
        server.warm_up();
        Ok(server)
    }

    pub fn addresses(&self) -> ServerAddresses {
        let ServedLake { http, flight_sql, postgres, .. } = &self.served;
        ServerAddresses { http: http.clone(), flight_sql: flight_sql.clone(), postgres: postgres.clone() }
    }

    /// Returns the token of client `NAME-NUMBER`; numbers beyond the group's begin again at 0.
    pub fn token(&self, group: &str, number: usize) -> &str {
        let is_member = |t: &&ClientToken| t.name.rsplit_once('-').is_some_and(|(name, _)| name == group);
        let members: Vec<_> = self.tokens.iter().filter(is_member).collect();
        members.get(number % members.len().max(1)).map_or("", |member| &member.token)
    }

    /// Returns a client of the group with connections of its own.
    pub fn client(&self, group: &str, number: usize) -> QueryClient {
        QueryClient::new(self.addresses(), self.token(group, number), self.run_name())
    }

    /// Returns the name of a run of the lake.
    pub fn run_name(&self) -> &str {
        self.runs.first().map_or("", String::as_str)
    }

    /// Returns the number of runs of the lake.
    pub fn run_count(&self) -> usize {
        self.runs.len()
    }

    pub fn process_tree(&self) -> ProcessTree {
        ProcessTree::new(self.served.id())
    }

    pub fn is_alive(&mut self) -> bool {
        self.served.is_up()
    }

    /// Returns the last lines that it wrote to stderr.
    pub fn last_words(&self) -> String {
        let said = self.served.said();
        said[said.len().saturating_sub(3)..].join(" / ")
    }

    /// Returns how many engines have ended by themselves so far, as its log says.
    pub fn count_engine_ends(&self) -> usize {
        self.served.said().iter().filter(|line| line.contains("an engine ended")).count()
    }

    /// Kills it with its engines and starts another on the same lake.
    pub fn restart(&mut self) {
        self.process_tree().kill();
        self.served = serve_lake(&self.binary, self.folder.path());
        self.restarts += 1;
        self.warm_up();
    }

    /// Waits until its processes work less than a hundredth of the time; returns false if they still do at the limit.
    pub fn wait_until_idle(&self, limit: Duration) -> bool {
        let begun = Instant::now();
        while begun.elapsed() < limit {
            if self.process_tree().processor_time_over(Duration::from_millis(300)) <= Duration::from_millis(10) {
                return true;
            }
        }
        false
    }

    fn list_runs(&self) -> Result<Vec<String>> {
        let listed =
            run_echolake(&self.binary, self.folder.path(), &["sql", "--json", "select run_id from runs order by 1"])?;
        let rows: Vec<serde_json::Value> = serde_json::from_slice(&listed.stdout)?;
        Ok(rows.iter().filter_map(|row| row["run_id"].as_str().map(str::to_owned)).collect())
    }

    // The idle state that memory is compared with is that of a server that has answered something.
    fn warm_up(&self) {
        let client = self.client("light", 0);
        for protocol in [QueryProtocol::Http, QueryProtocol::PostgresSimple, QueryProtocol::FlightSql] {
            for _ in 0..WARM_UP_QUERIES {
                let _ = client.query(protocol, "select count(*) from runs");
            }
        }
    }
}

impl Drop for ObservedServer {
    fn drop(&mut self) {
        self.process_tree().kill();
    }
}

fn serve_lake(binary: &Path, folder: &Path) -> ServedLake {
    ServedLake::start(binary, folder, &["--tokens", "tokens.toml", "--memory", QUERY_MEMORY_MIB])
}

fn run_echolake(binary: &Path, folder: &Path, args: &[&str]) -> Result<Output> {
    let mut command = Command::new(binary);
    command.args(["--lake", "lake"]).args(args).current_dir(folder).env_remove("ECHOLAKE_LAKE");
    let output = run_command(&mut command)?;
    ensure!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(output)
}

fn make_tokens(binary: &Path, folder: &Path, groups: &[ClientGroup]) -> Result<Vec<ClientToken>> {
    let mut tokens = Vec::new();
    let mut file = String::new();
    for group in groups {
        for number in 0..group.count {
            let name = format!("{}-{number}", group.name);
            let made = run_echolake(binary, folder, &["token", &name])?;
            let token = String::from_utf8_lossy(&made.stderr).lines().next().context("no token")?.to_owned();
            let lines = String::from_utf8(made.stdout)?;
            // What follows are limits, for which the group has its own.
            file.push_str(lines.split("seconds").next().unwrap_or_default());
            file.push_str(group.limits);
            file.push('\n');
            tokens.push(ClientToken { name, token });
        }
    }
    std::fs::write(folder.join("tokens.toml"), file)?;
    Ok(tokens)
}
