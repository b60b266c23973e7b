//! `echolake campaign`: measures the surfaces of a file, as far as the lake lacks them, and prints the paper's tables
//! with what was expected. On a rig with real devices somebody puts each panel in place.

mod definition;
mod real_runs;
mod tables;

use std::collections::{BTreeMap, HashSet};
use std::io::{IsTerminal as _, Write as _};
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::{Args, Subcommand};
use echolake_acquisition::run::controller::RecordingMode;
use echolake_acquisition::run::recording_lock::RecordingLock;
use echolake_ingest::pending_runs;
use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_query::Session;
use echolake_schema::{Rig, RunId, SurfaceId};
use serde::Deserialize;

use super::acquire::check_mesh;
use super::notify::NotifyArgs;
use super::simulated_runs::{PlannedRun, SimulationPlan, start_time};
use crate::CommandOutcome;
use crate::error_text::describe_error;
use crate::progress::CommandProgress;
use crate::signals::StopRequest;
use definition::{CampaignDefinition, CampaignSurface, UnnamedGeometry};
use real_runs::RealRuns;
use tables::{LevelTable, LevelsBySurface, TableColours, make_tables};

#[derive(Debug, Subcommand)]
pub(crate) enum CampaignSubcommand {
    /// Measure the surfaces that the lake lacks, ingest them, and print levels by band beside the expected ones.
    Run(CampaignRunArgs),
}

#[derive(Debug, Args)]
pub(crate) struct CampaignRunArgs {
    /// The campaign: TOML with surfaces, references and expected levels.
    file: PathBuf,
    /// The rig; by default the one that the campaign names, else the lake's, or that of the paper for a new lake.
    #[arg(long)]
    rig: Option<PathBuf>,
    /// Record no sweeps, only impulse responses: a tenth of the space.
    #[arg(long)]
    ir_only: bool,
    /// Real panels whose mesh or relief the campaign does not name are recorded without geometry.
    #[arg(long)]
    no_geometry: bool,
    /// Start even if another run is recorded into the lake, or with the same devices.
    #[arg(long)]
    force: bool,
    /// Print the tables as JSON.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    notify: NotifyArgs,
}

pub(crate) async fn run_campaign(command: &CampaignSubcommand, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let CampaignSubcommand::Run(args) = command;
    let file = args.file.display();
    let stop = super::stop_request()?;
    let campaign = CampaignDefinition::from_file(&args.file)?;
    // All of the file is checked before there is a lake.
    let own_rig = campaign.rig_file(&args.file);
    let rig = super::rig_or(args.rig.as_deref().or(own_rig.as_deref()), lake_url, Rig::paper).await?;
    let bands: Vec<String> = rig.band_names().into_iter().chain(["total".to_owned()]).collect();
    let unnamed = match (rig.devices.are_simulated(), args.no_geometry) {
        (true, _) => UnnamedGeometry::Guessed,
        (false, true) => UnnamedGeometry::Unknown,
        (false, false) => UnnamedGeometry::Refused,
    };
    let check = |references: &ReferenceSurfaces| {
        let surfaces = campaign.make_surfaces(&campaign.reference_surfaces(references), unnamed)?;
        surfaces.iter().try_for_each(|surface| check_mesh(&surface.specimen, &rig))?;
        campaign.check_expected(&surfaces, &bands)?;
        anyhow::Ok(surfaces)
    };
    check(&ReferenceSurfaces::default()).with_context(|| format!("campaign `{file}`"))?;
    let lake = Lake::open_or_create(lake_url, &rig, &ReferenceSurfaces::default()).await?;
    let surfaces = check(&lake.config().references).with_context(|| format!("campaign `{file}`"))?;
    let measured = measure_missing_runs(args, &campaign, &surfaces, &lake, &rig, &stop).await;
    if let Err(error) = &measured
        && !stop.is_made()
    {
        let notice = serde_json::json!({
            "event": "campaign_broken_off",
            "campaign": campaign.name,
            "simulated": rig.devices.are_simulated(),
            "error": describe_error(error),
        });
        args.notify.post_notice(&notice).await;
    }
    let outcome = measured?;
    super::ensure_wanted(&stop)?;
    let levels = read_levels(&Session::new(&lake)?).await?;
    let named: Vec<_> = surfaces.iter().map(|surface| (&surface.surface, surface.macro_reference.as_ref())).collect();
    let tables = make_tables(&named, &levels, &campaign.expected);
    print_tables(args, &campaign, &bands, &tables)?;
    Ok(outcome)
}

fn print_tables(
    args: &CampaignRunArgs,
    campaign: &CampaignDefinition,
    bands: &[String],
    tables: &[LevelTable],
) -> anyhow::Result<()> {
    if args.json {
        let report = serde_json::json!({
            "campaign": campaign.name, "about": campaign.about, "bands": bands, "tables": tables,
        });
        super::print_line(&serde_json::to_string_pretty(&report)?)?;
        return Ok(());
    }
    let colours = std::io::stdout().is_terminal() && std::env::var_os("NO_COLOR").is_none();
    let colours = if colours { TableColours::Extremes } else { TableColours::None };
    super::print_line(&campaign.name)?;
    if !campaign.about.is_empty() {
        super::print_line(campaign.about.trim_end())?;
    }
    for table in tables {
        // Its colours are control characters; the names in it are the campaign's own.
        writeln!(std::io::stdout().lock(), "\n{}", table.to_text(bands, colours))?;
    }
    Ok(())
}

// Measures the runs that the lake lacks, and ingests them.
async fn measure_missing_runs(
    args: &CampaignRunArgs,
    campaign: &CampaignDefinition,
    surfaces: &[CampaignSurface],
    lake: &Lake,
    rig: &Rig,
    stop: &StopRequest,
) -> anyhow::Result<CommandOutcome> {
    let folder = super::prepare_inbox(lake)?;
    let snapshot = lake.whole_snapshot().await?;
    let there: Vec<_> = snapshot.runs().map(|run| run.surface.to_string()).chain(surfaces_in(&folder)?).collect();
    let runs = missing_runs(campaign, surfaces, &there);
    let keep = if args.ir_only { RecordingMode::ResponsesOnly } else { RecordingMode::Sweeps };
    let mut outcome = CommandOutcome::Whole;
    if runs.is_empty() {
        eprintln!("the lake has all runs of the campaign");
    } else if rig.devices.are_simulated() {
        let progress = CommandProgress::new();
        progress.print_message("simulated rig: nothing here is measured");
        let simulation = SimulationPlan { rig: rig.clone(), runs, keep, folder, known: HashSet::new() };
        let measuring = stop.clone();
        tokio::task::spawn_blocking(move || simulation.measure_missing(measuring.flag(), &progress)).await??;
        super::ensure_wanted(stop)?;
    } else {
        let lock = match RecordingLock::acquire(&folder, rig) {
            Err(_) if args.force => None,
            locked => Some(locked?),
        };
        let real = RealRuns { rig: rig.clone(), runs, keep, folder };
        let measuring = stop.clone();
        outcome =
            tokio::task::spawn_blocking(move || real.measure_all(measuring.flag(), &CommandProgress::new())).await??;
        drop(lock);
        super::ensure_wanted(stop)?;
    }
    let sources = pending_runs(lake).await?;
    if !sources.is_empty() {
        super::ingest::ingest_runs(lake, sources, stop.flag(), &CommandProgress::new()).await?;
    }
    Ok(outcome)
}

// A surface that has runs of any origin is not measured again.
fn missing_runs(campaign: &CampaignDefinition, surfaces: &[CampaignSurface], there: &[String]) -> Vec<PlannedRun> {
    let [flat, foam] = campaign.named_references();
    let mut planned = Vec::new();
    let mut number = 0;
    for CampaignSurface { surface, specimen, macro_reference, seed, runs } in surfaces {
        let known = there.iter().filter(|there| **there == surface.as_str()).count();
        for run in 0..*runs {
            if run >= known {
                planned.push(PlannedRun {
                    surface: surface.clone(),
                    specimen: specimen.clone(),
                    macro_reference: macro_reference.clone(),
                    flat: flat.clone(),
                    foam: foam.clone(),
                    project: campaign.project.clone(),
                    start: start_time(campaign.seed, number),
                    seed: seed.wrapping_add(run as u64),
                });
            }
            number += 1;
        }
    }
    planned
}

// Surfaces of the runs that wait to be taken in.
fn surfaces_in(folder: &Path) -> anyhow::Result<Vec<String>> {
    let entries = std::fs::read_dir(folder).with_context(|| format!("cannot read `{}`", folder.display()))?;
    let named = entries.flatten().filter_map(|entry| {
        let name = entry.file_name();
        let run: RunId = name.to_str()?.strip_suffix(".mcap")?.parse().ok()?;
        run.untagged_name().split_once('-').map(|(_, surface)| surface.to_owned())
    });
    Ok(named.collect())
}

/// A row of the query for levels.
#[derive(Deserialize)]
struct BandLevelRow {
    surface_id: SurfaceId,
    band: String,
    level_db: Option<f64>,
}

// The levels of all surfaces, means over their runs.
async fn read_levels(session: &Session) -> anyhow::Result<LevelsBySurface> {
    let sql = "select surface_id, band, avg(p90_mean_db) as level_db from surface_stats group by surface_id, band";
    let rows: Vec<BandLevelRow> = super::sql::query_rows(session, sql).await?;
    let mut levels = BTreeMap::<String, BTreeMap<String, f64>>::new();
    for BandLevelRow { surface_id, band, level_db } in rows {
        if let Some(level_db) = level_db {
            levels.entry(surface_id.to_string()).or_default().insert(band, level_db);
        }
    }
    Ok(levels)
}
