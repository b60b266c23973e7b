//! The processes of a server, as `/proc` lists them: the one that was started, and all below it.

use std::collections::BTreeSet;
use std::process::Command;
use std::time::{Duration, Instant};

use echolake_testing::run_command;

/// One clock tick of `/proc/PID/stat`; Linux reports a hundred per second to programs on every machine.
const CLOCK_TICK: Duration = Duration::from_millis(10);

/// A process and all below it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ProcessTree {
    root: u32,
}

/// A process at one moment.
#[derive(Debug, Clone)]
struct ProcessEntry {
    pid: u32,
    parent: u32,
    own_ticks: u64,
    /// Of children that have ended and were waited for.
    child_ticks: u64,
}

/// Memory at one moment, KiB.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct TreeMemory {
    /// Of the process that was started: it holds the connections.
    pub door_kib: u64,
    /// Of all processes.
    pub total_kib: u64,
}

impl ProcessTree {
    pub fn new(root: u32) -> Self {
        Self { root }
    }

    /// Returns the processor time of all of its processes since their start, those that ended included.
    pub fn processor_time(&self) -> Duration {
        let ticks = |p: &ProcessEntry| p.own_ticks + if p.pid == self.root { p.child_ticks } else { 0 };
        let total: u64 = self.processes().iter().map(ticks).sum();
        CLOCK_TICK * u32::try_from(total).unwrap_or(u32::MAX)
    }

    /// Returns the processor time that its processes take from now on for so long.
    pub fn processor_time_over(&self, time: Duration) -> Duration {
        let before = self.processor_time();
        std::thread::sleep(time);
        self.processor_time().saturating_sub(before)
    }

    /// Returns the time from `since` until the processes become idle; None if they are not at the limit.
    pub fn time_until_idle(&self, since: Instant, limit: Duration) -> Option<Duration> {
        const LOOK_EVERY: Duration = Duration::from_millis(20);
        // A tick in so many looks is what a server that waits takes.
        const IDLE_LOOKS: usize = 5;
        let mut looks = vec![(Instant::now(), self.processor_time())];
        while since.elapsed() < limit + LOOK_EVERY * 5 {
            std::thread::sleep(LOOK_EVERY);
            looks.push((Instant::now(), self.processor_time()));
            let Some((begun, before)) = looks.len().checked_sub(IDLE_LOOKS + 1).map(|first| looks[first]) else {
                continue;
            };
            if looks[looks.len() - 1].1.saturating_sub(before) <= CLOCK_TICK {
                return Some(begun.saturating_duration_since(since)).filter(|idle| *idle <= limit);
            }
        }
        None
    }

    /// Returns the memory of its processes. Pages of the program's file are in memory once, however many processes map
    /// them, so they are counted once.
    pub fn memory(&self) -> TreeMemory {
        let mut memory = TreeMemory::default();
        let mut most_mapped = 0;
        for process in self.processes() {
            let status = std::fs::read_to_string(format!("/proc/{}/status", process.pid)).unwrap_or_default();
            let own = status_kib(&status, "RssAnon:") + status_kib(&status, "RssShmem:");
            let mapped = status_kib(&status, "RssFile:");
            if process.pid == self.root {
                memory.door_kib = own + mapped;
            }
            memory.total_kib += own;
            most_mapped = most_mapped.max(mapped);
        }
        memory.total_kib += most_mapped;
        memory
    }

    /// Returns the processes below the one that was started: its engines.
    pub fn children(&self) -> Vec<u32> {
        self.processes().iter().map(|p| p.pid).filter(|pid| *pid != self.root).collect()
    }

    /// Kills all of its processes, the first one first, so that none is started again.
    pub fn kill(&self) {
        for process in self.processes() {
            kill_process(process.pid);
        }
    }

    // The root first, and each process behind its parent.
    fn processes(&self) -> Vec<ProcessEntry> {
        let all = all_processes();
        let mut known = BTreeSet::from([self.root]);
        let mut found: Vec<_> = all.iter().filter(|p| p.pid == self.root).cloned().collect();
        loop {
            let below = |p: &&ProcessEntry| known.contains(&p.parent) && !known.contains(&p.pid);
            let next: Vec<_> = all.iter().filter(below).cloned().collect();
            if next.is_empty() {
                return found;
            }
            known.extend(next.iter().map(|p| p.pid));
            found.extend(next);
        }
    }
}

/// Sends SIGKILL to one process.
pub(crate) fn kill_process(pid: u32) {
    // It may have ended already.
    let _ = run_command(Command::new("kill").args(["-KILL", &pid.to_string()]));
}

fn all_processes() -> Vec<ProcessEntry> {
    let Ok(entries) = std::fs::read_dir("/proc") else { return Vec::new() };
    let pids = entries.flatten().filter_map(|entry| entry.file_name().to_str()?.parse().ok());
    pids.filter_map(read_process).collect()
}

fn read_process(pid: u32) -> Option<ProcessEntry> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The command's name is in parentheses and may hold anything.
    let fields: Vec<_> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let number = |place: usize| fields.get(place).and_then(|field| field.parse::<u64>().ok());
    Some(ProcessEntry {
        pid,
        parent: u32::try_from(number(1)?).ok()?,
        own_ticks: number(11)? + number(12)?,
        child_ticks: number(13)? + number(14)?,
    })
}

fn status_kib(status: &str, field: &str) -> u64 {
    let line = status.lines().find_map(|line| line.strip_prefix(field)).unwrap_or_default();
    line.trim().trim_end_matches("kB").trim().parse().unwrap_or(0)
}
