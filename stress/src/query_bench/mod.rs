//! Twelve queries of the lake's readers, beside DuckDB on the same Parquet files in the same run: warm, median.
//!
//! The Python of `--python` has the packages duckdb and pyarrow. The engines take turns, so that other programs disturb
//! both alike. Ends with an error if the answers differ.

mod digest;
mod peer;
mod queries;

use std::io::Write as _;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context as _, Result};
use arrow::record_batch::RecordBatch;
use digest::RowsDigest;
use echolake_lake::Lake;
use echolake_query::Session;
use echolake_schema::tables::Table;
use peer::DuckdbPeer;
use queries::BenchQuery;

#[derive(Debug, clap::Args)]
pub(crate) struct QueryBenchArgs {
    /// A lake, as `echolake demo --surfaces 350 --ir-only` makes one.
    #[arg(long, value_name = "FOLDER")]
    lake: String,
    /// A Python that has duckdb and pyarrow; without one, echolake alone is measured.
    #[arg(long, value_name = "PATH")]
    python: Option<PathBuf>,
    /// Timed runs of each query, of which the median counts.
    #[arg(long, value_name = "N", default_value_t = 5)]
    runs: usize,
    /// Threads of the peer.
    #[arg(long, value_name = "N", default_value_t = 2)]
    threads: usize,
    /// Queries whose name has this in it.
    #[arg(long, value_name = "TEXT", default_value = "")]
    only: String,
    /// Shows plans with their metrics instead.
    #[arg(long)]
    explain: bool,
}

/// A query's times, s.
struct QueryTimes {
    name: &'static str,
    own: f64,
    peer: Option<f64>,
    rows: u64,
}

pub(crate) async fn run_query_bench(args: &QueryBenchArgs) -> Result<()> {
    let lake = Lake::open(&args.lake).await?;
    let session = Session::new(&lake)?;
    let mut peer = match &args.python {
        Some(python) => Some(DuckdbPeer::start(python, &visible_files(&lake).await?, args.threads)?),
        None => None,
    };
    let surface = middle_surface(&lake).await?;
    let mut rows = Vec::new();
    for query in queries::bench_queries(&surface, 1234).into_iter().filter(|q| q.name.contains(&args.only)) {
        if args.explain {
            explain_query(&session, &query).await?;
        } else {
            rows.push(compare_engines(&session, peer.as_mut(), &query, args.runs).await?);
        }
    }
    if !args.explain {
        print_report(&rows, peer.as_ref().map(|p| p.version.as_str()))?;
    }
    Ok(())
}

// One untimed run of each, then in turns.
async fn compare_engines(
    session: &Session,
    mut peer: Option<&mut DuckdbPeer>,
    query: &BenchQuery,
    runs: usize,
) -> Result<QueryTimes> {
    let mut own = Vec::new();
    let mut other = Vec::new();
    let mut rows = 0;
    for run in 0..=runs {
        let (seconds, digest) = time_query(session, query).await?;
        rows = digest.rows;
        own.extend((run > 0).then_some(seconds));
        if let Some(peer) = &mut peer {
            let (seconds, theirs) = peer.query(query.peer.as_ref().unwrap_or(&query.sql))?;
            other.extend((run > 0).then_some(seconds));
            anyhow::ensure!(digest.agrees(&theirs), "{}: answers differ, {digest:?} and {theirs:?}", query.name);
        }
    }
    Ok(QueryTimes { name: query.name, own: median(own), peer: (!other.is_empty()).then(|| median(other)), rows })
}

async fn time_query(session: &Session, query: &BenchQuery) -> Result<(f64, RowsDigest)> {
    let start = Instant::now();
    let batches = collect_batches(session, &query.sql).await.with_context(|| query.name)?;
    let seconds = start.elapsed().as_secs_f64();
    Ok((seconds, RowsDigest::of(&batches)?))
}

async fn collect_batches(session: &Session, sql: &str) -> Result<Vec<RecordBatch>> {
    let mut answer = session.query(sql).await?;
    let mut batches = Vec::new();
    while let Some(batch) = answer.next().await? {
        batches.push(batch);
    }
    Ok(batches)
}

async fn explain_query(session: &Session, query: &BenchQuery) -> Result<()> {
    collect_batches(session, &query.sql).await?;
    let batches = collect_batches(session, &format!("EXPLAIN ANALYZE {}", query.sql)).await?;
    let text = arrow::util::pretty::pretty_format_batches(&batches)?;
    writeln!(std::io::stdout(), "{}\n{text}", query.name)?;
    Ok(())
}

fn median(mut seconds: Vec<f64>) -> f64 {
    seconds.sort_by(f64::total_cmp);
    seconds.get(seconds.len() / 2).copied().unwrap_or(f64::NAN)
}

// Just what readers see, so that both engines read the same rows.
async fn visible_files(lake: &Lake) -> Result<Vec<(String, Vec<String>)>> {
    let folder = lake.folder().context("the peer reads lakes in folders")?;
    let snapshot = lake.snapshot().await?;
    let mut tables = Vec::new();
    for table in Table::ALL {
        let files = snapshot.files(table).iter();
        anyhow::ensure!(files.clone().all(|f| f.hidden.is_empty()), "the lake is being cleaned up; run this again");
        let paths = files.map(|f| folder.join(f.path.as_ref()).display().to_string());
        tables.push((table.name().to_owned(), paths.collect()));
    }
    Ok(tables)
}

async fn middle_surface(lake: &Lake) -> Result<String> {
    let snapshot = lake.snapshot().await?;
    let runs: Vec<_> = snapshot.runs().collect();
    Ok(runs.get(runs.len() / 2).context("the lake has no runs")?.surface.to_string())
}

fn print_report(rows: &[QueryTimes], version: Option<&str>) -> Result<()> {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{:<20} {:>9} {:>12} {:>12} {:>7}", "query", "rows", "echolake ms", "duckdb ms", "ratio")?;
    let mut logs = Vec::new();
    for row in rows {
        let (peer, ratio) = match row.peer {
            Some(peer) => (format!("{:.2}", peer * 1e3), format!("{:.2}", row.own / peer)),
            None => ("-".to_owned(), "-".to_owned()),
        };
        logs.extend(row.peer.map(|peer| (row.own / peer).ln()));
        writeln!(out, "{:<20} {:>9} {:>12.2} {peer:>12} {ratio:>7}", row.name, row.rows, row.own * 1e3)?;
    }
    if let Some(version) = version {
        let mean = (logs.iter().sum::<f64>() / logs.len().max(1) as f64).exp();
        writeln!(out, "geometric mean of echolake / DuckDB {version}: {mean:.2}")?;
    }
    Ok(())
}
