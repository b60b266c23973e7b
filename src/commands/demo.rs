//! `echolake demo`: the main job end to end, on the simulated rig: measure, record, ingest, query, browse.

use std::path::Path;
use std::time::Instant;

use echolake_acquisition::run::controller::RecordingMode;
use echolake_ingest::pending_runs;
use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_panel::PanelSpecimen;
use echolake_panel::collection::{CollectionSurface, collection_surfaces};
use echolake_query::Session;
use echolake_schema::Rig;

use super::simulated_runs::{PlannedRun, SimulationPlan, start_time};
use crate::CommandOutcome;
use crate::progress::CommandProgress;
use clap::Args;
use echolake_panel::collection::LARGEST;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub(crate) struct DemoArgs {
    /// Measure this many surfaces instead: the references, then panels of every typology with random parameters (two
    /// brick walls per stone wall, as in the paper), and the paper's own panels by name.
    /// Surfaces that the lake has are not measured again.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=LARGEST as i64))]
    pub surfaces: Option<u32>,
    /// Record no sweeps, only impulse responses: a tenth of the space.
    #[arg(long)]
    pub ir_only: bool,
    /// Do not serve the catalogue afterwards.
    #[arg(long)]
    pub no_serve: bool,
    /// Leave the runs in the lake's inbox/.
    #[arg(long, hide = true)]
    pub no_ingest: bool,
    /// The rig; by default that of the paper with sweeps of 0.05 s.
    #[arg(long)]
    pub rig: Option<PathBuf>,
    /// Seed of the simulation: the same seed gives the same data.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

/// The surfaces, in the order in which they are measured: name and relief are the same.
const SURFACES: [&str; 6] = ["flat", "foam", "wood", "prd", "river_rock", "macrostructure"];
/// The surface that the second table compares with Flat.
const COMPARED: &str = "river_rock";
/// Sweeps of 0.05 s instead of the paper's rig's 0.5 s: they fit a laptop's disk.
const SWEEP_SECS: f64 = 0.05;

pub(crate) async fn run_demo(args: &DemoArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let begun = Instant::now();
    let stop = super::stop_request()?;
    let surfaces = match args.surfaces {
        Some(count) => collection_surfaces(args.seed, count as usize)?,
        None => few_surfaces()?,
    };
    let rig = demo_rig(args.rig.as_deref(), lake_url).await?;
    let lake = Lake::open_or_create(lake_url, &rig, &ReferenceSurfaces::default()).await?;
    let progress = CommandProgress::new();
    progress.print_message("simulated rig: nothing here is measured");
    let planned = |(number, member): (usize, CollectionSurface)| PlannedRun {
        surface: member.surface,
        specimen: PanelSpecimen::Relief(member.relief),
        macro_reference: member.macro_reference,
        flat: None,
        foam: None,
        project: None,
        start: start_time(args.seed, number),
        seed: args.seed.wrapping_mul(1_000).wrapping_add(number as u64),
    };
    let simulation = SimulationPlan {
        rig,
        runs: surfaces.into_iter().enumerate().map(planned).collect(),
        keep: if args.ir_only { RecordingMode::ResponsesOnly } else { RecordingMode::Sweeps },
        folder: super::prepare_inbox(&lake)?,
        known: lake.whole_snapshot().await?.runs().map(|r| r.run.untagged_name().to_owned()).collect(),
    };
    let measuring = stop.clone();
    tokio::task::spawn_blocking(move || simulation.measure_missing(measuring.flag(), &progress)).await??;
    super::ensure_wanted(&stop)?;
    if args.no_ingest {
        eprintln!("the runs are in inbox/. Next:\n  {} {}ingest", program_command(), lake_flag(lake_url));
        return Ok(CommandOutcome::Whole);
    }
    let sources = pending_runs(&lake).await?;
    super::ingest::ingest_runs(&lake, sources, stop.flag(), &CommandProgress::new()).await?;
    super::ensure_wanted(&stop)?;
    let example = match args.surfaces {
        Some(_) => print_typologies(&lake).await?,
        None => print_tables(&lake).await?,
    };
    eprintln!("\ndone in {:.0} s. Next:", begun.elapsed().as_secs_f64());
    print_next(lake_url, example, args.no_serve);
    if args.no_serve {
        return Ok(CommandOutcome::Whole);
    }
    eprintln!();
    super::serve::serve_catalogue(&lake, &stop).await
}

fn few_surfaces() -> anyhow::Result<Vec<CollectionSurface>> {
    SURFACES.iter().map(|name: &&str| Ok(CollectionSurface::by_relief_name(name.parse()?, name)?)).collect()
}

// Without a file the demo's rig, whatever the lake's is: a lake of another rig refuses it.
async fn demo_rig(file: Option<&Path>, lake_url: &str) -> anyhow::Result<Rig> {
    if file.is_some() {
        return super::rig_or(file, lake_url, Rig::paper).await;
    }
    let mut rig = Rig::paper();
    rig.sweep.duration_secs = SWEEP_SECS;
    Ok(rig)
}

// The command line of this program for hints; cargo sets the variable for programs that it runs.
fn program_command() -> &'static str {
    if std::env::var_os("CARGO_MANIFEST_DIR").is_some() { "cargo run --profile quick --" } else { "echolake" }
}

fn lake_flag(lake_url: &str) -> String {
    if lake_url == "lake" { String::new() } else { format!("--lake {lake_url} ") }
}

fn print_next(lake_url: &str, example: &str, with_serve: bool) {
    let flag = lake_flag(lake_url);
    let measurements = format!(
        "sql \"select pair_id, snr_db, array_max(ir) from measurements where surface_id = '{example}' limit 5\""
    );
    let serve = with_serve.then_some("serve");
    let others = [
        "sql \"select surface_id, p90_mean_db, spread_db from surface_stats where band = 'total'\"",
        &measurements,
        "acquire --surface foam_2 --panel foam --seed 2",
        "ingest",
        "doctor",
    ];
    for next in serve.into_iter().chain(others) {
        eprintln!("  {} {flag}{next}", program_command());
    }
}

/// Title of the tables of levels.
const LEVELS_TITLE: &str =
    "TNCE of the values up to the 90th percentile against Flat, dB re Flat, same band (simulated)";

// A table's column for each band.
fn level_columns(lake: &Lake, expression: impl Fn(&str) -> String) -> String {
    let bands = lake.rig().band_names();
    let column = |band: &str, name: &str| format!("{} as \"{name}\"", expression(band));
    let columns: Vec<_> =
        bands.iter().map(|b| column(b, &format!("{b} Hz"))).chain([column("total", "total")]).collect();
    columns.join(", ")
}

// A level against Flat with its standard uncertainty; Flat over itself is no measurement.
fn level_text(band: &str) -> String {
    let level = format!("against_flat_{band}_db");
    let u = format!("level_u_{band}_db");
    format!(
        "case when {level} is null then null when surface_id = flat_reference then 'reference' else \
         concat(case when {level} > 0 then '+' end, round({level}, 1) + 0.0, case when {u} < 0.005 then ' \u{b1} \
         <0.01' when {u} > 99 then ' \u{b1} >99' when {u} is not null then concat(' \u{b1} ', round({u}, 2)) end) end"
    )
}

// One row per reference or typology: a large collection has too many surfaces to print. Returns a surface to look at.
async fn print_typologies(lake: &Lake) -> anyhow::Result<&'static str> {
    let session = Session::new(lake)?;
    let columns = level_columns(lake, |band| format!("round(avg(against_flat_{band}_db), 1) + 0.0"));
    super::print_line(&format!("\n{LEVELS_TITLE}, mean over surfaces"))?;
    let sql = format!(
        "select case typology when 'reference' then surface_id else typology end as kind, \
         count(*) as surfaces, {columns} \
         from catalogue group by kind, typology order by typology <> 'reference', kind"
    );
    super::sql::print_table(&session, &sql).await?;
    Ok("flat")
}

// The paper's two tables. Returns a surface to look at.
async fn print_tables(lake: &Lake) -> anyhow::Result<&'static str> {
    let session = Session::new(lake)?;
    let columns = level_columns(lake, level_text);
    super::print_line(&format!("\nMean {LEVELS_TITLE}, \u{b1} standard uncertainty"))?;
    let sql = format!("select surface_id as surface, {columns} from catalogue order by surface_id");
    super::sql::print_table(&session, &sql).await?;
    super::print_line(&format!(
        "\nMean energy of {COMPARED} and Flat, over Flat's total, linear (simulated): of all pairs, where levels leave \
         out the loudest tenth"
    ))?;
    let row = |band: &str| {
        format!(
            "select '{band}' as band, avg(tnce_{band}) filter (where surface_id = 'flat') as flat, \
             avg(tnce_{band}) filter (where surface_id = '{COMPARED}') as panel from tnce"
        )
    };
    let rows: Vec<_> = lake.rig().band_names().iter().map(String::as_str).chain(["total"]).map(row).collect();
    let sql = format!(
        "select band, round(flat, 3) as flat, round(panel, 3) as {COMPARED}, round(100 * (panel / flat - 1), 1) as \
         \"difference %\" from ({}) order by band = 'total', length(band), band",
        rows.join(" union all ")
    );
    super::sql::print_table(&session, &sql).await?;
    Ok(COMPARED)
}
