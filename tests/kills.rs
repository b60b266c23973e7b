//! Ingest killed at random moments: run through once afterwards, its tables equal those of an undisturbed ingest.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use echolake_schema::{Rig, Table};
use echolake_testing::{ChildProcess, SMALL_RIG, run_command};
use rand::seq::SliceRandom as _;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

/// Surfaces of the lake: references and what waits for them, in an order that a run must not depend on.
const SURFACES: [&str; 6] = ["wood", "flat", "prd", "foam", "brick", "wavy"];
/// Returns a query for each table, whose rows are in a comparable order: by key, or by all columns if they may repeat.
pub(crate) fn table_queries() -> impl Iterator<Item = (&'static str, String)> {
    Table::ALL.into_iter().map(|table| {
        let schema = table.schema(&Rig::paper());
        let all = schema.fields().iter().map(|field| field.name().as_str());
        let order = if table.key().is_empty() { all.collect() } else { table.key().to_vec() };
        (table.name(), format!("select * from {} order by {}", table.name(), order.join(", ")))
    })
}

/// Counts of a campaign.
#[derive(Debug, Default)]
pub(crate) struct KillCounts {
    /// Processes that were killed while they worked.
    pub killed: usize,
    /// Processes that ended before their moment came.
    pub ended: usize,
}

/// A campaign in a folder of its own.
pub(crate) struct KillCampaign {
    folder: tempfile::TempDir,
    binary: PathBuf,
    random: ChaCha8Rng,
}

impl KillCampaign {
    /// Measures the runs of the lake that every round begins with.
    pub fn new(binary: &Path, seed: u64) -> Self {
        Self::of(binary, seed, SURFACES.len())
    }

    /// The same with so many runs, of the same surfaces again and again.
    pub fn of(binary: &Path, seed: u64, runs: usize) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("rig.toml"), SMALL_RIG).expect("written");
        let campaign = Self { folder, binary: binary.to_owned(), random: ChaCha8Rng::seed_from_u64(seed) };
        for (number, surface) in SURFACES.iter().cycle().take(runs).enumerate() {
            let seed = number.to_string();
            campaign
                .run("start", &["acquire", "--surface", surface, "--seed", &seed, "--rig", "rig.toml", "--ir-only"]);
        }
        campaign
    }

    /// Kills ingest once to three times in each round, lets it run through, and compares. `told` is called with the
    /// counts after each round.
    ///
    /// # Panics
    /// The tables are not those of an undisturbed ingest; the text names the round.
    pub fn rounds(&mut self, rounds: usize, told: &mut dyn FnMut(usize, &KillCounts)) -> KillCounts {
        let (mut whole, expected) = self.undisturbed();
        let mut outcome = KillCounts::default();
        for round in 0..rounds {
            self.copy("round");
            let kills = self.random.random_range(1..=3);
            for kill in 0..kills {
                let moment = whole.mul_f64(self.random.random());
                let begun = Instant::now();
                if self.is_killed_after(moment) {
                    outcome.killed += 1;
                    continue;
                }
                outcome.ended += 1;
                // The machine was busier when the time was taken. Only the first ingest of a round does all the work.
                if kill == 0 {
                    whole = begun.elapsed();
                }
            }
            self.run("round", &["ingest"]);
            self.is_undisturbed(round, &expected);
            told(round + 1, &outcome);
        }
        outcome
    }

    /// Two processes ingest at once, half of the runs each, in an order of chance; in every second round one of them is
    /// killed at some moment and begins again. Then compares.
    ///
    /// # Panics
    /// As [`Self::rounds`].
    pub fn halves(&mut self, rounds: usize, told: &mut dyn FnMut(usize, &KillCounts)) -> KillCounts {
        let (whole, expected) = self.undisturbed();
        let mut outcome = KillCounts::default();
        for round in 0..rounds {
            self.copy("round");
            let mut runs = self.inbox("round");
            runs.shuffle(&mut self.random);
            let moment = whole.mul_f64(self.random.random());
            let (first, second) = runs.split_at(runs.len() / 2);
            let start = |runs: &[String]| {
                let mut command = self.command("round");
                ChildProcess::start(command.arg("ingest").args(runs)).expect("the command starts")
            };
            let (mut one, other) = (start(first), start(second));
            if round % 2 == 1 {
                match one.ends_within(moment) {
                    true => outcome.ended += 1,
                    false => outcome.killed += 1,
                }
                one.kill();
                // What it had taken in is not in the inbox any more.
                one = start(&[]);
            }
            for mut process in [one, other] {
                let output = process.wait();
                assert!(output.status.success(), "round {round}: {}", String::from_utf8_lossy(&output.stderr));
            }
            self.run("round", &["ingest"]);
            self.is_undisturbed(round, &expected);
            told(round + 1, &outcome);
        }
        outcome
    }

    // Returns the time of an ingest that is not disturbed, and its tables.
    fn undisturbed(&self) -> (Duration, BTreeMap<&'static str, Vec<u8>>) {
        self.copy("undisturbed");
        let begun = Instant::now();
        self.run("undisturbed", &["ingest"]);
        (begun.elapsed(), self.tables("undisturbed"))
    }

    fn is_undisturbed(&self, round: usize, expected: &BTreeMap<&'static str, Vec<u8>>) {
        let actual = self.tables("round");
        for (table, rows) in expected {
            assert!(actual[table] == *rows, "round {round}: table {table} differs from that of an undisturbed ingest");
        }
    }

    fn inbox(&self, lake: &str) -> Vec<String> {
        let folder = self.folder.path().join(lake).join("inbox");
        let files = std::fs::read_dir(folder).expect("the inbox").map(|e| e.expect("an entry").path());
        let mut names: Vec<_> = files.map(|p| p.display().to_string()).collect();
        names.sort();
        names
    }

    fn command(&self, lake: &str) -> Command {
        let mut command = Command::new(&self.binary);
        command.args(["--lake", lake]).current_dir(self.folder.path()).env_remove("ECHOLAKE_LAKE");
        command
    }

    fn run(&self, lake: &str, args: &[&str]) -> Vec<u8> {
        let output = run_command(self.command(lake).args(args)).expect("the command starts");
        assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
        output.stdout
    }

    // False if the ingest ended before its moment came.
    fn is_killed_after(&self, moment: Duration) -> bool {
        let mut ingest = ChildProcess::start(self.command("round").arg("ingest")).expect("the command starts");
        let has_ended = ingest.ends_within(moment);
        ingest.kill();
        !has_ended
    }

    fn tables(&self, lake: &str) -> BTreeMap<&'static str, Vec<u8>> {
        table_queries().map(|(table, query)| (table, self.run(lake, &["sql", "--format", "csv", &query]))).collect()
    }

    fn copy(&self, lake: &str) {
        let to = self.folder.path().join(lake);
        // The first round finds none.
        let _ = std::fs::remove_dir_all(&to);
        copy_folder(&self.folder.path().join("start"), &to);
    }
}

pub(crate) fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).expect("made");
    for entry in std::fs::read_dir(from).expect("listed") {
        let entry = entry.expect("an entry");
        let target = to.join(entry.file_name());
        if entry.file_type().expect("its kind").is_dir() {
            copy_folder(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).expect("copied");
        }
    }
}
