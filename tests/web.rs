//! The catalogue in a browser, and its contract under Schemathesis, against the command itself.
//!
//! Their tools are installed if that is possible: packages of npm in `web/node_modules`, of PyPI in the target folder,
//! Chromium by apt-get if the test runs as root. If it is not, a test is skipped and says so; with `ECHOLAKE_NO_SKIP`
//! set it fails instead.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use echolake_testing::{ChildProcess, run_long_command};

use super::serve::{catalogue::lake, served};
use super::{TestFolder, stderr};

const NO_SKIP: &str = "ECHOLAKE_NO_SKIP";
const SCHEMATHESIS: &str = "schemathesis==4.32.5";
const CLIENTS: [&str; 6] = [
    "pyarrow==26.0.1",
    "polars==2.1.0",
    "duckdb-cli==1.5.6",
    "rerun-sdk==0.41.0",
    "mcap==1.6.0",
    "mcap-protobuf-support==0.6.0",
];

pub(crate) fn web() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("web")
}

/// Runs a program to its end; returns its output, as an error if it failed.
pub(crate) fn run(command: &mut Command) -> Result<String, String> {
    let output = run_long_command(command).map_err(|e| format!("{command:?}: {e}"))?;
    let said = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    if output.status.success() { Ok(said) } else { Err(format!("{command:?}: {}\n{said}", output.status)) }
}

/// Returns the prerequisite of a test; None, with a message, if it is missing.
pub(crate) fn or_skip<T>(test: &str, ready: Result<T, String>) -> Option<T> {
    match ready {
        Ok(ready) => Some(ready),
        Err(why) if env::var_os(NO_SKIP).is_some() => panic!("{test} cannot run: {why}"),
        Err(why) => {
            eprintln!("SKIPPED {test}: {why}");
            None
        }
    }
}

/// The browser; the packages that drive it are installed then, once for all tests.
pub(crate) fn browser() -> Result<PathBuf, String> {
    static BROWSER: OnceLock<Result<PathBuf, String>> = OnceLock::new();
    BROWSER.get_or_init(install_browser).clone()
}

fn install_browser() -> Result<PathBuf, String> {
    // npm writes this file last.
    if !web().join("node_modules/.package-lock.json").exists() {
        run(Command::new("npm").args(["ci", "--no-audit", "--no-fund"]).current_dir(web()))?;
    }
    let known = || {
        let named = env::var_os("CHROMIUM").map(PathBuf::from);
        named.into_iter().chain(["/usr/bin/chromium".into()]).find(|path| path.exists())
    };
    if let Some(path) = known() {
        return Ok(path);
    }
    run(Command::new("apt-get").args([
        "-o",
        "DPkg::Lock::Timeout=900",
        "install",
        "-y",
        "--no-install-recommends",
        "chromium",
    ]))?;
    known().ok_or_else(|| "there is no Chromium; hint: name it in $CHROMIUM".to_owned())
}

fn schemathesis() -> Result<PathBuf, String> {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("schemathesis");
    let program = folder.join("bin/schemathesis");
    if !program.exists() {
        run(Command::new("python3").args(["-m", "venv"]).arg(&folder))?;
        run(Command::new(folder.join("bin/pip")).args(["install", "--quiet", SCHEMATHESIS]))?;
    }
    Ok(program)
}

/// A folder whose programs the pages' code for other programs needs.
fn clients() -> Result<PathBuf, String> {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("page-clients");
    let mark = folder.join("installed");
    if fs::read_to_string(&mark).ok() != Some(CLIENTS.join(" ")) {
        run(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&folder))?;
        run(Command::new(folder.join("bin/pip")).args(["install", "--quiet"]).args(CLIENTS))?;
        fs::write(mark, CLIENTS.join(" ")).map_err(|e| e.to_string())?;
    }
    Ok(folder)
}

/// A lake of the paper's rig: the demo's, without sweeps.
fn demo() -> TestFolder {
    let place = TestFolder::new();
    let output = run_long_command(&mut place.command(&["demo", "--ir-only", "--no-serve"])).expect("it starts");
    assert!(output.status.success(), "{}", stderr(&output));
    place
}

mod slow {
    use super::*;

    #[test]
    fn the_pages_do_what_they_must_in_a_browser() {
        let Some(browser) = or_skip("the catalogue in a browser", browser()) else { return };
        let place = demo();
        let server = served(&place, &[]);
        let base = format!("http://{}", server.http);
        let shots = place.path("shots");
        let shots = shots.to_str().expect("a path");
        for script in
            [&["tests/contract.mjs", &base][..], &["tests/behaviour.mjs", &base], &["tests/pages.mjs", &base, shots]]
        {
            let done = run(Command::new("node").args(script).current_dir(web()).env("CHROMIUM", &browser));
            eprintln!("{}", done.unwrap_or_else(|why| panic!("{why}")));
        }
        let pictures = fs::read_dir(shots).expect("pictures").count();
        assert!(pictures >= 7 * 2, "{pictures} pictures of seven pages in two themes");
    }

    /// E20: behind a proxy that serves them below a path. Bug 6: on paper.
    #[test]
    fn the_pages_stand_below_a_proxys_path_and_on_paper() {
        let Some(browser) = or_skip("pages behind a proxy in a browser", browser()) else { return };
        let place = lake();
        let server = served(&place, &[]);
        let base = format!("http://{}", server.http);
        let folder = place.path("print");
        let folder = folder.to_str().expect("a path");
        for script in [&["tests/prefix.mjs", &base][..], &["tests/print.mjs", &base, folder]] {
            let done = run(Command::new("node").args(script).current_dir(web()).env("CHROMIUM", &browser));
            eprintln!("{}", done.unwrap_or_else(|why| panic!("{why}")));
        }
    }

    /// B14: the form for annotations is for tokens that may annotate.
    #[test]
    fn a_page_offers_what_its_token_may_do() {
        let Some(browser) = or_skip("pages with a token in a browser", browser()) else { return };
        let place = lake();
        let mut lines = Vec::new();
        let tokens = [["reader", "sql,files"], ["writer", "sql,files,annotate"]].map(|[name, scopes]| {
            let made = place.run(&["token", name, "--scopes", scopes]);
            lines.extend(&made.stdout);
            stderr(&made).lines().next().expect("a token").to_owned()
        });
        fs::write(place.path("tokens.toml"), lines).expect("written");
        let server = served(&place, &["--tokens", "tokens.toml"]);
        let base = format!("http://{}", server.http);
        let mut command = Command::new("node");
        command.args(["tests/scopes.mjs", &base]).args(&tokens).current_dir(web()).env("CHROMIUM", &browser);
        eprintln!("{}", run(&mut command).unwrap_or_else(|why| panic!("{why}")));
    }

    #[test]
    fn code_of_the_pages_runs_in_other_programs() {
        let ready = browser().and_then(|_| clients());
        let Some(clients) = or_skip("the pages' code in other programs", ready) else { return };
        let place = lake();
        let server = served(&place, &[]);
        let base = format!("http://{}", server.http);
        let mut command = Command::new("node");
        command.args(["tests/snippets.mjs", &base]).arg(clients).current_dir(web()).env("TMPDIR", place.path(""));
        eprintln!("{}", run(&mut command).unwrap_or_else(|why| panic!("{why}")));
    }

    #[test]
    fn pages_of_elsewhere_do_and_read_nothing() {
        let Some(browser) = or_skip("pages of elsewhere in a browser", browser()) else { return };
        let place = lake();
        let server = served(&place, &[]);
        let replay = &["replay", "flat", "--listen", "127.0.0.1:0"];
        let mut replay = ChildProcess::start(&mut place.command(replay)).expect("the command starts");
        let line = replay.wait_for_line("ws://");
        let viewer = line.split_once("ws://").expect("a URL").1.split(['/', ' ']).next().expect("host and port");
        let base = format!("http://{}", server.http);
        let done = run(Command::new("node")
            .args(["tests/foreign.mjs", &base, &server.flight_sql, &server.postgres, viewer])
            .current_dir(web())
            .env("CHROMIUM", &browser));
        eprintln!("{}", done.unwrap_or_else(|why| panic!("{why}")));
    }

    #[test]
    fn schemathesis_finds_no_breach_of_the_contract() {
        let Some(program) = or_skip("Schemathesis", schemathesis()) else { return };
        let place = lake();
        let server = served(&place, &[]);
        let done = run(Command::new(program)
            .args(["run", &format!("http://{}/api/v1/openapi.json", server.http)])
            .args(["--phases", "examples,coverage,fuzzing", "--checks", "all", "--max-examples", "30", "--seed", "1"])
            // Which bands, points and queries are right depends on the lake; the document cannot say.
            .args(["--exclude-checks", "positive_data_acceptance"])
            // It cannot make an Arrow stream.
            .args(["--exclude-path", "/api/v1/predictions"])
            .args(["--suppress-health-check", "all", "--no-color"])
            .current_dir(place.path("")));
        eprintln!("{}", done.unwrap_or_else(|why| panic!("{why}")));
    }
}
