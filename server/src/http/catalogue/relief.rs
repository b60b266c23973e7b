//! A surface's relief: heights, a picture, and the mesh of its run's file.

use echolake_dsp::{heights, png};
use serde::Deserialize;

use super::asked::{CatalogueRequest, missing, run, text};
use super::content::AnswerContent;
use crate::fault::RequestFault;

#[derive(Deserialize)]
struct HeightmapRow {
    cells: usize,
    size_mm: f32,
    heights_mm: Vec<f32>,
}

const HEIGHTS: &str = "select cells, size_mm, heights_mm from heightmaps \
    where surface_id = $1 and symmetry = 'identity' order by run_id desc limit 1";

async fn read(asked: &CatalogueRequest) -> Result<HeightmapRow, RequestFault> {
    let id = &asked.surface().await?.surface.surface_id;
    let rows: Vec<HeightmapRow> = asked.rows(HEIGHTS, vec![text(id)]).await?;
    let found = rows.into_iter().next().filter(|row| row.cells > 0 && row.heights_mm.len() == row.cells * row.cells);
    let hint = "its run came without a mesh";
    found.ok_or_else(|| RequestFault::NoData { what: format!("surface `{id}`"), data: "height map", hint })
}

/// Heights in mm, little-endian f32, row by row, y ascending.
pub(super) async fn heightmap(asked: CatalogueRequest) -> Result<AnswerContent, RequestFault> {
    let heights = read(&asked).await?.heights_mm;
    let bytes: Vec<u8> = heights.iter().flat_map(|h| h.to_le_bytes()).collect();
    Ok(AnswerContent::new("application/octet-stream", bytes))
}

/// The relief in oblique light, the same for all surfaces.
pub(super) async fn thumbnail(asked: CatalogueRequest) -> Result<AnswerContent, RequestFault> {
    let row = read(&asked).await?;
    let pixels = heights::shaded(&row.heights_mm, row.size_mm / row.cells as f32).map_err(|e| {
        eprintln!("a height map makes no picture: {e}");
        RequestFault::Internal
    })?;
    Ok(AnswerContent::new("image/png", png::grey(&pixels, row.cells)))
}

/// The panel's mesh as the run's file holds it.
pub(super) async fn mesh(asked: CatalogueRequest) -> Result<AnswerContent, RequestFault> {
    let surface = &asked.surface().await?.surface;
    let id = &surface.surface_id;
    let run =
        surface.run_id.as_deref().ok_or_else(|| missing(format!("a run of surface `{id}`"), "it is a reference"))?;
    let (session, visible) = (asked.view.session.clone(), run_of(&asked, run)?);
    let read = async move { Ok(session.attachment(&visible, ".glb").await?) };
    let bytes = asked.catalogue.service().plan(asked.view.session.client(), read).await?;
    let hint = "its run came without one; the height map may be there";
    let bytes = bytes.ok_or_else(|| RequestFault::NoData { what: format!("surface `{id}`"), data: "GLB", hint })?;
    Ok(AnswerContent::new("model/gltf-binary", bytes).named(format!("{id}.glb")))
}

fn run_of(asked: &CatalogueRequest, name: &str) -> Result<echolake_lake::VisibleRun, RequestFault> {
    run(&asked.view, name).cloned()
}
