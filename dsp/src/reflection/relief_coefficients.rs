//! Scattering and diffusion of a relief in the far field, each with its standard uncertainty, or why it has none.
//!
//! Kirchhoff's approximation knows no diffracted orders: it fails where details narrower than a wavelength turn the
//! phase of what they reflect. Reliefs of ridges that repeat are solved exactly there.

use std::f64::consts::PI;

use crate::Error;
use crate::far_field::{FarFieldCoefficients, FarFieldPlan};
use crate::height_field::HeightField;
use crate::repeating_relief::RepeatingRelief;
use crate::scattering::UncertainNumber;

/// Standard uncertainty of Kirchhoff's scattering s: of any relief, and for each rad of the details' phase, of 1 - s.
///
/// Source: nine reliefs in five bands by boundary elements in two dimensions, the table in `docs/materials.md`.
const SCATTERING_U: [f64; 2] = [0.02, 0.8];
/// The same of its diffusion, but of 1.
const DIFFUSION_U: [f64; 2] = [0.01, 0.45];
/// Greatest standard uncertainty of a coefficient that is given.
const GREATEST_U: f64 = 0.15;
/// Standard uncertainty of Kirchhoff's scattering up to which no exact solution is looked for.
const SMALL_U: f64 = 0.03;
/// Half waves in a period up to which ridges are solved: the work grows with their third power.
const MOST_HALF_WAVES: f64 = 16.0;

/// Coefficients of a relief in one band.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReliefCoefficients {
    /// Scattering coefficient for random incidence.
    pub scattering: Result<UncertainNumber, CoefficientGap>,
    /// Directional diffusion coefficient for random incidence, normalised by that of a flat panel.
    pub diffusion_normalised: Result<UncertainNumber, CoefficientGap>,
}

/// Reason for which a coefficient is not given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum CoefficientGap {
    /// Kirchhoff's approximation does not hold, and the relief has no ridges that repeat.
    #[error("details narrower than the wavelength, for which Kirchhoff's approximation does not hold")]
    NarrowDetails,
    /// An infinite relief is solved, and the panel is too small for what it does at these frequencies.
    #[error("finite sample near a cut-off")]
    NearCutOff,
}

/// Estimates the coefficients of each band of a plan.
///
/// # Errors
/// Those of [`FarFieldPlan::compute_coefficients`].
///
/// ```
/// use echolake_dsp::far_field::FarFieldPlan;
/// use echolake_dsp::height_field::HeightField;
/// use echolake_dsp::relief_coefficients::estimate_coefficients;
///
/// let flat = HeightField::from_fn(585.0, 64, |_, _| 0.0);
/// let plan = FarFieldPlan::new(&flat, vec![vec![50.0, 60.0]]);
/// let scattering = estimate_coefficients(&flat, &plan)?[0].scattering;
/// assert!(scattering.is_ok_and(|s| s.value.abs() < 1e-9 && s.uncertainty == Some(0.02)));
/// # Ok::<(), echolake_dsp::Error>(())
/// ```
pub fn estimate_coefficients(relief: &HeightField, plan: &FarFieldPlan) -> Result<Vec<ReliefCoefficients>, Error> {
    let of_kirchhoff = plan.compute_coefficients(relief)?;
    let phases = plan.band_wave_numbers().map(|wave_numbers| mean_detail_phase(relief, wave_numbers));
    let bands: Vec<_> = of_kirchhoff.iter().zip(phases).map(|(far, phase)| kirchhoff_numbers(far, phase)).collect();
    let is_unsure = |[scattering, _]: &[UncertainNumber; 2]| u_of(scattering) > SMALL_U;
    let ridges = if bands.iter().any(is_unsure) { RepeatingRelief::find_ridges(relief)? } else { None };
    let estimate = |(numbers, wave_numbers): ([UncertainNumber; 2], &[f64])| {
        let [scattering, diffusion] = numbers;
        let exact = ridges.as_ref().filter(|_| is_unsure(&numbers)).and_then(|r| solve_ridges(r, wave_numbers));
        let (scattering, gap) = match exact {
            Some(exact) if u_of(&exact) < u_of(&scattering) => (exact, CoefficientGap::NearCutOff),
            _ => (scattering, CoefficientGap::NarrowDetails),
        };
        let known = |number: UncertainNumber, gap| if u_of(&number) <= GREATEST_U { Ok(number) } else { Err(gap) };
        ReliefCoefficients {
            scattering: known(scattering, gap),
            diffusion_normalised: known(diffusion, CoefficientGap::NarrowDetails),
        }
    };
    Ok(bands.into_iter().zip(plan.band_wave_numbers()).map(estimate).collect())
}

fn u_of(number: &UncertainNumber) -> f64 {
    number.uncertainty.unwrap_or(f64::INFINITY)
}

// Scattering and diffusion, with what Kirchhoff's approximation makes wrong of details of this phase, rad.
fn kirchhoff_numbers(far: &FarFieldCoefficients, phase: f64) -> [UncertainNumber; 2] {
    let number = |value: f64, [least, slope]: [f64; 2], share: f64| {
        let uncertainty = Some(least.hypot(slope * phase * share)).filter(|u| u.is_finite());
        UncertainNumber { value, uncertainty }
    };
    [number(far.scattering, SCATTERING_U, 1.0 - far.scattering), number(far.diffusion_normalised, DIFFUSION_U, 1.0)]
}

// Phase of the details within a wavelength, rad; infinite if cells are too wide to show them.
fn mean_detail_phase(relief: &HeightField, wave_numbers: &[f64]) -> f64 {
    let phase = |wave_number: &f64| relief.detail_phase(2e3 * PI / wave_number).unwrap_or(f64::INFINITY);
    wave_numbers.iter().map(phase).sum::<f64>() / wave_numbers.len() as f64
}

// None if the waves are too short for this period, or an order is exactly horizontal.
fn solve_ridges(ridges: &RepeatingRelief, wave_numbers: &[f64]) -> Option<UncertainNumber> {
    let shortest = wave_numbers.iter().copied().fold(0.0, f64::max);
    let half_waves = shortest * ridges.repeated_profile().period_mm() / 1e3 / PI;
    (half_waves <= MOST_HALF_WAVES).then(|| ridges.random_incidence_scattering(wave_numbers).ok()).flatten()
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;

    const SPEED_M_S: f64 = 343.2;

    fn wave_numbers(hz: f64) -> Vec<f64> {
        [0.8, 1.0, 1.25].map(|factor| TAU * factor * hz / SPEED_M_S).to_vec()
    }

    fn coefficients(relief: &HeightField, hz: f64) -> ReliefCoefficients {
        let plan = FarFieldPlan::new(relief, vec![wave_numbers(hz)]);
        estimate_coefficients(relief, &plan).expect("coefficients")[0]
    }

    // Boundary elements have 0.38 across the ridges at 2.5 kHz, and Kirchhoff's approximation 0.15. Along the ridges no
    // order but the mirror's propagates there.
    #[test]
    fn ridges_are_solved_where_kirchhoff_fails() {
        let sine = HeightField::from_fn(585.0, 274, |x, _| 8.0 * (TAU * x / 100.0).cos());
        let ridges = RepeatingRelief::find_ridges(&sine).expect("no error").expect("ridges");
        for hz in [2_500.0, 5_000.0] {
            let found = coefficients(&sine, hz).scattering.expect("a number");
            assert_eq!(found, ridges.random_incidence_scattering(&wave_numbers(hz)).expect("a number"));
            assert!(u_of(&found) < 0.1, "{hz} Hz: {found:?}");
        }
        let lowest = coefficients(&sine, 2_500.0).scattering.expect("a number");
        assert!((lowest.value - 0.384 / 2.0).abs() < 0.01, "{lowest:?}");
        let kirchhoff = coefficients(&sine, 40_000.0).scattering.expect("a number");
        assert!(u_of(&kirchhoff) < 0.03, "{kirchhoff:?}");
    }

    // Wells that nothing repeats, as wide as a fifth of the wavelength: neither method holds.
    #[test]
    fn narrow_wells_have_no_coefficient() {
        let depth = |well: i64| [-20.0, -3.0, -11.0, 0.0, -17.0, -8.0, -14.0][(well * well % 7) as usize];
        let wells =
            HeightField::from_fn(585.0, 274, |x, y| depth((x / 15.0).floor() as i64 + 3 * (y / 15.0).floor() as i64));
        let found = coefficients(&wells, 5_000.0);
        assert_eq!(found.scattering, Err(CoefficientGap::NarrowDetails));
        assert_eq!(found.diffusion_normalised, Err(CoefficientGap::NarrowDetails));
        let coarse = HeightField::from_fn(585.0, 60, |x, y| f64::from(u8::from(x > y)));
        assert_eq!(coefficients(&coarse, 30_000.0).scattering, Err(CoefficientGap::NarrowDetails));
    }

    // Each value of the table differs from that by boundary elements by 1.96 standard uncertainties at most, or has one
    // over which it is not given; and the uncertainty is that of the constants here.
    #[test]
    fn boundary_elements_confirm_the_uncertainty() {
        let text = include_str!("../../../docs/materials.md");
        let marker = "tests/simulation/compare_bem.py --far-field -->";
        let table = text.split(marker).nth(1).expect("the table");
        let rows: Vec<(&str, Vec<f64>)> = table
            .lines()
            .filter_map(|line| {
                let cells: Vec<&str> = line.split('|').map(str::trim).collect();
                let numbers: Vec<f64> = cells.get(3..8)?.iter().filter_map(|cell| cell.parse().ok()).collect();
                (numbers.len() == 5).then(|| (cells[2], numbers))
            })
            .collect();
        let mut compared = [0, 0];
        for relief in rows.chunks(8) {
            let [truth_d, found_d, u_d, truth_s, found_s, u_s, phase, _] = relief else { panic!("{relief:?}") };
            assert_eq!((truth_d.0, found_s.0), ("diffusion, boundary elements", "scattering, Kirchhoff"));
            for band in 0..5 {
                let far = FarFieldCoefficients { diffusion_normalised: found_d.1[band], scattering: found_s.1[band] };
                let numbers = kirchhoff_numbers(&far, phase.1[band]);
                for (which, (number, told, truth)) in
                    [(numbers[0], u_s, truth_s), (numbers[1], u_d, truth_d)].into_iter().enumerate()
                {
                    let u = u_of(&number);
                    assert!((u - told.1[band]).abs() < 0.011, "{u} beside {}", told.1[band]);
                    let off = (number.value - truth.1[band]).abs();
                    assert!(off < 1.96 * u + 0.01 || u > GREATEST_U, "{off} beside {u} in {:?}", relief[0]);
                    compared[which] += usize::from(u <= GREATEST_U);
                }
            }
        }
        assert!(compared[0] >= 35 && compared[1] >= 25, "{compared:?} of 45 are given");
    }
}
