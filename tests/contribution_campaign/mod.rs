//! Random sequences of what users of two projects with a surface of the same name add by two servers: annotations,
//! predictions and verdicts, among them what a client must not add, with tags, merges and killed servers in between.
//! Nothing crosses to the other project, and nothing acknowledged is lost, for an independent reader, too. At the end
//! of each sequence a file is lost or damaged: `doctor` names it, and only what reads its table stops until it is back.

mod expected_rows;
mod requests;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::Duration;

use echolake_testing::{SMALL_RIG, run_command};
use rand::seq::SliceRandom as _;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

use super::serve::http::HttpRequest;
use super::serve::server::ServedLake;
use expected_rows::{DamagedFile, DeltaFolder, ExpectedRows};
use requests::{
    ANNOTATIONS, CLIENTS, EVE, PREDICTIONS, PredictedValues, RUNS, RequestSource, SentRows, TABLES, send_request,
};

/// Kinds of steps, of which each sequence has one of each, and the first of them, which are repeated at random.
const STEPS: u32 = 9;
const REPEATED_STEPS: u32 = 6;
/// Servers and the clients whose rows are compared there: each client of a server has an engine, which takes a while to
/// start.
const READERS: [(usize, usize); 4] = [(0, 0), (0, EVE), (1, 1), (1, EVE)];
/// Longest time until the end of a server that is killed.
const LONGEST: Duration = Duration::from_millis(30);

/// Counts of a campaign.
#[derive(Debug, Default)]
pub(crate) struct ContributionCounts {
    /// Sequences, with a fault each.
    pub sequences: usize,
    /// Requests that were acknowledged.
    pub acknowledged: usize,
    /// Requests that were refused, as they must be.
    pub refused: usize,
    /// Requests whose answer was lost, because their server was killed.
    pub unanswered: usize,
    /// Of these, those that were sent again.
    pub repeated: usize,
}

/// A campaign in a folder of its own.
pub(crate) struct ContributionCampaign {
    folder: tempfile::TempDir,
    binary: PathBuf,
    seed: u64,
    tokens: Vec<String>,
    servers: Vec<ServedLake>,
    source: RequestSource,
    expected: ExpectedRows,
    /// Each with the numbers of rows of then, by table.
    tags: Vec<(String, [usize; TABLES.len()])>,
    annotated: Option<SentRows>,
    predicted: Vec<PredictedValues>,
    counts: ContributionCounts,
    /// What is being done, for failures.
    place: String,
}

impl ContributionCampaign {
    /// Makes a lake with references and a surface of two projects, and serves it twice.
    pub fn new(binary: &Path, seed: u64) -> Self {
        let mut campaign = Self {
            folder: tempfile::tempdir().expect("a folder"),
            binary: binary.to_owned(),
            seed,
            tokens: Vec::new(),
            servers: Vec::new(),
            source: RequestSource::new(seed, Vec::new()),
            expected: ExpectedRows::default(),
            tags: Vec::new(),
            annotated: None,
            predicted: Vec::new(),
            counts: ContributionCounts::default(),
            place: "a new lake".to_owned(),
        };
        fs::write(campaign.folder.path().join("rig.toml"), SMALL_RIG).expect("written");
        let of_project = |project: Option<&'static str>| project.map_or(Vec::new(), |name| vec!["--project", name]);
        for (surface, project) in RUNS {
            let acquire = ["acquire", "--surface", surface, "--rig", "rig.toml", "--ir-only"];
            campaign.run(&[&acquire[..], &of_project(project)[..]].concat());
        }
        campaign.run(&["ingest"]);
        let runs = campaign.run(&["sql", "--json", "select run_id, surface_id, project from runs"]).stdout;
        let runs: Vec<Value> = serde_json::from_slice(&runs).expect("JSON");
        let run_ids = RUNS.map(|(surface, project)| {
            let is_meant = |run: &&Value| run["surface_id"] == surface && run["project"].as_str() == project;
            runs.iter().find(is_meant).and_then(|run| run["run_id"].as_str()).expect("it was ingested").to_owned()
        });
        campaign.source = RequestSource::new(seed, run_ids.to_vec());
        let mut lines = String::new();
        for (name, project) in CLIENTS {
            let scopes = project.map_or("sql,annotate,annotate-references", |_| "sql,annotate");
            let made = campaign.run(&[&["token", name, "--scopes", scopes], &of_project(project)[..]].concat());
            let printed = String::from_utf8_lossy(&made.stderr).into_owned();
            campaign.tokens.push(printed.lines().next().expect("a token").to_owned());
            lines += &String::from_utf8_lossy(&made.stdout);
        }
        fs::write(campaign.folder.path().join("tokens.toml"), lines).expect("written");
        campaign.start_servers();
        campaign
    }

    /// Runs sequences, each with a fault at its end. The seed chooses the first fault, too.
    ///
    /// # Panics
    /// A row crossed to the other project, an acknowledged one is missing, or a fault is not seen as it must be.
    pub fn sequences(&mut self, count: usize, told: &mut dyn FnMut(&ContributionCounts)) -> &ContributionCounts {
        for sequence in 0..count {
            let mut steps: Vec<u32> = (0..STEPS).collect();
            let more = self.source.random.random_range(1..=9);
            steps.extend((0..more).map(|_| self.source.random.random_range(0..REPEATED_STEPS)));
            steps.shuffle(&mut self.source.random);
            for (i, step) in steps.iter().enumerate() {
                self.place = format!("seed {}, sequence {sequence}, step {i} of {steps:?}", self.seed);
                self.take_step(*step);
            }
            self.place = format!("seed {}, sequence {sequence}, after {steps:?}", self.seed);
            // What a killed server left in a table without showing it is shown from here on.
            let annotations = self.source.draw_annotations(EVE);
            self.store_rows(0, &annotations, true);
            self.store_predictions(1, EVE);
            self.check_everything();
            self.damage_table(self.seed as usize % 10 + sequence);
            self.counts.sequences += 1;
            told(&self.counts);
        }
        &self.counts
    }

    fn take_step(&mut self, step: u32) {
        let client = self.source.random.random_range(0..CLIENTS.len());
        let server = self.source.random.random_range(0..self.servers.len());
        match step {
            0 => {
                let annotations = self.source.draw_annotations(client);
                self.store_rows(server, &annotations, true);
                self.annotated = Some(annotations);
            }
            1 => self.store_predictions(server, client),
            2 => self.send_again(server),
            3 => self.write_at_once(),
            4 => self.judge_reference(server),
            5 => self.trespass(server),
            6 => {
                let name = format!("t{}", self.tags.len());
                self.run(&["tag", &name]);
                self.tags.push((name, self.expected.counts()));
            }
            7 => drop(self.run(&["optimize"])),
            _ => self.kill_server(server, client),
        }
    }

    // Rows that are stored are known, in whatever grouping, and those beside them are new.
    fn send_again(&mut self, server: usize) {
        if let Some(annotations) = self.annotated.take() {
            self.store_rows(server, &annotations, false);
        }
        if self.predicted.is_empty() {
            return;
        }
        let index = self.source.random.random_range(0..self.predicted.len());
        let mut predicted = self.predicted[index].clone();
        let mut keys = predicted.keys();
        keys.shuffle(&mut self.source.random);
        keys.truncate(self.source.random.random_range(1..=keys.len()));
        if self.source.random.random() {
            self.source.draw_value(&mut predicted);
        }
        let stored = &self.predicted[index].values;
        let new: Vec<_> = predicted.keys().into_iter().filter(|key| !stored.contains_key(key)).collect();
        keys.extend(&new);
        let sent = self.source.prediction_request(&predicted, &keys);
        self.store_rows(server, &sent, !new.is_empty());
        self.predicted[index] = predicted;
    }

    // Clients of both projects write at once, by a server each.
    fn write_at_once(&mut self) {
        let both = [0, 1].map(|client| self.source.draw_annotations(client));
        let answers = std::thread::scope(|scope| {
            let begun = [0, 1].map(|client| {
                let (address, token) = (self.servers[client].http.as_str(), self.tokens[client].as_str());
                let request = both[client].http_request();
                scope.spawn(move || send_request(address, token, request))
            });
            begun.map(|thread| thread.join().expect("it sends"))
        });
        for (sent, answer) in both.iter().zip(answers) {
            self.acknowledge(sent, answer, Some(true));
        }
    }

    // A verdict on a reference needs its right and a confirmation.
    fn judge_reference(&mut self, server: usize) {
        let run = self.source.random.random_range(0..2);
        let forbidden = self.source.draw_annotation(0, run, "verdict");
        self.refuse(server, &self.source.annotation_request(0, vec![forbidden], true), 403);
        let verdict = self.source.draw_annotation(EVE, run, "verdict");
        self.refuse(server, &self.source.annotation_request(EVE, vec![verdict.clone()], false), 409);
        let confirmed = self.source.annotation_request(EVE, vec![verdict], true);
        self.store_rows(server, &confirmed, true);
        self.counts.refused += 2;
    }

    // A client adds to the surface of the other project.
    fn trespass(&mut self, server: usize) {
        let client = self.source.random.random_range(0..2);
        let run = 3 - client;
        let note = self.source.draw_annotation(client, run, "note");
        self.refuse(server, &self.source.annotation_request(client, vec![note], false), 400);
        let predicted = PredictedValues::of_run(client, run);
        self.refuse(server, &self.source.prediction_request(&predicted, &predicted.keys()), 400);
        self.counts.refused += 2;
    }

    // A server is killed while a client adds. What had no answer is sent again to either server, or left as it is.
    fn kill_server(&mut self, server: usize, client: usize) {
        let first = self.source.draw_annotations(client);
        self.store_rows(server, &first, true);
        let moment = LONGEST.mul_f64(self.source.random.random());
        // How many requests are drawn until then is by chance, and the next steps are those of the seed.
        let next = ChaCha8Rng::seed_from_u64(self.source.random.random());
        let pid = Pid::from_raw(self.servers[server].id() as i32).expect("a process");
        let killer = std::thread::spawn(move || {
            std::thread::sleep(moment);
            kill_process(pid, Signal::KILL).expect("it runs");
        });
        let unanswered = loop {
            let sent = if self.source.random.random() {
                self.source.draw_annotations(client)
            } else {
                let predicted = self.source.draw_predictions(client);
                self.source.prediction_request(&predicted, &predicted.keys())
            };
            match self.send_to(server, client, sent.http_request()) {
                Some((200, answer)) => self.acknowledge(&sent, Some((200, answer)), Some(true)),
                // Its engine may have ended just before.
                Some((status, answer)) if status < 500 => panic!("{}: {status} {answer}", self.place),
                _ => break sent,
            }
        };
        self.counts.unanswered += 1;
        killer.join().expect("it kills");
        self.servers[server].wait();
        self.source.random = next;
        let is_repeated = self.source.random.random();
        let is_elsewhere = self.source.random.random();
        let repeat = |campaign: &mut Self, server: usize| {
            let answer = campaign.send_to(server, client, unanswered.http_request());
            campaign.acknowledge(&unanswered, answer, None);
            campaign.counts.repeated += 1;
        };
        if is_repeated && is_elsewhere {
            repeat(self, 1 - server);
        }
        self.servers[server] = self.start_server();
        if is_repeated && !is_elsewhere {
            repeat(self, server);
        }
        if !is_repeated {
            self.expected.add_rows(&unanswered, false);
        }
    }

    // A file of a table is lost or damaged, and put back. Ten numbers are all sorts of both tables.
    fn damage_table(&mut self, number: usize) {
        let table = number % TABLES.len();
        let folder = DeltaFolder::new(self.folder.path(), table);
        let DamagedFile { path, bytes, named } = folder.damage_file(number % 5, &mut self.source.random);
        self.place += &format!(", damage {} of {}", number % 5, path.display());
        self.start_servers();
        for (server, client) in READERS {
            self.check_damaged(server, client, table, &named);
        }
        self.check_doctor(3, &named);
        fs::write(&path, bytes).expect("written");
        self.place += ", which is back";
        self.check_everything();
        self.check_doctor(0, "");
    }

    fn check_damaged(&self, server: usize, client: usize, table: usize, named: &str) {
        let place = format!("{}, by {}", self.place, CLIENTS[client].0);
        for whole in ["points", "tnce", "runs", TABLES[1 - table].0] {
            let (status, answer) = self.send_sql(server, client, &format!("select count(*) from {whole}"));
            assert_eq!(status, 200, "{place}: {whole}: {answer}");
        }
        // In this order all rows are read before the first is sent: later, a fault breaks the answer off.
        let (status, answer) = self.select_rows(server, client, table, "order by run_id");
        // A file without rows that the client sees is nothing to it.
        match status == 200 && client != EVE {
            true => self.expected.check_rows(&place, client, table, &answer, usize::MAX),
            false => assert!(status >= 500 && answer.to_string().contains(named), "{place}: {status} {answer}"),
        }
        if client == EVE {
            let (status, answer) = self.send_sql(server, client, "select count(*) from tnce_db");
            assert_eq!(status >= 500, table == ANNOTATIONS, "{place}: tnce_db: {status} {answer}");
        }
    }

    fn check_doctor(&self, code: i32, named: &str) {
        let doctor = self.execute(&["doctor"]);
        let found = String::from_utf8_lossy(&doctor.stdout).into_owned() + &String::from_utf8_lossy(&doctor.stderr);
        assert_eq!(doctor.status.code(), Some(code), "{}: {found}", self.place);
        assert!(found.contains(named), "{}: expected `{named}` in: {found}", self.place);
    }

    // What each client sees by each server, now and as of tags, and what an independent reader sees.
    fn check_everything(&mut self) {
        let older = self.source.random.random_range(0..self.tags.len());
        for table in [ANNOTATIONS, PREDICTIONS] {
            let check = |client: usize, rows: &Value, before: usize| {
                self.expected.check_rows(&self.place, client, table, rows, before);
            };
            check(EVE, &DeltaFolder::new(self.folder.path(), table).read_rows(), usize::MAX);
            for (server, client) in READERS {
                let (status, answer) = self.select_rows(server, client, table, "");
                assert_eq!(status, 200, "{}: {answer}", self.place);
                check(client, &answer, usize::MAX);
                for (tag, rows) in [&self.tags[older], &self.tags[self.tags.len() - 1]] {
                    let (status, answer) = self.select_rows(server, client, table, &format!("timestamp as of '{tag}'"));
                    // A token of a project sees no version after the one that added its newest run.
                    if status == 400 && client != EVE {
                        continue;
                    }
                    assert_eq!(status, 200, "{}: {tag}: {answer}", self.place);
                    check(client, &answer, rows[table]);
                }
            }
        }
    }

    fn store_predictions(&mut self, server: usize, client: usize) {
        let predicted = self.source.draw_predictions(client);
        let sent = self.source.prediction_request(&predicted, &predicted.keys());
        self.store_rows(server, &sent, true);
        self.predicted.push(predicted);
    }

    fn store_rows(&mut self, server: usize, sent: &SentRows, is_new: bool) {
        let answer = self.send_to(server, sent.client, sent.http_request());
        self.acknowledge(sent, answer, Some(is_new));
    }

    fn acknowledge(&mut self, sent: &SentRows, answer: Option<(u16, Value)>, is_new: Option<bool>) {
        let (status, stored) = answer.expect("an answer of a server that runs");
        let place = format!("{}: {} of {}: {stored}", self.place, sent.path, CLIENTS[sent.client].0);
        assert_eq!(status, 200, "{place}");
        let is_stored = stored["is_new"].as_bool().expect("a flag");
        assert_eq!(is_stored, is_new.unwrap_or(is_stored), "{place}");
        self.expected.add_rows(sent, true);
        self.counts.acknowledged += 1;
    }

    fn refuse(&self, server: usize, sent: &SentRows, expected: u16) {
        let answer = self.send_to(server, sent.client, sent.http_request());
        let (status, problem) = answer.expect("an answer of a server that runs");
        assert_eq!(status, expected, "{}: {} of {}: {problem}", self.place, sent.path, CLIENTS[sent.client].0);
    }

    fn select_rows(&self, server: usize, client: usize, table: usize, clause: &str) -> (u16, Value) {
        let (name, columns) = TABLES[table];
        self.send_sql(server, client, &format!("select {} from {name} {clause}", columns.join(", ")))
    }

    fn send_sql(&self, server: usize, client: usize, statement: &str) -> (u16, Value) {
        let request = HttpRequest::post("/api/v1/sql", statement).with("content-type", "text/plain");
        self.send_to(server, client, request).expect("an answer of a server that runs")
    }

    fn send_to(&self, server: usize, client: usize, request: HttpRequest) -> Option<(u16, Value)> {
        send_request(&self.servers[server].http, &self.tokens[client], request)
    }

    fn start_servers(&mut self) {
        self.servers.clear();
        self.servers = vec![self.start_server(), self.start_server()];
    }

    fn start_server(&self) -> ServedLake {
        ServedLake::start(&self.binary, self.folder.path(), &["--tokens", "tokens.toml"])
    }

    fn run(&self, args: &[&str]) -> Output {
        let output = self.execute(args);
        let printed = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{}: {args:?}: {printed}", self.place);
        output
    }

    fn execute(&self, args: &[&str]) -> Output {
        let mut command = Command::new(&self.binary);
        command.args(["--lake", "lake"]).args(args).current_dir(self.folder.path()).env_remove("ECHOLAKE_LAKE");
        run_command(&mut command).expect("the command starts")
    }
}
