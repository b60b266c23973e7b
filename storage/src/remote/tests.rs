//! Stores whose answers are lost, cut off or refused, and stores that overwrite.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use async_trait::async_trait;
use echolake_schema::Rig;
use echolake_schema::tables::Table;
use echolake_testing::{RequestFate, RequestKind, StoreBehaviour, StoreDouble};
use futures::stream;
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{Error as StoreError, ObjectStore, ObjectStoreExt as _, PutMode, PutOptions, PutPayload};

use super::retrying::RETRY_LIMIT;
use super::{ExclusionFault, RetryingStore, probe_exclusion};
use crate::{CommitOutcome, Error, FileName, Lake, ReferenceSurfaces, encode_batches};

/// Faults of a store.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum StoreFault {
    /// Creating overwrites.
    Overwrites,
    /// Creating an object that exists is refused, unless both meet.
    OverwritesInRaces,
    /// Of ten commits two are made and not answered, one is lost, and one is said to conflict with nothing; of ten
    /// listings two are cut off; of twenty reads one fails.
    Unreliable,
    /// Every read fails: the store does not answer, or does not allow it.
    Unanswered,
    Forbidden,
    None,
}

/// Faults by chance, which follows from a seed.
#[derive(Debug)]
struct StoreFaults {
    fault: StoreFault,
    random: AtomicU64,
    count: AtomicUsize,
}

/// A store in memory with faults.
type FaultyStore = StoreDouble<StoreFaults>;

impl StoreFaults {
    fn in_memory(fault: StoreFault, seed: u64) -> Arc<FaultyStore> {
        let faults = Self { fault, random: AtomicU64::new(seed), count: AtomicUsize::new(0) };
        StoreDouble::new(Arc::new(InMemory::new()), faults)
    }

    // SplitMix64: Steele, Lea, Flood 2014, Fast splittable pseudorandom number generators.
    fn draw(&self, of: u64) -> u64 {
        let mut z = self.random.fetch_add(0x9e37_79b9_7f4a_7c15, Ordering::SeqCst).wrapping_add(0x9e37_79b9_7f4a_7c15);
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % of
    }

    fn lost(&self) -> StoreError {
        self.count.fetch_add(1, Ordering::SeqCst);
        StoreError::Generic { store: "faulty", source: "connection reset by peer".into() }
    }
}

#[async_trait]
impl StoreBehaviour for StoreFaults {
    fn decide_fate(&self, kind: RequestKind, path: Option<&Path>) -> RequestFate {
        let refused = |text: &str| {
            self.count.fetch_add(1, Ordering::SeqCst);
            RequestFate::Refused(StoreError::Generic { store: "faulty", source: text.to_owned().into() })
        };
        match self.fault {
            // As the client of object_store says that it sent a request twice.
            StoreFault::Unanswered if kind == RequestKind::Get => {
                return refused("Error performing GET x in 1s, after 1 retries, max_retries: 1 - connection refused");
            }
            StoreFault::Unanswered => return RequestFate::Refused(self.lost()),
            StoreFault::Forbidden => {
                return refused(
                    "Error performing GET x in 1s - Server returned non-2xx status code: 403 Forbidden: <?xml?>\
                     <Error><Code>AccessDenied</Code></Error>",
                );
            }
            StoreFault::Unreliable => {}
            _ => return RequestFate::Done,
        }
        let one_in = |count| self.draw(count) == 0;
        match kind {
            RequestKind::Create => match self.draw(10) {
                0 | 1 => RequestFate::AnswerLost(self.lost()),
                2 => RequestFate::Refused(self.lost()),
                3 => {
                    let (path, source) = (path.map(ToString::to_string).unwrap_or_default(), "409 Conflict".into());
                    RequestFate::Refused(StoreError::AlreadyExists { path, source })
                }
                _ => RequestFate::Done,
            },
            RequestKind::Get if one_in(20) => RequestFate::Refused(self.lost()),
            RequestKind::List if one_in(5) => RequestFate::AnswerLost(self.lost()),
            _ => RequestFate::Done,
        }
    }

    async fn change_put(&self, path: &Path, payload: PutPayload, options: &mut PutOptions) -> PutPayload {
        let overwrites = match self.fault {
            StoreFault::Overwrites => true,
            StoreFault::OverwritesInRaces => path.as_ref().ends_with(".race"),
            StoreFault::Unreliable | StoreFault::Unanswered | StoreFault::Forbidden | StoreFault::None => false,
        };
        if overwrites {
            options.mode = PutMode::Overwrite;
        }
        payload
    }
}

async fn lake(store: Arc<FaultyStore>) -> crate::Result<Lake> {
    let store = Arc::new(RetryingStore::new(store, RETRY_LIMIT));
    Lake::open_or_create_in(store, "s3://bucket/lake", &Rig::paper(), &ReferenceSurfaces::default()).await
}

#[tokio::test]
async fn a_store_that_overwrites_is_refused_before_anything_is_written() {
    let good: Arc<dyn ObjectStore> = Arc::new(InMemory::new());
    probe_exclusion(&good).await.expect("it excludes");
    let left: Vec<_> = good.list(None).try_collect().await.expect("listed");
    assert!(left.is_empty(), "{left:?}");
    for (fault, expected) in [
        (StoreFault::Overwrites, "an object that was there was created again"),
        (StoreFault::OverwritesInRaces, "8 of 8 that created the same object at once succeeded"),
    ] {
        let store = StoreFaults::in_memory(fault, 1);
        let probed = probe_exclusion(&(store.clone() as Arc<dyn ObjectStore>)).await;
        assert!(matches!(&probed, Err(ExclusionFault::Overwrites(_))), "{probed:?}");
        let error = lake(store.clone()).await.expect_err("refused");
        assert!(matches!(error, Error::NotExclusive { .. }), "{error}");
        assert!(error.to_string().contains("s3://bucket/lake") && error.to_string().contains(expected), "{error}");
        let left: Vec<_> = store.list(None).try_collect().await.expect("listed");
        assert!(left.is_empty(), "{left:?}");
    }
}

#[tokio::test]
async fn what_is_cut_off_is_fetched_again_and_what_never_comes_says_how_often_it_was_tried() {
    let faulty = StoreFaults::in_memory(StoreFault::Unreliable, 5);
    let store = RetryingStore::new(faulty.clone(), RETRY_LIMIT);
    let paths: Vec<_> = (0..10).map(|number| Path::from(format!("{number}"))).collect();
    for path in &paths {
        store.put(path, "x".into()).await.expect("written");
    }
    for _ in 0..20 {
        let listed: Vec<_> = store.list(None).try_collect().await.expect("listed");
        assert_eq!(listed.len(), paths.len());
    }
    store
        .delete_stream(stream::iter(paths.into_iter().map(Ok)).boxed())
        .try_collect::<Vec<_>>()
        .await
        .expect("deleted");
    assert!(faulty.behaviour.count.load(Ordering::SeqCst) > 0);
    let gone = Error::store_failure(
        "read",
        "x",
        StoreError::Generic {
            store: "remote",
            source: Box::new(super::RetriedError { tries: 8, source: faulty.behaviour.lost() }),
        },
    );
    let expected = "cannot read `x`: connection reset by peer (tried 8 times); hint: run the same command again when \
                    the store answers; what was done stays";
    assert_eq!(gone.to_string(), expected);
}

/// B3: the environment's number of tries is that of reads, too, and a refusal is not retried.
#[tokio::test]
async fn a_read_is_tried_as_often_as_the_environment_says() {
    for (fault, limit, requests, expected) in [
        (
            StoreFault::Unanswered,
            1,
            1,
            "connection reset by peer; hint: run the same command again when the store answers",
        ),
        (StoreFault::Unanswered, 3, 3, "(tried 3 times); hint: run the same command again when the store answers"),
        (StoreFault::Forbidden, 3, 1, "403 Forbidden, AccessDenied; hint: look at the store's credentials"),
    ] {
        let faulty = StoreFaults::in_memory(fault, 1);
        let store = RetryingStore::new(faulty.clone(), limit);
        let listed: Result<Vec<_>, _> = store.list(None).try_collect().await;
        let error = Error::store_failure("list", "x", listed.expect_err("refused")).to_string();
        assert!(error.contains(expected), "{error}");
        assert_eq!(faulty.behaviour.count.load(Ordering::SeqCst), requests, "{fault:?} {limit}");
    }
    // The client below has sent each of these twice.
    let faulty = StoreFaults::in_memory(StoreFault::Unanswered, 1);
    let error = RetryingStore::new(faulty.clone(), 4).get(&Path::from("x")).await.expect_err("refused");
    assert_eq!(faulty.behaviour.count.load(Ordering::SeqCst), 2);
    assert!(Error::store_failure("read", "x", error).to_string().contains("(tried 4 times)"));
}

#[tokio::test]
async fn a_view_costs_a_request_a_table_and_a_commit_of_many_runs_a_few() {
    let store = StoreFaults::in_memory(StoreFault::None, 1);
    let lake = lake(store.clone()).await.expect("made");
    lake.snapshot().await.expect("a view");
    store.take_requests();
    let before = lake.snapshot().await.expect("a view");
    let requests = store.take_requests();
    assert!(requests.len() <= 14, "{requests:?}");

    let tables = [Table::Nce, Table::Tnce, Table::Runs];
    let mut staged = Vec::new();
    for number in 0..16 {
        for table in tables {
            let (surface, run) = ("flat".parse().expect("an id"), format!("r{number}").parse().expect("an id"));
            let name = FileName::Rows { surface, run, derivation: "ab".into() };
            let file = encode_batches(table, &table.schema(lake.rig()), &[]).expect("encoded");
            staged.push(lake.stage_file(table, &name, file).await.expect("staged").made_from(&before));
        }
    }
    store.take_requests();
    lake.commit_staged(&staged).await.expect("committed");
    let requests = store.take_requests();
    for table in tables {
        let of_table = requests.iter().filter(|r| r.contains(&format!("tables/{}/", table.name()))).count();
        assert!((1..=6).contains(&of_table), "{table:?}: {requests:?}");
    }
    lake.commit_staged(&staged).await.expect("there before");
    assert_eq!(store.take_requests().len(), tables.len(), "a look at each");
}

mod slow {
    use super::*;

    // Four processes' worth of writers. Every call succeeds, says that the rows are new, and they are there once.
    #[tokio::test(flavor = "multi_thread")]
    async fn commits_whose_answers_are_lost_are_made_once_and_known_to_be_made() {
        for seed in 1..=3 {
            let store = StoreFaults::in_memory(StoreFault::Unreliable, seed);
            let rows = lake(store.clone()).await.expect("made").pair_rows().expect("rows");
            let write = |writer: usize| {
                let (store, rows) = (store.clone(), rows.clone());
                tokio::spawn(async move {
                    let lake = lake(store).await.expect("opened");
                    for number in 0..6 {
                        let name = FileName::Rig { derivation: format!("{writer}x{number}") };
                        let outcome = lake.append_rows(Table::Pairs, &name, std::slice::from_ref(&rows)).await;
                        assert_eq!(outcome.expect("committed"), CommitOutcome::Now, "seed {seed}, {writer}x{number}");
                    }
                })
            };
            for writer in [0, 1, 2, 3].map(write) {
                writer.await.expect("no panic");
            }
            let files =
                lake(store.clone()).await.expect("opened").commit_log().list_files(Table::Pairs).await.expect("files");
            assert_eq!(files.len(), 25, "seed {seed}: the rig's own and 24");
            assert!(store.behaviour.count.load(Ordering::SeqCst) > 20, "seed {seed}");
        }
    }
}
