//! Squared stones in courses of different heights: coursed ashlar, and slate, whose courses are thin.

use super::PANEL_SIZE_MM;
use super::chance::SeededRandom;
use super::microstructure::{JOINT_SHAPE, joint_depth, joint_width};
use super::parameter::{ParameterLayer, ReliefParameter};
use super::settings::{FULL_SCALE, WallSettings};
use super::stone::{StoneFaces, pillow_rise, stone_bulge, stone_lean, stone_projection};
use super::stones::{SEED, StoneLayout, StoneSpot};

const MESO: ParameterLayer = ParameterLayer::Mesostructure;
/// Bulging stones are level from this distance to their edges on, as a share of their smaller side.
const PILLOW: f64 = 0.35;

const fn course_height([low, high, default]: [f64; 3]) -> ReliefParameter {
    ReliefParameter::new_mm("course_height_mm", MESO, [low, high, default], "mean height of a course")
}

const fn stone_length(default: f64) -> ReliefParameter {
    ReliefParameter::new_mm("stone_length_mm", MESO, [150.0, 1500.0, default], "mean length of a stone")
}

const fn size_variation(default: f64) -> ReliefParameter {
    let about = "courses and stones differ from their mean by up to this share of it";
    ReliefParameter::new_number("variation", MESO, "share", [0.0, 0.7, default], about)
}

pub(super) const ASHLAR: [ReliefParameter; 10] = [
    course_height([80.0, 600.0, 250.0]),
    stone_length(500.0),
    size_variation(0.4),
    stone_projection(80.0, 15.0),
    stone_lean(5.0),
    stone_bulge(40.0, 10.0),
    SEED,
    JOINT_SHAPE,
    joint_width(10.0),
    joint_depth(10.0),
];

/// Slate is laid nearly dry.
pub(super) const SLATE: [ReliefParameter; 10] = [
    course_height([20.0, 150.0, 50.0]),
    stone_length(600.0),
    size_variation(0.6),
    stone_projection(80.0, 60.0),
    stone_lean(10.0),
    stone_bulge(40.0, 0.0),
    SEED,
    JOINT_SHAPE,
    joint_width(4.0),
    joint_depth(20.0),
];

/// A wall in courses, model mm.
pub(super) struct CoursedStones {
    courses: Vec<StoneCourse>,
    faces: StoneFaces,
    chance: SeededRandom,
}

struct StoneCourse {
    top: f64,
    height: f64,
    /// Right ends of its stones, ascending.
    ends: Vec<f64>,
}

impl CoursedStones {
    pub fn from_settings(settings: &WallSettings) -> Self {
        let height = settings.course_height_mm / FULL_SCALE;
        let length = settings.stone_length_mm / FULL_SCALE;
        let variation = settings.variation;
        let chance = SeededRandom::new(settings.seed, 0xA541);
        let half = PANEL_SIZE_MM / 2.0;
        let mut courses = Vec::<StoneCourse>::new();
        let mut top = -half - height * chance.unit_number(0);
        while top < half {
            let row = chance.at_place(-1, courses.len() as i64);
            let height = height * (1.0 + variation * row.signed_number(0));
            top += height;
            let below = courses.last().map_or(&[][..], |c: &StoneCourse| &c.ends);
            courses.push(StoneCourse { top, height, ends: stone_ends(row, length, variation, below) });
        }
        Self { courses, faces: StoneFaces::from_settings(settings), chance }
    }
}

// Ends of a course's stones from beyond the left to beyond the right of the panel. Joints do not run on from one
// course into the next: an end that falls next to one below is moved off it.
fn stone_ends(row: SeededRandom, length: f64, variation: f64, below: &[f64]) -> Vec<f64> {
    let clear = 0.15 * length * (1.0 - variation);
    let mut at = -PANEL_SIZE_MM / 2.0 - 2.0 * length * row.unit_number(1);
    let mut ends = Vec::new();
    for n in 2.. {
        at += length * (1.0 + variation * row.signed_number(n));
        if let Some(near) = below.iter().find(|end| (**end - at).abs() < clear) {
            at = near + clear;
        }
        ends.push(at);
        if at > PANEL_SIZE_MM / 2.0 {
            break;
        }
    }
    ends
}

impl StoneLayout for CoursedStones {
    fn spot_at(&self, x: f64, y: f64, half_joint: f64) -> StoneSpot {
        let row = self.courses.partition_point(|c| c.top <= y).min(self.courses.len() - 1);
        let course = &self.courses[row];
        let column = course.ends.partition_point(|end| *end <= x).min(course.ends.len() - 1);
        let right = course.ends[column];
        // What lies left of the first end begins far beyond the panel.
        let left = column.checked_sub(1).map_or(right - 2.0 * PANEL_SIZE_MM, |before| course.ends[before]);
        let half_length = (right - left) / 2.0;
        let half_height = course.height / 2.0;
        let dx = x - (left + right) / 2.0;
        let dy = y - (course.top - half_height);
        let to_joint = (half_length - dx.abs()).min(half_height - dy.abs()).max(0.0);
        let stone = self.chance.at_place(column as i64, row as i64);
        let rise = pillow_rise(to_joint - half_joint, PILLOW * 2.0 * half_height.min(half_length));
        StoneSpot { to_joint, face: self.faces.face_height(stone, [dx / half_length, dy / half_height], rise) }
    }
}
