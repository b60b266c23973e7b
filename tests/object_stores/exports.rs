//! `export` to a bucket: all data first, then the checksums that say that they are there.

use echolake_testing::run_command;

use super::super::TestFolder;
use super::{S3Double, StoreBehaviour, command, ok, recordings, stderr};

const CHECKSUMS: &str = "SHA256SUMS";

mod slow {
    use super::*;

    #[test]
    fn a_slice_in_a_bucket_is_one_object() {
        let place = TestFolder::new();
        let store = S3Double::start(StoreBehaviour::Unreliable(3));
        let runs = recordings(&place, &["flat"]);
        ok(&place, &store, &["ingest", &runs[0]]);
        let slice = ["export", "mcap", "--where", "pair_id < 5", "-o"];
        ok(&place, &store, &[&slice[..], &["slice.mcap"]].concat());
        ok(&place, &store, &[&slice[..], &["s3://bucket/slices/five.mcap"]].concat());
        assert!(store.get("slices/five.mcap") == std::fs::read(place.path("slice.mcap")).expect("read"));
        for (target, expected) in [
            ("s3://bucket/slices/five.mcap", "is there already"),
            ("s3://bucket", "names no object"),
            ("ftp://host/five.mcap", "hint: name a path, or s3://bucket/prefix/name"),
        ] {
            let output =
                run_command(&mut command(&place, &store, &[&slice[..], &[target]].concat())).expect("it starts");
            assert!(!output.status.success() && stderr(&output).contains(expected), "{target}: {}", stderr(&output));
        }
    }

    #[test]
    fn an_export_to_a_bucket_is_that_to_a_folder_and_ends_with_its_checksums() {
        let place = TestFolder::new();
        let store = S3Double::start(StoreBehaviour::Faultless);
        let runs = recordings(&place, &["flat", "foam", "brick"]);
        ok(&place, &store, &["ingest", &runs[0], &runs[1], &runs[2]]);
        for (kind, more) in [("npz", &[][..]), ("sofa", &[]), ("ml", &["--split", "none"])] {
            let local = format!("local.{kind}");
            ok(&place, &store, &[&["export", kind, "-o", &local], more].concat());
            store.take_requests();
            let target = format!("s3://bucket/exports/{kind}");
            ok(&place, &store, &[&["export", kind, "-o", &target], more].concat());
            let created: Vec<_> = store.take_requests().into_iter().filter(|line| line.starts_with("PUT ")).collect();
            assert!(created.last().is_some_and(|line| line.contains(CHECKSUMS)), "{kind}: {created:?}");

            let there = |name: &str| store.get(&format!("exports/{kind}/{name}"));
            let checksums = String::from_utf8(there(CHECKSUMS)).expect("text");
            let names: Vec<_> = checksums.lines().map(|line| line.split_once("  ").expect("a digest").1).collect();
            assert!(names.len() >= 3, "{kind}: {checksums}");
            for name in &names {
                assert!(there(name) == std::fs::read(place.path(&local).join(name)).expect("read"), "{kind}: {name}");
            }
            let count = store.keys().iter().filter(|key| key.starts_with(&format!("exports/{kind}/"))).count();
            assert_eq!(count, names.len() + 1, "{kind}: all but the checksums are in them");

            let output = run_command(&mut command(&place, &store, &[&["export", kind, "-o", &target], more].concat()));
            let output = output.expect("it starts");
            let said = stderr(&output);
            assert_eq!(output.status.code(), Some(1), "{kind}: {said}");
            assert!(said.contains(&format!("`{target}` is there already; hint: ")), "{kind}: {said}");
        }
    }
}
