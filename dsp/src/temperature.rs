//! Speed of sound, and the correction of a response's time axis to the reference temperature.

use std::f64::consts::PI;
use std::sync::{Arc, LazyLock};

use echolake_schema::AirTreatment;
use echolake_schema::rig::ImpulseResponse;

use crate::RealSample;
use crate::air::AirState;

/// Speed of sound at 0 C, m/s (Rust et al. 2021, appendix, step 2).
const C0: f64 = 331.3;
/// 0 C in K.
const ZERO_CELSIUS: f64 = 273.15;
/// Lobes of the resampling kernel to each side, and the Kaiser window's parameter: SciPy's `resample_poly`.
const LOBES: f64 = 10.0;
const KAISER_BETA: f64 = 5.0;
/// Gain at 0 Hz that SciPy's normalisation of its filter amounts to, in continuous form.
const GAIN: f64 = 1.000_675;
/// Values of the kernel, a sample apart, that one position meets.
const TAPS: usize = 2 * LOBES as usize;
/// The tap that a position is at, or up to a sample past.
const CENTRE: usize = TAPS / 2 - 1;
/// Pieces between two samples: cubics through the kernel at their ends and neighbours are within 5e-8 of it.
const PIECES: usize = 64;

/// c = c0 sqrt(1 + T / 273.15), m/s: the paper's formula, of the temperature alone.
pub fn speed_of_sound(celsius: f64) -> f64 {
    C0 * (1.0 + celsius / ZERO_CELSIUS).sqrt()
}

/// c(T) / c(T_ref), exactly, by the paper's formula.
pub fn resampling_ratio(celsius: f64, reference_celsius: f64) -> f64 {
    ((ZERO_CELSIUS + celsius) / (ZERO_CELSIUS + reference_celsius)).sqrt()
}

/// The air that responses are corrected to, and what they are corrected for.
///
/// ```
/// use echolake_dsp::air::AirState;
/// use echolake_dsp::temperature::ReferenceAir;
///
/// let reference = ReferenceAir::from_response(&echolake_schema::Rig::paper().impulse_response);
/// assert_eq!(reference.time_ratio(&reference.air()), 1.0);
/// // Damp air is faster.
/// assert!(reference.time_ratio(&AirState { humidity_pct: 60.0, ..reference.air() }) > 1.0003);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReferenceAir {
    /// Temperature, C; humidity and pressure are those of [`AirState`]'s reference.
    pub celsius: f64,
    /// What responses are corrected for, which decides the formula of the speed of sound.
    pub treatment: AirTreatment,
}

impl ReferenceAir {
    /// Takes a rig's settings.
    pub fn from_response(response: &ImpulseResponse) -> Self {
        Self { celsius: response.reference_temperature_c.get(), treatment: response.air }
    }

    /// Its state.
    pub fn air(&self) -> AirState {
        AirState::with_known(self.celsius, None, None)
    }

    /// Speed of sound in it, m/s.
    pub fn speed_of_sound(&self) -> f64 {
        self.speed_in(&self.air())
    }

    /// Speed of sound in other air, m/s, by the same formula.
    pub fn speed_in(&self, air: &AirState) -> f64 {
        air.speed_of_sound(self.treatment)
    }

    /// Ratio by which times grow from other air to the reference: c / c_ref.
    pub fn time_ratio(&self, air: &AirState) -> f64 {
        match self.treatment {
            AirTreatment::Paper => resampling_ratio(air.temperature_c, self.celsius),
            AirTreatment::Complete => self.speed_in(air) / self.speed_of_sound(),
        }
    }
}

/// Share of its limits by which a response's range is narrower than the sweep's, so that it can be the same in air that
/// is about 9 K colder or warmer than the reference.
const RANGE_MARGIN: f64 = 0.015;

/// Limits, before the correction by a ratio, of the range that responses have after it: 1.5 % inside of the sweep's,
/// Hz.
///
/// The correction moves frequencies, too. Limits at the sweep's own would leave a warmer response less of its highest
/// band than a colder one, 0.03 dB a kelvin. Beyond 9 K the sweep's own range is the limit.
///
/// ```
/// use echolake_dsp::temperature::{resampling_ratio, response_limits_hz};
///
/// let after = |celsius: f64| {
///     let rho = resampling_ratio(celsius, 20.0);
///     response_limits_hz([2e3, 40e3], rho).map(|hz| hz / rho)
/// };
/// assert!((after(23.0)[1] - after(20.0)[1]).abs() < 1e-9 && (after(20.0)[1] - 39_400.0).abs() < 1e-9);
/// assert!(after(35.0)[1] < 39_100.0);
/// ```
pub fn response_limits_hz([low, high]: [f64; 2], rho: f64) -> [f64; 2] {
    [(low * (1.0 + RANGE_MARGIN) * rho).max(low), (high * (1.0 - RANGE_MARGIN) * rho).min(high)]
}

/// Stretches a recording by the rate of the clock that played over the one that recorded, less 1, in ppm, so that both
/// are one: samples past its end are silence.
///
/// ```
/// use echolake_dsp::temperature::stretch_recording;
///
/// // Of a clock that plays 100 ppm faster, what began after 20 000 samples was recorded 2 samples early.
/// let mut recording = vec![0.0; 20_100];
/// recording[19_998] = 1.0;
/// stretch_recording(&mut recording, 100.0);
/// assert!((19_995..20_005).all(|n| recording[n] <= recording[20_000]) && recording[20_000] > 0.99);
/// ```
pub fn stretch_recording<T: RealSample>(recording: &mut [T], playing_clock_ppm: f64) {
    if playing_clock_ppm != 0.0 {
        let recorded = recording.to_vec();
        TemperatureCorrection::new().correct_response(&recorded, 1.0 + playing_clock_ppm * 1e-6, recording);
    }
}

/// Resamples a response by the exact ratio, at the outputs that are wanted and nowhere else: an arrival over
/// d metres moves from d/c to d/c_ref.
///
/// y\[m\] = g sum_n x\[n\] fc k(fc (m/rho - n)), k(u) = sinc(u) I0(5 sqrt(1 - (u/10)^2)) / I0(5), |u| <= 10,
/// fc = min(1, rho): SciPy's `resample_poly` in continuous form, so that no fraction limits the ratio.
///
/// For rho >= 1 the kernel is read at m/rho - n, and all taps of one output have the same fraction of a sample.
/// For rho < 1 it is read at m - rho n, and all taps of one *input* have. So one table of the kernel at whole steps
/// from a fraction serves every ratio: outputs gather where they grow scarcer, inputs scatter where they do.
///
/// ```
/// use echolake_dsp::temperature::{TemperatureCorrection, resampling_ratio, speed_of_sound};
///
/// let rho = resampling_ratio(30.0, 20.0);
/// assert!((speed_of_sound(30.0) / speed_of_sound(20.0) - rho).abs() < 1e-12);
/// let (mut warm, mut corrected) = ([0.0; 120], [0.0; 120]);
/// warm[100] = 1.0;
/// TemperatureCorrection::<f64>::new().correct_response(&warm, rho, &mut corrected);
/// // In air of 20 C, what arrived after 100 samples arrives after 101.7.
/// assert_eq!((0..120).max_by(|a, b| corrected[*a].total_cmp(&corrected[*b])), Some(102));
/// ```
#[derive(Clone)]
pub struct TemperatureCorrection<T: RealSample> {
    table: Arc<[KernelPiece<T>]>,
}

/// Sums side by side, so that an addition need not wait for the one before.
const LANES: usize = 4;
/// Coefficients of 1, t, t^2 and t^3 of each tap, t from 0 to 1 along a piece.
type KernelPiece<T> = [[T; TAPS]; 4];

// Tap j is k(fraction + CENTRE - j), piece i for fractions from i / PIECES to (i + 1) / PIECES.
static TABLE: LazyLock<Vec<[[f64; TAPS]; 4]>> = LazyLock::new(|| {
    let cubic = |i: usize, j: usize| {
        let at = |t: f64| windowed_sinc((i as f64 + t) / PIECES as f64 + CENTRE as f64 - j as f64);
        let [a, b, c, d] = [-1.0, 0.0, 1.0, 2.0].map(at);
        [b, c - a / 3.0 - b / 2.0 - d / 6.0, (a + c) / 2.0 - b, (d - a) / 6.0 + (b - c) / 2.0]
    };
    let piece = |i: usize| {
        let taps: [[f64; 4]; TAPS] = std::array::from_fn(|j| cubic(i, j));
        std::array::from_fn(|power| taps.map(|tap| tap[power]))
    };
    (0..PIECES).map(piece).collect()
});

impl<T: RealSample> Default for TemperatureCorrection<T> {
    fn default() -> Self {
        Self::new()
    }
}

impl<T: RealSample> TemperatureCorrection<T> {
    /// The plan; it serves every ratio.
    pub fn new() -> Self {
        Self { table: TABLE.iter().map(|piece| piece.map(|taps| taps.map(T::of))).collect() }
    }

    /// Samples of input that `output_len` samples of output depend on.
    pub fn input_len_for(output_len: usize, rho: f64) -> usize {
        let last = output_len.saturating_sub(1) as f64 / rho;
        (last + LOBES / rho.min(1.0)).floor() as usize + 1
    }

    /// Corrects; samples outside of `ir_in` count as zero. A ratio of 1 copies.
    ///
    /// ir_in `[n]`  at the measured temperature
    /// ir_out `[m]` at the reference temperature
    pub fn correct_response(&self, ir_in: &[T], rho: f64, ir_out: &mut [T]) {
        if rho == 1.0 {
            crop(ir_in, ir_out);
        } else if rho > 1.0 {
            self.gather_samples(ir_in, rho.recip(), ir_out);
        } else {
            self.scatter_samples(ir_in, rho, ir_out);
        }
    }

    fn gather_samples(&self, ir_in: &[T], step: f64, ir_out: &mut [T]) {
        let gain = T::of(GAIN);
        for (m, out) in ir_out.iter_mut().enumerate() {
            let (at, taps) = self.taps_at(m as f64 * step);
            let inside = at.checked_sub(CENTRE).and_then(|first| ir_in.get(first..)?.first_chunk());
            let x: [T; TAPS] = inside.copied().unwrap_or_else(|| {
                std::array::from_fn(|j| {
                    (at + j).checked_sub(CENTRE).and_then(|n| ir_in.get(n)).copied().unwrap_or_default()
                })
            });
            *out = gain * dot(&x, &taps);
        }
    }

    fn scatter_samples(&self, ir_in: &[T], rho: f64, ir_out: &mut [T]) {
        ir_out.fill(T::default());
        let gain = T::of(GAIN * rho);
        for (n, x) in ir_in.iter().enumerate() {
            let (at, taps) = self.taps_at(n as f64 * rho);
            if at >= ir_out.len() + CENTRE {
                return;
            }
            let x = *x * gain;
            if let Some(out) =
                at.checked_sub(CENTRE).and_then(|first| ir_out.get_mut(first..)?.first_chunk_mut::<TAPS>())
            {
                out.iter_mut().zip(taps).for_each(|(out, tap)| *out = *out + x * tap);
            } else {
                let skipped = CENTRE.saturating_sub(at);
                let out = ir_out[(at + skipped).saturating_sub(CENTRE)..].iter_mut();
                out.zip(taps.into_iter().skip(skipped)).for_each(|(out, tap)| *out = *out + x * tap);
            }
        }
    }

    /// The sample at or before a position, which tap `CENTRE` belongs to, and the kernel around it.
    fn taps_at(&self, position: f64) -> (usize, [T; TAPS]) {
        let at = position as usize;
        let along = (position - at as f64) * PIECES as f64;
        let index = (along as usize).min(PIECES - 1);
        let t = T::of(along - index as f64);
        let [c0, c1, c2, c3] = &self.table[index];
        (at, std::array::from_fn(|i| c0[i] + t * (c1[i] + t * (c2[i] + t * c3[i]))))
    }
}

fn dot<T: RealSample>(x: &[T; TAPS], taps: &[T; TAPS]) -> T {
    let mut sums = [T::default(); LANES];
    for (x, taps) in x.as_chunks::<LANES>().0.iter().zip(taps.as_chunks::<LANES>().0) {
        for lane in 0..LANES {
            sums[lane] = sums[lane] + x[lane] * taps[lane];
        }
    }
    let [a, b, c, d] = sums;
    (a + b) + (c + d)
}

/// The first samples, with zeros if there are fewer.
pub fn crop<T: RealSample>(from: &[T], to: &mut [T]) {
    let kept = from.len().min(to.len());
    to[..kept].copy_from_slice(&from[..kept]);
    to[kept..].fill(T::default());
}

fn windowed_sinc(u: f64) -> f64 {
    // Just past the edge the window continues smoothly, which the interpolation of the last lobe needs.
    let window = 1.0 - (u / LOBES).powi(2);
    let sinc = if u == 0.0 { 1.0 } else { (PI * u).sin() / (PI * u) };
    sinc * bessel_i0(KAISER_BETA * KAISER_BETA * window) / bessel_i0(KAISER_BETA * KAISER_BETA)
}

/// Modified Bessel function of order 0 at sqrt(x), by its power series (Abramowitz and Stegun 9.6.12).
fn bessel_i0(x: f64) -> f64 {
    let quarter = x / 4.0;
    let mut term = 1.0;
    let mut sum = 1.0;
    for k in 1..60 {
        term *= quarter / f64::from(k * k);
        sum += term;
        if term.abs() < sum * 1e-17 {
            break;
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_accurate() {
        let plan = TemperatureCorrection::<f64>::new();
        for i in 0..10_000 {
            let position = f64::from(i) / 1_234.5;
            let (at, taps) = plan.taps_at(position);
            assert_eq!(at, position.floor() as usize);
            for (j, tap) in taps.into_iter().enumerate() {
                let u = position - (at + j) as f64 + CENTRE as f64;
                assert!((tap - windowed_sinc(u)).abs() < 5e-8, "{u}: {tap} {}", windowed_sinc(u));
            }
        }
    }

    // Sample by sample, as the definition says, where inputs and outputs end within the kernel's reach too.
    #[test]
    fn corrections_are_the_defined_sum() {
        let x: Vec<f64> = (0..431).map(|i| f64::from((i * 7919) % 101) - 50.0).collect();
        for (input, output) in [(431, 384), (100, 384), (431, 5), (3, 2), (15, 12), (0, 4), (4, 0)] {
            for rho in [0.8f64, 0.97, 0.999_9, 1.000_1, 1.03, 1.2] {
                let fc = rho.min(1.0);
                let mut out = vec![f64::NAN; output];
                TemperatureCorrection::new().correct_response(&x[..input], rho, &mut out);
                for (m, out) in out.iter().enumerate() {
                    let term = |(n, x): (usize, &f64)| {
                        let u = fc * (m as f64 / rho - n as f64);
                        if u.abs() <= LOBES { x * windowed_sinc(u) } else { 0.0 }
                    };
                    let expected = GAIN * fc * x[..input].iter().enumerate().map(term).sum::<f64>();
                    assert!((out - expected).abs() < 1e-5, "{rho}, {input} to {output}, {m}: {out} {expected}");
                }
            }
        }
    }

    #[test]
    fn an_arrival_moves_to_the_reference_temperature() {
        // A band-limited pulse at d/c, located by its energy's centre, for d = 0.7 m.
        let rate = 96_000.0;
        let pulse = |at: f64, n: usize| -> Vec<f64> {
            let shape = |i: usize| {
                let t = (i as f64 - at) / 4.0;
                (-t * t).exp() * (2.0 * PI * 0.2 * (i as f64 - at)).cos()
            };
            (0..n).map(shape).collect()
        };
        for celsius in [5.0, 15.0, 19.9, 23.7, 30.0] {
            let (from, to) = (0.7 / speed_of_sound(celsius) * rate, 0.7 / speed_of_sound(20.0) * rate);
            let rho = resampling_ratio(celsius, 20.0);
            let mut out = vec![0.0; 384];
            TemperatureCorrection::<f64>::new().correct_response(&pulse(from, 440), rho, &mut out);
            let energy: f64 = out.iter().map(|x| x * x).sum();
            let centre = out.iter().enumerate().map(|(i, x)| i as f64 * x * x).sum::<f64>() / energy;
            assert!((centre - to).abs() < 1e-3, "{celsius}: {centre} {to}");
        }
    }

    #[test]
    fn only_the_named_input_matters() {
        let x: Vec<f64> = (0..500).map(|i| f64::from((i * 7919) % 101) - 50.0).collect();
        for rho in [0.93, 0.99, 1.01, 1.05] {
            let needed = TemperatureCorrection::<f64>::input_len_for(384, rho);
            let (mut all, mut some) = (vec![0.0; 384], vec![0.0; 384]);
            TemperatureCorrection::new().correct_response(&x, rho, &mut all);
            TemperatureCorrection::new().correct_response(&x[..needed], rho, &mut some);
            assert_eq!(all, some, "{rho}");
        }
    }

    #[test]
    fn the_reference_temperature_changes_nothing() {
        let x: Vec<f32> = (0..100).map(|i| i as f32).collect();
        let mut out = vec![1.0; 120];
        TemperatureCorrection::new().correct_response(&x, resampling_ratio(20.0, 20.0), &mut out);
        assert_eq!(&out[..100], &x[..]);
        assert_eq!(&out[100..], &[0.0; 20]);
    }
}
