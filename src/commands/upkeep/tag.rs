//! `echolake tag`: names for versions of the lake.

use clap::Args;
use echolake_lake::{Lake, LakeMoment, TagName};

use crate::CommandOutcome;

#[derive(Debug, Args)]
pub(crate) struct TagArgs {
    /// Name to give; without one, the tags are listed.
    pub name: Option<TagName>,
    /// Version, time or tag to name instead of the newest version.
    #[arg(long, value_name = "MOMENT", requires = "name", conflicts_with = "delete")]
    pub at: Option<LakeMoment>,
    /// Delete the tag.
    #[arg(long, requires = "name")]
    pub delete: bool,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

pub(crate) async fn run_tag(args: &TagArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let lake = Lake::open(lake_url).await?;
    let tags = match &args.name {
        None => lake.list_tags().await?,
        Some(name) if args.delete => {
            lake.delete_tag(name).await?;
            eprintln!("tag `{name}` is deleted");
            return Ok(CommandOutcome::Whole);
        }
        Some(name) => {
            let newest = lake.list_versions().await?.last().map(|version| LakeMoment::Version(version.version));
            let Some(moment) = args.at.clone().or(newest) else {
                anyhow::bail!("`{lake_url}` has no version to name; hint: `echolake ingest` makes the first one");
            };
            vec![lake.create_tag(name, &moment).await?]
        }
    };
    if args.json {
        crate::commands::print_line(&serde_json::to_string_pretty(&tags)?)?;
        return Ok(CommandOutcome::Whole);
    }
    if tags.is_empty() {
        eprintln!("no tags; hint: `echolake tag NAME` names the newest version");
    }
    let versions = lake.list_versions().await?;
    for tag in &tags {
        let committed = tag.committed.format("%Y-%m-%d %H:%M:%S UTC");
        let is_there = versions.iter().any(|version| tag.is_of(version));
        let gone = if is_there { "" } else { ", gone: the tables were made again since" };
        crate::commands::print_line(&format!("{}  version {} of {committed}{gone}", tag.name, tag.version))?;
    }
    Ok(CommandOutcome::Whole)
}
