//! Long forms of what the tests try in short, and benchmarks: a subcommand each of one program. The test command does
//! not build it, because no test needs it.
#![allow(clippy::print_stderr, reason = "a campaign tells how it goes")]

#[path = "../../tests/acquire_kills.rs"]
mod acquire_kills;
#[path = "../../tests/annotation_kills.rs"]
mod annotation_kills;
mod attacks;
mod bench;
mod cancels;
#[path = "../../tests/contribution_campaign/mod.rs"]
mod contribution_campaign;
mod contribution_sequences;
#[path = "../../tests/differences/mod.rs"]
mod differences;
mod engine_kills;
#[path = "../../tests/forgetful.rs"]
mod forgetful;
#[path = "../../tests/fuzz/mod.rs"]
mod fuzz;
mod fuzz_server;
mod hostile_clients;
#[path = "../../tests/hostile_files.rs"]
mod hostile_files;
mod hostile_ingest;
mod kill_acquire;
mod kill_annotations;
mod kill_ingest;
#[path = "../../tests/kills.rs"]
mod kills;
mod motion;
mod observed_server;
mod operator_rounds;
#[path = "../../tests/operators/mod.rs"]
mod operators;
mod percentile;
#[allow(dead_code, reason = "the tests' clients, of which this wants a part")]
#[path = "../../tests/serve"]
mod serve {
    pub(crate) mod http;
    pub(crate) mod server;
    pub(crate) mod tunnel;
}
mod sql_differences;
mod workers;

use std::path::PathBuf;

use anyhow::{Context as _, Result};
use clap::Parser as _;

// As in the `echolake` command, so that it is measured as it is used.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Campaigns and benchmarks of echolake.
#[derive(Debug, clap::Parser)]
#[command(name = "stress", max_term_width = 100)]
struct StressCli {
    #[command(subcommand)]
    campaign: CampaignCommand,
}

#[derive(Debug, clap::Subcommand)]
enum CampaignCommand {
    /// Kill ingests, or let two processes ingest at once; the tables must be those of an undisturbed ingest.
    Kills(kill_ingest::KillIngestArgs),
    /// Put hostile and mutated run files into the inbox of `ingest --watch`; all others must be taken in.
    HostileFiles(hostile_ingest::HostileFilesArgs),
    /// Kill `acquire`, with or without the power, recover and resume; nothing acknowledged may be lost.
    AcquireKills(kill_acquire::KillAcquireArgs),
    /// Kill `serve` while a client annotates; nothing acknowledged may be lost or stored twice.
    AnnotationKills(kill_annotations::KillAnnotationsArgs),
    /// Let users of two projects add by two servers, kill these and damage files; nothing may cross or be lost.
    Contributions(contribution_sequences::ContributionSequencesArgs),
    /// Do what people do to a lake, in random sequences; an answer is whole, or an exit code says that it is not.
    Operators(operator_rounds::OperatorArgs),
    /// Throw changed SQL, bytes of each protocol or run files at `serve`.
    Fuzz(fuzz_server::FuzzArgs),
    /// Attack `serve` by statements and by bytes; other clients must not notice it.
    Attacks(attacks::AttackArgs),
    /// Let some of many clients be hostile; the others' answers must be right and soon.
    HostileClients(hostile_clients::HostileClientsArgs),
    /// Kill engines of `serve` while they answer; no short answer may look whole.
    EngineKills(engine_kills::EngineKillsArgs),
    /// Compare generated SQL with DuckDB, and shrink what differs.
    SqlDifferences(sql_differences::SqlDifferenceArgs),
    /// Compare answers over workers with those of one process, also while workers are killed.
    Workers(workers::WorkersArgs),
    /// Measure how soon the server is idle after a query is ended.
    Cancels(cancels::CancelArgs),
    /// Measure ingest, queries, readers and other things beside peers and limits.
    Bench(bench::BenchArgs),
    /// Compare orders in which the arms visit the grid, and show what they cannot reach.
    Motion(motion::MotionArgs),
}

fn main() -> Result<()> {
    let campaign = StressCli::parse().campaign;
    if let CampaignCommand::Bench(_) = &campaign {
        echolake_ingest::keep_freed_memory();
    }
    match campaign {
        CampaignCommand::Kills(args) => kill_ingest::run_kill_ingest(&args),
        CampaignCommand::HostileFiles(args) => hostile_ingest::run_hostile_ingest(&args),
        CampaignCommand::AcquireKills(args) => kill_acquire::run_kill_acquire(&args),
        CampaignCommand::AnnotationKills(args) => kill_annotations::run_kill_annotations(&args),
        CampaignCommand::Contributions(args) => contribution_sequences::run_contribution_sequences(&args),
        CampaignCommand::Operators(args) => operator_rounds::run_operator_rounds(&args),
        CampaignCommand::Fuzz(args) => fuzz_server::run_fuzz_server(&args),
        CampaignCommand::Attacks(args) => attacks::run_attacks(&args),
        CampaignCommand::HostileClients(args) => hostile_clients::run_hostile_clients(&args),
        CampaignCommand::EngineKills(args) => engine_kills::run_engine_kills(&args),
        CampaignCommand::SqlDifferences(args) => sql_differences::compare_with_duckdb(&args),
        CampaignCommand::Workers(args) => workers::run_workers(&args),
        CampaignCommand::Cancels(args) => cancels::run_cancel_campaign(&args),
        CampaignCommand::Bench(args) => bench::run_bench(&args),
        CampaignCommand::Motion(args) => motion::run_motion(&args),
    }
}

fn block_on<T>(work: impl Future<Output = Result<T>>) -> Result<T> {
    tokio::runtime::Builder::new_multi_thread().enable_all().build()?.block_on(work)
}

/// Returns the path of the `echolake` command, which is built beside this program.
fn echolake_path() -> Result<PathBuf> {
    let path = std::env::current_exe().context("this program has no path")?.with_file_name("echolake");
    anyhow::ensure!(path.exists(), "`{}` is missing; hint: build `echolake` with the same profile", path.display());
    Ok(path)
}
