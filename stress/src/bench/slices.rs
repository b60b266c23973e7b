//! Slices of a run from a server: bytes and times for parts of it, and for many readers at once.
//!
//! Bytes are those on the wire, the first byte is the first of the body.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Result, anyhow, bail};

use super::memory::resident_mib;
use super::report::BenchReport;
use crate::percentile::millis;

/// Topics with the poses of microphone and speaker, and the frames.
const POSES: &str = "&topics=/microphone/pose,/speaker/pose,/tf";

#[derive(Debug, Clone, clap::Args)]
pub(crate) struct SlicesArgs {
    /// Address of the served catalogue, as 127.0.0.1:8080.
    address: String,
    /// The run that is sliced.
    run: String,
    /// Its pairs, from 0 on.
    #[arg(long, value_name = "N", default_value_t = 2951)]
    pairs: u64,
    /// Readers at once.
    #[arg(long, value_name = "N", default_value_t = 100)]
    readers: u64,
    /// The server's process, whose memory is watched then.
    #[arg(long)]
    pid: Option<u32>,
}

/// Bytes and times of reading a slice.
struct SliceTimes {
    bytes: u64,
    first: Duration,
    all: Duration,
}

/// Reads a slice to its end; it is an error if the end does not come.
fn read_slice(address: &str, path: &str) -> Result<SliceTimes> {
    let begun = Instant::now();
    let mut stream = TcpStream::connect(address)?;
    stream.write_all(format!("GET {path} HTTP/1.1\r\nhost: {address}\r\nconnection: close\r\n\r\n").as_bytes())?;
    let mut head = Vec::new();
    let mut first = None;
    let mut bytes = 0;
    let mut block = vec![0; 64 << 10];
    let mut end = Vec::new();
    loop {
        let count = stream.read(&mut block)?;
        if count == 0 {
            break;
        }
        end.extend_from_slice(&block[..count]);
        end.drain(..end.len().saturating_sub(7));
        if first.is_some() {
            bytes += count as u64;
            continue;
        }
        head.extend_from_slice(&block[..count]);
        if let Some(at) = head.windows(4).position(|w| w == b"\r\n\r\n").filter(|at| head.len() > at + 4) {
            first = Some(begun.elapsed());
            bytes = (head.len() - at - 4) as u64;
        }
    }
    if !head.starts_with(b"HTTP/1.1 200") {
        bail!("{}", String::from_utf8_lossy(&head));
    }
    if !end.ends_with(b"\r\n0\r\n\r\n") {
        bail!("{path} broke off after {bytes} bytes");
    }
    Ok(SliceTimes { bytes, first: first.unwrap_or_default(), all: begun.elapsed() })
}

fn slice_path(run: &str, pairs: std::ops::Range<u64>, more: &str) -> String {
    format!("/api/v1/slices.mcap?run={run}&where=pair_id%20between%20{}%20and%20{}{more}", pairs.start, pairs.end - 1)
}

pub(crate) fn measure_slices(args: &SlicesArgs, report: &mut BenchReport) -> Result<()> {
    let args = Arc::new(args.clone());
    report.group("Slices of a served run");
    for (name, share, more) in [
        ("1 %", 100, ""),
        ("10 %", 10, ""),
        ("100 %", 1, ""),
        ("poses of 1 %", 100, POSES),
        ("poses of 100 %", 1, POSES),
    ] {
        let path = slice_path(&args.run, 0..(args.pairs / share).max(1), more);
        let mut tries = (0..5).map(|_| read_slice(&args.address, &path)).collect::<Result<Vec<_>>>()?;
        tries.sort_by_key(|took| took.first);
        let median = &tries[2];
        let slowest = &tries[4];
        report.figure(format!("{name}: size"), median.bytes as f64, "B");
        report.figure(format!("{name}: first byte"), millis(median.first), "ms");
        report.figure(format!("{name}: first byte, slowest of five"), millis(slowest.first), "ms");
        report.figure(format!("{name}: last byte"), millis(median.all), "ms");
    }
    let before = args.pid.and_then(resident_mib).unwrap_or(0);
    let done = Arc::new(AtomicBool::new(false));
    let begun = Instant::now();
    let reader = |number: u64| {
        let args = args.clone();
        std::thread::spawn(move || {
            // Each another tenth of the run, so that none is like another.
            let from = number * 7 % (args.pairs * 9 / 10).max(1);
            read_slice(&args.address, &slice_path(&args.run, from..from + (args.pairs / 10).max(1), ""))
        })
    };
    let readers: Vec<_> = (0..args.readers).map(reader).collect();
    let watch = {
        let args = args.clone();
        let done = done.clone();
        std::thread::spawn(move || {
            let mut heaviest = 0;
            while !done.load(Ordering::Relaxed) {
                heaviest = heaviest.max(args.pid.and_then(resident_mib).unwrap_or(0));
                std::thread::sleep(Duration::from_millis(50));
            }
            heaviest
        })
    };
    let mut all = Vec::new();
    for reader in readers {
        all.push(reader.join().map_err(|_| anyhow!("a reader panicked"))??);
    }
    let took = begun.elapsed();
    done.store(true, Ordering::Relaxed);
    let heaviest = watch.join().map_err(|_| anyhow!("the watch panicked"))?;
    all.sort_by_key(|took| took.first);
    let bytes: u64 = all.iter().map(|took| took.bytes).sum();
    report.group(format!("{} readers of slices of 10 % each", args.readers));
    report.figure("bytes", bytes as f64, "B");
    report.figure("all of them", took.as_secs_f64(), "s");
    report.figure("first byte, median", millis(all[all.len() / 2].first), "ms");
    report.figure("first byte, last reader", millis(all[all.len() - 1].first), "ms");
    if heaviest > 0 {
        report.figure("the server's memory before", before as f64, "MiB");
        report.figure("the server's memory, at most", heaviest as f64, "MiB");
    }
    Ok(())
}
