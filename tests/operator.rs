//! The work of an operator: runs that are refused, stopped, resumed and recovered.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use echolake_testing::ChildProcess;

use super::{TestFolder, stderr};

/// A run that was stopped by Ctrl-C after its first pairs; returns its recording.
fn stop_a_run(place: &TestFolder) -> PathBuf {
    let listed = place.path("safe.txt");
    let mut child = ChildProcess::start(&mut place.command(&[
        "acquire",
        "--surface",
        "flat",
        "--rig",
        "rig.toml",
        "--ir-only",
        "--pace",
        "0.1",
        "--checkpoint-every",
        "1",
        "--acknowledge",
        "safe.txt",
    ]))
    .expect("it starts");
    let begun = Instant::now();
    while std::fs::read_to_string(&listed).map_or(0, |text| text.lines().count()) < 3 {
        assert!(begun.elapsed() < Duration::from_secs(60), "no pair is safe yet");
        std::thread::sleep(Duration::from_millis(20));
    }
    child.signal("INT");
    let output = child.wait();
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let inbox = std::fs::read_dir(place.path("lake/inbox")).expect("an inbox");
    let partial = inbox.map(|entry| entry.expect("an entry").path()).next().expect("a recording");
    assert!(partial.extension().is_some_and(|e| e == "partial"), "{partial:?}");
    partial
}

#[test]
fn a_recovered_run_is_taken_in_as_partial() {
    let place = TestFolder::new();
    let partial = stop_a_run(&place);
    place.ok(&["recover", partial.to_str().expect("a name")]);
    place.fails(0, &["ingest"], "was stopped before its end; all that it holds is in the tables");
    assert_eq!(place.number("select count(*) from runs where state = 'partial'"), 1.0);
    // Resumed, it would be another file of the same run.
    let name = partial.to_str().expect("a name");
    place.fails(1, &["acquire", "--resume", name], "its run is in the lake");
    assert!(partial.exists());
}

#[test]
fn a_second_run_waits_for_the_first_or_is_forced() {
    let place = TestFolder::new();
    let first = ["acquire", "--surface", "flat", "--rig", "rig.toml", "--ir-only", "--skip-checks", "--pace", "3600"];
    let mut child = ChildProcess::start(&mut place.command(&first)).expect("it starts");
    let begun = Instant::now();
    let is_recording = || std::fs::read_dir(place.path("lake/inbox")).is_ok_and(|inbox| inbox.count() > 0);
    while !is_recording() {
        assert!(begun.elapsed() < Duration::from_secs(60), "no recording yet");
        std::thread::sleep(Duration::from_millis(20));
    }
    let second = ["acquire", "--surface", "foam", "--rig", "rig.toml", "--ir-only"];
    place.fails(1, &second, "lake/inbox` is in use: `");
    place.fails(1, &second, "-flat-");
    place.fails(1, &second, ".mcap.partial` is being recorded; hint: wait for the end of that run, or --force");
    place.ok(&[&second[..], &["--force"]].concat());
    // The simulated rig of another lake is another one.
    TestFolder::new().ok(&second);
    // The lock of a process that is gone counts for nothing.
    child.kill();
    place.ok(&second);
}

const ROOM: &str = "name = \"room\"\nbands.centres_hz = [1000]\ngrid.points_mm = [[0, 0, 1000], [500, 0, 1000]]\n\
    sweep = { rate_hz = 48000, high_hz = 20000 }\nimpulse_response.length = 48000\n";

#[test]
fn a_refused_first_run_leaves_no_lake_behind() {
    let place = TestFolder::new();
    std::fs::write(place.path("room.toml"), ROOM).expect("written");
    let acquire = ["acquire", "--surface", "flat", "--rig", "room.toml"];
    place.fails(1, &acquire, "rig `room`: a recording of 0.51 s is too short");
    assert!(!place.path("lake").exists());
    std::fs::create_dir(place.path("lake")).expect("made");
    place.fails(1, &acquire, "`sweep.duration_secs`");
    assert_eq!(std::fs::read_dir(place.path("lake")).expect("the folder stays").count(), 0);
    // Neither does one that fails before it measures.
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = taken.local_addr().expect("an address").to_string();
    place.fails(1, &["acquire", "--surface", "flat", "--rig", "rig.toml", "--live", &address], "in use");
    assert_eq!(std::fs::read_dir(place.path("lake")).expect("the folder stays").count(), 0);
    // A lake that was there before stays, and a run of another rig is refused in words.
    place.acquire("flat", &["--ir-only"]);
    place.fails(1, &acquire, "`grid.points_mm` is 2 points (0 0 1000, 500 0 1000), the lake's is none");
    assert!(place.path("lake/lake.toml").exists());
}

#[test]
fn the_rig_of_the_readme_can_be_simulated() {
    let place = TestFolder::new();
    let readme = include_str!("../README.md");
    let (_, rig) = readme.split_once("    name = \"living room\"\n").expect("a rig in the README");
    let lines = rig.lines().take_while(|line| line.is_empty() || line.starts_with("    "));
    let rig = lines.fold("name = \"living room\"\n".to_owned(), |text, line| text + line.trim() + "\n");
    std::fs::write(place.path("room.toml"), rig).expect("written");
    for surface in ["flat", "foam"] {
        place.ok(&["acquire", "--surface", surface, "--rig", "room.toml"]);
    }
    place.ok(&["ingest"]);
    assert_eq!(place.number("select count(*) from measurements"), 2.0);
}

mod slow {
    use super::*;

    #[test]
    fn a_run_that_was_stopped_becomes_a_run_of_what_it_holds_or_is_resumed() {
        let place = TestFolder::new();
        let partial = stop_a_run(&place);
        let name = partial.to_str().expect("a name");
        let before = std::fs::read(&partial).expect("read");
        // Ingest does not take the recording away from `--resume`.
        place.fails(1, &["ingest", name], "is an unfinished recording");
        place.fails(0, &["ingest"], "nothing to ingest");
        let output = place.run(&["recover", name]);
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(0), "{said}");
        assert!(said.contains("of 45 pairs") && said.contains("lost: nothing"), "{said}");
        let run = partial.with_extension("");
        assert_eq!(String::from_utf8_lossy(&output.stdout).trim(), run.to_str().expect("a name"));
        assert_eq!(std::fs::read(&partial).expect("read"), before, "the recording is only read");
        // A whole run is left alone.
        place.fails(0, &["recover", run.to_str().expect("a name")], "nothing to do");
        // The copy stands in the way of the run's name, and both ways out are named.
        place.fails(1, &["acquire", "--resume", name], "delete it if the recording is to be resumed");
        std::fs::remove_file(&run).expect("deleted");
        place.ok(&["acquire", "--resume", name]);
        place.ok(&["ingest"]);
        assert_eq!(place.number("select count(*) from measurements"), 45.0);
    }
}
