//! The short version of the campaign `flips` of `campaigns/`: the same rounds in every build.

#[path = "../../campaigns/src/flips/campaign/mod.rs"]
mod campaign;

use campaign::{FlipSettings, OutcomeTally};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_hundred_damaged_files_lose_only_what_is_damaged() {
    let summary = campaign::run(FlipSettings { count: 200, seed: 1, first: 0 }, &mut |_| {}).await.expect("specimens");
    assert!(summary.failures.is_empty(), "{}", summary.failures.join("\n"));
    let total = |count: fn(&OutcomeTally) -> u64| summary.by_kind.iter().map(|(_, tally)| count(tally)).sum::<u64>();
    assert_eq!(total(|t| t.rounds), 200);
    assert_eq!(total(|t| t.complete + t.partial + t.refused), 200, "each round had one of three ends");
    // That the rounds reach all of these shows that the checks above had something to check.
    assert!(summary.by_kind.iter().all(|(_, tally)| tally.rounds > 5));
    assert!(total(|t| t.partial) > 50 && total(|t| t.refused) > 5 && total(|t| t.lost) > 100);
    assert!(total(|t| t.kept) > total(|t| t.lost), "damage of all these kinds leaves most of a file");
    assert!(summary.specimens.iter().all(|s| s.1 > 50_000 && s.2 > 5 && s.3 > 20));
}
