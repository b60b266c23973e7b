//! Gauges of one moment: the process, its engines and connections, and the lake.

use std::time::Duration;

use echolake_service::{LakeFigures, ServerProtocol};
use prometheus::core::Collector;
use prometheus::{Counter, Gauge, Opts, Registry, Result};
use rustix::process::{Resource, getrlimit};
use rustix::time::{ClockId, clock_gettime};

/// Gauges of one moment.
#[derive(Default)]
pub(crate) struct ServerGauges {
    pub engines: EngineGauges,
    /// Open connections of each protocol that is served, and their limit.
    pub connections: Vec<(ServerProtocol, usize, usize)>,
    /// Space on the disks of `lake` and `temp`.
    pub disks: Vec<(&'static str, DiskSpace)>,
    /// The last figures of the lake, and their age.
    pub lake: Option<(Duration, LakeFigures)>,
    pub is_ready: bool,
    /// Seconds since 1970.
    pub process_start: f64,
}

/// Space of a file system.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct DiskSpace {
    /// Bytes that this user may still write.
    pub free_bytes: u64,
    pub bytes: u64,
}

/// Gauges of the engines.
#[derive(Default)]
pub(crate) struct EngineGauges {
    /// Engines that run, and their limit.
    pub engines: usize,
    pub most_engines: usize,
    /// Bytes that their queries occupy, and their limit.
    pub bytes: usize,
    pub most_bytes: usize,
    /// Engines since the start: those that were started, and those that ended by themselves.
    pub started: usize,
    pub failed: u64,
}

impl ServerGauges {
    /// Registers all of them with their values.
    pub fn register_all(&self, registry: &Registry) -> Result<()> {
        let moment = MomentRegistry(registry);
        moment.register_labelled("echolake_build_info", "Always 1.", ("version", env!("CARGO_PKG_VERSION")), 1.0)?;
        moment.register_gauge(
            "echolake_ready",
            "1 if requests are answered, as /ready says.",
            f64::from(u8::from(self.is_ready)),
        )?;
        self.register_engines(&moment)?;
        for (protocol, open, most) in &self.connections {
            let label = ("protocol", protocol.name());
            moment.register_labelled("echolake_connections", "Open connections.", label, *open as f64)?;
            moment.register_labelled(
                "echolake_connections_limit",
                "Connections that may be open.",
                label,
                *most as f64,
            )?;
        }
        for (folder, disk) in &self.disks {
            let label = ("folder", *folder);
            moment.register_labelled(
                "echolake_disk_free_bytes",
                "Free space on the folder's disk.",
                label,
                disk.free_bytes as f64,
            )?;
            moment.register_labelled("echolake_disk_bytes", "Size of the folder's disk.", label, disk.bytes as f64)?;
        }
        self.register_lake(&moment)?;
        self.register_process(&moment)
    }

    fn register_engines(&self, moment: &MomentRegistry<'_>) -> Result<()> {
        let pool = &self.engines;
        moment.register_gauge("echolake_engines", "Engines that run, the spare among them.", pool.engines as f64)?;
        moment.register_gauge("echolake_engines_limit", "Engines that may run.", pool.most_engines as f64)?;
        moment.register_gauge("echolake_engine_memory_bytes", "Memory that engines occupy.", pool.bytes as f64)?;
        moment.register_gauge(
            "echolake_engine_memory_limit_bytes",
            "Memory that queries may occupy.",
            pool.most_bytes as f64,
        )?;
        moment.register_counter("echolake_engine_starts_total", "Engines that were started.", pool.started as f64)?;
        let failed = pool.failed as f64;
        moment.register_counter("echolake_engine_failures_total", "Engines that ended by themselves.", failed)
    }

    // Left out while they are unknown: 0 runs would be a claim.
    fn register_lake(&self, moment: &MomentRegistry<'_>) -> Result<()> {
        let Some((age, lake)) = &self.lake else { return Ok(()) };
        moment.register_gauge("echolake_lake_version", "Version of the lake.", lake.version as f64)?;
        moment.register_gauge("echolake_lake_surfaces", "Surfaces of the lake.", lake.surfaces as f64)?;
        moment.register_gauge("echolake_lake_runs", "Runs of the lake.", lake.runs as f64)?;
        moment.register_gauge(
            "echolake_damaged_runs",
            "Runs with messages that ingest could not read.",
            lake.damaged_runs as f64,
        )?;
        moment.register_gauge("echolake_lake_table_bytes", "Bytes of the tables' files.", lake.table_bytes as f64)?;
        moment.register_gauge(
            "echolake_lake_look_age_seconds",
            "Time since the lake was looked at.",
            age.as_secs_f64(),
        )?;
        let folders =
            [("inbox", "that wait for ingest", lake.inbox), ("quarantine", "that ingest refused", lake.quarantine)];
        for (folder, which, figures) in folders {
            let name = |unit: &str| format!("echolake_{folder}_{unit}");
            moment.register_gauge(&name("runs"), &format!("Run files {which}."), figures.files as f64)?;
            moment.register_gauge(&name("bytes"), &format!("Bytes of run files {which}."), figures.bytes as f64)?;
        }
        Ok(())
    }

    // The names are those that Prometheus' own libraries give them. Those that the system does not tell are left out.
    fn register_process(&self, moment: &MomentRegistry<'_>) -> Result<()> {
        let cpu = clock_gettime(ClockId::ProcessCPUTime);
        let cpu_seconds = cpu.tv_sec as f64 + cpu.tv_nsec as f64 / 1e9;
        moment.register_counter(
            "process_cpu_seconds_total",
            "Processor time of the door, without engines.",
            cpu_seconds,
        )?;
        let start = self.process_start;
        moment.register_gauge("process_start_time_seconds", "Time of the start, since 1970.", start)?;
        if let Some(bytes) = resident_bytes() {
            moment.register_gauge(
                "process_resident_memory_bytes",
                "Memory of the door, without engines.",
                bytes as f64,
            )?;
        }
        if let Ok(files) = std::fs::read_dir("/proc/self/fd") {
            moment.register_gauge("process_open_fds", "Files and sockets that are open.", files.count() as f64)?;
        }
        if let Some(most) = getrlimit(Resource::Nofile).current {
            moment.register_gauge("process_max_fds", "Files and sockets that may be open.", most as f64)?;
        }
        Ok(())
    }
}

struct MomentRegistry<'a>(&'a Registry);

impl MomentRegistry<'_> {
    fn register_gauge(&self, name: &str, help: &str, value: f64) -> Result<()> {
        self.register_value(Gauge::with_opts(Opts::new(name, help))?, value)
    }

    fn register_labelled(&self, name: &str, help: &str, (label, text): (&str, &str), value: f64) -> Result<()> {
        self.register_value(Gauge::with_opts(Opts::new(name, help).const_label(label, text))?, value)
    }

    fn register_counter(&self, name: &str, help: &str, value: f64) -> Result<()> {
        let counter = Counter::with_opts(Opts::new(name, help))?;
        counter.inc_by(value);
        self.0.register(Box::new(counter))
    }

    fn register_value(&self, gauge: Gauge, value: f64) -> Result<()> {
        gauge.set(value);
        let collector: Box<dyn Collector> = Box::new(gauge);
        self.0.register(collector)
    }
}

fn resident_bytes() -> Option<usize> {
    let text = std::fs::read_to_string("/proc/self/statm").ok()?;
    let pages: usize = text.split(' ').nth(1)?.parse().ok()?;
    Some(pages * rustix::param::page_size())
}

#[cfg(test)]
mod tests {
    use super::super::ServerMetrics;
    use super::*;

    #[test]
    fn gauges_are_those_of_the_moment() {
        let lake = LakeFigures { runs: 7, damaged_runs: 1, ..LakeFigures::default() };
        let gauges = ServerGauges {
            connections: vec![(ServerProtocol::Http, 2, 512), (ServerProtocol::Postgres, 1, 128)],
            disks: vec![
                ("lake", DiskSpace { free_bytes: 10, bytes: 40 }),
                ("temp", DiskSpace { free_bytes: 1, bytes: 2 }),
            ],
            lake: Some((Duration::from_secs(3), lake)),
            is_ready: true,
            ..ServerGauges::default()
        };
        let text = ServerMetrics::new().and_then(|metrics| metrics.prometheus_text(&gauges)).expect("distinct names");
        for line in [
            "echolake_connections{protocol=\"http\"} 2",
            "echolake_connections_limit{protocol=\"postgres\"} 128",
            "echolake_disk_free_bytes{folder=\"lake\"} 10",
            "echolake_disk_bytes{folder=\"temp\"} 2",
            "echolake_lake_runs 7",
            "echolake_lake_look_age_seconds 3",
            "echolake_damaged_runs 1",
            "echolake_quarantine_runs 0",
            "echolake_ready 1",
            concat!("echolake_build_info{version=\"", env!("CARGO_PKG_VERSION"), "\"} 1"),
        ] {
            assert!(text.lines().any(|l| l == line), "{line} in {text}");
        }
        assert!(text.contains("\nprocess_resident_memory_bytes "), "{text}");
    }
}
