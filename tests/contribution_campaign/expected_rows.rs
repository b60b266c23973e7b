//! Rows as the test knows them, and tables' folders, which are read and damaged without the program.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use arrow::json::ArrayWriter;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use rand::Rng as _;
use rand_chacha::ChaCha8Rng;
use serde_json::Value;

use super::requests::{CLIENTS, SentRows, TABLES, is_visible, row_text};

/// A row that was sent.
struct ExpectedRow {
    /// Place in the order in which rows were sent.
    number: usize,
    project: Option<&'static str>,
    /// False if its request had no answer and was not repeated: then it may be there.
    is_acknowledged: bool,
}

/// The rows of the tables, by their text.
#[derive(Default)]
pub(super) struct ExpectedRows([BTreeMap<String, ExpectedRow>; TABLES.len()]);

impl ExpectedRows {
    /// Adds the rows of a request.
    pub fn add_rows(&mut self, sent: &SentRows, is_acknowledged: bool) {
        let rows = &mut self.0[sent.table];
        for (project, text) in &sent.rows {
            let row = ExpectedRow { number: rows.len(), project: *project, is_acknowledged };
            rows.entry(text.clone()).or_insert(row);
        }
    }

    /// Numbers of rows, by table.
    pub fn counts(&self) -> [usize; TABLES.len()] {
        [0, 1].map(|table| self.0[table].len())
    }

    /// Checks that all rows that a client may see are there once, and no others: those with a number below `before`.
    ///
    /// # Panics
    /// One is missing, there twice or not one of them.
    pub fn check_rows(&self, place: &str, client: usize, table: usize, answer: &Value, before: usize) {
        let place = format!("{place}: {} as {} sees them", TABLES[table].0, CLIENTS[client].0);
        let is_seen = |row: &ExpectedRow| row.number < before && is_visible(client, row.project);
        let mut found = BTreeMap::<String, usize>::new();
        for row in answer.as_array().expect("rows") {
            *found.entry(row_text(table, row)).or_default() += 1;
        }
        for (text, count) in &found {
            assert_eq!(*count, 1, "{place}: {text}");
            assert!(self.0[table].get(text).is_some_and(is_seen), "{place}: not one of them: {text}");
        }
        for (text, row) in &self.0[table] {
            assert!(!row.is_acknowledged || !is_seen(row) || found.contains_key(text), "{place}: lost: {text}");
        }
    }
}

/// A file that was lost or damaged.
pub(super) struct DamagedFile {
    pub path: PathBuf,
    /// Its bytes before.
    pub bytes: Vec<u8>,
    /// The name by which the fault must be told.
    pub named: String,
}

/// A table's folder, as any reader of Delta's protocol reads it.
pub(super) struct DeltaFolder {
    path: PathBuf,
    table: usize,
}

impl DeltaFolder {
    /// A table of the lake in a folder.
    pub fn new(folder: &Path, table: usize) -> Self {
        Self { path: folder.join("lake/tables").join(TABLES[table].0), table }
    }

    /// The rows of the newest version.
    pub fn read_rows(&self) -> Value {
        let mut writer = ArrayWriter::new(Vec::<u8>::new());
        for name in self.list_files() {
            let file = fs::File::open(self.path.join(name)).expect("it is there");
            let reader = ParquetRecordBatchReaderBuilder::try_new(file).expect("Parquet");
            let columns = ProjectionMask::columns(reader.parquet_schema(), TABLES[self.table].1.iter().copied());
            for rows in reader.with_projection(columns).build().expect("a reader") {
                writer.write(&rows.expect("rows")).expect("JSON");
            }
        }
        writer.finish().expect("ended");
        serde_json::from_slice(&writer.into_inner()).expect("JSON")
    }

    // The files of the newest version.
    fn list_files(&self) -> Vec<String> {
        let mut files = Vec::new();
        for commit in self.list_log(".json") {
            let text = fs::read_to_string(self.log_file(&commit, ".json")).expect("read");
            for line in text.lines() {
                let action: Value = serde_json::from_str(line).expect("an action");
                files.extend(action["add"]["path"].as_str().map(str::to_owned));
                files.retain(|file| action["remove"]["path"] != file.as_str());
            }
        }
        files.sort();
        files
    }

    /// Cuts, overwrites with zeros, empties or removes a file of the newest version, or removes a commit.
    pub fn damage_file(&self, sort: usize, random: &mut ChaCha8Rng) -> DamagedFile {
        let mut files = self.list_files();
        let mut commits = if sort == 4 { self.needed_commits() } else { Vec::new() };
        let (path, named) = if commits.is_empty() {
            let file = files.swap_remove(random.random_range(0..files.len()));
            (self.path.join(&file), file)
        } else {
            (commits.swap_remove(random.random_range(0..commits.len())), TABLES[self.table].0.to_owned())
        };
        let bytes = fs::read(&path).expect("read");
        let damaged = match sort {
            0 => fs::write(&path, &bytes[..random.random_range(1..bytes.len())]),
            1 => fs::write(&path, vec![0_u8; bytes.len()]),
            2 => fs::write(&path, ""),
            _ => fs::remove_file(&path),
        };
        damaged.expect("written");
        DamagedFile { path, bytes, named }
    }

    // The commits that readers need: those after the last checkpoint.
    fn needed_commits(&self) -> Vec<PathBuf> {
        let checkpoint = self.list_log(".checkpoint.parquet").pop();
        let commits = self.list_log(".json").into_iter().filter(|commit| Some(commit) > checkpoint.as_ref());
        commits.map(|commit| self.log_file(&commit, ".json")).collect()
    }

    // The versions of the log that have a file with this ending, as its names spell them.
    fn list_log(&self, ending: &str) -> Vec<String> {
        let listed = fs::read_dir(self.path.join("_delta_log")).expect("listed");
        let names = listed.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned());
        let mut versions: Vec<_> = names.filter_map(|name| name.strip_suffix(ending).map(str::to_owned)).collect();
        versions.sort();
        versions
    }

    fn log_file(&self, version: &str, ending: &str) -> PathBuf {
        self.path.join("_delta_log").join(format!("{version}{ending}"))
    }
}
