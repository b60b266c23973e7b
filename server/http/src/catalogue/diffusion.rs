//! `GET /api/v1/diffusion`: how evenly surfaces spread what they reflect. Computed once per snapshot.

use std::collections::BTreeMap;

use axum::Extension;
use echolake_query::figure_rows::{DiffusionRow, diffusion_query};
use echolake_service::RequestFault;
use serde::Serialize;
use utoipa::ToSchema;

use super::content::{AnswerContent, EndpointAnswer};
use super::request::CatalogueRequest;

/// Diffusion coefficients by surface: by band in the order of `lake.bands`, the total last.
pub(super) type DiffusionCoefficients = BTreeMap<String, Vec<Option<f64>>>;

/// Diffusion coefficients of all surfaces.
#[derive(Serialize, ToSchema)]
struct DiffusionTable<'a> {
    items: Vec<SurfaceDiffusion<'a>>,
}

/// Diffusion coefficients of a surface.
#[derive(Serialize, ToSchema)]
struct SurfaceDiffusion<'a> {
    surface_id: &'a str,
    /// Mean over the grid's points of the coefficient of a point's pairs: 1 if their energies are equal. By band in the
    /// order of `lake.bands`, the total last; null of the Foam that is subtracted.
    diffusion: &'a [Option<f64>],
}

/// Evenness with which surfaces spread what they reflect.
///
/// The coefficient has the form of ISO 17497-2, which asks for receivers in the far field. A rig's grid is in the near
/// field, where a plane is even, too: only surfaces that were measured alike can be compared. Once per snapshot.
#[utoipa::path(
    get,
    path = "/api/v1/diffusion",
    tag = "catalogue",
    responses((status = 200, description = "OK", body = DiffusionTable)),
    extensions(("x-sql" = json!([
        "select surface_id, avg(d_2500), ... from (select surface_id, point, diffusion_coefficient(10 * \
         log10(energy_2500)) as d_2500, ... from (select surface_id, unnest([microphone, speaker]) as point, \
         energy_2500, ... from tnce) group by surface_id, point) group by surface_id",
    ])))
)]
pub(super) async fn diffusion(Extension(request): Extension<CatalogueRequest>) -> EndpointAnswer {
    let found = read_diffusion(&request).await?;
    let items = found.iter().map(|(surface_id, diffusion)| SurfaceDiffusion { surface_id, diffusion }).collect();
    Ok(AnswerContent::encode_json(&DiffusionTable { items })?)
}

/// Returns the coefficients of all surfaces, which are computed once per snapshot.
///
/// # Errors
/// Those of its query.
pub(super) async fn read_diffusion(request: &CatalogueRequest) -> Result<&DiffusionCoefficients, RequestFault> {
    let compute = || async {
        let sql = diffusion_query(request.catalogue.lake().rig(), "");
        let rows: Vec<DiffusionRow> = request.read_rows(&sql, Vec::new()).await?;
        Ok(rows.into_iter().map(|row| (row.surface_id, row.diffusion)).collect())
    };
    request.view.results.diffusion.get_or_try_init(compute).await
}
