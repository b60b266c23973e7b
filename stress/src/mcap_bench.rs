//! Scans topics of runs with `mcap()` and with Python's `mcap`, side by side, and prints the bytes of each topic.
//!
//! The Python of `--python` needs the packages `mcap` and `mcap-protobuf-support`.

use std::io::Write as _;
use std::process::Command;
use std::time::Instant;

use anyhow::{Context as _, Result, bail};
use echolake_lake::Lake;
use echolake_query::Session;

/// Topics from the smallest to the largest.
const TOPICS: [&str; 5] = ["/environment", "/measurement", "/ir", "/sweep/audio", "/sweep"];
/// Each is scanned this many times; the median counts.
const ROUNDS: usize = 5;
/// Decodes every message of a topic in some files, and prints messages and seconds.
const SCRIPT: &str = r"
import sys, time
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
topic, files, seconds = sys.argv[1], sys.argv[2:], []
for _ in range(3):
    start, count = time.perf_counter(), 0
    for name in files:
        with open(name, 'rb') as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            for message in reader.iter_decoded_messages(topics=[topic]):
                count += 1
    seconds.append(time.perf_counter() - start)
print(count, sorted(seconds)[1])
";

#[derive(Debug, clap::Args)]
pub(crate) struct McapBenchArgs {
    /// A lake of runs.
    lake: String,
    /// Surfaces or runs, with `*` and `?`.
    pattern: String,
    /// A Python that has mcap and mcap-protobuf-support; without one, `mcap()` alone is measured.
    #[arg(long, value_name = "PATH")]
    python: Option<String>,
}

pub(crate) async fn run_mcap_bench(args: &McapBenchArgs) -> Result<()> {
    let McapBenchArgs { lake, pattern, python } = args;
    let lake = Lake::open(lake).await?;
    let session = Session::new(&lake)?;
    let (files, bytes) = find_files(&session, &lake, pattern).await?;
    let mut out = std::io::stdout();
    writeln!(out, "{} files, {bytes} bytes", files.len())?;
    writeln!(out, "| topic | messages | bytes read | MB/s | mcap() ms | Python ms | ratio |")?;
    writeln!(out, "| --- | --- | --- | --- | --- | --- | --- |")?;
    for topic in TOPICS {
        let sql = format!("select * from mcap('{pattern}', '{topic}')");
        let Ok((_, rows)) = time_scan(&session, &sql).await else { continue };
        let mut seconds = Vec::new();
        for _ in 0..ROUNDS {
            seconds.push(time_scan(&session, &sql).await?.0);
        }
        seconds.sort_by(f64::total_cmp);
        let ours = seconds[ROUNDS / 2];
        let read = bytes_read(&session, &sql).await?;
        let theirs = python.as_deref().map(|python| time_peer(python, topic, &files, rows)).transpose()?;
        let compared = theirs.map_or_else(|| "- | -".to_owned(), |t| format!("{:.0} | {:.1}", t * 1e3, t / ours));
        let speed = read as f64 / ours / 1e6;
        writeln!(out, "| `{topic}` | {rows} | {read} | {speed:.0} | {:.2} | {compared} |", ours * 1e3)?;
    }
    Ok(())
}

/// Seconds of one scan, from the query's text to its last row, and its rows.
async fn time_scan(session: &Session, sql: &str) -> Result<(f64, usize)> {
    let start = Instant::now();
    let mut answer = session.query(sql).await?;
    let mut rows = 0;
    while let Some(batch) = answer.next().await? {
        rows += batch.num_rows();
    }
    Ok((start.elapsed().as_secs_f64(), rows))
}

async fn query_text(session: &Session, sql: &str) -> Result<String> {
    let mut answer = session.query(sql).await?;
    let mut batches = Vec::new();
    while let Some(batch) = answer.next().await? {
        batches.push(batch);
    }
    Ok(arrow::util::pretty::pretty_format_batches(&batches)?.to_string())
}

/// The plan's own sum of what all partitions fetched.
async fn bytes_read(session: &Session, sql: &str) -> Result<u64> {
    let plan = query_text(session, &format!("explain {sql}")).await?;
    let (_, behind) = plan.split_once("bytes=").context("the plan tells no bytes")?;
    Ok(behind.chars().take_while(char::is_ascii_digit).collect::<String>().parse()?)
}

async fn find_files(session: &Session, lake: &Lake, pattern: &str) -> Result<(Vec<String>, u64)> {
    let folder = lake.folder().context("the lake is no folder")?;
    let sql = format!("select distinct file from mcap_topics('{pattern}') order by 1");
    let printed = query_text(session, &sql).await?;
    let names = printed.lines().filter_map(|l| l.strip_prefix('|')).map(|l| l.trim_matches(['|', ' ']));
    let files: Vec<_> = names.filter(|n| n.ends_with(".mcap")).map(|n| folder.join(n)).collect();
    let mut bytes = 0;
    for file in &files {
        bytes += std::fs::metadata(file)?.len();
    }
    Ok((files.iter().map(|f| f.display().to_string()).collect(), bytes))
}

/// Seconds that Python takes for the same messages.
fn time_peer(python: &str, topic: &str, files: &[String], rows: usize) -> Result<f64> {
    let done = Command::new(python).args(["-c", SCRIPT, topic]).args(files).output()?;
    if !done.status.success() {
        bail!("{}", String::from_utf8_lossy(&done.stderr));
    }
    let printed = String::from_utf8(done.stdout)?;
    let (count, seconds) = printed.trim().split_once(' ').context("Python printed something else")?;
    if count.parse::<usize>()? != rows {
        bail!("Python sees {count} messages, mcap() {rows}");
    }
    Ok(seconds.parse()?)
}
