//! `demo --surfaces N`: a collection as large as is wanted, stopped and resumed, the same for the same seed.

use std::collections::{BTreeMap, BTreeSet};

use super::TestFolder;

const PAIRS: f64 = 45.0;

fn demo<'a>(surfaces: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    [&["demo", "--surfaces", surfaces, "--ir-only", "--no-serve", "--rig", "rig.toml"], more].concat()
}

/// The runs that wait, by the names of their surfaces.
fn inbox(place: &TestFolder) -> BTreeMap<String, Vec<u8>> {
    let files = std::fs::read_dir(place.path("lake/inbox")).expect("the inbox");
    let named = files.map(|entry| {
        let path = entry.expect("an entry").path();
        let name = path.file_name().expect("a name").to_string_lossy().into_owned();
        let surface = name.split('-').nth(1).expect("<start>-<surface>-<tag>.mcap").to_owned();
        assert!(name.ends_with(".mcap"), "{name}");
        (surface, std::fs::read(path).expect("a run"))
    });
    named.collect()
}

/// Topic, time and content of all messages.
fn messages(run: &[u8]) -> Vec<(String, u64, Vec<u8>)> {
    let stream = mcap::MessageStream::new(run).expect("an MCAP file").map(|m| m.expect("whole"));
    stream.map(|m| (m.channel.topic.clone(), m.log_time, m.data.to_vec())).collect()
}

mod slow {
    use super::*;

    #[test]
    fn a_collection_is_measured_once_and_ingested() {
        let place = TestFolder::new();
        place.ok(&demo("5", &["--no-ingest"]));
        let first = inbox(&place);
        let names: Vec<_> = first.keys().map(String::as_str).collect();
        assert_eq!(names, ["0001_0", "0001_1", "flat", "foam", "wood"]);
        for (surface, run) in &first {
            let summary = mcap::Summary::read(run).expect("a summary").expect("a summary");
            let counts = summary.stats.as_ref().expect("statistics").channel_message_counts.clone();
            let count = |topic: &str| {
                let channel = summary.channels.values().find(|c| c.topic == topic).expect(topic);
                counts.get(&channel.id).copied().unwrap_or(0)
            };
            assert_eq!((count("/sweep"), count("/sweep/audio")), (0, 0), "{surface}");
            assert!(count("/ir") >= PAIRS as u64 && count("/ir") == count("/measurement"), "{surface}");
        }

        // Killed in the middle: a run that is missing is measured again as it was, under another name, and the others
        // are left alone.
        let lost = std::fs::read_dir(place.path("lake/inbox")).expect("the inbox").map(|e| e.expect("an entry").path());
        let lost = lost.into_iter().find(|p| p.to_string_lossy().contains("0001_1")).expect("a run");
        std::fs::rename(&lost, lost.with_extension("mcap.partial")).expect("renamed");
        place.ok(&demo("5", &["--no-ingest"]));
        let again = inbox(&place);
        assert!(first.iter().all(|(surface, run)| (again[surface] == *run) == (surface != "0001_1")));
        assert!(!lost.exists() && messages(&again["0001_1"]) == messages(&first["0001_1"]));

        // A larger collection begins with the smaller one.
        let printed = place.ok(&demo("7", &[]));
        assert_eq!(place.number("select count(*) from measurements"), 7.0 * PAIRS);
        assert_eq!(place.number("select count(*) from tnce"), 7.0 * PAIRS);
        let rows = place.sql("select surface_id, typology, panel, side from surfaces where origin = 'simulated'");
        let typologies: BTreeSet<_> = rows.iter().map(|r| r["typology"].as_str().expect("text")).collect();
        assert_eq!(typologies.len(), 5, "those of four walls, and the references': {typologies:?}");
        let kinds = typologies.iter().filter(|kind| **kind != "reference").chain(&["flat", "foam", "wood"]);
        kinds.for_each(|kind| assert!(printed.contains(kind), "{kind}: {printed}"));
        let side = rows.iter().find(|r| r["surface_id"] == "0002_1").expect("the second panel's other side");
        assert_eq!((&side["panel"], &side["side"]), (&"0002".into(), &1.into()));

        // What is in the lake is not measured again.
        let runs = "select count(*) from runs";
        place.ok(&demo("7", &[]));
        assert_eq!(place.number(runs), 7.0);
        assert!(inbox(&place).is_empty());
    }

    #[test]
    fn another_seed_is_another_collection() {
        let place = TestFolder::new();
        place.ok(&demo("4", &["--no-ingest"]));
        place.ok(&demo("4", &["--no-ingest", "--seed", "2"]));
        let runs = std::fs::read_dir(place.path("lake/inbox")).expect("the inbox").count();
        assert_eq!(runs, 8, "none is taken for one of the other seed");
        place.fails(2, &demo("0", &[]), "0 is not in 1..=20001");
        place.fails(2, &demo("20002", &[]), "20002 is not in 1..=20001");
    }
}
