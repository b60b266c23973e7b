use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use echolake_schema::Rig;
use echolake_testing::{RequestFate, RequestKind, StoreBehaviour, StoreDouble};
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _};
use serde_json::json;

use super::*;
use crate::{EncodedFile, LakeMoment, ReferenceSurfaces, TARGET_BYTES, VisibleRun};

async fn open(store: &Arc<InMemory>) -> Lake {
    open_in(store.clone()).await.expect("a lake")
}

async fn open_in(store: Arc<dyn ObjectStore>) -> Result<Lake> {
    Lake::open_or_create_in(store, "a lake under test", &Rig::paper(), &ReferenceSurfaces::default()).await
}

/// Adds a run's row to `runs`.
async fn add_run(lake: &Lake, surface: &str, run: &str, project: Option<&str>) {
    let visible = VisibleRun {
        surface: surface.parse().expect("an id"),
        run: run.parse().expect("an id"),
        run_derivation: "ab".to_owned(),
        reference_derivation: None,
        verdicts: None,
    };
    let schema = Table::Runs.schema(lake.rig());
    let file = encode_batches(Table::Runs, &schema, &[]).expect("encoded");
    let stats = json!({ "numRecords": 0, "minValues": { "project": project }, "maxValues": { "project": project } });
    let file = EncodedFile { stats: stats.to_string(), ..file };
    let staged = lake.stage_file(Table::Runs, &FileName::Pointer(visible), file).await.expect("staged");
    lake.commit_staged(&[staged]).await.expect("committed");
}

fn verdict(run: &str, id: &str, value: &str) -> Annotation {
    Annotation {
        annotation_id: id.to_owned(),
        run_id: run.parse().expect("an id"),
        pair_ids: Some(vec![1, 7]),
        kind: AnnotationKind::Verdict,
        value: value.to_owned(),
        comment: "because".to_owned(),
        author: "ann".to_owned(),
        time: DateTime::UNIX_EPOCH,
        lake_version: Some(3),
    }
}

/// Adds annotations; returns the lake's version.
async fn annotate(lake: &Lake, annotations: &[Annotation]) -> u64 {
    lake.prepare_contributions(Table::Annotations).await.expect("prepared");
    let snapshot = lake.snapshot().await.expect("a view");
    let seen = snapshot.log_version(Table::Annotations).expect("a log");
    let rows = annotation_rows(lake, &snapshot, annotations).expect("rows");
    let files = ContributedFile::encode_rows(lake, Table::Annotations, &rows).expect("files");
    let again = files.clone();
    let version = lake.add_contribution(Table::Annotations, seen, files).await.expect("added").expect("the newest");
    let late = lake.add_contribution(Table::Annotations, seen, again).await.expect("looked at");
    assert_eq!(late, None, "another writer has taken the version");
    version
}

async fn predict(lake: &Lake, surface: &str, run: &str, project: Option<&str>, model: &str) {
    let table = Table::Predictions;
    lake.prepare_contributions(table).await.expect("prepared");
    let seen = lake.snapshot().await.expect("a view").log_version(table).expect("a log");
    let mut rows = BatchBuilder::new(table, lake.rig(), 1);
    for (name, text) in
        [("surface_id", surface), ("run_id", run), ("model", model), ("model_version", "1"), ("author", "ann")]
    {
        rows.fill_text(name, text);
    }
    rows.fill_text("project", project).push_ints("pair_id", [7]).push_longs("lake_version", [None::<i64>]);
    for name in echolake_schema::tables::predicted_columns(lake.rig()) {
        rows.push_doubles(&name, [0.5]);
    }
    let time = TimestampMicrosecondArray::from_iter_values([0]).with_timezone("UTC");
    let rows = rows.push_column("predicted", Arc::new(time)).finish().expect("rows");
    let files = ContributedFile::encode_rows(lake, table, &rows).expect("files");
    lake.add_contribution(table, seen, files).await.expect("added").expect("the newest");
}

async fn names_at(lake: &Lake, version: u64) -> Vec<String> {
    let snapshot = lake.snapshot_at(version, Table::Annotations).await.expect("seen");
    let all = lake.read_annotations(&snapshot).await.expect("read");
    all.into_iter().map(|annotation| annotation.annotation_id).collect()
}

async fn models(lake: &Lake) -> Vec<String> {
    let snapshot = lake.snapshot().await.expect("a view");
    snapshot.check_table(Table::Predictions).expect("whole");
    let mut models = Vec::new();
    for file in snapshot.files(Table::Predictions) {
        for rows in file.visible_ranges() {
            let read = lake.read_rows(Table::Predictions, file, &["model"], rows).await.expect("read");
            for batch in read.try_collect::<Vec<_>>().await.expect("read") {
                models.extend(batch.column(0).as_string::<i32>().iter().flatten().map(str::to_owned));
            }
        }
    }
    models.sort();
    models
}

#[tokio::test]
async fn each_version_has_its_annotations_in_their_order_however_they_are_merged() {
    let store = Arc::new(InMemory::new());
    let lake = open(&store).await;
    lake.ensure_tables().await.expect("made");
    add_run(&lake, "flat", "r1", None).await;
    add_run(&lake, "wood", "r2", None).await;
    let before = lake.version_at(&LakeMoment::Version(2)).await.expect("a version");
    let mut expected = vec![(before, Vec::new())];
    let mut names = Vec::new();
    // Past a checkpoint, and merged twice on the way.
    for number in 0..45 {
        let run = ["r2", "r1"][number % 2];
        let both =
            [verdict(run, &format!("b{number:02}"), "rejected"), verdict(run, &format!("a{number:02}"), "accepted")];
        names.extend(both.iter().map(|annotation| annotation.annotation_id.clone()));
        expected.push((annotate(&lake, &both).await, names.clone()));
        if number % 20 == 10 {
            lake.optimize(TARGET_BYTES, &AtomicBool::default(), &mut |_| {}).await.expect("merged");
        }
    }
    let reader = open(&store).await;
    let snapshot = reader.snapshot().await.expect("a view");
    assert_eq!(snapshot.files(Table::Annotations).len(), 15, "two merged files as one, and fourteen more");
    let all = reader.read_annotations(&snapshot).await.expect("read");
    assert_eq!(all.iter().map(|a| a.annotation_id.as_str()).collect::<Vec<_>>(), names);
    assert_eq!(all[0], verdict("r2", "b00", "rejected"));
    for (version, names) in expected {
        assert_eq!(names_at(&reader, version).await, names, "{version}");
    }
}

/// E1: what is predicted for a surface of one project is not there for another project with a surface of that name.
#[tokio::test]
async fn rows_of_one_project_are_not_seen_by_another() {
    let store = Arc::new(InMemory::new());
    let lake = open(&store).await;
    lake.ensure_tables().await.expect("made");
    for (surface, run, project) in
        [("wall", "r1", Some("alpha")), ("wall", "r2", Some("beta")), ("flat", "r3", Some("beta")), ("own", "r4", None)]
    {
        add_run(&lake, surface, run, project).await;
    }
    let alpha = lake.restricted_to(["alpha".parse().expect("a name")].into());
    let beta = lake.restricted_to(["beta".parse().expect("a name")].into());
    for is_merged in [false, true] {
        if is_merged {
            lake.optimize(TARGET_BYTES, &AtomicBool::default(), &mut |_| {}).await.expect("merged");
        } else {
            predict(&lake, "wall", "r1", Some("alpha"), "of-alpha").await;
            predict(&lake, "wall", "r2", Some("beta"), "of-beta").await;
            predict(&lake, "flat", "r3", Some("beta"), "of-flat").await;
            predict(&lake, "own", "r4", None, "of-none").await;
            let all = ["r1", "r2", "r3", "r4"].map(|run| verdict(run, run, "rejected"));
            annotate(&lake, &all).await;
        }
        assert_eq!(models(&lake).await, ["of-alpha", "of-beta", "of-flat", "of-none"]);
        assert_eq!(models(&alpha).await, ["of-alpha", "of-flat"]);
        assert_eq!(models(&beta).await, ["of-beta", "of-flat"]);
        for (reader, expected) in
            [(&lake, &["r1", "r2", "r3", "r4"][..]), (&alpha, &["r1", "r3"]), (&beta, &["r2", "r3"])]
        {
            let snapshot = reader.snapshot().await.expect("a view");
            let seen = reader.read_annotations(&snapshot).await.expect("read");
            let mut seen: Vec<_> = seen.iter().map(|annotation| annotation.annotation_id.as_str()).collect();
            seen.sort_unstable();
            assert_eq!(seen, expected, "merged: {is_merged}");
        }
    }
}

/// E11: a number that the table does not have is not written, whoever names it, and readers see what they saw.
#[tokio::test]
async fn a_version_that_the_table_does_not_have_is_not_written() {
    let store = Arc::new(InMemory::new());
    let lake = open(&store).await;
    lake.ensure_tables().await.expect("made");
    add_run(&lake, "flat", "r1", None).await;
    annotate(&lake, &[verdict("r1", "own", "rejected")]).await;
    let snapshot = lake.snapshot().await.expect("a view");
    let rows = annotation_rows(&lake, &snapshot, &[verdict("r1", "other", "accepted")]).expect("rows");
    let files = ContributedFile::encode_rows(&lake, Table::Annotations, &rows).expect("files");
    for seen in [0, 2, 1 << 62, (1 << 63) - 1, 1 << 63, u64::MAX] {
        let added = lake.add_contribution(Table::Annotations, seen, files.clone()).await.expect("looked at");
        assert_eq!(added, None, "{seen}");
    }
    let reader = open(&store).await;
    let found = reader.read_annotations(&reader.snapshot().await.expect("a view")).await.expect("read");
    assert_eq!(found, [verdict("r1", "own", "rejected")]);
    assert_eq!(reader.commit_log().newest_version(Table::Annotations).await.expect("a log"), Some(1));
}

/// E5: an emptied file, of which a store gives no byte, is a fault of its table, not of the store.
#[tokio::test]
async fn an_emptied_file_of_annotations_is_a_fault_of_their_table() {
    let store = Arc::new(InMemory::new());
    let lake = open(&store).await;
    lake.ensure_tables().await.expect("made");
    add_run(&lake, "flat", "r1", None).await;
    annotate(&lake, &[verdict("r1", "lost", "rejected")]).await;
    let snapshot = lake.snapshot().await.expect("a view");
    let emptied = &snapshot.files(Table::Annotations)[0].path;
    store.put(emptied, "".into()).await.expect("emptied");
    let error = lake.read_annotations(&snapshot).await.expect_err("damaged");
    assert!(error.is_table_fault() && error.to_string().contains("it has 0 bytes, its log says"), "{error}");
}

/// E4: a file or the log of annotations that is lost is a fault of that table alone, until somebody gives it up.
#[tokio::test]
async fn lost_annotations_are_a_fault_of_their_table_alone_until_they_are_given_up() {
    let store = Arc::new(InMemory::new());
    let lake = open(&store).await;
    lake.ensure_tables().await.expect("made");
    add_run(&lake, "flat", "r1", None).await;
    annotate(&lake, &[verdict("r1", "lost", "rejected")]).await;
    let snapshot = lake.snapshot().await.expect("a view");
    let lost = snapshot.files(Table::Annotations)[0].path.clone();
    annotate(&lake, &[verdict("r1", "kept", "rejected")]).await;
    store.delete(&lost).await.expect("deleted");
    let snapshot = lake.snapshot().await.expect("a view");
    let error = lake.read_annotations(&snapshot).await.expect_err("lost");
    let hint = "`echolake rebuild annotations` gives up what is lost of it";
    assert!(error.is_table_fault() && error.to_string().contains(lost.as_ref()), "{error}");
    assert!(error.to_string().contains(hint), "{error}");
    snapshot.check_table(Table::Predictions).expect("another table");
    let given_up = lake.give_up_lost(Table::Annotations).await.expect("given up");
    assert_eq!((given_up.rows, given_up.files, given_up.is_whole_log), (1, vec![lost.to_string()], false));
    let read = async |lake: &Lake| {
        let all = lake.read_annotations(&lake.snapshot().await.expect("a view")).await;
        all.map(|all| all.into_iter().map(|annotation| annotation.annotation_id).collect::<Vec<_>>())
    };
    assert_eq!(read(&lake).await.expect("whole"), ["kept"]);

    let log = Path::from("tables/annotations/_delta_log");
    for object in store.list(Some(&log)).try_collect::<Vec<_>>().await.expect("listed") {
        store.delete(&object.location).await.expect("deleted");
    }
    let lake = open(&store).await;
    lake.ensure_tables().await.expect("it is not made again in silence");
    let error = read(&lake).await.expect_err("its log is lost").to_string();
    assert!(error.contains("it has no log, and `runs` names version") && error.contains(hint), "{error}");
    assert!(lake.prepare_contributions(Table::Annotations).await.is_err());
    lake.prepare_contributions(Table::Predictions).await.expect("another table");
    assert!(lake.give_up_lost(Table::Annotations).await.expect("given up").is_whole_log);
    assert_eq!(read(&lake).await.expect("whole"), Vec::<String>::new());
    annotate(&lake, &[verdict("r1", "new", "rejected")]).await;
    assert_eq!(read(&open(&store).await).await.expect("whole"), ["new"]);
}

/// A store that ends at its nth write: the write is made or not, and all later ones are refused.
#[derive(Debug)]
struct EndingStore {
    writes: AtomicUsize,
    last: usize,
    is_last_made: bool,
}

impl StoreBehaviour for EndingStore {
    fn decide_fate(&self, kind: RequestKind, _: Option<&Path>) -> RequestFate {
        if !kind.is_write() {
            return RequestFate::Done;
        }
        let number = self.writes.fetch_add(1, Ordering::SeqCst);
        let ended = object_store::Error::Generic { store: "Ending", source: "the power is gone".into() };
        match number.cmp(&self.last) {
            std::cmp::Ordering::Less => RequestFate::Done,
            std::cmp::Ordering::Equal if self.is_last_made => RequestFate::AnswerLost(ended),
            _ => RequestFate::Refused(ended),
        }
    }
}

/// A lake of an earlier form, and a reader of it: two objects of annotations, of which `runs` shows one.
async fn make_earlier_lake() -> (Arc<InMemory>, Lake) {
    let store = Arc::new(InMemory::new());
    let lake = open(&store).await;
    lake.ensure_tables().await.expect("made");
    add_run(&lake, "flat", "r1", None).await;
    for number in 1..=2 {
        let line = json!({
            "number": number, "annotation_id": format!("old-{number}"), "run_id": "r1", "pair_ids": [1, 7],
            "kind": "verdict", "value": "rejected", "comment": "because", "author": "ann",
            "time": "1970-01-01T00:00:00Z", "lake_version": 3,
        });
        let path = Path::from(format!("annotations/{number:020}.ndjson"));
        store.put(&path, format!("{line}\n").into()).await.expect("written");
    }
    for table in Table::OF_USERS {
        let log = Path::from(format!("tables/{}/_delta_log", table.name()));
        for object in store.list(Some(&log)).try_collect::<Vec<_>>().await.expect("listed") {
            store.delete(&object.location).await.expect("deleted");
        }
    }
    lake.delta_log().show_objects(Table::Annotations, 1).await.expect("shown");
    (store, lake)
}

#[tokio::test]
async fn what_an_earlier_form_has_is_copied_once_whenever_the_writer_ends() {
    let whole = ["old-1", "old-2"];
    let (_, reader) = make_earlier_lake().await;
    let snapshot = reader.snapshot().await.expect("a view");
    let version = snapshot.log_version(Table::Runs).expect("a version");
    let shown = reader.read_annotations(&snapshot).await.expect("read");
    assert_eq!(shown, [verdict("r1", "old-1", "rejected")], "readers read objects until they are copied");
    let mut deaths = 0;
    for is_last_made in [false, true] {
        for last in 0.. {
            let (store, reader) = make_earlier_lake().await;
            let ending = EndingStore { writes: AtomicUsize::new(0), last, is_last_made };
            let mortal = StoreDouble::new(store.clone(), ending);
            let done = async {
                let lake = open_in(mortal.clone()).await?;
                lake.prepare_contributions(Table::Annotations).await
            };
            let done = done.await;
            let snapshot = reader.snapshot().await.expect("a view");
            let between = reader.read_annotations(&snapshot).await.expect("read");
            let between: Vec<_> = between.into_iter().map(|a| a.annotation_id).collect();
            assert!(between == whole[..1] || between == whole, "after write {last}: {between:?}");
            annotate(&open(&store).await, &[verdict("r1", "new", "accepted")]).await;
            let snapshot = reader.snapshot().await.expect("a view");
            let all = reader.read_annotations(&snapshot).await.expect("read");
            let all: Vec<_> = all.into_iter().map(|a| a.annotation_id).collect();
            assert_eq!(all, ["old-1", "old-2", "new"], "after write {last}");
            assert_eq!(names_at(&reader, version).await, whole[..1], "a version of before");
            if done.is_ok() && mortal.behaviour.writes.load(Ordering::SeqCst) <= last {
                break;
            }
            deaths += 1;
        }
    }
    assert!(deaths >= 6, "{deaths} writes of copying");
}
