//! D4, the eight symmetries of a square panel, and what they do to points and pairs.

use serde::{Deserialize, Serialize};

use crate::grid::{Grid, Pair};
use crate::{PairId, PointId};

/// One of D4's eight; acts on (x, y).
///
/// ```
/// use echolake_schema::{Rig, Symmetry};
///
/// assert_eq!(Symmetry::Rot90.move_position([1.0, 2.0, 3.0]), [-2.0, 1.0, 3.0]);
/// let moved = Rig::paper().build_grid()?.moved_pairs(Symmetry::Rot180);
/// assert_eq!(moved.map(|pairs| pairs.len()), Some(2951));
/// # Ok::<(), echolake_schema::Error>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Symmetry {
    /// Nothing moves.
    Identity,
    /// A quarter turn, counter-clockwise seen from above.
    Rot90,
    /// A half turn.
    Rot180,
    /// A quarter turn, clockwise.
    Rot270,
    /// x changes its sign.
    MirrorX,
    /// y changes its sign.
    MirrorY,
    /// x and y change places.
    MirrorDiag,
    /// x and y change places and signs.
    MirrorAnti,
}

/// Image of a pair under a symmetry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MovedPair {
    /// The measured pair that it becomes.
    pub pair: Pair,
    /// Microphone and speaker changed places, so that the pair relies on reciprocity.
    pub swapped: bool,
}

impl Symmetry {
    /// All eight, in the order of their ids.
    pub const ALL: [Self; 8] = [
        Self::Identity,
        Self::Rot90,
        Self::Rot180,
        Self::Rot270,
        Self::MirrorX,
        Self::MirrorY,
        Self::MirrorDiag,
        Self::MirrorAnti,
    ];

    /// Its stable name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Identity => "identity",
            Self::Rot90 => "rot90",
            Self::Rot180 => "rot180",
            Self::Rot270 => "rot270",
            Self::MirrorX => "mirror_x",
            Self::MirrorY => "mirror_y",
            Self::MirrorDiag => "mirror_diag",
            Self::MirrorAnti => "mirror_anti",
        }
    }

    /// The matrix that acts on the column (x, y).
    pub fn matrix(self) -> [[i32; 2]; 2] {
        match self {
            Self::Identity => [[1, 0], [0, 1]],
            Self::Rot90 => [[0, -1], [1, 0]],
            Self::Rot180 => [[-1, 0], [0, -1]],
            Self::Rot270 => [[0, 1], [-1, 0]],
            Self::MirrorX => [[-1, 0], [0, 1]],
            Self::MirrorY => [[1, 0], [0, -1]],
            Self::MirrorDiag => [[0, 1], [1, 0]],
            Self::MirrorAnti => [[0, -1], [-1, 0]],
        }
    }

    /// Moves a position; z stays.
    pub fn move_position(self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        let [[a, b], [c, d]] = self.matrix().map(|row| row.map(f64::from));
        [a * x + b * y, c * x + d * y, z]
    }
}

impl Grid {
    /// Maps points: point i moves to point `[i]`. None if the grid lacks the symmetry.
    pub fn point_permutation(&self, symmetry: Symmetry) -> Option<Vec<PointId>> {
        self.points().iter().map(|p| self.point_at(symmetry.move_position(p.position_mm)).map(|q| q.id)).collect()
    }

    /// Maps pairs: pair i moves to `[i]`. None if the grid or its set of pairs lacks the symmetry.
    pub fn moved_pairs(&self, symmetry: Symmetry) -> Option<Vec<MovedPair>> {
        let to = self.point_permutation(symmetry)?;
        self.pairs().iter().map(|pair| self.move_pair(*pair, &to)).collect()
    }

    /// Numbers the orbits of the pairs: two pairs have the same number if one of the grid's symmetries moves one to the
    /// other. `[pairs]`; numbers begin at 0, and no number is left out.
    pub fn pair_orbits(&self) -> Vec<usize> {
        let images: Vec<_> = Symmetry::ALL.into_iter().filter_map(|symmetry| self.moved_pairs(symmetry)).collect();
        let mut orbits: Vec<Option<usize>> = vec![None; self.pairs().len()];
        let mut count = 0;
        for pair in 0..orbits.len() {
            if orbits[pair].is_none() {
                images.iter().for_each(|moved| orbits[moved[pair].pair.id.index()] = Some(count));
                count += 1;
            }
        }
        orbits.into_iter().flatten().collect()
    }

    fn move_pair(&self, pair: Pair, to: &[PointId]) -> Option<MovedPair> {
        let microphone = to[pair.microphone.index()];
        let speaker = to[pair.speaker.index()];
        let (id, swapped) = match self.pair_id(microphone, speaker) {
            Some(id) => (id, false),
            None => (self.pair_id(speaker, microphone)?, true),
        };
        let PairId(index) = id;
        Some(MovedPair { pair: self.pairs()[index as usize], swapped })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Rig;

    #[test]
    fn pairs_map_onto_themselves_with_swaps() {
        let grid = Rig::paper().build_grid().expect("the built-in rig is valid");
        for symmetry in Symmetry::ALL {
            let moved = grid.moved_pairs(symmetry).expect("the grid is square");
            let mut seen: Vec<_> = moved.iter().map(|m| m.pair.id).collect();
            seen.sort();
            seen.dedup();
            assert_eq!(seen.len(), 2951, "{}", symmetry.name());
            let swapped = moved.iter().filter(|m| m.swapped).count();
            // The published combinations lose between 164 and 1050 ordered pairs under each symmetry but one.
            match symmetry {
                Symmetry::Identity => assert_eq!(swapped, 0),
                _ => assert!((164..=1050).contains(&swapped), "{} {swapped}", symmetry.name()),
            }
        }
    }

    // Burnside's lemma counts orbits without listing them: the mean number of pairs that a symmetry leaves in place.
    #[test]
    fn orbits_are_as_many_as_burnside_counts() {
        let grid = Rig::paper().build_grid().expect("the built-in rig is valid");
        let orbits = grid.pair_orbits();
        let mut fixed = 0;
        for symmetry in Symmetry::ALL {
            let moved = grid.moved_pairs(symmetry).expect("the grid is square");
            assert!(moved.iter().zip(&orbits).all(|(to, orbit)| orbits[to.pair.id.index()] == *orbit));
            fixed += moved.iter().zip(grid.pairs()).filter(|(to, from)| to.pair.id == from.id).count();
        }
        assert_eq!(orbits.iter().max().map(|last| 8 * (last + 1)), Some(fixed));
    }

    #[test]
    fn names_are_those_of_serde() {
        for symmetry in Symmetry::ALL {
            let toml = toml::to_string(&std::collections::BTreeMap::from([("s", symmetry)])).expect("text");
            assert_eq!(toml.trim(), format!("s = \"{}\"", symmetry.name()));
        }
    }
}
