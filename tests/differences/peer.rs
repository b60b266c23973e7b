//! The peer: DuckDB in a Python process, queried over its pipes.

use std::fs::File;
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use anyhow::{Context as _, Result, ensure};
use arrow::array::RecordBatch;
use arrow::ipc::reader::FileReader;
use echolake_testing::run_long_command;
use serde_json::{Value, json};
use tempfile::NamedTempFile;

/// The script, which is in the program, so that it runs wherever the program is.
const SCRIPT: &str = include_str!("../clients/duckdb_peer.py");
/// Packages that the script needs.
const PACKAGES: [&str; 2] = ["duckdb==1.5.6", "pyarrow==26.0.1"];

/// The tables of the peer and how it reads them.
#[derive(Debug, Clone, Default)]
pub(crate) struct PeerTables {
    /// Files of each table.
    pub files: Vec<(String, Vec<String>)>,
    /// Threads of a query.
    pub threads: usize,
    /// Whether the tables are copied into memory; if not, each query reads the files.
    pub is_copied: bool,
    /// DuckDB's settings, name and value.
    pub settings: Vec<(&'static str, &'static str)>,
}

/// A running DuckDB.
pub(crate) struct DuckdbPeer {
    child: Child,
    ask: ChildStdin,
    answers: BufReader<ChildStdout>,
    rows: NamedTempFile,
    /// DuckDB's version.
    pub version: String,
}

impl DuckdbPeer {
    /// Starts it, with just these files.
    ///
    /// # Errors
    /// The program does not start, or a file cannot be read.
    pub fn start(python: &Path, tables: &PeerTables) -> Result<Self> {
        let mut child = Command::new(python)
            .args(["-c", SCRIPT])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start {}", python.display()))?;
        let ask = child.stdin.take().context("no pipe to the peer")?;
        let answers = BufReader::new(child.stdout.take().context("no pipe from the peer")?);
        let mut peer = Self { child, ask, answers, rows: NamedTempFile::new()?, version: String::new() };
        let files = tables.files.iter().map(|(name, files)| (name.clone(), json!(files)));
        let settings = tables.settings.iter().map(|(name, value)| ((*name).to_owned(), json!(value)));
        let order = json!({
            "tables": files.collect::<serde_json::Map<_, _>>(), "threads": tables.threads, "copy": tables.is_copied,
            "settings": settings.collect::<serde_json::Map<_, _>>(),
        });
        let hello = peer.exchange(&order)?.map_err(anyhow::Error::msg)?;
        peer.version = hello["version"].as_str().unwrap_or_default().to_owned();
        Ok(peer)
    }

    /// Answers a query, and returns the seconds that it took.
    ///
    /// # Errors
    /// The query fails, or the peer has ended.
    pub fn time_query(&mut self, sql: &str) -> Result<f64> {
        let answer = self.exchange(&json!({ "sql": sql }))?.map_err(anyhow::Error::msg)?;
        answer["seconds"].as_f64().context("the peer gave no time")
    }

    /// Answers a query, and returns its rows, or the message of the peer if it refuses.
    ///
    /// # Errors
    /// The peer has ended, or its answer cannot be read.
    pub fn ask_rows(&mut self, sql: &str) -> Result<Result<Vec<RecordBatch>, String>> {
        let order = json!({ "sql": sql, "rows": self.rows.path() });
        if let Err(message) = self.exchange(&order)? {
            return Ok(Err(message));
        }
        Ok(Ok(FileReader::try_new(File::open(self.rows.path())?, None)?.collect::<Result<_, _>>()?))
    }

    fn exchange(&mut self, question: &Value) -> Result<Result<Value, String>> {
        writeln!(self.ask, "{question}")?;
        self.ask.flush()?;
        let mut line = String::new();
        self.answers.read_line(&mut line)?;
        let answer: Value = serde_json::from_str(&line).with_context(|| format!("the peer said {line:?}"))?;
        match answer["error"].as_str() {
            Some(error) => Ok(Err(error.to_owned())),
            None => Ok(Ok(answer)),
        }
    }
}

impl Drop for DuckdbPeer {
    fn drop(&mut self) {
        // It ends with its input; a peer that hangs is not waited for.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Returns a Python that has the packages, in an environment in `folder`, which is made if it is missing.
///
/// # Errors
/// The packages cannot be installed.
pub(crate) fn install_duckdb(folder: &Path) -> Result<PathBuf> {
    let python = folder.join("bin/python");
    let mark = folder.join("installed");
    if std::fs::read_to_string(&mark).ok() != Some(PACKAGES.join(" ")) {
        run_program(Command::new("python3").args(["-m", "venv", "--clear"]).arg(folder))?;
        run_program(Command::new(folder.join("bin/pip")).args(["install", "--quiet"]).args(PACKAGES))?;
        std::fs::write(mark, PACKAGES.join(" "))?;
    }
    Ok(python)
}

fn run_program(command: &mut Command) -> Result<()> {
    let output = run_long_command(command).with_context(|| format!("cannot start {command:?}"))?;
    ensure!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(())
}
