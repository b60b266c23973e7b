//! The `echolake` command as its users run it: whole ways, exit codes, bad input, real data.
#![allow(clippy::print_stderr, reason = "a test that cannot run says so")]

mod acquire_kills;
mod annotation_kills;
mod architecture;
mod bad_input;
mod broken_tables;
mod campaign;
mod contribution_campaign;
mod design;
#[allow(dead_code, unused_imports, reason = "`stress` wants more of it")]
mod differences;
mod end_to_end;
mod figure;
mod foam;
mod forgetful;
mod fuzz;
mod hostile_files;
mod inbox;
mod installation;
mod kills;
mod large_chunk;
mod load;
mod maintenance;
mod materials;
mod notices;
mod object_stores;
mod operator;
mod operators;
mod real_data;
mod recover;
mod replay;
mod rooms;
mod serve;
mod signals;
mod sofa;
#[cfg(feature = "web")]
mod twin;
mod web;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use echolake_testing::{SMALL_RIG, run_command};

/// The command under test: `packaging/package.sh` names the one that ships.
const ECHOLAKE: &str = match option_env!("ECHOLAKE_SHIPPED") {
    Some(shipped) => shipped,
    None => env!("CARGO_BIN_EXE_echolake"),
};

/// A folder with a lake and a small rig.
struct TestFolder {
    folder: tempfile::TempDir,
}

impl TestFolder {
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
        run_command(&mut self.command(args)).expect("the command starts")
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

/// A folder that several tests begin with: its files, once one of them has made it.
struct TestFolderTemplate(OnceLock<BTreeMap<PathBuf, Vec<u8>>>);

impl TestFolderTemplate {
    const fn new() -> Self {
        Self(OnceLock::new())
    }

    /// A folder of the test's own, as `make` leaves a new one.
    fn place(&self, make: impl FnOnce(&TestFolder)) -> TestFolder {
        let files = self.0.get_or_init(|| {
            let place = TestFolder::new();
            make(&place);
            files_below(place.folder.path())
        });
        let place = TestFolder::new();
        for (path, bytes) in files {
            let path = place.folder.path().join(path);
            std::fs::create_dir_all(path.parent().expect("a folder")).expect("made");
            std::fs::write(path, bytes).expect("written");
        }
        place
    }
}

/// Every file below a folder, by its path from there.
fn files_below(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(&next).expect("listed") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(folder).expect("below it").to_owned();
                files.insert(name, std::fs::read(path).expect("read"));
            }
        }
    }
    files
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Real data beside the checkout; tests that need it are skipped if it is absent, and say so.
fn shared_data(name: &str) -> Option<PathBuf> {
    let path = Path::new("../shared/data").join(name);
    if !path.exists() {
        eprintln!("skipped: ../shared/data/{name} is not there");
        return None;
    }
    path.canonicalize().ok()
}
