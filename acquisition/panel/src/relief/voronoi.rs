//! Stones around scattered points, each of the places nearest to its own: polygonal rubble and river rock.

use std::ops::Range;

use super::PANEL_SIZE_MM;
use super::chance::SeededRandom;
use super::microstructure::{JOINT_SHAPE, joint_depth, joint_width};
use super::parameter::{ParameterLayer, ReliefParameter};
use super::settings::{FULL_SCALE, WallSettings};
use super::stone::{StoneFaces, pillow_rise, stone_bulge, stone_lean, stone_projection};
use super::stones::{SEED, StoneLayout, StoneSpot};

const MESO: ParameterLayer = ParameterLayer::Mesostructure;
/// Round stones leave this share of the way to their middle to the joint: it widens in the corners.
const CORNERS: f64 = 0.2;
/// Stones further away than this many lengths of the lattice border on no other.
const REACH: i64 = 2;
/// Stones that a place looks at are at most this many lengths of the lattice from each other, and a table of all around
/// a stone is so wide.
const SPAN: usize = 2 * REACH as usize;
const TABLE_WIDTH: usize = 2 * SPAN + 1;
/// Bulging rubble is level from this distance to its edges on, as a share of the way to its middle.
const PILLOW: f64 = 0.5;

const fn stone_size([low, high, default]: [f64; 3]) -> ReliefParameter {
    ReliefParameter::new_mm("stone_size_mm", MESO, [low, high, default], "mean distance between the middles of stones")
}

const IRREGULARITY: ReliefParameter = ReliefParameter::new_number(
    "irregularity",
    MESO,
    "share",
    [0.0, 1.0, 0.65],
    "how far the stones' middles leave their lattice: 0 makes all stones alike",
);
const ELONGATION: ReliefParameter =
    ReliefParameter::new_number("elongation", MESO, "ratio", [1.0, 3.0, 1.3], "stones are longer than high by this");

pub(super) const RUBBLE: [ReliefParameter; 10] = [
    stone_size([100.0, 1200.0, 400.0]),
    IRREGULARITY,
    ELONGATION,
    stone_projection(80.0, 20.0),
    stone_lean(10.0),
    stone_bulge(40.0, 15.0),
    SEED,
    JOINT_SHAPE,
    joint_width(20.0),
    joint_depth(15.0),
];

pub(super) const RIVER_ROCK: [ReliefParameter; 9] = [
    stone_size([80.0, 800.0, 280.0]),
    IRREGULARITY,
    ELONGATION,
    stone_projection(30.0, 20.0),
    stone_bulge(120.0, 70.0),
    SEED,
    JOINT_SHAPE,
    joint_width(15.0),
    joint_depth(20.0),
];

/// Outline of stones.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StoneOutline {
    /// Halfway to the next.
    Polygons,
    /// The same with its corners rounded, under an elliptic dome.
    Round,
}

/// A wall of cells, model mm.
pub(super) struct StoneCells {
    /// Length of the lattice along x and y.
    scale: [f64; 2],
    /// The lattice's first stone, and stones in a row.
    first: [i64; 2],
    row: usize,
    stones: Vec<Stone>,
    outline: StoneOutline,
    faces: StoneFaces,
    chance: SeededRandom,
}

struct Stone {
    /// Its middle, in lengths of the lattice.
    middle: [f64; 2],
    /// From its middle to its border, mm, as its outline measures it.
    radius: f64,
    /// Growth of the difference of the squared distances to it and to each stone around, across their border, per mm.
    slopes: [f64; TABLE_WIDTH * TABLE_WIDTH],
}

impl StoneCells {
    pub fn from_settings(settings: &WallSettings, outline: StoneOutline) -> Self {
        let size = settings.stone_size_mm / FULL_SCALE;
        let scale = [size * settings.elongation, size];
        let chance = SeededRandom::new(settings.seed, 0x5701);
        // As many stones as places of the panel look at, and those that these look at.
        let first = scale.map(|s| (-PANEL_SIZE_MM / 2.0 / s).floor() as i64 - 2 * REACH);
        let counts = first.map(|first| (-2 * first + 1) as usize);
        let stone = |n: usize| {
            let ix = first[0] + (n % counts[0]) as i64;
            let iy = first[1] + (n / counts[0]) as i64;
            // Odd rows are shifted by half a stone, so that stones without irregularity are hexagons.
            let shift = 0.5 * iy.rem_euclid(2) as f64;
            let off = |n| 0.45 * settings.irregularity * chance.at_place(ix, iy).signed_number(n);
            let middle = [ix as f64 + shift + off(8), iy as f64 + off(9)];
            Stone { middle, radius: 0.0, slopes: [0.0; TABLE_WIDTH * TABLE_WIDTH] }
        };
        let stones = (0..counts[0] * counts[1]).map(stone).collect();
        let mut cells =
            Self { scale, first, row: counts[0], stones, outline, faces: StoneFaces::from_settings(settings), chance };
        let slopes: Vec<_> = (0..cells.stones.len()).map(|own| cells.slopes_around(own)).collect();
        cells.stones.iter_mut().zip(slopes).for_each(|(stone, slopes)| stone.slopes = slopes);
        let radius = |n: usize| cells.to_border(cells.stones[n].middle, n);
        let radii: Vec<f64> = (0..cells.stones.len()).map(radius).collect();
        cells.stones.iter_mut().zip(radii).for_each(|(stone, radius)| stone.radius = radius);
        cells
    }

    /// Columns and rows of the stones around a place.
    fn lattice_around(&self, place: [f64; 2]) -> [Range<usize>; 2] {
        let counts = [self.row, self.stones.len() / self.row];
        [0, 1].map(|i| {
            let at = place[i].round() as i64 - self.first[i];
            (at - REACH).clamp(0, counts[i] as i64) as usize..(at + REACH + 1).clamp(0, counts[i] as i64) as usize
        })
    }

    fn slopes_around(&self, own: usize) -> [f64; TABLE_WIDTH * TABLE_WIDTH] {
        let middle = self.stones[own].middle;
        std::array::from_fn(|at| {
            let column = (own % self.row + at % TABLE_WIDTH).checked_sub(SPAN).filter(|column| *column < self.row);
            let row = (own / self.row + at / TABLE_WIDTH).checked_sub(SPAN);
            let other = column.zip(row).and_then(|(column, row)| self.stones.get(row * self.row + column));
            let slope = |i: usize| other.map_or(0.0, |other| 2.0 * (other.middle[i] - middle[i]) / self.scale[i]);
            (slope(0) * slope(0) + slope(1) * slope(1)).sqrt()
        })
    }

    /// From a place within a stone to the stone's border, mm.
    fn to_border(&self, place: [f64; 2], own: usize) -> f64 {
        let Stone { middle, slopes, .. } = &self.stones[own];
        let to_middle = squared_distance(place, *middle);
        let [columns, rows] = self.lattice_around(place);
        let mut least = f64::INFINITY;
        let mut inverse_squares = 0.0;
        for row in rows {
            let from = (row + SPAN - own / self.row) * TABLE_WIDTH + SPAN;
            for column in columns.clone() {
                let other = row * self.row + column;
                if other != own {
                    // The border between two is straight in the stretched lattice too.
                    let gap = squared_distance(place, self.stones[other].middle) - to_middle;
                    let distance = (gap / slopes[from + column - own % self.row]).max(1e-6);
                    least = least.min(distance);
                    inverse_squares += 1.0 / (distance * distance);
                }
            }
        }
        match self.outline {
            StoneOutline::Polygons => least,
            // Like the least of them, but smooth if two are alike.
            StoneOutline::Round => 1.0 / inverse_squares.sqrt(),
        }
    }

    /// The stone whose middle is nearest.
    fn nearest_stone(&self, place: [f64; 2]) -> usize {
        let [columns, rows] = self.lattice_around(place);
        let mut nearest = (0, f64::INFINITY);
        for row in rows {
            for n in row * self.row + columns.start..row * self.row + columns.end {
                let distance = squared_distance(place, self.stones[n].middle);
                if distance < nearest.1 {
                    nearest = (n, distance);
                }
            }
        }
        nearest.0
    }
}

fn squared_distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    let d = [a[0] - b[0], a[1] - b[1]];
    d[0] * d[0] + d[1] * d[1]
}

impl StoneLayout for StoneCells {
    fn spot_at(&self, x: f64, y: f64, half_joint: f64) -> StoneSpot {
        let place = [x / self.scale[0], y / self.scale[1]];
        let own = self.nearest_stone(place);
        let Stone { middle, radius, .. } = &self.stones[own];
        let to_border = self.to_border(place, own);
        let (to_joint, rise) = match self.outline {
            StoneOutline::Polygons => {
                let level = PILLOW * (radius - half_joint).max(0.1 * radius);
                (to_border, pillow_rise(to_border - half_joint, level))
            }
            StoneOutline::Round => {
                let to_joint = (to_border - CORNERS * radius).max(0.0);
                let dome = ((1.0 - CORNERS) * radius - half_joint).max(0.1 * radius);
                let t = ((to_joint - half_joint) / dome).clamp(0.0, 1.0);
                (to_joint, t * (2.0 - t))
            }
        };
        let stone =
            self.chance.at_place(self.first[0] + (own % self.row) as i64, self.first[1] + (own / self.row) as i64);
        let from_middle = [0, 1].map(|i| 2.0 * (place[i] - middle[i]));
        StoneSpot { to_joint, face: self.faces.face_height(stone, from_middle, rise) }
    }
}
