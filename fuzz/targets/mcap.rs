//! Run files: the reader that searches for whole records after damage, in a store and on a disk, and the summary's.
#![no_main]

use std::sync::{Arc, LazyLock};

use bytes::Bytes;
use echolake_fuzz::ImportFolder;
use echolake_recording::{
    DecodedChunk, RecordingReader, ResyncItem, ResyncReader, RunSummary, prove_file, summary_range, tail_range,
};
use futures::executor::block_on;
use libfuzzer_sys::fuzz_target;
use object_store::ObjectStoreExt as _;
use object_store::memory::InMemory;
use object_store::path::Path;

static FOLDER: LazyLock<ImportFolder> = LazyLock::new(ImportFolder::new);

fuzz_target!(init: echolake_fuzz::write_seeds_on_request(), |bytes: &[u8]| {
    block_on(resync(bytes));
    read_summary(bytes);
    let path = FOLDER.write("input.mcap", bytes);
    let _ = prove_file(&path);
    if let Ok(mut reader) = RecordingReader::open(&path) {
        while let Ok(Some(_)) = reader.next_item() {}
    }
});

async fn resync(bytes: &[u8]) {
    let store = Arc::new(InMemory::new());
    let path = Path::from("input.mcap");
    store.put(&path, Bytes::copy_from_slice(bytes).into()).await.expect("in memory");
    let Ok(mut reader) = ResyncReader::open(store, path, "input.mcap".into()).await else { return };
    while let Ok(Some(item)) = reader.next_item().await {
        let ResyncItem::Chunk(chunk) = item else { continue };
        let decoded = DecodedChunk::decode(&chunk.body);
        let is_whole = decoded.as_ref().is_ok_and(|decoded| decoded.check_records().is_ok());
        let _ = decoded.map(|decoded| decoded.messages().count());
        drop(chunk.permit);
        if !is_whole {
            let _ = reader.look_into(chunk.offset).await;
        }
    }
    if let Ok(found) = reader.finish().await {
        assert_eq!(found.bytes, bytes.len() as u64);
    }
}

fn read_summary(bytes: &[u8]) {
    let size = bytes.len() as u64;
    let part = |range: std::ops::Range<u64>| bytes.get(range.start as usize..range.end as usize);
    let summary = part(tail_range(size)).and_then(|tail| summary_range(tail, size)).and_then(part);
    let _ = summary.map(RunSummary::parse);
}
