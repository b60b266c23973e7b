//! Solids: from height fields and back, closed or not, how large.

use std::collections::HashMap;
use std::iter;
use std::path::Path;

use super::{Error, FACETS, Mesh, PanelSide};
use crate::relief::{HeightField, RELIEF_MM};

/// From the plane of a panel's front to that of its back, mm: 100 less twice the relief's greatest height.
const CORE_MM: f64 = 42.0;

impl Mesh {
    /// A closed solid: the relief on top, four walls, and a plane at `base_mm` below. [`Mesh::to_height_field`] returns
    /// the relief again.
    pub fn from_height_field(relief: &HeightField, base_mm: f32) -> Self {
        let mut mesh = Self::default();
        let top = mesh.push_grid(relief, |x, y| relief.height_at(x, y) as f32);
        let centre = mesh.vertices_mm.len() as u32;
        mesh.vertices_mm.push([0.0, 0.0, base_mm]);
        let bottom: Vec<u32> = (centre + 1..).take(top.len()).collect();
        for vertex in &top {
            let [x, y, _] = mesh.vertices_mm[*vertex as usize];
            mesh.vertices_mm.push([x, y, base_mm]);
        }
        mesh.push_walls(&top, &bottom);
        mesh.triangles.extend(edges_of(&bottom).map(|[from, to]| [centre, to, from]));
        mesh
    }

    /// A panel with a relief on either side, 100 mm thick at most: the planes that heights count from are 42 mm apart,
    /// so that the deepest reliefs leave 20 mm between them. The panel is turned over about its y axis to see its back.
    pub fn double_sided(front: &HeightField, back: &HeightField) -> Self {
        let mut mesh = Self::default();
        let top = mesh.push_grid(front, |x, y| front.height_at(x, y) as f32);
        let triangles = mesh.triangles.len();
        let bottom = mesh.push_grid(front, |x, y| (-CORE_MM - back.height_at(-x, y)) as f32);
        // Its outside is below.
        mesh.triangles[triangles..].iter_mut().for_each(|corners| corners.swap(1, 2));
        mesh.push_walls(&top, &bottom);
        mesh
    }

    /// Returns the mesh with a side above: the back is turned over, to the height of the front of our panels.
    #[must_use]
    pub fn seen_from(mut self, side: PanelSide) -> Self {
        if side == PanelSide::Back {
            for [x, _, z] in &mut self.vertices_mm {
                (*x, *z) = (-*x, -*z - CORE_MM as f32);
            }
        }
        self
    }

    // A surface with a vertex at the centre of each cell, where heights are known, and along the edges. Returns the
    // vertices of its rim, counter-clockwise.
    fn push_grid(&mut self, cells: &HeightField, height: impl Fn(f64, f64) -> f32) -> Vec<u32> {
        let edge = cells.size_mm() / 2.0;
        let centres = (0..cells.cells()).map(|i| cells.centre_mm(i));
        let places: Vec<f64> = iter::once(-edge).chain(centres).chain(iter::once(edge)).collect();
        let first = self.vertices_mm.len();
        for y in &places {
            self.vertices_mm.extend(places.iter().map(|x| [*x as f32, *y as f32, height(*x, *y)]));
        }
        let last = places.len() - 1;
        let at = |ix: usize, iy: usize| (first + iy * places.len() + ix) as u32;
        for iy in 0..last {
            for ix in 0..last {
                let [a, b, c, d] = [at(ix, iy), at(ix + 1, iy), at(ix + 1, iy + 1), at(ix, iy + 1)];
                self.triangles.extend([[a, b, c], [a, c, d]]);
            }
        }
        let sides = [|i, _| (i, 0), |i, last| (last, i), |i, last| (last - i, last), |i, last| (0, last - i)];
        let rim = sides.iter().flat_map(|side: &fn(usize, usize) -> _| (0..last).map(move |i| side(i, last)));
        rim.map(|(ix, iy)| at(ix, iy)).collect()
    }

    fn push_walls(&mut self, top: &[u32], bottom: &[u32]) {
        for ([a, b], [c, d]) in edges_of(bottom).zip(edges_of(top)) {
            self.triangles.extend([[a, b, d], [a, d, c]]);
        }
    }

    /// The same mesh with vertices at one place made one: STL shares none.
    pub fn to_welded(&self) -> Self {
        let mut index: HashMap<[u32; 3], u32> = HashMap::new();
        let mut vertices_mm = Vec::new();
        // Adding zero turns -0.0, which has other bits, into 0.0.
        let key = |v: &[f32; 3]| v.map(|x| (x + 0.0).to_bits());
        let to: Vec<u32> = self
            .vertices_mm
            .iter()
            .map(|v| {
                *index.entry(key(v)).or_insert_with(|| {
                    vertices_mm.push(*v);
                    vertices_mm.len() as u32 - 1
                })
            })
            .collect();
        let triangles = self.triangles.iter().map(|t| t.map(|i| to[i as usize])).collect();
        Self { vertices_mm, triangles }
    }

    /// Lowest and highest corner, mm.
    pub fn bounds_mm(&self) -> [[f32; 3]; 2] {
        let used = self.triangles.iter().flatten().map(|i| self.vertices_mm[*i as usize]);
        used.fold([[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]], |[low, high], v| {
            [[0, 1, 2].map(|i| low[i].min(v[i])), [0, 1, 2].map(|i| high[i].max(v[i]))]
        })
    }

    /// Volume of a closed mesh, mm^3.
    pub fn volume_mm3(&self) -> f64 {
        let signed = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|i| self.vertices_mm[i as usize].map(f64::from));
            a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
        };
        self.triangles.iter().map(signed).sum::<f64>() / 6.0
    }

    /// Checks that the mesh is a closed solid that fits the panel and has the heights of a relief; returns it welded.
    ///
    /// # Errors
    /// [`Error::Empty`], [`Error::Open`], [`Error::TooLarge`], or [`Error::Syntax`] for numbers that are none and
    /// for holes.
    pub fn check_solid(&self, panel_mm: f64, depth_mm: f64, path: &Path) -> Result<Self, Error> {
        if self.triangles.is_empty() {
            return Err(Error::Empty { path: path.to_owned() });
        }
        if let Some(at) = self.vertices_mm.iter().position(|v| v.iter().any(|x| !x.is_finite())) {
            let actual = format!("{:?}", self.vertices_mm[at]);
            let place = format!("vertex {at}");
            return Err(Error::Syntax { path: path.to_owned(), place, actual, expected: "finite numbers" });
        }
        let [low, high] = self.bounds_mm();
        let size = [0, 1, 2].map(|i| f64::from(high[i]) - f64::from(low[i]));
        // Exporters lose up to a tenth of a millimetre.
        if size[0].max(size[1]) > panel_mm + 0.1 {
            return Err(Error::TooLarge {
                path: path.to_owned(),
                actual: format!("{:.1} x {:.1} x {:.1} mm", size[0], size[1], size[2]),
                expected: format!("up to {panel_mm} x {panel_mm} mm with a relief of {depth_mm} mm"),
            });
        }
        let welded = self.to_welded();
        if let (edges @ 1.., place) = welded.open_edges() {
            return Err(Error::Open { path: path.to_owned(), edges, place });
        }
        // Heights are found as the simulation will find them.
        welded.to_height_field(FACETS, panel_mm, depth_mm, path)?;
        Ok(welded)
    }

    // Each edge of a closed mesh is passed as often in one direction as in the other.
    fn open_edges(&self) -> (usize, [f32; 3]) {
        let mut balance: HashMap<(u32, u32), i32> = HashMap::new();
        for [a, b, c] in &self.triangles {
            for (from, to) in [(*a, *b), (*b, *c), (*c, *a)] {
                if from != to {
                    *balance.entry((from.min(to), from.max(to))).or_default() += if from < to { 1 } else { -1 };
                }
            }
        }
        let mut open: Vec<_> = balance.into_iter().filter(|(_, sum)| *sum != 0).map(|(edge, _)| edge).collect();
        open.sort_unstable();
        (open.len(), open.first().map_or([0.0; 3], |(a, _)| self.vertices_mm[*a as usize]))
    }

    /// The surface seen from above, as heights; the mesh is centred over the panel, and if it does not lie
    /// within the relief's range its top is moved so that its mean is 0.
    ///
    /// # Errors
    /// [`Error::TooLarge`] if the relief is deeper than `depth_mm`, [`Error::Syntax`] if there is no surface: a
    /// hole, or a mesh smaller than the panel.
    pub fn to_height_field(
        &self,
        cells: usize,
        panel_mm: f64,
        depth_mm: f64,
        path: &Path,
    ) -> Result<HeightField, Error> {
        let [low, high] = self.bounds_mm();
        let centre = [0, 1].map(|i| f64::from(low[i] + high[i]) / 2.0);
        let cells = cells.max(3);
        let mut tops = vec![f32::NEG_INFINITY; cells * cells];
        for triangle in &self.triangles {
            let corners = triangle.map(|i| {
                let v = self.vertices_mm[i as usize].map(f64::from);
                let cell = |x: f64, c: f64| ((x - c) / panel_mm + 0.5) * cells as f64 - 0.5;
                [cell(v[0], centre[0]), cell(v[1], centre[1]), v[2]]
            });
            rasterise_triangle(corners, cells, &mut tops);
        }
        fill_rim(&mut tops, cells);
        if let Some(hole) = tops.iter().position(|t| !t.is_finite()) {
            let bare = tops.iter().filter(|t| !t.is_finite()).count();
            let [x, y] = [(hole % cells, centre[0]), (hole / cells, centre[1])]
                .map(|(i, c)| ((i as f64 + 0.5) / cells as f64 - 0.5) * panel_mm + c);
            let cm2 = bare as f64 * (panel_mm / cells as f64 / 10.0).powi(2);
            return Err(Error::Syntax {
                path: path.to_owned(),
                place: "its view from above".to_owned(),
                actual: format!("a hole at x = {x:.0}, y = {y:.0} mm, {cm2:.1} cm² in all"),
                expected: "a surface over the whole panel",
            });
        }
        let least = tops.iter().copied().fold(f32::INFINITY, f32::min);
        let greatest = tops.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        if f64::from(greatest - least) > depth_mm + 0.1 {
            return Err(Error::TooLarge {
                path: path.to_owned(),
                actual: format!("{:.1} mm deep on its upper side", greatest - least),
                expected: format!("a relief of up to {depth_mm} mm"),
            });
        }
        let mean = tops.iter().copied().map(f64::from).sum::<f64>() / tops.len() as f64;
        let inside = f64::from(least) >= RELIEF_MM[0] - 0.1 && f64::from(greatest) <= RELIEF_MM[1] + 0.1;
        let shift = if inside { 0.0 } else { mean };
        let mut heights = tops.iter().map(|t| f64::from(*t) - shift);
        Ok(HeightField::from_fn(panel_mm, cells, |_, _| heights.next().unwrap_or(0.0)))
    }
}

// From each vertex of a closed line to the next.
fn edges_of(rim: &[u32]) -> impl Iterator<Item = [u32; 2]> {
    rim.iter().zip(rim.iter().cycle().skip(1)).map(|(from, to)| [*from, *to])
}

// The outermost cells may lie just beyond the mesh's edge: they are as high as their inner neighbours.
fn fill_rim(tops: &mut [f32], cells: usize) {
    for iy in 0..cells {
        for ix in 0..cells {
            let inner = iy.clamp(1, cells - 2) * cells + ix.clamp(1, cells - 2);
            if !tops[iy * cells + ix].is_finite() {
                tops[iy * cells + ix] = tops[inner];
            }
        }
    }
}

// Raises every cell whose centre lies under the triangle, seen from above, to the triangle.
fn rasterise_triangle(corners: [[f64; 3]; 3], cells: usize, tops: &mut [f32]) {
    let [a, b, c] = corners;
    let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
    if area.abs() < 1e-12 {
        return;
    }
    let range = |i: usize| {
        let low = corners.iter().map(|p| p[i]).fold(f64::INFINITY, f64::min).ceil().max(0.0);
        let high = corners.iter().map(|p| p[i]).fold(f64::NEG_INFINITY, f64::max).floor().min(cells as f64 - 1.0);
        if low <= high { low as usize..high as usize + 1 } else { 0..0 }
    };
    for iy in range(1) {
        for ix in range(0) {
            let x = ix as f64;
            let y = iy as f64;
            let v = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area;
            let w = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area;
            if v >= -1e-9 && w >= -1e-9 && v + w <= 1.0 + 1e-9 {
                let z = (a[2] + v * (b[2] - a[2]) + w * (c[2] - a[2])) as f32;
                let top = &mut tops[iy * cells + ix];
                *top = top.max(z);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{BACK_MM, MeshFormat};
    use super::*;
    use crate::relief::{PANEL_SIZE_MM, PanelRelief};

    #[test]
    fn a_box_has_its_volume_and_is_closed() {
        let mesh = Mesh::from_height_field(&HeightField::from_fn(100.0, 5, |_, _| 0.0), -20.0);
        assert!((mesh.volume_mm3() - 100.0 * 100.0 * 20.0).abs() < 1e-3);
        assert_eq!(mesh.check_solid(100.0, 40.0, Path::new("box")).map(drop), Ok(()));
    }

    // The thinnest and the thickest that two reliefs can make, and which way round the back is.
    #[test]
    fn a_panel_with_two_sides_fits_and_keeps_its_thickness() {
        let [low, high] = RELIEF_MM;
        let level = |mm: f64| HeightField::from_fn(PANEL_SIZE_MM, 8, move |_, _| mm);
        let thickness = |mesh: &Mesh| mesh.volume_mm3() / PANEL_SIZE_MM.powi(2);
        assert!((thickness(&Mesh::double_sided(&level(low), &level(low))) - 20.0).abs() < 1e-4);
        let thickest = Mesh::double_sided(&level(high), &level(high));
        assert!((thickness(&thickest) - 100.0).abs() < 1e-3);
        assert_eq!(thickest.check_solid(PANEL_SIZE_MM, 40.0, Path::new("panel")).map(drop), Ok(()));
        // The back's left, seen from behind, is the front's right.
        let slope = HeightField::from_fn(PANEL_SIZE_MM, 8, |x, _| x / 100.0);
        let panel = Mesh::double_sided(&level(0.0), &slope);
        let lowest = panel.vertices_mm.iter().copied().min_by(|a, b| a[2].total_cmp(&b[2])).expect("vertices");
        assert!(lowest[0] < 0.0 && lowest[2] < -44.0, "{lowest:?}");
        assert_eq!(panel.check_solid(PANEL_SIZE_MM, 40.0, Path::new("panel")).map(drop), Ok(()));
    }

    #[test]
    fn a_panel_that_is_turned_over_shows_its_back() {
        let of = |name: &str| PanelRelief::by_name(name).expect("a relief").height_field(100);
        let (front, back) = (of("river_rock"), of("macrostructure"));
        let path = Path::new("panel");
        let panel = Mesh::double_sided(&front, &back).seen_from(PanelSide::Back);
        assert_eq!(panel.check_solid(PANEL_SIZE_MM, 40.0, path).map(drop), Ok(()), "it is closed, its outside outside");
        assert!(panel.volume_mm3() > 0.0);
        let seen = panel.to_height_field(100, PANEL_SIZE_MM, 40.0, path).expect("heights");
        let off = |field: &HeightField| {
            field.heights_mm().iter().zip(seen.heights_mm()).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()))
        };
        assert!(off(&back) < 0.25, "{} mm", off(&back));
        assert!(off(&front) > 1.0);
        let front_again = Mesh::double_sided(&front, &back).seen_from(PanelSide::Front);
        assert_eq!(front_again, Mesh::double_sided(&front, &back));
    }

    // What a run's mesh shows is the wall that was measured; the heights need not be of the reliefs' range.
    #[test]
    fn heights_survive_the_way_through_a_mesh() {
        for (name, raised) in [("river_rock", 0.0), ("prd", 0.0), ("0011_1", 12.0)] {
            let field = PanelRelief::by_name(name).expect("a relief").height_field(FACETS).raised_by(raised);
            let file = Mesh::from_height_field(&field, BACK_MM).to_bytes(MeshFormat::Glb);
            let mesh = Mesh::from_bytes(MeshFormat::Glb, &file, Path::new(name)).expect("a mesh");
            let again = mesh.to_height_field(FACETS, PANEL_SIZE_MM, 40.0, Path::new(name)).expect("heights");
            let off = field.heights_mm().iter().zip(again.heights_mm()).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
            // Positions in f32 are 0.03 um off, on slopes of up to 5.
            assert!(off < 5e-4, "{name}: {off} mm");
        }
    }

    #[test]
    fn bad_meshes_are_told_apart() {
        let path = Path::new("bad.stl");
        let good = Mesh::from_height_field(&HeightField::from_fn(585.0, 5, |_, _| 0.0), -20.0);
        let mut open = good.clone();
        open.triangles.pop();
        assert!(matches!(open.check_solid(585.0, 40.0, path), Err(Error::Open { edges: 3, .. })));
        assert!(matches!(Mesh::default().check_solid(585.0, 40.0, path), Err(Error::Empty { .. })));
        assert!(matches!(good.check_solid(500.0, 40.0, path), Err(Error::TooLarge { .. })));
        let mut nan = good.clone();
        nan.vertices_mm[3][1] = f32::NAN;
        assert!(nan.check_solid(585.0, 40.0, path).expect_err("NaN").to_string().contains("vertex 3"));
        let deep =
            Mesh::from_height_field(&HeightField::from_fn(585.0, 20, |x, _| if x < 0.0 { 0.0 } else { 60.0 }), -20.0);
        assert!(matches!(deep.to_height_field(50, 585.0, 40.0, path), Err(Error::TooLarge { .. })));
        assert!(deep.check_solid(585.0, 40.0, path).expect_err("deep").to_string().contains("60.0 mm deep"));
        let small = Mesh::from_height_field(&HeightField::from_fn(100.0, 5, |_, _| 0.0), -20.0);
        assert!(small.check_solid(585.0, 40.0, path).expect_err("small").to_string().contains("a hole at x = -291"));
    }

    /// A plate from -50 mm to 0 with a square hole of this width right through it, its middle at (100, 30) mm.
    fn plate_with_hole(width: f32) -> Mesh {
        let square = |half: f32, [x, y]: [f32; 2]| {
            [[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]]
        };
        let rings = [square(292.5, [0.0, 0.0]), square(width / 2.0, [100.0, 30.0])];
        let corners = [0.0, -50.0].map(|z| rings.map(|ring| ring.map(|[x, y]| [x, y, z])));
        let vertices_mm = corners.as_flattened().as_flattened().to_vec();
        // Outer ring above 0-3, inner 4-7, the same below from 8.
        let mut triangles = Vec::new();
        let mut quad = |[a, b, c, d]: [u32; 4]| triangles.extend([[a, b, c], [a, c, d]]);
        for (i, j) in [(0, 1), (1, 2), (2, 3), (3, 0)] {
            quad([i, j, j + 4, i + 4]);
            quad([i + 12, j + 12, j + 8, i + 8]);
            quad([i + 8, j + 8, j, i]);
            quad([i + 4, j + 4, j + 12, i + 12]);
        }
        Mesh { vertices_mm, triangles }
    }

    #[test]
    fn holes_are_named_wherever_a_cell_falls_into_them() {
        for width in [60.0, 8.0] {
            let mesh = plate_with_hole(width);
            let solid = f64::from(50.0 * (585.0 * 585.0 - width * width));
            assert!((mesh.volume_mm3() / solid - 1.0).abs() < 1e-6, "a closed solid: {}", mesh.volume_mm3());
            let error = mesh.check_solid(585.0, 40.0, Path::new("hole.stl")).expect_err("a hole").to_string();
            // The first cell within the hole is next to its lower left corner.
            let [x, y] = [100.0, 30.0].map(|middle| middle - width / 2.0 + 1.0);
            let named: Vec<f32> =
                error.split(|c: char| !(c.is_ascii_digit() || c == '-')).filter_map(|word| word.parse().ok()).collect();
            assert!(error.contains("a hole at x = "), "{error}");
            assert!((named[0] - x).abs() <= 2.0 && (named[1] - y).abs() <= 2.0, "{error}");
        }
    }

    #[test]
    fn a_mesh_that_ends_within_the_outermost_cells_is_level_there() {
        let slope = HeightField::from_fn(582.0, 50, |x, _| x / 50.0);
        let mesh = Mesh::from_height_field(&slope, -20.0);
        let again = mesh.to_height_field(FACETS, 585.0, 40.0, Path::new("slope")).expect("heights");
        for iy in [0, 100, FACETS - 1] {
            assert_eq!(again.cell_height(0, iy), again.cell_height(1, iy));
            // The slope's corner, half of its own cells within the edge, is at -5.70 mm.
            assert!((again.cell_height(1, iy) + 5.69).abs() < 0.02, "{}", again.cell_height(1, iy));
        }
    }
}
