//! The peer: DuckDB in a Python process, queried over its pipes.

use std::io::{BufRead as _, BufReader, Write as _};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use anyhow::{Context as _, Result};
use serde_json::{Value, json};

use super::digest::RowsDigest;

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

    /// Answers a query; seconds, and what came.
    pub fn query(&mut self, sql: &str) -> Result<(f64, RowsDigest)> {
        let answer = self.exchange(&json!({ "sql": sql }))?;
        let seconds = answer["seconds"].as_f64().context("the peer gave no time")?;
        let sums = answer["sums"].as_array().context("the peer gave no sums")?;
        let rows = answer["rows"].as_u64().context("the peer gave no rows")?;
        Ok((seconds, RowsDigest { rows, sums: sums.iter().filter_map(Value::as_f64).collect() }))
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
