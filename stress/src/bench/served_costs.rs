//! Costs of a served lake: processor time of the page of a pair, and memory with full stores of columns.

use std::collections::BTreeMap;

use anyhow::{Context as _, Result, ensure};
use arrow::datatypes::DataType;
use echolake_lake::Lake;
use echolake_schema::tables::Table;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::catalogue_client::CatalogueServer;
use super::memory::resident_mib;
use super::report::{BenchReport, FigureGoal};
use crate::observed_server::ProcessTree;
use crate::serve::http::HttpRequest;
use crate::serve::server::ServedLake;

/// Pages of pairs that are asked for, each of another pair.
const PAIR_PAGES: usize = 500;
/// Tables whose columns are kept decoded, lists apart.
const KEPT_TABLES: [Table; 4] = [Table::Measurements, Table::Tnce, Table::TnceD4, Table::Environment];

/// Measures the processor time of all of a server's processes for the page of a pair, which nobody asked for before.
pub(crate) async fn measure_pair_pages(
    served: &ServedLake,
    lake: &Lake,
    seed: u64,
    report: &mut BenchReport,
) -> Result<()> {
    let snapshot = lake.snapshot().await?;
    let surfaces: Vec<_> = snapshot.runs().map(|run| run.surface.to_string()).collect();
    ensure!(!surfaces.is_empty(), "the lake has no runs");
    let pairs = lake.grid().pairs().len();
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut connection = CatalogueServer::new(&served.http).connect()?;
    let mut ask_page = || {
        let surface = &surfaces[random.random_range(0..surfaces.len())];
        let path = format!("/api/v1/surfaces/{surface}/pairs/{}", random.random_range(0..pairs));
        let (status, _) = connection.get(&path)?;
        ensure!(status == 200, "{path}: status {status}");
        Ok(())
    };
    // What is loaded at first use, is loaded.
    ask_page()?;
    let processes = ProcessTree::new(served.id());
    let before = processes.processor_time();
    (0..PAIR_PAGES).try_for_each(|_| ask_page())?;
    let each = (processes.processor_time() - before).as_secs_f64() / PAIR_PAGES as f64;
    report.group("The page of a pair");
    report.note(format!("{PAIR_PAGES} pages, one after the other, of pairs and surfaces by chance."));
    report
        .figure("CPU of the page of a pair, all processes of the server", each * 1e3, "ms")
        .goal(FigureGoal::AtMost(2.5));
    Ok(())
}

/// Measures the memory of a server's processes after all columns that may be kept were asked for.
pub(crate) fn measure_full_stores(served: &ServedLake, lake: &Lake, report: &mut BenchReport) -> Result<()> {
    for table in KEPT_TABLES {
        let schema = table.schema(lake.rig());
        let sums = schema.fields().iter().filter_map(|field| match field.data_type() {
            DataType::Utf8 => Some(format!("max(length({}))", field.name())),
            kind if kind.is_numeric() => Some(format!("sum({})", field.name())),
            _ => None,
        });
        let sql = format!("SELECT {} FROM {}", sums.collect::<Vec<_>>().join(", "), table.name());
        let answer = HttpRequest::post("/api/v1/sql?format=csv", &sql).with("content-type", "text/plain").send(served);
        ensure!(answer.status == 200 && answer.is_whole, "{sql}: status {}: {}", answer.status, answer.text());
    }
    let processes = ProcessTree::new(served.id());
    let mut engines = BTreeMap::new();
    for pid in processes.children() {
        let arguments = std::fs::read(format!("/proc/{pid}/cmdline"))?;
        let arguments: Vec<_> = arguments.split(|byte| *byte == 0).map(String::from_utf8_lossy).collect();
        let value = |option: &str| Some(arguments[arguments.iter().position(|it| it == option)? + 1].to_string());
        let role = value("--role").context("an engine has a role")?;
        let columns: f64 = value("--column-bytes").context("an engine has a limit of columns")?.parse()?;
        let memory = resident_mib(pid).context("the engine has ended")?;
        // Of the two engines of statements, the other one is a spare.
        let known = engines.entry(role).or_insert((0, columns / 1024.0 / 1024.0));
        known.0 = memory.max(known.0);
    }
    report.group("Memory of a server with full stores of columns");
    report.note("All columns of `measurements`, `tnce`, `tnce_d4` and `environment` but lists were asked for.");
    for (role, (memory, columns)) in engines {
        let name = format!("engine of {role}; at most {columns:.0} MiB of columns by `--column-memory`");
        report.figure(name, memory as f64, "MiB");
    }
    report.figure("all processes, shared pages once", processes.memory().total_kib as f64 / 1024.0, "MiB");
    Ok(())
}
