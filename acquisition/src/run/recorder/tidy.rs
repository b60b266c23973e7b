//! A run with a checkpoint after every pair has thousands of small chunks. Before it gets its name it is copied into
//! chunks of the usual size, and the copy is proven.

use std::fs::OpenOptions;
use std::path::Path;

use echolake_recording::{ChunkWriter, PrefixReader, prove_file};
use echolake_schema::ErrorCause;

use crate::disk::{folder_of, free_bytes, sync};
use crate::recovery::Copy;

/// Puts a whole recording's messages into larger chunks. Until the copy is proven and on the disk the recording is as
/// it was; so it is where an error is returned.
pub(super) fn with_larger_chunks(partial: &Path, path: &Path) -> Result<(), ErrorCause> {
    let copy = path.with_extension("mcap.sealing");
    let made = copied(partial, &copy);
    if made.is_err() {
        // Half a copy of what is whole.
        let _ = std::fs::remove_file(&copy);
    }
    made
}

fn copied(partial: &Path, copy: &Path) -> Result<(), ErrorCause> {
    let mut walk = PrefixReader::open(partial)?;
    if free_bytes(folder_of(copy)).is_ok_and(|free| free < walk.size) {
        return Err("there is no room for a copy".into());
    }
    let file = OpenOptions::new().write(true).create(true).truncate(true).open(copy)?;
    let mut writer = ChunkWriter::new(file)?;
    let mut taken = Copy::new(&mut writer);
    while let Some(item) = walk.next_item()? {
        taken.take(item, &|_, _| true)?;
    }
    let counts = taken.counts;
    if let Some(defect) = walk.defect {
        return Err(defect.into());
    }
    writer.finish()?;
    prove_file(copy)?;
    if crate::recovery::messages(copy)? != counts {
        return Err("the copy has other messages".into());
    }
    std::fs::rename(copy, partial)?;
    Ok(sync(folder_of(partial))?)
}
