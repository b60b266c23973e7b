//! Reads the meshes of a GLB file's scene.

#[cfg(test)]
mod tests;

use std::collections::HashSet;
use std::path::Path;

use gltf::accessor::{DataType, Dimensions};
use gltf::json::{Root, deserialize};
use gltf::mesh::Mode;
use gltf::{Accessor, Document, Glb, Node, Primitive, Semantic};

use super::from_gltf;
use crate::mesh::{Error, Mesh};

/// Most vertices, and most triangles, that a scene may have once its instances are made. Accessors and meshes are
/// shared, so a small file can ask for any number; a panel with a vertex every 0.5 mm on both sides has 2.7 million
/// vertices and 5.5 million triangles.
const MOST: usize = 6_000_000;
/// [`MOST`] in messages.
const AT_MOST: &str = "up to 6 million vertices and as many triangles in all instances";
/// Most characters of a buffer's URI in a message: it may be all of the buffer's bytes.
const MOST_SHOWN: usize = 60;
/// Accessors that are read.
const PLAIN: &str = "plain f32 positions and whole-numbered triangle indices";
/// Types of indices.
const WHOLE_NUMBERS: [DataType; 3] = [DataType::U8, DataType::U16, DataType::U32];

/// Extensions that change how a mesh looks and not its shape. A file that requires another is refused.
const APPEARANCE: [&str; 3] = ["KHR_materials_", "KHR_texture_", "EXT_texture_"];
/// An extension that makes instances of a node, which files may have without requiring it.
const INSTANCING: &str = "EXT_mesh_gpu_instancing";

/// A transform, column by column.
type Matrix = [[f64; 4]; 4];
const IDENTITY: Matrix = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];

/// The place, the actual and the expected content of [`Error::Syntax`].
type GlbFault = (String, String, &'static str);

/// Reads positions and triangles of every mesh in the file's scene, each transformed by its nodes.
pub(crate) fn parse(bytes: &[u8], path: &Path) -> Result<Mesh, Error> {
    read_scene(bytes).map_err(|(place, actual, expected)| Error::Syntax {
        path: path.to_owned(),
        place,
        actual,
        expected,
    })
}

fn read_scene(bytes: &[u8]) -> Result<Mesh, GlbFault> {
    // The crate takes longer files, and subtracts the header's bytes from a length that may be less.
    let length = bytes.get(8..12).and_then(|b| b.try_into().ok()).map(u32::from_le_bytes);
    if bytes.starts_with(b"glTF") && length.map(|n| n as usize) != Some(bytes.len()) {
        let actual = format!("a length that is not the file's {} bytes", bytes.len());
        return Err(("byte 8".into(), actual, "the file's length"));
    }
    let glb = Glb::from_slice(bytes).map_err(|e| describe_error(&e))?;
    let root = deserialize::from_slice(&glb.json).map_err(|e| describe_error(&gltf::Error::Deserialize(e)))?;
    let document = Document::from_json(check_features(root)?).map_err(|e| describe_error(&e))?;
    let bin = glb.bin.as_deref().unwrap_or_default();
    let mut mesh = Mesh::default();
    // A file without nodes is a library of meshes: each keeps its place.
    if document.nodes().len() == 0 {
        document.meshes().try_for_each(|shape| append_mesh(&mut mesh, &shape, &IDENTITY, bin))?;
    }
    let mut seen = HashSet::new();
    let mut waiting: Vec<_> = root_nodes(&document).into_iter().map(|node| (node, IDENTITY)).collect();
    // A tree has each node once, which ends this whatever the file says, at any depth.
    while let Some((node, parent)) = waiting.pop() {
        if !seen.insert(node.index()) {
            let actual = "a second parent, or itself above it".to_owned();
            return Err((format!("node {}", node.index()), actual, "a tree of nodes"));
        }
        let transform = multiply(&parent, &node.transform().matrix().map(|column| column.map(f64::from)));
        if let Some(shape) = node.mesh() {
            append_mesh(&mut mesh, &shape, &transform, bin)?;
        }
        waiting.extend(node.children().map(|child| (child, transform)));
    }
    Ok(mesh)
}

fn describe_error(error: &gltf::Error) -> GlbFault {
    let (place, actual) = match error {
        gltf::Error::Binary(e) => ("its header or chunks".to_owned(), e.to_string()),
        gltf::Error::Validation(faults) => faults.first().map_or_else(Default::default, |(place, fault)| {
            (format!("its JSON at `{}`", place.as_str()), fault.to_string())
        }),
        other => ("its JSON".to_owned(), other.to_string()),
    };
    (place, format!("\"{actual}\""), "glTF 2.0 in one binary file")
}

// Refuses what would be read as another shape than the file's, and what the crate's validation does not survive.
fn check_features(mut root: Root) -> Result<Root, GlbFault> {
    root.extensions_required.retain(|name| !APPEARANCE.iter().any(|prefix| name.starts_with(prefix)));
    if let Some(name) = root.extensions_required.first() {
        let expected = "meshes that need no extension; hint: export it without compression and instances";
        return Err(("`extensionsRequired`".into(), format!("{name:?}"), expected));
    }
    let instanced = root
        .nodes
        .iter()
        .position(|node| node.extensions.as_ref().is_some_and(|extensions| extensions.others.contains_key(INSTANCING)));
    if let Some(node) = instanced {
        let expected = "one mesh a node; hint: export instances as meshes of their own";
        return Err((format!("node {node}"), format!("the extension {INSTANCING}"), expected));
    }
    if let Some(uri) = root.buffers.first().and_then(|buffer| buffer.uri.as_ref()) {
        let shown: String = uri.chars().take(MOST_SHOWN).collect();
        let expected = "the file's own binary chunk; hint: export it as one GLB file";
        return Err(("buffer 0".into(), format!("the uri {shown:?}"), expected));
    }
    for (number, mesh) in root.meshes.iter().enumerate() {
        let accessors = mesh.primitives.iter().flat_map(|primitive| primitive.attributes.values());
        if let Some(lacking) = accessors.map(|a| a.value()).find(|a| *a >= root.accessors.len()) {
            return Err((format!("mesh {number}"), format!("accessor {lacking}"), "one of the file's accessors"));
        }
    }
    Ok(root)
}

// The nodes of the default scene; without scenes, all that have no parent.
fn root_nodes(document: &Document) -> Vec<Node<'_>> {
    if let Some(scene) = document.default_scene().or_else(|| document.scenes().next()) {
        return scene.nodes().collect();
    }
    let children: HashSet<usize> = document.nodes().flat_map(|node| node.children()).map(|node| node.index()).collect();
    document.nodes().filter(|node| !children.contains(&node.index())).collect()
}

fn multiply(left: &Matrix, right: &Matrix) -> Matrix {
    right.map(|column| [0, 1, 2, 3].map(|row| (0..4).map(|k| left[k][row] * column[k]).sum()))
}

fn apply(transform: &Matrix, point: [f32; 3]) -> [f32; 3] {
    let [x, y, z] = point.map(f64::from);
    let [a, b, c, d] = transform;
    [0, 1, 2].map(|row| (a[row] * x + b[row] * y + c[row] * z + d[row]) as f32)
}

// Returns whether a transform turns the inside of a solid out.
fn mirrors(transform: &Matrix) -> bool {
    let [[a, b, c, _], [d, e, f, _], [g, h, i, _], _] = transform;
    a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0.0
}

fn append_mesh(mesh: &mut Mesh, shape: &gltf::Mesh<'_>, transform: &Matrix, bin: &[u8]) -> Result<(), GlbFault> {
    shape.primitives().try_for_each(|primitive| {
        append_primitive(mesh, &primitive, transform, bin).map_err(|(actual, expected)| {
            (format!("mesh {}, primitive {}", shape.index(), primitive.index()), actual, expected)
        })
    })
}

// An error has the actual and the expected content.
fn append_primitive(
    mesh: &mut Mesh,
    primitive: &Primitive<'_>,
    transform: &Matrix,
    bin: &[u8],
) -> Result<(), (String, &'static str)> {
    if primitive.mode() != Mode::Triangles {
        return Err((format!("mode {:?}", primitive.mode()), "triangles"));
    }
    let positions = primitive
        .get(&Semantic::Positions)
        .filter(|positions| is_readable(positions, Dimensions::Vec3, &[DataType::F32], bin))
        .ok_or_else(|| ("no readable positions".to_owned(), PLAIN))?;
    let indices = primitive.indices();
    if indices.as_ref().is_some_and(|indices| !is_readable(indices, Dimensions::Scalar, &WHOLE_NUMBERS, bin)) {
        return Err(("no readable indices".to_owned(), PLAIN));
    }
    // Counted before anything is made of it.
    let corners = indices.as_ref().unwrap_or(&positions).count();
    let vertices = mesh.vertices_mm.len().saturating_add(positions.count());
    let triangles = mesh.triangles.len().saturating_add(corners / 3);
    if vertices.max(triangles) > MOST {
        return Err((format!("with all before it {vertices} vertices and {triangles} triangles"), AT_MOST));
    }
    if !corners.is_multiple_of(3) {
        return Err((format!("{corners} corners"), "three for each triangle"));
    }
    let reader = primitive.reader(|_| Some(bin));
    let own_positions = reader.read_positions().ok_or_else(|| ("no readable positions".to_owned(), PLAIN))?;
    let own_indices: Vec<u32> = match reader.read_indices() {
        Some(read) => read.into_u32().collect(),
        None if indices.is_none() => (0..corners as u32).collect(),
        None => return Err(("no readable indices".to_owned(), PLAIN)),
    };
    if let Some(index) = own_indices.iter().find(|i| **i as usize >= positions.count()) {
        return Err((format!("vertex {index}"), "one of its own vertices"));
    }
    let first = mesh.vertices_mm.len() as u32;
    mesh.vertices_mm.extend(own_positions.map(|p| from_gltf(apply(transform, p))));
    let order = if mirrors(transform) { [0, 2, 1] } else { [0, 1, 2] };
    mesh.triangles.extend(own_indices.chunks_exact(3).map(|corners| order.map(|i| first + corners[i])));
    Ok(())
}

// The crate asserts shape, type and stride, adds offsets as they come, and trusts that a count is not 0.
fn is_readable(accessor: &Accessor<'_>, shape: Dimensions, types: &[DataType], bin: &[u8]) -> bool {
    accessor.view().is_some_and(|view| {
        [accessor.offset(), view.offset(), view.length()].iter().all(|n| *n <= bin.len())
            && view.stride().is_none_or(|stride| stride >= accessor.size())
            && view.buffer().index() == 0
    }) && accessor.dimensions() == shape
        && types.contains(&accessor.data_type())
        && accessor.sparse().is_none()
        && accessor.count() > 0
}
