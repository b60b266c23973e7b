//! Lets users of two projects add to a lake in random sequences, with faults.
#![allow(clippy::print_stdout, reason = "figures are what it is for")]

use anyhow::Result;

use super::contribution_campaign::ContributionCampaign;

#[derive(Debug, clap::Args)]
pub(crate) struct ContributionSequencesArgs {
    /// Number of sequences, with a lost or damaged file each.
    #[arg(default_value_t = 200)]
    sequences: usize,
    /// Seed of what is done.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

pub(crate) fn run_contribution_sequences(args: &ContributionSequencesArgs) -> Result<()> {
    let mut campaign = ContributionCampaign::new(&super::echolake_path()?, args.seed);
    let counts = campaign.sequences(args.sequences, &mut |so_far| {
        if so_far.sequences.is_multiple_of(10) {
            eprintln!("{} of {} sequences, {so_far:?}", so_far.sequences, args.sequences);
        }
    });
    println!(
        "{} sequences, seed {}: {} requests acknowledged, 0 of their rows lost or seen by the other project; {} \
         refused; {} without an answer, of which {} were sent again",
        counts.sequences, args.seed, counts.acknowledged, counts.refused, counts.unanswered, counts.repeated
    );
    Ok(())
}
