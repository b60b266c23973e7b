//! One surface: its statistics and means against Flat, and its grid seen from one microphone point.

use std::collections::HashMap;

use axum::Extension;
use echolake_lake::SurfaceReferences;
use echolake_query::figure_rows::{GridCell, GridLevels, LevelReference, band_list, grid_query};
use echolake_schema::SurfaceId;
use echolake_service::RequestFault;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use utoipa::{IntoParams, ToSchema};

use super::super::extract::{PathParams, QueryParams};
use super::content::{AnswerContent, EndpointAnswer};
use super::request::{CatalogueRequest, SurfacePath, number_value, text_value};
use super::snapshot::summary::{SurfaceEntry, SurfaceSummary};

/// One surface.
#[derive(Serialize, ToSchema)]
struct SurfaceDetail<'a> {
    surface: &'a SurfaceSummary,
    #[schema(value_type = HashMap<String, Value>)]
    parameters: &'a Map<String, Value>,
    mesh_triangles: Option<i64>,
    mesh_watertight: Option<bool>,
    reflection_factor: Option<f64>,
    runs: Vec<String>,
    /// Runs of the surface and of its references on which verdicts came since the last ingest: its statistics do not
    /// follow them yet.
    unfollowed_runs: Vec<String>,
    statistics: Vec<BandStatistics>,
    /// Phase of the relief's details that are narrower than a wavelength, rad, by band without the total. Over 0.18 a
    /// simulated relief is off by 1 dB and more in single pairs; null if it is not known.
    detail_phase: Vec<Option<f64>>,
    /// Mean over the pairs of Flat's TNCE, linear, over Flat's total. One value per band in the order of `lake.bands`,
    /// the total last; null if there is no value.
    flat_mean: Vec<Option<f64>>,
    /// Mean over the pairs of this surface's TNCE, as `flat_mean`; null of the Foam that is subtracted.
    mean: Vec<Option<f64>>,
    /// Flat's `p90_mean_db`, in the same order; null if there is no value.
    flat_measured_db: Vec<Option<f64>>,
}

/// Statistics of a band.
#[derive(Deserialize, Serialize, ToSchema)]
struct BandStatistics {
    band: String,
    measurements: i64,
    /// Runs that the row is a mean over.
    runs: Vec<String>,
    p90_mean_db: Option<f64>,
    p5_db: Option<f64>,
    p50_db: Option<f64>,
    p95_db: Option<f64>,
    min_db: Option<f64>,
    max_db: Option<f64>,
    spread_db: Option<f64>,
    /// Standard uncertainty of `p90_mean_db` without Foam's bias, with repositioning if it is known; null if it is not
    /// known.
    p90_mean_u_db: Option<f64>,
    /// `p90_mean_db` without Foam's own reflection; null if it cannot be estimated.
    unbiased_p90_mean_db: Option<f64>,
}

#[derive(Deserialize)]
struct SurfaceMeans {
    surface_id: String,
    means: Vec<Option<f64>>,
}

#[derive(Deserialize)]
struct DetailPhases {
    phases: Vec<Option<f64>>,
}

#[derive(Deserialize)]
struct SurfaceRun {
    run_id: String,
}

const STATISTICS: &str = "select band, measurements, run_ids as runs, level_db as p90_mean_db, p5_db, p50_db, p95_db, \
    min_db, max_db, spread_db, coalesce(combined_u_db, u_db) as p90_mean_u_db, unbiased_db as unbiased_p90_mean_db \
    from levels where surface_id = $1";

/// One surface with its statistics and means against Flat.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}",
    tag = "catalogue",
    params(SurfacePath),
    responses((status = 200, description = "OK", body = SurfaceDetail)),
    extensions(("x-sql" = json!([
        "the summary of /surfaces",
        "select * from levels where surface_id in ($1, $flat)",
        "select surface_id, avg(tnce_2500), ..., avg(tnce_total) from tnce where surface_id in ($1, $flat) and not \
         is_rejected(run_id, pair_id) group by surface_id",
    ])))
)]
pub(super) async fn surface(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<SurfacePath>,
) -> EndpointAnswer {
    let entry = request.find_surface(&path.surface_id).await?;
    let id = &entry.surface.surface_id;
    let flat = &entry.surface.flat_reference;
    let means = band_list(request.catalogue.lake().rig(), |band| format!("avg(tnce_{band})"));
    let means = format!(
        "select surface_id, {means} as means from tnce where surface_id in ($1, $2) and not is_rejected(run_id, \
             pair_id) group by surface_id"
    );
    let names = request.catalogue.lake().rig().band_names();
    let phases: Vec<_> = names.iter().map(|band| format!("cast(detail_phase_{band} as double)")).collect();
    let phases = format!(
        "select make_array({}) as phases from surfaces where surface_id = $1 order by run_id desc limit 1",
        phases.join(", ")
    );
    let (found, of_flat, rows, phases, runs) = tokio::try_join!(
        request.read_rows::<BandStatistics>(STATISTICS, vec![text_value(id)]),
        request.read_rows::<BandStatistics>(STATISTICS, vec![text_value(flat)]),
        request.read_rows::<SurfaceMeans>(&means, vec![text_value(id), text_value(flat)]),
        request.read_rows::<DetailPhases>(&phases, vec![text_value(id)]),
        request.read_rows::<SurfaceRun>(
            "select run_id from runs where surface_id = $1 order by started_ns",
            vec![text_value(id)]
        ),
    )?;
    let references =
        SurfaceReferences::from_snapshot(&request.view.snapshot, &request.catalogue.lake().config().references);
    let supporting = id.parse::<SurfaceId>().ok().map(|id| references.supporting_surfaces(&id));
    let unfollowed = request.unfollowed_runs(supporting.as_ref()).await?;
    let bands = &request.read_summary().await?.bands;
    let mean = |surface: &str| {
        let own = rows.iter().find(|row| row.surface_id == surface);
        own.map_or_else(|| vec![None; bands.len()], |row| row.means.clone())
    };
    let mut by_band = rows_by_band(found);
    let of_flat = rows_by_band(of_flat);
    let measured = |band: &str| of_flat.get(band).and_then(|row| row.p90_mean_db);
    Ok(AnswerContent::encode_json(&SurfaceDetail {
        surface: &entry.surface,
        parameters: &entry.parameters,
        mesh_triangles: entry.mesh_triangles,
        mesh_watertight: entry.mesh_watertight,
        reflection_factor: entry.reflection_factor,
        runs: runs.into_iter().map(|run| run.run_id).collect(),
        unfollowed_runs: unfollowed.into_iter().map(|run| run.run.to_string()).collect(),
        statistics: bands.iter().filter_map(|band| by_band.remove(&band.key)).collect(),
        detail_phase: phases.into_iter().next().map_or_else(|| vec![None; names.len()], |row| row.phases),
        flat_mean: mean(flat),
        mean: if entry.surface.is_foam() { vec![None; bands.len()] } else { mean(id) },
        flat_measured_db: bands.iter().map(|band| measured(&band.key)).collect(),
    })?)
}

fn rows_by_band(rows: Vec<BandStatistics>) -> HashMap<String, BandStatistics> {
    rows.into_iter().map(|row| (row.band.clone(), row)).collect()
}

/// TNCE over the grid for one microphone point.
#[derive(Serialize, ToSchema)]
#[schema(as = Grid)]
struct SurfaceGrid<'a> {
    surface_id: &'a str,
    microphone: usize,
    #[schema(inline)]
    over: GridNormalisation,
    /// Pair with the microphone by point; null if the pair was not measured or is the microphone itself.
    pairs: Vec<Option<i32>>,
    /// The pair was measured with microphone and speaker exchanged.
    swapped: Vec<bool>,
    /// By band, then by point: TNCE in dB.
    bands: Vec<Vec<Option<f64>>>,
}

/// The point and the levels of a grid.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct GridQuery {
    /// A grid point.
    #[param(value_type = usize, required = true)]
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    microphone: Option<String>,
    /// flat-total: as in the paper's tables. flat-band: as in its grid plots; the total is then over Flat's total.
    #[serde(default)]
    #[param(inline)]
    over: GridNormalisation,
}

/// The normalisation of the bands. The total is always normalised by Flat's total.
#[derive(Clone, Copy, Default, PartialEq, Eq, Deserialize, Serialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
#[schema(default = "flat-band")]
pub(super) enum GridNormalisation {
    FlatTotal,
    #[default]
    FlatBand,
}

/// TNCE over the grid for one microphone point.
///
/// Pairs that were measured the other way round are used by reciprocity and marked.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/grid",
    tag = "catalogue",
    params(SurfacePath, GridQuery),
    responses((status = 200, description = "OK", body = SurfaceGrid)),
    extensions(("x-sql" = json!([
        "select t.pair_id, t.microphone, t.speaker, <10 log10 of tnce_* or tnce_band_*> from tnce t where \
         t.surface_id = $1 and (t.microphone = $2 or t.speaker = $2)",
    ])))
)]
pub(super) async fn grid(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<SurfacePath>,
    QueryParams(query): QueryParams<GridQuery>,
) -> EndpointAnswer {
    let entry = request.find_surface(&path.surface_id).await?;
    let microphone = required_microphone(&request, query.microphone.as_deref())?;
    let levels = read_grid(&request, entry, microphone, query.over).await?;
    Ok(AnswerContent::encode_json(&SurfaceGrid {
        surface_id: &entry.surface.surface_id,
        microphone,
        over: query.over,
        pairs: levels.pairs,
        swapped: levels.swapped,
        bands: levels.bands,
    })?)
}

impl From<GridNormalisation> for LevelReference {
    fn from(over: GridNormalisation) -> Self {
        match over {
            GridNormalisation::FlatTotal => Self::FlatTotal,
            GridNormalisation::FlatBand => Self::FlatBand,
        }
    }
}

/// The microphone's point of a request that must name one.
///
/// # Errors
/// [`RequestFault::Request`] if it names none.
pub(super) fn required_microphone(request: &CatalogueRequest, named: Option<&str>) -> Result<usize, RequestFault> {
    request.parse_microphone(
        named.ok_or_else(|| RequestFault::bad_request("`microphone` is missing; hint: a grid point"))?,
    )
}

/// Reads the levels of a surface over the grid.
///
/// # Errors
/// Those of its query.
pub(super) async fn read_grid(
    request: &CatalogueRequest,
    entry: &SurfaceEntry,
    microphone: usize,
    over: GridNormalisation,
) -> Result<GridLevels, RequestFault> {
    let sql = grid_query(request.catalogue.lake().rig(), over.into(), "$1", "$2");
    let cells: Vec<GridCell> =
        request.read_rows(&sql, vec![text_value(&entry.surface.surface_id), number_value(microphone)]).await?;
    let points = request.catalogue.lake().grid().points().len();
    Ok(GridLevels::from_cells(cells, microphone, points, request.read_summary().await?.bands.len()))
}
