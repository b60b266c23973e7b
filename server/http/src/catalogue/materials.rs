//! `GET /api/v1/surfaces/{surface_id}/materials`: absorption and scattering at full scale.

use axum::Extension;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::super::extract::PathParams;
use super::content::{AnswerContent, EndpointAnswer};
use super::request::{CatalogueRequest, SurfacePath, text_value};

/// Coefficients of a surface in one octave at full scale; a standard uncertainty ends in `_u`.
#[derive(Deserialize, Serialize, ToSchema)]
struct MaterialBand {
    /// Centre of the octave at full scale; null if the rig does not say its scale.
    full_scale_hz: Option<f64>,
    /// The same in the measurement.
    band_hz: f64,
    absorption: Option<f64>,
    absorption_u: Option<f64>,
    /// The reason if there is no absorption, or whose it is.
    absorption_reason: Option<String>,
    scattering: Option<f64>,
    scattering_u: Option<f64>,
    /// The reason if there is no scattering, or that it differs from the specular loss.
    scattering_reason: Option<String>,
    specular_loss: Option<f64>,
    specular_loss_u: Option<f64>,
    /// Computed from the relief.
    far_scattering: Option<f64>,
    far_scattering_u: Option<f64>,
    /// Computed from the relief by Kirchhoff's approximation.
    diffusion_normalised: Option<f64>,
    diffusion_normalised_u: Option<f64>,
    /// The reason if one of the computed coefficients is missing.
    far_field_reason: Option<String>,
}

const MATERIALS: &str = "select full_scale_hz, band_hz, absorption, absorption_u, absorption_reason, scattering, \
    scattering_u, scattering_reason, specular_loss, specular_loss_u, cast(far_scattering as double) as far_scattering, \
    cast(far_scattering_u as double) as far_scattering_u, \
    cast(diffusion_normalised as double) as diffusion_normalised, \
    cast(diffusion_normalised_u as double) as diffusion_normalised_u, far_field_reason \
    from materials where surface_id = $1 order by band_hz";

/// Absorption and scattering of a surface by octave at full scale, for simulations of rooms.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/materials",
    tag = "catalogue",
    params(SurfacePath),
    responses((status = 200, description = "OK", body = Vec<MaterialBand>)),
    extensions(("x-sql" = json!(["select * from materials where surface_id = $1 order by band_hz"])))
)]
pub(super) async fn materials(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<SurfacePath>,
) -> EndpointAnswer {
    let surface_id = &request.find_surface(&path.surface_id).await?.surface.surface_id;
    let bands: Vec<MaterialBand> = request.read_rows(MATERIALS, vec![text_value(surface_id)]).await?;
    Ok(AnswerContent::encode_json(&bands)?)
}
