//! Reliefs that repeat along one side of their panel and are constant along the other, and their scattering for random
//! incidence, with the uncertainty that a panel of finite size has near an order's cut-off.

use std::f64::consts::TAU;

use crate::Error;
use crate::far_field::SOURCES;
use crate::height_field::HeightField;
use crate::periodic_profile::{IncidentWave, PeriodicProfile};
use crate::scattering::UncertainNumber;

/// Share of a relief's range of heights by which they may differ along its ridges.
const CONSTANT_SHARE: f64 = 0.01;
/// Least range of heights of a relief, mm.
const LEAST_RANGE_MM: f64 = 1e-3;
/// Periods of a panel at least.
const LEAST_PERIODS: f64 = 3.0;
/// Shortest period, cells: a shorter one may be another one, seen at too few places.
const SHORTEST_PERIOD_CELLS: f64 = 2.5;
/// Squares of steps between neighbours in a period over those of values in any order, at most.
const GREATEST_DISORDER: f64 = 0.03;
/// Cells of a period of which the profile is made, at least, and for each wavelength.
const LEAST_CELLS: f64 = 96.0;

/// Standard uncertainty of a finite sample's scattering where no order's cut-off is near.
///
/// Source: with [`CUT_OFF_U`] that by which 16 values of a round sample of ten periods differ, by boundary elements
/// (Mesh2scattering's public data of a sine).
const FINITE_SAMPLE_U: f64 = 0.03;
/// Standard uncertainty at one resolution of the sample from a cut-off; it falls with the distance's fourth power.
const CUT_OFF_U: f64 = 0.1;
/// Greatest standard uncertainty: that of a share of which nothing is known.
const UNKNOWN_SHARE_U: f64 = 0.3;

/// A relief of ridges, one like the other.
#[derive(Debug, Clone, PartialEq)]
pub struct RepeatingRelief {
    size_mm: f64,
    profile: PeriodicProfile,
}

impl RepeatingRelief {
    /// Finds the ridges of a relief, along either of its sides; None if there are none, or fewer than three periods.
    ///
    /// # Errors
    /// Those of [`PeriodicProfile::new`].
    pub fn find_ridges(relief: &HeightField) -> Result<Option<Self>, Error> {
        let cells = relief.cells();
        let height = |along: usize, across: usize, is_turned: bool| {
            let [ix, iy] = if is_turned { [across, along] } else { [along, across] };
            f64::from(relief.cell_height(ix, iy))
        };
        let [lowest, highest] = range_of(relief.heights_mm().iter().map(|height| f64::from(*height)));
        if highest - lowest < LEAST_RANGE_MM {
            return Ok(None);
        }
        for is_turned in [false, true] {
            let lines = || (0..cells).map(|along| range_of((0..cells).map(move |at| height(along, at, is_turned))));
            if lines().any(|[low, high]| high - low > CONSTANT_SHARE * (highest - lowest)) {
                continue;
            }
            let heights_mm: Vec<f64> = lines().map(|[low, high]| (low + high) / 2.0).collect();
            if let Some(period_cells) = find_period(&heights_mm) {
                let period_mm = period_cells * relief.pitch_mm();
                let profile = PeriodicProfile::new(period_mm, &fold_heights(&heights_mm, period_cells))?;
                return Ok(Some(Self { size_mm: relief.size_mm(), profile }));
            }
        }
        Ok(None)
    }

    /// The profile that repeats.
    pub fn repeated_profile(&self) -> &PeriodicProfile {
        &self.profile
    }

    /// Computes the scattering coefficient for random incidence: the mean of the planes along both sides of the panel,
    /// over these wave numbers, rad/m. Its uncertainty is that of a sample of the panel's size.
    ///
    /// # Errors
    /// Those of [`PeriodicProfile::diffracted_orders`]; [`Error::Setting`] without wave numbers.
    pub fn random_incidence_scattering(&self, wave_numbers: &[f64]) -> Result<UncertainNumber, Error> {
        let [mut value, mut squares, mut weights] = [0.0; 3];
        for wave_number in wave_numbers {
            for (zenith_deg, weight) in SOURCES {
                // What comes from the other side is mirrored as much: reciprocity.
                for azimuth_deg in [0.0, 90.0] {
                    let wave = IncidentWave { wave_number: *wave_number, zenith_deg, azimuth_deg };
                    let orders = self.profile.diffracted_orders(&wave)?;
                    let mirrored: f64 = orders.iter().filter(|order| order.order == 0).map(|order| order.energy).sum();
                    value += weight * (1.0 - mirrored);
                    squares += (weight * self.cut_off_u(&wave)).powi(2);
                    weights += weight;
                }
            }
        }
        if weights == 0.0 {
            let what = "the wave numbers";
            return Err(Error::Setting { what, actual: "none".into(), expected: "one at least" });
        }
        // What cut-offs do to one wave, they do not do to the next one.
        let uncertainty = FINITE_SAMPLE_U.hypot(squares.sqrt() / weights);
        Ok(UncertainNumber { value: value / weights, uncertainty: Some(uncertainty) })
    }

    /// Standard uncertainty of the scattering of one wave, because the sample is finite: an order that is nearly
    /// horizontal is one with the wave along its surface.
    pub fn finite_sample_u(&self, wave: &IncidentWave) -> f64 {
        FINITE_SAMPLE_U.hypot(self.cut_off_u(wave)).min(UNKNOWN_SHARE_U)
    }

    fn cut_off_u(&self, wave: &IncidentWave) -> f64 {
        (CUT_OFF_U / self.cut_off_distance(wave).powi(4)).min(UNKNOWN_SHARE_U)
    }

    // Distance of the order that is nearest to the horizon from it, in what a sample of this size resolves.
    fn cut_off_distance(&self, wave: &IncidentWave) -> f64 {
        let [zenith, azimuth] = [wave.zenith_deg.to_radians(), wave.azimuth_deg.to_radians()];
        let along = wave.wave_number * zenith.sin() * azimuth.cos();
        let across = wave.wave_number * zenith.sin() * azimuth.sin();
        let horizon = (wave.wave_number * wave.wave_number - across * across).sqrt();
        let step = TAU * 1e3 / self.profile.period_mm();
        let resolution = TAU * 1e3 / (self.size_mm * zenith.cos());
        let most = (2.0 * wave.wave_number / step).ceil() as i32 + 1;
        let distances = (-most..=most)
            .filter(|order| *order != 0)
            .map(|order| ((along + f64::from(order) * step).abs() - horizon).abs() / resolution);
        distances.fold(f64::INFINITY, f64::min)
    }
}

fn range_of(values: impl Iterator<Item = f64>) -> [f64; 2] {
    values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| [low.min(value), high.max(value)])
}

/// Finds the period after which heights repeat, in cells. All periods lie on one another, so that a period is seen at
/// as many places as there are cells, whether it is a number of cells or not.
fn find_period(heights_mm: &[f64]) -> Option<f64> {
    let count = heights_mm.len() as f64;
    // By a step, the last period moves by a quarter of a cell. What does not repeat has least disorder as it is.
    let step = 1.0 + 0.25 / count;
    let steps = ((2.0 * count / SHORTEST_PERIOD_CELLS).ln() / step.ln()).max(0.0) as i32;
    let tried = (0..=steps).map(|n| SHORTEST_PERIOD_CELLS * step.powi(n));
    let least = |[period, disorder]: [f64; 2], tried: f64| {
        let found = find_disorder(heights_mm, tried);
        if found < disorder { [tried, found] } else { [period, disorder] }
    };
    let [period, disorder] = tried.fold([f64::INFINITY; 2], least);
    (disorder <= GREATEST_DISORDER && period <= count / LEAST_PERIODS).then_some(period)
}

// Half the mean square of steps between neighbours within a period, over the variance: von Neumann's ratio.
fn find_disorder(heights_mm: &[f64], period_cells: f64) -> f64 {
    let folded = fold_places(heights_mm, period_cells);
    let count = folded.len() as f64;
    let mean = folded.iter().map(|(_, height)| height).sum::<f64>() / count;
    let variance = folded.iter().map(|(_, height)| (height - mean).powi(2)).sum::<f64>();
    let wrapped = folded.iter().skip(1).chain(folded.first());
    let steps = folded.iter().zip(wrapped).map(|(a, b)| (a.1 - b.1).powi(2)).sum::<f64>();
    steps / variance / 2.0
}

// Places in a period, 0 to 1, and heights, in the order of places.
fn fold_places(heights_mm: &[f64], period_cells: f64) -> Vec<(f64, f64)> {
    let place = |n: usize| ((n as f64 + 0.5) / period_cells).fract();
    let mut folded: Vec<_> = heights_mm.iter().enumerate().map(|(n, height)| (place(n), *height)).collect();
    folded.sort_by(|a, b| a.0.total_cmp(&b.0));
    folded
}

/// Heights over one period, from what is seen of all of them; at the middle of each cell the nearest one.
fn fold_heights(heights_mm: &[f64], period_cells: f64) -> Vec<f64> {
    let folded = fold_places(heights_mm, period_cells);
    let cells = LEAST_CELLS.max(period_cells.ceil()) as usize;
    let nearest = |place: f64| {
        let after = folded.partition_point(|(at, _)| *at < place);
        let [before, after] = [(after + folded.len() - 1) % folded.len(), after % folded.len()].map(|n| folded[n]);
        let distance = |at: f64| ((at - place).abs()).min(1.0 - (at - place).abs());
        if distance(before.0) <= distance(after.0) { before.1 } else { after.1 }
    };
    (0..cells).map(|cell| nearest((cell as f64 + 0.5) / cells as f64)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sine(size_mm: f64, period_mm: f64, depth_mm: f64, cells: usize, is_turned: bool) -> HeightField {
        HeightField::from_fn(size_mm, cells, |x, y| {
            depth_mm / 2.0 * (TAU * if is_turned { y } else { x } / period_mm).cos()
        })
    }

    #[test]
    fn ridges_are_found_by_their_period() {
        for (period_mm, cells) in [(17.7, 274), (100.0, 274), (35.0, 120), (190.0, 274)] {
            for is_turned in [false, true] {
                let relief = sine(585.0, period_mm, 5.1, cells, is_turned);
                let found = RepeatingRelief::find_ridges(&relief).expect("no error").expect("ridges");
                let off = found.repeated_profile().period_mm() / period_mm - 1.0;
                assert!(off.abs() < 5e-3, "{period_mm} mm of {cells} cells: {}", found.repeated_profile().period_mm());
            }
        }
        let steps = HeightField::from_fn(585.0, 274, |x, _| if (x / 24.0).rem_euclid(1.0) < 0.5 { 7.0 } else { 0.0 });
        let found = RepeatingRelief::find_ridges(&steps).expect("no error").expect("ridges");
        assert!(
            (found.repeated_profile().period_mm() / 24.0 - 1.0).abs() < 3e-3,
            "{}",
            found.repeated_profile().period_mm()
        );
    }

    #[test]
    fn what_does_not_repeat_has_no_ridges() {
        let none = |relief: &HeightField| RepeatingRelief::find_ridges(relief).expect("no error");
        assert_eq!(none(&HeightField::from_fn(585.0, 120, |_, _| 3.0)), None, "flat");
        assert_eq!(
            none(&HeightField::from_fn(585.0, 120, |x, y| (x / 9.0).sin() + (y / 9.0).sin())),
            None,
            "both ways"
        );
        assert_eq!(none(&HeightField::from_fn(585.0, 120, |x, _| (x * x / 4e3).sin())), None, "a chirp");
        assert_eq!(none(&sine(585.0, 400.0, 9.0, 120, false)), None, "too few periods");
    }

    // A sine at 1:10, as a round sample of ten periods has it by boundary elements (examples/project/sine of
    // Mesh2scattering, whose mesh has 80 mm and 23.05 mm from crest to trough at 1:2.5): 13 of 16 values are given, and
    // all of them are within 1.96 u.
    #[test]
    fn the_uncertainty_holds_what_a_finite_sample_does() {
        let relief = sine(200.0, 20.0, 5.7625, 400, false);
        let ridges = RepeatingRelief::find_ridges(&relief).expect("no error").expect("ridges");
        let published = [
            (0.0, 0.0, [0.005, 0.023, 0.021, 0.214]),
            (30.0, 0.0, [0.007, 0.036, 0.951, 0.860]),
            (60.0, 0.0, [0.015, 0.320, 0.883, 0.894]),
            (60.0, 90.0, [0.005, 0.019, 0.023, 0.034]),
        ];
        let mut given = 0;
        for (zenith_deg, azimuth_deg, expected) in published {
            for (khz, expected) in [4.0, 8.0, 12.0, 16.0].into_iter().zip(expected) {
                let wave = IncidentWave { wave_number: TAU * khz * 1e3 / 346.18, zenith_deg, azimuth_deg };
                let orders = ridges.repeated_profile().diffracted_orders(&wave).expect("orders");
                let mirrored: f64 = orders.iter().filter(|order| order.order == 0).map(|order| order.energy).sum();
                let u = ridges.finite_sample_u(&wave);
                let off: f64 = 1.0 - mirrored - expected;
                assert!(off.abs() <= 1.96 * u || u > 0.15, "{wave:?}: {off} beside {u}");
                given += usize::from(u <= 0.15);
            }
        }
        assert_eq!(given, 13);
    }

    #[test]
    fn random_incidence_is_the_mean_of_its_sources() {
        let ridges = RepeatingRelief::find_ridges(&sine(585.0, 35.0, 5.0, 274, false)).expect("no error");
        let ridges = ridges.expect("ridges");
        let found = ridges.random_incidence_scattering(&[300.0, 320.0]).expect("a number");
        let [mut sum, mut weights] = [0.0; 2];
        for wave_number in [300.0, 320.0] {
            for (zenith_deg, weight) in [(0.0, 1.0), (30.0, 6.0), (60.0, 6.0)] {
                for azimuth_deg in [0.0, 90.0, 180.0, 270.0] {
                    let wave = IncidentWave { wave_number, zenith_deg, azimuth_deg };
                    let orders = ridges.repeated_profile().diffracted_orders(&wave).expect("orders");
                    sum += weight * orders.iter().filter(|o| o.order != 0).map(|o| o.energy).sum::<f64>();
                    weights += weight;
                }
            }
        }
        assert!((found.value - sum / weights).abs() < 1e-8 && found.value > 0.05, "{found:?}");
        assert!(found.uncertainty.is_some_and(|u| (0.03..0.3).contains(&u)), "{found:?}");
        assert!(ridges.random_incidence_scattering(&[]).is_err());
    }
}
