//! PLY: text or binary little-endian; positions and faces, other properties are passed over.

use std::path::Path;

use super::obj::fan;
use super::{Error, Mesh};

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

struct PlyElement {
    name: String,
    count: usize,
    properties: Vec<PlyProperty>,
}

struct PlyProperty {
    name: String,
    kind: PlyType,
    /// Of a list: the kind of its length.
    length: Option<PlyType>,
}

#[derive(Debug, Clone, Copy)]
enum PlyType {
    Signed(usize),
    Unsigned(usize),
    Float,
    Double,
}

impl PlyType {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::Signed(1),
            "short" | "int16" => Self::Signed(2),
            "int" | "int32" => Self::Signed(4),
            "uchar" | "uint8" => Self::Unsigned(1),
            "ushort" | "uint16" => Self::Unsigned(2),
            "uint" | "uint32" => Self::Unsigned(4),
            "float" | "float32" => Self::Float,
            "double" | "float64" => Self::Double,
            _ => return None,
        })
    }
}

/// The numbers of the body, one after the other.
enum PlyBody<'a> {
    Text(Vec<&'a str>, usize),
    Binary(&'a [u8], usize),
}

impl PlyBody<'_> {
    fn next(&mut self, kind: PlyType) -> Option<f64> {
        match self {
            Self::Text(words, at) => {
                *at += 1;
                words.get(*at - 1)?.parse().ok()
            }
            Self::Binary(bytes, at) => {
                let size = match kind {
                    PlyType::Signed(n) | PlyType::Unsigned(n) => n,
                    PlyType::Float => 4,
                    PlyType::Double => 8,
                };
                let raw = bytes.get(*at..*at + size)?;
                *at += size;
                let bits = raw.iter().rev().fold(0u64, |n, b| n << 8 | u64::from(*b));
                Some(match kind {
                    PlyType::Signed(n) => ((bits << (64 - 8 * n)) as i64 >> (64 - 8 * n)) as f64,
                    PlyType::Unsigned(_) => bits as f64,
                    PlyType::Float => f64::from(f32::from_bits(bits as u32)),
                    PlyType::Double => f64::from_bits(bits),
                })
            }
        }
    }
}

pub(super) fn parse(bytes: &[u8], path: &Path) -> Result<Mesh, Error> {
    let wrong = |place: &str, actual: String, expected: &'static str| Error::Syntax {
        path: path.to_owned(),
        place: place.to_owned(),
        actual,
        expected,
    };
    let (header, body) = split(bytes).ok_or_else(|| wrong("the header", "no end".into(), "`end_header`"))?;
    let header = String::from_utf8_lossy(header);
    let mut lines = header.lines().map(str::trim);
    if lines.next() != Some("ply") {
        return Err(wrong("line 1", "something else".into(), "`ply`"));
    }
    let (mut elements, mut format) = (Vec::<PlyElement>::new(), "");
    for line in lines {
        let words: Vec<_> = line.split_whitespace().collect();
        match words[..] {
            ["format", kind, _] => {
                format = if kind == "ascii" {
                    "ascii"
                } else if kind == "binary_little_endian" {
                    "binary"
                } else {
                    ""
                }
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| wrong("the header", format!("`{line}`"), "a count"))?;
                elements.push(PlyElement { name: name.into(), count, properties: Vec::new() });
            }
            ["property", "list", length, kind, name] => add(&mut elements, name, kind, Some(length))
                .ok_or_else(|| wrong("the header", format!("`{line}`"), "a property of an element"))?,
            ["property", kind, name] => add(&mut elements, name, kind, None)
                .ok_or_else(|| wrong("the header", format!("`{line}`"), "a property of an element"))?,
            _ => {}
        }
    }
    let mut body = match format {
        "ascii" => PlyBody::Text(std::str::from_utf8(body).unwrap_or_default().split_whitespace().collect(), 0),
        "binary" => PlyBody::Binary(body, 0),
        _ => return Err(wrong("the header", "another format".into(), "ascii or binary_little_endian")),
    };
    let mut mesh = Mesh::default();
    for element in &elements {
        for row in 0..element.count {
            read_row(element, &mut body, &mut mesh)
                .map_err(|(actual, expected)| wrong(&format!("{} {row}", element.name), actual, expected))?;
        }
    }
    Ok(mesh)
}

fn add(elements: &mut [PlyElement], name: &str, kind: &str, length: Option<&str>) -> Option<()> {
    let length = match length {
        Some(length) => Some(PlyType::parse(length)?),
        None => None,
    };
    elements.last_mut()?.properties.push(PlyProperty { name: name.into(), kind: PlyType::parse(kind)?, length });
    Some(())
}

// Header and body; lines may end in a carriage return too.
fn split(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let mut at = 0;
    for line in bytes.split_inclusive(|b| *b == b'\n') {
        at += line.len();
        if matches!(line, b"end_header\n" | b"end_header\r\n") {
            return Some((&bytes[..at - line.len()], &bytes[at..]));
        }
    }
    None
}

// An error has the actual and the expected content.
fn read_row(element: &PlyElement, body: &mut PlyBody<'_>, mesh: &mut Mesh) -> Result<(), (String, &'static str)> {
    let no_number = || ("no number".to_owned(), "as many as the header counts");
    let mut position = [f32::NAN; 3];
    // An element without properties would be read without end.
    element.properties.first().ok_or_else(no_number)?;
    for property in &element.properties {
        let Some(length) = property.length else {
            let value = body.next(property.kind).ok_or_else(no_number)?;
            if let Some(axis) = ["x", "y", "z"].iter().position(|n| *n == property.name) {
                position[axis] = value as f32;
            }
            continue;
        };
        let length = body.next(length).ok_or_else(no_number)?;
        let length = whole(length).ok_or_else(|| (format!("a list of {length}"), "a whole number of items"))?;
        let is_corners = element.name == "face" && property.name.starts_with("vertex_ind");
        let mut corners = Vec::new();
        for _ in 0..length {
            let value = body.next(property.kind).ok_or_else(no_number)?;
            if is_corners {
                corners.push(whole(value).ok_or_else(|| (format!("vertex {value}"), "one of the file's vertices"))?);
            }
        }
        mesh.triangles.extend(fan(&corners));
    }
    if element.name == "vertex" {
        mesh.vertices_mm.push(position);
    }
    Ok(())
}

// A number from 0 that has no fraction.
fn whole(value: f64) -> Option<u32> {
    (value.fract() == 0.0 && (0.0..=f64::from(u32::MAX)).contains(&value)).then_some(value as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "ply\nformat ascii 1.0\ncomment before end_header\nelement vertex 3\nproperty float x\n\
                          property float y\nproperty float z\nelement face 1\n\
                          property list uchar int vertex_indices\nend_header\n";
    const VERTICES: &str = "0 0 0\n1 0 0\n0 1 0\n";

    fn read(face: &str) -> Result<Mesh, Error> {
        parse(format!("{HEADER}{VERTICES}{face}\n").as_bytes(), Path::new("a.ply"))
    }

    #[test]
    fn corners_are_whole_numbers_from_0() {
        assert_eq!(read("3 0 1 2").expect("a triangle").triangles, [[0, 1, 2]]);
        for (face, expected) in [
            ("3 -1 1 2", "face 0 has vertex -1"),
            ("3 2.7 1 0", "face 0 has vertex 2.7"),
            ("3 NaN 1 0", "face 0 has vertex NaN"),
            ("3 5e9 1 0", "face 0 has vertex 5000000000"),
            ("2.5 0 1 2", "face 0 has a list of 2.5"),
            ("-3 0 1 2", "face 0 has a list of -3"),
            ("3 0 1", "face 0 has no number"),
        ] {
            let error = read(face).expect_err(expected).to_string();
            assert!(error.contains(expected), "{error}");
        }
    }

    #[test]
    fn lines_may_end_in_carriage_returns() {
        let text = format!("{HEADER}{VERTICES}3 0 1 2\n").replace('\n', "\r\n");
        assert_eq!(parse(text.as_bytes(), Path::new("a.ply")), read("3 0 1 2"));
        // Binary numbers begin right behind the header's last line.
        let mut binary = HEADER.replace("ascii", "binary_little_endian").replace('\n', "\r\n").into_bytes();
        binary.extend([0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0].map(f32::to_le_bytes).as_flattened());
        binary.push(3);
        binary.extend([0i32, 1, 2].map(i32::to_le_bytes).as_flattened());
        assert_eq!(parse(&binary, Path::new("a.ply")), read("3 0 1 2"));
    }
}
