//! `echolake mcp`: the lake for an agent on this machine, over standard input and output.

use std::path::PathBuf;
use std::time::Duration;

use echolake_server::{AgentDoor, EngineSettings};

use super::cache::CacheArgs;
use super::serve::{MEMORY_MIB, engines};
use crate::CommandOutcome;
use crate::duration::parse_duration;
use crate::signals::StopRequest;

#[derive(Debug, clap::Args)]
pub(crate) struct McpArgs {
    /// Server whose pages and files the answers link to: `echolake serve` of the same lake.
    #[arg(long, value_name = "URL", default_value = "http://localhost:8080")]
    pages: String,
    /// Memory limit of all queries together, MiB; if it is exceeded, the query ends.
    #[arg(long, value_name = "MIB", default_value_t = MEMORY_MIB, value_parser = clap::value_parser!(u32).range(64..))]
    memory: u32,
    /// Log queries that take this long or longer, with their statements, as 1s or 500ms.
    #[arg(long, value_name = "TIME", value_parser = parse_duration)]
    log_slow: Option<Duration>,
    /// Folder for temporary files, such as sorts that do not fit into memory; by default `temp` in the lake.
    #[arg(long, value_name = "DIR")]
    temp: Option<PathBuf>,
    #[command(flatten)]
    cache: CacheArgs,
}

/// Answers until standard input ends.
pub(crate) async fn run(args: &McpArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let stop = StopRequest::listen("stopping")?;
    let lake = args.cache.open_lake(lake_url).await?;
    let settings = EngineSettings {
        slow: args.log_slow,
        cache: args.cache.folder().filter(|_| lake.is_remote()),
        ..engines(args.memory, 1, args.temp.clone())?
    };
    AgentDoor::new(&lake, settings, &args.pages)?.run(stop.wait()).await?;
    Ok(CommandOutcome::Whole)
}
