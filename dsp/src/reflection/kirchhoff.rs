//! Reflection of a pulse at a relief: the time-domain Kirchhoff approximation in its reciprocal form.
//!
//! With source at r1 and receiver at r2 from a facet dS,
//! h(t) = 1/(4 pi) sum dS/(r1 r2) [ (cos1 + cos2)/c d'(t - tau) + (cos1/r1 + cos2/r2) d(t - tau) ],
//! tau = (r1 + r2)/c: the tangent-plane approximation. [`FacetScattering`] tells which facets count, and what else is
//! mixed in for slopes and details of the size of the wavelength. No multiple reflection, no diffraction of the
//! diffracted, no shadows; worse at grazing angles. `tests/simulation/compare_bem.py` compares it with a
//! boundary-element method. With facets of 2.14 mm a flat plate is within 0.04 dB of its image source, 2.5 to 40 kHz.
//!
//! Directivity and the air's absorption, which depend on a facet's direction or distance and on the frequency, are
//! gathered at a few frequencies at once and interpolated between them.

use std::f64::consts::PI;
use std::sync::Arc;

use realfft::num_complex::Complex;
use realfft::{ComplexToReal, RealToComplex};
use wide::{f32x4, f32x8};

use crate::error::check_len;
use crate::height_field::HeightField;
use crate::{Error, RealSample as _};

/// Arrivals are gathered at this multiple of the sampling rate.
const OVERSAMPLING: usize = 8;
/// The response is kept whole up to this, and is gone at half the sampling rate: share of the sampling rate.
const PASS: f64 = 41.0 / 96.0;
/// Frequencies at which directivity and absorption are evaluated: Chebyshev's nodes of the frequency's square, of which
/// both are smooth functions, from 0 to this share of the sampling rate. A piston as wide as two wavelengths is within
/// 0.005 of its gain up to 45 degrees, and within 0.1 at its side.
const NODES: usize = 4;
const HIGHEST_NODE: f64 = 42.0 / 96.0;
/// Directions of a directivity table, evenly by cosine.
const DIRECTIONS: usize = 2048;
/// Facets that are weighed at once: the lanes of an `f32x8`.
const LANES: usize = 8;
/// dB of one neper.
const DB_PER_NEPER: f64 = 20.0 * std::f64::consts::LOG10_E;

/// A relief, ready to give the response between any two places over it.
///
/// ```
/// use echolake_dsp::height_field::HeightField;
/// use echolake_dsp::kirchhoff::{KirchhoffPlan, SoundPath, TransducerPose};
///
/// let flat = HeightField::from_fn(585.0, 32, |_, _| 0.0);
/// let plan = KirchhoffPlan::new(&flat, 96e3, 384);
/// let down = |x| TransducerPose { position_mm: [x, 0.0, 200.0], axis: [0.0, 0.0, -1.0] };
/// let (one, none) = (plan.spectrum_at_bins(|_| 1.0.into()), plan.spectrum_at_bins(|_| 0.0.into()));
/// let path = SoundPath {
///     microphone: down(-100.0),
///     speaker: down(100.0),
///     speed_of_sound_m_s: 343.0,
///     absorption_db_per_m: &|_| 0.0,
///     direct: &one,
///     reflection: &none,
/// };
/// let mut ir = [0.0; 384];
/// plan.compute_response(&path, &mut plan.make_scratch(), &mut ir)?;
/// // Without a reflection, the direct sound alone: 0.2 m at 343 m/s are 56 samples.
/// assert_eq!((0..384).max_by(|a, b| ir[*a].total_cmp(&ir[*b])), Some(56));
/// # Ok::<(), echolake_dsp::Error>(())
/// ```
pub struct KirchhoffPlan {
    rate_hz: f64,
    scattering: FacetScattering,
    facets: ReliefFacets,
    microphone: DirectivityTable,
    speaker: DirectivityTable,
    len: usize,
    forward: Arc<dyn RealToComplex<f32>>,
    inverse: Arc<dyn ComplexToReal<f32>>,
    /// Band limit of each bin of the response's spectrum, and the correction of the linear deposit.
    fade: Vec<f32>,
    correction: Vec<f32>,
    /// Weights of the nodes at each bin.
    interpolation: Vec<[f32; NODES]>,
}

/// Scattering of facets that are not level.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FacetScattering {
    /// Each facet scatters as a part of its tangent plane, and only if it faces microphone and speaker: what falls on
    /// steep walls is lost.
    FacingTangent,
    /// All facets count, those that face away with their negative cosines, so that the sum over a wall and its foot
    /// loses nothing. Half of it is by tangent planes, half by the small-slope approximation of first order, whose
    /// weight 4 (1 + t1 t2)/(z1 + z2), with t and z the parts of the unit vectors to both ends along the panel and over
    /// it, is (cos1 + cos2) where a level facet mirrors and more beside it: details below the wavelength scatter
    /// sideways. The half is what agrees best with the boundary-element method over all reliefs that were tried.
    ///
    /// Source: Voronovich 1994, Wave Scattering from Rough Surfaces, for a hard surface.
    Blended,
}

/// Place and direction of a microphone or speaker.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TransducerPose {
    /// Its acoustic centre, mm.
    pub position_mm: [f64; 3],
    /// Direction of its axis, of length 1: of a speaker where it shines, of a microphone where it listens.
    pub axis: [f64; 3],
}

/// Everything between a speaker and a microphone but the relief.
#[derive(Clone, Copy)]
pub struct SoundPath<'a> {
    /// The microphone.
    pub microphone: TransducerPose,
    /// The speaker.
    pub speaker: TransducerPose,
    /// Speed of sound, m/s.
    pub speed_of_sound_m_s: f64,
    /// The air's absorption at a frequency in Hz, dB/m.
    pub absorption_db_per_m: &'a dyn Fn(f64) -> f64,
    /// Spectrum of the direct sound, a filter of [`KirchhoffPlan::spectrum_at_bins`].
    pub direct: &'a [Complex<f32>],
    /// Spectrum of the reflection, the relief's reflection factor included.
    pub reflection: &'a [Complex<f32>],
}

/// The relief's facets, lengths in m. What all rows or all columns share stands once: all facets are read for each
/// response, from beyond the core's cache.
struct ReliefFacets {
    area: f32,
    /// Place of each row.
    rows: Vec<f32x8>,
    columns: Vec<FacetColumns>,
    /// Row by row.
    groups: Vec<FacetGroup>,
}

/// Places in their row of neighbours that are weighed at once. The last group of a row is filled up with facets that
/// weigh nothing.
struct FacetColumns {
    place: f32x8,
    /// 1 where there is a facet, else 0.
    presence: f32x8,
}

/// Heights and slopes of the facets of a group.
struct FacetGroup {
    height: f32x8,
    slope: [f32x8; 2],
}

/// Gain by direction and node.
struct DirectivityTable(Vec<f32x4>);

/// A microphone or speaker as facets see it, m.
#[derive(Clone, Copy)]
struct ViewPoint {
    position: [f32x8; 3],
    axis: [f32x8; 3],
}

/// Facets as seen from a point.
struct FacetView {
    distance: f32x8,
    /// Unit vector to the point.
    way: [f32x8; 3],
    /// 1 over the distance.
    nearness: f32x8,
    /// Cosine against the un-normalised normal, which is as long as the facet is larger than its cell.
    cosine: f32x8,
    /// Place of the direction in a directivity table.
    direction: f32x8,
}

/// Weights of a group of facets.
struct FacetWeights {
    path: f32x8,
    derivative: f32x8,
    plain: f32x8,
    from_microphone: f32x8,
    from_speaker: f32x8,
}

/// Buffers of a [`KirchhoffPlan`].
pub struct KirchhoffScratch {
    /// Weights of d' at each node, and of d, by time. Of d alone there is one: it matters at low frequencies only,
    /// where directivity and absorption do not.
    derivative: Vec<f32x4>,
    plain: Vec<f32>,
    wide: Vec<f32>,
    spectrum: Vec<Complex<f32>>,
    work: Vec<Complex<f32>>,
    narrow: Vec<Complex<f32>>,
}

impl KirchhoffPlan {
    /// For responses of `len` samples at `rate_hz`, with microphone and speaker that are the same in all directions.
    pub fn new(relief: &HeightField, rate_hz: f64, len: usize) -> Self {
        let share = |k: usize| k as f64 / len as f64;
        let bins = 0..len / 2 + 1;
        Self {
            rate_hz,
            scattering: FacetScattering::Blended,
            facets: ReliefFacets::new(relief),
            microphone: DirectivityTable::new(rate_hz, |_, _| 1.0),
            speaker: DirectivityTable::new(rate_hz, |_, _| 1.0),
            len,
            forward: f32::plan_real_forward(len * OVERSAMPLING),
            inverse: f32::plan_real_inverse(len),
            fade: bins.clone().map(|k| fade_gain(share(k)) as f32).collect(),
            correction: bins.clone().map(|k| deposit_correction(share(k)) as f32).collect(),
            interpolation: bins.map(|k| interpolation_weights(share(k))).collect(),
        }
    }

    /// Sets the scattering of facets; blended if it is not set.
    pub fn with_scattering(self, scattering: FacetScattering) -> Self {
        Self { scattering, ..self }
    }

    /// Sets the gains of microphone and speaker at a cosine against their axes and a frequency in Hz.
    pub fn with_directivity(self, microphone: impl Fn(f64, f64) -> f64, speaker: impl Fn(f64, f64) -> f64) -> Self {
        let (microphone, speaker) =
            (DirectivityTable::new(self.rate_hz, microphone), DirectivityTable::new(self.rate_hz, speaker));
        Self { microphone, speaker, ..self }
    }

    /// Samples of a response.
    #[allow(clippy::len_without_is_empty, reason = "a response has samples")]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Values of a spectrum at the bins of a response.
    pub fn spectrum_at_bins(&self, at_hz: impl Fn(f64) -> Complex<f64>) -> Vec<Complex<f32>> {
        let value = |k: usize| at_hz(self.frequency_hz(k));
        (0..self.len / 2 + 1).map(value).map(|x| Complex::new(x.re as f32, x.im as f32)).collect()
    }

    /// Buffers for [`Self::compute_response`]; one per thread.
    pub fn make_scratch(&self) -> KirchhoffScratch {
        let wide = self.len * OVERSAMPLING;
        KirchhoffScratch {
            derivative: vec![f32x4::ZERO; wide],
            plain: vec![0.0; wide],
            wide: vec![0.0; wide],
            spectrum: self.forward.make_output_vec(),
            work: vec![Complex::default(); self.forward.get_scratch_len().max(self.inverse.get_scratch_len())],
            narrow: self.inverse.make_input_vec(),
        }
    }

    /// Response along a path: the direct sound and the reflection, for a source whose pressure is s(t - r/c)/r, r in m,
    /// on its axis. A reflection that arrives past the end is left out.
    ///
    /// out `[len]`
    ///
    /// # Errors
    /// [`Error::Length`] if `out`, `scratch` or a filter is not the plan's; `out` is left as it was.
    pub fn compute_response(
        &self,
        path: &SoundPath<'_>,
        scratch: &mut KirchhoffScratch,
        out: &mut [f32],
    ) -> Result<(), Error> {
        check_len("the response", out.len(), self.len)?;
        check_len("the scratch", scratch.wide.len(), self.len * OVERSAMPLING)?;
        check_len("the direct sound's filter", path.direct.len(), self.fade.len())?;
        check_len("the reflection's filter", path.reflection.len(), self.fade.len())?;
        let per_metre = self.rate_hz * OVERSAMPLING as f64 / path.speed_of_sound_m_s;
        scratch.derivative.fill(f32x4::ZERO);
        scratch.plain.fill(0.0);
        self.gather_facets(path, per_metre as f32, scratch);
        absorb_weights(&mut scratch.derivative, self.step_attenuation(path, per_metre));
        self.transform_pulses(path, scratch);
        self.add_direct(path, scratch);
        // Lengths are the plan's own, so the transform cannot refuse; it asks for real ends only.
        scratch.narrow[0].im = 0.0;
        if let Some(last) = scratch.narrow.last_mut() {
            last.im = 0.0;
        }
        let _ = self.inverse.process_with_scratch(&mut scratch.narrow, out, &mut scratch.work);
        Ok(())
    }

    fn frequency_hz(&self, bin: usize) -> f64 {
        bin as f64 * self.rate_hz / self.len as f64
    }

    fn gather_facets(&self, path: &SoundPath<'_>, per_metre: f32, scratch: &mut KirchhoffScratch) {
        let KirchhoffScratch { derivative, plain, .. } = scratch;
        let ends = [ViewPoint::from_pose(path.microphone), ViewPoint::from_pose(path.speaker)];
        let last = plain.len() - 2;
        let end = f32x8::splat((last + 1) as f32);
        for (columns, y, group) in self.facets.iter_groups() {
            let weights = group.facet_weights(columns, y, ends, self.scattering);
            let arrival = weights.path * per_metre;
            let index = arrival.fast_trunc_int();
            let after = arrival - f32x8::from_i32x8(index);
            // What arrives past the end weighs nothing.
            let heard = arrival.simd_lt(end);
            let slopes = (weights.derivative & heard).to_array();
            let levels = (weights.plain & heard).to_array();
            let here = (1.0 - after).to_array();
            let after = after.to_array();
            let index = index.to_array();
            let from_microphone = weights.from_microphone.fast_trunc_int().to_array();
            let from_speaker = weights.from_speaker.fast_trunc_int().to_array();
            for lane in 0..LANES {
                let start = (index[lane] as usize).min(last);
                let (Some([sum, sum_after]), Some([plain, plain_after])) =
                    (first_two(&mut derivative[start..]), first_two(&mut plain[start..]))
                else {
                    continue;
                };
                let here = here[lane];
                let after = after[lane];
                *plain += levels[lane] * here;
                *plain_after += levels[lane] * after;
                let (a, b) = (
                    self.microphone.gains_towards(from_microphone[lane]),
                    self.speaker.gains_towards(from_speaker[lane]),
                );
                let weight = slopes[lane] * a * b;
                *sum += weight * here;
                *sum_after += weight * after;
            }
        }
    }

    // The factor from one time to the next, in which sound travels on.
    fn step_attenuation(&self, path: &SoundPath<'_>, per_metre: f64) -> [f32; NODES] {
        let db_per_m = |node| (path.absorption_db_per_m)(node_hz(node, self.rate_hz));
        std::array::from_fn(|node| (-db_per_m(node) / DB_PER_NEPER / per_metre).exp() as f32)
    }

    // H(f) = (2 pi i f A(f)/c + B(f)) / sinc^2, which undoes the linear deposit, at the lower rate.
    fn transform_pulses(&self, path: &SoundPath<'_>, scratch: &mut KirchhoffScratch) {
        let KirchhoffScratch { derivative, plain, wide, spectrum, work, narrow, .. } = scratch;
        // Lengths are the plan's own, so the transforms cannot refuse.
        narrow.fill(Complex::default());
        for node in 0..NODES {
            wide.iter_mut().zip(&*derivative).for_each(|(x, weights)| *x = weights.as_array()[node]);
            let _ = self.forward.process_with_scratch(wide, spectrum, work);
            for ((to, from), weights) in narrow.iter_mut().zip(&*spectrum).zip(&self.interpolation) {
                *to += from * weights[node];
            }
        }
        let step = (2.0 * PI * self.rate_hz / self.len as f64 / path.speed_of_sound_m_s) as f32;
        let _ = self.forward.process_with_scratch(plain, spectrum, work);
        for (k, (to, from)) in narrow.iter_mut().zip(&*spectrum).enumerate() {
            *to = Complex::new(-to.im, to.re) * (k as f32 * step) + from;
        }
        let common = self.facets.area / (4.0 * PI) as f32 / self.len as f32;
        let shapes = self.fade.iter().zip(&self.correction).map(|(fade, correction)| fade * correction * common);
        for ((x, shape), filter) in narrow.iter_mut().zip(shapes).zip(path.reflection) {
            *x = *x * filter * shape;
        }
    }

    fn add_direct(&self, path: &SoundPath<'_>, scratch: &mut KirchhoffScratch) {
        let way: [f64; 3] =
            std::array::from_fn(|i| (path.microphone.position_mm[i] - path.speaker.position_mm[i]) / 1e3);
        let distance = dot(way, way).sqrt();
        let microphone = self.microphone.gains_towards(direction_index(-dot(path.microphone.axis, way) / distance));
        let speaker = self.speaker.gains_towards(direction_index(dot(path.speaker.axis, way) / distance));
        let gains = (microphone * speaker).to_array();
        for (k, to) in scratch.narrow.iter_mut().enumerate() {
            let hz = self.frequency_hz(k);
            let gain: f32 = gains.iter().zip(&self.interpolation[k]).map(|(gain, weight)| gain * weight).sum();
            let air = (-(path.absorption_db_per_m)(hz) / DB_PER_NEPER * distance).exp();
            let level = f64::from(gain * self.fade[k]) * air / distance / self.len as f64;
            let turn = Complex::from_polar(level, -2.0 * PI * hz * distance / path.speed_of_sound_m_s);
            *to += path.direct[k] * Complex::new(turn.re as f32, turn.im as f32);
        }
    }
}

impl ReliefFacets {
    fn new(relief: &HeightField) -> Self {
        let cells = relief.cells();
        let pitch = metres_from_mm(relief.pitch_mm());
        let centre = |cell: usize| metres_from_mm(relief.centre_mm(cell));
        let firsts = || (0..cells).step_by(LANES);
        // The last facet stands in for those that are not there.
        let lanes = |value: &dyn Fn(usize) -> f32, first: usize| {
            f32x8::new(std::array::from_fn(|lane| value((first + lane).min(cells - 1))))
        };
        let presence = |first: usize| std::array::from_fn(|lane| if first + lane < cells { 1.0 } else { 0.0 });
        let group = |(iy, first): (usize, usize)| FacetGroup {
            height: lanes(&|ix| metres_from_mm(relief.cell_height(ix, iy).into()), first),
            slope: [0, 1].map(|axis| lanes(&|ix| relief.gradient_at(ix, iy)[axis], first)),
        };
        let columns = |first| FacetColumns { place: lanes(&centre, first), presence: f32x8::new(presence(first)) };
        Self {
            area: pitch * pitch,
            rows: (0..cells).map(|iy| f32x8::splat(centre(iy))).collect(),
            columns: firsts().map(columns).collect(),
            groups: (0..cells).flat_map(|iy| firsts().map(move |first| (iy, first))).map(group).collect(),
        }
    }

    // Each group with its columns and the place of its row.
    #[inline]
    fn iter_groups(&self) -> impl Iterator<Item = (&FacetColumns, f32x8, &FacetGroup)> {
        let rows = self.groups.chunks_exact(self.columns.len().max(1)).zip(&self.rows);
        rows.flat_map(move |(groups, y)| {
            self.columns.iter().zip(groups).map(move |(columns, group)| (columns, *y, group))
        })
    }
}

impl FacetGroup {
    #[inline]
    fn facet_weights(
        &self,
        columns: &FacetColumns,
        y: f32x8,
        [microphone, speaker]: [ViewPoint; 2],
        scattering: FacetScattering,
    ) -> FacetWeights {
        let place = [columns.place, y, self.height];
        let near = microphone.view_facets(place, self.slope);
        let far = speaker.view_facets(place, self.slope);
        let [derivative, plain] = match scattering {
            FacetScattering::FacingTangent => facing_tangent(&near, &far),
            FacetScattering::Blended => blended_weights(&near, &far),
        };
        let product = near.nearness * far.nearness * columns.presence;
        FacetWeights {
            path: near.distance + far.distance,
            derivative: derivative * product,
            plain: plain * product,
            from_microphone: near.direction,
            from_speaker: far.direction,
        }
    }
}

impl DirectivityTable {
    fn new(rate_hz: f64, gain: impl Fn(f64, f64) -> f64) -> Self {
        let gain = &gain;
        let at = |direction: usize| {
            let cosine = 1.0 - 2.0 * direction as f64 / (DIRECTIONS - 1) as f64;
            f32x4::new(std::array::from_fn(|node| gain(cosine, node_hz(node, rate_hz)) as f32))
        };
        Self((0..DIRECTIONS).map(at).collect())
    }

    #[inline]
    fn gains_towards(&self, direction: i32) -> f32x4 {
        self.0[(direction as usize).min(DIRECTIONS - 1)]
    }
}

impl ViewPoint {
    fn from_pose(pose: TransducerPose) -> Self {
        Self {
            position: pose.position_mm.map(|x| f32x8::splat(metres_from_mm(x))),
            axis: pose.axis.map(|x| f32x8::splat(x as f32)),
        }
    }

    #[inline]
    fn view_facets(&self, [x, y, z]: [f32x8; 3], [slope_x, slope_y]: [f32x8; 2]) -> FacetView {
        let [px, py, pz] = self.position;
        let dx = px - x;
        let dy = py - y;
        let dz = pz - z;
        let distance = (dx * dx + dy * dy + dz * dz).sqrt();
        let nearness = 1.0 / distance;
        let [ax, ay, az] = self.axis;
        let aim = (ax * dx + ay * dy + az * dz) * nearness;
        FacetView {
            distance,
            way: [dx * nearness, dy * nearness, dz * nearness],
            nearness,
            // N = (-sx, -sy, 1).
            cosine: (dz - slope_x * dx - slope_y * dy) * nearness,
            direction: (1.0 + aim) * HALF_DIRECTIONS + 0.5,
        }
    }
}

// Weights of the derivative and of the plain pulse, but for 1/(r1 r2).
#[inline]
fn tangent_weights(a: &FacetView, b: &FacetView) -> [f32x8; 2] {
    [a.cosine + b.cosine, a.cosine * a.nearness + b.cosine * b.nearness]
}

#[inline]
fn facing_tangent(a: &FacetView, b: &FacetView) -> [f32x8; 2] {
    let faces = a.cosine.fast_min(b.cosine).simd_gt(f32x8::ZERO);
    let [derivative, plain] = tangent_weights(a, b);
    [derivative & faces, plain & faces]
}

#[inline]
fn blended_weights(a: &FacetView, b: &FacetView) -> [f32x8; 2] {
    let along = a.way[0] * b.way[0] + a.way[1] * b.way[1];
    let small_slope = 4.0 * (1.0 + along) / (a.way[2] + b.way[2]).fast_max(f32x8::splat(LEAST_RISE));
    let [derivative, plain] = tangent_weights(a, b);
    [0.5 * (derivative + small_slope), 0.5 * (plain + small_slope * 0.5 * (a.nearness + b.nearness))]
}

/// Least sum of the vertical parts of both ways: the small-slope approximation knows no grazing sound.
const LEAST_RISE: f32 = 0.1;

const HALF_DIRECTIONS: f32 = (DIRECTIONS - 1) as f32 / 2.0;

#[inline]
fn first_two<T>(values: &mut [T]) -> Option<&mut [T; 2]> {
    values.first_chunk_mut()
}

// Place of a cosine in a directivity table.
fn direction_index(cosine: f64) -> i32 {
    ((1.0 - cosine as f32) * HALF_DIRECTIONS + 0.5) as i32
}

fn metres_from_mm(mm: f64) -> f32 {
    (mm / 1e3) as f32
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn node_hz(node: usize, rate_hz: f64) -> f64 {
    node_square(node).sqrt() * HIGHEST_NODE * rate_hz
}

// Square of a node's frequency over the highest.
fn node_square(node: usize) -> f64 {
    0.5 - 0.5 * (PI * (node as f64 + 0.5) / NODES as f64).cos()
}

// Weights of the nodes at a frequency: the polynomial of its square through them.
fn interpolation_weights(frequency_over_rate: f64) -> [f32; NODES] {
    let square = (frequency_over_rate / HIGHEST_NODE).min(1.0).powi(2);
    let factor = |node, other| (square - node_square(other)) / (node_square(node) - node_square(other));
    let others = |node| (0..NODES).filter(move |other| *other != node);
    std::array::from_fn(|node| others(node).map(|other| factor(node, other)).product::<f64>() as f32)
}

// Sound that arrives later has come farther.
fn absorb_weights(weights: &mut [f32x4], per_step: [f32; NODES]) {
    let mut left = f32x4::ONE;
    for weight in weights {
        *weight *= left;
        left *= f32x4::new(per_step);
    }
}

// 1/sinc^2 of the linear deposit.
fn deposit_correction(frequency_over_rate: f64) -> f64 {
    let x = PI * frequency_over_rate / OVERSAMPLING as f64;
    let sinc = if x == 0.0 { 1.0 } else { x.sin() / x };
    1.0 / (sinc * sinc)
}

// A half-cosine from the pass edge to half the sampling rate.
fn fade_gain(frequency_over_rate: f64) -> f64 {
    let share = ((frequency_over_rate - PASS) / (0.5 - PASS)).clamp(0.0, 1.0);
    0.5 + 0.5 * (PI * share).cos()
}

#[cfg(test)]
mod tests {
    use super::*;

    const PANEL_SIZE_MM: f64 = 585.0;
    const RATE: f64 = 96e3;
    const C: f64 = 343.0;

    fn waves(cells: usize, seen_from: impl Fn(f64, f64) -> [f64; 2]) -> HeightField {
        HeightField::from_fn(PANEL_SIZE_MM, cells, |x, y| {
            let [x, y] = seen_from(x, y);
            5.0 * (x / 60.0).sin() + 3.0 * (y / 45.0).cos()
        })
    }

    fn spectrum_db(x: &[f32], hz: f64) -> f64 {
        let (mut re, mut im) = (0.0, 0.0);
        for (n, x) in x.iter().enumerate() {
            let angle = 2.0 * PI * hz * n as f64 / RATE;
            re += f64::from(*x) * angle.cos();
            im -= f64::from(*x) * angle.sin();
        }
        10.0 * (re * re + im * im).log10()
    }

    fn pose(position_mm: [f64; 3]) -> TransducerPose {
        TransducerPose { position_mm, axis: [0.0, 0.0, -1.0] }
    }

    /// Gains of direct sound and reflection, and the air's absorption at 40 kHz, which goes by the frequency's square.
    #[derive(Clone, Copy)]
    struct Conditions {
        direct: f64,
        reflection: f64,
        db_per_m: f64,
    }

    const REFLECTED: Conditions = Conditions { direct: 0.0, reflection: 1.0, db_per_m: 0.0 };
    const DIRECT: Conditions = Conditions { direct: 1.0, reflection: 0.0, db_per_m: 0.0 };

    fn response(plan: &KirchhoffPlan, [microphone, speaker]: [[f64; 3]; 2], conditions: Conditions) -> Vec<f32> {
        let [direct, reflection] =
            [conditions.direct, conditions.reflection].map(|gain| plan.spectrum_at_bins(|_| gain.into()));
        let path = SoundPath {
            microphone: pose(microphone),
            speaker: pose(speaker),
            speed_of_sound_m_s: C,
            absorption_db_per_m: &|hz| conditions.db_per_m * (hz / 40e3).powi(2),
            direct: &direct,
            reflection: &reflection,
        };
        let mut out = vec![0.0; plan.len()];
        plan.compute_response(&path, &mut plan.make_scratch(), &mut out).expect("a response");
        out
    }

    fn reflection(plan: &KirchhoffPlan, points: [[f64; 3]; 2]) -> Vec<f32> {
        response(plan, points, REFLECTED)
    }

    // Over the middle of a flat plate the first edge is 2.2 times as far as the image: gated before it, only the
    // image source is left. By tangent planes 0.04 dB is the accuracy that this facet size has been measured to have;
    // the small-slope approximation neglects the near field of slanting sound.
    #[test]
    fn a_flat_plate_is_its_image_source() {
        let plate = HeightField::from_fn(PANEL_SIZE_MM, 274, |_, _| 0.0);
        let points = [[-37.5, -37.5, 124.0], [-37.5, 37.5, 124.0]];
        for (scattering, tolerance_db) in [(FacetScattering::FacingTangent, 0.1), (FacetScattering::Blended, 0.2)] {
            let plan = KirchhoffPlan::new(&plate, RATE, 512).with_scattering(scattering);
            let mut response = reflection(&plan, points);
            let image_m: f64 = (75f64.powi(2) + 248f64.powi(2)).sqrt() / 1e3;
            let edge_sample = 0.572 / C * RATE;
            let gate_start = edge_sample * 0.72;
            for (n, x) in response.iter_mut().enumerate() {
                let fade = ((n as f64 - gate_start) / (edge_sample - gate_start)).clamp(0.0, 1.0);
                *x *= (0.5 + 0.5 * (PI * fade).cos()) as f32;
            }
            let expected = 20.0 * (1.0 / image_m).log10();
            for step in 0..151 {
                let hz = 2_500.0 + 250.0 * f64::from(step);
                let off = spectrum_db(&response, hz) - expected;
                assert!(off.abs() < tolerance_db, "{scattering:?}, {hz}: {off} dB");
            }
        }
    }

    // A well's walls face away from half of the points. What the facing facets alone reflect lacks their energy.
    #[test]
    fn wells_keep_their_energy() {
        let wells =
            HeightField::from_fn(PANEL_SIZE_MM, 274, |x, _| if (x / 22.5).floor() % 2.0 == 0.0 { 0.0 } else { -20.0 });
        let points = [[-187.5, -37.5, 124.0], [112.5, 37.5, 124.0]];
        let energy = |relief: &HeightField, scattering| {
            let plan = KirchhoffPlan::new(relief, RATE, 512).with_scattering(scattering);
            crate::energy::energy(&reflection(&plan, points))
        };
        let plate = HeightField::from_fn(PANEL_SIZE_MM, 274, |_, _| 0.0);
        let [facing, blended] = [FacetScattering::FacingTangent, FacetScattering::Blended]
            .map(|scattering| energy(&wells, scattering) / energy(&plate, scattering));
        assert!(facing < 0.8 * blended && (0.5..1.5).contains(&blended), "{facing}, {blended}");
    }

    #[test]
    fn microphone_and_speaker_may_change_places() {
        let relief = waves(137, |x, y| [x, y]);
        let points = [[-187.5, 37.5, 124.0], [125.0, -62.5, 304.0], [0.0, 0.0, 474.0]];
        let plan = KirchhoffPlan::new(&relief, RATE, 512);
        for [a, b] in [[0, 1], [1, 2], [0, 2]].map(|pair| pair.map(|i| points[i])) {
            let (there, back) = (reflection(&plan, [a, b]), reflection(&plan, [b, a]));
            let peak = there.iter().fold(0.0f32, |p, x| p.max(x.abs()));
            let off = there.iter().zip(&back).fold(0.0f32, |p, (x, y)| p.max((x - y).abs()));
            assert!(peak > 0.0 && off <= 2e-5 * peak, "{off} of {peak}");
        }
    }

    #[test]
    fn a_turned_relief_under_turned_points_sounds_the_same() {
        // A quarter turn takes (x, y) to (-y, x).
        let (relief, turned) = (waves(137, |x, y| [x, y]), waves(137, |x, y| [y, -x]));
        let points = [[-187.5, 37.5, 124.0], [125.0, -62.5, 304.0]];
        let (plan, plan_turned) = (KirchhoffPlan::new(&relief, RATE, 512), KirchhoffPlan::new(&turned, RATE, 512));
        let (before, after) = (reflection(&plan, points), reflection(&plan_turned, points.map(|[x, y, z]| [-y, x, z])));
        let peak = before.iter().fold(0.0f32, |p, x| p.max(x.abs()));
        let off = before.iter().zip(&after).fold(0.0f32, |p, (x, y)| p.max((x - y).abs()));
        // Sums of 19,000 facets in another order, in f32.
        assert!(off <= 1e-3 * peak, "{off} of {peak}");
    }

    #[test]
    fn what_is_not_the_plans_is_refused() {
        let plate = HeightField::from_fn(PANEL_SIZE_MM, 20, |_, _| 0.0);
        let [plan, longer] = [256, 512].map(|len| KirchhoffPlan::new(&plate, RATE, len));
        let respond = |filters: &KirchhoffPlan, scratch: &mut KirchhoffScratch, len: usize| {
            let filter = filters.spectrum_at_bins(|_| 1.0.into());
            let path = SoundPath {
                microphone: pose([0.0, 0.0, 124.0]),
                speaker: pose([0.0, 150.0, 124.0]),
                speed_of_sound_m_s: C,
                absorption_db_per_m: &|_| 0.0,
                direct: &filter,
                reflection: &filter,
            };
            let mut out = vec![7.0; len];
            let outcome = plan.compute_response(&path, scratch, &mut out);
            (outcome, out.iter().all(|x| *x == 7.0))
        };
        let refused = |actual, expected, what| (Err(Error::Length { what, actual, expected }), true);
        for len in [0, 1, 255, 257, 512] {
            assert_eq!(respond(&plan, &mut plan.make_scratch(), len), refused(len, 256, "the response"));
        }
        assert_eq!(respond(&plan, &mut longer.make_scratch(), 256), refused(4_096, 2_048, "the scratch"));
        assert_eq!(respond(&longer, &mut plan.make_scratch(), 256), refused(257, 129, "the direct sound's filter"));
        assert_eq!(respond(&plan, &mut plan.make_scratch(), 256), (Ok(()), false));
    }

    const BESIDE: [[f64; 3]; 2] = [[0.0, 0.0, 124.0], [0.0, 150.0, 124.0]];

    #[test]
    fn the_direct_sound_is_one_over_its_distance() {
        let plan = KirchhoffPlan::new(&HeightField::from_fn(PANEL_SIZE_MM, 20, |_, _| 0.0), RATE, 512);
        let direct = response(&plan, BESIDE, DIRECT);
        let damped = response(&plan, BESIDE, Conditions { db_per_m: 20.0, ..DIRECT });
        for hz in [2_000.0, 10_000.0, 40_000.0] {
            let off = spectrum_db(&direct, hz) - 20.0 * (1.0f64 / 0.15).log10();
            assert!(off.abs() < 0.001, "{hz}: {off} dB");
            let air = spectrum_db(&damped, hz) - spectrum_db(&direct, hz) + 0.15 * 20.0 * (hz / 40e3).powi(2);
            assert!(air.abs() < 0.01, "{hz}: {air} dB");
        }
    }

    // Gains by direction and frequency reach reflection and direct sound alike. The reflection's spreads over facets,
    // so its gain is that of the specular direction only to the accuracy of the plate's diffraction; a gain that
    // depends on the frequency alone has to come out as it is.
    #[test]
    fn directivity_and_air_act_on_the_reflection() {
        let plate = HeightField::from_fn(PANEL_SIZE_MM, 274, |_, _| 0.0);
        let points = [[-37.5, -37.5, 124.0], [-37.5, 37.5, 124.0]];
        let plain = reflection(&KirchhoffPlan::new(&plate, RATE, 512), points);
        let by_frequency = |_: f64, hz: f64| 1.0 / (1.0 + (hz / 30e3).powi(2));
        let duller = KirchhoffPlan::new(&plate, RATE, 512).with_directivity(|_, _| 1.0, by_frequency);
        let damped =
            response(&KirchhoffPlan::new(&plate, RATE, 512), points, Conditions { db_per_m: 10.0, ..REFLECTED });
        // Of the speaker's and the microphone's axes, which point down, the image is 16.8 degrees off.
        let cosine = |c: f64, _: f64| c;
        let aimed = KirchhoffPlan::new(&plate, RATE, 512).with_directivity(cosine, cosine);
        for hz in [5_000.0, 10_000.0, 20_000.0, 40_000.0] {
            let level = spectrum_db(&plain, hz);
            let off = spectrum_db(&reflection(&duller, points), hz) - level - 20.0 * by_frequency(0.0, hz).log10();
            // Sound that is diffracted at low frequencies comes without directivity, as far as it is near field.
            assert!(off.abs() < 0.12, "{hz}: {off} dB");
            let off = spectrum_db(&damped, hz) - level + 0.259 * 10.0 * (hz / 40e3).powi(2);
            assert!(off.abs() < 0.2, "{hz}: {off} dB");
            // The plate's edges, which count less then, are heard less at high frequencies.
            let off = spectrum_db(&reflection(&aimed, points), hz) - level - 40.0 * (0.248f64 / 0.2591).log10();
            assert!(hz < 20e3 || off.abs() < 0.5, "{hz}: {off} dB");
        }
    }
}
