//! `GET /api/v1/map`: surfaces as points, close together if they reflect alike. Computed once per snapshot.

use axum::Extension;
use echolake_dsp::components::PrincipalComponents;
use echolake_dsp::self_organising_map::SelfOrganisingMap;
use echolake_query::figure_rows::{OrbitEnergies, orbit_energies_query};
use echolake_service::RequestFault;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::super::extract::{QueryParams, WholeNumber};
use super::content::{AnswerContent, EndpointAnswer};
use super::request::CatalogueRequest;
use super::snapshot::positions::{SurfaceNeighbour, SurfacePositions};

/// Components that are answered.
const COMPONENTS: usize = 3;
/// Surfaces that are placed; more are left out.
const MOST_SURFACES: usize = 2000;
/// Products of features that the distances may take: beyond, orbits are left out evenly. One core does about a billion
/// a second.
const MOST_PRODUCTS: usize = 4_000_000_000;

/// Surfaces on the map.
#[derive(Serialize, ToSchema)]
struct SurfaceMap<'a> {
    /// Levels that all surfaces have: two for each band and orbit of pairs.
    features: usize,
    /// Share of the variance by component.
    explained: Vec<f64>,
    units: MapUnits<'a>,
    points: Vec<MapPoint<'a>>,
    /// Surfaces without TNCE, and those beyond the first 2000.
    left_out: Vec<&'a str>,
}

/// Units of a self-organising map.
#[derive(Serialize, ToSchema)]
struct MapUnits<'a> {
    columns: usize,
    rows: usize,
    /// Mean distance of each unit from those beside it, row by row: great between groups.
    borders_db: &'a [f64],
}

/// A surface on the map.
#[derive(Serialize, ToSchema)]
struct MapPoint<'a> {
    surface_id: &'a str,
    typology: &'a str,
    /// Coordinates along the components, dB.
    position: Vec<f64>,
    /// Column and row of its unit on the self-organising map.
    unit: [usize; 2],
    neighbours: Vec<SurfaceNeighbour<'a>>,
}

/// The number of neighbours.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct MapQuery {
    #[param(inline)]
    neighbours: WholeNumber<1, 20, 6>,
}

/// Surfaces as points, close together if they reflect alike, and their nearest neighbours.
///
/// Principal components and a self-organising map of levels (dB re Flat, same band) that do not depend on how a panel
/// lay: for each band and each orbit of pairs under D4 the mean TNCE of the weaker and of the stronger half of its
/// pairs. Once per snapshot.
#[utoipa::path(
    get,
    path = "/api/v1/map",
    tag = "catalogue",
    params(MapQuery),
    responses((status = 200, description = "OK", body = SurfaceMap)),
    extensions(("x-sql" = json!([
        "select surface_id, pair_id, tnce_band_2500, ..., tnce_band_40000 from tnce; means by orbit of pairs, Gram \
         matrix, leading eigenvectors, batch self-organising map",
    ])))
)]
pub(super) async fn map(
    Extension(request): Extension<CatalogueRequest>,
    QueryParams(query): QueryParams<MapQuery>,
) -> EndpointAnswer {
    let summary = request.read_summary().await?;
    let places = surface_positions(&request).await?;
    let typology = |name: &str| summary.find_entry(name).map_or("", |entry| entry.surface.typology.as_str());
    let point = |(i, name)| MapPoint {
        surface_id: name,
        typology: typology(name),
        position: places.components.row_position(i),
        unit: places.units.units[i],
        neighbours: places.nearest_surfaces(i, query.neighbours.get()),
    };
    let names: std::collections::HashSet<_> = places.names.iter().map(String::as_str).collect();
    let all = summary.entries.iter().map(|entry| entry.surface.surface_id.as_str());
    Ok(AnswerContent::encode_json(&SurfaceMap {
        features: places.components.feature_count(),
        explained: places.components.explained_shares(),
        units: MapUnits {
            columns: places.units.size[0],
            rows: places.units.size[1],
            borders_db: &places.units.borders,
        },
        points: places.names.iter().map(String::as_str).enumerate().map(point).collect(),
        left_out: all.filter(|name| !names.contains(name)).collect(),
    })?)
}

/// Returns the surfaces' positions, which are found once per snapshot.
///
/// # Errors
/// Those of its query.
pub(super) async fn surface_positions(request: &CatalogueRequest) -> Result<&SurfacePositions, RequestFault> {
    request.view.results.places.get_or_try_init(|| find_positions(request)).await
}

/// Finds the surfaces' positions by their TNCE.
///
/// # Errors
/// Those of its query.
async fn find_positions(request: &CatalogueRequest) -> Result<SurfacePositions, RequestFault> {
    let summary = request.read_summary().await?;
    let rig = request.catalogue.lake().rig();
    let known = summary.entries.iter().filter(|e| e.surface.against_flat_db.iter().any(Option::is_some));
    let names: Vec<_> = known.map(|e| e.surface.surface_id.clone()).take(MOST_SURFACES).collect();
    let bands = rig.band_names();
    let grid = request.catalogue.lake().grid();
    let orbits = grid.pair_orbits().into_iter().max().map_or(0, |last| last + 1);
    let products = names.len() * names.len() * orbits * bands.len();
    let step = products.div_ceil(MOST_PRODUCTS).max(1);
    let mut energies = OrbitEnergies::new(&names, grid, bands.len(), step);
    let mut rows = request.stream_batches(&orbit_energies_query(rig), Vec::new()).await?;
    while let Some(batch) = rows.next_part().await? {
        energies.add_batch(&batch).map_err(RequestFault::defect("the map's columns are not as expected"))?;
    }
    let place = move || {
        let components = PrincipalComponents::from_rows(&mut energies.into_level_rows(), COMPONENTS)?;
        let units = SelfOrganisingMap::from_components(&components);
        Ok::<_, echolake_dsp::Error>((components, units))
    };
    let found = request.catalogue.service().compute_blocking(place).await?;
    let (components, units) = found.map_err(RequestFault::defect("surfaces have no places"))?;
    Ok(SurfacePositions { names, components, units })
}
