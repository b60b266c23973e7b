//! OBJ: positions and faces; everything else in the file is passed over.

use std::fmt::Write as _;
use std::path::Path;

use super::{Error, Mesh};

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

pub(super) fn parse(bytes: &[u8], path: &Path) -> Result<Mesh, Error> {
    let mut mesh = Mesh::default();
    for (number, line) in String::from_utf8_lossy(bytes).lines().enumerate() {
        let (keyword, rest) = line.trim().split_once(char::is_whitespace).unwrap_or((line.trim(), ""));
        if keyword == "v" {
            // Colours may follow the position.
            mesh.vertices_mm.push(numbers::<3>(rest, path, number)?);
        } else if keyword == "f" {
            let corners = rest.split_whitespace().map(|c| corner(c, mesh.vertices_mm.len()));
            let corners = corners.collect::<Option<Vec<u32>>>().filter(|c| c.len() >= 3);
            let corners = corners.ok_or_else(|| Error::Syntax {
                path: path.to_owned(),
                place: format!("line {}", number + 1),
                actual: format!("`{}`", line.chars().take(60).collect::<String>()),
                expected: "three or more vertex numbers",
            })?;
            mesh.triangles.extend(fan(&corners));
        }
    }
    Ok(mesh)
}

/// A polygon as triangles.
pub(super) fn fan(corners: &[u32]) -> impl Iterator<Item = [u32; 3]> {
    corners.windows(2).skip(1).map(|w| [corners[0], w[0], w[1]])
}

/// The first numbers of a line.
pub(super) fn numbers<const N: usize>(text: &str, path: &Path, line: usize) -> Result<[f32; N], Error> {
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

// `7`, `7/1`, `7//3` or, counted from the end, `-1`.
fn corner(text: &str, vertices: usize) -> Option<u32> {
    let number: i64 = text.split('/').next()?.parse().ok()?;
    let index = if number < 0 { vertices as i64 + number } else { number - 1 };
    u32::try_from(index).ok().filter(|i| (*i as usize) < vertices)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_whitespace_stands_between_words() {
        let text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf 1 2 3\n";
        let expected = parse(text.as_bytes(), Path::new("a.obj")).expect("a triangle");
        assert_eq!((expected.vertices_mm.len(), &expected.triangles[..]), (3, &[[0, 1, 2]][..]));
        for other in ["\t", "  ", " \t"] {
            let text = text.replace(' ', other).replace('\n', "\r\n");
            assert_eq!(parse(text.as_bytes(), Path::new("a.obj")), Ok(expected.clone()), "{other:?}");
        }
        for broken in ["v\n", "v 1 2\n", "v 0 0 0\nf\n"] {
            assert!(parse(broken.as_bytes(), Path::new("a.obj")).is_err(), "{broken:?}");
        }
    }
}
