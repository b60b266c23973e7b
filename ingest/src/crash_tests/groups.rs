//! Files of a group of runs: how many there are, and that their rows are those of files of one run.

use std::collections::BTreeSet;
use std::sync::Arc;

use bytes::Bytes;
use echolake_acquisition::run::controller::RecordingMode;
use echolake_lake::{DataFile, Lake};
use echolake_panel::relief::PanelRelief;
use echolake_schema::tables::{Source, Table};
use echolake_testing::simulate_project_run;
use object_store::ObjectStoreExt as _;
use object_store::memory::InMemory;
use object_store::path::Path;

use super::{ingest_pending, open_lake, read_rows, read_tables, simulate_runs, with_inbox};

/// Run files of these surfaces, each of a project or of none.
fn simulate_projects(surfaces: &[(String, Option<&str>)]) -> Vec<(String, Bytes)> {
    let folder = tempfile::tempdir().expect("a folder");
    let one = |(number, (surface, project)): (usize, &(String, Option<&str>))| {
        let relief = PanelRelief::guess_name(surface).expect("a name");
        let surface = (surface.as_str(), *project);
        let path = simulate_project_run(folder.path(), number, surface, relief, RecordingMode::ResponsesOnly);
        let name = path.file_name().expect("a name").to_string_lossy().into_owned();
        (name, Bytes::from(std::fs::read(path).expect("read")))
    };
    surfaces.iter().enumerate().map(one).collect()
}

async fn put_run(store: &Arc<InMemory>, (name, bytes): &(String, Bytes)) {
    store.put(&Path::from(format!("inbox/{name}")), bytes.clone().into()).await.expect("written");
}

fn run_tables() -> impl Iterator<Item = Table> {
    Table::ALL.into_iter().filter(|table| !matches!(table.source(), Source::Rig | Source::Users))
}

async fn seen_files(lake: &Lake, table: Table) -> Vec<Arc<DataFile>> {
    lake.snapshot().await.expect("a view").files(table).to_vec()
}

/// Twenty runs: the references, measured twice each, and eight of each of two projects.
#[tokio::test(flavor = "multi_thread")]
async fn a_group_has_a_file_per_table_and_project() {
    let references = ["flat", "foam", "flat", "foam"].map(|surface| (surface.to_owned(), None));
    let of_projects =
        (0..8).flat_map(|number| [(format!("wood_a{number}"), Some("a")), (format!("brick_b{number}"), Some("b"))]);
    let runs = simulate_projects(&references.into_iter().chain(of_projects).collect::<Vec<_>>());
    let store = with_inbox(&runs).await;
    assert_eq!(ingest_pending(store.clone()).await.expect("ingested").len(), 20);
    let lake = open_lake(store.clone()).await.expect("a lake");
    let is_of = |file: &DataFile, start: &str| file.parts.iter().all(|part| part.surface.as_str().starts_with(start));
    for table in run_tables() {
        let files = seen_files(&lake, table).await;
        let runs: Vec<_> = files.iter().map(|file| file.shown_runs().len()).collect();
        let is_described = table.key().contains(&"surface_id");
        assert_eq!(runs.iter().sum::<usize>(), if is_described { 18 } else { 20 }, "{}", table.name());
        assert_eq!(files.len(), 3, "{}: {runs:?}", table.name());
        for start in ["wood_a", "brick_b", "f"] {
            assert_eq!(files.iter().filter(|file| is_of(file, start)).count(), 1, "{}: {start}", table.name());
        }
    }
    // A reader of one project has whole files of it, and those of the references.
    for (project, other) in [("a", "brick_b"), ("b", "wood_a")] {
        let reader = lake.restricted_to([project.parse().expect("a project")].into());
        let snapshot = reader.snapshot().await.expect("a view");
        snapshot.check_run_tables().expect("whole");
        for table in run_tables() {
            let files: Vec<_> = snapshot.readable_files(table).collect();
            assert_eq!((files.len(), snapshot.files(table).len()), (2, 2), "{project}: {}", table.name());
            assert!(files.iter().all(|file| !is_of(file, other)), "{project}: {}", table.name());
        }
    }
    // Lists end a row group with their run; the rows of the others share one.
    let table_groups = async |table: Table| {
        let files = seen_files(&lake, table).await;
        let file = files.iter().find(|file| is_of(file, "wood_a")).expect("a file").clone();
        let bytes = store.get(&file.path).await.expect("there").bytes().await.expect("bytes");
        let reader = parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder::try_new(bytes).expect("a file");
        reader.metadata().num_row_groups()
    };
    assert_eq!(table_groups(Table::Measurements).await, 8);
    assert_eq!(table_groups(Table::Nce).await, 8);
    assert_eq!(table_groups(Table::Tnce).await, 1);
    assert_eq!(table_groups(Table::Environment).await, 1);

    // A new run of Flat replaces the derived rows of all; what it does not change stays in its files.
    let before = read_tables(store.clone()).await.0;
    let more = simulate_runs(&["prd", "prd", "prd", "prd", "flat"]);
    put_run(&store, &more[4]).await;
    ingest_pending(store.clone()).await.expect("ingested");
    let after = read_tables(store.clone()).await.0;
    let kept = |table: Table| {
        let start = format!("tables/{}/", table.name());
        before.keys().filter(|path| path.starts_with(&start) && after.contains_key(*path)).count()
    };
    assert_eq!([Table::Measurements, Table::Environment, Table::Nce, Table::Runs].map(kept), [3, 3, 0, 0]);
    let derived: usize = seen_files(&lake, Table::Nce).await.iter().map(|file| file.shown_runs().len()).sum();
    assert_eq!(derived, 21);
}

/// A lake that grows by a run at a time has the rows of one that was ingested at once, and nearly as few files.
#[tokio::test(flavor = "multi_thread")]
async fn files_of_single_runs_are_merged_once_there_are_enough() {
    let names: Vec<_> = ["flat".to_owned(), "foam".to_owned()]
        .into_iter()
        .chain((0..20).map(|number| format!("wood_{number}")))
        .collect();
    let runs = simulate_runs(&names.iter().map(String::as_str).collect::<Vec<_>>());
    let at_once = with_inbox(&runs).await;
    ingest_pending(at_once.clone()).await.expect("ingested");
    let expected = read_rows(at_once).await;
    // The files of the references and of fourteen runs are too few to be written again.
    let two_groups = with_inbox(&runs[..16]).await;
    ingest_pending(two_groups.clone()).await.expect("ingested");
    let lake = open_lake(two_groups).await.expect("a lake");
    for table in run_tables() {
        let files = seen_files(&lake, table).await;
        let parts: BTreeSet<_> = files.iter().map(|file| file.parts.len()).collect();
        assert_eq!((files.len(), parts), (2, BTreeSet::from([2, 14])), "{}", table.name());
    }
    let grown = with_inbox(&runs[..2]).await;
    ingest_pending(grown.clone()).await.expect("ingested");
    let lake = open_lake(grown.clone()).await.expect("a lake");
    for (number, run) in runs[2..].iter().enumerate() {
        put_run(&grown, run).await;
        ingest_pending(grown.clone()).await.expect("ingested");
        // Fourteen runs and the references are sixteen, which are merged.
        let files = if number < 13 { number + 2 } else { number - 12 };
        for table in run_tables() {
            assert_eq!(seen_files(&lake, table).await.len(), files, "{} with {}", table.name(), number + 1);
        }
    }
    assert!(read_rows(grown.clone()).await == expected, "other rows");
    let (seen, logged) = read_tables(grown).await;
    assert_eq!(seen.into_keys().collect::<Vec<_>>(), logged, "nothing but what is seen is in the logs");
    let parts: BTreeSet<_> = seen_files(&lake, Table::Nce).await.iter().map(|file| file.parts.len()).collect();
    assert_eq!(parts, BTreeSet::from([0, 16]));
}
