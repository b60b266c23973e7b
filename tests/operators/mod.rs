//! What people do to a lake, in random sequences: after each action an independent reader compares what was
//! acknowledged with answers. An answer is whole, or its command fails and names what is missing.

mod actions;
mod reader;

use std::collections::{BTreeMap, BTreeSet};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use echolake_schema::{Rig, Table};
use echolake_testing::{ChildProcess, SMALL_RIG, run_command};
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use self::actions::{ActionNeed, OPERATOR_ACTIONS};
use self::reader::{MEASUREMENTS_QUERY, RowsByRun, read_measurements, rows_by_run};
use super::kills::{copy_folder, table_queries};
use super::serve::http::HttpRequest;
use super::serve::server::ServedLake;

/// Surfaces of the lake. The first two are references: all rounds begin with their runs in the tables.
const SURFACES: [&str; 5] = ["flat", "foam", "prd", "wood", "wavy"];
/// Runs that each round begins with.
const FIRST_RUNS: usize = 2;
/// The surface whose recording is cut off and resumed.
const RESUMED_SURFACE: &str = "brick";
/// Time after which a command on a lake of six runs hangs.
const HANG_LIMIT: Duration = Duration::from_secs(60);
/// Times that hints are followed at the end of a round.
const REPAIR_TRIES: usize = 4;

/// A run file that was made once.
struct SourceRun {
    run: String,
    surface: &'static str,
    file: PathBuf,
    /// What its measurements must give.
    measurements: Vec<String>,
}

/// A campaign in a folder of its own.
pub(crate) struct OperatorCampaign {
    folder: PathBuf,
    binary: PathBuf,
    seed: u64,
    runs: Vec<SourceRun>,
    resumed: SourceRun,
    /// All tables of an undisturbed ingest of all runs.
    undisturbed: BTreeMap<&'static str, String>,
    /// Rows of each run in each of its tables.
    row_counts: BTreeMap<&'static str, RowsByRun>,
    /// The command's verbs.
    verbs: BTreeSet<String>,
    /// A Python that has deltalake.
    python: Option<PathBuf>,
    has_small_disks: bool,
    has_faketime: bool,
}

/// A round that failed.
pub(crate) struct RoundFailure {
    pub seed: u64,
    pub actions: Vec<String>,
    /// The first answer that was wrong.
    pub answer: String,
    pub folder: PathBuf,
}

/// A round: a lake, and what is known of it.
struct OperatorRound<'a> {
    campaign: &'a OperatorCampaign,
    folder: PathBuf,
    /// The lake's path below `folder`.
    lake: &'static str,
    random: ChaCha8Rng,
    /// Rows of `measurements` of each run that was acknowledged.
    acknowledged: RowsByRun,
    /// What was moved away: its place, and where it is.
    away: Vec<(PathBuf, PathBuf)>,
    /// Runs whose files are not in `runs/` as they were.
    lost_files: BTreeSet<String>,
    /// Whether tables were disturbed: rows may be missing until they are derived from the run files.
    lost_tables: bool,
    /// Entries that no program made.
    strange: Vec<PathBuf>,
    server: Option<ServedLake>,
    actions: Vec<String>,
}

/// How a command ended.
struct CommandEnd {
    code: Option<i32>,
    stdout: String,
    stderr: String,
}

impl OperatorCampaign {
    /// Measures the runs, and looks for what its actions need; `python` has the package deltalake.
    pub fn new(binary: &Path, seed: u64, python: Option<PathBuf>) -> Self {
        let folder = tempfile::tempdir().expect("a folder").keep();
        std::fs::write(folder.join("rig.toml"), SMALL_RIG).expect("written");
        let mut campaign = Self {
            binary: binary.to_owned(),
            seed,
            runs: Vec::new(),
            resumed: SourceRun {
                run: String::new(),
                surface: RESUMED_SURFACE,
                file: PathBuf::new(),
                measurements: Vec::new(),
            },
            undisturbed: BTreeMap::new(),
            row_counts: BTreeMap::new(),
            verbs: BTreeSet::new(),
            python,
            has_small_disks: false,
            has_faketime: succeeds(Command::new("faketime").args(["-f", "-1d", "true"])),
            folder,
        };
        campaign.prepare();
        campaign
    }

    fn prepare(&mut self) {
        let disk = self.folder.join("disk");
        self.has_small_disks = mount_disk(&disk, "1m") && succeeds(Command::new("umount").arg(&disk));
        if !self.has_small_disks {
            eprintln!("SKIPPED full disks: no file system can be mounted here");
        }
        let help = self.ok("start", &["help"]);
        self.verbs =
            help.lines().filter_map(|line| line.strip_prefix("  ")?.split(' ').next()).map(str::to_owned).collect();
        for (number, surface) in SURFACES.into_iter().enumerate() {
            let run = self.measure("start", surface, number);
            self.runs.push(run);
        }
        self.resumed = self.measure("resumed", RESUMED_SURFACE, SURFACES.len());
        copy_folder(&self.folder.join("start"), &self.folder.join("undisturbed"));
        self.ok("undisturbed", &["ingest"]);
        self.undisturbed = self.read_tables("undisturbed").expect("tables");
        for table in Table::ALL {
            if has_runs(table) {
                let counts = self.ok("undisturbed", &["sql", "--format", "csv", &count_query(table.name())]);
                self.row_counts.insert(table.name(), rows_by_run(&counts));
            }
        }
        let start = self.folder.join("start");
        for source in &mut self.runs {
            let inbox = source.file.clone();
            source.file = self.folder.join(inbox.file_name().expect("a name"));
            std::fs::rename(&inbox, &source.file).expect("moved");
        }
        for source in &self.runs[..FIRST_RUNS] {
            std::fs::copy(&source.file, start.join("inbox").join(source.file_name())).expect("copied");
        }
        self.ok("start", &["ingest"]);
    }

    fn measure(&self, lake: &str, surface: &'static str, seed: usize) -> SourceRun {
        let seed = seed.to_string();
        let out = self.ok(
            lake,
            &[
                "acquire",
                "--surface",
                surface,
                "--seed",
                &seed,
                "--rig",
                "rig.toml",
                "--ir-only",
                "--checkpoint-every",
                "5",
            ],
        );
        let file = self.folder.join(out.trim());
        let run = file.file_stem().expect("a name").to_string_lossy().into_owned();
        let measurements = read_measurements(&file);
        SourceRun { run, surface, file, measurements }
    }

    /// Runs rounds, each of a seed of its own; `told` is called after each with its seed and failure.
    pub fn rounds(&self, rounds: u64, told: &mut dyn FnMut(u64, Option<&RoundFailure>)) -> Vec<RoundFailure> {
        let mut failures = Vec::new();
        for number in 0..rounds {
            let seed = self.seed.wrapping_add(number);
            let failure = self.run_round(seed);
            told(seed, failure.as_ref());
            failures.extend(failure);
        }
        if failures.is_empty() {
            // A temporary folder that stays is not worth an error.
            let _ = std::fs::remove_dir_all(&self.folder);
        }
        failures
    }

    fn run_round(&self, seed: u64) -> Option<RoundFailure> {
        let folder = self.folder.join(format!("round-{seed}"));
        copy_folder(&self.folder.join("start"), &folder.join("lake"));
        std::fs::create_dir(folder.join("away")).expect("made");
        std::fs::copy(self.folder.join("rig.toml"), folder.join("rig.toml")).expect("copied");
        let mut round = OperatorRound {
            campaign: self,
            lake: "lake",
            random: ChaCha8Rng::seed_from_u64(seed),
            acknowledged: RowsByRun::new(),
            away: Vec::new(),
            lost_files: BTreeSet::new(),
            lost_tables: false,
            strange: Vec::new(),
            server: None,
            actions: Vec::new(),
            folder: folder.clone(),
        };
        for source in &self.runs[..FIRST_RUNS] {
            round.acknowledged.insert(source.run.clone(), source.measurements.clone());
        }
        let outcome = catch_unwind(AssertUnwindSafe(|| round.run())).unwrap_or_else(|panic| {
            let text = panic.downcast_ref::<String>().cloned();
            Err(text.or_else(|| panic.downcast_ref::<&str>().map(|t| (*t).to_owned())).unwrap_or_default())
        });
        drop(round.server.take());
        let _ = run_command(Command::new("umount").arg(folder.join("full")));
        let actions = std::mem::take(&mut round.actions);
        match outcome {
            Ok(()) => {
                let _ = std::fs::remove_dir_all(&folder);
                None
            }
            Err(answer) => Some(RoundFailure { seed, actions, answer, folder }),
        }
    }

    fn command(&self, lake: &str) -> Command {
        let mut command = Command::new(&self.binary);
        command.args(["--lake", lake]).current_dir(&self.folder).env_remove("ECHOLAKE_LAKE");
        command
    }

    fn ok(&self, lake: &str, args: &[&str]) -> String {
        let end = run_to_end(self.command(lake).args(args)).expect("it ends");
        assert_eq!(end.code, Some(0), "{args:?}: {}", end.stderr);
        end.stdout
    }

    fn read_tables(&self, lake: &str) -> Result<BTreeMap<&'static str, String>, String> {
        let mut tables = BTreeMap::new();
        for (table, query) in table_queries() {
            let end = run_to_end(self.command(lake).args(["sql", "--format", "csv", &query]))?;
            if end.code != Some(0) {
                return Err(format!("table {table} cannot be read after the repair: {}", end.stderr));
            }
            tables.insert(table, end.stdout);
        }
        Ok(tables)
    }

    fn has_need(&self, need: ActionNeed) -> bool {
        match need {
            ActionNeed::Nothing => true,
            ActionNeed::Verb(verb) => self.verbs.contains(verb),
            ActionNeed::DeltaLake => self.python.is_some(),
            ActionNeed::SmallDisk => self.has_small_disks,
        }
    }
}

impl std::fmt::Display for RoundFailure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { seed, actions, answer, folder } = self;
        write!(f, "seed {seed} failed: {answer}\n  {}\n  its folder: {}", actions.join("\n  "), folder.display())
    }
}

impl SourceRun {
    fn file_name(&self) -> String {
        format!("{}.mcap", self.run)
    }
}

impl OperatorRound<'_> {
    fn run(&mut self) -> Result<(), String> {
        if self.random.random_bool(0.25) {
            self.note("serve".to_owned());
            self.server = Some(ServedLake::start(&self.campaign.binary, &self.folder, &[]));
        }
        for _ in 0..self.random.random_range(2..=5) {
            let possible: Vec<_> =
                OPERATOR_ACTIONS.iter().filter(|action| self.campaign.has_need(action.need)).collect();
            let action = possible[self.random.random_range(0..possible.len())];
            self.note(action.name.to_owned());
            (action.run)(self)?;
            self.check_answers()?;
        }
        self.repair()
    }

    fn note(&mut self, what: String) {
        self.actions.push(what);
    }

    fn path(&self, below: &str) -> PathBuf {
        self.folder.join(self.lake).join(below)
    }

    fn command(&self, args: &[&str]) -> Command {
        let mut command = self.campaign.command(self.lake);
        command.args(args).current_dir(&self.folder);
        command
    }

    /// Runs a command of echolake to its end.
    fn echolake(&mut self, args: &[&str]) -> Result<CommandEnd, String> {
        let end = run_to_end(&mut self.command(args))?;
        self.note(format!("  echolake {}: {:?} {}", args.join(" "), end.code, end.stderr.trim().replace('\n', " | ")));
        Ok(end)
    }

    fn ingest(&mut self) -> Result<CommandEnd, String> {
        let end = self.echolake(&["ingest"])?;
        self.acknowledge(&end)?;
        Ok(end)
    }

    /// Notes which runs an ingest acknowledged: those that it named as ingested, if it ended.
    fn acknowledge(&mut self, end: &CommandEnd) -> Result<(), String> {
        let sources = self.campaign.runs.iter().chain([&self.campaign.resumed]);
        for source in sources {
            let Some(line) = end.stderr.lines().find_map(|line| line.strip_prefix(&format!("{}: ", source.run))) else {
                continue;
            };
            let is_known = line.starts_with("is in the lake already");
            let count = line.strip_suffix(" measurements").and_then(|count| count.parse::<usize>().ok());
            let is_whole = is_known || count == Some(source.measurements.len());
            if end.code == Some(0) && !is_whole && count.is_some() {
                return Err(format!("ingest exited with 0 and took a part of a run: {}: {line}", source.run));
            }
            // A run that is resumed is acknowledged by its action, which reads the file.
            if matches!(end.code, Some(0 | 3)) && is_whole && source.surface != RESUMED_SURFACE {
                self.acknowledged.insert(source.run.clone(), source.measurements.clone());
            } else if matches!(end.code, Some(1 | 3)) && self.lost_tables && self.lost_files.contains(&source.run) {
                // A command said that it is not there, and the only other witness was destroyed.
                self.acknowledged.remove(&source.run);
            }
        }
        Ok(())
    }

    /// Asks for what was acknowledged.
    fn check_answers(&mut self) -> Result<(), String> {
        let others: Vec<_> = self.campaign.row_counts.keys().copied().collect();
        let other = others[self.random.random_range(0..others.len())];
        let queries = [
            ("measurements", MEASUREMENTS_QUERY.to_owned()),
            ("tnce", "select run_id, pair_id from tnce".to_owned()),
            ("runs", "select run_id, measurements from runs".to_owned()),
            (other, count_query(other)),
        ];
        let lake = format!("`{}", self.lake);
        for (number, (table, query)) in queries.iter().enumerate() {
            let is_count = number == 3;
            let end = run_to_end(&mut self.command(&["sql", "--format", "csv", query]))?;
            match end.code {
                Some(0) => self.judge(table, is_count, &end.stdout).map_err(|e| format!("`sql` exited with 0: {e}"))?,
                _ if [table, "tables", "table `", &lake].iter().any(|name| end.stderr.contains(name)) => {}
                code => return Err(format!("`sql {query}` ended with {code:?} and names nothing: {}", end.stderr)),
            }
            let Some(server) = self.server.as_mut().filter(|_| self.lake == "lake") else { continue };
            if !server.is_up() {
                return Err(format!("`serve` ended: {:?}", server.said()));
            }
            let request = HttpRequest::post("/api/v1/sql?format=csv", query).with("content-type", "text/plain");
            if let Some(answer) = request.attempt(server).filter(|answer| answer.status == 200 && answer.is_whole) {
                self.judge(table, is_count, &answer.text()).map_err(|e| format!("`serve` answered 200: {e}"))?;
            }
        }
        Ok(())
    }

    fn judge(&self, table: &str, is_count: bool, csv: &str) -> Result<(), String> {
        let actual = rows_by_run(csv);
        for (run, measurements) in &self.acknowledged {
            let expected = match (is_count, table) {
                (true, _) => match self.campaign.row_counts[table].get(run) {
                    Some(counts) => counts.clone(),
                    // A run that was resumed has no undisturbed twin.
                    None => continue,
                },
                (false, "measurements") => measurements.clone(),
                (false, "tnce") => {
                    let mut pairs: Vec<_> =
                        measurements.iter().filter_map(|row| row.split(',').next()).map(str::to_owned).collect();
                    pairs.sort();
                    pairs
                }
                _ => vec![measurements.len().to_string()],
            };
            let rows = actual.get(run).cloned().unwrap_or_default();
            if rows != expected {
                let first = expected.iter().find(|row| !rows.contains(row)).or_else(|| rows.first());
                return Err(format!(
                    "table {table}, run {run}: {} rows, expected {}; the first that differs: {first:?}",
                    rows.len(),
                    expected.len()
                ));
            }
        }
        Ok(())
    }

    /// Does what the program's hints say at most, after which everything must be there.
    fn repair(&mut self) -> Result<(), String> {
        self.note("repair".to_owned());
        self.put_back();
        let mut said = String::new();
        for attempt in 0..REPAIR_TRIES {
            let missing: Vec<_> =
                self.campaign.runs.iter().filter(|source| !self.acknowledged.contains_key(&source.run)).collect();
            for source in missing {
                let _ = std::fs::remove_file(self.path("inbox").join(format!("{}.partial", source.file_name())));
                std::fs::copy(&source.file, self.path("inbox").join(source.file_name())).expect("copied");
            }
            let ingested = self.ingest()?;
            // Files that were refused are copies that this round made.
            let _ = std::fs::remove_dir_all(self.path("quarantine"));
            for source in &self.campaign.runs {
                // A run that a recovered recording became makes way for the whole file.
                let hint = format!("echolake remove {}", source.run);
                if self.campaign.verbs.contains("remove") && ingested.stderr.contains(&hint) {
                    self.echolake(&["remove", &source.run])?;
                    self.acknowledged.remove(&source.run);
                }
            }
            let mut doctor = self.echolake(&["doctor"])?;
            if doctor.code != Some(0) && attempt > 0 && self.campaign.verbs.contains("rebuild") {
                self.echolake(&["rebuild"])?;
                doctor = self.echolake(&["doctor"])?;
            }
            let is_there = self.campaign.runs.iter().all(|source| self.acknowledged.contains_key(&source.run));
            if doctor.code == Some(0) && is_there {
                return self.check_all();
            }
            said = format!("ingest: {}\ndoctor {:?}: {}{}", ingested.stderr, doctor.code, doctor.stdout, doctor.stderr);
        }
        Err(format!("not repaired by what hints say: {said}"))
    }

    // Tables are those of an undisturbed ingest, but for the run that was resumed.
    fn check_all(&mut self) -> Result<(), String> {
        self.check_answers()?;
        for (table, query) in table_queries() {
            let end = run_to_end(&mut self.command(&["sql", "--format", "csv", &query]))?;
            if end.code != Some(0) {
                return Err(format!("doctor exited with 0, but table {table} cannot be read: {}", end.stderr));
            }
            let resumed = &self.campaign.resumed.run;
            let actual: Vec<_> = end.stdout.lines().filter(|line| !line.contains(resumed)).collect();
            let expected: Vec<_> = self.campaign.undisturbed[table].lines().collect();
            if actual != expected {
                let differs = actual.iter().zip(&expected).position(|(a, e)| a != e);
                let place = differs.map(|at| format!("line {at}: {:.300} / {:.300}", actual[at], expected[at]));
                return Err(format!(
                    "doctor exited with 0, but table {table} has {} lines, expected {}; {place:?}",
                    actual.len(),
                    expected.len()
                ));
            }
        }
        Ok(())
    }

    /// Puts back what this round took away, and removes what it added.
    fn put_back(&mut self) {
        for (place, at) in std::mem::take(&mut self.away).into_iter().rev() {
            if !place.exists() && at.exists() {
                std::fs::create_dir_all(place.parent().expect("a folder")).expect("made");
                std::fs::rename(at, place).expect("moved");
            }
        }
        for run in std::mem::take(&mut self.lost_files) {
            let source = self.campaign.runs.iter().find(|source| source.run == run).expect("known");
            let place = self.path("runs").join(source.surface);
            std::fs::create_dir_all(&place).expect("made");
            std::fs::copy(&source.file, place.join(source.file_name())).expect("copied");
        }
        for entry in std::mem::take(&mut self.strange) {
            let removed = std::fs::remove_file(&entry);
            // It may have been moved, as into `quarantine/`.
            let _ = removed.or_else(|_| std::fs::remove_dir_all(&entry));
        }
    }
}

/// Runs a program to its end.
///
/// # Errors
/// It hangs or panics.
fn run_to_end(command: &mut Command) -> Result<CommandEnd, String> {
    let mut child = ChildProcess::start(command).map_err(|e| format!("{command:?}: {e}"))?;
    finish(&mut child, &format!("{command:?}"))
}

fn finish(child: &mut ChildProcess, name: &str) -> Result<CommandEnd, String> {
    if !child.ends_within(HANG_LIMIT) {
        child.kill();
        return Err(format!("{name} hangs: {}", child.stderr()));
    }
    let output = child.wait();
    let [stdout, stderr] = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    if stderr.contains("panicked") {
        return Err(format!("{name} panicked: {stderr}"));
    }
    Ok(CommandEnd { code: output.status.code(), stdout, stderr })
}

fn succeeds(command: &mut Command) -> bool {
    run_command(command).is_ok_and(|output| output.status.success())
}

fn mount_disk(at: &Path, size: &str) -> bool {
    let size = format!("size={size}");
    std::fs::create_dir_all(at).is_ok()
        && succeeds(Command::new("mount").args(["-t", "tmpfs", "-o", &size, "none"]).arg(at))
}

fn has_runs(table: Table) -> bool {
    table.schema(&Rig::paper()).fields().iter().any(|field| field.name() == "run_id")
}

fn count_query(table: &str) -> String {
    format!("select run_id, count(*) from {table} group by run_id")
}
