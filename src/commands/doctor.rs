//! `echolake doctor`: what is in the lake, what is missing and what is damaged; and what the installation can do.

mod installation;
#[cfg(feature = "lake")]
mod lake;

use crate::CommandOutcome;
use clap::Args;

#[derive(Debug, Args)]
pub(crate) struct DoctorArgs {
    /// Report what this installation can do instead: pages, audio, formats, disk, ports. The lake's data are not read.
    #[arg(long = "self")]
    pub installation: bool,
    /// Print the report as JSON.
    #[arg(long)]
    pub json: bool,
    /// Write the numbers of findings to this file for Prometheus, as the textfile collector of node_exporter reads it.
    #[cfg(feature = "lake")]
    #[arg(long, value_name = "FILE", conflicts_with = "installation")]
    pub prometheus: Option<std::path::PathBuf>,
}

pub(crate) async fn run_doctor(args: &DoctorArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    if args.installation {
        return installation::report_installation(args.json, lake_url).await;
    }
    #[cfg(feature = "lake")]
    return lake::report_lake(args, lake_url).await;
    #[cfg(not(feature = "lake"))]
    anyhow::bail!("this program has no tables to look into; hint: `echolake doctor --self` looks at the program itself")
}
