//! The peer: DuckDB in a Python process, queried over its pipes.

use std::fs::File;
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use anyhow::{Context as _, Result};
use arrow::ipc::reader::FileReader;
use arrow::record_batch::RecordBatch;
use serde_json::{Value, json};
use tempfile::NamedTempFile;

/// Path of the script.
const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/clients/duckdb_peer.py");

/// A running DuckDB.
pub(crate) struct DuckdbPeer {
    child: Child,
    ask: ChildStdin,
    answers: BufReader<ChildStdout>,
    /// DuckDB's version.
    pub version: String,
}

impl DuckdbPeer {
    /// Starts it, with a view a table over just these files.
    pub fn start(python: &Path, tables: &[(String, Vec<String>)], threads: usize) -> Result<Self> {
        let mut child = Command::new(python)
            .arg(SCRIPT)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start {}", python.display()))?;
        let ask = child.stdin.take().context("no pipe to the peer")?;
        let answers = BufReader::new(child.stdout.take().context("no pipe from the peer")?);
        let mut peer = Self { child, ask, answers, version: String::new() };
        let tables: Value =
            tables.iter().map(|(name, files)| (name.clone(), json!(files))).collect::<serde_json::Map<_, _>>().into();
        let hello = peer.exchange(&json!({ "tables": tables, "threads": threads }))?;
        peer.version = hello["version"].as_str().unwrap_or_default().to_owned();
        Ok(peer)
    }

    /// Answers a query, and returns the seconds that it took.
    pub fn time_query(&mut self, sql: &str) -> Result<f64> {
        self.exchange(&json!({ "sql": sql }))?["seconds"].as_f64().context("the peer gave no time")
    }

    /// Answers a query, and returns its rows.
    pub fn read_rows(&mut self, sql: &str) -> Result<Vec<RecordBatch>> {
        let file = NamedTempFile::new()?;
        self.exchange(&json!({ "sql": sql, "rows": file.path() }))?;
        Ok(FileReader::try_new(File::open(file.path())?, None)?.collect::<Result<_, _>>()?)
    }

    fn exchange(&mut self, question: &Value) -> Result<Value> {
        writeln!(self.ask, "{question}")?;
        self.ask.flush()?;
        let mut line = String::new();
        self.answers.read_line(&mut line)?;
        let answer: Value = serde_json::from_str(&line).with_context(|| format!("the peer said {line:?}"))?;
        if let Some(error) = answer["error"].as_str() {
            anyhow::bail!("the peer failed: {error}");
        }
        Ok(answer)
    }
}

impl Drop for DuckdbPeer {
    fn drop(&mut self) {
        // It ends with its input; a peer that hangs is not waited for.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
