//! A server that is killed while a client annotates: what was acknowledged is there afterwards, once.

use std::collections::BTreeMap;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use echolake_testing::{SMALL_RIG, run_command};
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::{Map, Value, json};

use super::serve::http::{HttpRequest, HttpResponse};
use super::serve::server::ServedLake;

/// Most annotations that a server stores before its end begins, and the longest time until then.
const MOST_STORED: usize = 6;
const LONGEST: Duration = Duration::from_millis(30);

/// Counts of a campaign.
#[derive(Debug, Default)]
pub(crate) struct AnnotationKillCounts {
    /// Servers that were killed.
    pub killed: usize,
    /// Annotations that were acknowledged.
    pub acknowledged: usize,
    /// Annotations that were sent again, because no answer came.
    pub repeated: usize,
    /// Of these, those that were stored before.
    pub known: usize,
}

/// A campaign in a folder of its own.
pub(crate) struct AnnotationKillCampaign {
    folder: tempfile::TempDir,
    binary: PathBuf,
    random: ChaCha8Rng,
}

impl AnnotationKillCampaign {
    /// Makes a lake of one run.
    pub fn new(binary: &Path, seed: u64) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("rig.toml"), SMALL_RIG).expect("written");
        let campaign = Self { folder, binary: binary.to_owned(), random: ChaCha8Rng::seed_from_u64(seed) };
        campaign.run(&["acquire", "--surface", "flat", "--rig", "rig.toml", "--ir-only"]);
        campaign.run(&["ingest"]);
        campaign
    }

    /// Kills servers at random moments while a client annotates, and repeats what was not acknowledged.
    ///
    /// # Panics
    /// An acknowledged annotation is missing, or one is there twice.
    pub fn kills(&mut self, kills: usize, told: &mut dyn FnMut(&AnnotationKillCounts)) -> AnnotationKillCounts {
        let rows = self.sql("select run_id from runs");
        let run = rows[0]["run_id"].as_str().expect("a name").to_owned();
        let mut counts = AnnotationKillCounts::default();
        let mut is_repeated = false;
        for _ in 0..kills {
            let mut server = ServedLake::start(&self.binary, self.folder.path(), &[]);
            let last = counts.acknowledged + self.random.random_range(1..=MOST_STORED);
            while counts.acknowledged < last {
                let is_new =
                    annotate(&server.http, &run, counts.acknowledged).expect("an answer of a server that runs");
                counts.known += usize::from(is_repeated && !is_new);
                counts.acknowledged += 1;
                is_repeated = false;
            }
            let moment = LONGEST.mul_f64(self.random.random());
            let pid = Pid::from_raw(server.id() as i32).expect("a process");
            let killer = std::thread::spawn(move || {
                std::thread::sleep(moment);
                kill_process(pid, Signal::KILL).expect("it runs");
            });
            while annotate(&server.http, &run, counts.acknowledged).is_some() {
                counts.acknowledged += 1;
            }
            is_repeated = true;
            counts.repeated += 1;
            killer.join().expect("it kills");
            server.wait();
            counts.killed += 1;
            told(&counts);
        }
        let server = ServedLake::start(&self.binary, self.folder.path(), &[]);
        assert!(annotate(&server.http, &run, counts.acknowledged).is_some());
        counts.acknowledged += 1;
        let mut stored = BTreeMap::<String, usize>::new();
        for row in self.sql("select annotation_id from annotations") {
            *stored.entry(row["annotation_id"].as_str().expect("a name").to_owned()).or_default() += 1;
        }
        let expected: BTreeMap<_, _> = (0..counts.acknowledged).map(|number| (annotation_id(number), 1)).collect();
        assert_eq!(stored, expected, "{counts:?}");
        counts
    }

    fn run(&self, args: &[&str]) -> Vec<u8> {
        let mut command = Command::new(&self.binary);
        command.args(["--lake", "lake"]).args(args).current_dir(self.folder.path()).env_remove("ECHOLAKE_LAKE");
        let output = run_command(&mut command).expect("the command starts");
        assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
        output.stdout
    }

    fn sql(&self, query: &str) -> Vec<Map<String, Value>> {
        serde_json::from_slice(&self.run(&["sql", "--json", query])).expect("JSON")
    }
}

fn annotation_id(number: usize) -> String {
    format!("annotation-{number:05}")
}

// Stores an annotation; returns whether it was new, or None if no answer came.
fn annotate(address: &str, run: &str, number: usize) -> Option<bool> {
    let annotation = json!({
        "annotation_id": annotation_id(number), "run_id": run, "pair_ids": [number % 2], "kind": "verdict",
        "value": if number.is_multiple_of(3) { "accepted" } else { "rejected" }, "comment": format!("number {number}"),
    });
    let body = json!({ "annotations": [annotation], "confirm_rederivation": true }).to_string();
    let request = HttpRequest::post("/api/v1/annotations", &body).with("content-type", "application/json");
    let mut stream = TcpStream::connect(address).ok()?;
    stream.set_read_timeout(Some(Duration::from_secs(60))).expect("a limit");
    stream.write_all(&request.bytes(address)).ok()?;
    let mut bytes = Vec::new();
    // A server that was killed leaves what it had sent.
    let _ = stream.read_to_end(&mut bytes);
    let answer = HttpResponse::read(&bytes).filter(|answer| answer.is_whole)?;
    let text = String::from_utf8_lossy(&answer.body).into_owned();
    let stored = serde_json::from_str::<Value>(&text).ok()?;
    // Its engine may have ended just before.
    if answer.status != 200 {
        assert!(answer.status >= 500, "{text}");
        return None;
    }
    Some(stored["is_new"].as_bool().expect("a flag"))
}
