//! `GET /api/v1/surfaces/{surface_id}/pairs`: the responses of a surface, whether or not it has levels.

use axum::Extension;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::super::extract::PathParams;
use super::content::{AnswerContent, EndpointAnswer};
use super::request::{CatalogueRequest, SurfacePath, text_value};

/// The measured pairs of a surface's run.
#[derive(Serialize, ToSchema)]
struct MeasuredPairs<'a> {
    surface_id: &'a str,
    /// Number of measured pairs.
    total: i64,
    /// The first 500 of them by number.
    items: Vec<MeasuredPair>,
}

/// A measured pair.
#[derive(Deserialize, Serialize, ToSchema)]
struct MeasuredPair {
    pair_id: i32,
    microphone: i32,
    speaker: i32,
    direct_mm: f64,
    #[schema(format = DateTime)]
    log_time: String,
    snr_db: Option<f32>,
    clipped_samples: Option<i64>,
    #[serde(skip_serializing)]
    #[schema(ignore)]
    total: i64,
}

const PAIRS: &str = "select m.pair_id, m.microphone, m.speaker, p.direct_mm, m.log_time, m.snr_db, m.clipped_samples, \
    count(*) over () as total from measurements m join pairs p using (pair_id) \
    where m.surface_id = $1 and m.run_id = $2 order by m.pair_id limit 500";

/// The measured pairs of a surface.
///
/// Those of its newest run.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/pairs",
    tag = "catalogue",
    params(SurfacePath),
    responses((status = 200, description = "OK", body = MeasuredPairs)),
    extensions(("x-sql" = json!([
        "select * from measurements join pairs using (pair_id) where surface_id = $1 and run_id = $run",
    ])))
)]
pub(super) async fn measured_pairs(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<SurfacePath>,
) -> EndpointAnswer {
    let surface = &request.find_surface(&path.surface_id).await?.surface;
    let items: Vec<MeasuredPair> = match &surface.run_id {
        Some(run) => request.read_rows(PAIRS, vec![text_value(&surface.surface_id), text_value(run)]).await?,
        None => Vec::new(),
    };
    let total = items.first().map_or(0, |pair| pair.total);
    Ok(AnswerContent::encode_json(&MeasuredPairs { surface_id: &surface.surface_id, total, items })?)
}
