//! `echolake doctor --self`: capabilities of this program on this machine; a lake's data are not read.

use std::env;
use std::env::consts::{ARCH, OS};
use std::fmt::Write as _;
use std::fs::{self, File};
use std::io;
#[cfg(feature = "lake")]
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::Command;

#[cfg(feature = "lake")]
use clap::Args as _;
use echolake_acquisition::disk::free_bytes;
use echolake_lake::{Error as LakeError, LAKE_FORMAT, Lake};
#[cfg(feature = "lake")]
use echolake_server::CataloguePages;
use serde::Serialize;

use crate::CommandOutcome;
#[cfg(feature = "lake")]
use crate::commands::serve::ServeArgs;
use crate::commands::{format_size, print_line};
use crate::processor;

/// Versions of what reads and writes the lake's files, and of all else that was compiled in.
const LOCK_FILE: &str = include_str!("../../../Cargo.lock");
const FORMAT_CRATES: [&str; 4] = ["mcap", "parquet", "arrow", "datafusion"];
/// The release sets it; a build in a checkout does not know its commit.
const COMMIT: Option<&str> = option_env!("ECHOLAKE_COMMIT");
/// Disk space that the demo needs.
const DEMO_BYTES: u64 = 900_000_000;
/// Disk space that `serve` uses for temporary files of slices, at most.
const SLICE_BYTES: u64 = 2 << 30;

/// The capabilities of an installation.
#[derive(Debug, Serialize)]
struct InstallationReport {
    version: &'static str,
    commit: Option<&'static str>,
    program: String,
    facts: Vec<InstallationFact>,
}

/// One fact about an installation.
#[derive(Debug, Serialize)]
struct InstallationFact {
    name: String,
    state: FactState,
    found: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    hint: Option<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum FactState {
    Ok,
    /// The program works, and something is left out or taken.
    Note,
    /// The program cannot do its job.
    Failed,
}

impl InstallationFact {
    fn ok(name: &str, found: impl Into<String>) -> Self {
        Self { name: name.to_owned(), state: FactState::Ok, found: found.into(), hint: None }
    }

    fn note(name: &str, found: impl Into<String>, hint: &str) -> Self {
        Self { state: FactState::Note, hint: Some(hint.to_owned()), ..Self::ok(name, found) }
    }

    fn failed(name: &str, found: impl Into<String>, hint: &str) -> Self {
        Self { state: FactState::Failed, ..Self::note(name, found, hint) }
    }
}

/// Prints the report; an error if the installation cannot do its job.
pub(super) async fn report_installation(json: bool, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let report = examine_installation(lake_url).await;
    match json {
        true => print_line(&serde_json::to_string_pretty(&report)?)?,
        false => print_line(report_text(&report).trim_end())?,
    }
    let failed: Vec<_> =
        report.facts.iter().filter(|f| f.state == FactState::Failed).map(|f| f.name.as_str()).collect();
    anyhow::ensure!(failed.is_empty(), "this installation cannot do its job here: {}", failed.join(", "));
    Ok(CommandOutcome::Whole)
}

async fn examine_installation(lake_url: &str) -> InstallationReport {
    let mut facts = vec![pages(), audio_fact(), format_fact(), system_fact(), processor_fact(), memory_fact()];
    facts.extend(lake_facts(lake_url).await);
    facts.push(temporary_files(&env::temp_dir()));
    #[cfg(feature = "lake")]
    facts.extend(port_facts());
    InstallationReport {
        version: env!("CARGO_PKG_VERSION"),
        commit: COMMIT,
        program: env::current_exe().map_or_else(|e| e.to_string(), |path| path.display().to_string()),
        facts,
    }
}

fn report_text(report: &InstallationReport) -> String {
    let commit = report.commit.unwrap_or("unknown");
    let mut out = format!("echolake {} (commit {commit}), {}\n\n", report.version, report.program);
    for InstallationFact { name, state, found, hint } in &report.facts {
        let word = match state {
            FactState::Ok => "ok",
            FactState::Note => "note",
            FactState::Failed => "failed",
        };
        let hint = hint.as_ref().map(|hint| format!("; hint: {hint}")).unwrap_or_default();
        let _ = writeln!(out, "{word:<7} {name:<16} {found}{hint}");
    }
    out
}

#[cfg(feature = "lake")]
fn pages() -> InstallationFact {
    let name = "pages";
    match CataloguePages::THIS_BUILD
        .missing_reason()
        .map(|problem| problem.split_once("; hint: ").unwrap_or((problem, "")))
    {
        None => InstallationFact::ok(name, "the catalogue's pages are part of the program"),
        Some((problem, hint)) => InstallationFact::note(name, problem, hint),
    }
}

#[cfg(not(feature = "lake"))]
fn pages() -> InstallationFact {
    let hint = "ingest, SQL and the catalogue need a build with the feature `lake`";
    InstallationFact::note("pages", "built for the rig alone, without tables and server", hint)
}

fn audio_fact() -> InstallationFact {
    let name = "audio";
    if cfg!(not(feature = "alsa")) {
        let hint = "audio devices need a build from source with `--features alsa`; the simulated rig needs none";
        return InstallationFact::note(name, "built without ALSA", hint);
    }
    // A line for each device: `00-00: ALC295 Analog : ALC295 Analog : playback 1 : capture 1`.
    let listed = fs::read_to_string("/proc/asound/pcm").unwrap_or_default();
    let devices: Vec<_> = listed.lines().filter_map(|line| line.split(" : ").next()).collect();
    if devices.is_empty() {
        let hint = "a rig file with an audio device needs one; the simulated rig needs none";
        return InstallationFact::note(name, "built with ALSA, which has no device here", hint);
    }
    InstallationFact::ok(name, format!("ALSA: {}", devices.join(", ")))
}

fn format_fact() -> InstallationFact {
    let crates = FORMAT_CRATES.into_iter().filter_map(|name| Some(format!("{name} {}", locked_version(name)?)));
    let versions: Vec<_> = [format!("lake format {LAKE_FORMAT}")].into_iter().chain(crates).collect();
    InstallationFact::ok("formats", versions.join(", "))
}

fn locked_version(name: &str) -> Option<&'static str> {
    let line = format!("\nname = \"{name}\"\n");
    let package = LOCK_FILE.split("[[package]]").find(|package| package.contains(&line))?;
    package.split_once("version = \"")?.1.split('"').next()
}

fn system_fact() -> InstallationFact {
    let kernel = fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    InstallationFact::ok("system", format!("{OS} {}, {ARCH}, {}", kernel.trim(), c_library()))
}

fn c_library() -> String {
    if cfg!(target_env = "musl") {
        return "musl (part of the program)".to_owned();
    }
    let output = Command::new("getconf").arg("GNU_LIBC_VERSION").output();
    let version = output.ok().filter(|output| output.status.success());
    version.map_or("glibc".to_owned(), |output| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

fn processor_fact() -> InstallationFact {
    let listed = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = listed.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let model = model.map(|(_, model)| format!(", {model}")).unwrap_or_default();
    InstallationFact::ok("processor", format!("{threads} threads{model}; the program is for {}", processor::BUILT_FOR))
}

fn memory_fact() -> InstallationFact {
    let listed = fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let bytes = |name: &str| {
        let line = listed.lines().find_map(|line| line.strip_prefix(name))?;
        Some(1024 * line.trim_start_matches(':').trim().split(' ').next()?.parse::<u64>().ok()?)
    };
    match (bytes("MemTotal"), bytes("MemAvailable")) {
        (Some(total), Some(free)) => {
            InstallationFact::ok("memory", format!("{} of {} free", format_size(free), format_size(total)))
        }
        _ => InstallationFact::note("memory", "unknown", "/proc/meminfo does not tell it"),
    }
}

/// The lake's place: whether there is a lake, how much room it has, and whether its file system does what is asked of
/// it.
async fn lake_facts(lake_url: &str) -> Vec<InstallationFact> {
    let opened = Lake::open(lake_url).await;
    let state = match &opened {
        Ok(_) => InstallationFact::ok("lake", format!("{lake_url} is a lake")),
        Err(LakeError::NoLake { .. }) => {
            let maker =
                if cfg!(feature = "lake") { "`echolake demo` makes one" } else { "`echolake acquire` makes one" };
            InstallationFact::note("lake", format!("{lake_url}: no lake yet"), maker)
        }
        Err(error) => {
            InstallationFact::failed("lake", error.to_string(), "--lake FOLDER or $ECHOLAKE_LAKE names another")
        }
    };
    let mut facts = vec![state];
    if let Some(folder) = existing_folder(lake_url) {
        facts.push(free_space("lake's disk", &folder, DEMO_BYTES, "the demo needs 0.9 GB"));
        facts.push(match (try_files(&folder), &opened) {
            (Ok(()), _) => {
                let done = "writes, syncs, renames, links and locks files in";
                InstallationFact::ok("lake's files", format!("{done} {}", folder.display()))
            }
            (Err(why), Ok(_)) => {
                InstallationFact::note("lake's files", why, "this lake can be queried and served, not added to")
            }
            (Err(why), Err(_)) => {
                InstallationFact::failed("lake's files", why, "--lake FOLDER names a folder that can be written to")
            }
        });
    }
    facts
}

/// The lake's folder, or the one above it that is there already; `None` if the lake is in no folder.
fn existing_folder(lake_url: &str) -> Option<PathBuf> {
    let path = lake_url.strip_prefix("file://").unwrap_or(lake_url);
    if path.contains("://") {
        return None;
    }
    let absolute = std::path::absolute(path).ok()?;
    absolute.ancestors().find(|folder| folder.is_dir()).map(Path::to_path_buf)
}

fn temporary_files(folder: &Path) -> InstallationFact {
    let name = "temporary files";
    match try_files(folder) {
        Ok(()) => free_space(name, folder, SLICE_BYTES, "slices of runs over HTTP use up to 2 GiB"),
        Err(why) => InstallationFact::failed(name, why, "$TMPDIR names another folder"),
    }
}

fn free_space(name: &str, folder: &Path, wanted: u64, hint: &str) -> InstallationFact {
    match free_bytes(folder) {
        Ok(free) => {
            let found = format!("{} free in {}", format_size(free), folder.display());
            if free < wanted { InstallationFact::note(name, found, hint) } else { InstallationFact::ok(name, found) }
        }
        Err(error) => InstallationFact::note(name, format!("{}: {error}", folder.display()), hint),
    }
}

/// Tries all file operations of a lake with small files; the error names the one that was refused.
fn try_files(folder: &Path) -> Result<(), String> {
    let scratch = folder.join(format!(".echolake-doctor-{}", std::process::id()));
    let refused = |what: &str, error: io::Error| format!("cannot {what} in {}: {error}", folder.display());
    fs::create_dir(&scratch).map_err(|e| refused("make a folder", e))?;
    let tried = try_files_in(&scratch).map_err(|(what, error)| refused(what, error));
    let removed = fs::remove_dir_all(&scratch).map_err(|e| refused("remove a folder", e));
    tried.and(removed)
}

fn try_files_in(scratch: &Path) -> Result<(), (&'static str, io::Error)> {
    let [first, second, third] = ["first", "second", "third"].map(|name| scratch.join(name));
    let file = File::create(&first).map_err(|e| ("create a file", e))?;
    fs::write(&first, "echolake").map_err(|e| ("write a file", e))?;
    file.sync_all().map_err(|e| ("sync a file", e))?;
    file.try_lock().map_err(|e| ("lock a file", e.into()))?;
    fs::rename(&first, &second).map_err(|e| ("rename a file", e))?;
    fs::hard_link(&second, &third).map_err(|e| ("link a file", e))?;
    // Commits rely on this: the second writer of a name is refused.
    if fs::hard_link(&second, &third).is_ok() {
        return Err(("rely on links", io::Error::other("a name was given twice")));
    }
    File::open(scratch).and_then(|folder| folder.sync_all()).map_err(|e| ("sync a folder", e))
}

/// The ports that `serve` listens on by default.
#[cfg(feature = "lake")]
fn port_facts() -> Vec<InstallationFact> {
    let serve = ServeArgs::augment_args(clap::Command::new("serve"));
    let defaults = serve.get_arguments().filter_map(|argument| {
        let address: SocketAddr = argument.get_default_values().first()?.to_str()?.parse().ok()?;
        Some((argument.get_long()?.to_owned(), address))
    });
    defaults.map(|(option, address)| port_fact(&option, address)).collect()
}

#[cfg(feature = "lake")]
fn port_fact(option: &str, address: SocketAddr) -> InstallationFact {
    let name = format!("port {}", address.port());
    match TcpListener::bind(address) {
        Ok(_) => InstallationFact::ok(&name, format!("{address} is free (serve --{option})")),
        Err(error) => {
            InstallationFact::note(&name, format!("{address}: {error}"), &format!("`serve --{option}` takes another"))
        }
    }
}
