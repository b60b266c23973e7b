//! The commands, one file each: their arguments, and what they do.

pub(crate) mod acquire;
#[cfg(feature = "lake")]
mod cache;
#[cfg(feature = "lake")]
pub(crate) mod campaign;
#[cfg(feature = "lake")]
pub(crate) mod demo;
#[cfg(feature = "lake")]
pub(crate) mod design;
pub(crate) mod doctor;
#[cfg(feature = "lake")]
pub(crate) mod export;
#[cfg(feature = "lake")]
pub(crate) mod figure;
#[cfg(feature = "lake")]
pub(crate) mod import;
#[cfg(feature = "lake")]
pub(crate) mod ingest;
#[cfg(feature = "lake")]
pub(crate) mod listen;
#[cfg(feature = "lake")]
pub(crate) mod mcp;
#[cfg(feature = "upload")]
mod notify;
pub(crate) mod panel;
pub(crate) mod recover;
pub(crate) mod replay;
#[cfg(feature = "lake")]
pub(crate) mod serve;
#[cfg(feature = "lake")]
mod simulated_runs;
#[cfg(feature = "lake")]
pub(crate) mod sql;
#[cfg(feature = "lake")]
pub(crate) mod twin;
#[cfg(feature = "lake")]
pub(crate) mod upkeep;
#[cfg(feature = "upload")]
pub(crate) mod upload;
#[cfg(feature = "lake")]
mod workers;

use std::net::SocketAddr;
use std::path::Path;

use anyhow::Context as _;
use echolake_acquisition::disk::read_text_file;
use echolake_lake::{Error as LakeError, Lake};
use echolake_schema::Rig;

use crate::progress::CommandProgress;
use crate::signals::StopRequest;
use crate::terminal_text::text_output;
use replay::ViewerArgs;

/// Writes text and a line break to stdout; a closed pipe is an error that `main` takes for success.
fn print_line(text: &str) -> std::io::Result<()> {
    use std::io::Write as _;
    writeln!(text_output(), "{text}")
}

/// Writes a file beside its path first, so that it is whole or not there.
#[cfg(feature = "lake")]
fn write_whole_file(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let failed = || format!("cannot write `{}`", path.display());
    let mut partial = path.as_os_str().to_owned();
    partial.push(".partial");
    std::fs::write(&partial, bytes).with_context(failed)?;
    std::fs::rename(&partial, path).with_context(failed)
}

/// A size for people.
fn format_size(bytes: u64) -> String {
    match bytes {
        0..1_000_000 => format!("{:.1} kB", bytes as f64 / 1e3),
        1_000_000..1_000_000_000 => format!("{:.1} MB", bytes as f64 / 1e6),
        _ => format!("{:.2} GB", bytes as f64 / 1e9),
    }
}

/// The rig of a file; else the lake's; else `otherwise`.
async fn rig_or(file: Option<&Path>, lake_url: &str, otherwise: impl FnOnce() -> Rig) -> anyhow::Result<Rig> {
    if let Some(file) = file {
        let text = read_text_file(file).with_context(|| format!("cannot read rig file `{}`", file.display()))?;
        let rig = Rig::from_toml(&text).with_context(|| format!("rig file `{}`", file.display()))?;
        if rig.validation.loopback_dbfs.is_some() {
            eprintln!("note: rig file `{}`: `validation.loopback_dbfs` is ignored: remove it", file.display());
        }
        return Ok(rig);
    }
    match Lake::open(lake_url).await {
        Ok(lake) => Ok(lake.rig().clone()),
        Err(LakeError::NoLake { .. }) => Ok(otherwise()),
        Err(e) => Err(e.into()),
    }
}

/// The folder of the lake that new recordings go to.
fn prepare_inbox(lake: &Lake) -> anyhow::Result<std::path::PathBuf> {
    let missing =
        "recordings need a lake in a folder; hint: --lake FOLDER, and `echolake upload` for one on an object store";
    let folder = lake.folder().context(missing)?.join("inbox");
    std::fs::create_dir_all(&folder).with_context(|| format!("cannot make `{}`", folder.display()))?;
    // A synced recording is of no use if its folder's name, or the lake's, is not synced.
    for above in folder.ancestors().skip(1).take(2) {
        let above = if above.as_os_str().is_empty() { Path::new(".") } else { above };
        let synced = std::fs::File::open(above).and_then(|opened| opened.sync_all());
        synced.with_context(|| format!("cannot sync `{}`", above.display()))?;
    }
    Ok(folder)
}

/// Prints which viewers have access at an address, and how to let in others.
fn tell_access(viewers: &ViewerArgs, address: SocketAddr, progress: &CommandProgress) {
    if viewers.allowed_origins.is_empty() {
        progress.print_message("hint: a viewer on the web must be allowed: --allow-origin https://app.foxglove.dev");
    }
    if viewers.open && !address.ip().is_loopback() {
        progress.print_message("warning: anyone who reaches this address can view");
    }
}

/// Fails if the command was asked to stop.
#[cfg(feature = "lake")]
fn ensure_wanted(stop: &StopRequest) -> anyhow::Result<()> {
    anyhow::ensure!(!stop.is_made(), "stopped; hint: run the same command again to resume");
    Ok(())
}

/// Listens for a request to stop work that ends at a clean place.
fn stop_request() -> anyhow::Result<StopRequest> {
    StopRequest::listen("stopping at the next clean place; Ctrl-C again stops at once")
}
