//! Panels that a design found, which were simulated at all pairs, and their files.

use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::path::Path;
use std::thread;

use anyhow::{Context as _, bail};
use echolake_acquisition::design::{DesignSimulation, PanelFigures};
use echolake_dsp::temperature::ReferenceAir;
use echolake_figures::{FigureNotes, GridFigure, GridLayer, GridPanel, LevelPalette, MapFigure, MapPlane, MapPosition};
use echolake_panel::mesh::{BACK_MM, FACETS, Mesh, MeshFormat};
use echolake_panel::relief::PanelRelief;
use echolake_query::figure_rows::band_labels;
use echolake_schema::simulation::{TRUSTED_PHASE, mean_level_u_db};
use echolake_schema::{Grid, Rig, SurfaceId};
use serde::Serialize;
use serde_json::json;

use super::super::write_whole_file;
use super::measured::MeasuredPanel;
use super::search::{DesignCandidate, differing_candidates};
use super::target::{DesignGoal, DesignTarget, FigureKind};

/// Candidates that are simulated at all pairs, if fewer panels are kept: at few pairs their order is uncertain.
const FINALISTS: usize = 10;

/// A panel that the search found.
pub(super) struct FoundPanel {
    pub name: String,
    pub relief: PanelRelief,
    /// At the pairs of the search.
    pub searched: DesignCandidate,
    /// At all pairs.
    pub figures: PanelFigures,
    pub misfit: f64,
    /// Phase of its details by band, rad.
    pub detail_phases: Vec<Option<f64>>,
    /// The errors are known of simulations with steep facets.
    has_steep_facets: bool,
}

/// A figure of a found panel beside its target.
#[derive(Debug, Serialize)]
pub(super) struct GoalRow {
    pub figure: String,
    pub target: f64,
    pub found: f64,
    pub deviation: f64,
    /// Standard uncertainty of the panel's simulated mean level, dB; None for other figures, whose error is not known.
    pub simulation_error_db: Option<f64>,
    pub is_trusted: bool,
}

/// All that a found panel's row and files say.
#[derive(Debug, Serialize)]
pub(super) struct PanelReport {
    pub name: String,
    pub origin: &'static str,
    pub relief: serde_json::Value,
    /// At all pairs, and at those of the search.
    pub misfit: f64,
    pub misfit_of_search: f64,
    /// Root mean square of the levels' deviations, dB: in all bands, and in those that the simulation is trusted in.
    pub level_deviation_db: Option<f64>,
    pub trusted_level_deviation_db: Option<f64>,
    pub goals: Vec<GoalRow>,
    pub bands: Vec<serde_json::Value>,
}

impl FoundPanel {
    /// Returns whether the simulation of a band is trusted.
    pub fn is_trusted(&self, band: usize) -> bool {
        self.has_steep_facets && self.detail_phases[band].is_some_and(|phase| phase <= TRUSTED_PHASE)
    }

    fn level_uncertainty_db(&self, band: usize) -> f64 {
        mean_level_u_db(self.detail_phases[band].filter(|_| self.has_steep_facets))
    }

    /// Returns what is said of it.
    pub fn make_report(&self, target: &DesignTarget, bands: &[String]) -> PanelReport {
        let goal_row = |goal: &DesignGoal| GoalRow {
            figure: goal.describe_goal(bands),
            target: goal.value,
            found: goal.figure_of(&self.figures.bands),
            deviation: goal.figure_deviation(&self.figures.bands),
            simulation_error_db: (goal.kind == FigureKind::Level).then(|| self.level_uncertainty_db(goal.band)),
            is_trusted: self.is_trusted(goal.band),
        };
        let band_row = |(band, figures): (usize, &echolake_acquisition::design::BandFigures)| {
            json!({
                "band": bands[band],
                "level_db": figures.level_db,
                "spread_db": figures.spread_db,
                "scattering": figures.scattering.value,
                "scattering_u": figures.scattering.uncertainty,
                "detail_phase": self.detail_phases[band],
                "simulation_error_db": self.level_uncertainty_db(band),
                "is_trusted": self.is_trusted(band),
            })
        };
        PanelReport {
            name: self.name.clone(),
            origin: "simulated",
            relief: self.relief.to_json(),
            misfit: self.misfit,
            misfit_of_search: target.figures_misfit(&self.searched.bands),
            level_deviation_db: target.level_misfit_db(&self.figures, |_| true),
            trusted_level_deviation_db: target.level_misfit_db(&self.figures, |band| self.is_trusted(band)),
            goals: target.goals.iter().map(goal_row).collect(),
            bands: self.figures.bands.iter().enumerate().map(band_row).collect(),
        }
    }
}

/// Simulates the best candidates at all pairs, and returns those that fit best there, the best first.
pub(super) fn find_panels(
    target: &DesignTarget,
    candidates: &[DesignCandidate],
    whole: &DesignSimulation,
    rig: &Rig,
) -> anyhow::Result<Vec<FoundPanel>> {
    let chosen = differing_candidates(target, candidates, target.best.max(FINALISTS));
    let simulated: Vec<anyhow::Result<FoundPanel>> = thread::scope(|scope| {
        let threads: Vec<_> =
            chosen.iter().map(|candidate| scope.spawn(|| simulate_panel(target, candidate, whole, rig))).collect();
        let ended = threads.into_iter().map(|thread| thread.join());
        ended.map(|panel| panel.unwrap_or_else(|_| bail!("a simulation ended early"))).collect()
    });
    let mut panels = simulated.into_iter().collect::<anyhow::Result<Vec<_>>>()?;
    panels.sort_by(|a, b| a.misfit.total_cmp(&b.misfit));
    panels.truncate(target.best);
    for (panel, rank) in panels.iter_mut().zip(1..) {
        panel.name = format!("best_{rank}");
    }
    Ok(panels)
}

fn simulate_panel(
    target: &DesignTarget,
    candidate: &DesignCandidate,
    whole: &DesignSimulation,
    rig: &Rig,
) -> anyhow::Result<FoundPanel> {
    let relief = target.relief_of(&candidate.values)?;
    let heights = relief.height_field(FACETS);
    let figures = whole.compute_figures(&heights, relief.material())?;
    let sound_mm_s = 1e3 * ReferenceAir::from_response(&rig.impulse_response).speed_of_sound();
    Ok(FoundPanel {
        name: String::new(),
        misfit: target.figures_misfit(&figures.bands),
        detail_phases: rig.bands.centres_hz.iter().map(|hz| heights.detail_phase(sound_mm_s / hz)).collect(),
        has_steep_facets: rig.simulation.steep_facets,
        searched: candidate.clone(),
        relief,
        figures,
    })
}

/// Writes a panel's parameters, its mesh, and its levels over the grid.
pub(super) fn write_panel(
    folder: &Path,
    panel: &FoundPanel,
    whole: &DesignSimulation,
    rig: &Rig,
    grid: &Grid,
) -> anyhow::Result<()> {
    let name = &panel.name;
    write_whole_file(&folder.join(format!("{name}.json")), &serde_json::to_vec_pretty(&panel.relief.to_json())?)?;
    let cells = super::super::panel::mesh_cells(&panel.relief);
    let mesh = Mesh::from_height_field(&panel.relief.height_field(cells), BACK_MM);
    write_whole_file(&folder.join(format!("{name}.stl")), &mesh.to_bytes(MeshFormat::Stl))?;
    let microphone = grid.central_point().context("the grid has no points")?.id.index();
    let mut levels_db = vec![vec![None; grid.points().len()]; panel.figures.levels_db.len()];
    for (at, pair) in whole.chosen_pairs().enumerate() {
        let ends = [pair.microphone.index(), pair.speaker.index()];
        // By reciprocity, a pair counts in both directions.
        let Some(end) = ends.iter().position(|end| *end == microphone) else { continue };
        for (band, levels) in levels_db.iter_mut().enumerate() {
            levels[ends[1 - end]] = Some(panel.figures.levels_db[band][at]);
        }
    }
    let mut bands = band_labels(rig);
    bands.truncate(levels_db.len());
    let errors: Vec<_> = (0..bands.len()).map(|band| panel.level_uncertainty_db(band).to_string()).collect();
    let title = format!("{name}; error of the bands' means: {} dB", errors.join(", "));
    let figure = GridFigure {
        bands,
        layers: GridLayer::from_grid(grid),
        microphone,
        panels: vec![GridPanel { title, levels_db, is_difference: false }],
        palette: LevelPalette::Centred,
        panel_px: 520.0,
        columns: 1,
        with_caption: true,
    };
    let at = grid.points()[microphone].label();
    let title = format!("Simulated levels over Flat in the same band, dB, microphone at {at}");
    write_whole_file(&folder.join(format!("{name}.svg")), figure.draw(&simulated_notes(title)).to_svg().as_bytes())
}

/// Notes of a figure of simulated numbers alone.
fn simulated_notes(title: String) -> FigureNotes {
    let command = "echolake design".to_owned();
    FigureNotes { title, command, ..FigureNotes::of_lake(String::new(), ["simulated".to_owned()].into_iter()) }
}

/// Writes the picture of the search: candidates, found and measured panels, the target, and the Pareto front, by the
/// two figures that weigh most.
pub(super) fn write_search(
    folder: &Path,
    target: &DesignTarget,
    candidates: &[DesignCandidate],
    panels: &[FoundPanel],
    measured: &[MeasuredPanel],
    bands: &[String],
) -> anyhow::Result<()> {
    let [x, y] = shown_goals(target);
    let front = pareto_front(candidates.iter().map(|candidate| {
        [&x, &y].map(|goal| [goal.figure_of(&candidate.bands), goal.figure_deviation(&candidate.bands).abs()])
    }));
    let point = |name: &str, kind: &str, position: [f64; 2]| MapPosition {
        name: name.to_owned(),
        kind: kind.to_owned(),
        position,
    };
    let mut positions: Vec<_> = candidates
        .iter()
        .map(|candidate| point("", "candidate, simulated", [&x, &y].map(|goal| goal.figure_of(&candidate.bands))))
        .collect();
    for panel in measured {
        if let (Some(x), Some(y)) = (panel.figure_of(&x), panel.figure_of(&y)) {
            positions.push(point(&panel.surface_id, &format!("surface of the lake, {}", panel.origin), [x, y]));
        }
    }
    for panel in panels {
        let position = [&x, &y].map(|goal| goal.figure_of(&panel.figures.bands));
        positions.push(point(&panel.name, "found, simulated at all pairs", position));
    }
    if y.value.is_finite() {
        positions.push(point("target", "target", [x.value, y.value]));
    }
    let origins = measured.iter().map(|panel| panel.origin.clone()).chain(["simulated".to_owned()]);
    let notes = FigureNotes {
        title: format!("Search of {} candidates; the line is the Pareto front of both deviations", candidates.len()),
        command: "echolake design".to_owned(),
        ..FigureNotes::of_lake(String::new(), origins)
    };
    let plane = MapPlane::Figures { titles: [x.describe_goal(bands), y.describe_goal(bands)], front };
    let figure = MapFigure { positions, plane, width_px: 720.0 };
    write_whole_file(&folder.join("search.svg"), figure.draw(&notes).to_svg().as_bytes())
}

// The two goals of the greatest weights; beside a single one, another figure of its band, without a target.
fn shown_goals(target: &DesignTarget) -> [DesignGoal; 2] {
    let mut goals = target.goals.clone();
    goals.sort_by(|a, b| b.weight.total_cmp(&a.weight));
    let first = goals[0].clone();
    let kind = if first.kind == FigureKind::Scattering { FigureKind::Level } else { FigureKind::Scattering };
    let second = goals.into_iter().nth(1).unwrap_or_else(|| DesignGoal { kind, value: f64::NAN, ..first.clone() });
    [first, second]
}

// Points [figure, size of its deviation] in two figures; returns those that none is better than in both.
fn pareto_front(points: impl Iterator<Item = [[f64; 2]; 2]>) -> Vec<[f64; 2]> {
    let mut sorted: Vec<_> = points.collect();
    sorted.sort_by(|a, b| a[0][1].total_cmp(&b[0][1]).then(a[1][1].total_cmp(&b[1][1])));
    let mut least = f64::INFINITY;
    sorted.retain(|point| {
        let is_better = point[1][1] < least;
        least = least.min(point[1][1]);
        is_better
    });
    let mut front: Vec<_> = sorted.into_iter().map(|[x, y]| [x[0], y[0]]).collect();
    front.sort_by(|a, b| a[0].total_cmp(&b[0]));
    front
}

/// Writes the campaign that measures the panels, and expects their simulated levels.
pub(super) fn write_campaign(
    folder: &Path,
    target: &DesignTarget,
    panels: &[FoundPanel],
    flat: &SurfaceId,
    bands: &[String],
) -> anyhow::Result<()> {
    let name = folder.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    let stem = if name.parse::<SurfaceId>().is_ok() { name } else { "design".to_owned() };
    // A lake may have panels of other searches under the name of the folder.
    let surface = |panel: &FoundPanel| {
        let mut hasher = DefaultHasher::new();
        panel.relief.to_json().to_string().hash(&mut hasher);
        format!("{stem}-{}-{:08x}", panel.name.replace('_', "-"), hasher.finish() as u32)
    };
    let surfaces = panels.iter().map(|panel| {
        let parameters = panel.relief.parameters();
        json!({ "name": surface(panel), "relief": panel.relief.name(), "parameters": parameters })
    });
    let expected = panels.iter().map(|panel| {
        let levels = bands
            .iter()
            .zip(&panel.figures.bands)
            .map(|(band, figures)| (band.clone(), json!(round_level(figures.level_db))));
        json!({
            "surface": surface(panel),
            "relative_to": flat,
            "levels_db": levels.collect::<serde_json::Map<_, _>>(),
            "source": "simulated by `echolake design` at all pairs",
        })
    });
    let campaign = json!({
        "name": format!("Design {stem}"),
        "about": target.about,
        "surfaces": surfaces.collect::<Vec<_>>(),
        "expected": expected.collect::<Vec<_>>(),
    });
    let text = toml::to_string(&campaign)?;
    let head = "# Written by `echolake design`: measures the panels that it found. What it expects is simulated.\n";
    write_whole_file(&folder.join("campaign.toml"), format!("{head}{text}").as_bytes())
}

fn round_level(level_db: f64) -> f64 {
    (100.0 * level_db).round() / 100.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_front_holds_what_nothing_is_better_than_in_both() {
        let points =
            [[[3.0, 0.0], [9.0, 5.0]], [[1.0, 1.0], [4.0, 2.0]], [[2.0, 2.0], [5.0, 3.0]], [[7.0, 4.0], [0.0, 0.0]]];
        assert_eq!(pareto_front(points.into_iter()), [[1.0, 4.0], [3.0, 9.0], [7.0, 0.0]]);
    }
}
