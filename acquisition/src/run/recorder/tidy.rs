//! A run with a checkpoint after every pair has thousands of small chunks. Before it gets its name it is copied into
//! chunks of the usual size, and the copy is proven.

use std::fs::OpenOptions;
use std::path::Path;

use echolake_recording::{ChunkWriter, PrefixReader, prove_file};

use crate::disk::{folder_of, free_bytes, sync};
use crate::recovery::Copy;

/// Puts a whole recording's messages into larger chunks. Until the copy is proven and on the disk the recording is as
/// it was; so it is where an error is returned.
pub(super) fn with_larger_chunks(partial: &Path, path: &Path) -> Result<(), String> {
    let copy = path.with_extension("mcap.sealing");
    let made = copied(partial, &copy);
    if made.is_err() {
        // Half a copy of what is whole.
        let _ = std::fs::remove_file(&copy);
    }
    made
}

fn copied(partial: &Path, copy: &Path) -> Result<(), String> {
    let words = |e: &dyn std::fmt::Display| e.to_string();
    let mut walk = PrefixReader::open(partial).map_err(|e| words(&e))?;
    if free_bytes(folder_of(copy)).is_ok_and(|free| free < walk.size) {
        return Err("there is no room for a copy".to_owned());
    }
    let file = OpenOptions::new().write(true).create(true).truncate(true).open(copy).map_err(|e| words(&e))?;
    let mut writer = ChunkWriter::new(file).map_err(|e| words(&e))?;
    let mut taken = Copy::new(&mut writer);
    while let Some(item) = walk.next_item().map_err(|e| words(&e))? {
        taken.take(item, &|_, _| true).map_err(|e| words(&e))?;
    }
    let counts = taken.counts;
    if let Some(defect) = walk.defect {
        return Err(defect);
    }
    writer.finish().map_err(|e| words(&e))?;
    prove_file(copy)?;
    if crate::recovery::messages(copy).map_err(|e| words(&e))? != counts {
        return Err("the copy has other messages".to_owned());
    }
    std::fs::rename(copy, partial).map_err(|e| words(&e))?;
    sync(folder_of(partial))
}
