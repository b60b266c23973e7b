//! `GET /api/v1/surfaces/{surface_id}/pairs/{pair_id}/ir.wav`: an audible response, slowed down to full scale.

use axum::Extension;
use echolake_schema::messages::SampleFormat;
use echolake_schema::samples::encode_wav;
use echolake_service::RequestFault;
use serde::Deserialize;
use utoipa::IntoParams;

use super::super::extract::{BinaryContent, PathParams, QueryParams, WholeNumber};
use super::content::{AnswerContent, EndpointAnswer};
use super::pair::{PairPath, ResponseSignal};
use super::request::CatalogueRequest;

/// The signal and the pitch of a response that is heard.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct WavQuery {
    #[param(inline)]
    signal: ResponseSignal,
    #[param(inline)]
    slowdown: Option<WholeNumber<1, 100, 1>>,
}

/// The response as 32-bit float WAV.
///
/// The rate in its header is the rig's divided by `slowdown`. By default it is that of full scale: the rig's divided by
/// its scale, or undivided if the rig does not say its scale.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/pairs/{pair_id}/ir.wav",
    tag = "catalogue",
    params(PairPath, WavQuery),
    responses((status = 200, description = "OK", body = inline(BinaryContent), content_type = "audio/wav")),
    extensions(("x-sql" = json!(["as of pair"])))
)]
pub(super) async fn wav(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<PairPath>,
    QueryParams(query): QueryParams<WavQuery>,
) -> EndpointAnswer {
    let entry = request.find_surface(&path.surface_id).await?;
    let pair = request.parse_pair(&path.pair_id)?;
    let samples = query.signal.read_samples(&request, entry, pair).await?;
    let rig = request.catalogue.lake().rig();
    let slowdown = query.slowdown.map_or_else(|| rig.known_scale().unwrap_or(1.0), |slowdown| slowdown.get() as f64);
    let rate_hz = rig.sweep.rate_hz.get() / slowdown;
    let bytes: Vec<u8> = samples.iter().flat_map(|sample| sample.to_le_bytes()).collect();
    let file = encode_wav(SampleFormat::F32le, rate_hz.round() as u32, &[&bytes]);
    let file = file.map_err(RequestFault::defect("a response makes no WAV file"))?;
    let name = format!("{}-{pair}-{}.wav", entry.surface.surface_id, query.signal.name());
    Ok(AnswerContent::new("audio/wav", file).with_name(name))
}
