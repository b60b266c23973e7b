//! Results of the attacks as a table, and the goals that they miss.
#![allow(clippy::print_stdout, reason = "figures are what it is for")]

use std::collections::BTreeMap;
use std::time::Duration;

use super::super::observed_server::{LightReport, MemoryPeak};
use super::super::percentile::{millis, percentile};

/// Longest times that other clients may measure.
const LIGHT_GOAL: Duration = Duration::from_millis(300);
const HEALTH_GOAL: Duration = Duration::from_millis(100);
/// Memory beyond the idle server's and the client's limit.
const MEMORY_GOAL_MIB: u64 = 200;
const DOOR_GOAL_MIB: u64 = 300;
/// Processor time of an idle server in a second.
const IDLE_GOAL: Duration = Duration::from_millis(50);

/// Fate of the server after an attack.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum ServerFate {
    Alive,
    /// It ended; these are its last words.
    Died(String),
    /// It was killed because it took too much memory.
    Capped,
    /// It was replaced because it did not become idle.
    Busy,
}

/// An attack over one protocol and what it did.
#[derive(Debug, Clone)]
pub(crate) struct AttackRow {
    pub name: &'static str,
    pub protocol: &'static str,
    /// Outcome of each of the attacker's connections.
    pub outcomes: Vec<String>,
    pub took: Duration,
    pub light: LightReport,
    /// Engines that ended by themselves meanwhile.
    pub engine_ends: usize,
    pub peak: MemoryPeak,
    /// Memory of all processes before.
    pub idle_mib: u64,
    /// Memory that the attacker's queries may hold.
    pub limit_mib: u64,
    /// Processor time in the second that begins half a second after the attack.
    pub idle_time: Duration,
    pub fate: ServerFate,
}

impl AttackRow {
    /// Returns the goals that it misses.
    pub fn missed_goals(&self) -> Vec<&'static str> {
        let goals = [
            ("the door lives", !matches!(self.fate, ServerFate::Died(_) | ServerFate::Capped)),
            ("pages and light queries are right", self.light.failures.is_empty()),
            // Two clients query, each at most one statement at a time.
            ("an error per engine that ended", self.light.retriable <= 2 * self.engine_ends),
            ("pages within 300 ms", longest_time(&self.light.pages) <= LIGHT_GOAL),
            ("/health within 100 ms", longest_time(&self.light.health) <= HEALTH_GOAL),
            ("memory within limit + 200 MiB", self.peak.total_mib <= self.memory_goal_mib()),
            ("door within 300 MiB", self.peak.door_mib <= DOOR_GOAL_MIB),
            ("idle again", self.idle_time <= IDLE_GOAL && self.fate != ServerFate::Busy),
        ];
        goals.iter().filter(|(_, is_reached)| !is_reached).map(|(goal, _)| *goal).collect()
    }

    fn memory_goal_mib(&self) -> u64 {
        self.idle_mib + self.limit_mib + MEMORY_GOAL_MIB
    }

    // Each outcome with how often it came.
    fn outcome(&self) -> String {
        let mut counts = BTreeMap::<&str, usize>::new();
        self.outcomes.iter().for_each(|outcome| *counts.entry(outcome).or_default() += 1);
        let counted = counts.iter().map(|(outcome, count)| format!("{outcome} x{count}"));
        counted.collect::<Vec<_>>().join(", ")
    }

    fn fate_name(&self) -> &'static str {
        match self.fate {
            ServerFate::Alive => "alive",
            ServerFate::Died(_) => "DIED",
            ServerFate::Capped => "CAP",
            ServerFate::Busy => "BUSY",
        }
    }
}

fn longest_time(times: &[Duration]) -> Duration {
    times.iter().max().copied().unwrap_or_default()
}

/// Prints what light clients measure on the quiet server.
pub(super) fn print_quiet(light: &LightReport) {
    let at = |share| millis(percentile(&light.pages, share));
    println!("quiet: pages {}, p50 {:.0} ms, p95 {:.0} ms", light.pages.len(), at(0.5), at(0.95));
}

/// Prints a row of the table.
pub(super) fn print_row(row: &AttackRow) {
    println!(
        "{:42} {:17} ends {}, light p50 {:6.0} max {:6.0} wrong {:2} again {:2}, pages max {:6.0}, health {:6.0} ms, \
         door {:5} all {:5} MiB, idle {:5.0} ms, {:5} {:4.1} s: {}",
        row.name,
        row.protocol,
        row.engine_ends,
        millis(percentile(&row.light.queries, 0.5)),
        millis(longest_time(&row.light.queries)),
        row.light.failures.len(),
        row.light.retriable,
        millis(longest_time(&row.light.pages)),
        millis(longest_time(&row.light.health)),
        row.peak.door_mib,
        row.peak.total_mib,
        millis(row.idle_time),
        row.fate_name(),
        row.took.as_secs_f64(),
        row.outcome(),
    );
    row.missed_goals().iter().for_each(|goal| println!("  missed: {goal}"));
    row.light.failures.iter().for_each(|failure| println!("  light query {failure}"));
}

/// Prints how many rows miss which goal; returns whether none does.
pub(super) fn print_summary(rows: &[AttackRow]) -> bool {
    let mut missed = BTreeMap::<&str, usize>::new();
    rows.iter().flat_map(AttackRow::missed_goals).for_each(|goal| *missed.entry(goal).or_default() += 1);
    let count = |fate: &str| rows.iter().filter(|row| row.fate_name() == fate).count();
    println!("{} attacks: {} died, {} capped, {} busy", rows.len(), count("DIED"), count("CAP"), count("BUSY"));
    let ending: Vec<_> = rows.iter().filter(|row| row.engine_ends > 0).collect();
    println!("{} end an engine:", ending.len());
    ending.iter().for_each(|row| println!("  {} {}: {}", row.name, row.protocol, row.engine_ends));
    let retriable: usize = rows.iter().map(|row| row.light.retriable).sum();
    println!("{retriable} light queries failed with their engine");
    let light: Vec<_> = rows.iter().flat_map(|row| row.light.queries.iter().copied()).collect();
    let health: Vec<_> = rows.iter().flat_map(|row| row.light.health.iter().copied()).collect();
    let pages: Vec<_> = rows.iter().flat_map(|row| row.light.pages.iter().copied()).collect();
    for (name, times) in [("light queries", light), ("pages", pages), ("/health", health)] {
        let at = |share| millis(percentile(&times, share));
        println!(
            "{name}: {}, p50 {:.0} ms, p95 {:.0} ms, p99 {:.0} ms, max {:.0} ms",
            times.len(),
            at(0.5),
            at(0.95),
            at(0.99),
            at(1.0)
        );
    }
    for (goal, rows) in &missed {
        println!("missed: {goal}: {rows} rows");
    }
    missed.is_empty()
}
