//! Limits of the machine: copies of memory, and decompression of the chunks of run files.

use std::hint::black_box;
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use mcap::Summary;

use super::report::BenchReport;
use super::run_on_cores;

/// Larger than caches.
const COPIED_BYTES: usize = 256 << 20;
/// Each limit is measured for about this long.
const MEASURED_TIME: Duration = Duration::from_secs(2);

/// MB/s of decompression.
pub(crate) struct DecompressionSpeed {
    /// Of compressed bytes.
    pub packed: f64,
    /// Of the bytes that they become.
    pub plain: f64,
}

/// Measures the limits beside which other figures stand.
pub(crate) fn measure_limits(run_file: PathBuf, report: &mut BenchReport) -> Result<()> {
    report.group("Limits of the machine");
    report.figure("memory copied, all cores", copy_speed()?, "MB/s");
    let zstd = decompression_speed(&[run_file], None)?;
    report.figure("zstd of the chunks of a run file, all cores: bytes in the file", zstd.packed, "MB/s");
    report.figure("zstd of the chunks of a run file, all cores: bytes decompressed", zstd.plain, "MB/s");
    Ok(())
}

// MB/s that all cores copy together.
fn copy_speed() -> Result<f64> {
    let speeds = run_on_cores(|| {
        let source = vec![1u8; COPIED_BYTES];
        let mut target = vec![0u8; COPIED_BYTES];
        let begun = Instant::now();
        let mut copies = 0;
        while begun.elapsed() < MEASURED_TIME {
            black_box(&mut target).copy_from_slice(black_box(&source));
            copies += 1;
        }
        Ok((copies * COPIED_BYTES) as f64 / begun.elapsed().as_secs_f64() / 1e6)
    })?;
    Ok(speeds.iter().sum())
}

/// Decompresses the chunks that have messages of a topic, or all chunks, on all cores.
///
/// # Errors
/// A file has no summary, or its chunks are not compressed by zstd.
pub(crate) fn decompression_speed(files: &[PathBuf], topic: Option<&str>) -> Result<DecompressionSpeed> {
    let mut contents = Vec::new();
    for file in files {
        let bytes = std::fs::read(file)?;
        let summary = Summary::read(&bytes)?.with_context(|| format!("`{}` has no summary", file.display()))?;
        contents.push((bytes, summary));
    }
    let mut chunks = Vec::new();
    for (bytes, summary) in &contents {
        let wanted = topic.map(|topic| summary.channels.values().find(|c| c.topic == topic).map(|c| c.id));
        for chunk in &summary.chunk_indexes {
            let is_wanted = match wanted {
                None => true,
                Some(id) => id.is_some_and(|id| chunk.message_index_offsets.contains_key(&id)),
            };
            if is_wanted {
                ensure!(chunk.compression == "zstd", "chunks are compressed by `{}`", chunk.compression);
                // The compressed records are the last field of a chunk.
                let end = (chunk.chunk_start_offset + chunk.chunk_length) as usize;
                chunks.push((&bytes[end - chunk.compressed_size as usize..end], chunk.uncompressed_size as usize));
            }
        }
    }
    ensure!(!chunks.is_empty(), "no chunks");
    let next = AtomicUsize::new(0);
    let begun = Instant::now();
    let done = run_on_cores(|| {
        let mut decompressor = zstd::bulk::Decompressor::new()?;
        let mut plain = Vec::new();
        let mut bytes = [0, 0];
        while begun.elapsed() < MEASURED_TIME {
            let (packed, size) = chunks[next.fetch_add(1, Ordering::Relaxed) % chunks.len()];
            plain.clear();
            plain.reserve(size);
            bytes[0] += packed.len();
            bytes[1] += decompressor.decompress_to_buffer(packed, &mut plain)?;
        }
        Ok(bytes)
    })?;
    let seconds = begun.elapsed().as_secs_f64();
    let speed = |place: usize| done.iter().map(|bytes| bytes[place]).sum::<usize>() as f64 / seconds / 1e6;
    Ok(DecompressionSpeed { packed: speed(0), plain: speed(1) })
}
