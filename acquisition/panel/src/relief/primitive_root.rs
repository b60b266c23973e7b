//! The 2D primitive-root diffuser: wells whose depths follow the powers of a primitive root modulo a prime.

use super::PANEL_SIZE_MM;
use super::parameter::{ParameterLayer, ParameterValue, ReliefParameter};

/// Parameters of relief `prd`; its lengths are the panel's own.
pub(super) const PARAMETERS: [ReliefParameter; 2] = [
    ReliefParameter::new_whole("prime", ParameterLayer::Whole, [5, LARGEST_PRIME, 157], "the prime p; p - 1 wells"),
    ReliefParameter::new_number(
        "depth_mm",
        ParameterLayer::Whole,
        "mm on the panel",
        [0.1, 38.0, 38.0],
        "depth of the deepest well under the highest",
    ),
];

/// A 2D primitive-root diffuser of p - 1 wells in a rectangle.
///
/// Well k is g^k mod p deep, in units of the greatest depth over p; the sequence goes along the rectangle's
/// diagonal, which by the Chinese remainder theorem meets every well once if the sides have no common factor.
/// Source: Cox and D'Antonio, Acoustic Absorbers and Diffusers, chapter on Schroeder diffusers.
#[derive(Debug, Clone, PartialEq)]
pub struct PrimitiveRootDiffuser {
    /// The prime. 157 makes 12 x 13 wells of 49 x 45 mm.
    pub prime: u64,
    /// Depth of the deepest well under the highest, mm.
    pub depth_mm: f64,
}

impl Default for PrimitiveRootDiffuser {
    fn default() -> Self {
        Self { prime: 157, depth_mm: 38.0 }
    }
}

/// Largest prime that is taken: its wells are 6 mm wide.
const LARGEST_PRIME: u64 = 10_007;

impl PrimitiveRootDiffuser {
    /// Sets the prime to a whole number, or the depth to a number, of their [`PARAMETERS`].
    ///
    /// # Errors
    /// Returns the expected value.
    pub(super) fn set_value(&mut self, value: &ParameterValue) -> Result<(), &'static str> {
        match *value {
            ParameterValue::Whole(prime) if is_prime(prime) && (Self { prime, ..*self }).well_counts().is_some() => {
                self.prime = prime;
            }
            ParameterValue::Number(depth_mm) => self.depth_mm = depth_mm,
            _ => return Err("a prime from 5 to 10007 with p - 1 = n m, n and m without a common factor"),
        }
        Ok(())
    }

    /// Wells along x and y: the squarest rectangle whose sides have no common factor.
    pub fn well_counts(&self) -> Option<(u64, u64)> {
        let wells = self.prime.saturating_sub(1);
        let coprime = |n: &u64| wells.is_multiple_of(*n) && gcd(*n, wells / n) == 1;
        let narrow = (2..=wells.isqrt()).rev().find(coprime)?;
        Some((narrow, wells / narrow))
    }

    /// The least primitive root.
    pub fn least_root(&self) -> u64 {
        (2..self.prime).find(|g| self.is_root(*g)).unwrap_or(1)
    }

    /// g^k mod p for k = 0 to p - 2.
    pub fn root_sequence(&self) -> Vec<u64> {
        let root = self.least_root();
        std::iter::successors(Some(1), |x| Some(x * root % self.prime)).take(self.prime as usize - 1).collect()
    }

    /// Depth of each well, mm, row by row along x.
    pub(super) fn depths_mm(&self) -> Vec<f64> {
        let Some((n, m)) = self.well_counts() else { return vec![0.0] };
        let mut depths = vec![0.0; (n * m) as usize];
        for (k, value) in (0u64..).zip(self.root_sequence()) {
            let x = k % n;
            let y = k % m;
            depths[(y * n + x) as usize] = value as f64 * self.depth_mm / self.prime as f64;
        }
        depths
    }

    /// Height at a place; the mean of all wells is 0.
    pub(super) fn height_at(&self, depths: &[f64], x: f64, y: f64) -> f64 {
        let (n, m) = self.well_counts().unwrap_or((1, 1));
        let well = |v: f64, count: u64| (((v / PANEL_SIZE_MM + 0.5) * count as f64) as u64).min(count - 1);
        // Depths run from depth/p to depth (p-1)/p, so half of it is their mean; 9 mm up keeps them in the relief.
        let depth = depths[(well(y, m) * n + well(x, n)) as usize];
        self.depth_mm / 2.0 - depth + 9.0
    }

    // g is a root if no power g^((p-1)/q), q a prime factor of p - 1, is 1.
    fn is_root(&self, g: u64) -> bool {
        let order = self.prime - 1;
        prime_factors(order).into_iter().all(|q| power_mod(g, order / q, self.prime) != 1)
    }
}

fn is_prime(n: u64) -> bool {
    n >= 2 && prime_factors(n) == [n]
}

fn prime_factors(mut n: u64) -> Vec<u64> {
    let mut factors = Vec::new();
    let mut q = 2;
    while q * q <= n {
        if n.is_multiple_of(q) {
            factors.push(q);
            while n.is_multiple_of(q) {
                n /= q;
            }
        }
        q += 1;
    }
    if n > 1 {
        factors.push(n);
    }
    factors
}

fn power_mod(base: u64, mut exponent: u64, modulus: u64) -> u64 {
    let mut result = 1;
    let mut square = base % modulus;
    while exponent > 0 {
        if exponent % 2 == 1 {
            result = result * square % modulus;
        }
        square = square * square % modulus;
        exponent /= 2;
    }
    result
}

fn gcd(a: u64, b: u64) -> u64 {
    if b == 0 { a } else { gcd(b, a % b) }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;

    #[test]
    fn the_default_is_12_by_13_and_every_depth_stands_once() {
        let prd = PrimitiveRootDiffuser::default();
        assert_eq!(prd.well_counts(), Some((12, 13)));
        let mut sequence = prd.root_sequence();
        sequence.sort_unstable();
        assert_eq!(sequence, (1..157).collect::<Vec<_>>());
        assert!(prd.depths_mm().iter().all(|d| *d > 0.0), "the diagonal meets every well");
    }

    // The defining property: at the design frequency all diffraction orders but the specular one are equally
    // strong, |DFT|^2 = p, and the specular one is 1.
    #[test]
    fn its_spectrum_is_flat() {
        let prd = PrimitiveRootDiffuser::default();
        let (sequence, p) = (prd.root_sequence(), prd.prime as f64);
        for order in 0..sequence.len() {
            let (mut re, mut im) = (0.0, 0.0);
            for (k, value) in sequence.iter().enumerate() {
                let angle = TAU * (*value as f64 / p - (k * order) as f64 / (p - 1.0));
                re += angle.cos();
                im += angle.sin();
            }
            let expected = if order == 0 { 1.0 } else { p };
            assert!((re * re + im * im - expected).abs() < 1e-6, "{order}");
        }
    }

    #[test]
    fn what_is_no_diffuser_is_refused() {
        let mut prd = PrimitiveRootDiffuser::default();
        for prime in [0, 4, 5, 9, 17, 15, 10_008] {
            assert!(prd.set_value(&ParameterValue::Whole(prime)).is_err(), "{prime}");
        }
        assert_eq!(prd.set_value(&ParameterValue::Whole(31)), Ok(()));
        assert_eq!(prd.well_counts(), Some((5, 6)));
    }
}
