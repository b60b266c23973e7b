//! The `echolake` command as its users run it: whole ways, exit codes, bad input, real data.

mod acquire_kills;
mod bad_input;
mod child;
mod end_to_end;
mod forgetful;
mod fuzz;
mod installation;
mod kills;
mod load;
mod maintenance;
mod prompt;
mod real_data;
mod replay;
mod serve;
mod signals;
mod sofa;
#[cfg(feature = "web")]
mod web;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// The command under test.
const ECHOLAKE: &str = env!("CARGO_BIN_EXE_echolake");
/// A rig that measures in milliseconds.
const SMALL_RIG: &str = include_str!("fixtures/small_rig.toml");

/// A folder with a lake and a small rig.
struct Place {
    folder: tempfile::TempDir,
}

impl Place {
    fn new() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("rig.toml"), SMALL_RIG).expect("written");
        Self { folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::new(ECHOLAKE);
        command.args(["--lake", "lake"]).args(args).current_dir(self.folder.path()).env_remove("ECHOLAKE_LAKE");
        command
    }

    fn run(&self, args: &[&str]) -> Output {
        child::run_command(&mut self.command(args)).expect("the command starts")
    }

    /// Runs what must succeed; returns stdout.
    fn ok(&self, args: &[&str]) -> String {
        let output = self.run(args);
        assert_eq!(output.status.code(), Some(0), "{args:?}: {}", stderr(&output));
        String::from_utf8(output.stdout).expect("text")
    }

    /// Runs what must fail with this code and say this.
    fn fails(&self, code: i32, args: &[&str], expected: &str) {
        let output = self.run(args);
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(code), "{args:?}: {said}");
        assert!(said.contains(expected), "{args:?}: expected `{expected}` in: {said}");
        assert!(!said.contains("panicked"), "{said}");
    }

    fn sql(&self, query: &str) -> Vec<serde_json::Map<String, serde_json::Value>> {
        serde_json::from_str(&self.ok(&["sql", "--json", query])).expect("JSON")
    }

    fn number(&self, query: &str) -> f64 {
        let rows = self.sql(query);
        assert_eq!(rows.len(), 1, "{query}");
        let value = rows[0].values().next().and_then(serde_json::Value::as_f64);
        value.unwrap_or_else(|| panic!("{query}: {rows:?}"))
    }

    /// Measures a surface; returns the run's file.
    fn acquire(&self, surface: &str, more: &[&str]) -> PathBuf {
        let args = [&["acquire", "--surface", surface, "--rig", "rig.toml"], more].concat();
        self.folder.path().join(self.ok(&args).trim())
    }
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Real data beside the checkout; tests that want it skip where it is absent, and say so.
fn shared_data(name: &str) -> Option<PathBuf> {
    let path = Path::new("../shared/data").join(name);
    if !path.exists() {
        eprintln!("skipped: ../shared/data/{name} is not there");
        return None;
    }
    path.canonicalize().ok()
}
