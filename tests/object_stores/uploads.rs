//! `upload`: closed runs go to a bucket, whatever cuts them off, and several ingests share what is there.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use echolake_schema::manifest::{Origin, RunManifest};
use echolake_schema::{Rig, Timestamp, topics};
use echolake_testing::{COMMAND_LIMIT, ChildProcess};
use rand::{RngCore as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{ECHOLAKE, S3Double, StoreBehaviour, TestFolder, command, ok, recordings, run, stderr};

/// Run of the large file.
const LARGE_RUN: &str = "20260105T080000Z-flat-7c1e";
/// Bytes of its attachment.
const LARGE_BYTES: usize = 100_000_000;
/// Parts that it goes up in: each of 8 MiB.
const LARGE_PARTS: usize = 12;
/// Number of times that its upload is cut off.
const CUTS: usize = 10;

fn key(name: &str) -> String {
    format!("a/lake/{name}")
}

fn wait_until(what: &str, condition: impl Fn() -> bool) {
    let end = Instant::now() + COMMAND_LIMIT;
    while !condition() {
        assert!(Instant::now() < end, "never: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// A closed file that begins as a run, with an attachment of random bytes.
fn write_large_run(path: &Path) {
    let rig = Rig::from_toml(super::super::SMALL_RIG).expect("a rig");
    let manifest = RunManifest {
        run_id: LARGE_RUN.parse().expect("an id"),
        surface_id: "flat".parse().expect("an id"),
        started: Timestamp::parse("2026-01-05T08:00:00Z").expect("a time"),
        software: "a test".to_owned(),
        rig: rig.name.clone(),
        origin: Origin::Simulated,
    };
    let mut bytes = vec![0; LARGE_BYTES];
    ChaCha8Rng::seed_from_u64(1).fill_bytes(&mut bytes);
    let file = std::fs::File::create(path).expect("made");
    let mut writer = mcap::Writer::new(std::io::BufWriter::new(file)).expect("a file");
    let record = mcap::records::Metadata { name: topics::RUN_METADATA.to_owned(), metadata: manifest.to_metadata() };
    writer.write_metadata(&record).expect("written");
    let rig = rig.to_toml().into_bytes();
    for (name, data) in [(topics::RIG_ATTACHMENT, rig), ("noise", bytes)] {
        let attachment = mcap::Attachment {
            log_time: 0,
            create_time: 0,
            name: name.to_owned(),
            media_type: "application/octet-stream".to_owned(),
            data: data.into(),
        };
        writer.attach(&attachment).expect("written");
    }
    writer.finish().expect("closed");
}

#[test]
fn what_is_not_closed_and_what_is_another_file_is_refused_and_the_rest_goes_up() {
    let place = TestFolder::new();
    let store = S3Double::start(StoreBehaviour::Faultless);
    let runs = recordings(&place, &["flat", "foam"]);
    let name = runs[0].rsplit('/').next().expect("a name");
    let whole = std::fs::read(&runs[0]).expect("read");
    std::fs::write(place.path("cut.mcap"), &whole[..whole.len() - 1000]).expect("written");
    std::fs::write(place.path("going.mcap.partial"), &whole).expect("written");
    std::fs::write(place.path("text.mcap"), "no run").expect("written");
    ok(&place, &store, &["upload", &runs[1]]);
    let mut other = whole.clone();
    // Within the magic bytes of the beginning nothing may change; the rest is compared by its digest.
    let end = other.len() - 100;
    other[end] ^= 1;
    store.put(&key(&format!("inbox/{name}")), other.clone());
    let output =
        run(&place, &store, &["upload", "cut.mcap", "going.mcap.partial", "text.mcap", &runs[0], "absent.mcap"]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for expected in [
        "`cut.mcap` was not closed",
        "echolake recover cut.mcap",
        "`going.mcap.partial` is an unfinished recording",
        "`text.mcap` is not an MCAP file: it begins with `6e 6f 20 72 75 6e`",
        "is another file than the given one",
        "cannot read `absent.mcap`",
        "5 of 5 files were not uploaded",
    ] {
        assert!(said.contains(expected), "expected `{expected}` in: {said}");
    }
    assert!(store.get(&key(&format!("inbox/{name}"))) == other, "left as it is");
}

#[test]
fn an_object_that_is_not_what_was_uploaded_goes_to_quarantine() {
    let place = TestFolder::new();
    let store = S3Double::start(StoreBehaviour::Faultless);
    let runs = recordings(&place, &["flat", "flat"]);
    let name = runs[0].rsplit('/').next().expect("a name");
    ok(&place, &store, &["upload", &runs[0]]);
    // A whole run of the same surface in its place.
    store.put(&key(&format!("inbox/{name}")), std::fs::read(&runs[1]).expect("read"));
    let output = run(&place, &store, &["ingest"]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(3), "{said}");
    assert!(said.contains("is not what was uploaded") && said.contains("now at `quarantine/"), "{said}");
    let is_left = |stored: &String| ["runs/", "inbox/"].iter().any(|folder| stored.starts_with(&key(folder)));
    assert!(!store.keys().iter().any(is_left), "{:?}", store.keys());
    ok(&place, &store, &["upload", &runs[0]]);
    ok(&place, &store, &["ingest"]);
    assert!(store.keys().contains(&key(&format!("runs/flat/{name}"))));
}

#[test]
fn a_copy_within_the_store_that_is_not_what_was_read_is_deleted_and_made_again() {
    let place = TestFolder::new();
    let store = S3Double::start(StoreBehaviour::DamagesCopies);
    let runs = recordings(&place, &["flat"]);
    let name = runs[0].rsplit('/').next().expect("a name");
    let (inbox, place_of_run) = (key(&format!("inbox/{name}")), key(&format!("runs/flat/{name}")));
    ok(&place, &store, &["upload", &runs[0]]);
    let output = run(&place, &store, &["ingest"]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(3), "{said}");
    assert!(said.contains("its copy has SHA-256") && said.contains("hint: "), "{said}");
    assert!(store.keys().contains(&inbox) && !store.keys().contains(&place_of_run), "{:?}", store.keys());
    store.set_behaviour(StoreBehaviour::Faultless);
    ok(&place, &store, &["ingest"]);
    assert!(!store.keys().contains(&inbox));
    assert!(store.get(&place_of_run) == std::fs::read(&runs[0]).expect("read"));
}

#[test]
fn a_recording_is_uploaded_at_its_end_and_stays_if_that_fails() {
    let place = TestFolder::new();
    let store = S3Double::start(StoreBehaviour::Faultless);
    let acquire = |store: &S3Double, surface: &str| {
        let mut command = Command::new(ECHOLAKE);
        command.args(["--lake", "lake", "acquire", "--surface", surface, "--rig", "rig.toml", "--ir-only"]);
        command.args(["--upload", super::LAKE]).current_dir(place.path("")).env_remove("ECHOLAKE_LAKE");
        super::run_command(command.envs(store.environment())).expect("it starts")
    };
    let output = acquire(&store, "flat");
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let file = place.path(String::from_utf8_lossy(&output.stdout).trim());
    let name = file.file_name().expect("a name").to_string_lossy().into_owned();
    assert!(store.get(&key(&format!("inbox/{name}"))) == std::fs::read(&file).expect("it stays"));
    let next = format!("next: echolake --lake {} ingest", super::LAKE);
    assert!(stderr(&output).contains(&next), "{}", stderr(&output));

    let refusing = S3Double::start(StoreBehaviour::Overwrites);
    let output = acquire(&refusing, "foam");
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    let file = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    let hint = format!("hint: `echolake --lake {} upload {file}` continues", super::LAKE);
    assert!(said.contains(&format!("the run stays in `{file}`")) && said.contains(&hint), "{said}");
    ok(&place, &store, &["upload", &file]);
}

mod slow {
    use super::*;

    // At each cut the store takes one part more.
    #[test]
    fn a_large_upload_that_is_cut_off_ten_times_sends_no_part_twice_that_is_known_to_be_there() {
        let place = TestFolder::new();
        let store = S3Double::start(StoreBehaviour::Faultless);
        let (file, journal) = (place.path("large.mcap"), place.path("large.mcap.upload"));
        write_large_run(&file);
        for cut in 1..=CUTS {
            wait_until("the end of the killed one's connections", || store.connections() == 0);
            store.limit_parts(store.parts() + 1);
            let expected = store.parts() + 1;
            let mut upload =
                ChildProcess::start(&mut command(&place, &store, &["upload", "large.mcap"])).expect("it starts");
            wait_until("a part more", || store.parts() >= expected);
            // A kill between the two costs that part.
            wait_until("its line in the journal", || {
                std::fs::read_to_string(&journal).is_ok_and(|text| text.lines().count() > cut)
            });
            if cut % 2 == 0 {
                upload.signal("INT");
                let output = upload.wait();
                let said = stderr(&output);
                assert_eq!(output.status.code(), Some(1), "{said}");
                assert!(said.contains("run the same command again to resume"), "{said}");
            } else {
                upload.kill();
            }
            assert!(!store.keys().contains(&key(&format!("inbox/{LARGE_RUN}.mcap"))), "cut {cut}");
        }
        wait_until("the end of its connections", || store.connections() == 0);
        store.limit_parts(usize::MAX);
        let paths = ok(&place, &store, &["upload", "large.mcap"]);
        assert_eq!(paths, format!("inbox/{LARGE_RUN}.mcap\n"));
        assert!(store.get(&key(paths.trim())) == std::fs::read(&file).expect("read"), "other bytes");
        assert_eq!(store.parts(), LARGE_PARTS, "each part once");
        assert!(!journal.exists(), "its end");
        let record = String::from_utf8(store.get(&key(&format!("inbox/{LARGE_RUN}.mcap.sha256")))).expect("text");
        let summed = Command::new("sha256sum").arg(&file).output().expect("sha256sum starts");
        assert_eq!(record.split(' ').next(), String::from_utf8_lossy(&summed.stdout).split(' ').next());

        // What the store has forgotten is sent anew.
        let store = S3Double::start(StoreBehaviour::Faultless);
        store.limit_parts(1);
        let mut upload =
            ChildProcess::start(&mut command(&place, &store, &["upload", "large.mcap"])).expect("it starts");
        wait_until("a part", || store.parts() >= 1 && journal.exists());
        upload.kill();
        store.abort_uploads();
        store.limit_parts(usize::MAX);
        ok(&place, &store, &["upload", "large.mcap"]);
        assert!(store.get(&key(paths.trim())) == std::fs::read(&file).expect("read"), "other bytes");
    }

    // Each run is read and committed by one of them alone.
    #[test]
    fn three_ingests_share_an_inbox_without_doing_anything_twice() {
        let place = TestFolder::new();
        let surfaces = ["flat", "foam", "wood", "prd", "brick", "wavy", "flat_2", "wood_2", "brick_2", "prd_2"];
        let runs = recordings(&place, &surfaces);
        let store = S3Double::start(StoreBehaviour::Faultless);
        ok(&place, &store, &["upload", "lake/inbox"]);
        let start = |_| ChildProcess::start(&mut command(&place, &store, &["ingest"])).expect("it starts");
        let mut ingests = [0, 1, 2].map(start);
        let said: String = ingests
            .iter_mut()
            .map(|ingest| {
                let output = ingest.wait();
                assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
                stderr(&output)
            })
            .collect();
        for run in &runs {
            let name = run.rsplit('/').next().and_then(|name| name.strip_suffix(".mcap")).expect("a run");
            let taken =
                said.lines().filter(|line| line.starts_with(&format!("{name}: ")) && line.ends_with(" measurements"));
            assert_eq!(taken.count(), 1, "{name}: {said}");
        }
        assert!(!said.contains("is in the lake already"), "{said}");
        let count = ok(&place, &store, &["sql", "--format", "csv", "select count(*) as n from runs"]);
        assert_eq!(count, format!("n\n{}\n", surfaces.len()));
        assert!(
            store.keys().iter().all(|key| !key.contains("/inbox/") && !key.contains("/_claims/")),
            "{:?}",
            store.keys()
        );
    }

    #[test]
    fn uploaded_runs_are_ingested_by_their_digest_and_known_ever_after() {
        let place = TestFolder::new();
        let store = S3Double::start(StoreBehaviour::Faultless);
        let runs = recordings(&place, &["flat", "foam"]);
        let names: Vec<_> = runs.iter().map(|run| run.rsplit('/').next().expect("a name").to_owned()).collect();
        std::fs::write(place.path("lake/inbox/x.mcap.partial"), "x").expect("written");
        let uploaded = |json: &str| -> Vec<(String, bool)> {
            let summary: serde_json::Value = serde_json::from_str(json).expect("JSON");
            assert_eq!(summary["refused"].as_array().map(Vec::len), Some(0), "{summary}");
            let runs = summary["runs"].as_array().expect("runs").iter();
            runs.map(|run| (run["path"].as_str().expect("a path").to_owned(), run["uploaded"] == true)).collect()
        };
        let inbox = |uploaded: bool| names.iter().map(|name| (format!("inbox/{name}"), uploaded)).collect::<Vec<_>>();
        // The first run makes the lake.
        let output = run(&place, &store, &["upload", "lake/inbox", "--json"]);
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        assert!(stderr(&output).contains("x.mcap.partial` is unfinished"), "{}", stderr(&output));
        assert_eq!(uploaded(&String::from_utf8_lossy(&output.stdout)), inbox(true));
        assert_eq!(uploaded(&ok(&place, &store, &["upload", &runs[0], &runs[1], "--json"])), inbox(false));

        ok(&place, &store, &["ingest"]);
        assert!(
            store.keys().iter().all(|key| !key.contains("/inbox/") && !key.contains("/_claims/")),
            "{:?}",
            store.keys()
        );
        let in_runs = [format!("runs/flat/{}", names[0]), format!("runs/foam/{}", names[1])];
        for (path, run) in in_runs.iter().zip(&runs) {
            assert!(store.get(&key(path)) == std::fs::read(run).expect("read"));
            assert!(store.keys().contains(&key(&format!("{path}.sha256"))));
        }
        let known = in_runs.map(|path| (path, false)).to_vec();
        assert_eq!(uploaded(&ok(&place, &store, &["upload", &runs[0], &runs[1], "--json"])), known);
        let report = ok(&place, &store, &["doctor"]);
        assert!(!report.contains("sha256"), "{report}");
    }
}
