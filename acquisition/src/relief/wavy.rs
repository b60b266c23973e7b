//! A smooth macrostructure: a few long waves in different directions.

use std::f64::consts::TAU;

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// A smooth wall at 1:10.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct WavyWall {
    /// Number of waves.
    pub waves: u64,
    /// Shortest wavelength, mm.
    pub wavelength_mm: f64,
    /// Height of the sum's crest over its trough at most, mm.
    pub depth_mm: f64,
    /// Seed of the wall's random draws.
    pub seed: u64,
}

impl Default for WavyWall {
    fn default() -> Self {
        Self { waves: 3, wavelength_mm: 250.0, depth_mm: 20.0, seed: 1 }
    }
}

/// The waves of one wall.
pub(super) struct WaveSum(Vec<Wave>);

struct Wave {
    amplitude: f64,
    kx: f64,
    ky: f64,
    phase: f64,
}

impl WavyWall {
    pub(super) fn check(&self) -> Result<(), &'static str> {
        if !(1..=32).contains(&self.waves) {
            return Err("1 to 32 waves");
        }
        if !(20.0..=10_000.0).contains(&self.wavelength_mm) || !(0.0..=22.0).contains(&self.depth_mm) {
            return Err("wavelengths from 20 mm to 10 m and depths up to 22 mm");
        }
        Ok(())
    }

    pub(super) fn waves(&self) -> WaveSum {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        let amplitude = self.depth_mm / 2.0 / self.waves as f64;
        let wave = |_| {
            let direction = rng.random_range(0.0..TAU);
            let k = TAU / (self.wavelength_mm * rng.random_range(1.0..2.0));
            Wave { amplitude, kx: k * direction.cos(), ky: k * direction.sin(), phase: rng.random_range(0.0..TAU) }
        };
        WaveSum((0..self.waves).map(wave).collect())
    }
}

impl WaveSum {
    pub(super) fn height(&self, x: f64, y: f64) -> f64 {
        self.0.iter().map(|w| w.amplitude * (w.kx * x + w.ky * y + w.phase).cos()).sum()
    }
}
