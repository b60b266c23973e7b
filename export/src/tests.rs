//! Exports of a small lake that the simulated rig has measured: what goes out is what was recorded, and nothing else.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::path::Path;
use std::sync::Arc;

use arrow::array::AsArray as _;
use arrow::datatypes::{Float32Type, Int32Type, Int64Type};
use arrow::record_batch::RecordBatch;
use echolake_acquisition::run::controller::RecordingMode;
use echolake_import::{ImportOptions, import_gir, import_wav};
use echolake_ingest::{LakeIngest, pending_runs};
use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_schema::{Rig, RunId, Table, Timestamp, topics};
use echolake_testing::{SMALL_RIG, simulate_run};
use futures::TryStreamExt as _;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use tempfile::TempDir;

use crate::*;

const SURFACES: [&str; 6] = ["flat", "foam", "0001_0", "0001_1", "0002_0", "0003_0"];

async fn lake(home: &TempDir, keep: RecordingMode) -> Lake {
    let relief = |surface: &'static str| if surface.starts_with('f') { surface } else { "macrostructure" };
    lake_of(home, keep, &SURFACES.map(|surface| (surface, relief(surface)))).await
}

/// A lake of surfaces with the reliefs that they have.
async fn lake_of(home: &TempDir, keep: RecordingMode, surfaces: &[(&str, &str)]) -> Lake {
    let rig = Rig::from_toml(SMALL_RIG).expect("a rig");
    let url = home.path().join("lake").display().to_string();
    let lake = Lake::open_or_create(&url, &rig, &ReferenceSurfaces::default()).await.expect("a lake");
    let inbox = home.path().join("lake/inbox");
    std::fs::create_dir_all(&inbox).expect("a folder");
    for (number, (surface, relief)) in surfaces.iter().enumerate() {
        simulate_run(&inbox, number, surface, relief, keep);
    }
    let ingest = LakeIngest::new(&lake, Arc::default());
    ingest.ingest_runs(pending_runs(&lake).await.expect("runs"), &mut |_| {}).await.expect("ingested");
    ingest.complete_runs(&mut |_, _| {}).await.expect("derived");
    lake
}

/// All measurements of some surfaces.
async fn measurements(lake: &Lake, surfaces: &[&str]) -> Vec<Taken> {
    let snapshot = lake.snapshot().await.expect("a view");
    let mut taken = Vec::new();
    for run in snapshot.runs().filter(|r| surfaces.contains(&r.surface.as_str())) {
        let columns = ["pair_id", "log_time_ns", "attempt"];
        let batch = rows::of_run(lake, &snapshot, Table::Measurements, &run.run, &columns).await.expect("rows");
        let number = |column: usize, row| batch.column(column).as_primitive::<Int32Type>().value(row) as u32;
        taken.extend((0..batch.num_rows()).map(|row| Taken {
            run: run.run.clone(),
            pair: number(0, row),
            attempt: number(2, row),
            log_time_ns: batch.column(1).as_primitive::<Int64Type>().value(row),
        }));
    }
    taken
}

async fn cut(lake: &Lake, params: SliceParams) -> Result<Vec<u8>> {
    let snapshot = lake.snapshot().await.expect("a view");
    let slice = Slice::open(lake, &snapshot, params).await?;
    Ok(slice.into_stream().try_collect::<Vec<_>>().await?.concat())
}

fn run_file(lake: &Lake, run: &RunId) -> std::path::PathBuf {
    let surface = run.as_str().split('-').nth(1).expect("a surface");
    lake.folder().expect("a folder").join(format!("runs/{surface}/{run}.mcap"))
}

/// Topic, time and content of every message, in the file's order.
fn messages(file: &[u8]) -> Vec<(String, u64, Vec<u8>)> {
    let stream = mcap::MessageStream::new(file).expect("an MCAP file");
    stream.map(|m| m.expect("whole")).map(|m| (m.channel.topic.clone(), m.log_time, m.data.to_vec())).collect()
}

fn set(symmetries: RowSymmetries) -> TrainingSet {
    TrainingSet { symmetries, ..TrainingSet::default() }
}

fn rows(path: &Path) -> Vec<RecordBatch> {
    let file = std::fs::File::open(path).expect("a file");
    let reader = ParquetRecordBatchReaderBuilder::try_new(file).expect("Parquet").build().expect("a reader");
    reader.map(|batch| batch.expect("rows")).collect()
}

fn content(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut files = BTreeMap::new();
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        let name = path.file_name().expect("a name").to_string_lossy().into_owned();
        if path.is_dir() {
            files.extend(content(&path).into_iter().map(|(inner, bytes)| (format!("{name}/{inner}"), bytes)));
        } else {
            files.insert(name, std::fs::read(&path).expect("content"));
        }
    }
    files
}

mod slow {
    use super::*;

    #[tokio::test(flavor = "multi_thread")]
    async fn a_slice_has_the_messages_of_its_measurements_and_no_others() {
        let home = tempfile::tempdir().expect("a folder");
        let lake = lake(&home, RecordingMode::Sweeps).await;
        let all = measurements(&lake, &["0001_0", "0002_0"]).await;
        let some: Vec<_> = all.iter().filter(|t| t.pair % 5 == 2).cloned().collect();
        let times: HashSet<u64> = some.iter().map(|t| t.log_time_ns as u64).collect();
        let mut expected: BTreeMap<(u64, String), Vec<Vec<u8>>> = BTreeMap::new();
        let runs: BTreeSet<_> = some.iter().map(|t| t.run.clone()).collect();
        // Both are of one panel, which is in the slice as the first of them has it.
        let mut panel = BTreeSet::new();
        let once = [topics::PANEL_SCENE, topics::PANEL_POINTS, topics::ROBOT_DESCRIPTION];
        for run in &runs {
            for (topic, time, data) in messages(&std::fs::read(run_file(&lake, run)).expect("the run")) {
                // Air is read a moment later than its measurement begins, and the log's lines are few: both by count
                // below.
                if topic != topics::LOG
                    && topic != topics::ENVIRONMENT
                    && (times.contains(&time) || once.contains(&topic.as_str()))
                    && (!once.contains(&topic.as_str()) || panel.insert(topic.clone()))
                {
                    expected.entry((time, topic)).or_default().push(data);
                }
            }
        }
        let snapshot = lake.snapshot().await.expect("a view");
        let params = SliceParams { taken: some.clone(), ..SliceParams::default() };
        let looked_over = outline_slice(&lake, &snapshot, params).await.expect("an outline");
        for layout in [Layout::InTime, Layout::ByTopic] {
            let file = cut(&lake, SliceParams { taken: some.clone(), layout, ..SliceParams::default() })
                .await
                .expect("a slice");
            let mut found: BTreeMap<(u64, String), Vec<Vec<u8>>> = BTreeMap::new();
            let (mut last, mut air, mut named) = (0, 0, BTreeSet::new());
            for (topic, time, data) in messages(&file) {
                named.insert(topic.clone());
                assert!((looked_over.start_ns as u64..=looked_over.end_ns as u64).contains(&time), "{topic} at {time}");
                assert!(layout == Layout::ByTopic || time >= last, "{topic} at {time} after {last}");
                last = time;
                air += usize::from(topic == topics::ENVIRONMENT);
                if topic != topics::LOG && topic != topics::ENVIRONMENT {
                    found.entry((time, topic)).or_default().push(data);
                }
            }
            assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>(), "{layout:?}");
            assert!(found == expected, "contents differ, {layout:?}");
            assert_eq!(air, some.len(), "{layout:?}");
            let told: BTreeSet<_> = looked_over.topics.iter().map(|t| t.name.clone()).collect();
            assert!(told.is_superset(&named) && told.len() == looked_over.topics.len(), "{told:?} {named:?}");
            let summary = mcap::Summary::read(&file).expect("sound").expect("a summary");
            let attached: BTreeSet<_> = summary.attachment_indexes.iter().map(|a| a.name.clone()).collect();
            let first = runs.first().expect("a run");
            let own = ["rig.toml", "surface.json", "panel.glb", "heights.f32"].map(|name| format!("{first}/{name}"));
            assert_eq!(attached, own.into_iter().collect(), "those of the second run are the same");
            let described = summary.metadata_indexes.iter().filter(|m| m.name == "echolake.slice.run");
            let described: Vec<_> =
                described.map(|index| mcap::read::metadata(&file, index).expect("metadata").metadata).collect();
            let mesh = |run: &BTreeMap<String, String>| run.get("attachment.panel.glb").cloned();
            assert_eq!(described.iter().map(mesh).collect::<Vec<_>>(), [None, Some(format!("{first}/panel.glb"))]);
            assert!(summary.metadata_indexes.iter().all(|m| m.name != topics::RUN_METADATA), "a slice is no run");
            if layout == Layout::ByTopic {
                for chunk in &summary.chunk_indexes {
                    let of: Vec<_> =
                        chunk.message_index_offsets.keys().map(|id| summary.channels[id].topic.as_str()).collect();
                    let heavy = [topics::SWEEP, topics::SWEEP_AUDIO];
                    assert!(
                        !of.contains(&heavy[0]) || of.iter().all(|t| heavy.contains(t)),
                        "sweeps share a chunk: {of:?}"
                    );
                }
            }
        }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_training_set_is_repeatable_and_leaks_nothing() {
        let home = tempfile::tempdir().expect("a folder");
        let lake = lake(&home, RecordingMode::ResponsesOnly).await;
        let folders = [home.path().join("a"), home.path().join("b")];
        let mut exported = Vec::new();
        for folder in &folders {
            exported.push(
                write_training_set(&lake, folder, &set(RowSymmetries::All), &mut |_, _| {}).await.expect("written"),
            );
        }
        let (files, again) = (content(&folders[0]), content(&folders[1]));
        assert!(files == again, "the same lake gives the same bytes");
        assert_eq!(exported[0].parts.iter().map(|p| p.surfaces).sum::<usize>(), SURFACES.len() - 2);
        assert_eq!(exported[0].references.iter().map(|s| s.as_str()).collect::<Vec<_>>(), ["flat", "foam"]);
        let statistics: serde_json::Value = serde_json::from_slice(&files["statistics.json"]).expect("JSON");
        let train =
            files.keys().filter(|name| name.starts_with("data/train-")).flat_map(|name| rows(&folders[0].join(name)));
        let levels: Vec<f64> = train
            .flat_map(|batch| {
                let column = batch.column_by_name("tnce_total").expect("a column");
                column.as_primitive::<Float32Type>().values().iter().map(|x| f64::from(*x)).collect::<Vec<_>>()
            })
            .collect();
        let mean = levels.iter().sum::<f64>() / levels.len() as f64;
        let variance = levels.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / levels.len() as f64;
        let told = &statistics["columns"]["tnce_total"];
        assert_eq!(told["values"], levels.len());
        assert!((told["mean"].as_f64().expect("a number") - mean).abs() < 1e-9, "{told} {mean}");
        assert!((told["standard_deviation"].as_f64().expect("a number") - variance.sqrt()).abs() < 1e-9, "{told}");
        assert_eq!(statistics["columns"]["microphone_mm"]["mean"].as_array().map(Vec::len), Some(3));
        assert!(statistics["columns"]["heights_mm"]["standard_deviation"].as_f64() > Some(0.0));
        let mut split_of: HashMap<String, HashSet<String>> = HashMap::new();
        let mut counted: HashMap<String, u64> = HashMap::new();
        let mut maps: HashSet<(String, String)> = HashSet::new();
        let mut joined: HashSet<(String, String)> = HashSet::new();
        for name in files.keys().filter(|name| name.ends_with(".parquet")) {
            for batch in rows(&folders[0].join(name)) {
                let text = |column: &str| batch.column_by_name(column).expect("a column").as_string::<i32>().clone();
                let (groups, splits, surfaces, symmetries) =
                    (text("group"), text("split"), text("surface_id"), text("symmetry"));
                for row in 0..batch.num_rows() {
                    split_of.entry(groups.value(row).into()).or_default().insert(splits.value(row).into());
                    let key = (surfaces.value(row).to_owned(), symmetries.value(row).to_owned());
                    if name.starts_with("data") {
                        *counted.entry(splits.value(row).into()).or_default() += 1;
                        joined.insert(key);
                    } else {
                        maps.insert(key);
                    }
                }
            }
        }
        assert!(split_of.values().all(|splits| splits.len() == 1), "{split_of:?}");
        assert_eq!(joined, maps, "each surface and symmetry has its height map");
        for part in &exported[0].parts {
            assert_eq!(counted[part.part.name()], part.rows);
        }
        let card = String::from_utf8(files["README.md"].clone()).expect("text");
        assert!(
            card.contains("10.1177/1351010X20986901") && card.contains("seed 1") && card.contains("simulated"),
            "{card}"
        );
        assert!(card.contains("\nlicense: unknown\n") && card.contains("--columns reflected_ir,"), "{card}");
        assert!(card.contains("no rows of this set") && card.contains("size_categories:\n- "), "{card}");
        let version = lake.snapshot().await.expect("a snapshot").lake_version().expect("a version");
        assert!(version > 0 && card.contains(&format!("of the lake as `runs@{version}` has it")), "{card}");
        let croissant: serde_json::Value = serde_json::from_slice(&files["croissant.json"]).expect("JSON");
        assert_eq!(croissant["version"], format!("1.{version}.0"));
        let description = croissant["description"].as_str().expect("a text");
        assert!(description.contains(&format!("Lake: runs@{version}, echolake ")), "{description}");
        let asked = TrainingSet { references: true, license: Some("cc-by-4.0".into()), ..TrainingSet::default() };
        let folder = home.path().join("with");
        let all = write_training_set(&lake, &folder, &asked, &mut |_, _| {}).await.expect("written");
        assert_eq!(all.parts.iter().map(|p| p.surfaces).sum::<usize>(), SURFACES.len());
        let read = |name: &str| std::fs::read_to_string(folder.join(name)).expect("a document");
        assert!(read("README.md").contains("\nlicense: cc-by-4.0\n") && !read("README.md").contains("unknown"));
        assert!(read("README.md").contains("References are among the rows"));
        assert!(read("croissant.json").contains("\"license\": \"cc-by-4.0\""));
        assert!(read("surfaces.csv").lines().filter(|l| l.contains("foam")).all(|l| l.contains(",train,")));
        let selected = ["0001_0", "0001_1"].map(|name| name.parse().expect("an id")).into();
        let selection = SurfaceSelection { predicate: "surface_id like '0001%'".into(), surfaces: selected };
        let split = SplitParams { by: SplitBy::Nothing, ..SplitParams::default() };
        let asked = TrainingSet { selection: Some(selection), split, ..TrainingSet::default() };
        let folder = home.path().join("selected");
        let some = write_training_set(&lake, &folder, &asked, &mut |_, _| {}).await.expect("written");
        assert_eq!(some.parts.iter().map(|p| p.surfaces).sum::<usize>(), 2);
        let card = std::fs::read_to_string(folder.join("README.md")).expect("a card");
        assert!(card.contains("Surfaces were selected by `surface_id like '0001%'`."), "{card}");
        let sums = String::from_utf8(files["SHA256SUMS"].clone()).expect("text");
        assert_eq!(sums.lines().count(), files.len() - 1);
    }

    /// E31: a panel with a reference is trained on, whether or not the reference is a row.
    #[tokio::test(flavor = "multi_thread")]
    async fn a_panel_has_one_part_with_references_and_without() {
        let home = tempfile::tempdir().expect("a folder");
        let reliefs = [("flat", "flat"), ("foam", "foam"), ("0003_1", "flat")];
        let others = ["0001_0", "0002_0", "0003_0"].map(|surface| (surface, "macrostructure"));
        let lake = lake_of(&home, RecordingMode::ResponsesOnly, &[reliefs, others].concat()).await;
        for references in [false, true] {
            // Of this seed the digest of 0003 is the first.
            let split = SplitParams { seed: 4, ..SplitParams::default() };
            let set = TrainingSet { references, split, ..TrainingSet::default() };
            let folder = home.path().join(references.to_string());
            write_training_set(&lake, &folder, &set, &mut |_, _| {}).await.expect("written");
            let sources = std::fs::read_to_string(folder.join("surfaces.csv")).expect("a document");
            let of = |surface: &str| sources.lines().find(|line| line.starts_with(surface)).map(str::to_owned);
            assert!(of("0003_0").is_some_and(|line| line.contains(",0003,train,")), "{sources}");
            assert_eq!(of("0003_1").is_some(), references, "{sources}");
        }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_run_file_that_is_not_the_ingested_one_is_refused() {
        let home = tempfile::tempdir().expect("a folder");
        let lake = lake(&home, RecordingMode::ResponsesOnly).await;
        let taken = measurements(&lake, &["0003_0"]).await;
        let path = run_file(&lake, &taken[0].run);
        let original = std::fs::read(&path).expect("the run");
        let refusal = async |content: Option<&[u8]>| {
            match content {
                Some(bytes) => std::fs::write(&path, bytes).expect("written"),
                None => std::fs::remove_file(&path).expect("removed"),
            }
            let error =
                cut(&lake, SliceParams { taken: taken.clone(), ..SliceParams::default() }).await.expect_err("changed");
            assert!(matches!(error, Error::Changed { .. }), "{error}");
            error.to_string()
        };
        let mut flipped = original.clone();
        let middle = flipped.len() / 2;
        flipped[middle] ^= 1;
        assert!(refusal(Some(&flipped)).await.contains("its SHA-256 is"));
        assert!(refusal(Some(&original[..middle])).await.contains("bytes, expected"));
        assert!(refusal(None).await.contains("was it moved?"));
        std::fs::write(&path, &original).expect("brought back");
        assert!(cut(&lake, SliceParams { taken, ..SliceParams::default() }).await.is_ok());
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn recordings_and_responses_come_back() {
        let home = tempfile::tempdir().expect("a folder");
        let lake = lake(&home, RecordingMode::Sweeps).await;
        let taken = measurements(&lake, &["0001_0"]).await;
        let wav = home.path().join("wav");
        let count = write_wav(&lake, &wav, &taken, Check::Whole, &mut |_, _| {}).await.expect("written");
        assert_eq!(count, taken.len());
        let again = home.path().join("again");
        std::fs::create_dir(&again).expect("a folder");
        let options = ImportOptions { started: Timestamp(0), folder: &again, project: None };
        let runs = import_wav(&wav.join("manifest.csv"), lake.rig(), options, &mut |_, _| {}).expect("imported");
        let sweeps = |file: Vec<u8>| -> Vec<(u64, f64, Vec<f32>)> {
            use echolake_schema::messages::SweepRecording;
            use prost::Message as _;
            let decoded =
                messages(&file).into_iter().filter(|(topic, ..)| topic == topics::SWEEP).map(|(_, time, data)| {
                    let sweep = SweepRecording::decode(data.as_slice()).expect("a sweep");
                    let mut samples = vec![0.0; 2 * sweep.sample_count as usize];
                    let (microphone, loopback) = samples.split_at_mut(sweep.sample_count as usize);
                    echolake_schema::samples::decode_samples(sweep.format(), &sweep.microphone, microphone)
                        .expect("samples");
                    echolake_schema::samples::decode_samples(sweep.format(), &sweep.loopback, loopback)
                        .expect("samples");
                    (time, sweep.temperature_c, samples)
                });
            decoded.collect()
        };
        let accepted: HashSet<u64> = taken.iter().map(|t| t.log_time_ns as u64).collect();
        let mut original = sweeps(std::fs::read(run_file(&lake, &taken[0].run)).expect("the run"));
        original.retain(|(time, ..)| accepted.contains(time));
        assert!(original == sweeps(std::fs::read(&runs[0].path).expect("the import")), "the same recordings");
        let npz = home.path().join("npz");
        let surface = ["0001_0".parse().expect("an id")];
        write_responses(&lake, &npz, ResponseFormat::Npz, &surface, &mut |_, _| {}).await.expect("written");
        let runs = import_gir(&npz, lake.rig(), options, &mut |_, _| {}).expect("imported");
        assert_eq!(runs[0].measurements, taken.len());
        let sofa = home.path().join("sofa");
        let files = write_responses(&lake, &sofa, ResponseFormat::Sofa, &[], &mut |_, _| {}).await.expect("written");
        assert_eq!(files.len(), SURFACES.len());
        let (unknown, x) = (["nope".parse().expect("an id")], home.path().join("x"));
        let error =
            write_responses(&lake, &x, ResponseFormat::Sofa, &unknown, &mut |_, _| {}).await.expect_err("unknown");
        assert!(error.to_string().contains("no surface `nope`"), "{error}");
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_training_set_that_fails_leaves_nothing() {
        let home = tempfile::tempdir().expect("a folder");
        let lake = lake(&home, RecordingMode::ResponsesOnly).await;
        let folder = home.path().join("set");
        let failed = async |set: &TrainingSet| {
            write_training_set(&lake, &folder, set, &mut |_, _| {}).await.expect_err("fails").to_string()
        };
        let columns = TrainingSet { columns: vec!["nope".into()], ..TrainingSet::default() };
        assert!(failed(&columns).await.contains("no column `nope`"));
        let by = TrainingSet {
            split: SplitParams { by: SplitBy::Macrostructure, ..SplitParams::default() },
            ..TrainingSet::default()
        };
        assert!(failed(&by).await.contains("by-macrostructure"));
        // The larger file of the lake, which is not that of the references, is damaged: the export breaks off half-way.
        let measurements = home.path().join("lake/tables/tnce");
        let victim = std::fs::read_dir(measurements)
            .expect("a table")
            .map(|e| e.expect("an entry").path())
            .filter(|p| p.extension().is_some_and(|kind| kind == "parquet"))
            .max_by_key(|p| std::fs::metadata(p).expect("a file").len());
        let victim = victim.expect("a file");
        std::fs::write(&victim, b"PAR1").expect("damaged");
        let error = failed(&TrainingSet::default()).await;
        assert!(error.contains("is damaged"), "{error}");
        let left: Vec<_> =
            std::fs::read_dir(home.path()).expect("listed").map(|e| e.expect("an entry").file_name()).collect();
        assert_eq!(left, ["lake"]);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_slice_of_few_topics_has_only_these() {
        let home = tempfile::tempdir().expect("a folder");
        let lake = lake(&home, RecordingMode::Sweeps).await;
        let taken = measurements(&lake, &["0001_0"]).await;
        let params =
            |topic: &str| SliceParams { taken: taken.clone(), topics: vec![topic.into()], ..SliceParams::default() };
        let poses = cut(&lake, params(topics::MICROPHONE_POSE)).await.expect("a slice");
        let found = messages(&poses);
        assert_eq!(found.len(), taken.len());
        assert!(found.iter().all(|(topic, ..)| topic == topics::MICROPHONE_POSE));
        let unknown = cut(&lake, params("/nope")).await.expect_err("unknown").to_string();
        assert!(unknown.contains("no topic `/nope`") && unknown.contains("/microphone/pose"), "{unknown}");
        let nothing = cut(&lake, SliceParams::default()).await.expect_err("nothing").to_string();
        assert!(nothing.contains("no measurement is selected"), "{nothing}");
    }
}
