//! OBJ: positions and faces, written only.

use std::fmt::Write as _;

use super::Mesh;

/// The mesh as OBJ.
pub(super) fn write(mesh: &Mesh) -> Vec<u8> {
    let mut text = String::from("# millimetres, z up\n");
    for [x, y, z] in &mesh.vertices_mm {
        let _ = writeln!(text, "v {x} {y} {z}");
    }
    for [a, b, c] in mesh.triangles.iter().map(|t| t.map(|i| i + 1)) {
        let _ = writeln!(text, "f {a} {b} {c}");
    }
    text.into_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_count_from_1() {
        let mesh = Mesh { vertices_mm: vec![[0.0; 3], [1.5, 0.0, 0.0], [0.0, 1.0, -2.0]], triangles: vec![[0, 1, 2]] };
        let expected = "# millimetres, z up\nv 0 0 0\nv 1.5 0 0\nv 0 1 -2\nf 1 2 3\n";
        assert_eq!(String::from_utf8(write(&mesh)).expect("text"), expected);
    }
}
