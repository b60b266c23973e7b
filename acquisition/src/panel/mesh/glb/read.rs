//! Reads the meshes of a GLB file's scene.

#[cfg(test)]
mod tests;

use std::path::Path;

use serde_json::Value;

use super::accessor::{GlbFile, list};
use super::scene::{MeshInstance, SceneFault, instances};
use super::{BIN_CHUNK, JSON_CHUNK, MAGIC, from_gltf};
use crate::panel::mesh::{Error, Mesh};

/// Most vertices, and most triangles, that a scene may have once its instances are made. Accessors and meshes are
/// shared, so a small file can ask for any number; a panel with a vertex every 0.5 mm on both sides has 2.7 million
/// vertices and 5.5 million triangles.
const MOST: usize = 6_000_000;
/// Most characters of a buffer's URI in a message: it may be all of the buffer's bytes.
const MOST_SHOWN: usize = 60;
/// As messages say it.
const AT_MOST: &str = "up to 6 million vertices and as many triangles in all instances";

/// Extensions that change how a mesh looks and not its shape. A file that requires another is refused.
const APPEARANCE: [&str; 3] = ["KHR_materials_", "KHR_texture_", "EXT_texture_"];
/// An extension that makes instances of a node, which files may have without requiring it.
const INSTANCING: &str = "EXT_mesh_gpu_instancing";

/// Reads positions and triangles of every mesh in the file's scene, each transformed by its nodes.
pub(crate) fn parse(bytes: &[u8], path: &Path) -> Result<Mesh, Error> {
    read(bytes).map_err(|SceneFault { place, actual, expected }| Error::Syntax {
        path: path.to_owned(),
        place,
        actual,
        expected,
    })
}

fn wrong(place: impl Into<String>, actual: impl Into<String>, expected: &'static str) -> SceneFault {
    SceneFault { place: place.into(), actual: actual.into(), expected }
}

fn read(bytes: &[u8]) -> Result<Mesh, SceneFault> {
    let file = open(bytes)?;
    check_features(&file.document)?;
    let mut mesh = Mesh::default();
    for instance in instances(&file.document)? {
        let primitives = list(&file.document["meshes"][instance.mesh]["primitives"]);
        for (number, primitive) in primitives.iter().enumerate() {
            append(&mut mesh, &file, &instance, primitive).map_err(|(actual, expected)| {
                wrong(format!("mesh {}, primitive {number}", instance.mesh), actual, expected)
            })?;
        }
    }
    Ok(mesh)
}

// The chunks of the file: its JSON, and its numbers, if any.
fn open(bytes: &[u8]) -> Result<GlbFile<'_>, SceneFault> {
    let word = |at: usize| Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?) as usize);
    if bytes.get(..4) != Some(MAGIC) || word(4) != Some(2) {
        return Err(wrong("byte 0", "no glTF 2.0 header", "`glTF` and version 2"));
    }
    if word(8) != Some(bytes.len()) {
        let actual = format!("a length that is not the file's {} bytes", bytes.len());
        return Err(wrong("byte 8", actual, "the file's length"));
    }
    let chunk = |at: usize, kind: u32| -> Option<&[u8]> {
        (word(at + 4)? == kind as usize).then(|| bytes.get(at + 8..at + 8 + word(at)?)).flatten()
    };
    let text = chunk(12, JSON_CHUNK).ok_or_else(|| wrong("byte 12", "no JSON chunk", "a JSON chunk"))?;
    let bin = chunk(20 + text.len(), BIN_CHUNK).unwrap_or(&[]);
    let document = serde_json::from_slice(text).map_err(|e| wrong("its JSON", e.to_string(), "valid JSON"))?;
    Ok(GlbFile { document, bin })
}

// Refuses what would be read as another shape than the file's.
fn check_features(document: &Value) -> Result<(), SceneFault> {
    for extension in list(&document["extensionsRequired"]) {
        let name = extension.as_str().unwrap_or_default();
        if !APPEARANCE.iter().any(|prefix| name.starts_with(prefix)) {
            let expected = "meshes that need no extension; hint: export it without compression and instances";
            return Err(wrong("`extensionsRequired`", extension.to_string(), expected));
        }
    }
    let has_instances = |node: &Value| !node["extensions"][INSTANCING].is_null();
    if let Some(node) = list(&document["nodes"]).iter().position(has_instances) {
        let expected = "one mesh a node; hint: export instances as meshes of their own";
        return Err(wrong(format!("node {node}"), format!("the extension {INSTANCING}"), expected));
    }
    match &document["buffers"][0]["uri"] {
        Value::Null => Ok(()),
        uri => {
            let shown: String = uri.to_string().chars().take(MOST_SHOWN).collect();
            let expected = "the file's own binary chunk; hint: export it as one GLB file";
            Err(wrong("buffer 0", format!("the uri {shown}"), expected))
        }
    }
}

// Adds a primitive with its node's transform; an error has the actual and the expected content.
fn append(
    mesh: &mut Mesh,
    file: &GlbFile<'_>,
    instance: &MeshInstance,
    primitive: &Value,
) -> Result<(), (String, &'static str)> {
    const PLAIN: &str = "plain f32 positions and whole-numbered triangle indices";
    let mode = &primitive["mode"];
    if !mode.is_null() && mode.as_u64() != Some(4) {
        return Err((format!("mode {mode}"), "triangles"));
    }
    let (positions, indices) = (&primitive["attributes"]["POSITION"], &primitive["indices"]);
    // Counted before anything is made of it.
    let count = file.count(positions).ok_or_else(|| ("no readable positions".to_owned(), PLAIN))?;
    let corners = if indices.is_null() { Some(count) } else { file.count(indices) };
    let corners = corners.ok_or_else(|| ("no readable indices".to_owned(), PLAIN))?;
    let vertices = mesh.vertices_mm.len().saturating_add(count);
    let triangles = mesh.triangles.len().saturating_add(corners / 3);
    if vertices.max(triangles) > MOST {
        return Err((format!("with all before it {vertices} vertices and {triangles} triangles"), AT_MOST));
    }
    let positions = file.positions(positions).ok_or_else(|| ("no readable positions".to_owned(), PLAIN))?;
    let indices = match indices {
        Value::Null => (0..count as u32).collect(),
        accessor => file.indices(accessor).ok_or_else(|| ("no readable indices".to_owned(), PLAIN))?,
    };
    if !indices.len().is_multiple_of(3) {
        return Err((format!("{} corners", indices.len()), "three for each triangle"));
    }
    if let Some(index) = indices.iter().find(|i| **i as usize >= count) {
        return Err((format!("vertex {index}"), "one of its own vertices"));
    }
    let first = mesh.vertices_mm.len() as u32;
    mesh.vertices_mm.extend(positions.into_iter().map(|p| from_gltf(instance.transform.apply(p))));
    let mirrors = instance.transform.mirrors();
    let triangles = indices.chunks_exact(3).map(|t| if mirrors { [t[0], t[2], t[1]] } else { [t[0], t[1], t[2]] });
    mesh.triangles.extend(triangles.map(|t| t.map(|i| first + i)));
    Ok(())
}
