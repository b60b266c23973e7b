//! The grid points for microphone and speaker, and the pairs of points that are measured.

use std::collections::HashMap;

use serde::{Deserialize, Serialize};

use crate::{Error, PairId, PointId};

/// Two positions closer than this are the same point, mm. The robots repeat to 0.02 mm, the pitch is 75 mm.
const SAME_POINT_MM: f64 = 0.5;

/// One point of the grid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Its number.
    pub id: PointId,
    /// Layer, 0 the lowest.
    pub layer: u32,
    /// Column along x.
    pub gridx: u32,
    /// Row along y.
    pub gridy: u32,
    /// Position in mm; origin at the panel's centre, z up from its surface.
    pub position_mm: [f64; 3],
}

/// A microphone point and a speaker point that are measured together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pair {
    /// Its number.
    pub id: PairId,
    /// Point of the microphone.
    pub microphone: PointId,
    /// Point of the speaker.
    pub speaker: PointId,
}

/// Description of a rig's grid: square layers, or single points.
///
/// ```
/// use echolake_schema::grid::{GridParams, Layer, PairRule};
///
/// let layers = vec![Layer { points_per_side: 2, pitch_mm: 75.0, height_mm: 124.0 }];
/// let params = GridParams { pairs: PairRule::Ordered, clearance_mm: 40.0, layers, points_mm: Vec::new() };
/// assert_eq!(params.build_grid()?.pairs().len(), 4 * 3);
/// # Ok::<(), echolake_schema::Error>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(from = "GridText")]
pub struct GridParams {
    /// Rule for the pairs that are measured.
    pub pairs: PairRule,
    /// Points of different layers below the topmost, horizontally nearer than this, cannot be a pair, mm.
    pub clearance_mm: f64,
    /// Square layers, lowest first.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub layers: Vec<Layer>,
    /// Points that form no layers, mm; they count as layer 0, gridx 0, 1, 2, ...
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub points_mm: Vec<[f64; 3]>,
}

/// A grid as TOML describes it: what it leaves out is the paper's, but a grid of single points has no layers.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct GridText {
    pairs: Option<PairRule>,
    clearance_mm: Option<f64>,
    layers: Option<Vec<Layer>>,
    #[serde(default)]
    points_mm: Vec<[f64; 3]>,
}

impl From<GridText> for GridParams {
    fn from(text: GridText) -> Self {
        let paper = Self::default();
        let layers = if text.points_mm.is_empty() { paper.layers } else { Vec::new() };
        Self {
            pairs: text.pairs.unwrap_or(paper.pairs),
            clearance_mm: text.clearance_mm.unwrap_or(paper.clearance_mm),
            layers: text.layers.unwrap_or(layers),
            points_mm: text.points_mm,
        }
    }
}

/// A square layer of points, centred over the panel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Layer {
    /// Points along each side.
    pub points_per_side: u32,
    /// Distance of neighbours, mm.
    pub pitch_mm: f64,
    /// Height over the panel's surface, mm.
    pub height_mm: f64,
}

/// Rule for the pairs of points that are measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PairRule {
    /// Each two points once, the microphone on the one with the lower number.
    Unordered,
    /// Each two points twice, with the roles exchanged.
    Ordered,
}

impl PairRule {
    /// Its name, as rig files spell it.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Unordered => "unordered",
            Self::Ordered => "ordered",
        }
    }
}

/// The points and pairs of a rig.
///
/// ```
/// use echolake_schema::Rig;
///
/// let grid = Rig::paper().build_grid()?;
/// let microphone = grid.parse_point("0/0/0")?;
/// let speaker = grid.parse_point("0 0 474")?;
/// let pair = grid.parse_pair(microphone, speaker)?;
/// assert_eq!(grid.pair(pair).map(|pair| pair.speaker), Some(speaker.id));
/// assert_eq!(microphone.position_mm, [-187.5, -187.5, 124.0]);
/// # Ok::<(), echolake_schema::Error>(())
/// ```
#[derive(Debug, Clone)]
pub struct Grid {
    points: Vec<Point>,
    pairs: Vec<Pair>,
    by_points: HashMap<(PointId, PointId), PairId>,
}

impl Default for GridParams {
    /// The grid of Rust et al. 2021: four layers of 6 x 6, 5 x 5, 4 x 4 and 1 points.
    fn default() -> Self {
        let layer = |points_per_side, pitch_mm, height_mm| Layer { points_per_side, pitch_mm, height_mm };
        Self {
            pairs: PairRule::Unordered,
            clearance_mm: 40.0,
            layers: vec![layer(6, 75.0, 124.0), layer(5, 93.75, 214.0), layer(4, 125.0, 304.0), layer(1, 0.0, 474.0)],
            points_mm: Vec::new(),
        }
    }
}

impl GridParams {
    /// Most points that a grid may have: pairs grow with the square.
    pub const MAX_POINTS: usize = 2000;

    /// Lays out the points and pairs.
    ///
    /// # Errors
    /// [`Error::Quantity`] if there are fewer than 2 points, more than [`Self::MAX_POINTS`], or one is not within 1 km.
    pub fn build_grid(&self) -> Result<Grid, Error> {
        let count = self.layers.iter().map(|l| (l.points_per_side as usize).saturating_pow(2)).sum::<usize>();
        let count = count.saturating_add(self.points_mm.len());
        if !(2..=Self::MAX_POINTS).contains(&count) {
            let actual = count.to_string();
            return Err(Error::Quantity { quantity: "number of grid points", actual, expected: "2 to 2000" });
        }
        let points = self.lay_out_points();
        if let Some(bad) = points.iter().find(|p| p.position_mm.iter().any(|x| !(x.abs() <= 1e6))) {
            let actual = format!("{:?}", bad.position_mm);
            return Err(Error::Quantity { quantity: "grid point (mm)", actual, expected: "finite, within 1 km" });
        }
        Ok(Grid::new(points.clone(), self.pairs_of(&points)))
    }

    fn lay_out_points(&self) -> Vec<Point> {
        let mut points = Vec::new();
        let mut push = |layer, gridx, gridy, position_mm| {
            points.push(Point { id: PointId(points.len() as u32), layer, gridx, gridy, position_mm });
        };
        for (number, layer) in (0u32..).zip(&self.layers) {
            let middle = (f64::from(layer.points_per_side) - 1.0) / 2.0;
            let at = |i: u32| (f64::from(i) - middle) * layer.pitch_mm;
            for gridx in 0..layer.points_per_side {
                for gridy in 0..layer.points_per_side {
                    push(number, gridx, gridy, [at(gridx), at(gridy), layer.height_mm]);
                }
            }
        }
        let single = self.layers.len() as u32;
        for (gridx, position_mm) in (0u32..).zip(&self.points_mm) {
            push(single, gridx, 0, *position_mm);
        }
        points
    }

    fn pairs_of(&self, points: &[Point]) -> Vec<Pair> {
        let top = points.iter().map(|p| p.position_mm[2]).fold(f64::NEG_INFINITY, f64::max);
        let mut pairs = Vec::new();
        for a in points {
            for b in points {
                let wanted = match self.pairs {
                    PairRule::Unordered => a.id < b.id,
                    PairRule::Ordered => a.id != b.id,
                };
                if wanted && !self.is_collision(a, b, top) {
                    pairs.push(Pair { id: PairId(pairs.len() as u32), microphone: a.id, speaker: b.id });
                }
            }
        }
        pairs
    }

    // The end-effector at one point would be above that at the other; the topmost layer is high enough.
    fn is_collision(&self, a: &Point, b: &Point, top: f64) -> bool {
        let [dx, dy, dz] = [0, 1, 2].map(|i| a.position_mm[i] - b.position_mm[i]);
        dz != 0.0 && a.position_mm[2].max(b.position_mm[2]) < top && dx.hypot(dy) < self.clearance_mm
    }
}

impl Grid {
    fn new(points: Vec<Point>, pairs: Vec<Pair>) -> Self {
        let by_points = pairs.iter().map(|p| ((p.microphone, p.speaker), p.id)).collect();
        Self { points, pairs, by_points }
    }

    /// The points, by number.
    pub fn points(&self) -> &[Point] {
        &self.points
    }

    /// The pairs, by number.
    pub fn pairs(&self) -> &[Pair] {
        &self.pairs
    }

    /// A point by its number.
    pub fn point(&self, id: PointId) -> Option<&Point> {
        self.points.get(id.index())
    }

    /// A pair by its number.
    pub fn pair(&self, id: PairId) -> Option<&Pair> {
        self.pairs.get(id.index())
    }

    /// The pair of two points, in these roles.
    pub fn pair_id(&self, microphone: PointId, speaker: PointId) -> Option<PairId> {
        self.by_points.get(&(microphone, speaker)).copied()
    }

    /// The point of the lowest layer that is nearest to the panel's middle, the first of those that are equally near;
    /// None if the grid has no points.
    pub fn central_point(&self) -> Option<&Point> {
        let lowest = self.points.iter().filter(|point| point.layer == 0);
        let distance = |point: &Point| point.position_mm[0].hypot(point.position_mm[1]);
        lowest.reduce(|best, point| if distance(point) < distance(best) - 1e-6 { point } else { best })
    }

    /// The point at a position, mm, within half a millimetre.
    pub fn point_at(&self, position_mm: [f64; 3]) -> Option<&Point> {
        self.nearest_point(position_mm).filter(|p| distance_between(p.position_mm, position_mm) < SAME_POINT_MM)
    }

    /// Reads `layer/x/y` or millimetres `x y z`.
    ///
    /// # Errors
    /// [`Error::Point`] if it is neither, or the grid has no such point; a position gets the nearest point as a hint.
    pub fn parse_point(&self, text: &str) -> Result<&Point, Error> {
        let numbers = |separator: char| -> Option<Vec<f64>> {
            let parts = text.split(separator).map(str::trim).filter(|p| !p.is_empty());
            parts.map(|p| p.parse().ok().filter(|x: &f64| x.is_finite())).collect()
        };
        let found = if text.contains('/') {
            let parts = numbers('/').filter(|n| n.len() == 3);
            parts.and_then(|n| {
                self.points.iter().find(|p| [p.layer, p.gridx, p.gridy].map(f64::from) == [n[0], n[1], n[2]])
            })
        } else {
            numbers(' ').filter(|n| n.len() == 3).and_then(|n| self.point_at([n[0], n[1], n[2]]))
        };
        found.ok_or_else(|| self.no_point(text, numbers(' ')))
    }

    /// Returns the number of the pair of two points, in these roles.
    ///
    /// # Errors
    /// [`Error::Pair`] if the rig does not measure it; the hint says if it does so with the roles exchanged.
    pub fn parse_pair(&self, microphone: &Point, speaker: &Point) -> Result<PairId, Error> {
        self.pair_id(microphone.id, speaker.id).ok_or_else(|| Error::Pair {
            microphone: microphone.label(),
            speaker: speaker.label(),
            pairs: self.pairs.len(),
            hint: match self.pair_id(speaker.id, microphone.id) {
                Some(_) => "; hint: the rig measures it with microphone and speaker exchanged",
                None => "; hint: the rig's `grid.clearance_mm` keeps points one above the other apart",
            },
        })
    }

    fn nearest_point(&self, position_mm: [f64; 3]) -> Option<&Point> {
        let to = |p: &Point| distance_between(p.position_mm, position_mm);
        self.points.iter().min_by(|a, b| to(a).total_cmp(&to(b)))
    }

    fn no_point(&self, text: &str, numbers: Option<Vec<f64>>) -> Error {
        let position = numbers.filter(|n| n.len() == 3).map(|n| [n[0], n[1], n[2]]);
        Error::Point {
            given: format!("`{text}`"),
            expected: format!("{} points; `layer/x/y` or millimetres `x y z`", self.points.len()),
            nearest: position.and_then(|p| self.nearest_point(p)).map(|p| {
                let [x, y, z] = p.position_mm;
                format!("{} at `{x} {y} {z}`", p.label())
            }),
        }
    }
}

impl Point {
    /// `layer/x/y`.
    pub fn label(&self) -> String {
        format!("{}/{}/{}", self.layer, self.gridx, self.gridy)
    }
}

fn distance_between(a: [f64; 3], b: [f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn paper() -> Grid {
        GridParams::default().build_grid().expect("the built-in grid is valid")
    }

    #[test]
    fn points_are_read_both_ways() {
        let grid = paper();
        let by_index = grid.parse_point("1/2/2").expect("a point");
        let by_mm = grid.parse_point("0 0 214").expect("a point");
        assert_eq!(by_index, by_mm);
        assert_eq!(by_index.id, PointId(48));
    }

    #[test]
    fn bad_points_say_what_would_do() {
        let grid = paper();
        for bad in ["", "9/0/0", "1/2", "a/b/c", "nan 0 0", "0 0", "1/2/2/3"] {
            assert!(grid.parse_point(bad).is_err(), "{bad}");
        }
        let error = grid.parse_point("0 0 210").expect_err("no such point").to_string();
        assert!(error.contains("the nearest is 1/2/2 at `0 0 214`"), "{error}");
    }

    #[test]
    fn exchanged_roles_are_named() {
        let grid = paper();
        let (a, b) = (grid.points()[0], grid.points()[1]);
        assert_eq!(grid.parse_pair(&a, &b), Ok(PairId(0)));
        assert!(grid.parse_pair(&b, &a).expect_err("exchanged").to_string().contains("exchanged"));
    }

    #[test]
    fn a_description_of_single_points_has_no_layers() {
        let grid = |text: &str| crate::Rig::from_toml(text).and_then(|r| r.build_grid()).expect(text);
        assert_eq!(grid("grid.points_mm = [[0, 0, 0], [1000, 0, 0]]").points().len(), 2);
        assert_eq!(grid("grid.clearance_mm = 40.0").points().len(), 78);
        let room = crate::Rig::from_toml("grid.points_mm = [[0, 0, 0], [1000, 0, 0]]").expect("a rig");
        assert_eq!(crate::Rig::from_toml(&room.to_toml()), Ok(room));
    }

    #[test]
    fn single_points_make_a_grid() {
        let params = GridParams {
            pairs: PairRule::Ordered,
            clearance_mm: 0.0,
            layers: Vec::new(),
            points_mm: vec![[0.0; 3], [1000.0, 0.0, 0.0], [0.0, 1500.0, 0.0]],
        };
        let grid = params.build_grid().expect("three points");
        assert_eq!(grid.pairs().len(), 6);
        assert_eq!(grid.parse_point("0/2/0").expect("a point").position_mm, [0.0, 1500.0, 0.0]);
    }
}
