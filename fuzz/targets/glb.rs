//! Meshes in GLB, and what is done with those that are read.
#![no_main]

use std::path::Path;

use echolake_panel::mesh::{Mesh, MeshFormat};
use libfuzzer_sys::fuzz_target;

fuzz_target!(init: echolake_fuzz::write_seeds_on_request(), |bytes: &[u8]| {
    let path = Path::new("input.glb");
    if let Ok(mesh) = Mesh::from_bytes(MeshFormat::Glb, bytes, path) {
        let mesh = mesh.to_welded();
        let _ = mesh.volume_mm3();
        let _ = mesh.check_solid(585.0, 40.0, path);
    }
});
