//! Compares generated statements with DuckDB, and prints the smallest statement of each sort of difference.
#![allow(clippy::print_stdout, reason = "figures are what it is for")]

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};

use super::differences::{
    ComparisonOutcome, DOCUMENTED, DifferenceCampaign, DifferenceCounts, DocumentedDifference, RowOrder,
    find_documented, install_duckdb,
};

/// Between two lines about how far it is.
const TELL_EVERY: Duration = Duration::from_secs(30);

#[derive(Debug, clap::Args)]
pub(crate) struct SqlDifferenceArgs {
    /// Seed of the statements.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Number of the first statement, to resume.
    #[arg(long, value_name = "N", default_value_t = 0)]
    first: u64,
    /// Number of statements.
    #[arg(long, value_name = "N", default_value_t = 10_000)]
    statements: u64,
    /// Ends it after so many minutes, too.
    #[arg(long, value_name = "MINUTES")]
    minutes: Option<u64>,
    /// Statements that are shrunk, of those of a kind that are refused or wrong alike.
    #[arg(long, value_name = "N", default_value_t = 4)]
    shrunk: usize,
    /// Compares this statement alone.
    #[arg(long, value_name = "SQL")]
    statement: Option<String>,
    /// Python that has the packages duckdb and pyarrow; by default they are installed beside this program.
    #[arg(long)]
    python: Option<PathBuf>,
}

pub(crate) fn compare_with_duckdb(args: &SqlDifferenceArgs) -> Result<()> {
    let python = match &args.python {
        Some(python) => python.clone(),
        None => install_duckdb(&std::env::current_exe()?.with_file_name("differences-python"))?,
    };
    let mut campaign = DifferenceCampaign::new(Some(python))?;
    if let Some(sql) = &args.statement {
        let outcome = campaign.compare_answers(sql, RowOrder::Free)?;
        println!("{}: {}", find_documented(sql, &outcome).unwrap_or(outcome.name()), outcome.detail());
        return Ok(());
    }
    let mut generator = campaign.create_generator(args.seed)?;
    let mut counts = DifferenceCounts::default();
    let begun = Instant::now();
    let mut told = begun;
    let mut next = args.first;
    while next < args.first + args.statements {
        let is_late = |minutes: u64| begun.elapsed() > Duration::from_secs(60 * minutes);
        if args.minutes.is_some_and(is_late) {
            break;
        }
        let statement = generator.generate_statement(next);
        let outcome = campaign.count_statement(next, &statement, args.shrunk, &mut counts)?;
        if let ComparisonOutcome::Different(difference) = &outcome {
            eprintln!("{next}, {}: {difference}\n  {}", statement.kind, statement.sql);
        }
        next += 1;
        if told.elapsed() > TELL_EVERY {
            told = Instant::now();
            let done = next - args.first;
            eprintln!("{done} statements in {:.0?}; resume with --seed {} --first {next}", begun.elapsed(), args.seed);
        }
    }
    report_counts(&counts, next - args.first, begun.elapsed());
    let wrong = counts.wrong().count();
    ensure!(wrong == 0, "{wrong} sorts of difference are not documented");
    Ok(())
}

fn report_counts(counts: &DifferenceCounts, statements: u64, took: Duration) {
    println!("{statements} statements in {took:.0?}\n");
    let mut kinds = BTreeMap::<_, Vec<_>>::new();
    let mut sums = BTreeMap::<_, usize>::new();
    for ((kind, outcome), count) in &counts.outcomes {
        kinds.entry(kind).or_default().push(format!("{count} {outcome}"));
        *sums.entry(outcome).or_default() += count;
    }
    for (kind, outcomes) in kinds {
        println!("{kind}: {}", outcomes.join(", "));
    }
    println!("\nall: {}", sums.iter().map(|(name, count)| format!("{count} {name}")).collect::<Vec<_>>().join(", "));
    for DocumentedDifference { name, sql, reason, .. } in &DOCUMENTED {
        let count = counts.documented.get(name).copied().unwrap_or(0);
        println!("documented, {name}: {count}, as `{sql}`: {reason}");
    }
    let mut findings: Vec<_> = counts.findings.values().collect();
    findings.sort_by_key(|finding| (finding.outcome.name(), std::cmp::Reverse(finding.count)));
    for finding in findings {
        println!(
            "\n[{}] {} times, as by statement {} ({}): {}\n  {}",
            finding.outcome.name(),
            finding.count,
            finding.number,
            finding.kind,
            finding.outcome.detail().lines().next().unwrap_or_default(),
            finding.sql
        );
    }
}
