//! A surface's relief: heights, a picture, and the mesh of its run's file.

use axum::Extension;
use echolake_dsp::heights;
use echolake_figures::encode_grey_png;
use echolake_service::RequestFault;
use serde::Deserialize;

use super::super::extract::{BinaryContent, PathParams};
use super::content::{AnswerContent, EndpointAnswer};
use super::request::{CatalogueRequest, SurfacePath, missing_item, text_value};

#[derive(Deserialize)]
struct HeightmapRow {
    cells: usize,
    size_mm: f32,
    heights_mm: Vec<f32>,
}

const HEIGHTS: &str = "select cells, size_mm, heights_mm from heightmaps \
    where surface_id = $1 and symmetry = 'identity' order by run_id desc limit 1";

async fn read_heightmap(request: &CatalogueRequest, path: &SurfacePath) -> Result<HeightmapRow, RequestFault> {
    let id = &request.find_surface(&path.surface_id).await?.surface.surface_id;
    let rows: Vec<HeightmapRow> = request.read_rows(HEIGHTS, vec![text_value(id)]).await?;
    let found = rows.into_iter().next().filter(|row| row.cells > 0 && row.heights_mm.len() == row.cells * row.cells);
    let hint = "its run came without a mesh";
    found.ok_or_else(|| RequestFault::NoData { what: format!("surface `{id}`"), data: "height map", hint })
}

/// Heights in mm as little-endian f32, row by row.
///
/// A side has as many cells as the square root of their number. y ascends.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/heightmap",
    tag = "catalogue",
    params(SurfacePath),
    responses((status = 200, description = "OK", body = inline(BinaryContent), content_type = "application/octet-stream")),
    extensions(("x-sql" = json!([
        "select cells, heights_mm from heightmaps where surface_id = $1 and symmetry = 'identity'",
    ])))
)]
pub(super) async fn heightmap(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<SurfacePath>,
) -> EndpointAnswer {
    let heights = read_heightmap(&request, &path).await?.heights_mm;
    let bytes: Vec<u8> = heights.iter().flat_map(|h| h.to_le_bytes()).collect();
    Ok(AnswerContent::new("application/octet-stream", bytes))
}

/// The relief in oblique light, grey, 128 x 128.
///
/// To scale in depth: one light for all surfaces.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/thumbnail.png",
    tag = "catalogue",
    params(SurfacePath),
    responses((status = 200, description = "OK", body = inline(BinaryContent), content_type = "image/png")),
    extensions(("x-sql" = json!(["as of heightmap"])))
)]
pub(super) async fn thumbnail(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<SurfacePath>,
) -> EndpointAnswer {
    let row = read_heightmap(&request, &path).await?;
    let pixels = heights::shade_heights(&row.heights_mm, row.size_mm / row.cells as f32)
        .map_err(RequestFault::defect("a height map makes no picture"))?;
    let file = encode_grey_png(&pixels, row.cells).map_err(RequestFault::defect("a height map makes no picture"))?;
    Ok(AnswerContent::new("image/png", file))
}

/// The panel's mesh as the run file holds it.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/mesh.glb",
    tag = "catalogue",
    params(SurfacePath),
    responses((status = 200, description = "OK", body = inline(BinaryContent), content_type = "model/gltf-binary")),
    extensions(("x-sql" = json!([
        "select file from runs where run_id = (select run_id from surfaces where surface_id = $1); attachment of the \
         run file",
    ])))
)]
pub(super) async fn mesh(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<SurfacePath>,
) -> EndpointAnswer {
    let surface = &request.find_surface(&path.surface_id).await?.surface;
    let id = &surface.surface_id;
    let run = surface
        .run_id
        .as_deref()
        .ok_or_else(|| missing_item(format!("a run of surface `{id}`"), "it is a reference"))?;
    let session = request.view.session.clone();
    let visible = request.find_run(run)?.clone();
    let read = async move { Ok(session.read_attachment(&visible, ".glb").await?) };
    let bytes = request.catalogue.service().plan_query(request.view.session.client(), read).await?;
    let hint = "its run came without one; the height map may be there";
    let bytes = bytes.ok_or_else(|| RequestFault::NoData { what: format!("surface `{id}`"), data: "GLB", hint })?;
    Ok(AnswerContent::new("model/gltf-binary", bytes).with_name(format!("{id}.glb")))
}
