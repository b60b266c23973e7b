//! GLB: glTF 2.0 in one binary file, metres, Y up.

use std::path::Path;

use serde_json::{Value, json};

use super::{Error, Mesh};

const MAGIC: &[u8; 4] = b"glTF";
const JSON_CHUNK: u32 = 0x4E4F_534A;
const BIN_CHUNK: u32 = 0x004E_4942;

/// Component types and targets of glTF 2.0.
const UNSIGNED_BYTE: u64 = 5121;
const UNSIGNED_SHORT: u64 = 5123;
const UNSIGNED_INT: u64 = 5125;
const FLOAT: u64 = 5126;
const ARRAY_BUFFER: u64 = 34962;
const ELEMENT_ARRAY_BUFFER: u64 = 34963;

/// The mesh as a GLB file: positions, normals, indices.
pub(super) fn write(mesh: &Mesh) -> Vec<u8> {
    let positions: Vec<[f32; 3]> = mesh.vertices_mm.iter().map(|v| to_gltf(*v)).collect();
    let normals = normals(mesh);
    let count = positions.len();
    let bound =
        |f: fn(f32, f32) -> f32, start: f32| positions.iter().fold([start; 3], |m, p| [0, 1, 2].map(|i| f(m[i], p[i])));
    let mut bin = Vec::with_capacity(count * 24 + mesh.triangles.len() * 12);
    bin.extend(positions.iter().chain(&normals).flatten().flat_map(|x| x.to_le_bytes()));
    bin.extend(mesh.triangles.iter().flatten().flat_map(|i| i.to_le_bytes()));
    let indices = mesh.triangles.len() * 3;
    let document = json!({
        "asset": { "version": "2.0", "generator": concat!("echolake ", env!("CARGO_PKG_VERSION")) },
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0, "name": "panel" }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0, "NORMAL": 1 }, "indices": 2, "material": 0 }] }],
        "materials": [{ "pbrMetallicRoughness": { "baseColorFactor": [0.8, 0.78, 0.74, 1.0], "metallicFactor": 0.0 } }],
        "accessors": [
            { "bufferView": 0, "componentType": FLOAT, "count": count, "type": "VEC3",
              "min": bound(f32::min, f32::INFINITY), "max": bound(f32::max, f32::NEG_INFINITY) },
            { "bufferView": 1, "componentType": FLOAT, "count": count, "type": "VEC3" },
            { "bufferView": 2, "componentType": UNSIGNED_INT, "count": indices, "type": "SCALAR" },
        ],
        "bufferViews": [
            { "buffer": 0, "byteOffset": 0, "byteLength": count * 12, "target": ARRAY_BUFFER },
            { "buffer": 0, "byteOffset": count * 12, "byteLength": count * 12, "target": ARRAY_BUFFER },
            { "buffer": 0, "byteOffset": count * 24, "byteLength": indices * 4, "target": ELEMENT_ARRAY_BUFFER },
        ],
        "buffers": [{ "byteLength": bin.len() }],
    });
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut file = Vec::with_capacity(text.len() + bin.len() + 28);
    file.extend_from_slice(MAGIC);
    file.extend(2u32.to_le_bytes());
    file.extend(((12 + 8 + text.len() + 8 + bin.len()) as u32).to_le_bytes());
    for (kind, body) in [(JSON_CHUNK, &text), (BIN_CHUNK, &bin)] {
        file.extend((body.len() as u32).to_le_bytes());
        file.extend(kind.to_le_bytes());
        file.extend_from_slice(body);
    }
    file
}

fn to_gltf([x, y, z]: [f32; 3]) -> [f32; 3] {
    [x / 1e3, z / 1e3, -y / 1e3]
}

fn from_gltf([x, y, z]: [f32; 3]) -> [f32; 3] {
    [x * 1e3, -z * 1e3, y * 1e3]
}

// Each vertex's normal is the mean of its triangles' by area.
fn normals(mesh: &Mesh) -> Vec<[f32; 3]> {
    let mut sums = vec![[0.0f32; 3]; mesh.vertices_mm.len()];
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|i| mesh.vertices_mm[i as usize]);
        let (u, v) = ([0, 1, 2].map(|i| b[i] - a[i]), [0, 1, 2].map(|i| c[i] - a[i]));
        let cross = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        for i in triangle {
            (0..3).for_each(|k| sums[*i as usize][k] += cross[k]);
        }
    }
    let unit = |n: [f32; 3]| {
        let length = n.iter().map(|x| x * x).sum::<f32>().sqrt();
        let [x, y, z] = if length > 0.0 { n.map(|x| x / length) } else { [0.0, 0.0, 1.0] };
        [x, z, -y]
    };
    sums.into_iter().map(unit).collect()
}

/// Reads positions and triangles of every mesh in the file. Transforms of nodes are not applied.
pub(super) fn parse(bytes: &[u8], path: &Path) -> Result<Mesh, Error> {
    let wrong = |place: &str, actual: String, expected: &'static str| Error::Syntax {
        path: path.to_owned(),
        place: place.to_owned(),
        actual,
        expected,
    };
    let word = |at: usize| Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?) as usize);
    if bytes.get(..4) != Some(MAGIC) || word(4) != Some(2) {
        return Err(wrong("byte 0", "no glTF 2.0 header".into(), "`glTF` and version 2"));
    }
    if word(8) != Some(bytes.len()) {
        return Err(wrong(
            "byte 8",
            format!("a length that is not the file's {} bytes", bytes.len()),
            "the file's length",
        ));
    }
    let chunk = |at: usize, kind: u32| -> Option<&[u8]> {
        (word(at + 4)? == kind as usize).then(|| bytes.get(at + 8..at + 8 + word(at)?)).flatten()
    };
    let text = chunk(12, JSON_CHUNK).ok_or_else(|| wrong("byte 12", "no JSON chunk".into(), "a JSON chunk"))?;
    let bin = chunk(20 + text.len(), BIN_CHUNK).unwrap_or(&[]);
    let document: Value = serde_json::from_slice(text).map_err(|e| wrong("its JSON", e.to_string(), "valid JSON"))?;
    let file = File { document, bin };
    let mut mesh = Mesh::default();
    let primitives = file.list(&file.document["meshes"]).iter().flat_map(|m| file.list(&m["primitives"]));
    for primitive in primitives {
        let missing =
            |what: &str| wrong("a primitive", format!("no readable {what}"), "plain positions and triangle indices");
        if primitive["mode"].as_u64().unwrap_or(4) != 4 {
            return Err(wrong("a primitive", format!("mode {}", primitive["mode"]), "triangles"));
        }
        let first = mesh.vertices_mm.len() as u32;
        let positions = file.positions(&primitive["attributes"]["POSITION"]).ok_or_else(|| missing("positions"))?;
        let count = positions.len() as u32;
        mesh.vertices_mm.extend(positions.into_iter().map(from_gltf));
        let indices = match &primitive["indices"] {
            Value::Null => (0..count).collect(),
            accessor => file.indices(accessor).ok_or_else(|| missing("indices"))?,
        };
        let triangles = indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]].map(|i| first.saturating_add(i)));
        mesh.triangles.extend(triangles);
    }
    Ok(mesh)
}

struct File<'a> {
    document: Value,
    bin: &'a [u8],
}

impl File<'_> {
    fn list<'v>(&self, value: &'v Value) -> &'v [Value] {
        value.as_array().map_or(&[], Vec::as_slice)
    }

    fn positions(&self, accessor: &Value) -> Option<Vec<[f32; 3]>> {
        let (kind, elements) = self.elements(accessor, "VEC3", 3)?;
        let float = |b: &[u8]| Some(f32::from_le_bytes(b.try_into().ok()?));
        (kind == FLOAT).then_some(())?;
        elements.into_iter().map(|e| Some([float(&e[..4])?, float(&e[4..8])?, float(&e[8..12])?])).collect()
    }

    fn indices(&self, accessor: &Value) -> Option<Vec<u32>> {
        let (_, elements) = self.elements(accessor, "SCALAR", 1)?;
        let int = |e: &[u8]| e.iter().rev().fold(0, |n, b| n << 8 | u32::from(*b));
        Some(elements.into_iter().map(int).collect())
    }

    // The bytes of each element; None where the accessor leads out of the file.
    fn elements(&self, accessor: &Value, shape: &str, width: usize) -> Option<(u64, Vec<&[u8]>)> {
        let number = |v: &Value| v.as_u64().and_then(|n| usize::try_from(n).ok());
        let accessor = self.list(&self.document["accessors"]).get(number(accessor)?)?;
        let view = self.list(&self.document["bufferViews"]).get(number(&accessor["bufferView"])?)?;
        let kind = accessor["componentType"].as_u64()?;
        let size = match kind {
            FLOAT | UNSIGNED_INT => 4,
            UNSIGNED_SHORT => 2,
            UNSIGNED_BYTE => 1,
            _ => return None,
        } * width;
        if accessor["type"] != shape || number(&view["buffer"])? != 0 {
            return None;
        }
        let start = number(&view["byteOffset"]).unwrap_or(0);
        let view_bytes = self.bin.get(start..start.checked_add(number(&view["byteLength"])?)?)?;
        let stride = number(&view["byteStride"]).unwrap_or(size).max(size);
        let from = view_bytes.get(number(&accessor["byteOffset"]).unwrap_or(0)..)?;
        let count = number(&accessor["count"])?;
        let needed = count.checked_sub(1).map_or(Some(0), |n| n.checked_mul(stride)?.checked_add(size))?;
        (needed <= from.len()).then(|| (kind, (0..count).map(|i| &from[i * stride..i * stride + size]).collect()))
    }
}
