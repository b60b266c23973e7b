//! Cost of what a server for a lab has and one for oneself has not: encryption, tokens, the audit, traces, and a log. Two
//! servers of one lake are asked in turn, so that what else the machine does falls on both.
#![allow(clippy::print_stdout, reason = "its figures are what it is for")]

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use echolake_testing::run_command;

use super::catalogue_client::CatalogueServer;
use super::observed_server::ProcessTree;
use super::percentile::{millis, percentile};
use super::readers::{CatalogueContents, QuestionKind, ReaderLoad};
use super::serve::server::ServedLake;

/// A trace that requests are part of: version, trace, span, sampled.
const TRACE: &str = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01";

/// Temporary files beside the tokens, so that nothing is written to the lake.
const TEMP: [&str; 2] = ["--temp", "."];

#[derive(Debug, Clone, clap::Args)]
pub(crate) struct OverheadArgs {
    /// A lake with rows; it is only read.
    lake: PathBuf,
    /// Readers at once.
    #[arg(long, value_name = "N", default_value_t = 200)]
    readers: u64,
    /// Duration of reading from one server in a round, in seconds.
    #[arg(long, value_name = "SECS", default_value_t = 10)]
    seconds: u64,
    /// Number of rounds.
    #[arg(long, value_name = "N", default_value_t = 5)]
    rounds: usize,
}

/// One of the two servers, and its clients.
struct ComparedServer {
    name: &'static str,
    served: ServedLake,
    client: CatalogueServer,
}

/// Figures of a round.
struct RoundFigures {
    answers_per_second: f64,
    median_ms: f64,
    p95_ms: f64,
    /// Processor time of the server's processes.
    processor_ms_per_answer: f64,
}

/// A figure by its name, and whether more of it is better.
type FigureColumn = (&'static str, fn(&RoundFigures) -> f64, FigureSense);

/// The direction in which a figure is better.
#[derive(Clone, Copy, PartialEq, Eq)]
enum FigureSense {
    More,
    Less,
}

const FIGURES: [FigureColumn; 4] = [
    ("answers a second", |figures| figures.answers_per_second, FigureSense::More),
    ("median, ms", |figures| figures.median_ms, FigureSense::Less),
    ("95th percentile, ms", |figures| figures.p95_ms, FigureSense::Less),
    ("server's processor time an answer, ms", |figures| figures.processor_ms_per_answer, FigureSense::Less),
];

pub(crate) fn run(args: &OverheadArgs) -> Result<()> {
    let binary = super::echolake_path()?;
    let folder = tempfile::tempdir()?;
    let lake = args.lake.canonicalize().with_context(|| format!("`{}` is no lake", args.lake.display()))?;
    let servers = [plain_server(&binary, folder.path(), &lake), guarded_server(&binary, folder.path(), &lake)?];
    let contents = Arc::new(CatalogueContents::read(&servers[0].client)?);
    for (title, kind, readers) in [("pages", QuestionKind::All, args.readers), ("one response", QuestionKind::Ir, 1)] {
        let measure = |server: &ComparedServer| measure_round(server, &contents, kind, readers, args.seconds);
        // What is loaded at first use is loaded.
        servers.iter().try_for_each(|server| measure(server).map(drop))?;
        let mut rounds = [Vec::new(), Vec::new()];
        for round in 0..args.rounds {
            // Each goes first as often as the other.
            for at in [round % 2, 1 - round % 2] {
                rounds[at].push(measure(&servers[at])?);
            }
        }
        println!("{title}: {readers} readers, {} rounds of {} s", args.rounds, args.seconds);
        for figure in &FIGURES {
            print_figure(figure, &servers, &rounds);
        }
    }
    Ok(())
}

fn plain_server(binary: &Path, folder: &Path, lake: &Path) -> ComparedServer {
    let mut command = serve_command(binary, folder, lake);
    let served = ServedLake::start_command(command.env("RUST_LOG", "off"), &TEMP);
    let client = CatalogueServer::new(&served.http);
    ComparedServer { name: "plain", served, client }
}

fn guarded_server(binary: &Path, folder: &Path, lake: &Path) -> Result<ComparedServer> {
    make(binary, folder, &["certificate", "localhost", "-o", "tls"])?;
    let (token, lines) = make(binary, folder, &["token", "reader"])?;
    // What follows are limits, of which the plain server has none.
    std::fs::write(folder.join("tokens.toml"), lines.split("seconds").next().unwrap_or_default())?;
    let more = ["--tokens", "tokens.toml", "--certificate", "tls/certificate.pem", "--key", "tls/key.pem"];
    let log = ["--log-format", "json", "--log-slow", "1s"];
    let served =
        ServedLake::start_command(&mut serve_command(binary, folder, lake), &[&more[..], &log, &TEMP].concat());
    let token = token.lines().next().context("no token")?;
    let client = CatalogueServer::new(&served.http).with_token(token).with_header("traceparent", TRACE);
    let client = client.with_certificate(&folder.join("tls/certificate.pem"))?;
    Ok(ComparedServer { name: "guarded", served, client })
}

fn serve_command(binary: &Path, folder: &Path, lake: &Path) -> Command {
    let mut command = Command::new(binary);
    command.arg("--lake").arg(lake).current_dir(folder).env_remove("ECHOLAKE_LAKE");
    command
}

// What a command writes to stderr and to stdout.
fn make(binary: &Path, folder: &Path, args: &[&str]) -> Result<(String, String)> {
    let output = run_command(Command::new(binary).args(args).current_dir(folder))?;
    let said = String::from_utf8(output.stderr)?;
    ensure!(output.status.success(), "{args:?}: {said}");
    Ok((said, String::from_utf8(output.stdout)?))
}

fn measure_round(
    server: &ComparedServer,
    contents: &Arc<CatalogueContents>,
    kind: QuestionKind,
    readers: u64,
    seconds: u64,
) -> Result<RoundFigures> {
    let (client, contents, time) = (server.client.clone(), contents.clone(), Duration::from_secs(seconds));
    let processes = ProcessTree::new(server.served.id());
    let before = processes.processor_time();
    let times = ReaderLoad { server: client, contents, kind, readers, time }.measure(|| {})?;
    let worked = processes.processor_time().saturating_sub(before);
    ensure!(times.errors == 0, "{} requests to the {} server failed", times.errors, server.name);
    ensure!(!times.answers.is_empty(), "the {} server answered nothing in {seconds} s", server.name);
    let answers = times.answers.len() as f64;
    Ok(RoundFigures {
        answers_per_second: answers / time.as_secs_f64(),
        median_ms: millis(percentile(&times.answers, 0.5)),
        p95_ms: millis(percentile(&times.answers, 0.95)),
        processor_ms_per_answer: millis(worked) / answers,
    })
}

// Medians over the rounds, and the median of the rounds' overheads: more time, or fewer answers, in percent.
fn print_figure((name, figure, sense): &FigureColumn, servers: &[ComparedServer; 2], rounds: &[Vec<RoundFigures>; 2]) {
    let of = |at: usize| rounds[at].iter().map(figure).collect::<Vec<f64>>();
    let (plain, guarded) = (of(0), of(1));
    let overheads = plain.iter().zip(&guarded).map(|(plain, guarded)| match sense {
        FigureSense::Less => (guarded / plain - 1.0) * 100.0,
        FigureSense::More => (plain / guarded - 1.0) * 100.0,
    });
    let overheads: Vec<f64> = overheads.collect();
    let spread = overheads.iter().fold((f64::MAX, f64::MIN), |(low, high), o| (low.min(*o), high.max(*o)));
    println!(
        "  {name}: {} {:.2}, {} {:.2}, overhead {:.1} % ({:.1} to {:.1})",
        servers[0].name,
        median(plain),
        servers[1].name,
        median(guarded),
        median(overheads),
        spread.0,
        spread.1
    );
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}
