//! Figures of merit of panels that nobody has printed: levels over Flat, their spread, and scattering, by band, from
//! reflections that the simulated rig computes at all pairs of a grid or some of them.

use std::sync::Arc;

use echolake_dsp::filter_bank::FilterBankPlan;
use echolake_dsp::full_scale_octave::bin_shares_of_octaves;
use echolake_dsp::geometry::{incidence_deg, specular_point};
use echolake_dsp::level::{p90_mean, power_to_db, standard_deviation};
use echolake_dsp::scattering::{ScatteringPath, ScatteringSums, UncertainNumber};
use echolake_dsp::{Complex, Error, RealSample as _};
use echolake_panel::material::SurfaceMaterial;
use echolake_panel::relief::{HeightField, PanelRelief};
use echolake_schema::{Grid, Pair, Rig};
use realfft::RealToComplex;

use crate::rig::devices::simulated::{PairPoses, PanelReflections};
use crate::rig::robots::Choreography;

/// A rig's grid over Flat, ready to compare panels with it.
pub struct DesignSimulation {
    rig: Rig,
    grid: Grid,
    pairs: Vec<DesignPair>,
    bank: FilterBankPlan<f64>,
    /// Of each bin's energy, what is in the octave around each band, where the sweep has all of it.
    octave_shares: Vec<Option<Vec<f64>>>,
    transform: Arc<dyn RealToComplex<f64>>,
    flat: Vec<PairReflection>,
    /// Mean energy by band, over Flat's of all bands.
    flat_means: Vec<f64>,
}

/// A pair, and where its reflection is.
struct DesignPair {
    pair: Pair,
    poses: PairPoses,
    path: ScatteringPath,
}

/// A reflection at a pair.
struct PairReflection {
    spectrum: Vec<Complex<f64>>,
    /// By band.
    energies: Vec<f64>,
}

/// Figures of a panel in one band.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BandFigures {
    /// Level over Flat, dB: `p90_mean_db` of table `surface_stats`, less Flat's.
    pub level_db: f64,
    /// Standard deviation of the pairs' levels, dB: `spread_db` of that table.
    pub spread_db: f64,
    /// Scattering by correlation with Flat, as in that table; NaN if the sweep does not have the band's octave.
    pub scattering: UncertainNumber,
}

/// Figures of a panel.
#[derive(Debug, Clone, PartialEq)]
pub struct PanelFigures {
    /// By band.
    pub bands: Vec<BandFigures>,
    /// Level of each pair over Flat's in the same band, dB; `[band][pair]`.
    pub levels_db: Vec<Vec<f64>>,
}

impl DesignSimulation {
    /// Measures Flat at so many pairs, evenly from all of the grid; at all of them by default.
    ///
    /// # Errors
    /// [`Error`] if the rig's bands are not within its sampling rate.
    pub fn new(rig: &Rig, grid: Grid, arms: Option<&Choreography>, pair_count: Option<usize>) -> Result<Self, Error> {
        let all = grid.pairs();
        let count = pair_count.map_or(all.len(), |count| count.min(all.len()));
        let sides = grid.points().iter().flat_map(|point| [point.position_mm[0], point.position_mm[1]]);
        let widest_mm = sides.map(f64::abs).fold(1.0, f64::max);
        let chosen = choose_evenly(all.len(), count);
        let pairs = chosen.into_iter().map(|at| DesignPair::new(&grid, all[at], arms, widest_mm)).collect();
        let length = rig.impulse_response.length;
        let bank = FilterBankPlan::new(length, rig.sweep.rate_hz.get(), &rig.bands.centres_hz)?;
        let mut simulation = Self {
            rig: rig.clone(),
            grid,
            pairs,
            bank,
            octave_shares: bin_shares_of_octaves(rig)?,
            transform: f64::plan_real_forward(length),
            flat: Vec::new(),
            flat_means: Vec::new(),
        };
        let relief = PanelRelief::Flat;
        let heights = relief.height_field(echolake_panel::mesh::FACETS);
        simulation.flat = simulation.compute_reflections(&heights, relief.material())?;
        simulation.flat_means = (0..simulation.bank.band_count())
            .map(|band| simulation.band_energies(&simulation.flat, band))
            .map(|energies| p90_mean(&energies, &mut Vec::new()).unwrap_or(f64::NAN))
            .collect();
        Ok(simulation)
    }

    /// The pairs, in the order of the figures' levels.
    pub fn chosen_pairs(&self) -> impl Iterator<Item = &Pair> {
        self.pairs.iter().map(|pair| &pair.pair)
    }

    /// Computes the figures of a panel.
    ///
    /// # Errors
    /// None for a rig that [`Self::new`] has taken.
    pub fn compute_figures(&self, relief: &HeightField, material: SurfaceMaterial) -> Result<PanelFigures, Error> {
        let reflections = self.compute_reflections(relief, material)?;
        let mut scattering = ScatteringSums::default();
        for ((panel, flat), pair) in reflections.iter().zip(&self.flat).zip(&self.pairs) {
            scattering.add_pair(&panel.spectrum, &flat.spectrum, pair.path)?;
        }
        let scattering = scattering.octave_coefficients(&self.octave_shares);
        let bands = scattering.iter().enumerate().map(|(band, scattering)| {
            let energies = self.band_energies(&reflections, band);
            let mean = p90_mean(&energies, &mut Vec::new()).unwrap_or(f64::NAN);
            let levels: Vec<f64> = energies.into_iter().map(power_to_db).filter(|level| level.is_finite()).collect();
            BandFigures {
                level_db: power_to_db(mean / self.flat_means[band]),
                spread_db: standard_deviation(&levels),
                scattering: scattering
                    .map_or(UncertainNumber { value: f64::NAN, uncertainty: None }, |octave| octave.scattering),
            }
        });
        let level_over_flat = |band: usize| {
            let pairs = reflections.iter().zip(&self.flat);
            pairs.map(|(panel, flat)| power_to_db(panel.energies[band] / flat.energies[band])).collect()
        };
        let levels_db = (0..self.bank.band_count()).map(level_over_flat).collect();
        Ok(PanelFigures { bands: bands.collect(), levels_db })
    }

    // Energies of a band, each over Flat's of all bands at the same pair: TNCE.
    fn band_energies(&self, reflections: &[PairReflection], band: usize) -> Vec<f64> {
        let pairs = reflections.iter().zip(&self.flat);
        pairs.map(|(panel, flat)| panel.energies[band] / flat.energies.iter().sum::<f64>()).collect()
    }

    fn compute_reflections(
        &self,
        relief: &HeightField,
        material: SurfaceMaterial,
    ) -> Result<Vec<PairReflection>, Error> {
        let panel = PanelReflections::new(&self.rig, &self.grid, relief, material);
        let mut scratch = panel.make_scratch();
        let mut samples = self.transform.make_input_vec();
        let mut work = self.transform.make_scratch_vec();
        let mut reflect_at = |pair: &DesignPair| {
            let response = panel.compute_reflection(&pair.poses, &mut scratch)?;
            samples.fill(0.0);
            samples.iter_mut().zip(&response).for_each(|(sample, value)| *sample = f64::from(*value));
            let mut spectrum = self.transform.make_output_vec();
            // The buffers are the transform's own, so it cannot refuse them.
            let _ = self.transform.process_with_scratch(&mut samples, &mut spectrum, &mut work);
            let mut energies = vec![0.0; self.bank.band_count()];
            self.bank.spectrum_energies(&spectrum, &mut energies);
            Ok(PairReflection { spectrum, energies })
        };
        self.pairs.iter().map(&mut reflect_at).collect()
    }
}

impl DesignPair {
    fn new(grid: &Grid, pair: Pair, arms: Option<&Choreography>, widest_mm: f64) -> Self {
        let [microphone, speaker] =
            [pair.microphone, pair.speaker].map(|point| grid.points()[point.index()].position_mm);
        let path = ScatteringPath {
            incidence_deg: incidence_deg(microphone, speaker),
            specular: specular_point(microphone, speaker).map(|mm| mm / widest_mm),
        };
        Self { poses: PairPoses::from_pair(grid, &pair, arms), pair, path }
    }
}

// Numbers below `all`, one of each of `count` equal parts; multiples of the golden ratio do not follow the grid's rows.
fn choose_evenly(all: usize, count: usize) -> Vec<usize> {
    const GOLDEN: f64 = 0.618_033_988_749_894_9;
    let part = all as f64 / count as f64;
    (0..count).map(|n| ((n as f64 + (n as f64 * GOLDEN).fract()) * part) as usize).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn simulation(pairs: usize) -> DesignSimulation {
        let rig = Rig::paper();
        let grid = rig.build_grid().expect("a grid");
        DesignSimulation::new(&rig, grid, None, Some(pairs)).expect("a simulation")
    }

    #[test]
    fn flat_is_as_loud_as_flat_and_scatters_nothing() {
        let simulation = simulation(30);
        assert_eq!(simulation.chosen_pairs().count(), 30);
        let flat = PanelRelief::Flat;
        let heights = flat.height_field(echolake_panel::mesh::FACETS);
        let figures = simulation.compute_figures(&heights, flat.material()).expect("figures");
        assert_eq!(figures.bands.len(), 5);
        for (number, band) in figures.bands.iter().enumerate() {
            assert!(band.level_db.abs() < 1e-9, "{band:?}");
            // The sweep has a part of the first octave and of the last.
            let is_whole = (1..4).contains(&number);
            assert!(
                if is_whole { band.scattering.value.abs() < 1e-9 } else { band.scattering.value.is_nan() },
                "{band:?}"
            );
        }
        assert!(figures.levels_db.iter().flatten().all(|level| level.abs() < 1e-9));
    }

    // Waves of 12 mm send more of the high bands elsewhere than of the low ones.
    #[test]
    fn waves_scatter_high_bands() {
        let mut waves = PanelRelief::by_name("macrostructure").expect("a relief");
        waves.set_parameter("macro_depth_mm", "120").expect("a parameter");
        let heights = waves.height_field(echolake_panel::mesh::FACETS);
        let figures = simulation(60).compute_figures(&heights, waves.material()).expect("figures");
        let [lowest, highest] = [1, 3].map(|band| figures.bands[band]);
        assert!(lowest.scattering.value < 0.5 && highest.scattering.value > 0.7, "{figures:?}");
        assert!(highest.spread_db > lowest.spread_db, "{figures:?}");
    }

    #[test]
    fn pairs_are_chosen_from_all_of_the_grid() {
        assert_eq!(choose_evenly(5, 5), [0, 1, 2, 3, 4]);
        let chosen = choose_evenly(2951, 120);
        assert_eq!(chosen.len(), 120);
        let in_tenth = |tenth: usize| chosen.iter().filter(|at| **at * 10 / 2951 == tenth).count();
        assert!((0..10).all(|tenth| (11..=13).contains(&in_tenth(tenth))), "{chosen:?}");
    }
}
