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
use crate::{Error, RealSample as _};

/// Receivers of ISO 17497-2 on a half circle in a plane across the panel, 5 degrees apart.
const RECEIVERS: usize = 37;
/// Zenith angles of the sources in that plane, deg, and their weights in the mean for random incidence. There is one to
/// each side.
///
/// Source: ISO 17497-2:2012, clause 8.4.
pub(crate) const SOURCES: [(f64, f64); 3] = [(0.0, 1.0), (30.0, 6.0), (60.0, 6.0)];
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

/// Far fields of reliefs of one size and number of cells, over a flat panel's, which is computed once.
///
/// ```
/// use echolake_dsp::far_field::FarFieldPlan;
/// use echolake_dsp::height_field::HeightField;
///
/// let flat = HeightField::from_fn(585.0, 64, |_, _| 0.0);
/// let flat = FarFieldPlan::new(&flat, vec![vec![50.0, 60.0]]).compute_coefficients(&flat)?;
/// assert!(flat[0].diffusion_normalised.abs() < 1e-9 && flat[0].scattering.abs() < 1e-9);
/// # Ok::<(), echolake_dsp::Error>(())
/// ```
#[derive(Debug)]
pub struct FarFieldPlan {
    size_mm: f64,
    cells: usize,
    bands: Vec<BandWaves>,
}

/// Wave numbers of a band, rad/m, and a flat panel's energies, summed over them.
#[derive(Debug)]
struct BandWaves {
    wave_numbers: Vec<f64>,
    flat: [PolarEnergies; SOURCES.len()],
}

/// Energies at the receivers of each view.
type PolarEnergies = [[f64; RECEIVERS]; VIEWS];

/// Pressures at the receivers of each view, but for a factor that all have in common.
type PolarResponses = [[Complex<f64>; RECEIVERS]; VIEWS];

/// Sums of phases e^(i upright h) over the cells across the panel: the real parts of those of each column along x, then
/// the imaginary parts, then the same of each row along y. `[4 x cells]`.
type PhaseSums = [f64];

/// [`PhaseSums`] at Chebyshev's points of a range, between which a polynomial is through them: sums are smooth
/// functions of the wave number, and there are fewer points than angles.
struct PhaseTable {
    uprights: Vec<f64>,
    /// `[points, up to a multiple of BLOCK][4 x cells]`.
    sums: Vec<f64>,
}

/// Points of a table that are summed side by side.
const BLOCK: usize = 4;

/// Phases of a plane wave along a line of cells, and the factor from one to the next.
struct LinePhases {
    re: Vec<f64>,
    im: Vec<f64>,
    step: Complex<f64>,
}

/// Heights over their mean in mm, row by row, in groups of cells.
struct CellHeights {
    cells: usize,
    /// Greatest distance from the mean, m.
    greatest_m: f64,
    /// Level with the mean beyond the end of a row.
    groups: Vec<f32x8>,
}

/// Parts of e^(i upright h) - 1 of a group of cells. Without the 1, a relief that is nearly flat is not lost in
/// rounding.
type PhaseChanges = [f32x8; 2];

impl FarFieldPlan {
    /// Plans for reliefs of the size and cells of this one and for bands, whose energies are sums over their wave
    /// numbers, rad/m. The cells should be narrower than half the wavelength.
    pub fn new(relief: &HeightField, bands: Vec<Vec<f64>>) -> Self {
        let mut plan = Self { size_mm: relief.size_mm(), cells: relief.cells(), bands: Vec::new() };
        plan.bands = bands.into_iter().map(|wave_numbers| plan.band_waves(wave_numbers)).collect();
        plan
    }

    /// Returns whether this is a plan for reliefs of this one's size and cells.
    pub fn fits_field(&self, relief: &HeightField) -> bool {
        self.size_mm == relief.size_mm() && self.cells == relief.cells()
    }

    /// Wave numbers of each band, rad/m.
    pub fn band_wave_numbers(&self) -> impl Iterator<Item = &[f64]> {
        self.bands.iter().map(|band| band.wave_numbers.as_slice())
    }

    /// Computes the coefficients of each band. Coefficients that do not exist are NaN.
    ///
    /// # Errors
    /// [`Error::Setting`] if the relief has another size or number of cells than the plan's.
    pub fn compute_coefficients(&self, relief: &HeightField) -> Result<Vec<FarFieldCoefficients>, Error> {
        if !self.fits_field(relief) {
            let actual = format!("{} cells over {} mm", relief.cells(), relief.size_mm());
            return Err(Error::Setting { what: "the relief", actual, expected: "the plan's cells and size" });
        }
        let wave_numbers = || self.bands.iter().flat_map(|band| &band.wave_numbers).copied();
        let [least, greatest] = [wave_numbers().fold(f64::MAX, f64::min), wave_numbers().fold(0.0, f64::max)];
        let table = PhaseTable::new(&CellHeights::new(relief), [least * RISES[0], greatest * RISES[1]]);
        let mut sums = vec![0.0; 4 * self.cells];
        Ok(self.bands.iter().map(|band| self.band_coefficients(band, &table, &mut sums)).collect())
    }

    fn band_coefficients(&self, band: &BandWaves, table: &PhaseTable, sums: &mut PhaseSums) -> FarFieldCoefficients {
        let weights: f64 = SOURCES.iter().map(|(_, weight)| weight).sum();
        let mut coefficients = FarFieldCoefficients { diffusion_normalised: 0.0, scattering: 0.0 };
        for ((source_deg, weight), flat) in SOURCES.into_iter().zip(&band.flat) {
            let mut energies = [[0.0; RECEIVERS]; VIEWS];
            let mut mirrored = 0.0;
            for wave_number in &band.wave_numbers {
                let phase_sums = |upright: f64, sums: &mut PhaseSums| table.fill_sums(upright, sums);
                add_energies(&mut energies, &self.polar_responses(*wave_number, source_deg, phase_sums, sums));
                table.fill_sums(2.0 * wave_number * source_deg.to_radians().cos(), sums);
                let columns = sums.chunks_exact(self.cells).map(|part| part.iter().sum::<f64>());
                let square: f64 = columns.take(2).map(|sum| sum * sum).sum();
                mirrored += square / (self.cells as f64).powi(4) / band.wave_numbers.len() as f64;
            }
            let diffusion = energies.iter().zip(flat).map(|(relief, flat)| diffusion_normalised(relief, flat));
            coefficients.diffusion_normalised += diffusion.sum::<f64>() / VIEWS as f64 * weight / weights;
            coefficients.scattering += (1.0 - mirrored) * weight / weights;
        }
        coefficients
    }

    fn band_waves(&self, wave_numbers: Vec<f64>) -> BandWaves {
        let level = |_: f64, sums: &mut PhaseSums| {
            let parts = sums.chunks_exact_mut(self.cells).zip([self.cells as f64, 0.0].into_iter().cycle());
            parts.for_each(|(part, value)| part.fill(value));
        };
        let mut sums = vec![0.0; 4 * self.cells];
        let flat = SOURCES.map(|(source_deg, _)| {
            let mut energies = [[0.0; RECEIVERS]; VIEWS];
            for wave_number in &wave_numbers {
                add_energies(&mut energies, &self.polar_responses(*wave_number, source_deg, level, &mut sums));
            }
            energies
        });
        BandWaves { wave_numbers, flat }
    }

    /// Computes pressures for plane waves from a zenith angle. `phase_sums` fills the sums of a relief for an upright
    /// wave number.
    ///
    /// A facet weighs half of n (s + r) + 4 (1 + s_t r_t) / (s_z + r_z), where s and r are the unit vectors to source
    /// and receiver, with parts z over the panel and t along it, and n is the normal, as long as the facet is larger
    /// than its cell. The slope in n, times the phase, is the phase's own slope, which is right for upright walls, too.
    fn polar_responses(
        &self,
        wave_number: f64,
        source_deg: f64,
        phase_sums: impl Fn(f64, &mut PhaseSums),
        sums: &mut PhaseSums,
    ) -> PolarResponses {
        let (source_along, source_up) = source_deg.to_radians().sin_cos();
        let mut responses = [[Complex::default(); RECEIVERS]; VIEWS];
        for receiver in 0..RECEIVERS.div_ceil(2) {
            let (along, up) = (PI * (receiver as f64 / (RECEIVERS - 1) as f64 - 0.5)).sin_cos();
            let rise = source_up + up;
            phase_sums(wave_number * rise, sums);
            // Receivers to both sides see the heights under the same angle.
            for (index, along) in [(receiver, along), (RECEIVERS - 1 - receiver, -along)] {
                let line = LinePhases::new(self, wave_number * (source_along + along) / 1e3);
                let level = (rise + 4.0 * (1.0 + source_along * along) / rise) / 2.0;
                let slope = (source_along + along) / 2.0;
                // The phase's slope is its difference over this.
                let run = Complex::new(0.0, 2.0 * wave_number * rise * self.size_mm / self.cells as f64 / 1e3);
                for (axis, sums) in sums.chunks_exact(2 * self.cells).enumerate() {
                    let there = line.transform_sums(sums);
                    responses[axis][index] = there[0].0 * level - there[0].1 / run * slope;
                    // The same from the other side of the panel.
                    responses[axis + 2][RECEIVERS - 1 - index] = there[1].0 * level + there[1].1 / run * slope;
                }
            }
        }
        responses
    }
}

fn add_energies(energies: &mut PolarEnergies, responses: &PolarResponses) {
    for (energies, responses) in energies.iter_mut().zip(responses) {
        energies.iter_mut().zip(responses).for_each(|(energy, pressure)| *energy += pressure.norm_sqr());
    }
}

fn diffusion_normalised(relief: &[f64; RECEIVERS], flat: &[f64; RECEIVERS]) -> f64 {
    let diffusion = |energies: &[f64; RECEIVERS]| diffusion_of_levels(&energies.map(|energy| 10.0 * energy.log10()));
    let both = diffusion(relief).zip(diffusion(flat));
    both.and_then(|(relief, flat)| normalise_diffusion(relief, flat)).unwrap_or(f64::NAN)
}

impl LinePhases {
    // `turn` is in rad/mm.
    fn new(plan: &FarFieldPlan, turn: f64) -> Self {
        let pitch_mm = plan.size_mm / plan.cells as f64;
        let mut re = vec![0.0; plan.cells.next_multiple_of(BLOCK)];
        let mut im = re.clone();
        let first = (pitch_mm - plan.size_mm) / 2.0;
        let mut phases: [Complex<f64>; BLOCK] =
            std::array::from_fn(|lane| Complex::cis(turn * (first + lane as f64 * pitch_mm)));
        let stride = Complex::cis(turn * BLOCK as f64 * pitch_mm);
        for (re, im) in re.as_chunks_mut::<BLOCK>().0.iter_mut().zip(im.as_chunks_mut::<BLOCK>().0) {
            *re = phases.map(|phase| phase.re);
            *im = phases.map(|phase| phase.im);
            phases.iter_mut().for_each(|phase| *phase *= stride);
        }
        re.truncate(plan.cells);
        im.truncate(plan.cells);
        Self { re, im, step: Complex::cis(turn * pitch_mm) }
    }

    // Sums of phases along the line times these, and of differences of the former, over two cells, times these; then
    // the same with the wave from the other side.
    fn transform_sums(&self, sums: &[f64]) -> [(Complex<f64>, Complex<f64>); 2] {
        let (re, im) = sums.split_at(self.re.len());
        let [rr, ii] = [f64::dot_product(re, &self.re), f64::dot_product(im, &self.im)];
        let [ri, ir] = [f64::dot_product(re, &self.im), f64::dot_product(im, &self.re)];
        let wholes = [Complex::new(rr - ii, ri + ir), Complex::new(rr + ii, ir - ri)];
        let last = re.len() - 1;
        [(wholes[0], 1.0), (wholes[1], -1.0)].map(|(whole, side)| {
            let sum = |cell: usize| Complex::new(re[cell], im[cell]);
            let phase = |cell: usize| Complex::new(self.re[cell], side * self.im[cell]);
            let step = Complex::new(self.step.re, side * self.step.im);
            let term = |cell: usize| sum(cell) * phase(cell);
            // The sum of (sum[i + 1] - sum[i - 1]) phase[i], by the factor between phases, without the ends. These have
            // one neighbour.
            let inner = (whole - term(0) - term(1)) * step.conj() - (whole - term(last - 1) - term(last)) * step;
            let ends = (sum(1) - sum(0)) * phase(0) + (sum(last) - sum(last - 1)) * phase(last);
            (whole, inner + ends * 2.0)
        })
    }
}

impl PhaseTable {
    // The polynomial's coefficients are Bessel functions of half the range times the height, and vanish beyond it:
    // those of 1.4 times as high an order and 12 more are below 1e-8.
    fn new(heights: &CellHeights, [low, high]: [f64; 2]) -> Self {
        let middle = (low + high) / 2.0;
        let half = (high - low) / 2.0;
        // An even number of points has none in the middle.
        let last = (12 + (1.4 * half * heights.greatest_m).ceil() as usize) | 1;
        let distance = |point: usize| half * (PI * point as f64 / last as f64).cos();
        let uprights: Vec<f64> = (0..=last).map(|point| middle - distance(point)).collect();
        let width = 4 * heights.cells;
        let mut sums = vec![0.0; uprights.len().next_multiple_of(BLOCK) * width];
        let middle = heights.turn_phases(middle);
        let mut points = sums.chunks_exact_mut(width).take(uprights.len()).enumerate();
        while let (Some((point, below)), Some((_, above))) = (points.next(), points.next_back()) {
            heights.fill_sums(&middle, distance(point), below, above);
        }
        Self { uprights, sums }
    }

    // Source: Berrut and Trefethen 2004, SIAM Review 46(3), 501-517, the second barycentric form.
    fn fill_sums(&self, upright: f64, sums: &mut PhaseSums) {
        let last = self.uprights.len() - 1;
        let weight = |point: usize| {
            let end = if point == 0 || point == last { 0.5 } else { 1.0 };
            let sign = if point.is_multiple_of(2) { end } else { -end };
            sign / (upright - self.uprights[point])
        };
        let known = self.uprights.iter().position(|known| (known - upright).abs() < 1e-9 * upright);
        let mut weights: Vec<f64> = match known {
            Some(known) => (0..=last).map(|point| if point == known { 1.0 } else { 0.0 }).collect(),
            None => (0..=last).map(weight).collect(),
        };
        let all: f64 = weights.iter().sum();
        weights.resize(weights.len().next_multiple_of(BLOCK), 0.0);
        sums.fill(0.0);
        for (rows, weights) in self.sums.chunks_exact(BLOCK * sums.len()).zip(weights.as_chunks::<BLOCK>().0) {
            let [a, b, c, d] = weights.map(|weight| weight / all);
            let (first, second) = rows.split_at(2 * sums.len());
            let ((x, y), (z, w)) = (first.split_at(sums.len()), second.split_at(sums.len()));
            for ((((sum, x), y), z), w) in sums.iter_mut().zip(x).zip(y).zip(z).zip(w) {
                *sum += a * x + b * y + c * z + d * w;
            }
        }
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
        Self { cells, greatest_m: greatest_m.into(), groups }
    }

    /// Computes the phases of all groups for an upright wave number, rad/m.
    fn turn_phases(&self, upright: f64) -> Vec<PhaseChanges> {
        self.groups.iter().map(|heights| turn_phase(*heights, upright)).collect()
    }

    /// Computes the sums for two upright wave numbers that are as far below and above a third one, from the phases of
    /// that one: so there is one sine for both.
    fn fill_sums(&self, middle: &[PhaseChanges], distance: f64, below: &mut PhaseSums, above: &mut PhaseSums) {
        let width = self.cells.div_ceil(LANES);
        let mut columns = vec![[PhaseChanges::default(); 2]; width];
        for (number, (heights, middle)) in self.groups.chunks(width).zip(middle.chunks(width)).enumerate() {
            let mut row = [PhaseChanges::default(); 2];
            for ((heights, [a_re, a_im]), column) in heights.iter().zip(middle).zip(&mut columns) {
                // (1 + a) (1 + b) - 1, and the same with b's conjugate.
                let [b_re, b_im] = turn_phase(*heights, distance);
                let re = *a_re + b_re + *a_re * b_re;
                let im = *a_im + *a_im * b_re;
                let along = *a_im * b_im;
                let across = b_im + *a_re * b_im;
                let both = [[re + along, im - across], [re - along, im + across]];
                for (changes, (column, row)) in both.iter().zip(column.iter_mut().zip(&mut row)) {
                    column.iter_mut().zip(changes).for_each(|(sum, change)| *sum += *change);
                    row.iter_mut().zip(changes).for_each(|(sum, change)| *sum += *change);
                }
            }
            for (sums, row) in [&mut *below, &mut *above].into_iter().zip(row) {
                let [re, im] = row.map(|changes| f64::from(changes.reduce_add()));
                sums[2 * self.cells + number] = re + self.cells as f64;
                sums[3 * self.cells + number] = im;
            }
        }
        for (side, sums) in [below, above].into_iter().enumerate() {
            for (part, sums) in sums.chunks_exact_mut(self.cells).take(2).enumerate() {
                let unturned = if part == 0 { self.cells as f64 } else { 0.0 };
                let lanes = columns.iter().flat_map(|column| column[side][part].to_array());
                sums.iter_mut().zip(lanes).for_each(|(sum, lane)| *sum = unturned + f64::from(lane));
            }
        }
    }
}

fn turn_phase(heights: f32x8, upright: f64) -> PhaseChanges {
    let (sines, cosines) = (heights * (upright / 2e3) as f32).sin_cos();
    let twice = sines + sines;
    [-(twice * sines), twice * cosines]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kirchhoff::{KirchhoffPlan, SoundPath, TransducerPose};

    fn bumps(cells: usize) -> HeightField {
        HeightField::from_fn(100.0, cells, |x, y| 2.0 * (x / 9.0).sin() + 1.5 * (y / 7.0 + x / 15.0).cos())
    }

    fn coefficients(relief: &HeightField, wave_numbers: &[f64]) -> FarFieldCoefficients {
        let plan = FarFieldPlan::new(relief, vec![wave_numbers.to_vec()]);
        plan.compute_coefficients(relief).expect("the plan's relief")[0]
    }

    // In double precision.
    fn fill_directly(relief: &CellHeights, upright: f64, sums: &mut PhaseSums) {
        sums.fill(0.0);
        let width = relief.cells.div_ceil(LANES);
        for (row, groups) in relief.groups.chunks(width).enumerate() {
            let heights = groups.iter().flat_map(|group| group.to_array()).take(relief.cells);
            for (column, height) in heights.enumerate() {
                let phase = Complex::cis(upright * f64::from(height) / 1e3);
                for (at, part) in [(0, phase.re), (1, phase.im)] {
                    sums[at * relief.cells + column] += part;
                    sums[(2 + at) * relief.cells + row] += part;
                }
            }
        }
    }

    // The formula as it is written, cell by cell along a line, from the sums at each angle.
    fn plain_responses(relief: &HeightField, wave_number: f64, source_deg: f64) -> PolarResponses {
        let heights = CellHeights::new(relief);
        let cells = relief.cells();
        let last = cells - 1;
        let mut responses = [[Complex::default(); RECEIVERS]; VIEWS];
        let mut sums = vec![0.0; 4 * cells];
        for (view, responses) in responses.iter_mut().enumerate() {
            for (receiver, response) in responses.iter_mut().enumerate() {
                let (source_along, source_up) = source_deg.to_radians().sin_cos();
                let source_along = if view < 2 { source_along } else { -source_along };
                let (along, up) = (PI * (receiver as f64 / (RECEIVERS - 1) as f64 - 0.5)).sin_cos();
                let rise = source_up + up;
                fill_directly(&heights, wave_number * rise, &mut sums);
                let axis = &sums[2 * cells * (view % 2)..];
                let sum = |cell: usize| Complex::new(axis[cell], axis[cells + cell]);
                let level = (rise + 4.0 * (1.0 + source_along * along) / rise) / 2.0;
                for cell in 0..cells {
                    let (left, right) = (cell.saturating_sub(1), (cell + 1).min(last));
                    let run_m = (right - left) as f64 * relief.pitch_mm() / 1e3;
                    let slope = (sum(right) - sum(left)) / Complex::new(0.0, wave_number * rise * run_m);
                    let turn = wave_number * (source_along + along) * relief.centre_mm(cell) / 1e3;
                    *response += (sum(cell) * level - slope * (source_along + along) / 2.0) * Complex::cis(turn);
                }
            }
        }
        responses
    }

    #[test]
    fn responses_from_the_table_are_those_of_the_formula() {
        for (cells, rise_mm, bands) in [(2, 3.0, 2), (31, 0.3, 5), (100, 12.0, 5), (64, 60.0, 3)] {
            let relief = HeightField::from_fn(585.0, cells, |x, y| {
                rise_mm * (0.6 * (x / 31.0 + 0.2).sin() + 0.4 * (y / 17.0 + x / 50.0).cos())
            });
            let wave_numbers: Vec<f64> = (0..bands).map(|band| 45.0 * f64::from(1 << band)).collect();
            let plan = FarFieldPlan::new(&relief, wave_numbers.iter().map(|wave_number| vec![*wave_number]).collect());
            let range = [wave_numbers[0] * RISES[0], wave_numbers[wave_numbers.len() - 1] * RISES[1]];
            let table = PhaseTable::new(&CellHeights::new(&relief), range);
            let found = plan.compute_coefficients(&relief).expect("the plan's relief");
            let level = HeightField::from_fn(585.0, cells, |_, _| 0.0);
            for (wave_number, found) in wave_numbers.into_iter().zip(found) {
                let mut expected = FarFieldCoefficients { diffusion_normalised: 0.0, scattering: 0.0 };
                for (source_deg, weight) in SOURCES {
                    let mut sums = vec![0.0; 4 * cells];
                    let fill = |upright: f64, sums: &mut PhaseSums| table.fill_sums(upright, sums);
                    let by_table = plan.polar_responses(wave_number, source_deg, fill, &mut sums);
                    let plain = plain_responses(&relief, wave_number, source_deg);
                    let flat = plain_responses(&level, wave_number, source_deg);
                    let greatest = plain.iter().flatten().map(|p| p.norm()).fold(0.0, f64::max);
                    for (by_table, plain) in by_table.iter().flatten().zip(plain.iter().flatten()) {
                        // The table's sums are of single precision.
                        assert!(
                            (by_table - plain).norm() < 2e-6 * greatest,
                            "{cells} {wave_number}: {by_table} {plain}"
                        );
                    }
                    let energies = |responses: &PolarResponses| responses.map(|view| view.map(|p| p.norm_sqr()));
                    let views = energies(&plain).into_iter().zip(energies(&flat));
                    let diffusion: f64 = views.map(|(relief, flat)| diffusion_normalised(&relief, &flat)).sum();
                    expected.diffusion_normalised += diffusion / VIEWS as f64 * weight / 13.0;
                    let upright = 2.0 * wave_number * source_deg.to_radians().cos() / 1e3;
                    let phases = relief.heights_mm().iter().map(|height| Complex::cis(upright * f64::from(*height)));
                    let mirrored = (phases.sum::<Complex<f64>>() / (cells * cells) as f64).norm_sqr();
                    expected.scattering += (1.0 - mirrored) * weight / 13.0;
                }
                let off = (found.diffusion_normalised - expected.diffusion_normalised)
                    .abs()
                    .max((found.scattering - expected.scattering).abs());
                assert!(off < 1e-6, "{cells} cells, {wave_number}: {found:?} {expected:?}");
                // Of a relief that is nearly flat, too, the coefficients are those of the formula.
                assert!((found.diffusion_normalised / expected.diffusion_normalised - 1.0).abs() < 1e-4, "{found:?}");
            }
            let other = HeightField::from_fn(500.0, cells, |_, _| 0.0);
            assert!(matches!(plan.compute_coefficients(&other), Err(Error::Setting { .. })));
        }
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
        let level = CellHeights::new(&flat);
        let plan = FarFieldPlan::new(&relief, Vec::new());
        for (source_deg, receiver, along, bin) in
            [(0.0, 19, 0, 900), (30.0, 25, 0, 1_400), (30.0, 6, 1, 1_400), (60.0, 12, 1, 700), (-30.0, 10, 0, 1_100)]
        {
            let wave_number = 2.0 * PI * rate_hz * bin as f64 / len as f64 / speed;
            let zenith_deg = f64::abs(source_deg);
            let view = along + if source_deg < 0.0 { 2 } else { 0 };
            let [found, beside] = [&heights, &level].map(|heights| {
                let fill = |upright: f64, sums: &mut PhaseSums| fill_directly(heights, upright, sums);
                plan.polar_responses(wave_number, zenith_deg, fill, &mut vec![0.0; 400])
            });
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
        let [found, turned] = [false, true].map(|turned| coefficients(&ridges(turned), &wave_numbers));
        assert!((found.scattering - turned.scattering).abs() < 1e-5, "{found:?} {turned:?}");
        assert!((found.diffusion_normalised - turned.diffusion_normalised).abs() < 1e-5, "{found:?} {turned:?}");
        assert!((found.scattering - 0.422_515).abs() < 1e-5, "{found:?}");
        assert!((found.diffusion_normalised - 0.075_318).abs() < 1e-5, "{found:?}");
    }

    #[test]
    fn a_flat_panel_scatters_nothing() {
        for height in [-7.0, 0.0, 30.0] {
            let flat = coefficients(&HeightField::from_fn(585.0, 100, |_, _| height), &[50.0, 170.0]);
            assert!(flat.scattering.abs() < 1e-6 && flat.diffusion_normalised.abs() < 1e-6, "{height}: {flat:?}");
        }
    }
}
