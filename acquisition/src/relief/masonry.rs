//! Bricks in stretcher and in Flemish bond, in full-scale sizes.

use super::Bond;
use super::chance::Chance;
use super::microstructure::{JOINT_DEPTH, JOINT_SHAPE, JOINT_WIDTH};
use super::parameter::{Layer, Parameter};
use super::settings::Settings;
use super::stone::{Faces, lean, projection};
use super::stones::{SEED, Spot, Stones};

const LENGTH: Parameter = Parameter::mm(
    "brick_length_mm",
    Layer::Mesostructure,
    [150.0, 600.0, 250.0],
    "length of a brick; in Flemish bond a header shows half of it, less half a joint",
);
const HEIGHT: Parameter =
    Parameter::mm("brick_height_mm", Layer::Mesostructure, [40.0, 250.0, 65.0], "height of a brick");

pub(super) const PARAMETERS: [Parameter; 8] =
    [LENGTH, HEIGHT, projection(80.0, 4.0), lean(3.0), SEED, JOINT_SHAPE, JOINT_WIDTH, JOINT_DEPTH];

/// A wall of bricks, model mm.
pub(super) struct Masonry {
    bond: Bond,
    length: f64,
    height: f64,
    joint: f64,
    faces: Faces,
    chance: Chance,
}

impl Masonry {
    pub(super) fn of(settings: &Settings, seed: u64, bond: Bond) -> Self {
        Self {
            bond,
            length: settings.model_mm(&LENGTH),
            height: settings.model_mm(&HEIGHT),
            joint: settings.model_mm(&JOINT_WIDTH),
            faces: Faces::of(settings),
            chance: Chance::new(seed, 0xB41C),
        }
    }

    /// Column, place along the brick from its middle, and half the distance between its joints' middles.
    fn along(&self, x: f64, course: i64) -> (i64, f64, f64) {
        let stretcher = self.length + self.joint;
        let header = stretcher / 2.0;
        let odd = course.rem_euclid(2) as f64;
        match self.bond {
            Bond::Stretcher => {
                let x = x + odd * stretcher / 2.0;
                let column = (x / stretcher).floor();
                (column as i64, x - (column + 0.5) * stretcher, stretcher / 2.0)
            }
            Bond::Flemish => {
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

impl Stones for Masonry {
    fn spot(&self, x: f64, y: f64, _half_joint: f64) -> Spot {
        let half_height = (self.height + self.joint) / 2.0;
        let course = (y / (2.0 * half_height)).floor();
        let dy = y - (2.0 * course + 1.0) * half_height;
        let (column, dx, half_length) = self.along(x, course as i64);
        let face = self.faces.height(self.chance.at(column, course as i64), [dx / half_length, dy / half_height], 0.0);
        Spot { to_joint: (half_length - dx.abs()).min(half_height - dy.abs()), face }
    }
}
