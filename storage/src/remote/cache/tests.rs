//! The cache over a store that counts requests: bytes are the store's, and what is known is not asked for.

use std::path::Path as FsPath;
use std::sync::Arc;

use bytes::Bytes;
use echolake_testing::StoreDouble;
use futures::future::join_all;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{GetOptions, ObjectStore, ObjectStoreExt as _};

use super::block_cache::BLOCK_BYTES;
use super::{BlockCache, BlockFolder, CacheCounters, CacheCounts, CacheFolder, CachedStore};

const FILE: &str = "tables/nce/flat.r1.ab.parquet";
/// Not a whole number of blocks.
const FILE_BYTES: u64 = 5 * BLOCK_BYTES + 17;

fn content() -> Bytes {
    (0..FILE_BYTES).map(|at| (at.wrapping_mul(2_654_435_761) >> 13) as u8).collect()
}

async fn store() -> Arc<StoreDouble<()>> {
    let store = StoreDouble::new(Arc::new(InMemory::new()), ());
    store.put(&Path::from(FILE), content().into()).await.expect("written");
    store.take_requests();
    store
}

fn cached(store: &Arc<StoreDouble<()>>, folder: Option<BlockFolder>) -> CachedStore {
    CachedStore::new(store.clone(), Arc::new(BlockCache::new(folder)))
}

fn folder(path: &FsPath, blocks: u64, lake: &str) -> BlockFolder {
    let folder = CacheFolder { path: path.to_owned(), bytes: blocks * BLOCK_BYTES };
    BlockFolder::open(&folder, lake).expect("opened")
}

fn block_files(path: &FsPath) -> Vec<std::path::PathBuf> {
    let entries = std::fs::read_dir(path).expect("listed").map(|entry| entry.expect("an entry").path());
    let files = entries.flat_map(|path| if path.is_dir() { block_files(&path) } else { vec![path] });
    files.filter(|path| path.file_name().is_some_and(|name| name != "usage")).collect()
}

#[tokio::test]
async fn ranges_are_those_of_the_store_and_a_block_is_fetched_once() {
    let (store, content) = (store().await, content());
    let cached = cached(&store, None);
    let path = Path::from(FILE);
    let ends = [0, 1, BLOCK_BYTES - 1, BLOCK_BYTES, BLOCK_BYTES + 1, 3 * BLOCK_BYTES, FILE_BYTES - 1, FILE_BYTES];
    for start in ends {
        for end in ends.into_iter().filter(|end| start < *end) {
            let bytes = cached.get_range(&path, start..end).await.expect("read");
            assert!(bytes == content[start as usize..end as usize], "{start}..{end}");
        }
    }
    let fetched = cached.block_cache().read_counts();
    assert_eq!((fetched.misses, fetched.fetched_bytes), (6, FILE_BYTES), "each block once");
    store.take_requests();
    let ranges = [10..20, BLOCK_BYTES - 5..BLOCK_BYTES + 5, FILE_BYTES - 3..FILE_BYTES];
    let parts = cached.get_ranges(&path, &ranges).await.expect("read");
    for (part, range) in parts.iter().zip(&ranges) {
        assert_eq!(part[..], content[range.start as usize..range.end as usize], "{range:?}");
    }
    let beyond = cached.get_range(&path, FILE_BYTES - 3..FILE_BYTES + 9).await.expect("read");
    assert_eq!(beyond[..], content[FILE_BYTES as usize - 3..], "clipped as a store does");
    let found = cached.get_opts(&path, GetOptions::new().with_range(Some(5..9))).await.expect("read");
    assert_eq!((found.meta.size, found.range.clone()), (FILE_BYTES, 5..9));
    assert_eq!(store.take_requests(), [""; 0]);
    assert!(cached.get_range(&path, FILE_BYTES..FILE_BYTES + 1).await.is_err(), "there is nothing");
    assert!(cached.get_range(&"tables/nce/flat.r2.ab.parquet".into(), 0..9).await.is_err(), "no such object");
}

#[tokio::test(flavor = "multi_thread")]
async fn many_readers_at_once_cost_one_request() {
    let (store, content) = (store().await, content());
    let cached = cached(&store, None);
    let read = |_| {
        let cached = cached.clone();
        tokio::spawn(async move { cached.get_range(&Path::from(FILE), 0..FILE_BYTES).await.expect("read") })
    };
    for bytes in join_all((0..20).map(read)).await {
        assert!(bytes.expect("no panic") == content);
    }
    assert_eq!(store.take_requests(), [format!("GET {FILE}")]);
    // A reader that gives up leaves the block to the next one.
    let second = Path::from("runs/flat/r1.mcap");
    store.put(&second, content.clone().into()).await.expect("written");
    let given_up = cached.get_range(&second, 0..5);
    drop(tokio::time::timeout(std::time::Duration::ZERO, given_up).await);
    assert_eq!(cached.get_range(&second, 0..5).await.expect("read"), content.slice(0..5));
}

#[tokio::test]
async fn what_may_change_is_not_cached() {
    let store = store().await;
    let cached = cached(&store, None);
    for name in [
        "lake.toml",
        "inbox/x.mcap",
        "runs/flat/x.mcap.partial",
        "tables/pairs/rig.v7.parquet",
        "tables/runs/_delta_log/00000000000000000001.json",
        "tables/runs/_delta_log/00000000000000000020.checkpoint.parquet",
        "tables/_maintenance/lease.json",
    ] {
        let path = Path::from(name);
        for text in ["before", "behind"] {
            store.put(&path, text.into()).await.expect("written");
            assert_eq!(cached.get_range(&path, 0..6).await.expect("read"), text, "{name}");
        }
    }
    assert_eq!(cached.block_cache().read_counts(), CacheCounts::default());
}

#[tokio::test]
async fn processes_share_a_folder_and_damage_is_fetched_again() {
    let (store, content, place) = (store().await, content(), tempfile::tempdir().expect("a folder"));
    let read = async |lake: &str, scan: &Arc<CacheCounters>| {
        let cached = cached(&store, Some(folder(place.path(), 100, lake))).for_scan(scan.clone());
        assert!(cached.get_range(&Path::from(FILE), 0..FILE_BYTES).await.expect("read") == content);
        store.take_requests().len()
    };
    let scan = Arc::new(CacheCounters::default());
    assert_eq!((read("lake", &scan).await, read("lake", &scan).await), (1, 0));
    let expected = CacheCounts { disk_hits: 6, misses: 6, requests: 1, fetched_bytes: FILE_BYTES, memory_hits: 0 };
    assert_eq!(scan.read_counts(), expected);
    assert_eq!(read("another", &scan).await, 1, "its objects have the same names");
    let damage: [fn(&mut Vec<u8>); 4] = [
        |bytes| bytes.truncate(9),
        |bytes| bytes.truncate(bytes.len() - 1),
        |bytes| bytes.clear(),
        |bytes| {
            if let Some(byte) = bytes.last_mut() {
                *byte ^= 1;
            }
        },
    ];
    for damage in damage {
        for path in block_files(place.path()) {
            let mut bytes = std::fs::read(&path).expect("read");
            damage(&mut bytes);
            std::fs::write(&path, bytes).expect("written");
        }
        assert_eq!((read("lake", &scan).await, read("lake", &scan).await), (1, 0), "fetched again, and kept again");
    }
    std::fs::remove_dir_all(place.path()).expect("deleted");
    assert_eq!((read("lake", &scan).await, read("lake", &scan).await), (1, 0), "the folder is made anew");
}

#[tokio::test(flavor = "multi_thread")]
async fn all_processes_together_keep_to_the_limit_and_keep_what_was_read_last() {
    let (store, place) = (store().await, tempfile::tempdir().expect("a folder"));
    let objects: Vec<_> = (0..6).map(|number| Path::from(format!("runs/flat/r{number}.mcap"))).collect();
    for object in &objects {
        store.put(object, content().into()).await.expect("written");
    }
    let fill = |lake: String| {
        let (store, objects, folder) = (store.clone(), objects.clone(), folder(place.path(), 16, &lake));
        tokio::spawn(async move {
            let cached = cached(&store, Some(folder));
            for object in &objects {
                cached.get_range(object, 0..FILE_BYTES).await.expect("read");
            }
        })
    };
    for filled in join_all((0..4).map(|lake| fill(lake.to_string()))).await {
        filled.expect("no panic");
    }
    let used = || -> u64 { block_files(place.path()).iter().map(|path| path.metadata().expect("there").len()).sum() };
    let counted = std::fs::read_to_string(place.path().join("usage")).expect("read");
    assert!((8 * BLOCK_BYTES..=16 * BLOCK_BYTES).contains(&used()), "{} bytes", used());
    assert_eq!(counted.trim().parse::<u64>().expect("a number"), used());

    // What was not read for longest goes first, and a writer that died leaves nothing for good.
    let old = std::time::SystemTime::now() - std::time::Duration::from_secs(3600);
    let abandoned = place.path().join("0.1-1.partial");
    std::fs::write(&abandoned, [0; 100]).expect("written");
    for path in block_files(place.path()) {
        std::fs::File::options().write(true).open(path).and_then(|file| file.set_modified(old)).expect("touched");
    }
    std::fs::write(place.path().join("usage"), "cut o").expect("written");
    for _ in 0..2 {
        cached(&store, Some(folder(place.path(), 16, "new"))).get_range(&objects[0], 0..9).await.expect("read");
    }
    for object in &objects[1..3] {
        let cached = cached(&store, Some(folder(place.path(), 16, "new")));
        cached.get_range(object, 0..FILE_BYTES).await.expect("read");
    }
    store.take_requests();
    let again = cached(&store, Some(folder(place.path(), 16, "new")));
    again.get_range(&objects[0], 0..9).await.expect("read");
    assert_eq!(again.block_cache().read_counts().disk_hits, 1);
    assert!(used() <= 16 * BLOCK_BYTES && !abandoned.exists(), "{} bytes", used());
}
