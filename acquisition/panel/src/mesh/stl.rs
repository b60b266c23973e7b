//! STL: triangles without shared corners, binary or text.

use std::path::Path;

use super::{Error, Mesh};

const HEADER: usize = 80;
const FACET: usize = 50;

/// The mesh as binary STL.
pub(super) fn write_stl(mesh: &Mesh) -> Vec<u8> {
    let mut file = vec![0; HEADER];
    file[..8].copy_from_slice(b"echolake");
    file.extend((mesh.triangles.len() as u32).to_le_bytes());
    for triangle in &mesh.triangles {
        // Normals of zero tell readers to take the corners' order.
        file.extend([0; 12]);
        file.extend(triangle.iter().flat_map(|i| mesh.vertices_mm[*i as usize]).flat_map(f32::to_le_bytes));
        file.extend([0; 2]);
    }
    file
}

pub(super) fn parse_stl(bytes: &[u8], path: &Path) -> Result<Mesh, Error> {
    let count = bytes.get(HEADER..HEADER + 4).and_then(|b| b.try_into().ok()).map(u32::from_le_bytes);
    let expected = count.map(|n| HEADER as u64 + 4 + FACET as u64 * u64::from(n));
    // Binary files may begin with `solid` too; their length tells them apart.
    if expected == Some(bytes.len() as u64) {
        return Ok(parse_binary(&bytes[HEADER + 4..]));
    }
    // A name may be in any alphabet and encoding, but text has no zeros, and binary numbers do.
    if bytes.starts_with(b"solid") && !bytes.contains(&0) {
        return parse_text(bytes, path);
    }
    Err(Error::Syntax {
        path: path.to_owned(),
        place: "the file".to_owned(),
        actual: format!("{} bytes", bytes.len()),
        expected: "84 bytes and 50 for each of the triangles that its header counts",
    })
}

fn parse_binary(facets: &[u8]) -> Mesh {
    let float = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
    let corner = |b: &[u8]| [float(&b[0..4]), float(&b[4..8]), float(&b[8..12])];
    let corners = facets.chunks_exact(FACET).flat_map(|f| [corner(&f[12..24]), corner(&f[24..36]), corner(&f[36..48])]);
    triangle_soup(corners.collect())
}

fn parse_text(bytes: &[u8], path: &Path) -> Result<Mesh, Error> {
    let text = String::from_utf8_lossy(bytes);
    let mut corners = Vec::new();
    for (number, line) in text.lines().enumerate() {
        if let Some(rest) = line.trim().strip_prefix("vertex") {
            corners.push(parse_numbers::<3>(rest, path, number)?);
        }
    }
    let complete = corners.len().is_multiple_of(3)
        && text.trim_end().lines().last().is_some_and(|l| l.trim_start().starts_with("endsolid"));
    if complete {
        return Ok(triangle_soup(corners));
    }
    Err(Error::Syntax {
        path: path.to_owned(),
        place: "its last line".to_owned(),
        actual: "no end".to_owned(),
        expected: "three vertices a facet and `endsolid`",
    })
}

/// The first numbers of a line.
fn parse_numbers<const N: usize>(text: &str, path: &Path, line: usize) -> Result<[f32; N], Error> {
    let mut words = text.split_whitespace();
    let mut out = [0.0; N];
    for slot in &mut out {
        let word = words.next().unwrap_or("nothing");
        *slot = word.parse().map_err(|_| Error::Syntax {
            path: path.to_owned(),
            place: format!("line {}", line + 1),
            actual: format!("`{}`", word.chars().take(60).collect::<String>()),
            expected: "a number",
        })?;
    }
    Ok(out)
}

fn triangle_soup(vertices_mm: Vec<[f32; 3]>) -> Mesh {
    let triangles = (0..vertices_mm.len() as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
    Mesh { vertices_mm, triangles }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(name: &[u8]) -> Vec<u8> {
        let facet =
            b"\nfacet normal 0 0 1\n outer loop\n  vertex 0 0 0\n\tvertex\t1 0 0\n  vertex 0 1 0\n endloop\nendfacet\n";
        [b"solid ", name, facet, b"endsolid ", name, b"\n"].concat()
    }

    #[test]
    fn names_may_be_in_any_alphabet() {
        let expected = parse_stl(&text(b"wall"), Path::new("a.stl")).expect("a triangle");
        assert_eq!(expected.vertices_mm, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);
        // UTF-8, and the same in Latin-1.
        for name in ["Mauerstück".as_bytes(), b"Mauerst\xFCck"] {
            assert_eq!(parse_stl(&text(name), Path::new("a.stl")), Ok(expected.clone()), "{name:?}");
        }
    }

    #[test]
    fn a_binary_file_that_was_cut_off_is_no_text() {
        let mut bytes = write_stl(&Mesh { vertices_mm: vec![[1.5; 3]; 3], triangles: vec![[0, 1, 2]] });
        bytes[..6].copy_from_slice(b"solid ");
        assert!(parse_stl(&bytes, Path::new("a.stl")).is_ok());
        let cut = bytes.len() - 10;
        assert!(parse_stl(&bytes[..cut], Path::new("a.stl")).expect_err("cut").to_string().contains("124 bytes"));
    }
}
