//! Recordings that are damaged, recovered and resumed: what is whole is kept, what is lost is named with its place.

use std::path::{Path, PathBuf};
use std::process::Command;

use super::web::{or_skip, run};
use super::{ECHOLAKE, TestFolder, stderr};

/// Runs of this test have a checkpoint every five pairs.
const FEW_PAIRS: [&str; 3] = ["--ir-only", "--checkpoint-every", "5"];
const MCAP: &str = "mcap==1.3.1";

/// The ranges of a whole file's chunks.
fn chunks_of(file: &[u8]) -> Vec<std::ops::Range<usize>> {
    let (mut found, mut at) = (Vec::new(), 8);
    while at < file.len() - 8 {
        let length = u64::from_le_bytes(file[at + 1..at + 9].try_into().expect("eight bytes")) as usize;
        found.extend((file[at] == 6).then_some(at..at + 9 + length));
        at += 9 + length;
    }
    found
}

#[test]
fn damage_is_named_with_its_place_and_what_was_lost_is_measured_again() {
    let place = TestFolder::new();
    let path = place.acquire("flat", &FEW_PAIRS);
    let mut bytes = std::fs::read(&path).expect("read");
    std::fs::remove_file(&path).expect("removed");
    let partial = path.with_extension("mcap.partial");
    let name = partial.to_str().expect("a name");
    let chunks = chunks_of(&bytes);
    let damaged = &chunks[4];
    bytes[damaged.end - 9] ^= 1;
    bytes.truncate(chunks.last().expect("chunks").start + 100);
    std::fs::write(&partial, &bytes).expect("written");
    let output = place.run(&["recover", name, "-o", "out.mcap"]);
    let said = stderr(&output);
    let last = chunks.last().expect("chunks").start;
    let lost = format!("bytes, at {}..{}, {last}..{}", damaged.start, damaged.end, bytes.len());
    assert_eq!(output.status.code(), Some(3), "{said}");
    // What the flipped bit breaks depends on the run's name and time.
    let faults =
        ["its CRC", "it does not decompress"].map(|fault| format!("the chunk at byte {}: {fault}", damaged.start));
    assert!(said.contains(&lost) && faults.iter().any(|fault| said.contains(fault)), "{said}");
    let output = place.run(&["acquire", "--resume", name, "--skip-checks"]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(3), "{said}");
    assert!(said.contains(&format!("damage: the chunk at byte {}", damaged.start)), "{said}");
    place.ok(&["ingest"]);
    assert_eq!(place.number("select count(*) from measurements"), 45.0);
}

#[test]
fn a_file_that_lost_its_end_in_the_inbox_becomes_a_run_by_recover() {
    let place = TestFolder::new();
    let path = place.acquire("flat", &FEW_PAIRS);
    let bytes = std::fs::read(&path).expect("read");
    std::fs::write(&path, &bytes[..bytes.len() - 30]).expect("written");
    let name = path.to_str().expect("a name");
    let recovered = place.ok(&["recover", name]);
    assert_eq!(Path::new(recovered.trim()), path.with_extension("recovered.mcap"));
    std::fs::remove_file(&path).expect("removed");
    place.ok(&["ingest"]);
    assert_eq!(place.number("select count(*) from measurements"), 45.0);
}

#[test]
fn a_second_file_behind_the_first_is_named_by_every_command() {
    let place = TestFolder::new();
    let runs = ["flat", "foam"].map(|surface| place.acquire(surface, &FEW_PAIRS));
    let [flat, foam] = runs.each_ref().map(|path| std::fs::read(path).expect("read"));
    std::fs::write(&runs[0], [&flat[..], &foam].concat()).expect("written");
    std::fs::remove_file(&runs[1]).expect("removed");
    let expected = format!("another file begins at byte {}", flat.len());
    let name = runs[0].to_str().expect("a name");
    place.fails(3, &["recover", name, "-o", "out.mcap"], &expected);
    let file = runs[0].file_name().expect("a name").to_string_lossy().into_owned();
    let sql = format!("select count(*) from mcap_messages('inbox/{file}')");
    place.fails(1, &["sql", &sql], "another file");
    place.fails(3, &["ingest"], &expected);
    assert_eq!(place.number("select count(*) from measurements"), 45.0);
    assert_eq!(place.number("select count(*) from measurements where surface_id = 'flat'"), 45.0);
    let found = place.run(&["doctor"]);
    let said = String::from_utf8_lossy(&found.stdout);
    assert!(found.status.code() == Some(3) && said.contains(&expected), "{said}");
}

/// A Python with the MCAP project's own reader.
pub(crate) fn python_with_mcap() -> Result<PathBuf, String> {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("python-mcap");
    let python = folder.join("bin/python");
    if !folder.join("bin/pip").exists() {
        run(Command::new("python3").args(["-m", "venv"]).arg(&folder))?;
    }
    run(Command::new(&python).args(["-m", "pip", "install", "--quiet", MCAP]))?;
    Ok(python)
}

mod slow {
    use super::*;

    // The long form: `tests/clients/compare_recover.py RUN.mcap` has 500 rounds.
    #[test]
    fn recover_keeps_all_that_pythons_mcap_accepts() {
        let Some(python) = or_skip("recover beside Python's mcap", python_with_mcap()) else { return };
        let place = TestFolder::new();
        let run_file = place.acquire("flat", &FEW_PAIRS);
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/clients/compare_recover.py");
        let mut compare = Command::new(python);
        compare.arg(script).arg(run_file).args([ECHOLAKE, "--rounds", "40", "--seed", "1"]);
        let said = run(&mut compare).unwrap_or_else(|why| panic!("{why}"));
        assert!(said.contains("in part: ") && said.contains("40 of 40 rounds are right"), "{said}");
    }
}
