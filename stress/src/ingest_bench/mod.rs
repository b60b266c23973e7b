//! Cost of ingest beside that of its unavoidable parts, side by side in one run: the bare transforms, the reference
//! pipeline in NumPy, the parquet crate alone; and the size of a lake.
//!
//! With `--quick` it takes less than a minute. Ratios are of CPU time, the least of a few repeats that take turns, so
//! that other programs disturb them little.

mod lake_size;
mod layout;
mod meter;
mod parquet_files;
mod report;
mod responses;
mod simulated;
mod sweeps;

use std::path::PathBuf;

use anyhow::Result;
use report::FigureReport;
use simulated::REFERENCES;

#[derive(Debug, clap::Args)]
pub(crate) struct IngestBenchArgs {
    /// Smaller runs and fewer repeats.
    #[arg(long)]
    quick: bool,
    /// Pairs of each of the four runs with sweeps.
    #[arg(long, value_name = "N")]
    pairs: Option<usize>,
    /// Runs without sweeps, of all pairs, the references among them.
    #[arg(long, value_name = "K")]
    runs: Option<usize>,
    /// Repeats, of which the best counts.
    #[arg(long, value_name = "N")]
    repeats: Option<usize>,
    /// A Python that has NumPy and SciPy.
    #[arg(long, value_name = "PATH", default_value = "python3")]
    python: PathBuf,
    /// Folder of `pipeline.py`.
    #[arg(long, value_name = "DIR", default_value = "../shared/reference")]
    reference: PathBuf,
    /// Parent of the temporary folder; it should be on the disk that the lake would be on.
    #[arg(long, value_name = "DIR")]
    folder: Option<PathBuf>,
    /// Seed of the simulated rig.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

impl IngestBenchArgs {
    fn pairs(&self) -> usize {
        self.pairs.unwrap_or(if self.quick { 300 } else { 1500 }).max(1)
    }

    fn runs(&self) -> usize {
        self.runs.unwrap_or(if self.quick { 4 } else { 6 }).max(REFERENCES + 1)
    }

    fn repeats(&self) -> usize {
        self.repeats.unwrap_or(if self.quick { 2 } else { 4 }).max(1)
    }
}

pub(crate) fn run_ingest_bench(args: &IngestBenchArgs) -> Result<()> {
    let folder = match &args.folder {
        Some(parent) => tempfile::tempdir_in(parent)?,
        None => tempfile::tempdir()?,
    };
    let mut report = FigureReport::new();
    super::block_on(async {
        sweeps::measure_sweeps(args, folder.path(), &mut report).await?;
        responses::measure_responses(args, folder.path(), &mut report).await
    })?;
    report.finish()
}
