//! Scans of topics of runs with `mcap()`, beside Python's `mcap` and beside the decompression of the same chunks.
//!
//! The Python of `--python` needs the packages `mcap` and `mcap-protobuf-support`.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use anyhow::{Context as _, Result, bail, ensure};
use echolake_lake::Lake;
use echolake_query::Session;

use super::limits::decompression_speed;
use super::report::{BenchReport, FigureGoal};

/// Topics from the smallest to the largest.
const TOPICS: [&str; 5] = ["/environment", "/measurement", "/ir", "/sweep/audio", "/sweep"];
/// Those with a goal, and the share of the decompression's speed that it is.
const GOAL_TOPICS: [&str; 3] = ["/environment", "/ir", "/sweep"];
const GOAL_SHARE: f64 = 0.5;
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
    pub lake: String,
    /// Surfaces or runs, with `*` and `?`.
    pub pattern: String,
    /// A Python that has mcap and mcap-protobuf-support; without them, `mcap()` alone is measured.
    #[arg(long, value_name = "PATH")]
    pub python: Option<PathBuf>,
}

pub(crate) async fn measure_mcap(args: &McapBenchArgs, report: &mut BenchReport) -> Result<()> {
    let McapBenchArgs { lake, pattern, python } = args;
    let lake = Lake::open(lake).await?;
    let session = Session::new(&lake)?;
    let files = find_files(&session, &lake, pattern).await?;
    report.group("Topics of run files by `mcap()`");
    report.note(
        "The median of five scans. Speeds are of bytes in the file, beside the decompression of the same chunks.",
    );
    let python = python.as_deref().filter(|python| match find_peer(python) {
        Ok(()) => true,
        Err(why) => {
            report.note(format!("Python's mcap was skipped: {why:#}."));
            false
        }
    });
    for topic in TOPICS {
        let sql = format!("select * from mcap('{pattern}', '{topic}')");
        let Ok((_, rows)) = time_scan(&session, &sql).await else { continue };
        let mut seconds = Vec::new();
        for _ in 0..ROUNDS {
            seconds.push(time_scan(&session, &sql).await?.0);
        }
        seconds.sort_by(f64::total_cmp);
        let own = seconds[ROUNDS / 2];
        let peer = python.map(|python| time_peer(python, topic, &files, rows)).transpose()?;
        let figure = report.figure(format!("`{topic}`, {rows} messages"), own * 1e3, "ms");
        if let Some(peer) = peer {
            figure.beside("Python's mcap", peer * 1e3);
        }
        let limit = decompression_speed(&files, Some(topic))?.packed;
        let speed = bytes_read(&session, &sql).await? as f64 / own / 1e6;
        let figure = report.figure(format!("`{topic}`, bytes of the file"), speed, "MB/s");
        figure.beside("zstd, all cores", limit);
        if GOAL_TOPICS.contains(&topic) {
            figure.goal(FigureGoal::AtLeast(GOAL_SHARE * limit));
        }
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

async fn find_files(session: &Session, lake: &Lake, pattern: &str) -> Result<Vec<PathBuf>> {
    let folder = lake.folder().context("the lake is no folder")?;
    let sql = format!("select distinct file from mcap_topics('{pattern}') order by 1");
    let printed = query_text(session, &sql).await?;
    let names = printed.lines().filter_map(|l| l.strip_prefix('|')).map(|l| l.trim_matches(['|', ' ']));
    Ok(names.filter(|name| name.ends_with(".mcap")).map(|name| folder.join(name)).collect())
}

// Whether a Python has what is measured.
fn find_peer(python: &Path) -> Result<()> {
    let found = Command::new(python).args(["-c", "import mcap, mcap_protobuf"]).output();
    let found = found.with_context(|| format!("cannot run `{}`", python.display()))?;
    ensure!(found.status.success(), "`{}` has no mcap or no mcap-protobuf-support", python.display());
    Ok(())
}

/// Seconds that Python takes for the same messages.
fn time_peer(python: &Path, topic: &str, files: &[PathBuf], rows: usize) -> Result<f64> {
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
