//! The arguments of the commands that need the lake's tables.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use echolake_acquisition::panel::collection::LARGEST;
use echolake_lake::{KEEP_HOURS, TARGET_BYTES};

use crate::commands::export::ExportCommand;
use crate::commands::serve::{EngineArgs, ServeArgs};
use crate::commands::sql::SqlArgs;

#[derive(Debug, Subcommand)]
pub(crate) enum LakeCommand {
    /// Measure a few surfaces with the simulated rig, ingest them, print the paper's tables and serve the catalogue.
    Demo(DemoArgs),
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
    /// Serve the catalogue, and the lake over HTTP, Arrow Flight SQL and Postgres' protocol, for reading.
    Serve(ServeArgs),
    /// Answer one client's queries, as a child of `serve`.
    #[command(hide = true)]
    Engine(EngineArgs),
    /// Make a token for `serve --tokens`.
    Token {
        /// Name of its holder.
        name: String,
    },
    /// Merge the tables' small files into large ones; ingest and queries may go on.
    Optimize(OptimizeArgs),
    /// Delete files that are in no table any more, and what crashes left behind.
    Vacuum(VacuumArgs),
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
    /// Seed of the simulation: the same seed gives the same data.
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
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
pub(crate) struct IngestArgs {
    /// Run files, or names of runs in the lake; by default all that are not in the tables yet.
    pub(crate) runs: Vec<String>,
    /// Go on: take in what comes into the lake's inbox, until Ctrl-C.
    #[arg(long, conflicts_with_all = ["runs", "json"])]
    pub(crate) watch: bool,
    /// Print what was done as JSON.
    #[arg(long)]
    pub(crate) json: bool,
    /// Take in this file of the lake alone, for the ingest that started this one.
    #[arg(long, hide = true, value_name = "PATH", conflicts_with_all = ["runs", "watch", "json"])]
    pub(crate) suspect: Option<String>,
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
