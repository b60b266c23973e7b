//! A surface's relief: heights, a picture, and the mesh of its run's file. A surface without one, as a room, has the
//! decay of its first response for a picture.

use axum::Extension;
use echolake_dsp::heights;
use echolake_dsp::level::plotted_power_to_db;
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

const FIRST_RESPONSE: &str =
    "select ir from measurements where surface_id = $1 and run_id = $2 order by pair_id limit 1";

/// Width and height of the picture of a decay.
const DECAY_SIDE: usize = 128;
/// Levels that it shows, below the highest.
const DECAY_RANGE_DB: f64 = 60.0;
/// Greys of its paper and of its curve.
const DECAY_GREYS: [u8; 2] = [232, 96];

async fn read_heightmap(request: &CatalogueRequest, surface: &str) -> Result<Option<HeightmapRow>, RequestFault> {
    let rows: Vec<HeightmapRow> = request.read_rows(HEIGHTS, vec![text_value(surface)]).await?;
    Ok(rows.into_iter().next().filter(|row| row.cells > 0 && row.heights_mm.len() == row.cells * row.cells))
}

#[derive(Deserialize)]
struct FirstResponse {
    ir: Vec<f32>,
}

/// Draws the level of a response's samples over the part that is louder than the range below its highest level. Paper
/// alone if there is no sound.
///
/// returns  `[DECAY_SIDE x DECAY_SIDE]`  grey, rows from the top
fn draw_decay(ir: &[f32]) -> Vec<u8> {
    let [paper, ink] = DECAY_GREYS;
    let mut pixels = vec![paper; DECAY_SIDE * DECAY_SIDE];
    let highest = ir.iter().fold(0.0f32, |most, x| most.max(x.abs()));
    if highest == 0.0 {
        return pixels;
    }
    let levels: Vec<f64> = ir.iter().map(|x| plotted_power_to_db(f64::from(x / highest).powi(2))).collect();
    let is_loud = |level: &f64| *level > -DECAY_RANGE_DB;
    let first = levels.iter().position(is_loud).unwrap_or(0);
    let last = levels.iter().rposition(is_loud).unwrap_or(first);
    let shown = &levels[first..=last];
    for column in 0..DECAY_SIDE {
        let from = column * shown.len() / DECAY_SIDE;
        let to = ((column + 1) * shown.len() / DECAY_SIDE).max(from + 1);
        let level = shown[from..to].iter().copied().fold(-DECAY_RANGE_DB, f64::max);
        let height = ((1.0 + level / DECAY_RANGE_DB) * DECAY_SIDE as f64).round() as usize;
        for row in DECAY_SIDE - height.min(DECAY_SIDE)..DECAY_SIDE {
            pixels[row * DECAY_SIDE + column] = ink;
        }
    }
    pixels
}

/// Heights in mm as little-endian f32, row by row.
///
/// A side has as many cells as the square root of their number. y ascends.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/heightmap",
    tag = "catalogue",
    params(SurfacePath),
    responses(
        (status = 200, description = "OK", body = inline(BinaryContent), content_type = "application/octet-stream")
    ),
    extensions(("x-sql" = json!([
        "select cells, heights_mm from heightmaps where surface_id = $1 and symmetry = 'identity'",
    ])))
)]
pub(super) async fn heightmap(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<SurfacePath>,
) -> EndpointAnswer {
    let id = &request.find_surface(&path.surface_id).await?.surface.surface_id;
    let missing = || RequestFault::NoData {
        what: format!("surface `{id}`"),
        data: "height map",
        hint: "its run came without a mesh",
    };
    let row = read_heightmap(&request, id).await?.ok_or_else(missing)?;
    let bytes: Vec<u8> = row.heights_mm.iter().flat_map(|h| h.to_le_bytes()).collect();
    Ok(AnswerContent::new("application/octet-stream", bytes))
}

/// The relief in oblique light, grey, as many pixels as the height map has cells.
///
/// To scale in depth: one light for all surfaces. Of a surface without a height map, the level of its first response
/// over time, 128 x 128: 60 dB from bottom to top. Without a response, paper.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/thumbnail.png",
    tag = "catalogue",
    params(SurfacePath),
    responses((status = 200, description = "OK", body = inline(BinaryContent), content_type = "image/png")),
    extensions(("x-sql" = json!([
        "as of heightmap",
        "select ir from measurements where surface_id = $1 and run_id = $run order by pair_id limit 1",
    ])))
)]
pub(super) async fn thumbnail(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<SurfacePath>,
) -> EndpointAnswer {
    let surface = &request.find_surface(&path.surface_id).await?.surface;
    let id = &surface.surface_id;
    let (pixels, width) = match (read_heightmap(&request, id).await?, &surface.run_id) {
        (Some(row), _) => {
            let pixels = heights::shade_heights(&row.heights_mm, row.size_mm / row.cells as f32);
            (pixels.map_err(RequestFault::defect("a height map makes no picture"))?, row.cells)
        }
        (None, Some(run)) => {
            let values = vec![text_value(id), text_value(run)];
            let rows: Vec<FirstResponse> = request.read_rows(FIRST_RESPONSE, values).await?;
            (draw_decay(rows.first().map_or(&[], |row| &row.ir)), DECAY_SIDE)
        }
        (None, None) => (draw_decay(&[]), DECAY_SIDE),
    };
    let file = encode_grey_png(&pixels, width).map_err(RequestFault::defect("a surface has no picture"))?;
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

#[cfg(test)]
mod tests {
    use super::*;

    // 60 dB in 1000 samples: a straight line from the upper left corner to the lower right one.
    #[test]
    fn a_decay_is_drawn_as_a_slope() {
        let mut ir: Vec<f32> = (0..4000).map(|n| 10f32.powf(-3.0 * n as f32 / 1000.0)).collect();
        ir.iter_mut().skip(1).step_by(2).for_each(|x| *x = -*x);
        let pixels = draw_decay(&ir);
        let tall = |column: usize| (0..DECAY_SIDE).filter(|row| pixels[row * DECAY_SIDE + column] == 96).count();
        for (column, expected) in [(0, 128), (32, 96), (64, 64), (96, 32), (127, 1)] {
            assert!(tall(column).abs_diff(expected) <= 2, "{column}: {}", tall(column));
        }
        for silent in [&[][..], &[0.0; 9]] {
            assert!(draw_decay(silent).iter().all(|grey| *grey == 232));
        }
    }
}
