//! `GET /api/v1/lake`: what the lake holds, its rig, bands and grid.

use axum::Extension;
use echolake_service::TokenScope;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::AnswerContents;
use super::content::{AnswerContent, EndpointAnswer};
use super::request::CatalogueRequest;
use super::snapshot::bands::{BandDescription, describe_bands};

/// The lake.
#[derive(Serialize, ToSchema)]
#[schema(as = Lake)]
struct LakeDescription<'a> {
    name: &'a str,
    /// Changes with every snapshot; also the ETag of what is computed from it.
    version: &'a str,
    software: &'static str,
    bands: Vec<BandDescription>,
    rate_hz: f64,
    low_hz: f64,
    high_hz: f64,
    /// Full size over the size that is measured: 10 of models at 1:10. Null if the rig does not say it.
    scale: Option<f64>,
    ir_length: usize,
    reference_temperature_c: f64,
    /// Division of the spectra at the limits of `low_hz` and `high_hz`: `tapered`, `floored` or `literal`.
    division: &'static str,
    /// Direct sound that is subtracted: `foam`, or `estimated` without Foam's own reflection.
    direct_sound: &'static str,
    panel_size_mm: f64,
    panel_depth_mm: f64,
    layers: i32,
    points: Vec<GridPoint>,
    counts: LakeCounts,
    /// Every surface comes from the simulated rig, or is computed for the heights of one.
    simulated: bool,
    /// Some surface has levels against its Flat. In a lake of rooms none has.
    has_levels: bool,
    /// The client's token is for adding annotations.
    may_annotate: bool,
    /// Runs on which verdicts came since the last ingest: levels do not follow them yet. Null if annotations cannot be
    /// read.
    unfollowed_runs: Option<usize>,
}

/// A point of the grid.
#[derive(Deserialize, Serialize, ToSchema)]
#[schema(as = Point)]
struct GridPoint {
    point_id: i32,
    layer: i32,
    gridx: i32,
    gridy: i32,
    x_mm: f64,
    y_mm: f64,
    z_mm: f64,
}

/// Numbers of what the lake holds.
#[derive(Serialize, ToSchema)]
struct LakeCounts {
    surfaces: usize,
    runs: i64,
    measurements: i64,
    pairs: usize,
}

#[derive(Deserialize)]
struct RunTotals {
    runs: i64,
    measurements: Option<i64>,
}

/// The contents of the lake, its rig, bands and grid.
#[utoipa::path(
    get,
    path = "/api/v1/lake",
    tag = "catalogue",
    responses((status = 200, description = "OK", body = LakeDescription)),
    extensions(("x-sql" = json!([
        "select * from points order by point_id",
        "select count(*) from surfaces",
        "select count(*), sum(measurements) from runs",
        "lake.toml for the rig",
    ])))
)]
pub(super) async fn lake(Extension(request): Extension<CatalogueRequest>) -> EndpointAnswer {
    let lake = request.catalogue.lake();
    let rig = lake.rig();
    let points: Vec<GridPoint> = request
        .read_rows("select point_id, layer, gridx, gridy, x_mm, y_mm, z_mm from points order by point_id", Vec::new())
        .await?;
    let runs: Vec<RunTotals> = request
        .read_rows("select count(*) as runs, cast(sum(measurements) as bigint) as measurements from runs", Vec::new())
        .await?;
    let summary = request.read_summary().await?;
    let counts = LakeCounts {
        surfaces: summary.entries.len(),
        runs: runs.first().map_or(0, |r| r.runs),
        measurements: runs.first().and_then(|r| r.measurements).unwrap_or(0),
        pairs: lake.grid().pairs().len(),
    };
    Ok(AnswerContent::encode_json(&LakeDescription {
        name: lake_name(lake.location()),
        version: &request.view.content_version(AnswerContents::Contributions),
        software: concat!("echolake ", env!("CARGO_PKG_VERSION")),
        bands: describe_bands(rig),
        rate_hz: rig.sweep.rate_hz.get(),
        low_hz: rig.sweep.low_hz,
        high_hz: rig.sweep.high_hz,
        scale: rig.known_scale(),
        ir_length: rig.impulse_response.length,
        reference_temperature_c: rig.impulse_response.reference_temperature_c.get(),
        division: rig.impulse_response.division.name(),
        direct_sound: lake.config().references.direct_sound.name(),
        panel_size_mm: rig.panel.size_mm,
        panel_depth_mm: rig.panel.depth_mm,
        layers: points.iter().map(|p| p.layer + 1).max().unwrap_or(0),
        points,
        counts,
        simulated: !summary.entries.is_empty()
            && summary.entries.iter().all(|e| matches!(e.surface.origin.as_str(), "simulated" | "computed")),
        has_levels: summary.entries.iter().any(|entry| entry.surface.has_levels()),
        may_annotate: request.catalogue.service().has_scope(TokenScope::Annotate),
        // What needs verdicts is refused with the fault; the lake's description is not.
        unfollowed_runs: request.unfollowed_runs(None).await.ok().map(|runs| runs.len()),
    })?)
}

// The lake's path on the server's disk is not disclosed.
fn lake_name(location: &str) -> &str {
    location.split(['/', '\\']).rfind(|part| !part.is_empty()).unwrap_or("lake")
}
