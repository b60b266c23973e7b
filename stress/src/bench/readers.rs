//! Many readers of a served catalogue at once: errors, times, and the server's memory.
//!
//! Nothing of it comes out of a browser's cache; what the server keeps, it keeps.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Result, anyhow};
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;

use super::catalogue_client::CatalogueServer;
use super::memory::resident_mib;
use super::report::{BenchReport, FigureGoal};
use crate::observed_server::percent_encoded;
use crate::percentile::{millis, percentile};

/// Kind of requests that a reader sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum QuestionKind {
    /// All requests that pages send.
    All,
    /// A new combination of filters each time.
    Facets,
    /// A WAV of another pair each time.
    Ir,
}

#[derive(Debug, Clone, clap::Args)]
pub(crate) struct ReadersArgs {
    /// Address of the served catalogue, as 127.0.0.1:8080.
    pub address: String,
    /// Readers at once.
    #[arg(long, value_name = "N", default_value_t = 200)]
    pub readers: u64,
    /// Duration of reading, in seconds.
    #[arg(long, value_name = "SECS", default_value_t = 60)]
    pub seconds: u64,
    /// Kind of requests that they send.
    #[arg(long = "ask", value_name = "KIND", value_enum, default_value_t = QuestionKind::All)]
    pub kind: QuestionKind,
    /// The server's certificate; without it, nothing is encrypted.
    #[arg(long, value_name = "FILE")]
    pub certificate: Option<PathBuf>,
    /// A token, if the server wants one.
    #[arg(long)]
    pub token: Option<String>,
    /// The server's process, whose memory is watched then.
    #[arg(long)]
    pub pid: Option<u32>,
    /// Runs are ingested meanwhile.
    #[arg(skip)]
    pub is_ingesting: bool,
}

/// Surfaces, facets, runs and pairs that requests name.
struct CatalogueContents {
    surfaces: Vec<String>,
    facets: Vec<(String, String)>,
    runs: Vec<String>,
    pairs: u64,
}

impl CatalogueContents {
    /// Asks a server for them.
    ///
    /// # Errors
    /// The server does not answer.
    fn read(server: &CatalogueServer) -> Result<Self> {
        let mut connection = server.connect()?;
        let mut json = |path: &str| -> Result<Value> { Ok(serde_json::from_slice(&connection.get(path)?.1)?) };
        let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
        let page = json("/api/v1/surfaces?limit=500")?;
        let list = |value: &Value| value.as_array().cloned().unwrap_or_default();
        let mut facets = Vec::new();
        for facet in list(&page["facets"]) {
            facets.extend(
                list(&facet["values"]).iter().map(|v| (text(&facet["name"]), percent_encoded(&text(&v["value"])))),
            );
        }
        for histogram in list(&page["histograms"]) {
            let (name, prefix) = match text(&histogram["name"]).split_once(':') {
                Some((name, band)) => (name.to_owned(), format!("{band}:")),
                None => (text(&histogram["name"]), String::new()),
            };
            let bins = list(&histogram["bins"]);
            facets.extend(bins.iter().map(|bin| (name.clone(), format!("{prefix}{}..{}", bin["from"], bin["to"]))));
        }
        let runs = json("/api/v1/runs?limit=500")?;
        Ok(Self {
            surfaces: list(&page["items"]).iter().map(|s| text(&s["surface_id"])).collect(),
            facets,
            runs: list(&runs["items"]).iter().map(|r| text(&r["run_id"])).collect(),
            pairs: json("/api/v1/lake")?["counts"]["pairs"].as_u64().unwrap_or(1),
        })
    }

    // The kind of page data that is requested, and its path.
    fn path(&self, kind: QuestionKind, random: &mut ChaCha8Rng) -> (&'static str, String) {
        let surface = &self.surfaces[random.random_range(0..self.surfaces.len())];
        let pair = random.random_range(0..self.pairs.max(1));
        match (kind, random.random_range(0..10)) {
            (QuestionKind::Facets, _) => {
                let (name, value) = &self.facets[random.random_range(0..self.facets.len())];
                // A different offset makes an address that was not requested before.
                let offset = random.random_range(0..100_000);
                ("facets", format!("/api/v1/surfaces?{name}={value}&sort=level&offset={offset}"))
            }
            (QuestionKind::Ir, _) => ("wav", format!("/api/v1/surfaces/{surface}/pairs/{pair}/ir.wav?signal=measured")),
            (QuestionKind::All, 0) => ("page", "/".to_owned()),
            (QuestionKind::All, 1) => ("surfaces", "/api/v1/surfaces".to_owned()),
            (QuestionKind::All, 2) => ("surface", format!("/api/v1/surfaces/{surface}")),
            (QuestionKind::All, 3) => {
                ("grid", format!("/api/v1/surfaces/{surface}/grid?microphone={}", random.random_range(0..10)))
            }
            (QuestionKind::All, 4) => {
                ("curves", format!("/api/v1/surfaces/{surface}/curves?microphone={}", random.random_range(0..10)))
            }
            (QuestionKind::All, 5 | 6) => ("thumbnail", format!("/api/v1/surfaces/{surface}/thumbnail.png")),
            (QuestionKind::All, 7) => ("pair", format!("/api/v1/surfaces/{surface}/pairs/{pair}")),
            (QuestionKind::All, 8) => {
                ("run", format!("/api/v1/runs/{}", self.runs[random.random_range(0..self.runs.len())]))
            }
            (QuestionKind::All, _) => ("map", "/api/v1/map".to_owned()),
        }
    }
}

/// Readers that ask for a while.
#[derive(Clone)]
struct ReaderLoad {
    server: CatalogueServer,
    contents: Arc<CatalogueContents>,
    kind: QuestionKind,
    readers: u64,
    time: Duration,
}

/// Times of all answers, and the number of requests that failed.
struct ReaderTimes {
    /// By kind of page data.
    answers: BTreeMap<&'static str, Vec<Duration>>,
    errors: u64,
}

impl ReaderLoad {
    /// Lets the readers ask, and `watch` be called meanwhile.
    ///
    /// # Errors
    /// A reader panicked.
    fn measure(&self, mut watch: impl FnMut()) -> Result<ReaderTimes> {
        let errors = Arc::new(AtomicU64::new(0));
        let end = Instant::now() + self.time;
        let reader = |number| {
            let load = self.clone();
            let errors = errors.clone();
            std::thread::spawn(move || load.read(number, end, &errors))
        };
        let readers: Vec<_> = (1..=self.readers).map(reader).collect();
        while Instant::now() < end {
            watch();
            std::thread::sleep(Duration::from_millis(200));
        }
        let mut answers = BTreeMap::<_, Vec<_>>::new();
        for reader in readers {
            for (what, time) in reader.join().map_err(|_| anyhow!("a reader panicked"))? {
                answers.entry(what).or_default().push(time);
            }
        }
        Ok(ReaderTimes { answers, errors: errors.load(Ordering::Relaxed) })
    }

    fn read(&self, number: u64, end: Instant, errors: &AtomicU64) -> Vec<(&'static str, Duration)> {
        let mut random = ChaCha8Rng::seed_from_u64(number);
        let mut own = Vec::new();
        let mut connection = None;
        while Instant::now() < end {
            let (what, path) = self.contents.path(self.kind, &mut random);
            let begun = Instant::now();
            let asked = match connection.take() {
                Some(open) => Ok(open),
                None => self.server.connect(),
            };
            match asked.and_then(|mut open| open.get(&path).map(|answer| (open, answer))) {
                // Not every surface has every pair.
                Ok((open, (200 | 404, _))) => {
                    own.push((what, begun.elapsed()));
                    connection = Some(open);
                }
                Ok((_, (status, body))) => {
                    eprintln!("{path}: {status} {}", String::from_utf8_lossy(&body));
                    errors.fetch_add(1, Ordering::Relaxed);
                }
                Err(why) => {
                    eprintln!("{path}: {why}");
                    errors.fetch_add(1, Ordering::Relaxed);
                }
            }
        }
        own
    }
}

pub(crate) fn measure_readers(args: &ReadersArgs, report: &mut BenchReport) -> Result<()> {
    let mut server = CatalogueServer::new(&args.address);
    if let Some(token) = &args.token {
        server = server.with_token(token);
    }
    if let Some(certificate) = &args.certificate {
        server = server.with_certificate(certificate)?;
    }
    let contents = Arc::new(CatalogueContents::read(&server)?);
    let readers = args.readers;
    let time = Duration::from_secs(args.seconds);
    let mut heaviest = 0;
    let load = ReaderLoad { server, contents, kind: args.kind, readers, time };
    let times = load.measure(|| heaviest = heaviest.max(args.pid.and_then(resident_mib).unwrap_or(0)))?;
    let all: Vec<_> = times.answers.values().flatten().copied().collect();
    let load = match args.is_ingesting {
        true => format!("{readers} readers while runs are ingested"),
        false => format!("{readers} readers"),
    };
    report.group(format!("{load}, of the catalogue"));
    report.note(format!("For {} s, each asks again when it has its answer.", args.seconds));
    let rate = report.figure(format!("answers to {load}"), all.len() as f64 / args.seconds as f64, "/s");
    // The goals are for this load.
    let is_goal = readers == 200 && args.kind == QuestionKind::All;
    if is_goal && !args.is_ingesting {
        rate.goal(FigureGoal::AtLeast(3000.0));
    }
    report.figure("errors", times.errors as f64, "");
    for share in [50, 95, 99] {
        let time = millis(percentile(&all, f64::from(share) / 100.0));
        let figure = report.figure(format!("answers to {load}, p{share}"), time, "ms");
        if is_goal && share == 95 {
            figure.goal(FigureGoal::AtMost(if args.is_ingesting { 250.0 } else { 150.0 }));
        }
    }
    for (what, answers) in &times.answers {
        report.figure(format!("{what}, {} answers, p95", answers.len()), millis(percentile(answers, 0.95)), "ms");
    }
    if heaviest > 0 {
        report.figure("memory of the server's first process, at most", heaviest as f64, "MiB");
    }
    Ok(())
}
