//! Ingest that dies at any step of its writing, and ingests side by side: the tables end as if nothing had happened.

mod groups;
mod mortal;
mod skewed;
mod verdicts;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use self::mortal::{DeathMoment, MortalStore};
use self::skewed::{Interlude, SkewedStore};
use crate::{
    CompletedRun, Error, FileReport, LakeIngest, RemovedFile, RunSource, find_removals, find_runs, pending_runs,
};
use arrow::row::{RowConverter, SortField};
use bytes::Bytes;
use chrono::TimeDelta;
use echolake_acquisition::run::controller::RecordingMode;
use echolake_lake::{ClaimOutcome, ClaimTimes, DeletionMode, Lake, ReferenceSurfaces, WorkClaims};
use echolake_panel::relief::PanelRelief;
use echolake_schema::Rig;
use echolake_schema::tables::Table;
use echolake_testing::{SMALL_RIG, StoreDouble, simulate_run};
use futures::TryStreamExt as _;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _};

fn small_rig() -> Rig {
    Rig::from_toml(SMALL_RIG).expect("a rig")
}

/// Run files of these surfaces, by name. A surface is made of the relief that its name begins with.
fn simulate_runs(surfaces: &[&str]) -> Vec<(String, Bytes)> {
    let folder = tempfile::tempdir().expect("a folder");
    let one = |(number, surface): (usize, &&str)| {
        let relief = PanelRelief::guess_name(surface).expect("a name");
        let path = simulate_run(folder.path(), number, surface, relief, RecordingMode::ResponsesOnly);
        let name = path.file_name().expect("a name").to_string_lossy().into_owned();
        (name, Bytes::from(std::fs::read(path).expect("read")))
    };
    surfaces.iter().enumerate().map(one).collect()
}

pub(crate) async fn open_lake(store: Arc<dyn ObjectStore>) -> echolake_lake::Result<Lake> {
    Lake::open_or_create_in(store, "a lake under test", &small_rig(), &ReferenceSurfaces::default()).await
}

/// A lake with these runs in its inbox.
pub(crate) async fn with_inbox(runs: &[(String, Bytes)]) -> Arc<InMemory> {
    let store = Arc::new(InMemory::new());
    open_lake(store.clone()).await.expect("a lake");
    for (name, bytes) in runs {
        store.put(&Path::from(format!("inbox/{name}")), bytes.clone().into()).await.expect("written");
    }
    store
}

pub(crate) async fn ingest_pending(store: Arc<dyn ObjectStore>) -> crate::Result<Vec<FileReport>> {
    let lake = open_lake(store).await?;
    let mut reports = Vec::new();
    let ingest = LakeIngest::new(&lake, Arc::default());
    ingest.ingest_runs(pending_runs(&lake).await?, &mut |report| reports.push(report)).await?;
    ingest.complete_runs(&mut |_, _| {}).await?;
    Ok(reports)
}

/// All that readers see: the files of every table with their bytes; and what other Delta readers see, by name.
async fn read_tables(store: Arc<InMemory>) -> (BTreeMap<String, Bytes>, Vec<String>) {
    let lake = open_lake(store.clone()).await.expect("a lake");
    let snapshot = lake.snapshot().await.expect("a view");
    let mut seen = BTreeMap::new();
    let mut logged = Vec::new();
    for table in Table::ALL {
        for file in snapshot.files(table) {
            let bytes = store.get(&file.path).await.expect("there").bytes().await.expect("bytes");
            assert_eq!(bytes.len() as u64, file.bytes, "{}", file.path);
            seen.insert(file.path.to_string(), bytes);
        }
        logged.extend(lake.commit_log().list_files(table).await.expect("a log").iter().map(|f| f.path.to_string()));
    }
    logged.sort();
    (seen, logged)
}

/// Merges all files that can be, and deletes what nothing names any more.
async fn tidy_lake(store: Arc<dyn ObjectStore>) -> echolake_lake::Result<()> {
    let lake = open_lake(store).await?;
    let stop = AtomicBool::new(false);
    lake.optimize(1 << 30, &stop, &mut |_| {}).await?;
    lake.vacuum(TimeDelta::zero(), DeletionMode::Real, &mut |_, _| {}).await?;
    Ok(())
}

/// All rows that readers see, sorted, by table.
async fn read_rows(store: Arc<InMemory>) -> BTreeMap<&'static str, Vec<Vec<u8>>> {
    let lake = open_lake(store).await.expect("a lake");
    let snapshot = lake.snapshot().await.expect("a view");
    let mut all: BTreeMap<_, Vec<_>> = BTreeMap::new();
    for table in Table::ALL {
        let files = snapshot.files(table).iter();
        for (file, range) in files.flat_map(|file| file.visible_ranges().into_iter().map(move |range| (file, range))) {
            let mut batches = lake.read_rows(table, file, &[], range).await.expect("a stream");
            while let Some(batch) = batches.try_next().await.expect("rows") {
                let fields = batch.schema().fields().iter().map(|f| SortField::new(f.data_type().clone())).collect();
                let rows = RowConverter::new(fields).and_then(|c| c.convert_columns(batch.columns())).expect("rows");
                all.entry(table.name()).or_default().extend(rows.iter().map(|row| row.as_ref().to_vec()));
            }
        }
    }
    all.values_mut().for_each(|rows| rows.sort_unstable());
    all
}

/// Dies at each write of `work`, made or not, and hands over what is left each time; returns how many deaths there
/// were.
async fn each_death<T, E: std::fmt::Debug>(
    start: &InMemory,
    work: impl AsyncFn(Arc<dyn ObjectStore>) -> Result<T, E>,
    check: impl AsyncFn(Arc<InMemory>, String),
) -> usize {
    let mut deaths = 0;
    for death in [DeathMoment::Before, DeathMoment::After] {
        for last in 0.. {
            let inner = Arc::new(start.fork());
            let mortal = StoreDouble::new(inner.clone(), MortalStore::new(last, death));
            let first = work(mortal.clone()).await;
            if !mortal.behaviour.has_died() {
                first.expect("it lived");
                break;
            }
            deaths += 1;
            check(inner, format!("{death:?} write {last}")).await;
        }
    }
    deaths
}

/// Ahead or behind.
const SKEW: TimeDelta = TimeDelta::minutes(5);

fn skewed_store(store: &Arc<InMemory>, skew: TimeDelta, interlude: Option<Interlude>) -> Arc<dyn ObjectStore> {
    StoreDouble::new(store.clone(), SkewedStore { skew, interlude })
}

#[tokio::test(flavor = "multi_thread")]
async fn a_new_reference_run_rewrites_its_dependants_and_nothing_else() {
    let runs = simulate_runs(&["flat", "foam", "wood", "flat"]);
    let store = with_inbox(&runs[..3]).await;
    ingest_pending(store.clone()).await.expect("ingested");
    let before = read_tables(store.clone()).await.0;
    let (name, bytes) = &runs[3];
    store.put(&Path::from(format!("inbox/{name}")), bytes.clone().into()).await.expect("written");
    ingest_pending(store.clone()).await.expect("ingested");
    let after = read_tables(store).await.0;
    let kept = |table: &str| {
        let of = |files: &BTreeMap<String, Bytes>| {
            files.keys().filter(|k| k.starts_with(&format!("tables/{table}/"))).cloned().collect::<Vec<_>>()
        };
        let before = of(&before);
        let after = of(&after);
        (before.iter().filter(|f| after.contains(f)).count(), before.len(), after.len())
    };
    // All derived rows used Flat; no other row did. The references share a file.
    for table in ["nce", "tnce", "tnce_d4", "surface_stats"] {
        assert_eq!(kept(table), (0, 2, 2), "{table}");
    }
    for table in ["measurements", "environment", "events"] {
        assert_eq!(kept(table), (2, 2, 3), "{table}");
    }
    assert_eq!(kept("surfaces"), (1, 2, 3), "Flat's newest run tells what it is");
}

#[tokio::test(flavor = "multi_thread")]
async fn refused_files_go_to_quarantine_with_the_reason_and_the_rest_goes_on() {
    let mut runs = simulate_runs(&["flat", "foam"]);
    let cut = runs[1].1.len() / 2;
    runs[1].1.truncate(cut);
    runs.push(("text.mcap".into(), Bytes::from_static(b"no MCAP at all")));
    let store = with_inbox(&runs).await;
    let reports = ingest_pending(store.clone()).await.expect("ingested");
    let refused: Vec<_> = reports.iter().filter(|r| matches!(r, FileReport::Refused { .. })).collect();
    assert_eq!(refused.len(), 2, "{refused:?}");
    let reason = store.get(&Path::from("quarantine/text.mcap.reason.txt")).await.expect("a reason");
    let reason = String::from_utf8(reason.bytes().await.expect("bytes").to_vec()).expect("text");
    assert!(reason.contains("is not an MCAP file"), "{reason}");
    let kept = store.get(&Path::from("quarantine/text.mcap")).await.expect("kept").bytes().await.expect("bytes");
    assert_eq!(kept, "no MCAP at all");
    let taken: Vec<_> = reports
        .iter()
        .filter_map(|r| match r {
            FileReport::Ingested(taken) => Some((taken.surface.as_str(), taken.whole, taken.measurements)),
            _ => None,
        })
        .collect();
    assert_eq!(taken, [("flat", true, 45)]);
    // What is not whole stays.
    let again = ingest_pending(store.clone()).await.expect("ingested");
    let [FileReport::Refused { why: Error::Unfinished { bytes, .. }, moved: None, .. }] = again.as_slice() else {
        panic!("{again:?}")
    };
    assert_eq!(*bytes, cut as u64);
    store.head(&Path::from(format!("inbox/{}", runs[1].0))).await.expect("where it was");
}

// As somebody deletes it, or another program moves it.
#[tokio::test(flavor = "multi_thread")]
async fn a_file_that_is_gone_when_it_is_read_does_not_end_the_batch() {
    let runs = simulate_runs(&["flat", "foam", "wood"]);
    let store = with_inbox(&runs).await;
    let lake = open_lake(store.clone()).await.expect("a lake");
    let mut reports = Vec::new();
    let sources = pending_runs(&lake).await.expect("listed");
    store.delete(&Path::from(format!("inbox/{}", runs[1].0))).await.expect("deleted");
    let ingest = LakeIngest::new(&lake, Arc::default());
    ingest.ingest_runs(sources, &mut |report| reports.push(report)).await.expect("the others are ingested");
    let gone = reports.iter().filter(|r| matches!(r, FileReport::Gone(_))).count();
    let taken = reports.iter().filter(|r| matches!(r, FileReport::Ingested(_))).count();
    assert_eq!((gone, taken), (1, 2), "{reports:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn runs_are_found_by_name_and_by_path() {
    let runs = simulate_runs(&["flat", "foam"]);
    let store = with_inbox(&runs).await;
    store.put(&Path::from("inbox/sub/own name.mcap"), runs[1].1.clone().into()).await.expect("written");
    let place = format!("runs/flat/{}", runs[0].0);
    store.rename(&Path::from(format!("inbox/{}", runs[0].0)), &Path::from(place.clone())).await.expect("moved");
    let lake = open_lake(store).await.expect("a lake");
    let in_inbox = format!("inbox/{}", runs[1].0);
    let cases = [
        (runs[0].0.trim_end_matches(".mcap"), Some(place.as_str())),
        (&runs[0].0, Some(&place)),
        (&place, Some(&place)),
        (&runs[1].0, Some(&in_inbox)),
        (&in_inbox, Some(&in_inbox)),
        ("own name", Some("inbox/sub/own name.mcap")),
        ("inbox/own name.mcap", None),
        ("lake.toml", None),
        ("", None),
    ];
    let found = find_runs(&lake, &cases.map(|(name, _)| name)).await.expect("looked up");
    for ((name, expected), found) in cases.into_iter().zip(found) {
        assert_eq!(found.as_ref().map(Path::as_ref), expected, "{name}");
    }
}

// A sparse file costs its maker nothing, whatever its records claim.
#[tokio::test(flavor = "multi_thread")]
async fn a_record_that_is_too_large_is_passed_over_and_told() {
    let mut runs = simulate_runs(&["flat"]);
    let whole = runs[0].1.clone();
    let header = 17 + u64::from_le_bytes(whole[9..17].try_into().expect("a length")) as usize;
    let claimed = (256 << 20) + 1u64;
    let mut file = whole[..header].to_vec();
    file.push(0x09);
    // Times, name, media type, data, CRC.
    file.extend((16 + 4 + 4 + 8 + claimed + 4).to_le_bytes());
    file.extend([0; 24]);
    file.extend(claimed.to_le_bytes());
    // Zeros would be a hole of a copy that is not whole yet.
    file.resize(file.len() + claimed as usize + 4, 0x55);
    file.extend(&whole[header..]);
    runs[0].1 = file.into();
    let reports = ingest_pending(with_inbox(&runs).await).await.expect("ingested");
    let [FileReport::Ingested(taken)] = reports.as_slice() else { panic!("{reports:?}") };
    assert_eq!(taken.measurements, 45);
    let place = format!("record of kind 0x09 at byte {header} has ");
    assert!(taken.damaged.iter().any(|d| d.starts_with(&place) && d.contains("more than")), "{:?}", taken.damaged);
}

// A chunk without a CRC, as other writers may make it, that ends within a message.
#[tokio::test(flavor = "multi_thread")]
async fn a_chunk_whose_records_end_early_is_told() {
    let mut runs = simulate_runs(&["flat"]);
    let whole = runs[0].1.clone();
    let header = 17 + u64::from_le_bytes(whole[9..17].try_into().expect("a length")) as usize;
    let records = [&[0x05][..], &100_u64.to_le_bytes(), &[7; 50]].concat();
    let length = (records.len() as u64).to_le_bytes();
    // Times, uncompressed size, no CRC, no compression, records.
    let body = [&[0; 16][..], &length, &[0; 8], &length, &records].concat();
    let chunk = [&[0x06][..], &(body.len() as u64).to_le_bytes(), &body].concat();
    runs[0].1 = [&whole[..header], &chunk, &whole[header..]].concat().into();
    let reports = ingest_pending(with_inbox(&runs).await).await.expect("ingested");
    let [FileReport::Ingested(taken)] = reports.as_slice() else { panic!("{reports:?}") };
    assert_eq!(taken.measurements, 45);
    let place = format!("the chunk at byte {header}: a record ends early");
    assert!(taken.damaged.iter().any(|d| d.starts_with(&place)), "{:?}", taken.damaged);
}

// Removes a run and derives what rested on it.
async fn remove_run(store: Arc<dyn ObjectStore>, file: &str, kept: RemovedFile) -> crate::Result<()> {
    let lake = open_lake(store).await?;
    let ingest = LakeIngest::new(&lake, Arc::default());
    match find_removals(&lake, &[file.to_owned()]).await {
        // The first time was enough.
        Err(Error::NoRun { .. }) => {}
        found => ingest.remove_runs(&mut found?, kept, "a test").await?,
    }
    ingest.complete_runs(&mut |_, _| {}).await?;
    Ok(())
}

mod slow {
    use super::*;

    // An earlier version took half of a copy for a run, and the whole file comes.
    #[tokio::test(flavor = "multi_thread")]
    async fn a_whole_file_replaces_its_beginning_whatever_dies_on_the_way() {
        let runs = simulate_runs(&["flat", "foam", "wood"]);
        let undisturbed = with_inbox(&runs).await;
        ingest_pending(undisturbed.clone()).await.expect("ingested");
        let expected = read_tables(undisturbed).await;
        let (name, whole) = &runs[2];
        let in_inbox = Path::from(format!("inbox/{name}"));
        let start = with_inbox(&runs[..2]).await;
        ingest_pending(start.clone()).await.expect("ingested");
        let half = whole.slice(..whole.len() * 3 / 5);
        start.put(&in_inbox, half.into()).await.expect("written");
        let lake = open_lake(start.clone()).await.expect("a lake");
        let partial = LakeIngest::new(&lake, Arc::default())
            .ingest_without_end(&RunSource::Lake(in_inbox.clone()))
            .await
            .expect("ingested as it was once");
        assert!(partial.measurements < 45 && !partial.whole, "{partial:?}");
        start.put(&in_inbox, whole.clone().into()).await.expect("written");
        let deaths = each_death(&start, ingest_pending, async |inner, death| {
            let reports = ingest_pending(inner.clone()).await.unwrap_or_else(|e| panic!("{death}: {e}"));
            assert!(reports.iter().all(|r| matches!(r, FileReport::Ingested(_))), "{death}: {reports:?}");
            assert!(read_tables(inner.clone()).await == expected, "{death}: other files");
            let kept = inner.get(&Path::from(format!("runs/wood/{name}"))).await.expect("there");
            assert!(kept.bytes().await.expect("bytes") == *whole, "{death}: another file");
            assert!(inner.head(&in_inbox).await.is_err(), "{death}: it is still in the inbox");
        })
        .await;
        assert!(deaths > 20, "{deaths} deaths");

        // Two files in one are no longer file: what the lake has ends as a closed file does.
        let both = [&runs[0].1[..], &runs[1].1[..]].concat();
        start.put(&Path::from(format!("inbox/{}", runs[0].0)), both.into()).await.expect("written");
        let reports = ingest_pending(start.clone()).await.expect("ingested");
        let refused = |r: &FileReport| matches!(r, FileReport::Refused { why: Error::OtherContent { .. }, .. });
        assert!(reports.iter().any(refused), "{reports:?}");
    }

    // A death at each write of a removal: once it is repeated, the lake's rows are those of one that never had the run.
    #[tokio::test(flavor = "multi_thread")]
    async fn a_removed_run_leaves_nothing_whatever_dies_on_the_way() {
        let runs = simulate_runs(&["flat", "foam", "wood", "flat"]);
        for (removed, is_merged) in [(2, false), (3, true)] {
            let mut others = runs.clone();
            let (name, bytes) = others.remove(removed);
            let without = with_inbox(&others).await;
            ingest_pending(without.clone()).await.expect("ingested");
            let expected = read_rows(without).await;
            let start = with_inbox(&runs).await;
            ingest_pending(start.clone()).await.expect("ingested");
            if is_merged {
                tidy_lake(start.clone()).await.expect("merged");
            }
            let surface = if removed == 2 { "wood" } else { "flat" };
            let work = async |store| remove_run(store, &name, RemovedFile::Kept).await;
            let deaths = each_death(&start, work, async |inner, death| {
                // What readers see meanwhile is the run as a whole, or nothing of it.
                ingest_pending(inner.clone()).await.unwrap_or_else(|e| panic!("{death}: {e}"));
                let seen = read_rows(inner.clone()).await[Table::Runs.name()].len();
                assert!(seen == 3 || seen == 4, "{death}: {seen} runs");
                remove_run(inner.clone(), &name, RemovedFile::Kept).await.unwrap_or_else(|e| panic!("{death}: {e}"));
                assert!(ingest_pending(inner.clone()).await.expect("ingested").is_empty(), "{death}: it is back");
                let actual = read_rows(inner.clone()).await;
                for (table, rows) in &expected {
                    assert!(actual[table] == *rows, "{death}: other rows of {table}");
                }
                assert!(inner.head(&Path::from(format!("runs/{surface}/{name}"))).await.is_err(), "{death}");
                let kept = inner.get(&Path::from(format!("quarantine/{name}"))).await;
                let kept = match kept {
                    Ok(kept) => kept,
                    // It died between the reason and the file.
                    Err(_) => inner.get(&Path::from(format!("quarantine/2-{name}"))).await.expect("kept"),
                };
                assert!(kept.bytes().await.expect("bytes") == bytes, "{death}: another file is kept");
            })
            .await;
            assert!(deaths > 20, "{deaths} deaths");
        }
    }

    // A death at each write, made or not: afterwards ingest is run once more, and the tables are those of an ingest
    // that nothing disturbed, byte for byte.
    #[tokio::test(flavor = "multi_thread")]
    async fn a_death_at_any_write_is_repaired_by_running_again() {
        let runs = simulate_runs(&["flat", "foam", "wood"]);
        let start = with_inbox(&runs).await;
        let undisturbed = Arc::new(start.fork());
        ingest_pending(undisturbed.clone()).await.expect("ingested");
        let expected = read_tables(undisturbed).await;
        assert_eq!(
            expected.0.keys().cloned().collect::<Vec<_>>(),
            expected.1,
            "nothing but what is seen is in the logs"
        );
        let deaths = each_death(&start, ingest_pending, async |inner, death| {
            ingest_pending(inner.clone()).await.unwrap_or_else(|e| panic!("{death}: {e}"));
            let (seen, logged) = read_tables(inner).await;
            assert_eq!(logged, expected.1, "{death}");
            assert!(seen == expected.0, "{death}: other bytes");
        })
        .await;
        // Each of two groups has nine files, each table a commit, each of three runs' files a move.
        assert!(deaths > 2 * 35, "{deaths} deaths");
    }

    // A death at each write of a merge and of the clean-up behind it: readers see the same rows at once, and once it is
    // run again the files are those of one that nothing disturbed.
    #[tokio::test(flavor = "multi_thread")]
    async fn a_death_at_any_write_of_the_upkeep_changes_no_row() {
        let start = with_inbox(&simulate_runs(&["flat", "foam", "wood"])).await;
        ingest_pending(start.clone()).await.expect("ingested");
        let before = read_rows(Arc::new(start.fork())).await;
        let undisturbed = Arc::new(start.fork());
        tidy_lake(undisturbed.clone()).await.expect("tidied");
        assert!(read_rows(undisturbed.clone()).await == before, "other rows");
        let files = async |store: Arc<InMemory>| {
            let listed: Vec<_> = store.list(Some(&Path::from("tables"))).try_collect().await.expect("listed");
            listed.iter().filter(|f| f.location.extension() == Some("parquet")).count()
        };
        let expected = read_tables(undisturbed.clone()).await;
        let kept = files(undisturbed).await;
        assert!(kept < files(start.clone()).await, "files are merged");
        let deaths = each_death(&start, tidy_lake, async |inner, death| {
            assert!(read_rows(inner.clone()).await == before, "{death}: other rows");
            // As if the lease had expired.
            let leases: Vec<_> =
                inner.list(Some(&Path::from("tables/_maintenance"))).try_collect().await.expect("listed");
            for lease in leases {
                inner.delete(&lease.location).await.expect("deleted");
            }
            tidy_lake(inner.clone()).await.unwrap_or_else(|e| panic!("{death}: {e}"));
            assert!(read_tables(inner.clone()).await == expected, "{death}: other files");
            // Unnamed files stay for an hour, because a concurrent ingest may be about to commit them.
            assert!(files(inner).await <= kept + 1, "{death}: files are left over");
        })
        .await;
        // A merge of each of ten tables is a file and a commit; 20 files are deleted; two leases are taken and given
        // back.
        assert!(deaths > 2 * 40, "{deaths} deaths");
    }

    // Three machines: two ingest, the third cleans up without end.
    #[tokio::test(flavor = "multi_thread")]
    async fn two_ingests_and_a_clean_up_with_any_clocks_lose_nothing_and_double_nothing() {
        let runs = simulate_runs(&["flat", "foam", "wood", "prd", "brick", "wavy", "flat_2", "wood_2"]);
        let undisturbed = with_inbox(&runs).await;
        ingest_pending(undisturbed.clone()).await.expect("ingested");
        let expected = read_rows(undisturbed).await;
        let equal = TimeDelta::zero();
        for [a, b, third] in [[equal, equal, equal], [SKEW, -SKEW, equal], [equal, SKEW, -SKEW], [-SKEW, equal, SKEW]] {
            let store = with_inbox(&runs).await;
            let done = Arc::new(AtomicBool::new(false));
            let clean_up = tokio::spawn({
                let store = skewed_store(&store, third, None);
                let done = done.clone();
                async move {
                    let lake = open_lake(store).await.expect("opened");
                    while !done.load(Ordering::SeqCst) {
                        lake.remove_superseded().await.expect("cleaned up");
                        tokio::task::yield_now().await;
                    }
                }
            });
            let a = ingest_pending(skewed_store(&store, a, None));
            let b = ingest_pending(skewed_store(&store, b, None));
            let a = tokio::spawn(a);
            let b = tokio::spawn(b);
            a.await.expect("no panic").expect("ingested");
            b.await.expect("no panic").expect("ingested");
            // Each completes what it saw; the last one to end has seen everything.
            ingest_pending(store.clone()).await.expect("ingested");
            done.store(true, Ordering::SeqCst);
            clean_up.await.expect("no panic");
            // Which runs share a file is a matter of chance.
            let (seen, logged) = read_tables(store.clone()).await;
            assert_eq!(seen.into_keys().collect::<Vec<_>>(), logged, "nothing but what is seen is in the logs");
            assert!(read_rows(store).await == expected, "other rows");
        }
    }

    // Of eight runs, a process that died had claimed one, and had brought it to its place; a live one gives its own
    // back.
    #[tokio::test(flavor = "multi_thread")]
    async fn what_others_claimed_and_did_not_do_is_done_after_a_while_and_by_one_ingest_alone() {
        let runs = simulate_runs(&["flat", "foam", "wood", "prd", "brick", "wavy", "flat_2", "wood_2"]);
        let undisturbed = with_inbox(&runs).await;
        ingest_pending(undisturbed.clone()).await.expect("ingested");
        let expected = read_rows(undisturbed).await;
        let store = with_inbox(&runs).await;
        let lake = open_lake(store.clone()).await.expect("a lake");
        let never = ClaimTimes { renew_every: Duration::from_secs(3600), ..IMPATIENT };
        let dead = WorkClaims::start(&lake, never);
        assert_eq!(dead.claim_work(&runs[2].0).await, ClaimOutcome::Granted);
        let from = format!("inbox/{}", runs[2].0);
        let to = format!("runs/wood/{}", runs[2].0);
        store.rename(&Path::from(from), &Path::from(to)).await.expect("moved");
        let alive = WorkClaims::start(&lake, IMPATIENT);
        assert_eq!(alive.claim_work(&runs[3].0).await, ClaimOutcome::Granted);
        let work = async || {
            let mut taken = Vec::new();
            let mut claimed = 0;
            let sources = pending_runs(&lake).await.expect("listed");
            let ingest = LakeIngest::new(&lake, Arc::default()).with_claims(IMPATIENT);
            let report = &mut |report: FileReport| match report {
                FileReport::Ingested(run) => taken.push(run.run.to_string()),
                FileReport::Claimed(_) => claimed += 1,
                FileReport::Gone(_) => {}
                FileReport::Refused { source, why, .. } => panic!("{source}: {why}"),
            };
            ingest.ingest_runs(sources, report).await.expect("ingested");
            ingest.release_claims().await;
            (taken, claimed)
        };
        let give_back = async {
            tokio::time::sleep(Duration::from_secs(1)).await;
            alive.release_all().await;
        };
        let ((mut taken, claimed), (more, more_claimed), ()) = tokio::join!(work(), work(), give_back);
        assert!(claimed + more_claimed >= 3, "both waited: {claimed} {more_claimed}");
        taken.extend(more);
        taken.sort();
        let mut names: Vec<_> = runs.iter().map(|(name, _)| name.trim_end_matches(".mcap").to_owned()).collect();
        names.sort();
        assert_eq!(taken, names, "each once");
        LakeIngest::new(&lake, Arc::default()).complete_runs(&mut |_, _| {}).await.expect("completed");
        assert!(read_rows(store).await == expected, "other rows");
    }

    // Two complete what waited for references, and the references themselves; each run once.
    #[tokio::test(flavor = "multi_thread")]
    async fn completions_are_shared() {
        let runs = simulate_runs(&["wood", "prd", "brick", "wavy", "flat", "foam"]);
        let store = with_inbox(&runs[..4]).await;
        ingest_pending(store.clone()).await.expect("ingested");
        for (name, bytes) in &runs[4..] {
            store.put(&Path::from(format!("inbox/{name}")), bytes.clone().into()).await.expect("written");
        }
        let lake = open_lake(store.clone()).await.expect("a lake");
        let sources = pending_runs(&lake).await.expect("listed");
        LakeIngest::new(&lake, Arc::default()).ingest_runs(sources, &mut |_| {}).await.expect("ingested");
        let work = async || {
            let mut completed = Vec::new();
            let ingest = LakeIngest::new(&lake, Arc::default()).with_claims(ClaimTimes::default());
            let done = &mut |run: &CompletedRun, _| completed.push(run.run.to_string());
            let summary = ingest.complete_runs(done).await.expect("completed");
            ingest.release_claims().await;
            assert_eq!(summary.changed, completed.len());
            completed
        };
        let (mut completed, more) = tokio::join!(work(), work());
        completed.extend(more);
        completed.sort();
        let mut names: Vec<_> = runs.iter().map(|(name, _)| name.trim_end_matches(".mcap").to_owned()).collect();
        names.sort();
        assert_eq!(completed, names);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn upkeep_beside_ingest_loses_nothing_and_doubles_nothing() {
        let surfaces = ["flat", "foam", "wood", "prd", "brick", "wavy", "flat_2", "wood_2"];
        let runs = simulate_runs(&surfaces);
        let undisturbed = with_inbox(&runs).await;
        ingest_pending(undisturbed.clone()).await.expect("ingested");
        let expected = read_rows(undisturbed).await;
        let store = with_inbox(&runs[..2]).await;
        ingest_pending(store.clone()).await.expect("ingested");
        let done = Arc::new(AtomicBool::new(false));
        let upkeep = tokio::spawn({
            let store = store.clone();
            let done = done.clone();
            async move {
                let mut rounds = 0;
                while !done.load(Ordering::SeqCst) {
                    tidy_lake(store.clone()).await.expect("tidied");
                    rounds += 1;
                }
                rounds
            }
        });
        for (name, bytes) in &runs[2..] {
            store.put(&Path::from(format!("inbox/{name}")), bytes.clone().into()).await.expect("written");
            // Nothing is kept for readers here, so that ingest may find a file gone that was merged meanwhile: it is
            // run again.
            let mut tries = 0;
            while let Err(e) = ingest_pending(store.clone()).await {
                tries += 1;
                assert!(tries < 20, "{name}: {e}");
            }
        }
        done.store(true, Ordering::SeqCst);
        assert!(upkeep.await.expect("no panic") > 0);
        ingest_pending(store.clone()).await.expect("ingested");
        let seen = read_rows(store).await;
        for (table, rows) in &expected {
            assert_eq!(seen.get(table).map(Vec::len), Some(rows.len()), "{table}");
        }
        assert!(seen == expected, "other rows");
    }

    // The rows that replace others are in their logs, and another machine cleans up before `runs` names them.
    #[tokio::test(flavor = "multi_thread")]
    async fn a_clean_up_just_before_the_rows_are_named_takes_none_of_them_whatever_the_clocks_say() {
        let runs = simulate_runs(&["flat", "foam", "wood", "flat"]);
        let undisturbed = with_inbox(&runs[..3]).await;
        ingest_pending(undisturbed.clone()).await.expect("ingested");
        let (name, bytes) = &runs[3];
        let inbox = Path::from(format!("inbox/{name}"));
        undisturbed.put(&inbox, bytes.clone().into()).await.expect("written");
        ingest_pending(undisturbed.clone()).await.expect("ingested");
        let expected = read_tables(undisturbed).await;
        for (first, second) in [(SKEW, -SKEW), (-SKEW, SKEW), (SKEW, TimeDelta::zero())] {
            let store = with_inbox(&runs[..3]).await;
            ingest_pending(skewed_store(&store, first, None)).await.expect("ingested");
            store.put(&inbox, bytes.clone().into()).await.expect("written");
            let other = store.clone();
            let clean_up: Interlude = Arc::new(move || {
                let store = skewed_store(&other, first, None);
                Box::pin(async move {
                    open_lake(store).await.expect("opened").remove_superseded().await.expect("cleaned up");
                })
            });
            ingest_pending(skewed_store(&store, second, Some(clean_up))).await.expect("ingested");
            let (seen, logged) = read_tables(store).await;
            assert_eq!(logged, expected.1, "clocks {first} and {second}");
            assert!(seen == expected.0, "clocks {first} and {second}: other bytes");
        }
    }
}

/// Claims of processes that died are dead soon.
const IMPATIENT: ClaimTimes =
    ClaimTimes { renew_every: Duration::from_millis(100), dead_after: Duration::from_secs(3) };

#[tokio::test(flavor = "multi_thread")]
async fn another_file_in_a_runs_place_is_not_taken_for_it_though_it_is_as_long() {
    let runs = simulate_runs(&["flat"]);
    let (name, bytes) = &runs[0];
    let store = with_inbox(&runs).await;
    let mut other = bytes.to_vec();
    let middle = other.len() / 2;
    other[middle] ^= 1;
    let place = Path::from(format!("runs/flat/{name}"));
    store.put(&place, other.clone().into()).await.expect("written");
    let lake = open_lake(store.clone()).await.expect("a lake");
    let mut reports = Vec::new();
    let source = RunSource::Lake(Path::from(format!("inbox/{name}")));
    LakeIngest::new(&lake, Arc::default()).ingest_runs(vec![source], &mut |r| reports.push(r)).await.expect("ingested");
    let [FileReport::Refused { why, moved: Some(moved), .. }] = reports.as_slice() else { panic!("{reports:?}") };
    assert!(why.to_string().contains("already in the lake with other content"), "{why}");
    assert_eq!(store.get(moved).await.expect("there").bytes().await.expect("bytes"), bytes);
    assert_eq!(store.get(&place).await.expect("there").bytes().await.expect("bytes"), other);
}
