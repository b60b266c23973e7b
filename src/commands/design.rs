//! `echolake design`: panels for a target, found by a search on the simulation.

mod gaussian_process;
mod measured;
mod next;
mod report;
mod search;
mod target;

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context as _, bail};
use clap::Args;
use echolake_acquisition::design::DesignSimulation;
use echolake_acquisition::rig::robots::Choreography;
use echolake_dsp::full_scale_octave::{OctaveGap, measured_octave};
use echolake_lake::{Error as LakeError, Lake, ReferenceSurfaces};
use echolake_schema::Rig;
use serde_json::json;

use crate::CommandOutcome;
use crate::progress::CommandProgress;
use next::NextPanel;
use report::PanelReport;
use search::{CandidateColumns, DesignSearch};
use target::{DesignTarget, FigureKind};

/// The file of a folder that has the inputs of its search.
const INPUTS_FILE: &str = "search.json";

#[derive(Debug, Args)]
pub(crate) struct DesignArgs {
    /// The target, a TOML file: a relief, ranges of its parameters, and levels, spreads or scattering by band.
    target: PathBuf,
    /// The folder of the results; a search that was stopped goes on there.
    #[arg(short, long, value_name = "FOLDER")]
    output: PathBuf,
    /// Propose so many panels to measure next instead: those whose measurement tells the most, because neither a
    /// surface of the lake nor a candidate of the folder is near. Their parameters go to next_1.json and so on.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=50))]
    next: Option<u32>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(crate) async fn run_design(args: &DesignArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let stop = super::stop_request()?;
    let lake = match Lake::open(lake_url).await {
        Err(LakeError::NoLake { .. }) => {
            eprintln!("no lake `{lake_url}`: the rig is the paper's");
            None
        }
        lake => Some(lake?),
    };
    let rig = lake.as_ref().map_or_else(Rig::paper, |lake| lake.rig().clone());
    rig.known_scale().ok_or(OctaveGap::UnknownScale).with_context(|| format!("rig `{}`", rig.name))?;
    let bands = rig.band_names();
    let text = target::read_target(&args.target)?;
    let within = || format!("target `{}`", args.target.display());
    let mut target = DesignTarget::from_toml(&text, &bands).with_context(within)?;
    for goal in target.goals.iter().filter(|goal| goal.kind == FigureKind::Scattering) {
        let octave = measured_octave(&rig, rig.bands.centres_hz[goal.band]);
        octave.with_context(|| format!("`scattering` of band `{}`", bands[goal.band])).with_context(within)?;
    }
    let (measured, references) = match &lake {
        Some(lake) => (measured::read_measured(lake, &bands).await?, lake.config().references.clone()),
        None => (Vec::new(), ReferenceSurfaces::default()),
    };
    if let Some(surface) = target.levels_of.clone() {
        target.add_levels(&measured::levels_of(&measured, &surface).with_context(within)?);
    }
    std::fs::create_dir_all(&args.output).with_context(|| format!("cannot make `{}`", args.output.display()))?;
    let path = args.output.join("candidates.csv");
    let inputs = serde_json::to_string_pretty(&json!({ "target": text, "goals": target.goals, "rig": rig }))?;
    let columns = CandidateColumns::new(&target, &bands, &inputs);
    if let Some(count) = args.next {
        let candidates = columns.read_candidates(&path, &target)?;
        check_inputs(&args.output, &inputs, !candidates.is_empty())?;
        let panels = next::propose_panels(&target, &candidates, &measured, bands.len(), count as usize)?;
        return write_next(args, &panels, &bands);
    }
    // The lock comes before the folder is read: another search may be writing its first candidates.
    let file = columns.lock_file(&path)?;
    let candidates = columns.read_candidates(&path, &target)?;
    check_inputs(&args.output, &inputs, !candidates.is_empty())?;
    super::write_whole_file(&args.output.join(INPUTS_FILE), inputs.as_bytes())?;
    let arms = Choreography::for_rig(&rig)?;
    let grid = rig.build_grid()?;
    let simulation = DesignSimulation::new(&rig, grid.clone(), arms.as_deref(), Some(target.pairs))?;
    let progress = CommandProgress::new();
    let task = progress.start_task("search", target.candidates as u64, "candidates");
    let known = candidates.len();
    let search = DesignSearch::from_candidates(file, candidates, &target, &simulation, &stop, task);
    let begun = Instant::now();
    let whole = DesignSimulation::new(&rig, grid.clone(), arms.as_deref(), None)?;
    let candidates = tokio::task::block_in_place(|| search.run(&whole))?;
    let secs = begun.elapsed().as_secs_f64() / (candidates.len() - known).max(1) as f64;

    eprintln!("simulating the best panels at all pairs");
    let panels = tokio::task::block_in_place(|| report::find_panels(&target, &candidates, &whole, &rig))?;
    if panels.len() < target.best {
        eprintln!("{} panels differ from each other, expected {}", panels.len(), target.best);
    }
    for panel in &panels {
        report::write_panel(&args.output, panel, &whole, &rig, &grid)?;
    }
    report::write_search(&args.output, &target, &candidates, &panels, &measured, &bands)?;
    report::write_campaign(&args.output, &target, &panels, &references.flat, &bands)?;
    let reports: Vec<PanelReport> = panels.iter().map(|panel| panel.make_report(&target, &bands)).collect();
    let summary = json!({
        "origin": "simulated",
        "candidates": candidates.len(),
        "pairs": simulation.chosen_pairs().count(),
        "secs_per_candidate": (candidates.len() > known).then_some(secs),
        "panels": reports,
    });
    let summary = serde_json::to_string_pretty(&summary)?;
    super::write_whole_file(&args.output.join("best.json"), summary.as_bytes())?;
    if args.json {
        super::print_line(&summary)?;
    } else {
        print_reports(&reports, &panels, &target)?;
    }
    if candidates.len() > known {
        eprintln!("{secs:.2} s per candidate at {} pairs", simulation.chosen_pairs().count());
    }
    let folder = args.output.display();
    eprintln!("{folder}: meshes, parameters and grid plots of {} panels; all numbers are simulated", panels.len());
    eprintln!("next: echolake campaign run {}", args.output.join("campaign.toml").display());
    Ok(CommandOutcome::Whole)
}

fn write_next(args: &DesignArgs, panels: &[NextPanel], bands: &[String]) -> anyhow::Result<CommandOutcome> {
    for (panel, number) in panels.iter().zip(1..) {
        let path = args.output.join(format!("next_{number}.json"));
        super::write_whole_file(&path, &serde_json::to_vec_pretty(&panel.parameters)?)?;
        if !args.json {
            let expected = bands.iter().zip(&panel.expected_db);
            let expected = expected.map(|(band, [level, s])| format!("{band} Hz {level:.1} ± {s:.1}"));
            super::print_line(&format!("{}: {:.1} bits", path.display(), panel.information_bits))?;
            super::print_line(&format!(
                "  expected levels over Flat, dB, computed from the others: {}",
                expected.collect::<Vec<_>>().join(", ")
            ))?;
            super::print_line(&format!("  {}", panel.parameters["parameters"]))?;
        }
    }
    if args.json {
        super::print_line(&serde_json::to_string_pretty(panels)?)?;
    }
    let first = args.output.join("next_1.json");
    eprintln!("next: echolake panel --parameters {} -o panel.stl", first.display());
    Ok(CommandOutcome::Whole)
}

// The folder has the inputs of its candidates, so that two searches are not mixed.
fn check_inputs(folder: &Path, inputs: &str, has_candidates: bool) -> anyhow::Result<()> {
    let kept = std::fs::read_to_string(folder.join(INPUTS_FILE)).ok();
    if has_candidates && kept.as_deref() != Some(inputs) {
        let folder = folder.display();
        bail!("`{folder}` has candidates of another target, levels or rig; hint: another folder for -o");
    }
    Ok(())
}

fn print_reports(reports: &[PanelReport], panels: &[report::FoundPanel], target: &DesignTarget) -> anyhow::Result<()> {
    for (report, panel) in reports.iter().zip(panels) {
        let values = target.ranges.iter().zip(&panel.searched.values).map(|((key, _), value)| format!("{key}={value}"));
        super::print_line(&format!(
            "{} (simulated): misfit {:.2} at all pairs, {:.2} in the search; {}",
            report.name,
            report.misfit,
            report.misfit_of_search,
            values.collect::<Vec<_>>().join(", ")
        ))?;
        if let Some(deviation) = report.level_deviation_db {
            let trusted = match report.trusted_level_deviation_db {
                Some(trusted) => format!("{trusted:.2} dB in the bands in which the simulation is trusted"),
                None => "the simulation is trusted in none of the bands".to_owned(),
            };
            super::print_line(&format!("  levels {deviation:.2} dB rms from the target; {trusted}"))?;
        }
        super::print_line("   target     found  deviation  figure, and standard uncertainty of the simulation")?;
        for goal in &report.goals {
            let error = match goal.simulation_error_db {
                Some(error) if goal.is_trusted => format!("means {error:.2} dB"),
                Some(error) => format!("means {error:.2} dB, single pairs 0.9 dB or more"),
                None => "not known".to_owned(),
            };
            super::print_line(&format!(
                "{:9.2} {:9.2}  {:9.2}  {}: {error}",
                goal.target, goal.found, goal.deviation, goal.figure
            ))?;
        }
    }
    Ok(())
}
