//! Kills `serve` while a client annotates.
#![allow(clippy::print_stdout, reason = "figures are what it is for")]

use anyhow::Result;

use super::annotation_kills::AnnotationKillCampaign;

#[derive(Debug, clap::Args)]
pub(crate) struct KillAnnotationsArgs {
    /// Number of servers that are killed.
    #[arg(default_value_t = 200)]
    kills: usize,
    /// Seed of the moments.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

pub(crate) fn run_kill_annotations(args: &KillAnnotationsArgs) -> Result<()> {
    let mut campaign = AnnotationKillCampaign::new(&super::echolake_path()?, args.seed);
    let counts = campaign.kills(args.kills, &mut |so_far| {
        if so_far.killed.is_multiple_of(20) {
            eprintln!("{} of {} kills, {} acknowledged", so_far.killed, args.kills, so_far.acknowledged);
        }
    });
    println!(
        "{} kills: {} annotations acknowledged, 0 lost, 0 stored twice; {} sent again, of which {} were stored before",
        counts.killed, counts.acknowledged, counts.repeated, counts.known
    );
    Ok(())
}
