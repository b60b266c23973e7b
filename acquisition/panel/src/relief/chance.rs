//! Chance that is the same everywhere: numbers out of integers alone, and functions out of sums and products alone,
//! so that a relief has the same bits on every machine, whatever its mathematics library.

/// Numbers that belong to a seed and a purpose.
#[derive(Debug, Clone, Copy)]
pub(super) struct SeededRandom(u64);

/// The finaliser of SplitMix64 (Steele, Lea, Flood 2014, "Fast splittable pseudorandom number generators").
const fn mix_bits(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ (x >> 31)
}

/// SplitMix64's increment: the golden ratio in 64 bits.
const STEP: u64 = 0x9E37_79B9_7F4A_7C15;

impl SeededRandom {
    pub fn new(seed: u64, purpose: u64) -> Self {
        Self(mix_bits(seed.wrapping_mul(STEP).wrapping_add(mix_bits(purpose.wrapping_add(STEP)))))
    }

    /// The chance of one place of a lattice.
    pub fn at_place(self, x: i64, y: i64) -> Self {
        let row = mix_bits(self.0.wrapping_add((y as u64).wrapping_mul(STEP)));
        Self(mix_bits(row ^ (x as u64).wrapping_mul(0xD6E8_FEB8_6659_FD93)))
    }

    /// The `n`-th number of it, 0 to 1 (never 1).
    pub fn unit_number(self, n: u64) -> f64 {
        (self.whole_number(n) >> 11) as f64 / (1u64 << 53) as f64
    }

    /// The same, -1 to 1.
    pub fn signed_number(self, n: u64) -> f64 {
        2.0 * self.unit_number(n) - 1.0
    }

    /// The `n`-th whole number of it.
    pub fn whole_number(self, n: u64) -> u64 {
        mix_bits(self.0.wrapping_add((n + 1).wrapping_mul(STEP)))
    }

    /// Returns 0 to `count - 1` in an order of chance.
    pub fn random_order(self, count: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..count).collect();
        order.sort_by_key(|n| self.at_place(*n as i64, 1).whole_number(0));
        order
    }

    /// Smooth noise over the plane, -1 to 1, with features of about the length 1.
    pub fn smooth_noise(self, x: f64, y: f64) -> f64 {
        let ix = x.floor();
        let iy = y.floor();
        let corner = |dx: i64, dy: i64| self.at_place(ix as i64 + dx, iy as i64 + dy).signed_number(0);
        let u = fade_curve(x - ix);
        let v = fade_curve(y - iy);
        let low = corner(0, 0) + (corner(1, 0) - corner(0, 0)) * u;
        let high = corner(0, 1) + (corner(1, 1) - corner(0, 1)) * u;
        low + (high - low) * v
    }
}

// Level at both ends, so that the lattice does not show (Perlin 2002, "Improving noise").
fn fade_curve(t: f64) -> f64 {
    t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
}

/// Cosine of a number of whole turns, within 1e-12.
pub(super) fn cosine_of_turns(turns: f64) -> f64 {
    let t = (turns - (turns + 0.5).floor()).abs();
    // cos(2 pi t) is sin(2 pi (1/4 - t)), whose argument is within a quarter turn: Taylor's series to x^17.
    let x = std::f64::consts::TAU * (0.25 - t);
    let square = x * x;
    let series = (1..=8).rev().fold(1.0, |sum, k| 1.0 - sum * square / f64::from(2 * k * (2 * k + 1)));
    x * series
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cosine_is_the_cosine() {
        for step in -4000..4000 {
            let turns = f64::from(step) * 0.001_37;
            let off = cosine_of_turns(turns) - (turns * std::f64::consts::TAU).cos();
            assert!(off.abs() < 1e-12, "{turns}: {off}");
        }
    }

    #[test]
    fn numbers_are_spread_evenly_and_tell_places_apart() {
        let chance = SeededRandom::new(1, 2);
        let mut tenths = [0; 10];
        for x in -50..50 {
            for y in -50..50 {
                tenths[(chance.at_place(x, y).unit_number(0) * 10.0) as usize] += 1;
            }
        }
        // 10,000 draws: a tenth holds 1000 with a standard deviation of 30.
        assert!(tenths.iter().all(|n| (880..1120).contains(n)), "{tenths:?}");
        assert_ne!(chance.at_place(0, 1).whole_number(0), chance.at_place(1, 0).whole_number(0));
        assert_ne!(SeededRandom::new(1, 2).whole_number(0), SeededRandom::new(2, 1).whole_number(0));
    }

    #[test]
    fn noise_is_smooth_and_bounded() {
        let chance = SeededRandom::new(7, 0);
        let mut last = chance.smooth_noise(-3.0, 0.4);
        for step in 1..6000 {
            let now = chance.smooth_noise(-3.0 + f64::from(step) * 1e-3, 0.4);
            assert!(now.abs() <= 1.0 && (now - last).abs() < 5e-3, "{step}: {last} {now}");
            last = now;
        }
    }
}
