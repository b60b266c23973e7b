//! What people put into a lake's inbox: copies that are not whole yet, names and kinds of entries that no run has,
//! files that are removed again.

use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt as _;
use std::os::unix::fs::symlink;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::process::Command;

use echolake_testing::{ChildProcess, run_command};

use super::{TestFolder, stderr};

fn start_watch(place: &TestFolder) -> ChildProcess {
    let mut watch = ChildProcess::start(&mut place.command(&["ingest", "--watch"])).expect("it starts");
    watch.wait_for_line("watching");
    watch
}

fn name(run: &Path) -> String {
    run.file_name().expect("a name").to_string_lossy().into_owned()
}

#[test]
fn a_copy_that_is_not_whole_stays_until_it_is() {
    let place = TestFolder::new();
    let run = place.acquire("flat", &["--ir-only"]);
    let whole = std::fs::read(&run).expect("read");
    for length in [0, 5, 20_000, whole.len() - 1] {
        std::fs::write(&run, &whole[..length]).expect("written");
        place.fails(3, &["ingest"], &format!("is not whole: it has {length} bytes"));
        let id = name(&run).trim_end_matches(".mcap").to_owned();
        place.fails(1, &["ingest", &id], "is not whole");
        assert_eq!(std::fs::metadata(&run).expect("where it was").len(), length as u64);
    }
    // A copy whose size is there before its bytes.
    std::fs::write(&run, vec![0; whole.len()]).expect("written");
    place.fails(3, &["ingest"], "is not whole");
    assert!(place.ok(&["doctor"]).contains("it has no end"));
    let states = place.sql("select state from system.inbox");
    assert_eq!(states[0]["state"], "incomplete");
    assert_eq!(place.number("select count(*) from runs"), 0.0);
    std::fs::write(&run, &whole).expect("written");
    place.fails(0, &["ingest"], "45 measurements");
    assert_eq!(place.sql("select state, missing from runs")[0]["state"], "waiting");
}

/// E34: a copy that fills out of order waits wherever its hole is; a damaged file is taken in, and a whole one
/// replaces it.
#[test]
fn a_copy_with_a_hole_waits_and_a_whole_file_replaces_a_damaged_one() {
    let place = TestFolder::new();
    let run = place.acquire("flat", &["--ir-only"]);
    let whole = std::fs::read(&run).expect("read");
    // The summary begins where the footer says; the data end before it, with their CRC.
    let summary = whole.len() - 28;
    let summary = u64::from_le_bytes(whole[summary..summary + 8].try_into().expect("eight")) as usize;
    let last = (summary - 13) / 4096 * 4096;
    // The last block may have nothing but an index, which is made again.
    for hole in [0..4096, 4096..8192, 8192..last, last - 4 * 4096..last] {
        let mut copy = whole.clone();
        copy[hole.clone()].fill(0);
        std::fs::write(&run, &copy).expect("written");
        place.fails(3, &["ingest"], "as in a copy that is not made in order; it stays where it is");
        assert!(std::fs::read(&run).expect("where it was") == copy, "{hole:?}");
        assert_eq!(place.number("select count(*) from runs"), 0.0, "{hole:?}");
    }
    let outside = place.path("outside.mcap");
    std::fs::rename(&run, &outside).expect("moved");
    place.fails(1, &["ingest", "outside.mcap"], "as in a copy that is not made in order");

    let in_place = place.path("lake/runs/flat").join(name(&run));
    let mut damaged = whole.clone();
    damaged[whole.len() / 2] ^= 0x55;
    std::fs::write(&run, &damaged).expect("written");
    place.fails(3, &["ingest"], "warning:");
    assert!(place.number("select damaged from runs") > 0.0);
    assert!(std::fs::read(&in_place).expect("in its place") == damaged);
    // The second time, the ingest before it ended after its commit, and left the damaged file in its place.
    for _ in 0..2 {
        std::fs::write(&in_place, &damaged).expect("written");
        std::fs::write(&run, &whole).expect("written");
        place.ok(&["ingest"]);
        assert!(!run.exists() && std::fs::read(&in_place).expect("in its place") == whole);
        let row = place.sql("select damaged, measurements, state from runs");
        let row = (&row[0]["damaged"], &row[0]["measurements"], &row[0]["state"]);
        assert_eq!(row, (&0.into(), &45.into(), &"waiting".into()));
    }
    // A damaged file does not replace a whole one.
    std::fs::write(&run, &damaged).expect("written");
    place.fails(3, &["ingest"], "is already in the lake with other content");
    assert!(std::fs::read(&in_place).expect("in its place") == whole);
}

#[test]
fn a_watch_waits_for_a_copy_without_a_word() {
    let place = TestFolder::new();
    let [flat, foam, wood] = ["flat", "foam", "wood"].map(|surface| place.acquire(surface, &["--ir-only"]));
    let whole = std::fs::read(&flat).expect("read");
    let away = place.path("wood.mcap");
    std::fs::rename(&wood, &away).expect("moved");
    std::fs::write(&flat, &whole[..whole.len() / 2]).expect("written");
    let mut watch = start_watch(&place);
    watch.wait_for_line(&format!("{}: 45 measurements", name(&foam).trim_end_matches(".mcap")));
    std::fs::rename(&away, &wood).expect("moved");
    watch.wait_for_line(&format!("{}: 45 measurements", name(&wood).trim_end_matches(".mcap")));
    assert!(flat.exists() && !watch.stderr().contains("not whole"), "{}", watch.stderr());
    std::fs::write(&flat, &whole).expect("written");
    watch.wait_for_line(&format!("{}: 45 measurements", name(&flat).trim_end_matches(".mcap")));
    watch.signal("TERM");
    assert_eq!(watch.wait().status.code(), Some(0));
}

#[test]
fn a_recording_that_was_cut_off_is_left_to_recover() {
    let place = TestFolder::new();
    // The rig's plan makes a recording one that can be resumed; a part of a file has none of it.
    let run = place.acquire("flat", &["--ir-only"]);
    let partial = run.with_extension("mcap.partial");
    std::fs::rename(&run, &partial).expect("renamed");
    place.fails(0, &["ingest"], "is not finished; hint: `echolake acquire --resume` resumes it");
    place.fails(0, &["ingest"], "nothing to ingest: every closed run of the lake is in its tables; 1 recordings");
    let whole = std::fs::read(&partial).expect("read");
    std::fs::write(&partial, &whole[..30]).expect("written");
    place.fails(3, &["ingest"], "was cut off after 30 bytes");
    assert!(partial.exists() && !run.exists(), "it is not renamed");
}

#[test]
fn a_removed_run_is_gone_from_all_tables_and_stays_in_earlier_versions() {
    let place = TestFolder::new();
    let runs = ["flat", "foam", "wood"].map(|surface| place.acquire(surface, &["--ir-only"]));
    place.ok(&["ingest"]);
    let id = |at: usize| name(&runs[at]).trim_end_matches(".mcap").to_owned();
    let count = |query: &str| place.number(query);
    let version = count("select max(version) from system.versions where \"table\" = 'runs'");
    assert_eq!(count("select count(*) from tnce"), 135.0);

    let listed = place.ok(&["remove", &id(2), "--dry-run"]);
    assert!(listed.contains("45 measurements would be removed"), "{listed}");
    assert_eq!(count("select count(*) from tnce"), 135.0);
    place.fails(1, &["remove", &id(2), "nonsense"], "no run at `nonsense`");
    assert_eq!(count("select count(*) from runs"), 3.0, "all or none of what is named");

    let removed: serde_json::Value = serde_json::from_str(&place.ok(&["remove", &id(2), "--json"])).expect("JSON");
    assert_eq!(removed[0]["run_id"], id(2).as_str());
    assert_eq!(removed[0]["moved_to"], format!("quarantine/{}.mcap", id(2)));
    for table in ["runs", "surfaces", "measurements", "nce", "tnce", "tnce_d4", "environment", "events", "heightmaps"] {
        assert_eq!(count(&format!("select count(*) from {table} where surface_id = 'wood'")), 0.0, "{table}");
    }
    assert_eq!(count("select count(*) from tnce"), 90.0);
    let then = format!("select count(*) from tnce version as of {version}");
    assert_eq!(count(&then), 135.0, "earlier versions are as they were");
    let audit = "select count(*) from system.versions where operation = 'DELETE' and \"table\" = 'runs'";
    assert_eq!(count(audit), 1.0);
    // Repeated, it has nothing to do, and no ingest brings the run back.
    place.fails(0, &["remove", &id(2)], "is not in the lake");
    place.ok(&["ingest"]);
    assert_eq!((count("select count(*) from runs"), count(audit)), (2.0, 1.0));
    let report = place.ok(&["doctor"]);
    assert!(!report.contains("damaged:") && !report.contains("reason.txt:"), "{report}");

    // Without Foam there is nothing to derive with; what has no row of `runs` is gone for good.
    place.ok(&["remove", &id(1), "--delete"]);
    assert!(!place.path("lake/quarantine").join(name(&runs[1])).exists());
    assert_eq!((count("select count(*) from tnce"), count("select count(*) from measurements")), (0.0, 45.0));
    assert_eq!(place.sql("select state, missing from runs")[0]["missing"], "foam");

    // It comes back as it was.
    let set_aside = place.path("lake/quarantine").join(name(&runs[2]));
    std::fs::rename(set_aside, place.path("lake/inbox").join(name(&runs[2]))).expect("moved");
    place.ok(&["ingest"]);
    assert_eq!(count("select count(*) from measurements"), 90.0);
    place.ok(&["vacuum", "--keep-hours", "0"]);
    place.fails(1, &["sql", &then], "");
}

/// An entry of an inbox beside a good run.
struct InboxEntry {
    kind: &'static str,
    /// Makes it in the inbox; the second folder is outside of the lake and has a run.
    make: fn(inbox: &Path, elsewhere: &Path),
    /// What names it; None if it is ingested.
    named: Option<&'static str>,
}

fn make_pipe(path: PathBuf) {
    let made = run_command(Command::new("mkfifo").arg(path)).expect("mkfifo starts");
    assert!(made.status.success(), "{}", stderr(&made));
}

fn copy_run(elsewhere: &Path, to: PathBuf) {
    std::fs::copy(elsewhere.join("other.mcap"), to).expect("copied");
}

fn inbox_entries() -> Vec<InboxEntry> {
    const LINK: Option<&str> = Some("a symbolic link, which is not followed");
    let entry = |kind, named, make| InboxEntry { kind, make, named };
    vec![
        entry(
            "a name that is not UTF-8",
            Some("inbox/x\\xff.mcap` is passed over: its name is not UTF-8"),
            |inbox, other| {
                copy_run(other, inbox.join(OsStr::from_bytes(b"x\xff.mcap")));
            },
        ),
        entry(
            "a line break",
            Some("inbox/x\\ny.mcap` is passed over: its name has a control character"),
            |inbox, other| {
                copy_run(other, inbox.join("x\ny.mcap"));
            },
        ),
        entry("an escape", Some("inbox/x\\u{1b}[2J.mcap` is passed over"), |inbox, other| {
            copy_run(other, inbox.join("x\u{1b}[2J.mcap"));
        }),
        entry("a link that leads back", LINK, |inbox, _| symlink("..", inbox.join("up")).expect("linked")),
        entry("a link to another lake", LINK, |inbox, other| symlink(other, inbox.join("x")).expect("linked")),
        entry("a link to a run", LINK, |inbox, other| {
            symlink(other.join("other.mcap"), inbox.join("x.mcap")).expect("linked");
        }),
        entry("a link to no run", LINK, |inbox, _| symlink("/etc/passwd", inbox.join("x.mcap")).expect("linked")),
        entry("a link to nothing", LINK, |inbox, _| symlink("nowhere", inbox.join("x.mcap")).expect("linked")),
        entry("a link as a recording", LINK, |inbox, other| {
            symlink(other.join("other.mcap"), inbox.join("x.mcap.partial")).expect("linked");
        }),
        entry("a named pipe", Some("a named pipe, expected a file"), |inbox, _| make_pipe(inbox.join("x.mcap"))),
        entry("a pipe as a recording", Some("a named pipe, expected a file"), |inbox, _| {
            make_pipe(inbox.join("x.mcap.partial"));
        }),
        entry("a socket", Some("a socket, expected a file"), |inbox, _| {
            drop(UnixListener::bind(inbox.join("x.mcap")).expect("bound"));
        }),
        entry("a folder", Some("a folder, expected a file"), |inbox, _| {
            std::fs::create_dir(inbox.join("x.mcap")).expect("made");
        }),
        entry("no run of the longest name", Some("is not an MCAP file"), |inbox, _| {
            std::fs::write(inbox.join(format!("{}.mcap", "n".repeat(250))), "no run").expect("written");
        }),
        entry("no run of a name that is longer encoded", Some("is not an MCAP file"), |inbox, _| {
            std::fs::write(inbox.join(format!("{}.mcap", "~ü".repeat(80))), "no run").expect("written");
        }),
        entry("a run of the longest name", None, |inbox, other| {
            copy_run(other, inbox.join(format!("{}.mcap", "n".repeat(250))));
        }),
        entry("a run in a folder of a strange name", None, |inbox, other| {
            std::fs::create_dir(inbox.join("a%20 b[~]*")).expect("made");
            copy_run(other, inbox.join("a%20 b[~]*/ü?.mcap"));
        }),
    ]
}

mod slow {
    use super::*;
    use crate::kills::copy_folder;

    /// Entries that are tried at once.
    const AT_ONCE: usize = 6;

    // Each entry by each command that reads the inbox: the good run beside it is ingested, the entry is named, nothing
    // hangs (every command has a limit), and nothing outside of the lake is touched.
    #[test]
    fn names_and_kinds_of_files_in_the_inbox() {
        let start = TestFolder::new();
        let good = start.acquire("flat", &["--ir-only"]);
        let other = start.acquire("foam", &["--ir-only"]);
        let elsewhere = start.path("elsewhere");
        std::fs::create_dir(&elsewhere).expect("made");
        std::fs::rename(&other, elsewhere.join("other.mcap")).expect("moved");
        let run = name(&good).trim_end_matches(".mcap").to_owned();
        // A watch waits for most of its time.
        let entries = inbox_entries();
        for entries in entries.chunks(AT_ONCE) {
            std::thread::scope(|scope| {
                for entry in entries {
                    scope.spawn(|| check_entry(entry, &start, &run));
                }
            });
        }
    }

    fn check_entry(InboxEntry { kind, make, named }: &InboxEntry, start: &TestFolder, run: &str) {
        let named = *named;
        let lake_with_entry = || {
            let place = TestFolder::new();
            copy_folder(&start.path("lake"), &place.path("lake"));
            copy_folder(&start.path("elsewhere"), &place.path("elsewhere"));
            make(&place.path("lake/inbox"), &place.path("elsewhere"));
            place
        };
        let check = |place: &TestFolder, said: &str| {
            if let Some(named) = named {
                assert!(said.contains(named), "{kind}: expected `{named}` in: {said}");
            }
            let runs = if named.is_some() { 1.0 } else { 2.0 };
            assert_eq!(place.number("select count(*) from runs"), runs, "{kind}: {said}");
            assert_eq!(place.number("select count(*) from measurements where surface_id = 'flat'"), 45.0, "{kind}");
            assert!(place.path("elsewhere/other.mcap").is_file(), "{kind}: it is touched");
            assert!(!said.contains('\u{1b}') && !said.contains("root:"), "{kind}: {said}");
        };
        let place = lake_with_entry();
        let report = place.ok(&["doctor"]);
        let listed = place.ok(&["sql", "--json", "select state, path, reason from system.inbox"]);
        // Refused files are named once ingest has read them.
        if let Some(named) = named.filter(|named| !named.contains("MCAP")) {
            let reason = named.rsplit("passed over: ").next().expect("a text");
            let reason = if reason.contains('`') { "control character" } else { reason };
            assert!(report.contains(reason), "{kind}: {report}");
            assert!(listed.contains("unusable") && listed.contains(reason), "{kind}: {listed}");
        }
        assert!(listed.contains(run), "{kind}: {listed}");
        let output = place.run(&["ingest"]);
        assert_eq!(output.status.code(), Some(if named.is_some() { 3 } else { 0 }), "{kind}: {}", stderr(&output));
        check(&place, &stderr(&output));
        place.ok(&["doctor"]);

        let place = lake_with_entry();
        let mut watch = start_watch(&place);
        watch.wait_for_line(&format!("{run}: 45 measurements"));
        watch.wait_for_line(named.unwrap_or("foam"));
        watch.wait_for_line("ingest: ");
        watch.signal("TERM");
        let output = watch.wait();
        assert_eq!(output.status.code(), Some(if named.is_some() { 3 } else { 0 }), "{kind}: {}", stderr(&output));
        check(&place, &stderr(&output));
    }
}
