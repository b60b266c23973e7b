//! The journal of an upload in parts: `RUN.mcap.upload` beside the run file. Its first line says which upload it is,
//! each further one which part is in the store. A line that a cut left unfinished is passed over.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, Read as _, Seek as _, Write as _};
use std::path::{Path as FsPath, PathBuf};

use object_store::path::Path;
use serde::{Deserialize, Serialize};

use super::RunUpload;
use crate::{Error, Result};

/// Suffix of a journal's name.
const SUFFIX: &str = "upload";
const HINT: &str = "; hint: the journal of an upload stands beside the run file; make its folder writable, or upload a \
    copy of the file";

/// A journal, locked while its upload runs.
#[derive(Debug)]
pub(super) struct UploadJournal {
    path: PathBuf,
    file: File,
    wanted: UploadHead,
    /// Id of the upload in the store, once it is begun.
    upload: Option<String>,
    /// Ids of the parts that are in the store, by number.
    parts: BTreeMap<usize, String>,
}

/// Identity of an upload.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct UploadHead {
    location: String,
    path: String,
    sha256: String,
    bytes: u64,
}

#[derive(Serialize, Deserialize)]
struct FirstLine {
    #[serde(flatten)]
    head: UploadHead,
    upload: String,
}

#[derive(Serialize, Deserialize)]
struct PartLine {
    part: usize,
    id: String,
}

impl UploadJournal {
    /// Opens the journal of a run file; one of another upload is begun anew.
    ///
    /// # Errors
    /// [`Error::UploadBusy`], or [`Error::UploadFile`] if it cannot be read or written.
    pub fn open(run: &RunUpload, location: &str, to: &Path) -> Result<Self> {
        let mut path = run.file.as_os_str().to_owned();
        path.push(".");
        path.push(SUFFIX);
        let path = PathBuf::from(path);
        let failed = |source| journal_error("open", &path, source);
        let mut file = OpenOptions::new().read(true).append(true).create(true).open(&path).map_err(failed)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(Error::UploadBusy { file: run.file.clone() }),
            Err(TryLockError::Error(source)) => return Err(failed(source)),
        }
        let mut text = Vec::new();
        file.read_to_end(&mut text).map_err(failed)?;
        let location = location.to_owned();
        let sha256 = run.sha256.clone();
        let wanted = UploadHead { location, path: to.to_string(), sha256, bytes: run.bytes };
        let (upload, parts) = parse_journal(&String::from_utf8_lossy(&text), &wanted).unwrap_or_default();
        let mut journal = Self { path, file, wanted, upload, parts };
        match journal.upload {
            // What is added must not continue a line that a cut left unfinished.
            Some(_) if text.last() != Some(&b'\n') => journal.append_text("\n")?,
            Some(_) => {}
            None => journal.restart_upload()?,
        }
        Ok(journal)
    }

    /// Returns whether parts may have been sent.
    pub fn is_begun(&self) -> bool {
        self.upload.is_some()
    }

    /// Id of the upload, once it is begun.
    pub fn upload_id(&self) -> Option<&str> {
        self.upload.as_deref()
    }

    /// Ids of the parts that are in the store, by number.
    pub fn part_ids(&self) -> &BTreeMap<usize, String> {
        &self.parts
    }

    /// Notes the beginning of an upload.
    pub fn begin_upload(&mut self, upload: String) -> Result<()> {
        let line = FirstLine { head: self.wanted.clone(), upload: upload.clone() };
        self.append_line(&line)?;
        self.upload = Some(upload);
        Ok(())
    }

    /// Notes a part that is in the store.
    pub fn add_part(&mut self, part: usize, id: String) -> Result<()> {
        self.append_line(&PartLine { part, id: id.clone() })?;
        self.parts.insert(part, id);
        Ok(())
    }

    /// Forgets the upload: it is begun anew.
    pub fn restart_upload(&mut self) -> Result<()> {
        (self.upload, self.parts) = (None, BTreeMap::new());
        let emptied = self.file.set_len(0).and_then(|()| self.file.rewind());
        emptied.map_err(|e| journal_error("write", &self.path, e))
    }

    /// Deletes it: the upload is at its end.
    pub fn delete_journal(self) -> Result<()> {
        std::fs::remove_file(&self.path).map_err(|e| journal_error("delete", &self.path, e))
    }

    fn append_line(&mut self, line: &impl Serialize) -> Result<()> {
        // Texts and numbers always have a JSON form.
        let text = serde_json::to_string(line).unwrap_or_default();
        self.append_text(&format!("{text}\n"))
    }

    // A whole line in one call, so that a kill leaves all of it or none.
    fn append_text(&mut self, text: &str) -> Result<()> {
        self.file.write_all(text.as_bytes()).map_err(|e| journal_error("write", &self.path, e))
    }
}

// None if the text is the journal of another upload, or of none.
fn parse_journal(text: &str, wanted: &UploadHead) -> Option<(Option<String>, BTreeMap<usize, String>)> {
    let mut lines = text.split_inclusive('\n').filter(|line| line.ends_with('\n'));
    let FirstLine { head, upload } = serde_json::from_str(lines.next()?).ok()?;
    if head != *wanted {
        return None;
    }
    let parts = lines.filter_map(|line| serde_json::from_str::<PartLine>(line).ok());
    Some((Some(upload), parts.map(|line| (line.part, line.id)).collect()))
}

fn journal_error(action: &'static str, path: &FsPath, source: io::Error) -> Error {
    Error::UploadFile { action, file: path.to_owned(), source, hint: HINT }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(folder: &tempfile::TempDir) -> RunUpload {
        RunUpload {
            file: folder.path().join("r.mcap"),
            surface: "flat".parse().expect("an id"),
            run: "r".parse().expect("an id"),
            bytes: 100,
            sha256: "ab".to_owned(),
        }
    }

    fn open(run: &RunUpload) -> Result<UploadJournal> {
        UploadJournal::open(run, "s3://bucket", &Path::from("inbox/r.mcap"))
    }

    #[test]
    fn a_journal_is_read_as_far_as_its_lines_are_whole() {
        let folder = tempfile::tempdir().expect("a folder");
        let run = run(&folder);
        let mut journal = open(&run).expect("new");
        assert!(!journal.is_begun());
        let busy = open(&run).expect_err("locked").to_string();
        assert!(busy.contains("r.mcap") && busy.contains("hint: "), "{busy}");
        journal.begin_upload("id".to_owned()).expect("written");
        journal.add_part(1, "one".to_owned()).expect("written");
        journal.append_text("{\"part\":0,\"i").expect("written");
        drop(journal);
        let mut journal = open(&run).expect("there");
        assert_eq!(journal.upload_id(), Some("id"));
        journal.add_part(2, "two".to_owned()).expect("written");
        drop(journal);
        let parts = open(&run).expect("there").part_ids().clone();
        assert_eq!(parts.keys().copied().collect::<Vec<_>>(), [1, 2]);
        open(&run).expect("there").delete_journal().expect("deleted");
        assert!(!open(&run).expect("new").is_begun());
    }

    #[test]
    fn a_journal_of_another_upload_is_begun_anew() {
        let folder = tempfile::tempdir().expect("a folder");
        let first = run(&folder);
        let others =
            [RunUpload { sha256: "cd".to_owned(), ..first.clone() }, RunUpload { bytes: 101, ..first.clone() }];
        for other in others {
            open(&first).expect("new").begin_upload("id".to_owned()).expect("written");
            assert!(!open(&other).expect("there").is_begun(), "{other:?}");
            assert!(!open(&first).expect("there").is_begun(), "forgotten");
        }
        open(&first).expect("new").begin_upload("id".to_owned()).expect("written");
        let elsewhere = UploadJournal::open(&first, "s3://other", &Path::from("inbox/r.mcap"));
        assert!(!elsewhere.expect("there").is_begun());
    }
}
