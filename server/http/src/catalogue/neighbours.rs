//! `GET /api/v1/surfaces/{surface_id}/neighbours`, and the same of a pair: what in the lake is most alike.

use arrow::datatypes::DataType;
use axum::Extension;
use datafusion::common::ScalarValue;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::super::extract::PathParams;
use super::content::{AnswerContent, EndpointAnswer};
use super::map::surface_positions;
use super::pair::{PairPath, ResponseSignal};
use super::request::{CatalogueRequest, SurfacePath, number_value, text_value};
use super::snapshot::positions::SurfaceNeighbour;

/// Surfaces that are answered.
const NEAREST_SURFACES: usize = 8;

/// The surfaces that are most like one.
#[derive(Serialize, ToSchema)]
struct NearestSurfaces<'a> {
    surface_id: &'a str,
    /// Nearest first, up to 8; none if the surface is not on the map.
    items: Vec<SurfaceNeighbour<'a>>,
}

/// The responses that are most like one.
#[derive(Serialize, ToSchema)]
struct NearestResponses<'a> {
    surface_id: &'a str,
    pair_id: usize,
    /// Most alike first, up to 10.
    items: Vec<AlikeResponse>,
}

/// The response of the same pair on another surface.
#[derive(Deserialize, Serialize, ToSchema)]
struct AlikeResponse {
    surface_id: String,
    /// Pearson's coefficient of both responses, at the same times: 1 if they differ by a factor.
    correlation: f64,
    /// Energy of the other response over that of this one, dB.
    level_db: f64,
}

const ALIKE: &str = "select surface_id, correlation, level_db from (select surface_id, \
    pearson(reflected, cast($3 as float[])) as correlation, \
    10 * log10(list_energy(reflected) / list_energy(cast($3 as float[]))) as level_db \
    from (select surface_id, avg_list(reflected_ir) as reflected from nce where pair_id = $2 and surface_id <> $1 \
    and not is_rejected(run_id, pair_id) group by surface_id)) where correlation is not null \
    order by correlation desc, surface_id limit 10";

/// The surfaces that are most like one: distances of the map.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/neighbours",
    tag = "catalogue",
    params(SurfacePath),
    responses((status = 200, description = "OK", body = NearestSurfaces)),
    extensions(("x-sql" = json!(["as of /map"])))
)]
pub(super) async fn nearest_surfaces(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<SurfacePath>,
) -> EndpointAnswer {
    let surface_id = &request.find_surface(&path.surface_id).await?.surface.surface_id;
    let places = surface_positions(&request).await?;
    let own = places.names.iter().position(|name| name == surface_id);
    let items = own.map(|own| places.nearest_surfaces(own, NEAREST_SURFACES)).unwrap_or_default();
    Ok(AnswerContent::encode_json(&NearestSurfaces { surface_id, items })?)
}

/// The responses of the same pair on other surfaces that are most like one's, after Foam's were subtracted.
///
/// Of another pair the sound arrives at other times, so that its samples cannot be compared one by one.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/pairs/{pair_id}/neighbours",
    tag = "catalogue",
    params(PairPath),
    responses((status = 200, description = "OK", body = NearestResponses)),
    extensions(("x-sql" = json!([
        "select surface_id, pearson(reflected_ir, $own) as correlation, 10 * log10(list_energy(reflected_ir) / \
         list_energy($own)) as level_db from nce where pair_id = $2 and surface_id <> $1 order by correlation desc \
         nulls last limit 10; means of several runs",
    ])))
)]
pub(super) async fn nearest_responses(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<PairPath>,
) -> EndpointAnswer {
    let entry = request.find_surface(&path.surface_id).await?;
    let surface_id = &entry.surface.surface_id;
    let pair_id = request.parse_pair(&path.pair_id)?;
    let samples = ResponseSignal::Reflected.read_samples(&request, entry, pair_id).await?;
    let samples: Vec<_> = samples.into_iter().map(ScalarValue::from).collect();
    let samples = ScalarValue::List(ScalarValue::new_list_nullable(&samples, &DataType::Float32));
    let items = request.read_rows(ALIKE, vec![text_value(surface_id), number_value(pair_id), samples]).await?;
    Ok(AnswerContent::encode_json(&NearestResponses { surface_id, pair_id, items })?)
}
