//! Files that are cut at any byte, or damaged, are rebuilt to what was whole before that, and nothing else.

use std::path::Path;

use echolake_schema::manifest::{Origin, RunEnd, RunManifest};
use echolake_schema::messages::{AmbientSample, ImpulseResponse, Measurement, Verdict};
use echolake_schema::{Rig, RunId, SurfaceRecord, Timestamp, topics};
use mcap::read::Options;
use prost::Message as _;

use super::*;
use crate::run::recorder::{Held, Recorder, RunStart};

/// Pairs of the run, one a checkpoint.
const PAIRS: u32 = 20;
const START: Timestamp = Timestamp(1_767_600_000_000_000_000);

fn attempt(recorder: &mut Recorder, pair: u32, attempt: u32) {
    let at = START.plus_secs(f64::from(pair) * 12.3 + f64::from(attempt) / 10.0);
    recorder.poses(at, [0.0; 3], [1.0; 3]).expect("recorded");
    recorder.environment(at, &AmbientSample::default()).expect("recorded");
    let samples = (0..400).map(|i| ((i * 7919 + pair * 31) % 1009) as f32).collect();
    let ir = ImpulseResponse { pair_id: pair, attempt, samples, ..Default::default() };
    recorder.ir(at, &ir).expect("recorded");
    let verdict = Verdict::Accepted.into();
    recorder.measurement(at, &Measurement { pair_id: pair, attempt, verdict, ..Default::default() }).expect("recorded");
}

fn end() -> RunEnd {
    let ended = START.plus_secs(300.0);
    RunEnd { ended, accepted: u64::from(PAIRS), rejected: 0, attempts: u64::from(PAIRS) }
}

/// A run of [`PAIRS`], and how long its file was after each checkpoint.
fn whole(path: &Path) -> Vec<u64> {
    let rig = Rig::paper();
    let surface = "flat".parse().expect("an id");
    let manifest = RunManifest {
        run_id: RunId::compose(START, &surface, 1).expect("an id"),
        surface_id: surface,
        started: START,
        software: "test".into(),
        rig: rig.name.clone(),
        origin: Origin::Simulated,
    };
    let (surface, plan) = (SurfaceRecord::default(), Some(BTreeMap::new()));
    let start = RunStart { manifest: &manifest, rig: &rig, surface: &surface, relief: None, plan };
    let mut recorder = Recorder::create(path, &start).expect("a recorder");
    let lengths = (0..PAIRS).map(|pair| {
        attempt(&mut recorder, pair, 1);
        recorder.checkpoint().expect("on the disk");
        recorder.partial().metadata().expect("it is there").len()
    });
    let lengths = lengths.collect();
    recorder.finish(&end()).expect("finished");
    lengths
}

/// The pairs of a file's verdicts, and of its responses.
fn pairs(path: &Path) -> [Vec<u32>; 2] {
    let file = std::fs::read(path).expect("read");
    let mut found = [Vec::new(), Vec::new()];
    let messages = mcap::MessageStream::new_with_options(&file, Options::IgnoreEndMagic.into()).expect("an MCAP file");
    for message in messages.map_while(Result::ok) {
        match message.channel.topic.as_str() {
            topics::MEASUREMENT => found[0].push(Measurement::decode(&message.data[..]).expect("a verdict").pair_id),
            topics::IR => found[1].push(ImpulseResponse::decode(&message.data[..]).expect("a response").pair_id),
            _ => {}
        }
    }
    found
}

#[test]
fn a_file_cut_at_any_byte_keeps_every_checkpoint_before_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let checkpoints = whole(&path);
    let bytes = std::fs::read(&path).expect("read");
    let (cut_off, out) = (folder.path().join("cut.mcap.partial"), folder.path().join("cut.mcap"));
    // Around each checkpoint, where it matters, and in steps of a prime elsewhere.
    let around = checkpoints.iter().flat_map(|c| [c - 1, *c, c + 1]);
    for cut in around.chain((0..bytes.len() as u64).step_by(1_009)) {
        let kept = &bytes[..cut as usize];
        std::fs::write(&cut_off, kept).expect("written");
        let safe: Vec<u32> = (0..PAIRS).filter(|pair| checkpoints[*pair as usize] <= cut).collect();
        match recover(&cut_off, &out) {
            Ok(report) => {
                assert_eq!((report.bytes, report.verified_bytes <= cut), (cut, true));
                assert_eq!(report.to.as_deref(), Some(out.as_path()));
                assert_eq!(prove_file(&out), Ok(()), "cut at {cut}");
                let [verdicts, responses] = pairs(&out);
                // A chunk is whole a little before its indexes, and with them the checkpoint.
                assert!(verdicts == safe || verdicts == (0..=safe.len() as u32).collect::<Vec<_>>(), "cut at {cut}");
                assert!(verdicts.iter().all(|pair| responses.contains(pair)), "cut at {cut}");
                std::fs::remove_file(&out).expect("removed");
            }
            Err(error) => {
                assert!(matches!(error, Error::Headless { .. }) && safe.is_empty(), "cut at {cut}: {error}");
                assert!(!out.exists());
            }
        }
        assert!(std::fs::read(&cut_off).expect("read") == kept, "the original is as it was");
    }
}

#[test]
fn a_whole_file_is_left_as_it_is() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    whole(&path);
    let out = folder.path().join("out.mcap");
    let report = recover(&path, &out).expect("looked at");
    assert!(report.to.is_none() && report.defect.is_none() && report.has_end && report.lost_bytes() == 0);
    assert!(!out.exists());
}

#[test]
fn damage_ends_what_is_kept_and_is_told() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let checkpoints = whole(&path);
    let mut bytes = std::fs::read(&path).expect("read");
    // Within the responses of the eleventh pair.
    bytes[checkpoints[9] as usize + 300] ^= 4;
    std::fs::write(&path, &bytes).expect("written");
    let out = beside(&path);
    assert_eq!(out, folder.path().join("run.recovered.mcap"));
    let report = recover(&path, &out).expect("rebuilt");
    let defect = report.defect.clone().expect("a defect");
    assert!(defect.contains(&format!("at byte {}", checkpoints[9])), "{defect}");
    assert_eq!(report.lost_bytes(), bytes.len() as u64 - checkpoints[9]);
    assert_eq!(pairs(&out)[0], (0..10).collect::<Vec<_>>());
    // Nothing is overwritten.
    assert!(matches!(recover(&path, &out), Err(Error::Exists { .. })));
}

#[test]
fn a_damaged_summary_costs_no_measurement() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    whole(&path);
    let mut bytes = std::fs::read(&path).expect("read");
    let last = bytes.len() - 60;
    bytes[last] ^= 1;
    std::fs::write(&path, &bytes).expect("written");
    let out = beside(&path);
    let report = recover(&path, &out).expect("rebuilt");
    assert!(report.to.is_some() && report.has_end && report.lost_bytes() == 0, "{report:?}");
    assert_eq!(pairs(&out)[0].len(), PAIRS as usize);
}

#[test]
fn what_is_no_run_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap.partial");
    for bytes in [&b""[..], b"\x89MCAP0\r", b"\x89MCAP0\r\n", b"something else altogether", &[0; 100]] {
        std::fs::write(&path, bytes).expect("written");
        let error = recover(&path, &beside(&path)).expect_err("no run").to_string();
        assert!(error.contains("holds no run"), "{error}");
        assert!(matches!(Recorder::resume(&path), Err(Error::Headless { .. })));
    }
}

#[test]
fn a_run_is_gone_on_with_behind_what_is_safe() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let checkpoints = whole(&path);
    let bytes = std::fs::read(&path).expect("read");
    std::fs::remove_file(&path).expect("removed");
    let partial = folder.path().join("run.mcap.partial");
    for cut in [checkpoints[6], checkpoints[6] + 1_500, checkpoints[7] - 1, bytes.len() as u64] {
        std::fs::write(&partial, &bytes[..cut as usize]).expect("written");
        let (mut recorder, held) = Recorder::resume(&partial).expect("gone on with");
        let safe = held.accepted();
        let acknowledged = checkpoints.iter().filter(|c| **c <= cut).count();
        assert!(held.pairs.len() == safe && (safe == acknowledged || safe == acknowledged + 1), "{cut}");
        // Whoever else comes finds it in use.
        assert!(matches!(Recorder::resume(&partial), Err(Error::Busy { .. })));
        for pair in safe as u32..PAIRS {
            attempt(&mut recorder, pair, 1);
        }
        let finished = recorder.finish(&end()).expect("finished");
        assert_eq!(finished, path);
        assert_eq!(prove_file(&path), Ok(()));
        // What stood in the file of pairs without a verdict is not there twice.
        let all: Vec<u32> = (0..PAIRS).collect();
        assert_eq!(pairs(&path), [all.clone(), all], "{cut}");
        let names: Vec<_> =
            std::fs::read_dir(folder.path()).expect("listed").flatten().map(|e| e.file_name()).collect();
        assert_eq!(names, ["run.mcap"], "nothing else is left");
        let held = Held::read(&path).expect("the finished run");
        assert_eq!((held.accepted(), held.attempts), (PAIRS as usize, u64::from(PAIRS)));
        std::fs::remove_file(&path).expect("removed");
    }
}
