//! Brick walls: stretcher and Flemish bond, with joints and bricks that do not lie quite true.

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// A brick wall at 1:10.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BrickWall {
    /// Bond of the wall.
    pub bond: BrickBond,
    /// Length of a stretcher, mm; a header is half as long, less half a joint.
    pub length_mm: f64,
    /// Height of a course without its joint, mm.
    pub height_mm: f64,
    /// Width of the joints, mm.
    pub joint_width_mm: f64,
    /// Depth of the joints, mm.
    pub joint_depth_mm: f64,
    /// Largest height of a brick over or under the wall's plane, mm.
    pub jitter_mm: f64,
    /// Largest tilt of a brick, degrees.
    pub tilt_deg: f64,
    /// Seed of the wall's random draws.
    pub seed: u64,
}

/// Bond of a brick wall: the order of its bricks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BrickBond {
    /// Stretchers, each course shifted by half a brick.
    Stretcher,
    /// Stretchers and headers in turn.
    Flemish,
}

/// One brick, and the position of the queried point in it.
struct Brick {
    column: i64,
    course: i64,
    /// From the brick's centre, mm.
    offset: [f64; 2],
    /// Of the brick without joints, mm.
    size: [f64; 2],
}

impl Default for BrickWall {
    fn default() -> Self {
        Self {
            bond: BrickBond::Stretcher,
            length_mm: 80.0,
            height_mm: 30.0,
            joint_width_mm: 4.0,
            joint_depth_mm: 8.0,
            jitter_mm: 3.0,
            tilt_deg: 1.5,
            seed: 1,
        }
    }
}

impl BrickWall {
    pub(super) fn check(&self) -> Result<(), &'static str> {
        let within = |x: f64, low: f64, high: f64| (low..=high).contains(&x);
        if !within(self.length_mm, 5.0, 585.0) || !within(self.height_mm, 2.0, 585.0) {
            return Err("bricks 5 to 585 mm long and 2 to 585 mm high");
        }
        if !within(self.joint_width_mm, 0.0, self.length_mm / 4.0) || !within(self.joint_depth_mm, 0.0, 10.0) {
            return Err("joints up to a quarter brick wide and 10 mm deep");
        }
        if !within(self.jitter_mm, 0.0, 10.0) || !within(self.tilt_deg, 0.0, 5.0) {
            return Err("bricks that stand out by up to 10 mm and tilt by up to 5 degrees");
        }
        Ok(())
    }

    pub(super) fn height(&self, x: f64, y: f64) -> f64 {
        let brick = self.brick(x, y);
        let in_joint = brick.offset.iter().zip(brick.size).any(|(o, s)| o.abs() > s / 2.0);
        if in_joint {
            return -self.joint_depth_mm;
        }
        let mut rng = self.rng(brick.column, brick.course);
        let mut within = |limit: f64| limit * rng.random_range(-1.0..=1.0);
        let out = within(self.jitter_mm);
        let slope = [within(self.tilt_deg), within(self.tilt_deg)].map(|deg| deg.to_radians().tan());
        (out + slope[0] * brick.offset[0] + slope[1] * brick.offset[1]).clamp(-9.0, 9.0)
    }

    fn brick(&self, x: f64, y: f64) -> Brick {
        let course_pitch = self.height_mm + self.joint_width_mm;
        let course = (y / course_pitch).floor() as i64;
        let dy = y - (course as f64 + 0.5) * course_pitch;
        let stretcher = self.length_mm + self.joint_width_mm;
        let odd = course.rem_euclid(2) == 1;
        let (column, dx, width) = match self.bond {
            BrickBond::Stretcher => {
                let x = if odd { x + stretcher / 2.0 } else { x };
                let column = (x / stretcher).floor();
                (column as i64, x - (column + 0.5) * stretcher, self.length_mm)
            }
            BrickBond::Flemish => {
                let header = stretcher / 2.0;
                let period = stretcher + header;
                // A header stands over the middle of a stretcher.
                let x = if odd { x + period / 2.0 } else { x };
                let unit = (x / period).floor();
                let in_unit = x - unit * period;
                match in_unit < stretcher {
                    true => (2 * unit as i64, in_unit - stretcher / 2.0, self.length_mm),
                    false => (2 * unit as i64 + 1, in_unit - stretcher - header / 2.0, header - self.joint_width_mm),
                }
            }
        };
        Brick { column, course, offset: [dx, dy], size: [width, self.height_mm] }
    }

    // Each brick has a generator of its own, so that its look does not depend on the order of asking.
    fn rng(&self, column: i64, course: i64) -> ChaCha8Rng {
        let place = ((column as u64) << 32) ^ (course as u64 & 0xFFFF_FFFF);
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(place);
        rng
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joints_lie_between_the_bricks() {
        let wall = BrickWall { jitter_mm: 0.0, tilt_deg: 0.0, ..BrickWall::default() };
        // The first course spans y = 0 to 34, its first brick x = 0 to 84, joints around it.
        assert_eq!(wall.height(42.0, 17.0), 0.0);
        assert_eq!(wall.height(0.5, 17.0), -8.0);
        assert_eq!(wall.height(42.0, 0.5), -8.0);
        assert_eq!(wall.height(42.0, 34.0 + 17.0), -8.0, "the next course is shifted by half a brick");
    }

    #[test]
    fn seeds_tell_walls_apart() {
        let height = |seed| BrickWall { seed, ..BrickWall::default() }.height(42.0, 17.0);
        assert_eq!(height(1), height(1));
        assert_ne!(height(1), height(2));
    }
}
