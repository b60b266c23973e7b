//! Reliefs with parameters drawn at random: walls of every typology, as many as are wanted.

use rand::seq::SliceRandom as _;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{BrickBond, BrickWall, PanelRelief, PrimitiveRootDiffuser, WavyWall};

/// Primes p with p - 1 = n (n + 1), n = 5 to 27: nearly square wells, from 117 mm down to 21 mm wide.
const PRIMES: [u64; 11] = [31, 43, 73, 157, 211, 241, 307, 421, 463, 601, 757];
/// The generators' streams: those of the decks lie apart from those of the reliefs.
const DECKS: u64 = 1 << 63;

/// Kinds of reliefs that are drawn.
#[derive(Debug, Clone, Copy)]
enum Typology {
    Stretcher,
    Flemish,
    Prd,
    Wavy,
}

impl PanelRelief {
    /// Relief `number` of the collection that `seed` names; it does not depend on how many there are. Every four from
    /// a multiple of four are one each of bricks in stretcher and in Flemish bond, diffusers and waves, in any order.
    /// Planes are not among them.
    pub fn drawn(seed: u64, number: u64) -> Self {
        use Typology::{Flemish, Prd, Stretcher, Wavy};
        let mut deck = [Stretcher, Flemish, Prd, Wavy];
        let cards = deck.len() as u64;
        deck.shuffle(&mut generator(seed, DECKS | (number / cards)));
        let mut rng = generator(seed, number);
        match deck[(number % cards) as usize] {
            Stretcher => Self::Brick(bricks(&mut rng, BrickBond::Stretcher)),
            Flemish => Self::Flemish(bricks(&mut rng, BrickBond::Flemish)),
            Prd => Self::Prd(diffuser(&mut rng)),
            Wavy => Self::Wavy(waves(&mut rng)),
        }
    }
}

fn generator(seed: u64, stream: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(stream);
    rng
}

fn bricks(rng: &mut ChaCha8Rng, bond: BrickBond) -> BrickWall {
    BrickWall {
        bond,
        length_mm: tenths(rng, 40.0, 120.0),
        height_mm: tenths(rng, 15.0, 45.0),
        joint_width_mm: tenths(rng, 2.0, 8.0),
        joint_depth_mm: tenths(rng, 2.0, 10.0),
        jitter_mm: tenths(rng, 0.0, 6.0),
        tilt_deg: tenths(rng, 0.0, 3.0),
        seed: wall(rng),
    }
}

fn diffuser(rng: &mut ChaCha8Rng) -> PrimitiveRootDiffuser {
    PrimitiveRootDiffuser { prime: PRIMES[rng.random_range(0..PRIMES.len())], depth_mm: tenths(rng, 8.0, 38.0) }
}

fn waves(rng: &mut ChaCha8Rng) -> WavyWall {
    WavyWall {
        waves: rng.random_range(1..=8),
        wavelength_mm: tenths(rng, 60.0, 500.0),
        depth_mm: tenths(rng, 6.0, 22.0),
        seed: wall(rng),
    }
}

// Parameters are rounded, so that they are easy to read and survive being written as text.
fn tenths(rng: &mut ChaCha8Rng, low: f64, high: f64) -> f64 {
    (rng.random_range(low..=high) * 10.0).round() / 10.0
}

fn wall(rng: &mut ChaCha8Rng) -> u64 {
    rng.random_range(1..=999_999)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::relief::RELIEF_MM;

    #[test]
    fn the_same_seed_draws_the_same_reliefs() {
        let drawn = |seed| (0..100).map(|n| PanelRelief::drawn(seed, n)).collect::<Vec<_>>();
        assert_eq!(drawn(1), drawn(1));
        let (one, two) = (drawn(1), drawn(2));
        // Of two drawn diffusers one pair in thousands is the same by chance.
        let same = one.iter().zip(&two).filter(|(a, b)| a == b).count();
        assert!(same <= 1, "{same} of 100 reliefs are the same under another seed");
        let distinct: BTreeSet<_> = one.iter().map(|r| format!("{r:?}")).collect();
        assert!(distinct.len() >= 99, "{} of 100", distinct.len());
    }

    #[test]
    fn every_typology_occurs_in_every_four() {
        for block in 0..50u64 {
            let names: BTreeSet<_> = (0..4).map(|n| PanelRelief::drawn(7, 4 * block + n).name()).collect();
            assert_eq!(names, BTreeSet::from(["brick", "flemish", "prd", "wavy"]), "block {block}");
        }
        let first: BTreeSet<_> = (0..50).map(|block| PanelRelief::drawn(7, 4 * block).name()).collect();
        assert_eq!(first.len(), 4, "the order changes");
    }

    #[test]
    fn every_drawn_relief_can_be_made() {
        for (seed, number) in [1u64, 2, 3].into_iter().flat_map(|seed| (0..200u64).map(move |n| (seed, n))) {
            let relief = PanelRelief::drawn(seed, number);
            assert_eq!(relief.check(), Ok(()), "{relief:?}");
            let [low, high] = relief.height_field(100).extent_mm().map(f64::from);
            assert!(low >= RELIEF_MM[0] && high <= RELIEF_MM[1] && high - low > 1.0, "{low} to {high}: {relief:?}");
        }
    }

    #[test]
    fn the_primes_make_wells_that_are_nearly_square() {
        for prime in PRIMES {
            let diffuser = PrimitiveRootDiffuser { prime, ..PrimitiveRootDiffuser::default() };
            assert_eq!(diffuser.check(), Ok(()));
            let (n, m) = diffuser.sides().expect("sides");
            assert_eq!(m, n + 1, "{prime}");
        }
    }
}
