//! Positions of a GLB file's meshes: the transforms along its tree of nodes.

use serde_json::Value;

use super::accessor::{list, number};

/// An affine map: three rows of a 3 x 3 matrix and a translation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct NodeTransform([[f64; 4]; 3]);

/// A mesh and its transform.
#[derive(Debug, PartialEq)]
pub(super) struct MeshInstance {
    /// Its index in `meshes`.
    pub(super) mesh: usize,
    pub(super) transform: NodeTransform,
}

/// A fault of a scene.
#[derive(Debug, PartialEq)]
pub(super) struct SceneFault {
    pub(super) place: String,
    pub(super) actual: String,
    pub(super) expected: &'static str,
}

impl NodeTransform {
    const IDENTITY: Self = Self([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);

    pub(super) fn apply(&self, p: [f32; 3]) -> [f32; 3] {
        let p = p.map(f64::from);
        self.0.map(|[a, b, c, d]| (a * p[0] + b * p[1] + c * p[2] + d) as f32)
    }

    /// Returns whether it turns the inside of a solid out.
    pub(super) fn mirrors(&self) -> bool {
        let [[a, b, c, _], [d, e, f, _], [g, h, i, _]] = self.0;
        a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0.0
    }

    fn after(&self, first: &Self) -> Self {
        let column = |row: &[f64; 4], j: usize| (0..3).map(|k| row[k] * first.0[k][j]).sum::<f64>();
        Self(self.0.map(|row| [column(&row, 0), column(&row, 1), column(&row, 2), column(&row, 3) + row[3]]))
    }

    // A node has a matrix, column by column, or scale, rotation and translation, in this order.
    fn of(node: &Value) -> Option<Self> {
        if !node["matrix"].is_null() {
            let m = numbers::<16>(&node["matrix"], [0.0; 16])?;
            return Some(Self([0, 1, 2].map(|row| [m[row], m[row + 4], m[row + 8], m[row + 12]])));
        }
        let [tx, ty, tz] = numbers(&node["translation"], [0.0; 3])?;
        let [x, y, z, w] = numbers(&node["rotation"], [0.0, 0.0, 0.0, 1.0])?;
        let [sx, sy, sz] = numbers(&node["scale"], [1.0; 3])?;
        let turned = [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ];
        let row = |i: usize, t: f64| [turned[i][0] * sx, turned[i][1] * sy, turned[i][2] * sz, t];
        Some(Self([row(0, tx), row(1, ty), row(2, tz)]))
    }
}

// Reads N finite numbers; the default if there are none.
fn numbers<const N: usize>(value: &Value, default: [f64; N]) -> Option<[f64; N]> {
    if value.is_null() {
        return Some(default);
    }
    let found: Option<Vec<f64>> = value.as_array()?.iter().map(|x| x.as_f64().filter(|x| x.is_finite())).collect();
    found?.try_into().ok()
}

/// The meshes of the file's scene, in the order of its tree. A file without nodes is a library of meshes: each
/// keeps its place.
pub(super) fn instances(document: &Value) -> Result<Vec<MeshInstance>, SceneFault> {
    let (nodes, meshes) = (list(&document["nodes"]), list(&document["meshes"]).len());
    if nodes.is_empty() {
        return Ok((0..meshes).map(|mesh| MeshInstance { mesh, transform: NodeTransform::IDENTITY }).collect());
    }
    let mut found = Vec::new();
    let mut seen = vec![false; nodes.len()];
    let mut waiting: Vec<_> = roots(document, nodes)?.into_iter().rev().map(|n| (n, NodeTransform::IDENTITY)).collect();
    // A tree has each node once, which ends this whatever the file says, at any depth.
    while let Some((at, parent)) = waiting.pop() {
        let wrong = |actual: String, expected| SceneFault { place: format!("node {at}"), actual, expected };
        if std::mem::replace(&mut seen[at], true) {
            return Err(wrong("a second parent, or itself above it".into(), "a tree of nodes"));
        }
        let node = &nodes[at];
        let own = NodeTransform::of(node).ok_or_else(|| wrong("a transform that is none".into(), "finite numbers"))?;
        let transform = parent.after(&own);
        if !node["mesh"].is_null() {
            let mesh = number(&node["mesh"]).filter(|m| *m < meshes);
            let mesh = mesh.ok_or_else(|| wrong(format!("mesh {}", node["mesh"]), "one of the file's meshes"))?;
            found.push(MeshInstance { mesh, transform });
        }
        let children = indices(&node["children"], nodes.len(), || format!("node {at}"))?;
        waiting.extend(children.into_iter().rev().map(|child| (child, transform)));
    }
    Ok(found)
}

// The nodes of the default scene; without scenes, all that have no parent.
fn roots(document: &Value, nodes: &[Value]) -> Result<Vec<usize>, SceneFault> {
    let scenes = list(&document["scenes"]);
    if !scenes.is_empty() {
        let shown = if document["scene"].is_null() { Some(0) } else { number(&document["scene"]) };
        let scene = shown.and_then(|s| scenes.get(s)).ok_or_else(|| SceneFault {
            place: "its JSON".into(),
            actual: format!("scene {}", document["scene"]),
            expected: "one of the file's scenes",
        })?;
        return indices(&scene["nodes"], nodes.len(), || "its scene".into());
    }
    let mut is_child = vec![false; nodes.len()];
    for (at, node) in nodes.iter().enumerate() {
        for child in indices(&node["children"], nodes.len(), || format!("node {at}"))? {
            is_child[child] = true;
        }
    }
    Ok((0..nodes.len()).filter(|n| !is_child[*n]).collect())
}

fn indices(value: &Value, nodes: usize, place: impl Fn() -> String) -> Result<Vec<usize>, SceneFault> {
    let index = |v: &Value| {
        let found = number(v).filter(|n| *n < nodes);
        found.ok_or_else(|| SceneFault {
            place: place(),
            actual: format!("node {v}"),
            expected: "one of the file's nodes",
        })
    };
    list(value).iter().map(index).collect()
}
