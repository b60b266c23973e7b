//! The arguments, and nothing else.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};
use echolake_acquisition::collection::LARGEST;
use echolake_acquisition::mesh::Side;
use echolake_acquisition::replay::SPEEDS;
use echolake_lake::{KEEP_HOURS, TARGET_BYTES};
use echolake_schema::SurfaceId;

use crate::commands::export::ExportCommand;
use crate::commands::panel::PanelArgs;
use crate::commands::serve::ServeArgs;
use crate::commands::sql::SqlArgs;

/// A data lake and catalogue for sweep measurements.
#[derive(Debug, Parser)]
#[command(version, max_term_width = 100)]
pub(crate) struct Cli {
    /// The lake: a folder or a file:// URL.
    #[arg(long, global = true, env = "ECHOLAKE_LAKE", default_value = "lake", value_name = "URL")]
    pub(crate) lake: String,
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Measure a few surfaces with the simulated rig, ingest them, print the paper's tables and serve the catalogue.
    Demo(DemoArgs),
    /// Measure one surface with the simulated rig: one run, one MCAP file.
    Acquire(AcquireArgs),
    /// Write a generated relief as a mesh, heights or a picture; make groups of them.
    Panel(PanelArgs),
    /// Turn existing measurements into runs.
    #[command(subcommand)]
    Import(ImportCommand),
    /// Turn runs into rows.
    Ingest(IngestArgs),
    /// Ask the lake in SQL; a prompt where no query is given.
    Sql(SqlArgs),
    /// Data out: training sets, slices of runs, SOFA, WAV, npz.
    #[command(subcommand)]
    Export(ExportCommand),
    /// Show runs again to Foxglove, which plays, pauses and seeks, and to Lichtblick.
    Replay(ReplayArgs),
    /// Serve the catalogue, and the lake over HTTP, Arrow Flight SQL and Postgres' protocol, for reading.
    Serve(ServeArgs),
    /// Make a token for `serve --tokens`.
    Token {
        /// Whose it is.
        name: String,
    },
    /// Rebuild a recording that was cut off or damaged, as far as every checksum is right.
    Recover(RecoverArgs),
    /// Say what is in the lake, what is missing and what is damaged.
    Doctor(DoctorArgs),
    /// Merge the tables' small files into large ones; ingest and queries may go on.
    Optimize(OptimizeArgs),
    /// Delete files that are in no table any more, and what crashes left behind.
    Vacuum(VacuumArgs),
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
pub(crate) struct DemoArgs {
    /// Measure this many surfaces instead: the references, then panels of every typology with random parameters.
    /// Those that are measured already are not measured again.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=LARGEST as i64))]
    pub(crate) surfaces: Option<u32>,
    /// Record no sweeps, only impulse responses: a tenth of the space.
    #[arg(long)]
    pub(crate) ir_only: bool,
    /// Do not serve the catalogue afterwards.
    #[arg(long)]
    pub(crate) no_serve: bool,
    /// Leave the runs in the lake's inbox/.
    #[arg(long, hide = true)]
    pub(crate) no_ingest: bool,
    /// The rig; by default that of the paper with sweeps of 0.05 s.
    #[arg(long)]
    pub(crate) rig: Option<PathBuf>,
    /// Seed of the simulation: the same seed gives the same lake.
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
}

#[derive(Debug, Args)]
pub(crate) struct AcquireArgs {
    /// Name of the measured surface, as 0015_0.
    #[arg(long, required_unless_present = "resume")]
    pub(crate) surface: Option<SurfaceId>,
    /// Go on with a run that was stopped or cut off: its `.mcap.partial`. What is safe in it is not measured again.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["surface", "panel", "parameters", "set", "mesh", "side", "rig", "flat", "foam", "seed", "ir_only"])]
    pub(crate) resume: Option<PathBuf>,
    /// What the simulated rig measures, as `echolake panel --list` names it; by default what the surface's name begins
    /// with.
    #[arg(long, value_name = "NAME", conflicts_with = "mesh")]
    pub(crate) panel: Option<String>,
    /// A JSON file of parameters, as `echolake panel` writes them, in place of a name.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["mesh", "panel"])]
    pub(crate) parameters: Option<PathBuf>,
    /// A parameter of it.
    #[arg(long, value_name = "KEY=VALUE")]
    pub(crate) set: Vec<String>,
    /// A mesh to measure instead: GLB, STL, OBJ or PLY.
    #[arg(long)]
    pub(crate) mesh: Option<PathBuf>,
    /// The side of the mesh that is measured: the back is seen when the panel is turned over about its y axis.
    #[arg(long, value_name = "front|back", value_parser = side, requires = "mesh")]
    pub(crate) side: Option<Side>,
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
    /// Serve metrics for Prometheus under http://ADDR/metrics.
    #[arg(long, value_name = "ADDR")]
    pub(crate) metrics: Option<std::net::SocketAddr>,
    /// Send metrics every ten seconds as InfluxDB lines: udp://HOST:PORT, or an http:// address of a write endpoint.
    #[arg(long, value_name = "URL")]
    pub(crate) influx: Option<String>,
}

#[derive(Debug, Args)]
pub(crate) struct RecoverArgs {
    /// The recording that was cut off or damaged; it is only read.
    pub(crate) file: PathBuf,
    /// Where the rebuilt file goes; by default beside it, without `.partial`.
    #[arg(short, long, value_name = "FILE")]
    pub(crate) output: Option<PathBuf>,
    /// Print what was done as JSON.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Subcommand)]
pub(crate) enum ImportCommand {
    /// Recordings and loopbacks as WAV files, listed in a CSV manifest.
    Wav {
        /// The manifest.
        manifest: PathBuf,
        /// The rig that made them: sweep range, response length, bands, grid.
        #[arg(long)]
        rig: Option<PathBuf>,
    },
    /// A folder of the published GIR data set.
    Gir {
        /// The folder.
        folder: PathBuf,
        /// The rig; by default the lake's, or the paper's with responses of 400 samples for a new lake.
        #[arg(long)]
        rig: Option<PathBuf>,
    },
    /// Responses as SOFA files (SingleRoomSRIR), one a surface.
    Sofa {
        /// The files.
        #[arg(required = true, value_name = "FILE")]
        files: Vec<PathBuf>,
        /// The rig; by default the lake's, or the paper's for a new lake.
        #[arg(long)]
        rig: Option<PathBuf>,
        /// Temperature of files that do not tell it.
        #[arg(long, value_name = "C", allow_negative_numbers = true)]
        temperature_c: Option<f64>,
    },
}

#[derive(Debug, Args)]
pub(crate) struct ReplayArgs {
    /// Names of runs, surfaces (of each its newest run), or .mcap files; they are shown one after the other.
    #[arg(required = true, value_name = "RUN")]
    pub(crate) runs: Vec<String>,
    /// Where to listen; who reaches it can look on.
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8765")]
    pub(crate) listen: std::net::SocketAddr,
    /// Speed at first, as a factor of real time.
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = speed)]
    pub(crate) speed: f32,
    /// Wait for a viewer's play button; without it playback begins with the first viewer.
    #[arg(long)]
    pub(crate) paused: bool,
}

fn side(text: &str) -> Result<Side, String> {
    Side::parse(text).ok_or_else(|| "expected front or back".to_owned())
}

fn speed(text: &str) -> Result<f32, String> {
    let speed = text.parse().ok().filter(|x| SPEEDS.contains(x));
    speed.ok_or_else(|| format!("expected a number from {} to {}", SPEEDS.start(), SPEEDS.end()))
}

#[derive(Debug, Args)]
pub(crate) struct IngestArgs {
    /// Run files, or names of runs in the lake; by default all that are not in the tables yet.
    pub(crate) runs: Vec<String>,
    /// Go on: take in what comes into the lake's inbox, until Ctrl-C.
    #[arg(long, conflicts_with_all = ["runs", "json"])]
    pub(crate) watch: bool,
    /// Print what was done as JSON.
    #[arg(long)]
    pub(crate) json: bool,
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

#[derive(Debug, Args)]
pub(crate) struct OptimizeArgs {
    /// Size of the merged files in MB; files of half of it and more are left alone.
    #[arg(long, value_name = "MB", default_value_t = TARGET_BYTES >> 20, value_parser = clap::value_parser!(u64).range(1..=1024))]
    pub(crate) target_mb: u64,
    /// Print what was done as JSON.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct VacuumArgs {
    /// Keep files that went out of their table less than this long ago: longer than any query runs. 168 at most,
    /// because a table's log forgets after a week when that was.
    #[arg(long, value_name = "HOURS", default_value_t = KEEP_HOURS, value_parser = clap::value_parser!(u32).range(0..=KEEP_HOURS as i64))]
    pub(crate) keep_hours: u32,
    /// Only say what would be deleted.
    #[arg(long)]
    pub(crate) dry_run: bool,
    /// Print what was done as JSON.
    #[arg(long)]
    pub(crate) json: bool,
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    #[test]
    fn the_arguments_are_consistent() {
        super::Cli::command().debug_assert();
    }
}
