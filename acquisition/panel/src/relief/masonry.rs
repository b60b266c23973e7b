//! Bricks in stretcher and in Flemish bond, in full-scale sizes.

use super::chance::SeededRandom;
use super::microstructure::{JOINT_SHAPE, joint_depth, joint_width};
use super::parameter::{ParameterLayer, ReliefParameter};
use super::settings::{FULL_SCALE, WallSettings};
use super::stone::{StoneFaces, stone_lean, stone_projection};
use super::stones::{SEED, StoneLayout, StoneSpot};

const MESO: ParameterLayer = ParameterLayer::Mesostructure;

pub(super) const PARAMETERS: [ReliefParameter; 8] = [
    // The defaults are the German Reichsformat of 250 x 120 x 65 mm; the Swiss format is 250 x 120 x 60, NF 240 x 115 x
    // 71, DF 240 x 115 x 52, and the paper's bricks are 215 x 102.5 x 65.
    ReliefParameter::new_mm(
        "brick_length_mm",
        MESO,
        [150.0, 600.0, 250.0],
        "length of a brick; in Flemish bond a header shows half of it, less half a joint",
    ),
    ReliefParameter::new_mm("brick_height_mm", MESO, [40.0, 250.0, 65.0], "height of a brick"),
    stone_projection(80.0, 4.0),
    stone_lean(3.0),
    SEED,
    JOINT_SHAPE,
    joint_width(10.0),
    joint_depth(10.0),
];

/// Bond of a brick wall: the order of its bricks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum BrickBond {
    /// Stretchers, each course shifted by half a brick.
    Stretcher,
    /// Stretchers and headers in turn.
    Flemish,
}

/// A wall of bricks, model mm.
pub(super) struct MasonryStones {
    bond: BrickBond,
    length: f64,
    height: f64,
    joint: f64,
    faces: StoneFaces,
    chance: SeededRandom,
}

impl MasonryStones {
    pub fn from_settings(settings: &WallSettings, bond: BrickBond) -> Self {
        Self {
            bond,
            length: settings.brick_length_mm / FULL_SCALE,
            height: settings.brick_height_mm / FULL_SCALE,
            joint: settings.joint_width_mm / FULL_SCALE,
            faces: StoneFaces::from_settings(settings),
            chance: SeededRandom::new(settings.seed, 0xB41C),
        }
    }

    /// Column, place along the brick from its middle, and half the distance between its joints' middles.
    fn locate_brick(&self, x: f64, course: i64) -> (i64, f64, f64) {
        let stretcher = self.length + self.joint;
        let header = stretcher / 2.0;
        let odd = course.rem_euclid(2) as f64;
        match self.bond {
            BrickBond::Stretcher => {
                let x = x + odd * stretcher / 2.0;
                let column = (x / stretcher).floor();
                (column as i64, x - (column + 0.5) * stretcher, stretcher / 2.0)
            }
            BrickBond::Flemish => {
                let period = stretcher + header;
                // A header stands over the middle of a stretcher.
                let x = x + odd * period / 2.0;
                let unit = (x / period).floor();
                let within = x - unit * period;
                let column = 2 * unit as i64;
                if within < stretcher {
                    (column, within - stretcher / 2.0, stretcher / 2.0)
                } else {
                    (column + 1, within - stretcher - header / 2.0, header / 2.0)
                }
            }
        }
    }
}

impl StoneLayout for MasonryStones {
    fn spot_at(&self, x: f64, y: f64, _half_joint: f64) -> StoneSpot {
        let half_height = (self.height + self.joint) / 2.0;
        let course = (y / (2.0 * half_height)).floor();
        let dy = y - (2.0 * course + 1.0) * half_height;
        let (column, dx, half_length) = self.locate_brick(x, course as i64);
        let face = self.faces.face_height(
            self.chance.at_place(column, course as i64),
            [dx / half_length, dy / half_height],
            0.0,
        );
        StoneSpot { to_joint: (half_length - dx.abs()).min(half_height - dy.abs()), face }
    }
}
