//! Diffusion and scattering of a relief in the far field, computed by Kirchhoff's approximation.
//!
//! The limit of [`crate::kirchhoff`] for a source and receivers at a great distance, with
//! [`FacetScattering::Blended`](crate::kirchhoff::FacetScattering::Blended). Every coefficient is that of a hard panel
//! of the relief's size beside a flat one of the same size in its mean plane; it is computed, not measured.

use std::f64::consts::PI;

use realfft::num_complex::Complex;
use wide::f32x8;

use crate::diffusion::{diffusion_of_levels, normalise_diffusion};
use crate::height_field::HeightField;

/// Receivers of ISO 17497-2 on a half circle in a plane across the panel, 5 degrees apart.
const RECEIVERS: usize = 37;
/// Zenith angles of the sources in that plane, deg, and their weights in the mean for random incidence. There is one to
/// each side.
///
/// Source: ISO 17497-2:2012, clause 8.4.
const SOURCES: [(f64, f64); 3] = [(0.0, 1.0), (30.0, 6.0), (60.0, 6.0)];
/// Least and greatest sum of the vertical parts of both ways.
const RISES: [f64; 2] = [0.5, 2.0];
/// Views of a relief from one zenith angle: from both sides along x, and along y.
const VIEWS: usize = 4;
/// Cells that are summed at once: the lanes of an `f32x8`.
const LANES: usize = 8;

/// Coefficients of a relief for random incidence, the mean of the planes along both of its sides.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FarFieldCoefficients {
    /// Directional diffusion coefficient, normalised by a flat panel's. Negative if the flat panel is more even.
    ///
    /// Source: ISO 17497-2:2012, formulas 5 and 7.
    pub diffusion_normalised: f64,
    /// Share of the energy that a flat panel reflects as a mirror and the relief does not: 1 - |m|^2, with m the mean
    /// of e^(2 i k h cos(a)) over the panel, a the angle of incidence.
    pub scattering: f64,
}

/// Pressures at the receivers of one view, but for a factor that all have in common.
type PolarResponse = [Complex<f64>; RECEIVERS];

/// Energies at the receivers of one view, summed over frequencies.
#[derive(Clone, Copy)]
struct PolarSums {
    relief: [f64; RECEIVERS],
    flat: [f64; RECEIVERS],
}

/// [`CellHeights::phase_sums`] at Chebyshev's points of a range, between which a polynomial is through them: sums are
/// smooth functions of the wave number, and there are fewer points than angles.
struct PhaseTable {
    uprights: Vec<f64>,
    sums: Vec<[Vec<Complex<f64>>; 2]>,
}

/// Heights over their mean in mm, row by row, in groups of cells.
struct CellHeights {
    cells: usize,
    /// Greatest distance from the mean, m.
    greatest_m: f64,
    groups: Vec<f32x8>,
    /// 1 where a group of any row has a cell, else 0.
    presence: Vec<f32x8>,
}

/// Computes the coefficients of a band, whose energies are sums over these wave numbers, rad/m. The cells should be
/// narrower than half the wavelength. Coefficients that do not exist are NaN.
///
/// ```
/// use echolake_dsp::far_field::far_field_coefficients;
/// use echolake_dsp::height_field::HeightField;
///
/// let flat = far_field_coefficients(&HeightField::from_fn(585.0, 64, |_, _| 0.0), &[50.0, 60.0]);
/// assert!(flat.diffusion_normalised.abs() < 1e-9 && flat.scattering.abs() < 1e-9);
/// ```
pub fn far_field_coefficients(relief: &HeightField, wave_numbers: &[f64]) -> FarFieldCoefficients {
    let heights = CellHeights::new(relief);
    let level = vec![Complex::from(relief.cells() as f64); relief.cells()];
    let mut sums = SOURCES.map(|_| [PolarSums { relief: [0.0; RECEIVERS], flat: [0.0; RECEIVERS] }; VIEWS]);
    let mut mirrored = SOURCES.map(|_| 0.0);
    for wave_number in wave_numbers {
        let table = PhaseTable::new(&heights, RISES.map(|rise| wave_number * rise));
        for (number, (source_deg, _)) in SOURCES.into_iter().enumerate() {
            let responses = polar_responses(relief, *wave_number, source_deg, |upright| table.phase_sums(upright));
            let flat = polar_responses(relief, *wave_number, source_deg, |_| [level.clone(), level.clone()]);
            for (sums, (response, flat)) in sums[number].iter_mut().zip(responses.iter().zip(&flat)) {
                sums.add_responses(response, flat);
            }
            let [columns, _] = table.phase_sums(2.0 * wave_number * source_deg.to_radians().cos());
            let mean = columns.iter().sum::<Complex<f64>>() / (relief.cells() * relief.cells()) as f64;
            mirrored[number] += mean.norm_sqr() / wave_numbers.len() as f64;
        }
    }
    let weights: f64 = SOURCES.iter().map(|(_, weight)| weight).sum();
    let mut coefficients = FarFieldCoefficients { diffusion_normalised: 0.0, scattering: 0.0 };
    for ((views, mirrored), (_, weight)) in sums.iter().zip(mirrored).zip(SOURCES) {
        let diffusion = views.iter().map(PolarSums::diffusion_normalised).sum::<f64>() / VIEWS as f64;
        coefficients.diffusion_normalised += diffusion * weight / weights;
        coefficients.scattering += (1.0 - mirrored) * weight / weights;
    }
    coefficients
}

impl PolarSums {
    fn add_responses(&mut self, relief: &PolarResponse, flat: &PolarResponse) {
        self.relief.iter_mut().zip(relief).for_each(|(energy, p)| *energy += p.norm_sqr());
        self.flat.iter_mut().zip(flat).for_each(|(energy, p)| *energy += p.norm_sqr());
    }

    fn diffusion_normalised(&self) -> f64 {
        let diffusion = |energies: [f64; RECEIVERS]| diffusion_of_levels(&energies.map(|energy| 10.0 * energy.log10()));
        let both = diffusion(self.relief).zip(diffusion(self.flat));
        both.and_then(|(relief, flat)| normalise_diffusion(relief, flat)).unwrap_or(f64::NAN)
    }
}

/// Pressures for plane waves from a zenith angle. `phase_sums` is [`CellHeights::phase_sums`] or its like.
///
/// A facet weighs half of n (s + r) + 4 (1 + s_t r_t) / (s_z + r_z), where s and r are the unit vectors to source and
/// receiver, with parts z over the panel and t along it, and n is the normal, as long as the facet is larger than its
/// cell. The slope in n, times the phase, is the phase's own slope, which is right for upright walls, too.
fn polar_responses(
    relief: &HeightField,
    wave_number: f64,
    source_deg: f64,
    phase_sums: impl Fn(f64) -> [Vec<Complex<f64>>; 2],
) -> [PolarResponse; VIEWS] {
    let (source_along, source_up) = source_deg.to_radians().sin_cos();
    let mut responses = [[Complex::default(); RECEIVERS]; VIEWS];
    for receiver in 0..RECEIVERS.div_ceil(2) {
        let (along, up) = (PI * (receiver as f64 / (RECEIVERS - 1) as f64 - 0.5)).sin_cos();
        let rise = source_up + up;
        let sums = phase_sums(wave_number * rise);
        let slopes = [0, 1].map(|axis| slope_sums(&sums[axis], wave_number * rise, relief.pitch_mm() / 1e3));
        for (view, response) in responses.iter_mut().enumerate() {
            let source_along = if view < 2 { source_along } else { -source_along };
            // Receivers to both sides see the heights under the same angle.
            for (index, along) in [(receiver, along), (RECEIVERS - 1 - receiver, -along)] {
                response[index] = Complex::default();
                let level = (rise + 4.0 * (1.0 + source_along * along) / rise) / 2.0;
                let slope = (source_along + along) / 2.0;
                let turn = wave_number * (source_along + along) / 1e3;
                let step = Complex::cis(turn * relief.pitch_mm());
                let mut place = Complex::cis(turn * relief.centre_mm(0));
                for (phase, sloped) in sums[view % 2].iter().zip(&slopes[view % 2]) {
                    response[index] += (phase * level - sloped * slope) * place;
                    place *= step;
                }
            }
        }
    }
    responses
}

// Of slope times phase e^(i upright h), from the differences of the phase.
fn slope_sums(sums: &[Complex<f64>], upright: f64, pitch_m: f64) -> Vec<Complex<f64>> {
    let last = sums.len() - 1;
    let slope = |i: usize| {
        let left = i.saturating_sub(1);
        let right = (i + 1).min(last);
        (sums[right] - sums[left]) / Complex::new(0.0, upright * pitch_m * (right - left) as f64)
    };
    (0..=last).map(slope).collect()
}

impl PhaseTable {
    // The polynomial's coefficients are Bessel functions of half the range times the height, and vanish beyond it.
    fn new(heights: &CellHeights, [low, high]: [f64; 2]) -> Self {
        let middle = (low + high) / 2.0;
        let half = (high - low) / 2.0;
        let last = 12 + (half * heights.greatest_m).ceil() as usize;
        let upright = |point: usize| middle - half * (PI * point as f64 / last as f64).cos();
        let uprights: Vec<f64> = (0..=last).map(upright).collect();
        let sums = uprights.iter().map(|upright| heights.phase_sums(*upright)).collect();
        Self { uprights, sums }
    }

    // Source: Berrut and Trefethen 2004, SIAM Review 46(3), 501-517, the second barycentric form.
    fn phase_sums(&self, upright: f64) -> [Vec<Complex<f64>>; 2] {
        let last = self.uprights.len() - 1;
        let weight = |point: usize| {
            let end = if point == 0 || point == last { 0.5 } else { 1.0 };
            let sign = if point.is_multiple_of(2) { end } else { -end };
            sign / (upright - self.uprights[point])
        };
        if let Some(point) = self.uprights.iter().position(|known| (known - upright).abs() < 1e-9 * upright) {
            return self.sums[point].clone();
        }
        let weights: Vec<f64> = (0..=last).map(weight).collect();
        let all: f64 = weights.iter().sum();
        [0, 1].map(|axis| {
            let mut out = vec![Complex::default(); self.sums[0][axis].len()];
            for (sums, weight) in self.sums.iter().zip(&weights) {
                out.iter_mut().zip(&sums[axis]).for_each(|(out, sum)| *out += sum * (weight / all));
            }
            out
        })
    }
}

impl CellHeights {
    fn new(relief: &HeightField) -> Self {
        let cells = relief.cells();
        let all = relief.heights_mm();
        let mean = all.iter().map(|height| f64::from(*height)).sum::<f64>() / all.len() as f64;
        let relative: Vec<f32> = all.iter().map(|height| (f64::from(*height) - mean) as f32).collect();
        let group = |row: &[f32]| f32x8::new(std::array::from_fn(|lane| row.get(lane).copied().unwrap_or_default()));
        let groups = relative.chunks(cells).flat_map(|row| row.chunks(LANES).map(group)).collect();
        let greatest_m = relative.iter().fold(0.0f32, |greatest, height| greatest.max(height.abs())) / 1e3;
        Self {
            cells,
            greatest_m: greatest_m.into(),
            groups,
            presence: vec![1.0; cells].chunks(LANES).map(group).collect(),
        }
    }

    /// Sums of e^(i upright h) over the cells across the panel, of each column along x and of each row along y; the
    /// wave number is in rad/m.
    fn phase_sums(&self, upright: f64) -> [Vec<Complex<f64>>; 2] {
        let width = self.presence.len();
        let mut columns = vec![[f32x8::ZERO; 2]; width];
        let mut rows = Vec::with_capacity(self.cells);
        for row in self.groups.chunks(width) {
            let mut row_sum = [f32x8::ZERO; 2];
            for ((heights, presence), column) in row.iter().zip(&self.presence).zip(&mut columns) {
                let (sines, cosines) = (*heights * (upright / 1e3) as f32).sin_cos();
                *column = [column[0] + cosines, column[1] + sines];
                row_sum = [row_sum[0] + cosines * *presence, row_sum[1] + sines * *presence];
            }
            let [re, im] = row_sum.map(|sum| f64::from(sum.reduce_add()));
            rows.push(Complex::new(re, im));
        }
        let columns = columns.iter().flat_map(|[re, im]| {
            let lanes = re.to_array().into_iter().zip(im.to_array());
            lanes.map(|(re, im)| Complex::new(f64::from(re), f64::from(im)))
        });
        [columns.take(self.cells).collect(), rows]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kirchhoff::{KirchhoffPlan, SoundPath, TransducerPose};

    fn bumps(cells: usize) -> HeightField {
        HeightField::from_fn(100.0, cells, |x, y| 2.0 * (x / 9.0).sin() + 1.5 * (y / 7.0 + x / 15.0).cos())
    }

    // Source and receiver 20 m away see the same as the time-domain sum does, over a flat panel.
    #[test]
    fn the_limit_of_the_time_domain_sum() {
        let (rate_hz, len, speed) = (96e3, 16_384, 343.0);
        let pose = |degrees: f64, along: usize| {
            let (sine, cosine) = degrees.to_radians().sin_cos();
            let mut away = [0.0, 0.0, cosine];
            away[along] = sine;
            TransducerPose { position_mm: away.map(|x| 20e3 * x), axis: away.map(|x| -x) }
        };
        let flat = HeightField::from_fn(100.0, 100, |_, _| 0.0);
        let spectrum = |relief: &HeightField, source_deg: f64, receiver: usize, along: usize, bin: usize| {
            let plan = KirchhoffPlan::new(relief, rate_hz, len);
            let [one, none] = [1.0, 0.0].map(|gain: f64| plan.spectrum_at_bins(|_| gain.into()));
            let path = SoundPath {
                microphone: pose(receiver as f64 * 5.0 - 90.0, along),
                speaker: pose(source_deg, along),
                speed_of_sound_m_s: speed,
                absorption_db_per_m: &|_| 0.0,
                direct: &none,
                reflection: &one,
            };
            let mut ir = vec![0.0; len];
            plan.compute_response(&path, &mut plan.make_scratch(), &mut ir).expect("a response");
            let turn = |n: usize| Complex::cis(2.0 * PI * (bin * n % len) as f64 / len as f64);
            ir.iter().enumerate().map(|(n, x)| turn(n) * f64::from(*x)).sum::<Complex<f64>>()
        };
        let relief = bumps(100);
        let heights = CellHeights::new(&relief);
        let level = vec![Complex::from(100.0); 100];
        for (source_deg, receiver, along, bin) in
            [(0.0, 19, 0, 900), (30.0, 25, 0, 1_400), (30.0, 6, 1, 1_400), (60.0, 12, 1, 700), (-30.0, 10, 0, 1_100)]
        {
            let wave_number = 2.0 * PI * rate_hz * bin as f64 / len as f64 / speed;
            let zenith_deg = f64::abs(source_deg);
            let view = along + if source_deg < 0.0 { 2 } else { 0 };
            let found = polar_responses(&relief, wave_number, zenith_deg, |upright| heights.phase_sums(upright));
            let beside = polar_responses(&relief, wave_number, zenith_deg, |_| [level.clone(), level.clone()]);
            let expected =
                spectrum(&relief, source_deg, receiver, along, bin) / spectrum(&flat, source_deg, receiver, along, bin);
            let found = found[view][receiver] / beside[view][receiver];
            // Heights are over their mean here, which turns the phase alone.
            assert!((found.norm() / expected.norm() - 1.0).abs() < 0.03, "{source_deg} {receiver}: {found} {expected}");
        }
    }

    // By the same sums in NumPy. Along the ridges nothing scatters.
    #[test]
    fn ridges_scatter_across() {
        let ridges = |turned: bool| {
            HeightField::from_fn(585.0, 274, |x, y| 8.0 * (PI / 50.0 * if turned { y } else { x }).cos())
        };
        let wave_numbers = [80.0, 90.0, 100.0];
        let found = far_field_coefficients(&ridges(false), &wave_numbers);
        let turned = far_field_coefficients(&ridges(true), &wave_numbers);
        assert!((found.scattering - turned.scattering).abs() < 1e-5, "{found:?} {turned:?}");
        assert!((found.diffusion_normalised - turned.diffusion_normalised).abs() < 1e-5, "{found:?} {turned:?}");
        assert!((found.scattering - 0.422_515).abs() < 1e-5, "{found:?}");
        assert!((found.diffusion_normalised - 0.075_318).abs() < 1e-5, "{found:?}");
    }

    #[test]
    fn a_flat_panel_scatters_nothing() {
        for height in [-7.0, 0.0, 30.0] {
            let flat = far_field_coefficients(&HeightField::from_fn(585.0, 100, |_, _| height), &[50.0, 170.0]);
            assert!(flat.scattering.abs() < 1e-6 && flat.diffusion_normalised.abs() < 1e-6, "{height}: {flat:?}");
        }
    }
}
