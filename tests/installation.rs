//! The command as packages use it: its report about itself, man pages and completions.

use std::fs;
use std::net::TcpListener;
use std::process::Command;

use serde::Deserialize;

use super::child::run_command;
use super::{ECHOLAKE, TestFolder, stderr};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct SelfReport {
    version: String,
    commit: Option<String>,
    program: String,
    facts: Vec<ReportedFact>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct ReportedFact {
    name: String,
    state: String,
    found: String,
    hint: Option<String>,
}

impl SelfReport {
    fn of(command: &mut Command) -> Self {
        let output = run_command(command).expect("the command starts");
        serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {}", stderr(&output)))
    }

    fn fact(&self, name: &str) -> &ReportedFact {
        self.facts.iter().find(|fact| fact.name == name).unwrap_or_else(|| panic!("no {name} in {self:?}"))
    }
}

#[test]
fn doctor_reports_the_installation_and_leaves_nothing_behind() {
    let place = TestFolder::new();
    let before = fs::read_dir(place.path("")).expect("a folder").count();
    let report = SelfReport::of(&mut place.command(&["doctor", "--self", "--json"]));
    assert_eq!(report.version, env!("CARGO_PKG_VERSION"));
    assert!(report.program.ends_with("echolake"), "{}", report.program);
    assert!(report.commit.is_none_or(|commit| !commit.is_empty()));
    for fact in &report.facts {
        assert!(["ok", "note"].contains(&fact.state.as_str()), "{fact:?}");
        assert!(!fact.found.is_empty(), "{fact:?}");
        assert_eq!(fact.hint.is_some(), fact.state == "note", "{fact:?}");
    }
    let names: Vec<_> = report.facts.iter().map(|fact| fact.name.as_str()).collect();
    let expected = [
        "pages",
        "audio",
        "formats",
        "system",
        "processor",
        "memory",
        "lake",
        "lake's disk",
        "lake's files",
        "temporary files",
        "port 8080",
        "port 8081",
        "port 5433",
    ];
    assert_eq!(names, expected);
    let pages = &report.facts[0];
    let is_remedy_named = pages.hint.as_ref().is_some_and(|hint| hint.contains("pip install echolake"));
    assert!(pages.state == "ok" || is_remedy_named, "{pages:?}");
    assert_eq!(fs::read_dir(place.path("")).expect("a folder").count(), before);
    let text = place.ok(&["doctor", "--self"]);
    assert!(expected.iter().all(|name| text.contains(name)), "{text}");
}

#[test]
fn facts_are_those_of_the_place() {
    let place = TestFolder::new();
    let own = ["doctor", "--self", "--json"];
    // The port is taken, by this test or by another program.
    let _taken = TcpListener::bind("127.0.0.1:5433");
    let report = SelfReport::of(&mut place.command(&own));
    let port = report.fact("port 5433");
    assert_eq!(port.state, "note", "{port:?}");
    let formats = &report.fact("formats").found;
    for name in ["mcap", "parquet", "arrow", "datafusion"] {
        let version = formats.split(", ").find_map(|part| part.strip_prefix(&format!("{name} ")));
        assert!(version.is_some_and(|version| version.contains('.')), "{name} in {formats}");
    }
    // There is no lake yet, so that its disk is that of the folder above.
    let disk = &report.fact("lake's disk").found;
    let folder = place.path("").canonicalize().expect("a folder").display().to_string();
    assert!(disk.ends_with(folder.trim_end_matches('/')), "{disk}, not {folder}");
    let no_folder = SelfReport::of(Command::new(ECHOLAKE).args(["--lake", "memory://"]).args(own));
    assert!(no_folder.facts.iter().all(|fact| fact.name != "lake's disk"), "{no_folder:?}");
    let no_files = SelfReport::of(place.command(&own).env("TMPDIR", "/dev/null"));
    let files = no_files.fact("temporary files");
    assert!(files.state == "failed" && files.found.starts_with("cannot make a folder in /dev/null"), "{files:?}");
}

#[test]
fn a_lake_that_cannot_be_is_a_failure() {
    let place = TestFolder::new();
    fs::write(place.path("lake"), "no folder").expect("written");
    let output = place.run(&["doctor", "--self"]);
    assert_eq!(output.status.code(), Some(1));
    let said = stderr(&output);
    assert!(said.contains("this installation cannot do its job here: lake"), "{said}");
    assert!(String::from_utf8_lossy(&output.stdout).contains("it is a file"));
}

#[test]
fn packages_get_man_pages_and_completions() {
    let place = TestFolder::new();
    place.ok(&["man", "man"]);
    for (page, expected) in
        [("echolake.1", "doctor"), ("echolake-serve.1", "flight"), ("echolake-import-wav.1", "manifest")]
    {
        let text = fs::read_to_string(place.path("man").join(page)).expect(page);
        assert!(text.contains(expected), "{page}");
    }
    for shell in ["bash", "zsh", "fish"] {
        assert!(place.ok(&["completions", shell]).contains("echolake"), "{shell}");
    }
}
