//! Hostile input against a server: changed SQL, changed bytes of each protocol, changed run files, changed bodies.
//! Whatever comes, the process lives and answers the next client, and nothing in it panics but pgwire's decoder, which
//! ends the connection that it decodes for.

use std::path::Path;
use std::time::Duration;

use echolake_testing::{SMALL_RIG, run_command};
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::serve::http::HttpRequest;
use super::serve::server::ServedLake;

mod bodies;
mod bytes;
mod sql;

/// Limits of a query: time, memory, and rows.
const LIMITS: &str = "seconds = 2\nmemory_mb = 200\nrows = 100000\n";
/// Memory that bodies may need, the token's.
const BODY_KIB: u64 = 200 << 10;
/// Time to wait for more of an answer to changed bytes: many are the beginning of a request, and get none.
const PATIENCE: Duration = Duration::from_secs(1);
/// Time to wait for the rest of a backtrace.
const BACKTRACE_LIMIT: Duration = Duration::from_secs(60);
/// A server on which a plain query runs out of time for so long is harmed.
const BUSY: Duration = Duration::from_secs(60);

/// The input that is changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FuzzTarget {
    /// The text of queries, over HTTP.
    Sql,
    /// The bytes of HTTP, Flight SQL and Postgres' protocol.
    Wire,
    /// A run's file, which queries then read in place.
    Mcap,
    /// Arrow streams and JSON that users would add to the lake.
    Bodies,
}

impl FuzzTarget {
    /// All targets.
    pub const ALL: [Self; 4] = [Self::Sql, Self::Wire, Self::Mcap, Self::Bodies];

    /// Its name on a command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Sql => "sql",
            Self::Wire => "wire",
            Self::Mcap => "mcap",
            Self::Bodies => "bodies",
        }
    }
}

/// Counts of a campaign.
#[derive(Debug, Default)]
pub(crate) struct FuzzCounts {
    pub rounds: usize,
    /// Rounds whose query did not fail, or whose bytes got some back.
    pub answered: usize,
    /// Connections that ended by a panic of pgwire's decoder (0.41 panics on some messages of Postgres' protocol).
    pub broken: usize,
    /// The most that the server's process held in memory after a round, KiB.
    pub resident_kib: u64,
    /// The most that one of its engines held at a time, KiB.
    pub engine_kib: u64,
}

/// A server and what is thrown at it.
pub(crate) struct FuzzCampaign {
    folder: tempfile::TempDir,
    server: ServedLake,
    token: String,
    random: ChaCha8Rng,
    run: Vec<u8>,
    bodies: Vec<bodies::SentBody>,
}

impl FuzzCampaign {
    /// Measures a surface, ingests it, and serves the lake by [`ServedLake::start`] or its like.
    pub fn new(binary: &Path, seed: u64, serve: fn(&Path, &Path, &[&str]) -> ServedLake) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        std::fs::write(path("rig.toml"), SMALL_RIG).expect("written");
        let run = |args: &[&str]| {
            let mut command = std::process::Command::new(binary);
            command.args(["--lake", "lake"]).args(args).current_dir(folder.path()).env_remove("ECHOLAKE_LAKE");
            let output = run_command(&mut command).expect("the command starts");
            assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
            output
        };
        run(&["acquire", "--surface", "flat", "--rig", "rig.toml"]);
        run(&["ingest"]);
        let made = run(&["token", "fuzz", "--scopes", "sql,files,annotate"]);
        let token = String::from_utf8_lossy(&made.stderr).lines().next().expect("a token").to_owned();
        let entry = String::from_utf8(made.stdout).expect("text");
        let named = entry.split("seconds").next().expect("who it is");
        std::fs::write(path("tokens.toml"), format!("{named}{LIMITS}")).expect("written");
        let server = serve(binary, folder.path(), &["--tokens", "tokens.toml", "--memory", "1000"]);
        let file = run_file(&path("lake/runs/flat"));
        let name = file.file_stem().and_then(|name| name.to_str()).expect("a run's name");
        let bodies = bodies::bodies(name);
        let bytes = std::fs::read(&file).expect("a run");
        Self { server, token, random: ChaCha8Rng::seed_from_u64(seed), run: bytes, bodies, folder }
    }

    /// Throws one thing after the other for as long as `go_on` says.
    ///
    /// # Panics
    /// The server is harmed; the text names the cause.
    pub fn throw(&mut self, target: FuzzTarget, go_on: &mut dyn FnMut(&FuzzCounts) -> bool) -> FuzzCounts {
        let mut outcome = FuzzCounts::default();
        self.is_well("nothing");
        let before_kib = self.server.engine_kib();
        while go_on(&outcome) {
            let (thrown, answered) = match target {
                FuzzTarget::Sql => self.sql(),
                FuzzTarget::Wire => self.wire(),
                FuzzTarget::Mcap => self.mcap(),
                FuzzTarget::Bodies => self.body(),
            };
            outcome.rounds += 1;
            outcome.answered += usize::from(answered);
            outcome.broken = self.is_well(&thrown);
            outcome.resident_kib = outcome.resident_kib.max(self.server.resident_kib());
            outcome.engine_kib = outcome.engine_kib.max(self.server.engine_kib());
            let more_kib = outcome.engine_kib.saturating_sub(before_kib);
            assert!(target != FuzzTarget::Bodies || more_kib < BODY_KIB, "{more_kib} KiB more by: {thrown}");
        }
        outcome
    }

    // Asks a plain query; returns how many connections ended by a panic of their decoder so far.
    fn is_well(&mut self, thrown: &str) -> usize {
        assert!(self.server.is_up(), "the server ended by: {thrown}");
        let asked = std::time::Instant::now();
        let mut answer = self.ask("select 41 + 1 as n");
        // On a busy machine a plain query may run out of time; that is no harm.
        while answer.0 == 408 && asked.elapsed() < BUSY {
            answer = self.ask("select 41 + 1 as n");
        }
        assert_eq!((answer.0, answer.1.trim()), (200, r#"[{"n":42}]"#), "after: {thrown}");
        let counts = || {
            let said = self.server.said();
            ["panicked", "PgWireFrontendMessage::decode"].map(|w| said.iter().filter(|l| l.contains(w)).count())
        };
        let told = std::time::Instant::now();
        // A panic's backtrace comes line by line.
        while counts()[0] != counts()[1] && told.elapsed() < BACKTRACE_LIMIT {
            std::thread::sleep(Duration::from_millis(20));
        }
        let [panics, broken] = counts();
        assert_eq!(panics, broken, "{thrown}: {:?}", self.server.said());
        broken
    }

    fn ask(&self, query: &str) -> (u16, String) {
        let answer = HttpRequest::post("/api/v1/sql", query)
            .with("content-type", "text/plain")
            .with("authorization", &format!("Bearer {}", self.token))
            .attempt(&self.server);
        let answer =
            answer.unwrap_or_else(|| panic!("no answer to {query:?}; the server said: {:?}", self.server.said()));
        (answer.status, String::from_utf8_lossy(&answer.body).into_owned())
    }

    fn asked(&self, query: &str) -> bool {
        let (status, body) = self.ask(query);
        // 507 is the limit of memory; 503 is the answer if `version as of` names a version that the lake does not have.
        assert!(status < 500 || status == 503 || status == 507, "{status} by {query:?}: {body}");
        status == 200
    }

    fn sql(&mut self) -> (String, bool) {
        let query = sql::changed(&mut self.random);
        let answered = self.asked(&query);
        (query, answered)
    }

    fn wire(&mut self) -> (String, bool) {
        let (name, address, bytes) = match self.random.random_range(0..3) {
            0 => ("HTTP", &self.server.http, bytes::http(&mut self.random, &self.token)),
            1 => ("Postgres", &self.server.postgres, bytes::postgres(&mut self.random, &self.token)),
            _ => ("Flight SQL", &self.server.flight_sql, bytes::http2(&mut self.random)),
        };
        let heard = bytes::send(address, &bytes, PATIENCE);
        (format!("{name}: {}", bytes.escape_ascii()), heard > 0)
    }

    fn mcap(&mut self) -> (String, bool) {
        let mut changed = self.run.clone();
        let changes = bytes::change(&mut self.random, &mut changed);
        let file = run_file(&self.folder.path().join("lake/runs/flat"));
        std::fs::write(&file, &changed).expect("written");
        let function =
            ["mcap_topics('flat')", "mcap_messages('flat')", "mcap('flat', '/ir')", "mcap('flat', '/sweep')"]
                [self.random.random_range(0..4)];
        let answered = self.asked(&format!("select * from {function} limit 100"));
        std::fs::write(&file, &self.run).expect("written");
        (format!("{function} with {changes}"), answered)
    }

    // A changed body is refused as one, or is another good one: the engine reads the next.
    fn body(&mut self) -> (String, bool) {
        let sent = &self.bodies[self.random.random_range(0..self.bodies.len())];
        let mut changed = sent.bytes.clone();
        let changes = bytes::change(&mut self.random, &mut changed);
        let thrown = format!("{} with {changes}", sent.name);
        let answer = HttpRequest::post_bytes(sent.path, changed)
            .with("authorization", &format!("Bearer {}", self.token))
            .attempt(&self.server);
        let answer = answer.unwrap_or_else(|| panic!("{thrown}: no answer; {:?}", self.server.said()));
        let text = String::from_utf8_lossy(&answer.body);
        // 408 is the limit of time, on a busy machine.
        assert!(matches!(answer.status, 200 | 400 | 408 | 409 | 413), "{} by {thrown}: {text}", answer.status);
        (thrown, answer.status == 200)
    }
}

fn run_file(folder: &Path) -> std::path::PathBuf {
    let mut entries = std::fs::read_dir(folder).expect("a folder").flatten().map(|e| e.path());
    entries.find(|p| p.extension().is_some_and(|e| e == "mcap")).expect("a run's file")
}
