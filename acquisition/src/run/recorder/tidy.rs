//! A run with a checkpoint after every pair has thousands of small chunks. Before it gets its name it is copied into
//! chunks of the usual size, and the copy is proven.

use std::fs::OpenOptions;
use std::path::Path;

use echolake_recording::{ChunkWriter, RecordingReader, prove_file};
use echolake_schema::ErrorCause;

use crate::disk::{folder_of, free_bytes, sync_to_disk};
use crate::recovery::{RecordingCopy, RecordingSurvey};

/// Puts a whole recording's messages into larger chunks. Until the copy is proven and on the disk the recording is as
/// it was; so it is where an error is returned.
pub(super) fn with_larger_chunks(partial: &Path, path: &Path) -> Result<(), ErrorCause> {
    let copy = path.with_extension("mcap.sealing");
    let made = replace_by_copy(partial, &copy);
    if made.is_err() {
        // Half a copy of what is whole.
        let _ = std::fs::remove_file(&copy);
    }
    made
}

fn replace_by_copy(partial: &Path, copy: &Path) -> Result<(), ErrorCause> {
    let survey = RecordingSurvey::from_file(partial)?;
    if let Some(damage) = survey.damage().first() {
        return Err(damage.clone().into());
    }
    if free_bytes(folder_of(copy)).is_ok_and(|free| free < survey.loss_and_size().1) {
        return Err("there is no room for a copy".into());
    }
    let file = OpenOptions::new().write(true).create(true).truncate(true).open(copy)?;
    let mut writer = ChunkWriter::new(file)?;
    let mut taken = RecordingCopy::new(&mut writer, &survey.channels);
    let mut walk = RecordingReader::open(partial)?;
    while let Some(item) = walk.next_item()? {
        taken.copy_item(item, &|_, _| true)?;
    }
    writer.finish()?;
    prove_file(copy)?;
    if RecordingSurvey::from_file(copy)?.counts != survey.counts {
        return Err("the copy has other messages".into());
    }
    std::fs::rename(copy, partial)?;
    Ok(sync_to_disk(folder_of(partial))?)
}
