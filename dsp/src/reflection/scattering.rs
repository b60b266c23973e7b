//! Scattering of a surface by the coherence of its reflections with Flat's over many places.
//!
//! The mirrored part of a reflection is, at every place over a surface, what Flat reflects times one factor, which
//! depends on frequency and angle of incidence. The scattered part has another phase at each place. So the mean over
//! the places of the product of both spectra leaves the mirrored part alone: Mommertz's correlation over receivers, and
//! the mean over positions of the sample in ISO 17497-1. Places are pairs of one class of incidence; each class has its
//! own mean.

use std::collections::BTreeMap;

use realfft::num_complex::Complex;

use crate::error::check_len;
use crate::{Error, RealSample};

/// Classes of the cosine of the angle of incidence, each a tenth wide.
const CLASSES_PER_COSINE: f64 = 10.0;
/// Strips of the grid along each side; without one of their fields each, coefficients show their uncertainty.
const STRIPS: f64 = 3.0;

/// Path of a pair's reflection.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScatteringPath {
    /// Angle of incidence, degrees.
    pub incidence_deg: f64,
    /// Point of reflection over the grid's greatest coordinate along x or y, -1 to 1.
    pub specular: [f64; 2],
}

/// A number and its standard uncertainty.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UncertainNumber {
    /// The number.
    pub value: f64,
    /// None if there are fewer than three fields.
    pub uncertainty: Option<f64>,
}

/// Coefficients of a surface in one band.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BandScattering {
    /// Reflected energy over Flat's, sums over the pairs.
    pub energy: UncertainNumber,
    /// Share of the reflected energy that is not mirrored.
    pub scattering: UncertainNumber,
    /// Share of Flat's energy that is not mirrored: the scattering of ISO 17497-1 if the surface absorbs what Flat
    /// does.
    pub specular_loss: UncertainNumber,
}

/// Sums over pairs, by class of incidence and field of the panel.
#[derive(Debug, Clone, Default)]
pub struct ScatteringSums {
    fields: BTreeMap<(u8, u8), Vec<BinSums>>,
}

/// Sums of one frequency.
#[derive(Debug, Clone, Copy, Default)]
struct BinSums {
    product: Complex<f64>,
    surface: f64,
    flat: f64,
}

impl ScatteringSums {
    /// Adds a pair.
    ///
    /// surface, flat `[bins]`: spectra of what both reflect
    ///
    /// # Errors
    /// [`Error::Length`] if they are not equally long, or not as those before.
    pub fn add_pair<T: RealSample>(
        &mut self,
        surface: &[Complex<T>],
        flat: &[Complex<T>],
        path: ScatteringPath,
    ) -> Result<(), Error> {
        check_len("Flat's spectrum", flat.len(), surface.len())?;
        let cosine = path.incidence_deg.to_radians().cos();
        let class = (cosine * CLASSES_PER_COSINE).floor().clamp(0.0, CLASSES_PER_COSINE - 1.0);
        let [column, row] = path.specular.map(|at| ((at + 1.0) / 2.0 * STRIPS).floor().clamp(0.0, STRIPS - 1.0));
        let field = row * STRIPS + column;
        let bins =
            self.fields.entry((class as u8, field as u8)).or_insert_with(|| vec![BinSums::default(); flat.len()]);
        check_len("the spectrum", surface.len(), bins.len())?;
        for ((sums, surface), flat) in bins.iter_mut().zip(surface).zip(flat) {
            let [surface, flat] = [surface, flat].map(|c| Complex::new(c.re.f64(), c.im.f64()));
            sums.product += surface * flat.conj();
            sums.surface += surface.norm_sqr();
            sums.flat += flat.norm_sqr();
        }
        Ok(())
    }

    /// Computes the coefficients of each octave that has shares of bins; None of one without, and without pairs.
    ///
    /// shares  `[octaves][bins]`: of each bin's energy, what is in the octave
    pub fn octave_coefficients(&self, shares: &[Option<Vec<f64>>]) -> Vec<Option<BandScattering>> {
        let whole = self.octaves_without_field(shares, None);
        let mut names: Vec<u8> = self.fields.keys().map(|(_, field)| *field).collect();
        names.sort_unstable();
        names.dedup();
        let parts: Vec<_> = names.iter().map(|field| self.octaves_without_field(shares, Some(*field))).collect();
        let coefficients = |octave: usize| {
            let all = whole[octave]?;
            // A field that has all pairs leaves none.
            let parts: Option<Vec<_>> = parts.iter().map(|octaves| octaves[octave]).collect();
            let parts = parts.unwrap_or_default();
            let number =
                |of: fn(&[f64; 3]) -> f64| jackknife_number(of(&all), &parts.iter().map(of).collect::<Vec<_>>());
            Some(BandScattering {
                energy: number(|[surface, flat, _]| surface / flat),
                scattering: number(|[surface, _, coherent]| 1.0 - coherent / surface),
                specular_loss: number(|[_, flat, coherent]| 1.0 - coherent / flat),
            })
        };
        (0..shares.len()).map(coefficients).collect()
    }

    // Energies of surface and Flat and the mirrored energy in each octave, from all fields but one.
    fn octaves_without_field(&self, shares: &[Option<Vec<f64>>], omitted: Option<u8>) -> Vec<Option<[f64; 3]>> {
        let mut classes: BTreeMap<u8, Vec<BinSums>> = BTreeMap::new();
        for ((class, _), bins) in self.fields.iter().filter(|((_, field), _)| Some(*field) != omitted) {
            let sums = classes.entry(*class).or_insert_with(|| vec![BinSums::default(); bins.len()]);
            for (sum, bin) in sums.iter_mut().zip(bins) {
                sum.product += bin.product;
                sum.surface += bin.surface;
                sum.flat += bin.flat;
            }
        }
        let mirrored = |bin: &BinSums| if bin.flat > 0.0 { bin.product.norm_sqr() / bin.flat } else { 0.0 };
        let energies = |shares: &Vec<f64>| {
            let mut energies = [0.0; 3];
            for (bin, share) in classes.values().flat_map(|bins| bins.iter().zip(shares)) {
                let powers = [bin.surface, bin.flat, mirrored(bin)];
                energies.iter_mut().zip(powers).for_each(|(sum, power)| *sum += share * power);
            }
            energies
        };
        let has_pairs = !classes.is_empty();
        shares.iter().map(|octave| octave.as_ref().filter(|_| has_pairs).map(energies)).collect()
    }
}

// The jackknife takes away the bias of few places, too: by chance they agree a little.
fn jackknife_number(whole: f64, without_one: &[f64]) -> UncertainNumber {
    let count = without_one.len() as f64;
    if without_one.len() < 3 {
        return UncertainNumber { value: whole, uncertainty: None };
    }
    let mean = without_one.iter().sum::<f64>() / count;
    let square = without_one.iter().map(|value| (value - mean).powi(2)).sum::<f64>();
    let uncertainty = ((count - 1.0) / count * square).sqrt();
    UncertainNumber { value: count * whole - (count - 1.0) * mean, uncertainty: Some(uncertainty) }
}

#[cfg(test)]
mod tests {
    use echolake_schema::Rig;

    use super::*;
    use crate::full_scale_octave::bin_shares_of_octaves;

    const BINS: usize = 193;

    fn shares() -> Vec<Option<Vec<f64>>> {
        bin_shares_of_octaves(&Rig::paper()).expect("filters")
    }

    // Places at random over the panel, and spectra of noise.
    fn random_numbers() -> impl FnMut() -> f64 {
        let mut state = 1u64;
        move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64 * 2.0 - 1.0
        }
    }

    fn coefficients(pairs: usize, mirrored: Complex<f64>, scattered: f64) -> Vec<BandScattering> {
        let mut next = random_numbers();
        let mut sums = ScatteringSums::default();
        for _ in 0..pairs {
            let path = ScatteringPath { incidence_deg: 35.0 + 10.0 * next(), specular: [next(), next()] };
            let mut noise = || -> Vec<Complex<f64>> { (0..BINS).map(|_| Complex::new(next(), next())).collect() };
            let flat = noise();
            let other = noise();
            let surface: Vec<_> = flat.iter().zip(&other).map(|(f, o)| f * mirrored + o * scattered).collect();
            sums.add_pair(&surface, &flat, path).expect("equally long");
        }
        let octaves = sums.octave_coefficients(&shares());
        assert_eq!(octaves.iter().map(Option::is_some).collect::<Vec<_>>(), [false, true, true, true, false]);
        octaves.into_iter().flatten().collect()
    }

    // Of independent places with a mirrored part of known size, whatever its phase.
    #[test]
    fn shares_that_are_known() {
        for (mirrored, scattered) in [(0.9, 0.3), (0.5, 0.5), (0.1, 1.0), (0.0, 1.0)] {
            for band in coefficients(600, Complex::from_polar(mirrored, 1.3), scattered) {
                let [mirrored, scattered] = [mirrored * mirrored, scattered * scattered];
                let expected = [
                    (band.energy, mirrored + scattered),
                    (band.scattering, scattered / (mirrored + scattered)),
                    (band.specular_loss, 1.0 - mirrored),
                ];
                for (found, expected) in expected {
                    assert!((found.value - expected).abs() < 0.03, "{found:?} {expected}");
                    assert!(found.uncertainty.is_some_and(|u| u < 0.03), "{found:?}");
                }
            }
        }
    }

    #[test]
    fn flat_scatters_nothing() {
        for band in coefficients(40, 1.0.into(), 0.0) {
            assert!(band.scattering.value.abs() < 1e-12 && band.specular_loss.value.abs() < 1e-12, "{band:?}");
            assert!((band.energy.value - 1.0).abs() < 1e-12, "{band:?}");
        }
        assert_eq!(ScatteringSums::default().octave_coefficients(&shares()), [None; 5]);
    }

    // One place tells nothing of its uncertainty; other lengths are refused.
    #[test]
    fn few_places() {
        let path = ScatteringPath { incidence_deg: 0.0, specular: [0.0; 2] };
        let mut sums = ScatteringSums::default();
        let one = vec![Complex::new(1.0, 0.0); BINS];
        sums.add_pair(&one, &one, path).expect("equally long");
        let octave = sums.octave_coefficients(&shares())[2].expect("a pair");
        assert_eq!(octave.scattering.uncertainty, None);
        assert!(sums.add_pair(&one, &one[1..], path).is_err());
        assert!(sums.add_pair(&one[1..], &one[1..], path).is_err());
    }
}
