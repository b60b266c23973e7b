//! Cost of ingest beside that of its unavoidable parts, side by side in one run: the bare transforms, the reference
//! pipeline in NumPy, the parquet crate alone; and the size of a lake.
//!
//! With `--quick` it takes less than a minute. Ratios are of CPU time, the least of a few repeats that take turns, so
//! that other programs disturb them little.

pub(crate) mod lake_size;
mod layout;
mod parquet_files;
pub(crate) mod responses;
pub(crate) mod simulated;
pub(crate) mod sweeps;

use std::path::PathBuf;

use anyhow::Result;
use echolake_lake::Lake;
use simulated::REFERENCES;

use super::report::BenchReport;

#[derive(Debug, clap::Args)]
pub(crate) struct IngestBenchArgs {
    /// Smaller runs and fewer repeats.
    #[arg(long)]
    pub quick: bool,
    /// Pairs of each of the four runs with sweeps.
    #[arg(long, value_name = "N")]
    pub pairs: Option<usize>,
    /// Runs without sweeps, of all pairs, the references among them.
    #[arg(long, value_name = "K")]
    pub runs: Option<usize>,
    /// Repeats, of which the best counts.
    #[arg(long, value_name = "N")]
    pub repeats: Option<usize>,
    /// A Python that has NumPy and SciPy.
    #[arg(long, value_name = "PATH", default_value = "python3")]
    pub python: PathBuf,
    /// Folder of `pipeline.py`.
    #[arg(long, value_name = "DIR", default_value = "../shared/reference")]
    pub reference: PathBuf,
    /// Parent of the temporary folder; it should be on the disk that the lake would be on.
    #[arg(long, value_name = "DIR")]
    pub folder: Option<PathBuf>,
    /// Seed of the simulated rig.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

impl IngestBenchArgs {
    fn pairs(&self) -> usize {
        self.pairs.unwrap_or(if self.quick { 300 } else { 1500 }).max(1)
    }

    fn runs(&self) -> usize {
        self.runs.unwrap_or(if self.quick { 4 } else { 12 }).max(REFERENCES + 1)
    }

    fn repeats(&self) -> usize {
        self.repeats.unwrap_or(if self.quick { 2 } else { 4 }).max(1)
    }
}

pub(crate) async fn measure_ingest(args: &IngestBenchArgs, report: &mut BenchReport) -> Result<()> {
    let folder = super::temporary_folder(args.folder.as_deref())?;
    sweeps::measure_sweeps(args, folder.path(), report).await?;
    responses::measure_responses(args, folder.path(), report).await?;
    let lake = Lake::open(&folder.path().join("lake").display().to_string()).await?;
    lake_size::measure_lake_size(&lake, report).await?;
    layout::measure_layouts(args, &parquet_files::read_table_files(&lake).await?, report)
}
