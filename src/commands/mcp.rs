//! `echolake mcp`: the lake for an agent on this machine, over standard input and output.

use echolake_server::AgentDoor;

use super::serve::QueryArgs;
use crate::CommandOutcome;
use crate::signals::StopRequest;

#[derive(Debug, clap::Args)]
pub(crate) struct McpArgs {
    /// Server whose pages and files the answers link to: `echolake serve` of the same lake.
    #[arg(long, value_name = "URL", default_value = "http://localhost:8080")]
    pages: String,
    #[command(flatten)]
    queries: QueryArgs,
}

/// Answers until standard input ends.
pub(crate) async fn run_mcp(args: &McpArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let stop = StopRequest::listen("stopping")?;
    let lake = args.queries.open_lake(lake_url).await?;
    let settings = args.queries.engine_settings(&lake)?;
    AgentDoor::new(&lake, settings, &args.pages)?.answer_until(stop.wait_until_made()).await?;
    Ok(CommandOutcome::Whole)
}
