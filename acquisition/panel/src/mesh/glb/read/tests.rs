//! Files whose JSON is changed: nodes that move and mirror, sharing, and what is refused.

use serde_json::{Value, json};

use super::*;
use crate::relief::HeightField;

/// A plate of 100 x 100 x 20 mm, its top at 0.
fn plate() -> Mesh {
    Mesh::from_height_field(&HeightField::from_fn(100.0, 3, |_, _| 0.0), -20.0)
}

/// The plate's file, its JSON changed.
fn file(change: impl FnOnce(&mut Value)) -> Vec<u8> {
    let bytes = super::super::write_glb(&plate());
    let glb = Glb::from_slice(&bytes).expect("its own file");
    let mut document = serde_json::from_slice(&glb.json).expect("its own JSON");
    change(&mut document);
    packed(&document, &glb.bin.unwrap_or_default())
}

fn packed(document: &Value, bin: &[u8]) -> Vec<u8> {
    super::super::pack_glb(document.to_string().into_bytes(), bin.to_vec())
}

fn remove(document: &mut Value, key: &str) {
    assert!(document.as_object_mut().and_then(|object| object.remove(key)).is_some(), "no {key}");
}

fn parsed(change: impl FnOnce(&mut Value)) -> Mesh {
    parse(&file(change), Path::new("plate.glb")).expect("a mesh")
}

fn refused(change: impl FnOnce(&mut Value), expected: &str) {
    let error = parse(&file(change), Path::new("plate.glb")).expect_err(expected).to_string();
    assert!(error.contains(expected) && error.contains("plate.glb"), "{error}");
}

// Lengths in metres, in f32: a thousandth of a millimetre is what remains of them.
fn assert_bounds(mesh: &Mesh, expected: [[f32; 3]; 2]) {
    let bounds = mesh.bounds_mm();
    let near = bounds.as_flattened().iter().zip(expected.as_flattened()).all(|(a, b)| (a - b).abs() < 1e-3);
    assert!(near, "{bounds:?}, expected {expected:?}");
}

#[test]
fn nodes_move_turn_and_scale_their_meshes() {
    assert_bounds(&parsed(|_| {}), [[-50.0, -50.0, -20.0], [50.0, 50.0, 0.0]]);
    // Y is up in glTF: 0.5 m along its y lifts the plate.
    let moved = parsed(|d| d["nodes"][0]["translation"] = json!([0.1, 0.5, 0.2]));
    assert_bounds(&moved, [[50.0, -250.0, 480.0], [150.0, -150.0, 500.0]]);
    let scaled = parsed(|d| d["nodes"][0]["scale"] = json!([2.0, 1.0, 0.5]));
    assert_bounds(&scaled, [[-100.0, -25.0, -20.0], [100.0, 25.0, 0.0]]);
    // A quarter turn about x takes glTF's y to z, which is -y here.
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let turned = parsed(|d| d["nodes"][0]["rotation"] = json!([half, 0.0, 0.0, half]));
    assert_bounds(&turned, [[-50.0, 0.0, -50.0], [50.0, 20.0, 50.0]]);
    let matrix = json!([2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0.5, 0, 0.1, 0, 0, 1]);
    let by_matrix = parsed(|d| d["nodes"][0]["matrix"] = matrix);
    assert_bounds(&by_matrix, [[0.0, -25.0, -20.0], [200.0, 25.0, 0.0]]);
}

#[test]
fn transforms_add_up_along_the_tree() {
    let mesh = parsed(|d| {
        d["nodes"] = json!([
            { "children": [1], "scale": [10, 10, 10] },
            { "children": [2], "translation": [0.01, 0, 0] },
            { "mesh": 0, "scale": [0.1, 0.1, 0.1] },
        ]);
    });
    // The move is enlarged by its parent: 0.01 m become 100 mm.
    assert_bounds(&mesh, [[50.0, -50.0, -20.0], [150.0, 50.0, 0.0]]);
    assert!((mesh.volume_mm3() / 2e5 - 1.0).abs() < 1e-4);
}

#[test]
fn a_mirrored_solid_keeps_its_inside() {
    let mesh = parsed(|d| d["nodes"][0]["scale"] = json!([-1, 1, 1]));
    assert!((mesh.volume_mm3() / 2e5 - 1.0).abs() < 1e-4, "{}", mesh.volume_mm3());
}

#[test]
fn every_instance_stands_and_what_is_not_in_the_scene_does_not() {
    let nodes = json!([
        { "mesh": 0 }, { "mesh": 0, "translation": [0.2, 0, 0] }, { "mesh": 0, "translation": [0, 9, 0] },
    ]);
    let two = parsed(|d| (d["nodes"], d["scenes"]) = (nodes.clone(), json!([{ "nodes": [0, 1] }])));
    assert_eq!(two.triangles.len(), 2 * plate().triangles.len());
    assert_bounds(&two, [[-50.0, -50.0, -20.0], [250.0, 50.0, 0.0]]);
    let second = json!([{ "nodes": [0] }, { "nodes": [2] }]);
    let shown = parsed(|d| (d["nodes"], d["scenes"], d["scene"]) = (nodes.clone(), second, json!(1)));
    assert_bounds(&shown, [[-50.0, -50.0, 8980.0], [50.0, 50.0, 9000.0]]);
    let without_scenes = parsed(|d| {
        d["nodes"] = nodes;
        ["scenes", "scene"].iter().for_each(|key| remove(d, key));
    });
    assert_eq!(without_scenes.triangles.len(), 3 * plate().triangles.len());
    let without_nodes = parsed(|d| ["nodes", "scenes", "scene"].iter().for_each(|key| remove(d, key)));
    assert_eq!(without_nodes.triangles.len(), plate().triangles.len());
}

#[test]
fn graphs_that_are_no_trees_are_refused() {
    let nodes = |nodes: Value| move |d: &mut Value| d["nodes"] = nodes;
    refused(nodes(json!([{ "children": [0] }])), "node 0 has a second parent, or itself above it");
    refused(nodes(json!([{ "children": [1] }, { "children": [0] }])), "expected a tree of nodes");
    refused(nodes(json!([{ "children": [1, 1] }, { "mesh": 0 }])), "node 1 has a second parent");
    refused(nodes(json!([{ "children": [7] }])), "its JSON at `nodes[0].children[0]` has \"Index out of bounds\"");
    refused(nodes(json!([{ "mesh": 1 }])), "its JSON at `nodes[0].mesh` has");
    refused(
        nodes(json!([{ "mesh": 0, "scale": [1, "a", 1] }])),
        "its JSON has \"invalid type: string \"a\", expected f32",
    );
    refused(nodes(json!([{ "mesh": 0, "matrix": [1, 0, 0] }])), "its JSON has \"invalid length 3");
    refused(|d| d["scene"] = json!(3), "its JSON at `scene` has");
    // A chain as long as any file's: depth costs no stack.
    let mut chain: Vec<Value> = (1..100_000).map(|next| json!({ "children": [next] })).collect();
    chain.push(json!({ "mesh": 0 }));
    assert_eq!(parsed(nodes(chain.into())).triangles.len(), plate().triangles.len());
}

#[test]
fn numbers_of_another_kind_are_refused() {
    refused(|d| d["accessors"][2]["componentType"] = json!(5126), "no readable indices");
    refused(|d| d["accessors"][0]["componentType"] = json!(5125), "no readable positions");
    let sparse = json!({
        "count": 1,
        "indices": { "bufferView": 2, "componentType": 5125 },
        "values": { "bufferView": 1 },
    });
    refused(|d| d["accessors"][0]["sparse"] = sparse, "no readable positions");
    refused(|d| d["accessors"][0]["type"] = json!("VEC4"), "no readable positions");
    refused(|d| d["accessors"][0]["count"] = json!(0), "no readable positions");
    refused(|d| d["bufferViews"][0]["byteStride"] = json!(8), "no readable positions");
    refused(
        |d| d["bufferViews"][0]["byteStride"] = json!(1_u64 << 40),
        "`bufferViews[0].byteStride` has \"Invalid value\"",
    );
    refused(|d| d["bufferViews"][0]["byteOffset"] = json!(u64::MAX - 4), "no readable positions");
    refused(|d| d["bufferViews"][2]["byteOffset"] = json!(1 << 20), "no readable indices");
    refused(|d| d["accessors"][2]["type"] = json!("VEC3"), "no readable indices");
    refused(|d| d["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = json!(9), "mesh 0 has accessor 9");
    refused(|d| d["meshes"][0]["primitives"][0]["indices"] = json!(9), "primitives[0].indices` has \"Index out");
    refused(|d| d["bufferViews"][0]["byteOffset"] = json!(-4), "its JSON has \"invalid value: integer `-4`");
    refused(|d| d["accessors"][2]["count"] = json!(10), "10 corners, expected three for each triangle");
    refused(|d| d["accessors"][0]["count"] = json!(4), "one of its own vertices");
    refused(|d| d["meshes"][0]["primitives"][0]["mode"] = json!(1), "mode Lines, expected triangles");
}

#[test]
fn features_that_would_change_the_shape_are_refused_by_name() {
    let required = |name: &str| {
        let names = json!(["KHR_materials_unlit", name]);
        move |d: &mut Value| d["extensionsRequired"] = names
    };
    refused(required("KHR_draco_mesh_compression"), "`extensionsRequired` has \"KHR_draco_mesh_compression\"");
    refused(required("EXT_mesh_gpu_instancing"), "has \"EXT_mesh_gpu_instancing\"");
    refused(|d| d["extensionsRequired"] = json!([7]), "invalid type: integer `7`, expected a string");
    assert_eq!(parsed(required("KHR_texture_transform")), parsed(|_| {}), "it changes no shape");
    let with_picture = parsed(|d| {
        d["textures"] = json!([{ "extensions": { "EXT_texture_webp": { "source": 0 } } }]);
        d["images"] = json!([{ "uri": "a.webp" }]);
        d["meshes"][0]["primitives"][0]["attributes"]["_OWN"] = json!(0);
    });
    assert_eq!(with_picture, parsed(|_| {}), "pictures and attributes of applications change no shape");
    let instances = json!({ "EXT_mesh_gpu_instancing": { "attributes": { "TRANSLATION": 0 } } });
    refused(|d| d["nodes"][0]["extensions"] = instances, "node 0 has the extension EXT_mesh_gpu_instancing");
    refused(
        |d| d["buffers"][0]["uri"] = json!("other.bin"),
        "buffer 0 has the uri \"other.bin\", expected the file's own",
    );
    let embedded = format!("data:application/octet-stream;base64,{}", "A".repeat(9_999));
    let error = parse(&file(|d| d["buffers"][0]["uri"] = json!(embedded)), Path::new("a.glb")).expect_err("a uri");
    assert!(error.to_string().len() < 250, "{error}");
}

mod slow {
    use super::*;

    #[test]
    fn a_small_file_cannot_ask_for_any_number() {
        // Each of 1,001 nodes and primitives costs some bytes and shares 9,000 vertices of 108 kB.
        let bin = vec![0; 9_000 * 12];
        let document = |nodes: usize, primitives: usize| {
            json!({
                "asset": { "version": "2.0" },
                "nodes": vec![json!({ "mesh": 0 }); nodes],
                "meshes": [{ "primitives": vec![json!({ "attributes": { "POSITION": 0 } }); primitives] }],
                "accessors": [{ "bufferView": 0, "componentType": 5126, "count": 9_000, "type": "VEC3",
                                 "min": [0, 0, 0], "max": [0, 0, 0] }],
                "bufferViews": [{ "buffer": 0, "byteLength": bin.len() }],
                "buffers": [{ "byteLength": bin.len() }],
            })
        };
        for (nodes, primitives) in [(1_001, 1), (1, 1_001)] {
            let bytes = packed(&document(nodes, primitives), &bin);
            assert!(bytes.len() < 160_000, "{}", bytes.len());
            let error = parse(&bytes, Path::new("bomb.glb")).expect_err("too many").to_string();
            assert!(error.contains("6003000 vertices") && error.contains("up to 6 million vertices"), "{error}");
        }
        let mesh = parse(&packed(&document(10, 1), &bin), Path::new("ten.glb")).expect("a mesh");
        assert_eq!((mesh.vertices_mm.len(), mesh.triangles.len()), (90_000, 30_000));
    }
}
