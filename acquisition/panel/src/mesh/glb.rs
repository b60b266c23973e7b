//! GLB: glTF 2.0 in one binary file, metres, Y up.

mod read;

pub(super) use read::parse;

use gltf::Glb;
use gltf::binary::Header;
use serde_json::json;

use super::Mesh;

/// Component types and targets of glTF 2.0.
const UNSIGNED_INT: u64 = 5125;
const FLOAT: u64 = 5126;
const ARRAY_BUFFER: u64 = 34962;
const ELEMENT_ARRAY_BUFFER: u64 = 34963;

/// The mesh as a GLB file: positions, normals, indices.
pub(super) fn write_glb(mesh: &Mesh) -> Vec<u8> {
    let positions: Vec<[f32; 3]> = mesh.vertices_mm.iter().map(|v| to_gltf(*v)).collect();
    let normals = vertex_normals(mesh);
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
    pack_glb(document.to_string().into_bytes(), bin)
}

// The crate writes the header's version and length itself.
fn pack_glb(json: Vec<u8>, bin: Vec<u8>) -> Vec<u8> {
    let header = Header { magic: *b"glTF", version: 2, length: 0 };
    let mut file = Vec::with_capacity(json.len() + bin.len() + 32);
    // A vector takes all bytes.
    let _ = Glb { header, json: json.into(), bin: Some(bin.into()) }.to_writer(&mut file);
    file
}

fn to_gltf([x, y, z]: [f32; 3]) -> [f32; 3] {
    [x / 1e3, z / 1e3, -y / 1e3]
}

fn from_gltf([x, y, z]: [f32; 3]) -> [f32; 3] {
    [x * 1e3, -z * 1e3, y * 1e3]
}

// Each vertex's normal is the mean of its triangles' by area.
fn vertex_normals(mesh: &Mesh) -> Vec<[f32; 3]> {
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
