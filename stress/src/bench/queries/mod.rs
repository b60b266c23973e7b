//! Queries beside DuckDB on the same Parquet files in the same run, warm, the median of times in turns: twelve of the
//! lake's readers, joins of the air to the takes by time, and generated ones. The twelve are measured once more beside
//! DuckDB on files of one run each, as files were before runs shared them.
//!
//! The Python of `--python` has the packages duckdb and pyarrow. The engines take turns, so that other programs disturb
//! both alike. Answers are compared value by value.

mod run_files;
mod twelve;

use std::collections::BTreeMap;
use std::io::Write as _;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context as _, Result};
use arrow::record_batch::RecordBatch;
use echolake_lake::Lake;
use echolake_query::Session;

use super::report::{BenchReport, FigureGoal};
use crate::differences::{DuckdbPeer, PeerTables, QueryGenerator, collect_batches, find_difference, visible_files};
use twelve::{BenchQuery, TIME_JOIN, TWELVE, time_joins};

pub(crate) use twelve::bench_queries;

/// The one of the twelve that is measured as a first query, too.
const COLD_QUERY: &str = "by_incidence";
/// Slow generated queries that are reported by themselves.
const SHOWN_SLOW: usize = 8;

#[derive(Debug, clap::Args)]
pub(crate) struct QueryBenchArgs {
    /// A lake, as `echolake demo --surfaces 350 --ir-only` makes one.
    #[arg(long, value_name = "FOLDER")]
    pub lake: String,
    /// A Python that has duckdb and pyarrow; without one, echolake alone is measured.
    #[arg(long, value_name = "PATH")]
    pub python: Option<PathBuf>,
    /// Queries that are generated, besides the twelve.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub generated: usize,
    /// Seed of the generated queries.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Timed runs of each query, of which the median counts.
    #[arg(long, value_name = "N", default_value_t = 5)]
    pub runs: usize,
    /// Threads of the peer.
    #[arg(long, value_name = "N", default_value_t = 2)]
    pub threads: usize,
    /// Queries whose name has this in it.
    #[arg(long, value_name = "TEXT", default_value = "")]
    pub only: String,
    /// Shows texts and plans with their metrics instead.
    #[arg(long)]
    pub explain: bool,
    /// Parent of the temporary folder, for copies of the lake's tables.
    #[arg(long, value_name = "DIR")]
    pub folder: Option<PathBuf>,
}

/// A query's times, s.
struct QueryTimes {
    query: BenchQuery,
    own: f64,
    /// Of a text that is new each time: its plan is not kept.
    planned: f64,
    peer: Option<f64>,
    rows: usize,
}

impl QueryTimes {
    fn ratio(&self) -> Option<f64> {
        self.peer.map(|peer| self.own / peer)
    }
}

pub(crate) async fn measure_queries(args: &QueryBenchArgs, report: &mut BenchReport) -> Result<()> {
    let lake = Lake::open(&args.lake).await?;
    let session = Session::new(&lake)?;
    let mut queries = bench_queries(&middle_surface(&lake).await?, 1234);
    queries.extend(time_joins());
    if args.generated > 0 {
        let generated = QueryGenerator::new(&session, args.seed).await?.generate_queries(args.generated);
        queries.extend(generated.into_iter().enumerate().map(|(number, (kind, sql))| BenchQuery {
            name: format!("{kind} #{number}"),
            kind,
            sql,
            peer: None,
        }));
    }
    queries.retain(|query| query.name.contains(&args.only));
    if args.explain {
        for query in &queries {
            explain_query(&session, query).await?;
        }
        return Ok(());
    }
    let mut peer = match &args.python {
        Some(python) => {
            let files = visible_files(&lake).await?;
            Some(DuckdbPeer::start(python, &PeerTables { files, threads: args.threads, ..PeerTables::default() })?)
        }
        None => None,
    };
    let cold = match queries.iter().find(|query| query.name == COLD_QUERY) {
        Some(query) => Some(time_cold_query(args, query, peer.as_mut()).await?),
        None => None,
    };
    let of_run_files: Vec<_> = queries.iter().filter(|query| query.kind == TWELVE).cloned().collect();
    let mut times = time_queries(&session, peer.as_mut(), queries, args.runs, report).await;
    let version = peer.as_ref().map_or(String::new(), |peer| format!("DuckDB {}", peer.version));
    drop(peer);
    let twelve: Vec<_> = times.extract_if(.., |t| t.query.kind == TWELVE).collect();
    if !twelve.is_empty() {
        report.group("Twelve queries");
        report_ratios("the twelve queries", &twelve, [0.5, 1.1], report);
        for times in &twelve {
            report_times(format!("{}, {} rows", times.query.name, times.rows), times, &version, report);
        }
        if let Some(times) = &cold {
            let name = format!("{COLD_QUERY} as the first query: the lake is opened, nothing is decoded or planned");
            report_times(name, times, &version, report);
        }
    }
    // Copies of the whole lake are too much for a query or two.
    if let Some(python) = args.python.as_ref().filter(|_| args.only.is_empty()) {
        let folder = super::temporary_folder(args.folder.as_deref())?;
        let files = run_files::write_run_files(&lake, folder.path()).await?;
        let mut peer =
            DuckdbPeer::start(python, &PeerTables { files, threads: args.threads, ..PeerTables::default() })?;
        let times = time_queries(&session, Some(&mut peer), of_run_files, args.runs, report).await;
        report.note("Last: the same queries, and the lake as it is, beside DuckDB on copies of one file for each run.");
        let of_peer = geometric_mean(times.iter().filter_map(QueryTimes::ratio));
        let name = "the twelve queries, geometric mean of DuckDB's time on one file per run";
        report.figure(name, of_peer, "x").goal(FigureGoal::AtMost(0.3));
    }
    let joins: Vec<_> = times.extract_if(.., |t| t.query.kind == TIME_JOIN).collect();
    if !joins.is_empty() {
        report.group("Joins by time");
        report_ratios(TIME_JOIN, &joins, [1.5, 1.5], report);
        for times in &joins {
            report_times(format!("{}, {} rows", times.query.name, times.rows), times, &version, report);
        }
    }
    if !times.is_empty() {
        report.group("Generated queries");
        report.note(format!("Seed {}; columns and values are those of the lake.", args.seed));
        report_ratios("generated queries", &times, [0.65, 1.3], report);
        let mut kinds = BTreeMap::<_, Vec<_>>::new();
        for times in &times {
            kinds.entry(times.query.kind).or_default().push(times);
        }
        for (kind, times) in kinds {
            let own = geometric_mean(times.iter().map(|t| t.own));
            let mut name = format!("{kind}, geometric mean of {}", times.len());
            if let Some(slowest) = times.iter().filter_map(|t| t.ratio()).max_by(f64::total_cmp) {
                name += &format!("; the highest ratio is {slowest:.2}");
            }
            let figure = report.figure(name, own * 1e3, "ms");
            if !version.is_empty() {
                figure.beside(&version, geometric_mean(times.iter().filter_map(|t| t.peer)) * 1e3);
            }
        }
        times.sort_by(|a, b| b.ratio().unwrap_or(b.own).total_cmp(&a.ratio().unwrap_or(a.own)));
        for times in times.iter().take(SHOWN_SLOW) {
            report_times(format!("{}: `{}`", times.query.name, times.query.sql), times, &version, report);
        }
    }
    Ok(())
}

fn report_times(name: String, times: &QueryTimes, version: &str, report: &mut BenchReport) {
    let figure = report.figure(name, times.own * 1e3, "ms");
    if let Some(peer) = times.peer {
        figure.beside(version, peer * 1e3);
    }
    if times.query.name == "one_ir" {
        figure.goal(FigureGoal::AtMost(1.3));
    }
}

// The mean of the ratios and the highest, if there is a peer.
fn report_ratios(name: &str, times: &[QueryTimes], [mean, most]: [f64; 2], report: &mut BenchReport) {
    let of_peer = "of DuckDB's time";
    let slowest = times.iter().filter_map(|t| Some((t.ratio()?, t))).max_by(|a, b| a.0.total_cmp(&b.0));
    if let Some((ratio, slowest)) = slowest {
        let value = geometric_mean(times.iter().filter_map(QueryTimes::ratio));
        report.figure(format!("{name}, geometric mean {of_peer}"), value, "x").goal(FigureGoal::AtMost(mean));
        let title = format!("{name}, slowest {of_peer} ({})", slowest.query.name);
        report.figure(title, ratio, "x").goal(FigureGoal::AtMost(most));
        let planned = geometric_mean(times.iter().filter_map(|t| Some(t.planned / t.peer?)));
        report.figure(
            format!("{name}, each time as a new text, whose plan is not known: mean {of_peer}"),
            planned,
            "x",
        );
    }
}

fn geometric_mean(values: impl Iterator<Item = f64>) -> f64 {
    let logs: Vec<_> = values.map(f64::ln).collect();
    (logs.iter().sum::<f64>() / logs.len() as f64).exp()
}

// Once. Files are in the system's cache, if the lake was just made.
async fn time_cold_query(
    args: &QueryBenchArgs,
    query: &BenchQuery,
    peer: Option<&mut DuckdbPeer>,
) -> Result<QueryTimes> {
    let start = Instant::now();
    let session = Session::new(&Lake::open(&args.lake).await?)?;
    let answer = collect_batches(&session, &query.sql).await?;
    let own = start.elapsed().as_secs_f64();
    let peer = peer.map(|peer| peer.time_query(&query.sql)).transpose()?;
    Ok(QueryTimes {
        query: query.clone(),
        own,
        planned: own,
        peer,
        rows: answer.iter().map(RecordBatch::num_rows).sum(),
    })
}

// The times of those queries that both engines answered; others are failures of the report.
async fn time_queries(
    session: &Session,
    mut peer: Option<&mut DuckdbPeer>,
    queries: Vec<BenchQuery>,
    runs: usize,
    report: &mut BenchReport,
) -> Vec<QueryTimes> {
    let mut times = Vec::new();
    for query in queries {
        let name = format!("{}: {}", query.name, query.sql);
        match compare_engines(session, peer.as_deref_mut(), query, runs, report).await {
            Ok(measured) => times.push(measured),
            Err(why) => report.fail(format!("{name}: {why:#}")),
        }
    }
    times
}

// One untimed run of each, whose answers are compared, then in turns.
async fn compare_engines(
    session: &Session,
    mut peer: Option<&mut DuckdbPeer>,
    query: BenchQuery,
    runs: usize,
    report: &mut BenchReport,
) -> Result<QueryTimes> {
    let peer_sql = query.peer.as_ref().unwrap_or(&query.sql);
    let answer = collect_batches(session, &query.sql).await?;
    if let Some(peer) = &mut peer
        && let Some(difference) = find_difference(&answer, &peer.ask_rows(peer_sql)?.map_err(anyhow::Error::msg)?)?
    {
        report.fail(format!("{}: answers differ, {difference}; {}", query.name, query.sql));
    }
    let rows = answer.iter().map(RecordBatch::num_rows).sum();
    drop(answer);
    let mut own = Vec::new();
    let mut planned = Vec::new();
    let mut other = Vec::new();
    for run in 0..runs {
        let new_text = format!("{} -- {run}", query.sql);
        let start = Instant::now();
        collect_batches(session, &new_text).await?;
        planned.push(start.elapsed().as_secs_f64());
        let start = Instant::now();
        collect_batches(session, &query.sql).await?;
        own.push(start.elapsed().as_secs_f64());
        if let Some(peer) = &mut peer {
            other.push(peer.time_query(peer_sql)?);
        }
    }
    let peer = (!other.is_empty()).then(|| median(other));
    Ok(QueryTimes { query, own: median(own), planned: median(planned), peer, rows })
}

async fn explain_query(session: &Session, query: &BenchQuery) -> Result<()> {
    collect_batches(session, &query.sql).await?;
    let batches = collect_batches(session, &format!("EXPLAIN ANALYZE {}", query.sql)).await?;
    let text = arrow::util::pretty::pretty_format_batches(&batches)?;
    writeln!(std::io::stdout(), "{}\n{}\n{text}", query.name, query.sql)?;
    Ok(())
}

pub(crate) fn median(mut seconds: Vec<f64>) -> f64 {
    seconds.sort_by(f64::total_cmp);
    seconds.get(seconds.len() / 2).copied().unwrap_or(f64::NAN)
}

pub(crate) async fn middle_surface(lake: &Lake) -> Result<String> {
    let snapshot = lake.snapshot().await?;
    let runs: Vec<_> = snapshot.runs().collect();
    Ok(runs.get(runs.len() / 2).context("the lake has no runs")?.surface.to_string())
}
