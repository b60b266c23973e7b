//! Diffusion coefficient of a surface: evenness of the levels at its receivers.

/// Sums that the directional diffusion coefficient needs, kept relative to the loudest so that no level overflows.
///
/// d = ((sum e)^2 - sum e^2) / ((n - 1) sum e^2), e = 10^(L/10), over n receivers: 1 if all levels are equal, 0 if
/// all energy is at one. The autocorrelation coefficient of ISO 17497-2:2012, all receivers of equal weight. That
/// standard asks for receivers in the far field; on the grid of a rig they are in the near field, and the number
/// compares surfaces measured alike, no more.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DiffusionSums {
    receivers: u64,
    loudest_db: f64,
    /// Sum of the energies over that of the loudest.
    energy: f64,
    /// Sum of their squares.
    square: f64,
}

impl Default for DiffusionSums {
    fn default() -> Self {
        Self { receivers: 0, loudest_db: f64::NEG_INFINITY, energy: 0.0, square: 0.0 }
    }
}

impl DiffusionSums {
    /// Adds a receiver by its level, dB. Minus infinity is a receiver without sound; NaN makes the coefficient NaN.
    pub fn add_level(&mut self, level_db: f64) {
        let (energy, square) = if level_db == f64::NEG_INFINITY { (0.0, 0.0) } else { (1.0, 1.0) };
        self.merge(&Self { receivers: 1, loudest_db: level_db, energy, square });
    }

    /// Adds the receivers of another.
    pub fn merge(&mut self, other: &Self) {
        self.receivers += other.receivers;
        if other.energy == 0.0 {
            return;
        }
        if self.energy == 0.0 {
            (self.loudest_db, self.energy, self.square) = (other.loudest_db, other.energy, other.square);
            return;
        }
        let loudest = self.loudest_db.max(other.loudest_db);
        let ours = energy_ratio(self.loudest_db, loudest);
        let theirs = energy_ratio(other.loudest_db, loudest);
        self.loudest_db = loudest;
        self.energy = self.energy * ours + other.energy * theirs;
        self.square = self.square * ours * ours + other.square * theirs * theirs;
    }

    /// The coefficient; None of fewer than two receivers, or of no sound.
    pub fn coefficient(&self) -> Option<f64> {
        if self.receivers < 2 || self.square == 0.0 {
            return None;
        }
        let others = (self.receivers - 1) as f64;
        Some((self.energy * self.energy - self.square) / (others * self.square))
    }

    /// The sums as numbers: receivers, loudest level, energy and square relative to it.
    pub fn parts(&self) -> (u64, f64, f64, f64) {
        (self.receivers, self.loudest_db, self.energy, self.square)
    }

    /// From [`Self::parts`].
    pub fn from_parts((receivers, loudest_db, energy, square): (u64, f64, f64, f64)) -> Self {
        Self { receivers, loudest_db, energy, square }
    }
}

/// Energy of a level over that of the loudest. Two infinite ones are NaN, as is one that is NaN.
fn energy_ratio(level_db: f64, loudest_db: f64) -> f64 {
    if level_db == loudest_db && level_db.is_finite() { 1.0 } else { 10f64.powf((level_db - loudest_db) / 10.0) }
}

/// The coefficient of one list of levels, dB; None of fewer than two, or of no sound.
///
/// ```
/// use echolake_dsp::diffusion::diffusion_of_levels;
///
/// assert_eq!(diffusion_of_levels(&[60.0, 60.0, 60.0]), Some(1.0));
/// assert_eq!(diffusion_of_levels(&[60.0, f64::NEG_INFINITY, f64::NEG_INFINITY]), Some(0.0));
/// ```
pub fn diffusion_of_levels<T: crate::RealSample>(levels_db: &[T]) -> Option<f64> {
    let mut sums = DiffusionSums::default();
    levels_db.iter().for_each(|level| sums.add_level(level.f64()));
    sums.coefficient()
}

/// Diffusion coefficient normalised by that of a flat panel of the same size: (d - d_flat) / (1 - d_flat). None if the
/// flat panel is as even as can be.
///
/// Source: ISO 17497-2:2012, formula 7.
pub fn normalise_diffusion(coefficient: f64, flat: f64) -> Option<f64> {
    (flat < 1.0).then(|| (coefficient - flat) / (1.0 - flat))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_levels_are_diffuse_and_one_direction_is_not() {
        for level in [-300.0, 0.0, 94.0, 4_000.0] {
            assert!((diffusion_of_levels(&[level; 37]).expect("one") - 1.0).abs() < 1e-12, "{level}");
        }
        let mut one = [f64::NEG_INFINITY; 37];
        one[20] = 80.0;
        assert_eq!(diffusion_of_levels(&one), Some(0.0));
        one.fill(-40.0);
        one[3] = 80.0;
        assert!(diffusion_of_levels(&one).expect("one") < 1e-10);
        // Half of the receivers alike, the others silent: (n/2 - 1) / (n - 1).
        let half: Vec<f32> = (0..10).map(|i| if i < 5 { 3.0 } else { f32::NEG_INFINITY }).collect();
        assert!((diffusion_of_levels(&half).expect("one") - 4.0 / 9.0).abs() < 1e-12);
    }

    #[test]
    fn the_formula_itself() {
        let levels = [3.0f64, -1.5, 7.25, 0.0, 2.0];
        let e: Vec<f64> = levels.iter().map(|l| 10f64.powf(l / 10.0)).collect();
        let (sum, square) = (e.iter().sum::<f64>(), e.iter().map(|e| e * e).sum::<f64>());
        let expected = (sum * sum - square) / (4.0 * square);
        assert!((diffusion_of_levels(&levels).expect("one") - expected).abs() < 1e-12);
        let (mut first, mut second) = (DiffusionSums::default(), DiffusionSums::default());
        levels[..2].iter().for_each(|l| first.add_level(*l));
        levels[2..].iter().for_each(|l| second.add_level(*l));
        first.merge(&DiffusionSums::from_parts(second.parts()));
        first.merge(&DiffusionSums::default());
        assert!((first.coefficient().expect("one") - expected).abs() < 1e-12);
    }

    // 6 periods of the sequence n^2 mod 7, 0.2 m deep and 3.6 m wide, at 1 kHz. Cox and D'Antonio 2017, Acoustic
    // Absorbers and Diffusers, equations 5.8 and 9.32: wells change the phase, Fraunhofer's far field of their sum.
    fn fraunhofer_level(angle_deg: f64, deepest_m: f64) -> f64 {
        let wave_number = std::f64::consts::TAU * 1e3 / 343.0;
        let (sine, cosine) = angle_deg.to_radians().sin_cos();
        let well = |n: i32| {
            let depth = f64::from(n * n % 7) / 4.0 * deepest_m;
            let place = (f64::from(n) - 20.5) * 0.6 / 7.0;
            crate::Complex::cis(wave_number * (place * sine - 2.0 * depth))
        };
        let half = wave_number * 0.3 / 7.0 * sine;
        let aperture = if half == 0.0 { 1.0 } else { half.sin() / half };
        let pressure = (0..42).map(well).sum::<crate::Complex<f64>>().norm() * aperture * (1.0 + cosine) / 2.0;
        20.0 * pressure.max(1e-10).log10()
    }

    // The levels by another program: tests/fixtures/diffusion/README.md. They are over the loudest.
    #[test]
    fn a_published_diffuser() {
        let file = include_str!("../../../tests/fixtures/diffusion/qrd7_1000hz.csv");
        let column = |at: usize| -> Vec<f64> {
            file.lines().skip(1).map(|line| line.split(',').nth(at).expect("three").parse().expect("number")).collect()
        };
        let angles = column(0);
        assert_eq!(angles.len(), 37);
        let [diffuser, flat] = [(1, 0.2), (2, 0.0)].map(|(other, deepest_m)| {
            let levels: Vec<f64> = angles.iter().map(|angle| fraunhofer_level(*angle, deepest_m)).collect();
            let loudest = levels.iter().copied().fold(f64::MIN, f64::max);
            for (level, other) in levels.iter().zip(column(other)) {
                assert!((level - loudest - other).abs() < 1e-5, "{level} {other}");
            }
            diffusion_of_levels(&levels).expect("one")
        });
        let found = [diffuser, flat, normalise_diffusion(diffuser, flat).expect("one")];
        for (found, [published, computed]) in
            found.into_iter().zip([[0.1099, 0.109_853], [0.0049, 0.004_872], [0.1055, 0.105_495]])
        {
            assert!((found - published).abs() < 1e-4 && (found - computed).abs() < 1e-6, "{found}");
        }
        assert_eq!(normalise_diffusion(1.0, 1.0), None);
    }

    #[test]
    fn too_few_or_no_sound_have_none() {
        assert_eq!(diffusion_of_levels::<f64>(&[]), None);
        assert_eq!(diffusion_of_levels(&[3.0]), None);
        assert_eq!(diffusion_of_levels(&[f64::NEG_INFINITY; 4]), None);
        assert!(diffusion_of_levels(&[1.0, f64::NAN]).expect("not a number").is_nan());
        assert!(diffusion_of_levels(&[f64::INFINITY, f64::INFINITY]).expect("not a number").is_nan());
    }
}
