//! `acquire` killed at random moments, with or without the power, recovered and resumed: nothing that was acknowledged
//! is lost, nothing is there twice, and the run is whole in the end.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use echolake_schema::messages::{Measurement, Verdict};
use echolake_testing::{ChildProcess, SMALL_RIG, run_command};
use prost::Message as _;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::forgetful::{DiskMount, ForgetfulDisk};

/// Pairs of the small rig.
pub(crate) const PAIRS: usize = 45;
/// Seconds of a take: kills then come at all moments of a run, not only while it begins.
const PACE: &str = "0.008";

/// A run that is never killed within so many tries shows that the moments are wrong.
const RUNS_PER_KILL: usize = 50;

/// Counts of a campaign.
#[derive(Debug, Default)]
pub(crate) struct AcquireKillCounts {
    /// Processes that were killed while they worked.
    pub killed: usize,
    /// Of these, before there was a recording.
    pub before_the_file: usize,
    /// Runs that were brought to their end.
    pub runs: usize,
    /// Attempts that were acknowledged, in all runs.
    pub acknowledged: usize,
}

/// A campaign in a folder of its own.
pub(crate) struct AcquireKillCampaign {
    folder: tempfile::TempDir,
    binary: PathBuf,
    random: ChaCha8Rng,
    /// The lake's disk, if the power is cut, too.
    disk: Option<(ForgetfulDisk, Option<DiskMount>)>,
}

/// A verdict's pair, attempt and name.
type VerdictKey = (u32, u32, String);

impl AcquireKillCampaign {
    pub fn new(binary: &Path, seed: u64) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("rig.toml"), SMALL_RIG).expect("written");
        std::fs::create_dir(folder.path().join("disk")).expect("made");
        Self { folder, binary: binary.to_owned(), random: ChaCha8Rng::seed_from_u64(seed), disk: None }
    }

    /// With a disk that forgets at each kill what was not synced; nothing if this machine cannot mount one.
    pub fn with_power_cuts(binary: &Path, seed: u64) -> Option<Self> {
        let mut campaign = Self::new(binary, seed);
        let disk = ForgetfulDisk::new();
        let mounted = disk.mount(&campaign.folder.path().join("disk"))?;
        campaign.disk = Some((disk, Some(mounted)));
        Some(campaign)
    }

    // Unmounted, so that nothing of it is in the kernel's memory.
    fn cut_the_power(&mut self) {
        if let Some((disk, mounted)) = &mut self.disk {
            drop(mounted.take());
            disk.cut(&mut self.random);
            *mounted = disk.mount(&self.folder.path().join("disk"));
            assert!(mounted.is_some(), "it was mounted before");
        }
    }

    /// Kills `acquire` so many times; run after run is begun, and each is brought to its end. `told` is called with the
    /// counts after each run.
    ///
    /// # Panics
    /// A measurement is lost or doubled; the text names it.
    pub fn kills(&mut self, kills: usize, told: &mut dyn FnMut(&AcquireKillCounts)) -> AcquireKillCounts {
        let mut whole = self.undisturbed();
        let mut outcome = AcquireKillCounts::default();
        while outcome.killed < kills {
            self.run_through(&mut whole, kills, &mut outcome);
            outcome.runs += 1;
            assert!(outcome.runs <= RUNS_PER_KILL * kills, "runs end before they are killed: {outcome:?}");
            told(&outcome);
        }
        outcome
    }

    // Returns the time of a run that is not killed.
    fn undisturbed(&mut self) -> Duration {
        let begun = Instant::now();
        let output = run_command(&mut self.acquire(None)).expect("it starts");
        let whole = begun.elapsed();
        assert!(output.status.success(), "{}", text(&output.stderr));
        self.check_the_run();
        whole
    }

    fn run_through(&mut self, whole: &mut Duration, kills: usize, outcome: &mut AcquireKillCounts) {
        loop {
            let partial = self.inbox().into_iter().find(|p| p.extension().is_some_and(|e| e == "partial"));
            let begun = Instant::now();
            let mut child = ChildProcess::start(&mut self.acquire(partial.as_deref())).expect("it starts");
            let moment = whole.mul_f64(self.random.random_range(0.0..0.8));
            if outcome.killed >= kills || child.ends_within(moment) {
                // A fresh run that ends early: the machine was busier when the time was taken.
                if outcome.killed < kills && partial.is_none() {
                    *whole = begun.elapsed();
                }
                let output = child.wait();
                assert!(output.status.success(), "{}", text(&output.stderr));
                break;
            }
            child.kill();
            outcome.killed += 1;
            self.cut_the_power();
            outcome.before_the_file += usize::from(!self.check_the_remains());
            if self.inbox().iter().any(|p| p.extension().is_some_and(|e| e == "mcap")) {
                // It died between the file's name and its own end.
                break;
            }
        }
        outcome.acknowledged += self.check_the_run();
    }

    fn acquire(&self, partial: Option<&Path>) -> Command {
        let mut command = self.command();
        command.args(["acquire", "--acknowledge", "acknowledged.txt", "--checkpoint-every", "1", "--pace", PACE]);
        match partial {
            Some(partial) => command.arg("--resume").arg(partial),
            None => command.args(["--surface", "flat", "--rig", "rig.toml"]),
        };
        command
    }

    // What was acknowledged is in what recover makes of the file. Whether there is a file.
    fn check_the_remains(&self) -> bool {
        let Some(partial) = self.inbox().into_iter().find(|p| p.extension().is_some_and(|e| e == "partial")) else {
            let is_whole = self.inbox().iter().any(|p| p.extension().is_some_and(|e| e == "mcap"));
            assert!(is_whole || self.acknowledged().is_empty(), "a file with acknowledged measurements is gone");
            return is_whole;
        };
        let before = std::fs::read(&partial).expect("read");
        let out = self.folder.path().join("recovered.mcap");
        let _ = std::fs::remove_file(&out);
        let output = run_command(self.command().arg("recover").arg(&partial).arg("-o").arg(&out)).expect("it starts");
        assert!(before == std::fs::read(&partial).expect("read"), "the original is as it was");
        match output.status.code() {
            Some(0 | 3) => {
                let read = verdicts(&out);
                for key in self.acknowledged() {
                    assert_eq!(read.get(&key), Some(&1), "{key:?} was acknowledged: {}", text(&output.stderr));
                }
                true
            }
            // Killed while the head was written: nothing was measured, and the next one starts again.
            Some(1) if text(&output.stderr).contains("holds no run") => {
                assert!(self.acknowledged().is_empty(), "{}", text(&output.stderr));
                std::fs::remove_file(&partial).expect("removed");
                false
            }
            code => panic!("recover ended with {code:?}: {}", text(&output.stderr)),
        }
    }

    // The whole run has every pair once, and all that was acknowledged once; its rows are those. How many were
    // acknowledged. The folder is empty afterwards.
    fn check_the_run(&self) -> usize {
        let inbox = self.inbox();
        let [run] = &inbox[..] else { panic!("one run and nothing else, but there is {inbox:?}") };
        let (read, acknowledged) = (verdicts(run), self.acknowledged());
        for (key, times) in &read {
            assert_eq!(*times, 1, "{key:?} is there {times} times");
        }
        for key in &acknowledged {
            assert!(read.contains_key(key), "{key:?} was acknowledged and is lost");
        }
        let mut accepted: Vec<_> =
            read.keys().filter(|(.., v)| v == "accepted").map(|(pair, ..)| *pair as usize).collect();
        accepted.sort_unstable();
        assert_eq!(accepted, (0..PAIRS).collect::<Vec<_>>(), "every pair is accepted once");
        self.ok(&["ingest"]);
        let count = text(
            &self.ok(&["sql", "--format", "csv", "select count(*), count(distinct pair_id) from measurements"]).stdout,
        );
        assert!(count.contains(&format!("{PAIRS},{PAIRS}")), "{count}");
        let state = text(&self.ok(&["sql", "--format", "csv", "select damaged from runs"]).stdout);
        assert!(state.lines().last().is_some_and(|n| n.trim() == "0"), "{state}");
        let report: serde_json::Value = serde_json::from_slice(&self.ok(&["doctor", "--json"]).stdout).expect("JSON");
        let damaged = report["findings"].as_array().into_iter().flatten().filter(|f| f["severity"] == "damaged");
        assert_eq!(damaged.count(), 0, "{report}");
        std::fs::remove_dir_all(self.folder.path().join("disk/lake")).expect("removed");
        let _ = std::fs::remove_file(self.folder.path().join("acknowledged.txt"));
        acknowledged.len()
    }

    // The last line may have been cut off with its process.
    fn acknowledged(&self) -> Vec<VerdictKey> {
        let list = std::fs::read_to_string(self.folder.path().join("acknowledged.txt")).unwrap_or_default();
        let lines = list.split_inclusive('\n').filter(|line| line.ends_with('\n'));
        let key = |line: &str| {
            let mut words = line.split_whitespace();
            let mut number = || words.next().and_then(|w| w.parse().ok()).expect("a number");
            let (pair, attempt) = (number(), number());
            (pair, attempt, words.next().expect("a verdict").to_owned())
        };
        lines.map(key).collect()
    }

    fn inbox(&self) -> Vec<PathBuf> {
        let entries = std::fs::read_dir(self.folder.path().join("disk/lake/inbox"));
        // A file that a killed resume left incomplete is written again by the next one.
        let is_left = |p: &PathBuf| p.extension().is_none_or(|e| e != "resuming");
        entries.into_iter().flatten().map(|e| e.expect("an entry").path()).filter(is_left).collect()
    }

    fn command(&self) -> Command {
        let mut command = Command::new(&self.binary);
        command.args(["--lake", "disk/lake"]).current_dir(self.folder.path()).env_remove("ECHOLAKE_LAKE");
        command
    }

    fn ok(&self, args: &[&str]) -> Output {
        let output = run_command(self.command().args(args)).expect("it starts");
        assert!(output.status.success(), "{args:?}: {}", text(&output.stderr));
        output
    }
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Counts each verdict of a file; each has its response and its sweep before it.
fn verdicts(path: &Path) -> BTreeMap<VerdictKey, usize> {
    let file = std::fs::read(path).expect("read");
    let (mut found, mut behind) = (BTreeMap::new(), BTreeMap::new());
    for message in mcap::MessageStream::new(&file).expect("an MCAP file") {
        let message = message.expect("whole");
        if message.channel.topic == "/measurement" {
            let m = Measurement::decode(&message.data[..]).expect("a verdict");
            let name = match m.verdict() {
                Verdict::Accepted => "accepted",
                Verdict::Repeated => "repeated",
                _ => "rejected",
            };
            let rests_on: usize = behind.get(&message.log_time).copied().unwrap_or(0);
            assert_eq!(rests_on, 2, "pair {} has its sweep and its response once", m.pair_id);
            *found.entry((m.pair_id, m.attempt, name.to_owned())).or_default() += 1;
        } else if matches!(message.channel.topic.as_str(), "/sweep" | "/ir") {
            *behind.entry(message.log_time).or_default() += 1;
        }
    }
    found
}
