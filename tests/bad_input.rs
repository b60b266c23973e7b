//! Bad input: a clear error that names the place, and nothing half-written.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use echolake_schema::messages::SampleFormat;
use echolake_schema::samples::encode_wav;
use echolake_testing::run_command;

use super::{ECHOLAKE, TestFolder, stderr};

fn files(folder: &Path) -> usize {
    std::fs::read_dir(folder).map_or(0, Iterator::count)
}

fn wav(path: &Path, rate: u32, channels: &[&[i16]]) {
    let bytes: Vec<Vec<u8>> = channels.iter().map(|c| c.iter().flat_map(|x| x.to_le_bytes()).collect()).collect();
    let channels: Vec<&[u8]> = bytes.iter().map(Vec::as_slice).collect();
    std::fs::write(path, encode_wav(SampleFormat::S16le, rate, &channels).expect("a file")).expect("written");
}

fn noise(len: usize) -> Vec<i16> {
    (0..len).map(|i| ((i * 7919) % 20_011) as i16 - 10_005).collect()
}

const HEADER: &str = "surface,recording,loopback,microphone,speaker,temperature_c\n";

#[test]
fn manifests_and_wav_files() {
    let place = TestFolder::new();
    wav(&place.path("good.wav"), 96_000, &[&noise(4_000)]);
    wav(&place.path("short.wav"), 96_000, &[&noise(3_999)]);
    wav(&place.path("slow.wav"), 48_000, &[&noise(4_000)]);
    std::fs::write(place.path("empty.wav"), "").expect("written");
    std::fs::write(place.path("text.wav"), "RIFF, but not really").expect("written");
    let whole = std::fs::read(place.path("good.wav")).expect("read");
    std::fs::write(place.path("cut.wav"), &whole[..whole.len() - 100]).expect("written");
    let check = |manifest: &str, expected: &str| {
        std::fs::write(place.path("manifest.csv"), manifest).expect("written");
        place.fails(1, &["import", "wav", "manifest.csv", "--rig", "rig.toml"], expected);
        assert_eq!(files(&place.path("lake/inbox")), 0, "{expected}");
        assert!(!place.path("lake").exists(), "no lake is made for it: {expected}");
    };
    let row = |row: &str, expected: &str| check(&format!("{HEADER}{row}\n"), expected);
    row("a,missing.wav,good.wav,0/0/0,0/0/1,20", "missing.wav");
    row("a,empty.wav,good.wav,0/0/0,0/0/1,20", "is empty");
    row("a,text.wav,good.wav,0/0/0,0/0/1,20", "no WAV file");
    row("a,cut.wav,good.wav,0/0/0,0/0/1,20", "is cut off: its header says 8000 bytes");
    row("a,good.wav,cut.wav,0/0/0,0/0/1,20", "line 2, column `loopback`");
    row("a,good.wav,short.wav,0/0/0,0/0/1,20", "3999 samples, expected the recording's 4000");
    row("a,good.wav,slow.wav,0/0/0,0/0/1,20", "sampled at 48000 Hz, expected the rig's 96000 Hz");
    row("a,good.wav,good.wav#2,0/0/0,0/0/1,20", "has 1 channels");
    row("a,good.wav,good.wav,9/0/0,0/0/1,20", "line 2, column `microphone`");
    row("a,good.wav,good.wav,1 2 3,0/0/1,20", "the nearest is");
    row("a,good.wav,good.wav,0/0/1,0/0/0,20", "exchanged");
    row("a,good.wav,good.wav,0/0/0,0/0/1,NaN", "`NaN` is no number");
    row("a,good.wav,good.wav,0/0/0,0/0/1,400", "temperature (C) is 400");
    row("a,good.wav,good.wav,0/0/0,0/0/1,", "it is empty, and levels of a model are corrected by it");
    row("../a,good.wav,good.wav,0/0/0,0/0/1,20", "not a valid surface id");
    check("", "it is empty");
    check(HEADER, "no rows");
    check("surface,recording\na,b\n", "column `loopback` is missing");
    check(&format!("{},colour\n", HEADER.trim()), "unknown column `colour`");
    place.fails(1, &["import", "wav", "nowhere.csv", "--rig", "rig.toml"], "nowhere.csv");
}

#[test]
fn a_clipped_recording_is_kept_and_said() {
    let place = TestFolder::new();
    let mut clipped = noise(4_000);
    clipped.rotate_right(30);
    clipped[100] = i16::MAX;
    wav(&place.path("clipped.wav"), 96_000, &[&clipped]);
    wav(&place.path("good.wav"), 96_000, &[&noise(4_000)]);
    std::fs::write(place.path("manifest.csv"), format!("{HEADER}a,clipped.wav,good.wav,0/0/0,0/0/1,20\n"))
        .expect("written");
    place.fails(0, &["import", "wav", "manifest.csv", "--rig", "rig.toml"], "1 samples clipped");
    place.ok(&["ingest"]);
    assert_eq!(place.number("select clipped_samples from measurements"), 1.0);
    // Of both channels of one file the loopback is the second: it is named, and the recording is not.
    let mut late = noise(4_000);
    late.rotate_right(30);
    let mut clipped = noise(4_000);
    clipped[100] = i16::MAX;
    wav(&place.path("both.wav"), 96_000, &[&late, &clipped]);
    std::fs::write(place.path("manifest.csv"), format!("{HEADER}b,both.wav,both.wav#2,0/0/0,0/0/1,20\n"))
        .expect("written");
    // It is noise with a click, and no response is found with it: the take is lost.
    let expected = "line 2: rejected: 1 samples clipped in the loopback, `both.wav`, channel 2; loopback";
    place.fails(3, &["import", "wav", "manifest.csv", "--rig", "rig.toml"], expected);
}

#[test]
fn sofa_files_that_are_none() {
    let place = TestFolder::new();
    std::fs::write(place.path("a.sofa"), "no HDF5").expect("written");
    place.fails(1, &["import", "sofa", "a.sofa", "--rig", "rig.toml"], "it is no HDF5 file");
    place.fails(1, &["import", "sofa", "b.sofa", "--rig", "rig.toml"], "b.sofa");
    assert!(!place.path("lake").exists(), "no lake is made for it");
}

#[test]
fn exports_to_what_is_neither_a_disk_nor_an_object_store() {
    let place = TestFolder::new();
    let refused = |args: &[&str]| place.fails(2, &[&["export"], args].concat(), "hint: name a path");
    refused(&["ml", "-o", "https://example.org/set"]);
    refused(&["mcap", "--where", "true", "-o", "ftp://host/some.mcap"]);
    refused(&["sofa", "-o", "http://bucket/sofa"]);
    refused(&["npz", "-o", "ssh://host/npz"]);
    refused(&["wav", "--where", "true", "-o", "hdfs://host/wav"]);
    assert_eq!(files(&place.path("")), 1, "the rig file alone, no folder that is called as a URL begins");
}

#[test]
fn panels_and_groups_that_cannot_be_made() {
    let place = TestFolder::new();
    place.fails(1, &["panel", "marble", "-o", "x.stl"], "no relief; hint: flat");
    place.fails(
        1,
        &["panel", "stretcher_bond", "--set", "joint_depth_mm=90", "-o", "x.stl"],
        "expected 0 to 80 mm full",
    );
    let deep = ["--set", "macrostructure=concave", "--set", "macro_depth_mm=400", "-o", "x.stl"];
    place.fails(1, &[&["panel", "stretcher_bond"][..], &deep].concat(), "macro_depth_mm=400, joint_depth_mm=10");
    place.fails(1, &["panel", "river_rock", "-o", "x.stl", "-o", "x.step"], "no mesh file that is known");
    assert!(!place.path("x.stl").exists(), "nothing is written where something is refused");
    place.fails(2, &["panel", "river_rock"], "--output");
    place.fails(2, &["panel", "--next", "ranges.toml", "-o", "next.toml"], "--results");
    let ranges = "relief = \"slated_stone\"\n[ranges]\nprojection_mm = [20, 60]\n[steps]\nprojection_mm = 5\n";
    std::fs::write(place.path("ranges.toml"), ranges).expect("written");
    std::fs::write(place.path("wide.toml"), ranges.replace("60", "90")).expect("written");
    place.fails(1, &["panel", "--group", "wide.toml", "-o", "group"], "range of `projection_mm` is 20 to 90");
    place.ok(&["panel", "--group", "ranges.toml", "--count", "3", "-o", "group"]);
    place.ok(&["panel", "--parameters", "group/0002_0.json", "--back", "prd", "--cells", "32", "-o", "0002.stl"]);
    place.acquire("0002_0", &["--parameters", "group/0002_0.json"]);
    std::fs::write(place.path("one.csv"), "surface_id,band,p90_mean_db\n0001_0,total,-1\n").expect("written");
    let next = |results| ["panel", "--next", "ranges.toml", "--results", results, "-o", "next.toml"];
    place.fails(1, &next("one.csv"), "two surfaces or more");
    std::fs::write(place.path("two.csv"), "surface_id,band,p90_mean_db\n0001_0,total,-1\n0001_1,total,-1\n")
        .expect("written");
    assert!(place.ok(&next("two.csv")).contains("projection_mm: steps of 5 become 10, from 30 on within 20 to 60."));
}

#[test]
fn rigs_whose_devices_are_unknown_or_absent() {
    let place = TestFolder::new();
    let rig = std::fs::read_to_string(place.path("rig.toml")).expect("the rig");
    let [audio, sensor, robots] = [
        "[devices.audio]\nkind = \"alsa\"\ncapture = \"no_such_pcm\"\nplayback = \"no_such_pcm\"\n",
        "[devices.sensor]\nkind = \"serial\"\npath = \"/dev/no_such_line\"\n",
        "[devices.robots]\nkind = \"rosbridge\"\nurl = \"ws://127.0.0.1:1\"\n",
    ];
    for (devices, expected) in [
        (audio.replace("alsa", "tape"), "unknown variant `tape`"),
        (sensor.replace("serial", "parallel"), "unknown variant `parallel`"),
        (robots.replace("rosbridge", "puppets"), "unknown variant `puppets`"),
        (audio.to_owned(), "simulated devices beside real ones"),
        ([sensor, robots].concat(), "simulated devices beside real ones"),
        ([audio, sensor, robots].concat(), "no_such_pcm"),
    ] {
        std::fs::write(place.path("rig.toml"), format!("{rig}\n{devices}")).expect("written");
        place.fails(1, &["acquire", "--surface", "flat", "--rig", "rig.toml", "--no-geometry"], expected);
        assert_eq!(files(&place.path("lake/inbox")), 0, "no run file: {expected}");
    }
    // A real panel is not what its surface is called.
    place.fails(2, &["acquire", "--surface", "flat", "--rig", "rig.toml"], "hint: --mesh FILE");
    place.fails(2, &["acquire", "--surface", "flat", "--rig", "rig.toml", "--set", "a=b"], "or --no-geometry");
    place.fails(1, &["acquire", "--surface", "flat", "--rig", "rig.toml", "--panel", "flat"], "no_such_pcm");
    std::fs::write(
        place.path("campaign.toml"),
        "name = \"real\"\nrig = \"rig.toml\"\n[[surfaces]]\nname = \"0012_1\"\n",
    )
    .expect("written");
    let campaign = ["campaign", "run", "campaign.toml"];
    place.fails(2, &campaign, "looks like; hint: `mesh = \"FILE\"`");
    assert!(!place.path("lake").exists());
    let campaign = [&campaign[..], &["--no-geometry"]].concat();
    place.fails(1, &campaign, "nobody confirmed that surface `flat` is in place");
    let mut command = Command::new("sh");
    command.args(["-c", "echo | exec \"$0\" --lake lake \"$@\"", ECHOLAKE]).args(&campaign);
    let output = run_command(command.current_dir(place.path("")).env_remove("ECHOLAKE_LAKE")).expect("it starts");
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("no_such_pcm") && !said.contains("simulated"), "{said}");
    assert_eq!(files(&place.path("lake/inbox")), 0, "nothing is simulated in place of it");
    std::fs::write(place.path("rig.toml"), rig).expect("written");
    place.fails(2, &["acquire", "--surface", "flat", "--rig", "rig.toml", "--no-geometry"], "leave out --no-geometry");
}

// A run's file that ends within the chunk of its last verdicts.
fn cut_off(whole: &[u8]) -> &[u8] {
    let summary = mcap::Summary::read(whole).expect("sound").expect("a summary");
    let verdicts = summary.channels.values().find(|c| c.topic == "/measurement").expect("verdicts").id;
    let theirs = summary.chunk_indexes.iter().filter(|c| c.message_index_offsets.contains_key(&verdicts));
    let last = theirs.map(|c| c.chunk_start_offset).max().expect("a chunk");
    &whole[..last as usize + 10]
}

#[test]
fn lakes_that_are_none_newer_or_someone_elses() {
    let place = TestFolder::new();
    place.fails(1, &["sql", "select 1"], "no lake at");
    place.acquire("flat", &[]);
    let config = place.path("lake/lake.toml");
    let text = std::fs::read_to_string(&config).expect("read");
    std::fs::write(&config, text.replace("format = 1", "format = 2")).expect("written");
    place.fails(1, &["sql", "select 1"], "update echolake");
    std::fs::write(&config, "format = [").expect("written");
    place.fails(1, &["ingest"], "lake.toml` is damaged");
    std::fs::write(&config, text).expect("written");
    std::fs::write(place.path("other.toml"), "impulse_response.length = 100").expect("written");
    place.fails(1, &["acquire", "--surface", "flat", "--rig", "other.toml"], "does not fit the lake");
}

/// A small file system of its own; unmounted at the end.
struct SmallDisk(std::path::PathBuf);

impl SmallDisk {
    // None if the test may not mount, as outside of containers and for other users than root.
    fn mounted(at: &Path, kib: u64) -> Option<Self> {
        std::fs::create_dir(at).expect("made");
        let size = format!("size={kib}k");
        let done = run_command(Command::new("mount").args(["-t", "tmpfs", "-o", &size, "tmpfs"]).arg(at));
        match done {
            Ok(output) if output.status.success() => Some(Self(at.to_owned())),
            _ => {
                eprintln!("skipped: no file system can be mounted here");
                None
            }
        }
    }

    fn remount(&self, option: &str) {
        let option = format!("remount,{option}");
        let done = run_command(Command::new("mount").args(["-o", &option]).arg(&self.0)).expect("mount starts");
        assert!(done.status.success(), "{option}: {}", stderr(&done));
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = run_command(Command::new("umount").arg(&self.0));
    }
}

#[test]
fn a_lake_that_is_read_only_can_be_read() {
    let place = TestFolder::new();
    let Some(disk) = SmallDisk::mounted(&place.path("lake"), 24 << 10) else { return };
    place.acquire("flat", &["--ir-only"]);
    place.ok(&["ingest"]);
    place.acquire("foam", &["--ir-only", "--seed", "2"]);
    disk.remount("ro");
    assert_eq!(place.number("select count(*) from measurements"), 45.0);
    place.fails(1, &["ingest"], "Read-only");
    place.fails(1, &["acquire", "--surface", "wood", "--rig", "rig.toml"], "Read-only");
    disk.remount("rw");
    place.ok(&["ingest"]);
    assert_eq!(place.number("select count(*) from measurements"), 2.0 * 45.0);
}

#[test]
fn a_recording_whose_recorder_died_yields_what_was_complete() {
    let place = TestFolder::new();
    let run = place.acquire("flat", &["--ir-only", "--checkpoint-every", "5"]);
    let whole = std::fs::read(&run).expect("read");
    let partial = run.with_extension("mcap.partial");
    std::fs::remove_file(&run).expect("removed");
    std::fs::write(&partial, cut_off(&whole)).expect("written");
    // While it is being recorded, it is left alone.
    let recorder = std::fs::File::open(&partial).expect("open");
    recorder.lock().expect("locked");
    place.fails(0, &["ingest"], "nothing to ingest");
    place.fails(1, &["recover", &partial.to_string_lossy()], "is being recorded");
    drop(recorder);
    // It could be resumed, so it is taken for a run only on request.
    place.fails(0, &["ingest"], "nothing to ingest");
    place.fails(3, &["recover", &partial.to_string_lossy()], "read back and compared");
    place.fails(3, &["ingest"], "");
    assert_eq!(place.number("select count(*) from runs where state = 'partial'"), 1.0);
    assert!(partial.exists(), "the original is as it was");
}

mod slow {
    use super::*;
    use crate::hostile_files::{HostileCampaign, HostileSizes, MIB};

    #[test]
    fn the_rest_of_an_inbox_with_hostile_files_is_taken_in() {
        let campaign = HostileCampaign::new(Path::new(ECHOLAKE), 1);
        let sizes = HostileSizes { false_records: 1_000_000, bomb: 20 * MIB, sparse: 300 * MIB };
        let outcome = campaign.round(Some(sizes), 0..20, Duration::from_secs(200));
        assert!(outcome.good == outcome.good_expected && outcome.deaths.is_empty(), "{outcome:?}");
        assert!(outcome.peak_mib < 600 && outcome.files > 40 && outcome.quarantined > 0, "{outcome:?}");
    }

    #[test]
    fn meshes_and_surfaces() {
        let place = TestFolder::new();
        let acquire = |mesh: &str| {
            vec![
                "acquire".to_owned(),
                "--surface".into(),
                "x".into(),
                "--rig".into(),
                "rig.toml".into(),
                "--mesh".into(),
                mesh.into(),
            ]
        };
        let check = |mesh: &str, expected: &str| {
            let args = acquire(mesh);
            place.fails(1, &args.iter().map(String::as_str).collect::<Vec<_>>(), expected);
            assert!(!place.path("lake").exists(), "no lake is made for it: {mesh}");
        };
        let stl = |file: &str, triangles: &[[[u32; 3]; 3]]| {
            let vertex = |[x, y, z]: &[u32; 3]| format!("vertex {x} {y} {z}\n");
            let text: String = triangles.iter().flatten().map(vertex).collect();
            std::fs::write(place.path(file), format!("solid x\n{text}endsolid x\n")).expect("written");
        };
        stl("empty.stl", &[]);
        stl("open.stl", &[[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]);
        let [a, b, c, d] = [[0, 0, 0], [1000, 0, 0], [0, 1000, 0], [0, 0, 1]];
        stl("large.stl", &[[a, b, c], [a, b, d], [b, c, d], [a, c, d]]);
        check("empty.stl", "is empty");
        check("open.stl", "is open: 3 edges");
        check("large.stl", "larger than the panel");
        check("missing.stl", "cannot read mesh");
        check("panel.ply", "no mesh file that is known; hint: .glb or .stl");
        place.fails(1, &["acquire", "--surface", "mystery", "--rig", "rig.toml"], "unknown surface `mystery`");
        place.fails(2, &["acquire", "--surface", "../x", "--rig", "rig.toml"], "not a valid surface id");
        place.fails(1, &["acquire", "--surface", "brick", "--set", "colour=red"], "no parameter `colour`");
        place.ok(&["panel", "macrostructure", "--cells", "128", "-o", "wavy.stl"]);
        place.acquire("from_file", &["--mesh", "wavy.stl"]);
        place.fails(2, &["acquire", "--surface", "x", "--rig", "rig.toml", "--side", "back"], "--mesh");
        place.ok(&["panel", "flat", "--back", "macrostructure", "--cells", "64", "-o", "two.stl"]);
        place.acquire("two_0", &["--mesh", "two.stl"]);
        place.acquire("two_1", &["--mesh", "two.stl", "--side", "back"]);
        place.ok(&["ingest"]);
        let of = |surface: &str, column: &str| {
            place.sql(&format!("select {column} x from surfaces where surface_id = '{surface}'"))[0]["x"].clone()
        };
        assert_eq!(of("from_file", "mesh_file"), "wavy.stl");
        assert_eq!(of("two_0", "relief_max_mm"), 0.0);
        let height = |surface: &str| of(surface, "relief_max_mm").as_f64().expect("a height");
        assert!(
            height("two_1") > 1.0 && (height("two_1") - height("from_file")).abs() < 0.5,
            "the back is the wavy one"
        );
    }

    #[test]
    fn run_files_that_are_none_or_damaged() {
        let place = TestFolder::new();
        let run = place.acquire("flat", &["--checkpoint-every", "5"]);
        let whole = std::fs::read(&run).expect("the run");
        std::fs::remove_file(&run).expect("removed");
        let ingest = |name: &str, bytes: &[u8], code: i32, expected: &str| {
            std::fs::write(place.path(name), bytes).expect("written");
            place.fails(code, &["ingest", name], expected);
        };
        ingest("empty.mcap", b"", 1, "is not whole: it has 0 bytes");
        ingest("text.mcap", b"this is no MCAP file at all", 1, "not an MCAP file");
        let mut foreign = std::io::Cursor::new(Vec::new());
        mcap::Writer::new(&mut foreign).expect("a writer").finish().expect("closed");
        ingest("foreign.mcap", foreign.get_ref(), 1, "no run of echolake");
        assert_eq!(place.number("select count(*) from runs"), 0.0);

        // Cut off near its end: it stays, and `recover` makes a run of what was complete.
        ingest("cut.mcap", cut_off(&whole), 1, "is not whole");
        assert_eq!(place.number("select count(*) from runs"), 0.0);
        place.fails(3, &["recover", "cut.mcap", "-o", "part.mcap"], "lost: ");
        place.fails(3, &["ingest", "part.mcap"], "its recording was cut off");
        let kept = place.number("select count(*) from measurements");
        assert!(kept > 0.0 && kept < 45.0, "{kept}");
        assert_eq!(place.sql("select state from runs")[0]["state"], "partial");
        // The whole file has other content under the same name.
        ingest("whole.mcap", &whole, 1, "already in the lake with other content");

        let other = TestFolder::new();
        other.acquire("wavy", &["--seed", "5"]);
        let mut flipped = whole.clone();
        let at = flipped.len() / 2;
        flipped[at] ^= 0x10;
        std::fs::write(other.path("flipped.mcap"), &flipped).expect("written");
        other.fails(3, &["ingest", "flipped.mcap"], "warning: ");
        other.fails(0, &["ingest"], "45 measurements");
    }

    #[test]
    fn a_full_disk_stops_everything_cleanly_and_with_space_it_goes_on() {
        let place = TestFolder::new();
        let Some(disk) = SmallDisk::mounted(&place.path("lake"), 24 << 10) else { return };
        for (surface, seed) in [("flat", "1"), ("foam", "2"), ("wood", "3")] {
            place.acquire(surface, &["--seed", seed, "--ir-only"]);
        }
        // As much space as two of the runs' tables need, less than all.
        let used = || {
            let output = run_command(Command::new("du").arg("-sk").arg(&disk.0)).expect("du starts");
            String::from_utf8(output.stdout)
                .expect("text")
                .split_whitespace()
                .next()
                .and_then(|n| n.parse::<u64>().ok())
        };
        let before = used().expect("a number");
        disk.remount(&format!("size={}k", before + 300));
        place.fails(1, &["ingest"], "full");
        place.fails(1, &["acquire", "--surface", "prd", "--rig", "rig.toml"], "full");
        // Readers are not disturbed.
        place.ok(&["sql", "select count(*) from runs"]);
        disk.remount("size=48m");
        place.ok(&["ingest"]);
        assert_eq!(place.number("select count(*) from tnce"), 3.0 * 45.0);
        assert_eq!(place.number("select count(*) from runs where state = 'complete'"), 3.0);
        let report: serde_json::Value = serde_json::from_str(&place.ok(&["doctor", "--json"])).expect("JSON");
        let findings = report["findings"].as_array().expect("a list");
        assert!(findings.iter().all(|f| f["severity"] == "note"), "{findings:?}");
    }

    #[test]
    fn a_run_ends_in_order_before_its_disk_is_full() {
        let place = TestFolder::new();
        let Some(_disk) = SmallDisk::mounted(&place.path("lake"), 60 << 10) else { return };
        // The paper's rig, whose checkpoints are 50 MB apart.
        let acquire = ["acquire", "--surface", "flat", "--skip-checks", "--acknowledge", "safe.txt"];
        place.fails(1, &acquire, "is nearly full: ");
        place.fails(1, &acquire[..3], "the run needs about");
        let acknowledged = std::fs::read_to_string(place.path("safe.txt")).expect("a list").lines().count();
        let mut inbox = std::fs::read_dir(place.path("lake/inbox")).expect("an inbox");
        let partial = std::fs::read(inbox.next().expect("a recording").expect("listed").path()).expect("read");
        assert!(inbox.next().is_none() && partial.len() > 55 << 20, "{} bytes", partial.len());
        let cut_off = mcap::read::Options::IgnoreEndMagic.into();
        let messages = mcap::MessageStream::new_with_options(&partial, cut_off).expect("an MCAP file");
        let topics: Vec<_> = messages.map_while(Result::ok).map(|message| message.channel.topic.clone()).collect();
        let count = |topic: &str| topics.iter().filter(|of| *of == topic).count();
        assert_eq!(count("/measurement"), acknowledged, "all that was measured is safe");
        assert!(acknowledged > 200 && count("/sweep") == acknowledged, "{acknowledged}");
    }

    // The system ends a process that writes larger files than it may: heights are as large, and rows of two flat runs
    // are not.
    #[test]
    fn a_run_that_ends_ingest_is_passed_over_by_the_next_one() {
        let place = TestFolder::new();
        for (surface, seed) in [("flat", "1"), ("brick", "1"), ("flat", "2")] {
            place.acquire(surface, &["--seed", seed, "--ir-only"]);
        }
        let ingest = || {
            let mut command = Command::new("sh");
            command.args(["-c", "ulimit -c 0; ulimit -f 300; exec \"$0\" --lake lake ingest", ECHOLAKE]);
            run_command(command.current_dir(place.path("")).env_remove("ECHOLAKE_LAKE")).expect("the command starts")
        };
        let first = ingest();
        assert_eq!(first.status.code(), None, "{}", stderr(&first));
        let second = ingest();
        let said = stderr(&second);
        assert_eq!(second.status.code(), Some(3), "{said}");
        assert_eq!(said.matches("a process of its own takes it in").count(), 2, "{said}");
        assert!(
            said.contains(".mcap` is passed over") && said.contains("-brick-") && said.contains("SIGXFSZ"),
            "{said}"
        );
        assert_eq!(place.number("select count(*) from runs where surface_id = 'flat'"), 2.0);
        match std::fs::read_dir(place.path("lake/quarantine")) {
            // It had not come to its place yet.
            Ok(quarantine) => {
                let files = quarantine.map(|entry| entry.expect("listed").path());
                let run = files.into_iter().find(|path| path.extension() == Some("mcap".as_ref())).expect("a run");
                std::fs::rename(&run, place.path("lake/inbox").join(run.file_name().expect("a name"))).expect("moved");
            }
            Err(_) => {
                place.fails(3, &["ingest"], "is passed over");
                std::fs::remove_dir_all(place.path("lake/tables/_reading")).expect("removed");
            }
        }
        place.ok(&["ingest"]);
        assert_eq!(place.number("select count(*) from runs"), 3.0);
    }
}
