//! Benchmarks: figures beside peers and limits that are measured in the same run.

mod catalogue_client;
mod ingest;
mod limits;
mod mcap;
mod memory;
mod meter;
mod queries;
mod readers;
mod report;
mod scale;
mod served_costs;
mod slices;
mod whole;

use std::path::Path;

use anyhow::{Context as _, Result};
use tempfile::TempDir;

use crate::block_on;
use report::{BenchReport, ReportOutput};

/// Responses of the full lake, of 350 surfaces: figures of smaller ones are scaled to it.
const FULL_LAKE_RESPONSES: u64 = 1_032_764;

#[derive(Debug, clap::Args)]
pub(crate) struct BenchArgs {
    #[command(subcommand)]
    bench: BenchCommand,
    #[command(flatten)]
    output: ReportOutput,
}

#[derive(Debug, clap::Subcommand)]
enum BenchCommand {
    /// Measure ingest beside bare transforms, the reference pipeline and the parquet crate alone.
    Ingest(ingest::IngestBenchArgs),
    /// Measure queries beside DuckDB on the same files.
    Queries(queries::QueryBenchArgs),
    /// Measure `mcap()` beside Python's mcap.
    Mcap(mcap::McapBenchArgs),
    /// Measure many readers of a served catalogue at once.
    Readers(readers::ReadersArgs),
    /// Measure slices of a served run, for one reader and for many.
    Slices(slices::SlicesArgs),
    /// Measure costs against the size of a lake.
    Scale(scale::ScaleBenchArgs),
    /// Make lakes, and measure all but slices on them.
    All(whole::WholeBenchArgs),
}

pub(crate) fn run_bench(args: &BenchArgs) -> Result<()> {
    let mut report = BenchReport::new();
    match &args.bench {
        BenchCommand::Ingest(args) => block_on(ingest::measure_ingest(args, &mut report)),
        BenchCommand::Queries(args) => block_on(queries::measure_queries(args, &mut report)),
        BenchCommand::Mcap(args) => block_on(mcap::measure_mcap(args, &mut report)),
        BenchCommand::Readers(args) => readers::measure_readers(args, &mut report),
        BenchCommand::Slices(args) => slices::measure_slices(args, &mut report),
        BenchCommand::Scale(args) => block_on(scale::measure_scale(args, &mut report)),
        BenchCommand::All(args) => whole::measure_whole(args, &mut report),
    }?;
    report.finish(&args.output)
}

/// Makes a folder that is removed at the end, in `parent` or where the system has such folders.
fn temporary_folder(parent: Option<&Path>) -> Result<TempDir> {
    Ok(match parent {
        Some(parent) => tempfile::tempdir_in(parent).with_context(|| format!("in `{}`", parent.display()))?,
        None => tempfile::tempdir()?,
    })
}

/// Runs the same work on a thread for each core.
///
/// # Errors
/// Work fails or panics.
fn run_on_cores<T: Send>(work: impl Fn() -> Result<T> + Sync) -> Result<Vec<T>> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..cores).map(|_| scope.spawn(&work)).collect();
        threads.into_iter().map(|thread| thread.join().ok().context("a thread panicked").flatten()).collect()
    })
}
