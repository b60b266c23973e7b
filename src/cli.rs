//! The arguments, and nothing else.

#[cfg(feature = "lake")]
mod lake;

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};
use echolake_acquisition::ViewerAccess;
use echolake_acquisition::panel::mesh::PanelSide;
use echolake_acquisition::replay::SPEEDS;
use echolake_schema::SurfaceId;

use crate::commands::panel::PanelArgs;
use crate::logging::{FORMAT_VARIABLE, LogFormat};
#[cfg(feature = "lake")]
pub(crate) use lake::{DemoArgs, ImportCommand, IngestArgs, LakeCommand, OptimizeArgs, VacuumArgs};

/// A data lake and catalogue for sweep measurements.
#[derive(Debug, Parser)]
#[command(version, max_term_width = 100)]
pub(crate) struct CliArguments {
    /// The lake: a folder or a file:// URL.
    #[arg(long, global = true, env = "ECHOLAKE_LAKE", default_value = "lake", value_name = "URL")]
    pub(crate) lake: String,
    /// Format of the log on stderr; RUST_LOG sets its levels.
    #[arg(long, global = true, env = FORMAT_VARIABLE, default_value = "text", value_name = "FORMAT")]
    pub(crate) log_format: LogFormat,
    #[command(subcommand)]
    pub(crate) command: CliCommand,
}

#[derive(Debug, Subcommand)]
pub(crate) enum CliCommand {
    #[cfg(feature = "lake")]
    #[command(flatten)]
    Lake(LakeCommand),
    /// Measure one surface with the simulated rig: one run, one MCAP file.
    Acquire(AcquireArgs),
    /// Write a generated relief as a mesh, heights or a picture; make groups of them.
    Panel(PanelArgs),
    /// Show runs again to Foxglove, which plays, pauses and seeks, and to Lichtblick.
    Replay(ReplayArgs),
    /// Rebuild a recording that was cut off or damaged, as far as every checksum is right.
    Recover(RecoverArgs),
    /// Say what is in the lake, what is missing and what is damaged.
    Doctor(DoctorArgs),
    /// Print a completion script for a shell.
    Completions {
        /// The shell.
        shell: clap_complete::Shell,
    },
    /// Write the man pages, one for each command.
    #[command(hide = true)]
    Man {
        /// The folder they go to.
        folder: PathBuf,
    },
}

#[derive(Debug, Args)]
pub(crate) struct AcquireArgs {
    /// Name of the measured surface, as 0015_0.
    #[arg(long, required_unless_present = "resume")]
    pub(crate) surface: Option<SurfaceId>,
    /// Go on with a run that was stopped or cut off: its `.mcap.partial`. What is safe in it is not measured again.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["surface", "panel", "parameters", "set", "mesh", "side", "rig", "flat", "foam", "seed", "ir_only"])]
    pub(crate) resume: Option<PathBuf>,
    /// Relief for the simulated rig, by a name of `echolake panel --list`; by default the one that the surface's name
    /// begins with.
    #[arg(long, value_name = "NAME", conflicts_with = "mesh")]
    pub(crate) panel: Option<String>,
    /// A JSON file of parameters, as `echolake panel` writes them, in place of a name.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["mesh", "panel"])]
    pub(crate) parameters: Option<PathBuf>,
    /// A parameter of it.
    #[arg(long, value_name = "KEY=VALUE")]
    pub(crate) set: Vec<String>,
    /// A mesh to measure instead: GLB or STL.
    #[arg(long)]
    pub(crate) mesh: Option<PathBuf>,
    /// The side of the mesh that is measured: the back is seen when the panel is turned over about its y axis.
    #[arg(long, value_name = "front|back", value_parser = side, requires = "mesh")]
    pub(crate) side: Option<PanelSide>,
    /// The rig; by default the lake's, or that of the paper for a new lake.
    #[arg(long)]
    pub(crate) rig: Option<PathBuf>,
    /// Surface that normalises this one, where it is not the lake's.
    #[arg(long)]
    pub(crate) flat: Option<SurfaceId>,
    /// Surface whose direct sound is subtracted from this one, where it is not the lake's.
    #[arg(long)]
    pub(crate) foam: Option<SurfaceId>,
    /// Seed of the simulation.
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
    /// Record no sweeps, only impulse responses.
    #[arg(long)]
    pub(crate) ir_only: bool,
    /// Pairs between two checkpoints: what a power cut costs at most, and how late a pair is told to be safe. By default 1
    /// on a real rig, 200 on the simulated one.
    #[arg(long, value_name = "PAIRS", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) checkpoint_every: Option<u32>,
    /// Seconds that a simulated take lasts at least; a real rig's are 12.3.
    #[arg(long, value_name = "SECS", default_value_t = 0.0)]
    pub(crate) pace: f64,
    /// Begin even where disk, sensor, level or loopback are not fit.
    #[arg(long)]
    pub(crate) skip_checks: bool,
    /// Append a line to this file for every attempt once it is safe on the disk: pair, attempt, verdict, SNR in dB.
    /// `-` is stdout.
    #[arg(long, value_name = "FILE")]
    pub(crate) acknowledge: Option<PathBuf>,
    /// Show the run as it happens to Foxglove and Lichtblick, which open ws://ADDR.
    #[arg(long, value_name = "ADDR")]
    pub(crate) live: Option<std::net::SocketAddr>,
    #[command(flatten)]
    pub(crate) viewers: ViewerArgs,
    /// Serve metrics for Prometheus under http://ADDR/metrics.
    #[arg(long, value_name = "ADDR")]
    pub(crate) metrics: Option<std::net::SocketAddr>,
}

#[derive(Debug, Args)]
pub(crate) struct RecoverArgs {
    /// The recording that was cut off or damaged; it is only read.
    pub(crate) file: PathBuf,
    /// Path of the rebuilt file; by default beside it, without `.partial`.
    #[arg(short, long, value_name = "FILE")]
    pub(crate) output: Option<PathBuf>,
    /// Print what was done as JSON.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct ReplayArgs {
    /// Names of runs, surfaces (of each its newest run), or .mcap files; they are shown one after the other.
    #[arg(required = true, value_name = "RUN")]
    pub(crate) runs: Vec<String>,
    /// Address to listen on.
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8765")]
    pub(crate) listen: std::net::SocketAddr,
    #[command(flatten)]
    pub(crate) viewers: ViewerArgs,
    /// Speed at first, as a factor of real time.
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = speed)]
    pub(crate) speed: f32,
    /// Wait for a viewer's play button; without it playback begins with the first viewer.
    #[arg(long)]
    pub(crate) paused: bool,
}

/// Access of viewers.
#[derive(Debug, Args)]
pub(crate) struct ViewerArgs {
    /// Let a viewer that is a web page look on, beside pages of this machine, as `https://app.foxglove.dev`; repeatable.
    #[arg(long = "allow-origin", value_name = "URL", value_parser = origin)]
    pub(crate) allowed_origins: Vec<String>,
    /// Let other machines look on without the token that is part of the printed address.
    #[arg(long)]
    pub(crate) open: bool,
}

impl ViewerArgs {
    pub(crate) fn access(&self) -> ViewerAccess {
        ViewerAccess { allowed_origins: self.allowed_origins.clone(), is_open: self.open }
    }
}

// As browsers spell it.
fn origin(text: &str) -> Result<String, String> {
    let origin = text.trim_end_matches('/').to_ascii_lowercase();
    let is_origin = origin.split_once("://").is_some_and(|(scheme, host)| {
        !scheme.is_empty() && !host.is_empty() && !host.contains(['/', '?', '#', '@', ' '])
    });
    if is_origin { Ok(origin) } else { Err("expected scheme and host, as https://viewer.example:8080".to_owned()) }
}

fn side(text: &str) -> Result<PanelSide, String> {
    PanelSide::parse(text).ok_or_else(|| "expected front or back".to_owned())
}

fn speed(text: &str) -> Result<f32, String> {
    let speed = text.parse().ok().filter(|x| SPEEDS.contains(x));
    speed.ok_or_else(|| format!("expected a number from {} to {}", SPEEDS.start(), SPEEDS.end()))
}

#[derive(Debug, Args)]
pub(crate) struct DoctorArgs {
    /// Report what this installation can do instead: pages, audio, formats, disk, ports. The lake's data are not read.
    #[arg(long = "self")]
    pub(crate) installation: bool,
    /// Print the report as JSON.
    #[arg(long)]
    pub(crate) json: bool,
}
