//! Files that are cut at any byte, or damaged, are rebuilt from what is whole of them, and nothing else.

use std::path::Path;
use std::slice::from_ref;

use echolake_schema::manifest::RunEnd;
use echolake_schema::messages::{AmbientSample, ImpulseResponse, Measurement, Verdict};
use echolake_schema::{Rig, Timestamp, topics};
use mcap::read::Options;
use prost::Message as _;

use super::*;
use crate::run::recorder::tests::create_flat;
use crate::run::recorder::{Held, PairAttempts, Recorder};

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
    let mut recorder = create_flat(path, &rig, START, Some(BTreeMap::new()));
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
    assert!(report.to.is_none() && report.is_whole() && report.has_end && report.lost_bytes() == 0);
    assert!(!out.exists());
}

#[test]
fn damage_is_skipped_and_told() {
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
    assert!(report.damage.iter().any(|d| d.contains(&format!("at byte {}", checkpoints[9]))), "{:?}", report.damage);
    let [lost] = &report.lost[..] else { panic!("{:?}", report.lost) };
    assert_eq!((lost.start, lost.end < checkpoints[10]), (checkpoints[9], true));
    let all: Vec<u32> = (0..PAIRS).collect();
    let without: Vec<u32> = all.iter().copied().filter(|pair| *pair != 10).collect();
    assert_eq!(pairs(&out), [all, without]);
    // The pair whose response is lost is measured again.
    let held = Held::from_file(&out).expect("a run with a plan");
    assert_eq!(
        (held.accepted_count(), held.pairs[&10]),
        (PAIRS as usize - 1, PairAttempts { attempts: 1, accepted: false })
    );
    // Nothing is overwritten.
    assert!(matches!(recover(&path, &out), Err(Error::Exists { .. })));
}

/// The opcode and range of each record of a whole file.
fn records(bytes: &[u8]) -> Vec<(u8, std::ops::Range<usize>)> {
    let (mut found, mut at) = (Vec::new(), 8);
    while at < bytes.len() - 8 {
        let length = u64::from_le_bytes(bytes[at + 1..at + 9].try_into().expect("eight bytes")) as usize;
        found.push((bytes[at], at..at + 9 + length));
        at += 9 + length;
    }
    found
}

#[test]
fn one_wrong_byte_costs_one_record_whether_the_file_was_closed_or_not() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let checkpoints = whole(&path);
    let bytes = std::fs::read(&path).expect("read");
    let (partial, out) = (folder.path().join("damaged.mcap.partial"), folder.path().join("damaged.mcap"));
    let all: Vec<u32> = (0..PAIRS).collect();
    let data = records(&bytes).into_iter().take_while(|(code, _)| *code != 0x0F);
    let mut chunks = 0;
    // Attachments, and chunks, the first of which describes the channels.
    for (code, range) in data.filter(|(code, _)| matches!(code, 0x06 | 0x09)) {
        chunks += usize::from(code == 0x06);
        for at in [range.start + 2, range.start + 9 + 16, range.end - 20] {
            for size in [bytes.len(), checkpoints[PAIRS as usize - 1] as usize] {
                let mut damaged = bytes[..size].to_vec();
                damaged[at] ^= 1;
                std::fs::write(&partial, &damaged).expect("written");
                let report = recover(&partial, &out).unwrap_or_else(|e| panic!("byte {at} of {code:#04x}: {e}"));
                assert_eq!(
                    report.lost,
                    from_ref(&(range.start as u64..range.end as u64)),
                    "byte {at} of {code:#04x}: {report:?}"
                );
                assert!(!report.damage.is_empty(), "byte {at}");
                assert_eq!(prove_file(&out), Ok(()), "byte {at}");
                let [verdicts, responses] = pairs(&out);
                let lost = 2 * PAIRS as usize - verdicts.len() - responses.len();
                assert_eq!(lost, usize::from(code == 0x06 && chunks > 1), "byte {at}: {verdicts:?} {responses:?}");
                assert!(verdicts.iter().chain(&responses).all(|pair| all.contains(pair)));
                std::fs::remove_file(&out).expect("removed");
            }
        }
    }
}

#[test]
fn a_chunk_that_was_never_closed_costs_itself() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let checkpoints = whole(&path);
    let bytes = std::fs::read(&path).expect("read");
    let partial = folder.path().join("open.mcap.partial");
    for (begin, expected) in [(checkpoints[14] as usize, 15), (checkpoints[3] as usize, 4)] {
        let mut open = bytes[..begin + 400].to_vec();
        open[begin + 1..begin + 9].fill(0xFF);
        open[begin + 9 + 16..begin + 9 + 24].fill(0xFF);
        std::fs::write(&partial, &open).expect("written");
        let (from, to) = (open.len() as u64, begin as u64);
        let report = recover(&partial, &folder.path().join("out.mcap")).expect("rebuilt");
        assert_eq!((report.lost.as_slice(), report.verified_bytes), (from_ref(&(to..from)), to));
        assert_eq!(report.damage, [format!("the file has a chunk that was never closed at byte {to}")]);
        std::fs::remove_file(folder.path().join("out.mcap")).expect("removed");
        let held = Held::from_file(&partial).expect("it can be resumed");
        assert_eq!((held.accepted_count(), held.is_damaged()), (expected, false));
    }
}

#[test]
fn a_file_cut_within_its_summary_or_footer_loses_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    whole(&path);
    let bytes = std::fs::read(&path).expect("read");
    let (_, end) = records(&bytes).into_iter().find(|(code, _)| *code == 0x0F).expect("the data end");
    // A run without its end keeps its name; what becomes of it stands beside it.
    let (cut_off, out) = (folder.path().join("cut.mcap"), folder.path().join("cut.recovered.mcap"));
    for cut in (end.end..bytes.len()).step_by(97).chain([bytes.len() - 9, bytes.len() - 8, bytes.len() - 1]) {
        std::fs::write(&cut_off, &bytes[..cut]).expect("written");
        let report = recover(&cut_off, &beside(&cut_off)).unwrap_or_else(|e| panic!("cut at {cut}: {e}"));
        assert!(report.is_whole() && report.lost_bytes() == 0, "cut at {cut}: {report:?}");
        assert_eq!(pairs(&out)[0].len(), PAIRS as usize);
        std::fs::remove_file(&out).expect("removed");
    }
}

#[test]
fn a_second_file_behind_the_first_is_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    whole(&path);
    let bytes = std::fs::read(&path).expect("read");
    let size = bytes.len() as u64;
    std::fs::write(&path, [&bytes[..], &bytes[..]].concat()).expect("written");
    let report = recover(&path, &beside(&path)).expect("rebuilt");
    assert_eq!(report.lost, from_ref(&(size..2 * size)));
    assert!(report.damage[0].starts_with(&format!("another file begins at byte {size}")), "{:?}", report.damage);
    assert_eq!(pairs(&beside(&path))[0].len(), PAIRS as usize);
}

#[test]
fn a_manifest_that_is_lost_is_named_and_nothing_is_said_of_measurements() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap.partial");
    whole(&folder.path().join("whole.mcap"));
    let mut bytes = std::fs::read(folder.path().join("whole.mcap")).expect("read");
    let is_manifest = |range: &std::ops::Range<usize>| bytes[range.clone()].windows(12).any(|w| w == b"echolake.run");
    let (_, manifest) =
        records(&bytes).into_iter().find(|(code, r)| *code == 0x0C && is_manifest(r)).expect("it is there");
    bytes[manifest.start + 9 + 5] ^= 1;
    std::fs::write(&path, &bytes).expect("written");
    let error = recover(&path, &beside(&path)).expect_err("no run").to_string();
    assert!(error.contains("its manifest is missing or damaged, though"), "{error}");
    assert!(!error.contains("no measurement"), "{error}");
    let error = Recorder::resume_recording(&path).map(|_| ()).expect_err("no run").to_string();
    assert!(error.contains("its manifest is missing or damaged, though"), "{error}");
}

#[test]
fn a_channel_that_is_used_again_for_something_else_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    whole(&path);
    let bytes = std::fs::read(&path).expect("read");
    let (_, last) = records(&bytes).into_iter().rfind(|(code, _)| *code == 0x06).expect("a chunk");
    let mut other = std::io::Cursor::new(Vec::new());
    let mut writer = mcap::Writer::new(&mut other).expect("a writer");
    writer.add_schema_with_id(1, "other", "", b"").expect("added");
    writer.add_channel_with_id(1, 1, "/other", "json", &BTreeMap::new()).expect("added");
    writer.finish().expect("written");
    drop(writer);
    let other = other.into_inner();
    let (_, chunk) = records(&other).into_iter().find(|(code, _)| *code == 0x06).expect("a chunk");
    let spliced = [&bytes[..last.start], &other[chunk], &bytes[last.start..]].concat();
    std::fs::write(&path, spliced).expect("written");
    let error = recover(&path, &beside(&path)).expect_err("refused").to_string();
    assert!(
        error.contains(&format!("the chunk at byte {}: ", last.start)) && error.contains("is used again"),
        "{error}"
    );
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
        assert!(matches!(Recorder::resume_recording(&path), Err(Error::Headless { .. })));
    }
}

#[test]
fn a_run_is_resumed_behind_what_is_safe() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let checkpoints = whole(&path);
    let bytes = std::fs::read(&path).expect("read");
    std::fs::remove_file(&path).expect("removed");
    let partial = folder.path().join("run.mcap.partial");
    for cut in [checkpoints[6], checkpoints[6] + 1_500, checkpoints[7] - 1, bytes.len() as u64] {
        std::fs::write(&partial, &bytes[..cut as usize]).expect("written");
        let (mut recorder, held) = Recorder::resume_recording(&partial).expect("gone on with");
        let safe = held.accepted_count();
        let acknowledged = checkpoints.iter().filter(|c| **c <= cut).count();
        assert!(held.pairs.len() == safe && (safe == acknowledged || safe == acknowledged + 1), "{cut}");
        // Whoever else comes finds it in use.
        assert!(matches!(Recorder::resume_recording(&partial), Err(Error::Busy { .. })));
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
        let held = Held::from_file(&path).expect("the finished run");
        assert_eq!((held.accepted_count(), held.attempts), (PAIRS as usize, u64::from(PAIRS)));
        std::fs::remove_file(&path).expect("removed");
    }
}

#[test]
fn what_is_lost_in_the_middle_is_measured_again() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let checkpoints = whole(&path);
    let mut bytes = std::fs::read(&path).expect("read")[..checkpoints[15] as usize].to_vec();
    std::fs::remove_file(&path).expect("removed");
    let chunks: Vec<_> =
        records(&[&bytes[..], &[0; 8]].concat()).into_iter().filter(|(code, _)| *code == 0x06).collect();
    // The channels; the responses of the first pair; the verdict of the fifth.
    for chunk in [&chunks[0].1, &chunks[1].1, &chunks[10].1] {
        bytes[chunk.end - 30] ^= 8;
    }
    let partial = folder.path().join("run.mcap.partial");
    std::fs::write(&partial, &bytes).expect("written");
    let (mut recorder, held) = Recorder::resume_recording(&partial).expect("resumed");
    assert_eq!((held.accepted_count(), held.is_damaged(), held.lost.len()), (14, true, 2));
    let again: Vec<u32> = (0..PAIRS).filter(|pair| held.pairs.get(pair).is_none_or(|tried| !tried.accepted)).collect();
    assert_eq!(again, [0, 4, 16, 17, 18, 19]);
    for pair in again {
        let number = held.pairs.get(&pair).map_or(1, |tried| tried.attempts + 1);
        attempt(&mut recorder, pair, number);
    }
    recorder.finish(&end()).expect("finished");
    assert_eq!(prove_file(&path), Ok(()));
    let mut found = pairs(&path);
    found.iter_mut().for_each(|pairs| pairs.sort_unstable());
    // The first verdict is there, whose response was lost, and the second.
    let expected: Vec<u32> = (0..PAIRS).collect();
    assert_eq!(found, [[&[0], &expected[..]].concat(), expected]);
}
