//! Many readers of a served catalogue at once: errors, times, and the server's memory.
//!
//! Nothing of it comes out of a browser's cache; what the server keeps, it keeps.
#![allow(clippy::print_stdout, reason = "its figures are what it is for")]

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, anyhow};
use serde_json::Value;

use super::memory::resident_mib;

/// Kind of requests that a reader sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum QuestionKind {
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
    address: String,
    /// Readers at once.
    #[arg(long, value_name = "N", default_value_t = 200)]
    readers: u64,
    /// Duration of reading, in seconds.
    #[arg(long, value_name = "SECS", default_value_t = 60)]
    seconds: u64,
    /// Kind of requests that they send.
    #[arg(long = "ask", value_name = "KIND", value_enum, default_value_t = QuestionKind::All)]
    kind: QuestionKind,
    /// The server's process, whose memory is watched then.
    #[arg(long)]
    pid: Option<u32>,
}

/// A connection that is kept open.
struct CatalogueConnection {
    address: String,
    stream: BufReader<TcpStream>,
}

impl CatalogueConnection {
    fn open(address: &str) -> Result<Self> {
        let stream = TcpStream::connect(address)?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(Duration::from_secs(60)))?;
        Ok(Self { address: address.to_owned(), stream: BufReader::new(stream) })
    }

    /// Asks; returns status and body.
    fn get(&mut self, path: &str) -> Result<(u16, Vec<u8>)> {
        let head = format!("GET {path} HTTP/1.1\r\nhost: {}\r\naccept: application/json, */*\r\n\r\n", self.address);
        self.stream.get_mut().write_all(head.as_bytes())?;
        let (mut status, mut length) = (0, None);
        for line in (&mut self.stream).lines() {
            let line = line?;
            if line.is_empty() {
                break;
            }
            if let Some(rest) = line.strip_prefix("HTTP/1.1 ") {
                status = rest.split(' ').next().unwrap_or_default().parse()?;
            }
            if let Some((name, value)) = line.split_once(": ")
                && name.eq_ignore_ascii_case("content-length")
            {
                length = Some(value.parse::<usize>()?);
            }
        }
        let mut body = vec![0; length.context("an answer without a length")?];
        self.stream.read_exact(&mut body)?;
        Ok((status, body))
    }
}

/// Surfaces, facets, runs and pairs that requests name.
struct CatalogueContents {
    surfaces: Vec<String>,
    facets: Vec<(String, String)>,
    runs: Vec<String>,
    pairs: u64,
}

impl CatalogueContents {
    fn read(address: &str) -> Result<Self> {
        let mut connection = CatalogueConnection::open(address)?;
        let mut json = |path: &str| -> Result<Value> { Ok(serde_json::from_slice(&connection.get(path)?.1)?) };
        let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
        let page = json("/api/v1/surfaces?limit=500")?;
        let list = |value: &Value| value.as_array().cloned().unwrap_or_default();
        let mut facets = Vec::new();
        for facet in list(&page["facets"]) {
            facets.extend(list(&facet["values"]).iter().map(|v| (text(&facet["name"]), encoded(&text(&v["value"])))));
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

    fn path(&self, kind: QuestionKind, chance: &mut RequestRandom) -> String {
        let surface = &self.surfaces[chance.below(self.surfaces.len() as u64) as usize];
        let pair = chance.below(self.pairs);
        match (kind, chance.below(10)) {
            (QuestionKind::Facets, _) => {
                let (name, value) = &self.facets[chance.below(self.facets.len() as u64) as usize];
                // A different offset makes an address that was not requested before.
                format!("/api/v1/surfaces?{name}={value}&sort=level&offset={}", chance.below(100_000))
            }
            (QuestionKind::Ir, _) => format!("/api/v1/surfaces/{surface}/pairs/{pair}/ir.wav?signal=measured"),
            (QuestionKind::All, 0) => "/".to_owned(),
            (QuestionKind::All, 1) => "/api/v1/surfaces".to_owned(),
            (QuestionKind::All, 2) => format!("/api/v1/surfaces/{surface}"),
            (QuestionKind::All, 3) => format!("/api/v1/surfaces/{surface}/grid?microphone={}", chance.below(10)),
            (QuestionKind::All, 4) => format!("/api/v1/surfaces/{surface}/curves?microphone={}", chance.below(10)),
            (QuestionKind::All, 5 | 6) => format!("/api/v1/surfaces/{surface}/thumbnail.png"),
            (QuestionKind::All, 7) => format!("/api/v1/surfaces/{surface}/pairs/{pair}"),
            (QuestionKind::All, 8) => {
                format!("/api/v1/runs/{}", self.runs[chance.below(self.runs.len() as u64) as usize])
            }
            (QuestionKind::All, _) => "/api/v1/map".to_owned(),
        }
    }
}

fn encoded(text: &str) -> String {
    text.bytes()
        .map(|b| if b.is_ascii_alphanumeric() { (b as char).to_string() } else { format!("%{b:02x}") })
        .collect()
}

/// Numbers that are the same each time (Marsaglia 2003, xorshift).
struct RequestRandom(u64);

impl RequestRandom {
    fn below(&mut self, bound: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % bound.max(1)
    }
}

pub(crate) fn run(args: &ReadersArgs) -> Result<()> {
    let args = Arc::new(args.clone());
    let lake = Arc::new(CatalogueContents::read(&args.address)?);
    let (times, errors) = (Arc::new(Mutex::new(Vec::new())), Arc::new(AtomicU64::new(0)));
    let end = Instant::now() + Duration::from_secs(args.seconds);
    let reader = |number: u64| {
        let (args, lake, times, errors) = (args.clone(), lake.clone(), times.clone(), errors.clone());
        std::thread::spawn(move || {
            let mut chance = RequestRandom(number.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1);
            (0..10).for_each(|_| {
                let _ = chance.below(1);
            });
            let mut own = Vec::new();
            let mut connection = None;
            while Instant::now() < end {
                let path = lake.path(args.kind, &mut chance);
                let begun = Instant::now();
                let asked = match connection.take() {
                    Some(open) => Ok(open),
                    None => CatalogueConnection::open(&args.address),
                };
                match asked.and_then(|mut open| open.get(&path).map(|answer| (open, answer))) {
                    // Not every surface has every pair.
                    Ok((open, (200 | 404, _))) => {
                        own.push(begun.elapsed());
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
            times.lock().unwrap_or_else(PoisonError::into_inner).extend(own);
        })
    };
    let readers: Vec<_> = (1..=args.readers).map(reader).collect();
    let mut heaviest = 0;
    while Instant::now() < end {
        heaviest = heaviest.max(args.pid.and_then(resident_mib).unwrap_or(0));
        std::thread::sleep(Duration::from_millis(200));
    }
    for reader in readers {
        reader.join().map_err(|_| anyhow!("a reader panicked"))?;
    }
    let mut times = times.lock().unwrap_or_else(PoisonError::into_inner);
    times.sort_unstable();
    let at = |share: f64| times.get((share * times.len() as f64) as usize).map_or(f64::NAN, |t| t.as_secs_f64() * 1e3);
    println!("{:?}: {} readers, {} s", args.kind, args.readers, args.seconds);
    println!("  answers {}, {:.0} a second", times.len(), times.len() as f64 / args.seconds as f64);
    println!("  errors {}", errors.load(Ordering::Relaxed));
    println!("  p50 {:.1} ms, p95 {:.1} ms, p99 {:.1} ms", at(0.5), at(0.95), at(0.99));
    if heaviest > 0 {
        println!("  the server's memory at most {heaviest} MiB");
    }
    Ok(())
}
