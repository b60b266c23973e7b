//! One surface: its statistics and means against Flat, and its grid seen from one microphone point.

use std::collections::HashMap;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::asked::{CatalogueRequest, number, text};
use super::content::AnswerContent;
use super::lake::{band_list, levels_db};
use super::summary::SurfaceSummary;
use crate::fault::RequestFault;

#[derive(Serialize)]
struct SurfaceDetail<'a> {
    surface: &'a SurfaceSummary,
    parameters: &'a Map<String, Value>,
    mesh_triangles: Option<i64>,
    mesh_watertight: Option<bool>,
    reflection_factor: Option<f64>,
    runs: Vec<String>,
    statistics: Vec<BandStatistics>,
    flat_mean: Vec<Option<f64>>,
    mean: Vec<Option<f64>>,
}

#[derive(Deserialize, Serialize)]
struct BandStatistics {
    band: String,
    measurements: i64,
    p90_mean_db: Option<f64>,
    p5_db: Option<f64>,
    p50_db: Option<f64>,
    p95_db: Option<f64>,
    min_db: Option<f64>,
    max_db: Option<f64>,
    spread_db: Option<f64>,
}

#[derive(Deserialize)]
struct SurfaceMeans {
    surface_id: String,
    means: Vec<Option<f64>>,
}

#[derive(Deserialize)]
struct SurfaceRun {
    run_id: String,
}

const STATISTICS: &str = "select band, measurements, p90_mean_db, p5_db, p50_db, p95_db, min_db, max_db, spread_db \
    from surface_stats where surface_id = $1 order by run_id desc";

/// One surface with its statistics and means against Flat.
pub(super) async fn surface(asked: CatalogueRequest) -> Result<AnswerContent, RequestFault> {
    let entry = asked.surface().await?;
    let (id, flat) = (&entry.surface.surface_id, &entry.surface.flat_reference);
    let means = band_list(asked.catalogue.lake().rig(), |band| format!("avg(tnce_{band})"));
    let means =
        format!("select surface_id, {means} as means from tnce where surface_id in ($1, $2) group by surface_id");
    let (found, rows, runs) = tokio::try_join!(
        asked.rows::<BandStatistics>(STATISTICS, vec![text(id)]),
        asked.rows::<SurfaceMeans>(&means, vec![text(id), text(flat)]),
        asked.rows::<SurfaceRun>("select run_id from runs where surface_id = $1 order by started_ns", vec![text(id)]),
    )?;
    let bands = &asked.summary().await?.bands;
    let mean = |surface: &str| {
        let own = rows.iter().find(|row| row.surface_id == surface);
        own.map_or_else(|| vec![None; bands.len()], |row| row.means.clone())
    };
    // The newest run's row of each band, in the order of the bands.
    let mut by_band: HashMap<_, _> = found.into_iter().rev().map(|row| (row.band.clone(), row)).collect();
    AnswerContent::json(&SurfaceDetail {
        surface: &entry.surface,
        parameters: &entry.parameters,
        mesh_triangles: entry.mesh_triangles,
        mesh_watertight: entry.mesh_watertight,
        reflection_factor: entry.reflection_factor,
        runs: runs.into_iter().map(|run| run.run_id).collect(),
        statistics: bands.iter().filter_map(|band| by_band.remove(&band.key)).collect(),
        flat_mean: mean(flat),
        mean: mean(id),
    })
}

#[derive(Serialize)]
struct SurfaceGrid<'a> {
    surface_id: &'a str,
    microphone: usize,
    over: &'static str,
    pairs: Vec<Option<i32>>,
    swapped: Vec<bool>,
    bands: Vec<Vec<Option<f64>>>,
}

#[derive(Deserialize)]
struct GridCell {
    pair_id: i32,
    microphone: usize,
    speaker: usize,
    energies: Vec<Option<f64>>,
}

/// The normalisation of the bands. The total is always normalised by Flat's total.
const OVER: [&str; 2] = ["flat-total", "flat-band"];

/// TNCE over the grid for one microphone point; a pair that was measured the other way round is used by reciprocity.
pub(super) async fn grid(asked: CatalogueRequest) -> Result<AnswerContent, RequestFault> {
    let entry = asked.surface().await?;
    let microphone =
        asked.microphone()?.ok_or_else(|| RequestFault::request("`microphone` is missing; hint: a grid point"))?;
    let over = asked.params.choice("over", &OVER)?;
    let column = |band: &str| match band == super::lake::TOTAL || over == OVER[0] {
        true => format!("avg(tnce_{band})"),
        false => format!("avg(tnce_band_{band})"),
    };
    let energies = band_list(asked.catalogue.lake().rig(), column);
    let sql = format!(
        "select pair_id, microphone, speaker, {energies} as energies from tnce \
         where surface_id = $1 and (microphone = $2 or speaker = $2) group by pair_id, microphone, speaker"
    );
    let mut cells: Vec<GridCell> = asked.rows(&sql, vec![text(&entry.surface.surface_id), number(microphone)]).await?;
    // If both directions were measured, the requested one counts.
    cells.sort_by_key(|cell| cell.microphone == microphone);
    let points = asked.catalogue.lake().grid().points().len();
    let bands = asked.summary().await?.bands.len();
    let mut grid = SurfaceGrid {
        surface_id: &entry.surface.surface_id,
        microphone,
        over,
        pairs: vec![None; points],
        swapped: vec![false; points],
        bands: vec![vec![None; points]; bands],
    };
    for cell in cells {
        let swapped = cell.microphone != microphone;
        let other = if swapped { cell.microphone } else { cell.speaker };
        if other >= points {
            continue;
        }
        grid.pairs[other] = Some(cell.pair_id);
        grid.swapped[other] = swapped;
        for (band, level) in grid.bands.iter_mut().zip(levels_db(&cell.energies)) {
            band[other] = level;
        }
    }
    AnswerContent::json(&grid)
}
