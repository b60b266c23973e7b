//! PLY: positions and faces, binary little-endian, written only.

use super::Mesh;

/// The mesh as binary little-endian PLY.
pub(super) fn write(mesh: &Mesh) -> Vec<u8> {
    let header = format!(
        "ply\nformat binary_little_endian 1.0\ncomment millimetres, z up\nelement vertex {}\nproperty float x\n\
         property float y\nproperty float z\nelement face {}\nproperty list uchar int vertex_indices\nend_header\n",
        mesh.vertices_mm.len(),
        mesh.triangles.len()
    );
    let mut file = header.into_bytes();
    file.extend(mesh.vertices_mm.iter().flatten().flat_map(|x| x.to_le_bytes()));
    for triangle in &mesh.triangles {
        file.push(3);
        file.extend(triangle.iter().flat_map(|i| i.to_le_bytes()));
    }
    file
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_follow_the_header() {
        let mesh = Mesh { vertices_mm: vec![[0.0; 3], [1.5, 0.0, 0.0], [0.0, 1.0, -2.0]], triangles: vec![[0, 1, 2]] };
        let file = write(&mesh);
        let end = file.windows(11).position(|w| w == b"end_header\n").expect("an end") + 11;
        let header = String::from_utf8_lossy(&file[..end]);
        assert!(header.contains("element vertex 3\n") && header.contains("element face 1\n"), "{header}");
        let (positions, face) = file[end..].split_at(36);
        assert_eq!(positions[12..16], 1.5f32.to_le_bytes());
        assert_eq!(positions[32..], (-2f32).to_le_bytes());
        assert_eq!(face, [3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
    }
}
