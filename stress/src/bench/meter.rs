//! CPU time, wall time and peak memory of this process, as Linux reports them.

use std::time::Instant;

use anyhow::{Context as _, Result};

/// Ticks of `/proc/self/stat` in a second, the same on all Linux systems.
const TICKS: f64 = 100.0;

/// Seconds that something took.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct MeasuredCost {
    /// CPU time of all threads, user and system.
    pub cpu: f64,
    pub wall: f64,
}

/// A clock that runs.
pub(crate) struct CostMeter {
    cpu: f64,
    wall: Instant,
}

impl MeasuredCost {
    pub const NONE: Self = Self { cpu: f64::INFINITY, wall: f64::INFINITY };

    pub fn plus(self, other: Self) -> Self {
        Self { cpu: self.cpu + other.cpu, wall: self.wall + other.wall }
    }

    /// The least of both, each by itself: what disturbs one need not disturb the other.
    pub fn least(self, other: Self) -> Self {
        Self { cpu: self.cpu.min(other.cpu), wall: self.wall.min(other.wall) }
    }
}

impl CostMeter {
    pub fn start() -> Result<Self> {
        Ok(Self { cpu: process_cpu()?, wall: Instant::now() })
    }

    pub fn stop(self) -> Result<MeasuredCost> {
        Ok(MeasuredCost { cpu: process_cpu()? - self.cpu, wall: self.wall.elapsed().as_secs_f64() })
    }
}

/// Resets the peak of memory, if the system allows it.
pub(crate) fn forget_peak() {
    // If it is refused, the peak is only higher than need be.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// The most memory that this process had at a time, MiB.
pub(crate) fn peak_mib() -> Result<f64> {
    let status = std::fs::read_to_string("/proc/self/status").context("no /proc/self/status")?;
    let kib = status.lines().find_map(|l| l.strip_prefix("VmHWM:")).context("no VmHWM")?;
    Ok(kib.trim().trim_end_matches("kB").trim().parse::<f64>()? / 1024.0)
}

// To ten milliseconds: what is measured should take seconds.
fn process_cpu() -> Result<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").context("no /proc/self/stat")?;
    // The second field is the program's name, which may have blanks; utime and stime are the 14th and 15th.
    let (_, behind) = stat.rsplit_once(')').context("/proc/self/stat has no name")?;
    let ticks: Vec<f64> = behind.split_whitespace().skip(11).take(2).map(str::parse).collect::<Result<_, _>>()?;
    Ok(ticks.iter().sum::<f64>() / TICKS)
}
