//! Solids of geometry on a square lattice.

use super::chance::SeededRandom;
use super::microstructure::{JOINT_SHAPE, joint_depth, joint_width};
use super::parameter::{ParameterLayer, ReliefParameter};
use super::settings::{FULL_SCALE, SolidShape, SolidTurn, WallSettings};
use super::stones::{SEED, StoneLayout, StoneSpot};

const MESO: ParameterLayer = ParameterLayer::Mesostructure;

pub(super) const PARAMETERS: [ReliefParameter; 10] = [
    ReliefParameter::new_choice(
        "primitive",
        MESO,
        &["pyramid", "hemisphere", "box", "wedge", "ridge", "cone", "cylinder"],
        "the solid that is repeated; a wedge rises to one side, a ridge to its middle line",
    ),
    ReliefParameter::new_mm("primitive_size_mm", MESO, [100.0, 2000.0, 450.0], "edge of a solid's base"),
    ReliefParameter::new_mm("primitive_height_mm", MESO, [0.0, 150.0, 150.0], "height of a solid"),
    ReliefParameter::new_mm("gap_mm", MESO, [0.0, 500.0, 30.0], "between the bases of two solids"),
    ReliefParameter::new_number("variation", MESO, "share", [0.0, 1.0, 0.0], "solids are lower by up to this share"),
    ReliefParameter::new_choice(
        "turn",
        MESO,
        &["alike", "alternating", "random"],
        "how wedges and ridges are turned, in quarter turns",
    ),
    SEED,
    JOINT_SHAPE,
    joint_width(0.0),
    joint_depth(0.0),
];

/// A lattice of solids, model mm.
pub(super) struct PrimitiveStones {
    solid: SolidShape,
    half_size: f64,
    height: f64,
    half_pitch: f64,
    variation: f64,
    turn: SolidTurn,
    chance: SeededRandom,
}

impl PrimitiveStones {
    pub fn from_settings(settings: &WallSettings) -> Self {
        let half_size = settings.primitive_size_mm / FULL_SCALE / 2.0;
        Self {
            solid: settings.primitive,
            half_size,
            height: settings.primitive_height_mm / FULL_SCALE,
            half_pitch: half_size + settings.gap_mm / FULL_SCALE / 2.0,
            variation: settings.variation,
            turn: settings.turn,
            chance: SeededRandom::new(settings.seed, 0x9813),
        }
    }

    fn turn_place(&self, place: [f64; 2], cell: [i64; 2], stone: SeededRandom) -> [f64; 2] {
        let quarters = match self.turn {
            SolidTurn::Alike => 0,
            SolidTurn::Alternating => (cell[0] + cell[1]).rem_euclid(2) as u64,
            SolidTurn::Random => stone.whole_number(3) % 4,
        };
        (0..quarters).fold(place, |[u, v], _| [v, -u])
    }
}

impl SolidShape {
    /// Height as a share of the greatest, at a place from -1 to 1 in both directions.
    fn height_share(self, [u, v]: [f64; 2]) -> f64 {
        if u.abs() > 1.0 || v.abs() > 1.0 {
            return 0.0;
        }
        let square = u * u + v * v;
        match self {
            Self::Pyramid => 1.0 - u.abs().max(v.abs()),
            Self::Hemisphere => (1.0 - square).max(0.0).sqrt(),
            Self::Box => 1.0,
            Self::Wedge => (1.0 + u) / 2.0,
            Self::Ridge => 1.0 - u.abs(),
            Self::Cone => (1.0 - square.sqrt()).max(0.0),
            Self::Cylinder => f64::from(u8::from(square <= 1.0)),
        }
    }
}

impl StoneLayout for PrimitiveStones {
    fn spot_at(&self, x: f64, y: f64, _half_joint: f64) -> StoneSpot {
        let pitch = 2.0 * self.half_pitch;
        // A solid stands in the panel's middle.
        let cell = [x, y].map(|v| (v / pitch + 0.5).floor());
        let [dx, dy] = [x - cell[0] * pitch, y - cell[1] * pitch];
        let cell = cell.map(|c| c as i64);
        let stone = self.chance.at_place(cell[0], cell[1]);
        let place = self.turn_place([dx / self.half_size, dy / self.half_size], cell, stone);
        let height = self.height * (1.0 - self.variation * stone.unit_number(0));
        let to_joint = (self.half_pitch - dx.abs()).min(self.half_pitch - dy.abs()).max(0.0);
        StoneSpot { to_joint, face: height * self.solid.height_share(place) }
    }
}
