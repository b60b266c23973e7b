//! Rebuilds a recording that was cut off or damaged from all that is whole of it. The original is only read.

mod copy;
mod error;
mod survey;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions, TryLockError};
use std::ops::Range;
use std::path::{Path, PathBuf};

use echolake_recording::{ChunkWriter, McapError, Metadata, RecordingReader, prove_file, system_cause};
use echolake_schema::topics;
use serde::Serialize;

use crate::disk::{folder_of, sync_to_disk};
pub(crate) use copy::{MessageCounts, RecordingCopy, is_end};
pub use error::Error;
pub(crate) use survey::RecordingSurvey;

/// What became of a recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Report {
    /// The recording.
    pub from: PathBuf,
    /// The written run; `None` if the file is whole and has a run's name.
    pub to: Option<PathBuf>,
    /// Size of the recording, bytes.
    pub bytes: u64,
    /// Bytes of it that are whole: all that was kept.
    pub verified_bytes: u64,
    /// Messages that were kept, by topic.
    pub messages: BTreeMap<String, u64>,
    /// Whether it says how its run ended.
    pub has_end: bool,
    /// What is damaged, each with its place, in words.
    pub damage: Vec<String>,
    /// Bytes of the recording that were lost.
    pub lost: Vec<Range<u64>>,
}

impl Report {
    /// Bytes that could not be kept.
    pub fn lost_bytes(&self) -> u64 {
        self.bytes - self.verified_bytes
    }

    /// Returns whether nothing was lost.
    pub fn is_whole(&self) -> bool {
        self.lost.is_empty() && self.damage.is_empty()
    }
}

/// Where a recording is rebuilt to, if nobody says otherwise: beside it, under the name that it would have had, or
/// with `.recovered` in it where it has that name.
pub fn beside(from: &Path) -> PathBuf {
    if is_partial(from) { from.with_extension("") } else { from.with_extension("recovered.mcap") }
}

/// Rebuilds `from` as `to`, reads it back, and only then gives it its name. A whole file is left alone, unless it is a
/// recording that was stopped: it becomes a run of what it holds.
///
/// # Errors
/// [`Error`], [`Error::Busy`] where somebody records it; nothing stands at `to` then, and `from` is as it was.
pub fn recover(from: &Path, to: &Path) -> Result<Report, Error> {
    // What is being recorded goes on growing behind the copy.
    let _lock = lock(from)?;
    let survey = RecordingSurvey::from_file(from)?;
    survey.run_manifest(from)?;
    let mut report = survey.survey_report(from);
    if !is_partial(from) && report.is_whole() && prove_file(from).is_ok() {
        return Ok(report);
    }
    if to.exists() {
        return Err(Error::Exists { path: to.to_owned() });
    }
    let mut staged = to.as_os_str().to_owned();
    staged.push(".recovering");
    let staged = PathBuf::from(staged);
    let made = rebuild(from, &staged, &survey, &report).and_then(|()| compare(&staged, &report));
    let named = made.and_then(|()| publish(&staged, to));
    if let Err(error) = named {
        // Half a copy of what is whole elsewhere; the cause is told.
        let _ = std::fs::remove_file(&staged);
        return Err(error);
    }
    report.to = Some(to.to_owned());
    Ok(report)
}

/// Returns whether the name is that of an unfinished recording.
pub fn is_partial(path: &Path) -> bool {
    path.extension().is_some_and(|e| e == "partial")
}

fn rebuild(from: &Path, to: &Path, survey: &RecordingSurvey, report: &Report) -> Result<(), Error> {
    let failed = |e: McapError| Error::Write { path: to.to_owned(), source: system_cause(e) };
    let file = OpenOptions::new().write(true).create(true).truncate(true).open(to);
    let file = file.map_err(|e| failed(e.into()))?;
    let mut writer = ChunkWriter::new(file).map_err(failed)?;
    let mut walk = RecordingReader::open(from)?;
    let mut copy = RecordingCopy::new(&mut writer, &survey.channels);
    while let Some(item) = walk.next_item()? {
        copy.copy_item(item, &|_, _| true).map_err(failed)?;
    }
    let record = [
        ("software", concat!("echolake ", env!("CARGO_PKG_VERSION")).to_owned()),
        ("from", from.file_name().unwrap_or_default().to_string_lossy().into_owned()),
        ("bytes", report.bytes.to_string()),
        ("verified_bytes", report.verified_bytes.to_string()),
        ("defect", report.damage.join("; ")),
    ];
    let metadata = record.map(|(key, value)| (key.to_owned(), value)).into();
    let noted = writer
        .end_all()
        .and_then(|()| writer.mcap.write_metadata(&Metadata { name: topics::RECOVERY_METADATA.to_owned(), metadata }));
    noted.and_then(|()| writer.finish()).map_err(failed)
}

// What was written is read back from its first byte: by another reader for every CRC and the summary, and by ours for
// what it holds.
fn compare(written: &Path, expected: &Report) -> Result<(), Error> {
    let unproven = |text: String| Error::Unproven { path: written.to_owned(), source: text.into() };
    prove_file(written).map_err(unproven)?;
    let found = RecordingSurvey::from_file(written)?;
    if found.counts != expected.messages || found.has_end() != expected.has_end {
        return Err(unproven(format!("it has {:?}, read were {:?}", found.counts, expected.messages)));
    }
    Ok(())
}

fn publish(staged: &Path, to: &Path) -> Result<(), Error> {
    let failed = |e: std::io::Error| Error::Write { path: to.to_owned(), source: e.into() };
    if to.exists() {
        return Err(Error::Exists { path: to.to_owned() });
    }
    std::fs::rename(staged, to).map_err(failed)?;
    sync_to_disk(folder_of(to)).map_err(failed)
}

/// Locks a recording until the file is dropped; its recorder holds a lock as long as it lives.
///
/// # Errors
/// [`Error::Busy`] if somebody else holds the lock.
pub(crate) fn lock(partial: &Path) -> Result<File, Error> {
    let file = File::open(partial).map_err(|e| Error::Read { path: partial.to_owned(), source: e.into() })?;
    match file.try_lock() {
        Err(TryLockError::WouldBlock) => Err(Error::Busy { path: partial.to_owned() }),
        // A file system without locks cannot tell.
        _ => Ok(file),
    }
}
