//! Ingest that dies at any step of its writing, and ingests side by side: the tables end as if nothing had happened.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use async_trait::async_trait;
use bytes::Bytes;
use echolake_acquisition::controller::Keep;
use echolake_acquisition::relief::Relief;
use echolake_acquisition::simulate::{SimulatedRun, Specimen};
use echolake_lake::{Lake, References};
use echolake_schema::tables::Table;
use echolake_schema::{Rig, Timestamp};
use futures::stream::BoxStream;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{
    CopyOptions, Error as StoreError, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta, ObjectStore,
    ObjectStoreExt as _, PutMultipartOptions, PutOptions, PutPayload, PutResult, RenameOptions, Result as StoreResult,
};

use crate::{Ingest, Report, complete, pending};

/// Ten points, so that a run takes milliseconds.
const SMALL_RIG: &str = include_str!("../../tests/fixtures/small_rig.toml");

/// Where a store dies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Death {
    /// The write is not made.
    Before,
    /// The write is made, and its author does not hear of it.
    After,
}

/// A store that dies at its nth write; all that comes later fails.
#[derive(Debug)]
struct Mortal {
    inner: Arc<InMemory>,
    writes: AtomicUsize,
    last: usize,
    death: Death,
}

impl Mortal {
    fn new(inner: Arc<InMemory>, last: usize, death: Death) -> Arc<Self> {
        Arc::new(Self { inner, writes: AtomicUsize::new(0), last, death })
    }

    // Whether the write is made, and whether its author hears of it.
    fn write(&self) -> (bool, bool) {
        let number = self.writes.fetch_add(1, Ordering::SeqCst);
        (number < self.last || (number == self.last && self.death == Death::After), number < self.last)
    }

    async fn mutate<T>(&self, work: impl Future<Output = StoreResult<T>>) -> StoreResult<T> {
        let (made, heard) = self.write();
        let done = if made { Some(work.await) } else { None };
        done.filter(|_| heard).unwrap_or_else(|| Err(dead()))
    }
}

fn dead() -> StoreError {
    StoreError::Generic { store: "Mortal", source: "the power is gone".into() }
}

impl fmt::Display for Mortal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Mortal")
    }
}

#[async_trait]
impl ObjectStore for Mortal {
    async fn put_opts(&self, location: &Path, payload: PutPayload, opts: PutOptions) -> StoreResult<PutResult> {
        self.mutate(self.inner.put_opts(location, payload, opts)).await
    }

    async fn put_multipart_opts(
        &self,
        location: &Path,
        opts: PutMultipartOptions,
    ) -> StoreResult<Box<dyn MultipartUpload>> {
        self.mutate(self.inner.put_multipart_opts(location, opts)).await
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> StoreResult<GetResult> {
        self.inner.get_opts(location, options).await
    }

    fn delete_stream(&self, locations: BoxStream<'static, StoreResult<Path>>) -> BoxStream<'static, StoreResult<Path>> {
        match self.write() {
            (true, true) => self.inner.delete_stream(locations),
            _ => Box::pin(futures::stream::once(async { Err(dead()) })),
        }
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, StoreResult<ObjectMeta>> {
        self.inner.list(prefix)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> StoreResult<ListResult> {
        self.inner.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> StoreResult<()> {
        self.mutate(self.inner.copy_opts(from, to, options)).await
    }

    // In one step, as a file system does it.
    async fn rename_opts(&self, from: &Path, to: &Path, options: RenameOptions) -> StoreResult<()> {
        self.mutate(self.inner.rename_opts(from, to, options)).await
    }
}

fn rig() -> Rig {
    Rig::from_toml(SMALL_RIG).expect("a rig")
}

/// Run files of these surfaces, by name. A surface is made of the relief that its name begins with.
fn runs(surfaces: &[&str]) -> Vec<(String, Bytes)> {
    let (folder, rig) = (tempfile::tempdir().expect("a folder"), rig());
    let one = |(number, surface): (usize, &&str)| {
        let relief = surface.split('_').next().expect("a name");
        let specimen = Specimen::Relief(Relief::by_name(relief).expect("a relief"));
        let run = SimulatedRun {
            rig: &rig,
            surface: surface.parse().expect("an id"),
            specimen: &specimen,
            flat: None,
            foam: None,
            start: Timestamp(1_767_600_000_000_000_000).plus_secs(number as f64 * 3_600.0),
            seed: number as u64 + 1,
            keep: Keep::ResponsesOnly,
            folder: folder.path(),
        };
        let (path, _) = run.measure(&AtomicBool::new(false), &mut |_| {}).expect("a run");
        let name = path.file_name().expect("a name").to_string_lossy().into_owned();
        (name, Bytes::from(std::fs::read(path).expect("read")))
    };
    surfaces.iter().enumerate().map(one).collect()
}

async fn lake(store: Arc<dyn ObjectStore>) -> echolake_lake::Result<Lake> {
    Lake::open_or_create_in(store, "a lake under test", &rig(), &References::default()).await
}

/// A lake with these runs in its inbox.
async fn with_inbox(runs: &[(String, Bytes)]) -> Arc<InMemory> {
    let store = Arc::new(InMemory::new());
    lake(store.clone()).await.expect("a lake");
    for (name, bytes) in runs {
        store.put(&Path::from(format!("inbox/{name}")), bytes.clone().into()).await.expect("written");
    }
    store
}

async fn ingest(store: Arc<dyn ObjectStore>) -> crate::Result<Vec<Report>> {
    let (lake, stop) = (lake(store).await?, Arc::new(AtomicBool::new(false)));
    let mut reports = Vec::new();
    let sources = pending(&lake).await?;
    Ingest::new(&lake, stop.clone()).take_in(sources, &mut |report| reports.push(report)).await?;
    complete(&lake, &stop, &mut |_| {}).await?;
    Ok(reports)
}

/// All that readers see: the files of every table with their bytes; and what other Delta readers see, by name.
async fn tables(store: Arc<InMemory>) -> (BTreeMap<String, Bytes>, Vec<String>) {
    let lake = lake(store.clone()).await.expect("a lake");
    let snapshot = lake.snapshot().await.expect("a view");
    let (mut seen, mut logged) = (BTreeMap::new(), Vec::new());
    for table in Table::ALL {
        for file in snapshot.files(table) {
            let bytes = store.get(&file.path).await.expect("there").bytes().await.expect("bytes");
            assert_eq!(bytes.len() as u64, file.bytes, "{}", file.path);
            seen.insert(file.path.to_string(), bytes);
        }
        logged.extend(lake.log().files(table).await.expect("a log").iter().map(|f| f.path.to_string()));
    }
    logged.sort();
    (seen, logged)
}

// A death at each write, made or not: afterwards ingest is run once more, and the tables are those of an ingest that
// nothing disturbed, byte for byte.
#[tokio::test(flavor = "multi_thread")]
async fn a_death_at_any_write_is_repaired_by_running_again() {
    let runs = runs(&["flat", "foam", "wood"]);
    let start = with_inbox(&runs).await;
    let undisturbed = Arc::new(start.fork());
    ingest(undisturbed.clone()).await.expect("ingested");
    let expected = tables(undisturbed).await;
    assert_eq!(expected.0.keys().cloned().collect::<Vec<_>>(), expected.1, "nothing but what is seen is in the logs");
    let mut deaths = 0;
    for death in [Death::Before, Death::After] {
        for last in 0.. {
            let inner = Arc::new(start.fork());
            let mortal = Mortal::new(inner.clone(), last, death);
            let first = ingest(mortal.clone()).await;
            if mortal.writes.load(Ordering::SeqCst) <= last {
                first.expect("it lived");
                break;
            }
            deaths += 1;
            ingest(inner.clone()).await.unwrap_or_else(|e| panic!("{death:?} write {last}: {e}"));
            let (seen, logged) = tables(inner).await;
            assert_eq!(logged, expected.1, "{death:?} write {last}");
            assert!(seen == expected.0, "{death:?} write {last}: other bytes");
        }
    }
    // Each of three runs has nine files, each table a commit, each run's file a move.
    assert!(deaths > 2 * 35, "{deaths} deaths");
}

#[tokio::test(flavor = "multi_thread")]
async fn two_ingests_at_once_lose_nothing_and_double_nothing() {
    let runs = runs(&["flat", "foam", "wood", "prd", "brick", "wavy", "flat_2", "wood_2"]);
    let undisturbed = with_inbox(&runs).await;
    ingest(undisturbed.clone()).await.expect("ingested");
    let expected = tables(undisturbed).await;
    for _ in 0..5 {
        let store = with_inbox(&runs).await;
        let (a, b) = (tokio::spawn(ingest(store.clone())), tokio::spawn(ingest(store.clone())));
        a.await.expect("no panic").expect("ingested");
        b.await.expect("no panic").expect("ingested");
        // Each completes what it saw; the last one to end has seen everything.
        ingest(store.clone()).await.expect("ingested");
        let (seen, logged) = tables(store).await;
        assert_eq!(logged, expected.1);
        assert!(seen == expected.0, "other bytes");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_new_reference_run_rewrites_its_dependants_and_nothing_else() {
    let runs = runs(&["flat", "foam", "wood", "flat"]);
    let store = with_inbox(&runs[..3]).await;
    ingest(store.clone()).await.expect("ingested");
    let before = tables(store.clone()).await.0;
    let (name, bytes) = &runs[3];
    store.put(&Path::from(format!("inbox/{name}")), bytes.clone().into()).await.expect("written");
    ingest(store.clone()).await.expect("ingested");
    let after = tables(store).await.0;
    let kept = |table: &str| {
        let of = |files: &BTreeMap<String, Bytes>| {
            files.keys().filter(|k| k.starts_with(&format!("tables/{table}/"))).cloned().collect::<Vec<_>>()
        };
        let (before, after) = (of(&before), of(&after));
        (before.iter().filter(|f| after.contains(f)).count(), before.len(), after.len())
    };
    // All derived rows used Flat; no other row did.
    for table in ["nce", "tnce", "tnce_d4", "surface_stats"] {
        assert_eq!(kept(table), (0, 3, 4), "{table}");
    }
    for table in ["measurements", "environment", "events"] {
        assert_eq!(kept(table), (3, 3, 4), "{table}");
    }
    assert_eq!(kept("surfaces"), (2, 3, 3), "Flat's newest run tells what it is");
}

#[tokio::test(flavor = "multi_thread")]
async fn refused_files_go_to_quarantine_with_the_reason_and_the_rest_goes_on() {
    let mut runs = runs(&["flat", "foam"]);
    let cut = runs[1].1.len() / 2;
    runs[1].1.truncate(cut);
    runs.push(("text.mcap".into(), Bytes::from_static(b"no MCAP at all")));
    let store = with_inbox(&runs).await;
    let reports = ingest(store.clone()).await.expect("ingested");
    let refused: Vec<_> = reports.iter().filter(|r| matches!(r, Report::Refused { .. })).collect();
    assert_eq!(refused.len(), 1, "{refused:?}");
    let reason = store.get(&Path::from("quarantine/text.mcap.reason.txt")).await.expect("a reason");
    let reason = String::from_utf8(reason.bytes().await.expect("bytes").to_vec()).expect("text");
    assert!(reason.contains("is not an MCAP file"), "{reason}");
    let kept = store.get(&Path::from("quarantine/text.mcap")).await.expect("kept").bytes().await.expect("bytes");
    assert_eq!(kept, "no MCAP at all");
    let taken: Vec<_> = reports
        .iter()
        .filter_map(|r| match r {
            Report::Taken(taken) => Some((taken.surface.as_str(), taken.whole, taken.measurements)),
            _ => None,
        })
        .collect();
    assert_eq!(taken.len(), 2, "{taken:?}");
    let foam = taken.iter().find(|t| t.0 == "foam").expect("the cut run");
    assert!(!foam.1 && foam.2 < 45, "{foam:?}");
    assert!(ingest(store).await.expect("ingested").is_empty(), "nothing is left in the inbox");
}
