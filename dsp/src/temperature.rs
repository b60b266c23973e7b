//! Speed of sound, and the correction of a response's time axis to the reference temperature.

use std::f64::consts::PI;
use std::sync::LazyLock;

use crate::Real;

/// Speed of sound at 0 C, m/s (Rust et al. 2021, appendix, step 2).
const C0: f64 = 331.3;
/// 0 C in K.
const ZERO_CELSIUS: f64 = 273.15;
/// Lobes of the resampling kernel to each side, and the Kaiser window's parameter: SciPy's `resample_poly`.
const LOBES: f64 = 10.0;
const KAISER_BETA: f64 = 5.0;
/// Gain at 0 Hz that SciPy's normalisation of its filter amounts to, in continuous form.
const GAIN: f64 = 1.000_675;
/// Pieces of the table a lobe: cubics through the kernel at their ends and neighbours are within 1e-9 of it.
const STEPS: usize = 256;

/// c = c0 sqrt(1 + T / 273.15), m/s.
pub fn speed_of_sound(celsius: f64) -> f64 {
    C0 * (1.0 + celsius / ZERO_CELSIUS).sqrt()
}

/// c(T) / c(T_ref), exactly.
pub fn resampling_ratio(celsius: f64, reference_celsius: f64) -> f64 {
    ((ZERO_CELSIUS + celsius) / (ZERO_CELSIUS + reference_celsius)).sqrt()
}

/// Resamples a response by the exact ratio, at the outputs that are wanted and nowhere else: an arrival over
/// d metres moves from d/c to d/c_ref.
///
/// y\[m\] = g sum_n x\[n\] fc k(fc (m/rho - n)), k(u) = sinc(u) I0(5 sqrt(1 - (u/10)^2)) / I0(5), |u| <= 10,
/// fc = min(1, rho): SciPy's `resample_poly` in continuous form, so that no fraction limits the ratio.
#[derive(Debug, Clone)]
pub struct TemperatureCorrection<T> {
    table: &'static [Piece],
    kind: std::marker::PhantomData<T>,
}

/// Coefficients of 1, t, t^2 and t^3, t from 0 to 1 along a piece.
type Piece = [f64; 4];

// Piece i is k from i / STEPS to (i + 1) / STEPS; there is one past the edge, which rounding can reach.
static TABLE: LazyLock<Vec<Piece>> = LazyLock::new(|| {
    let piece = |i: usize| {
        let [a, b, c, d] = [-1.0, 0.0, 1.0, 2.0].map(|t| kernel((i as f64 + t) / STEPS as f64));
        [b, c - a / 3.0 - b / 2.0 - d / 6.0, (a + c) / 2.0 - b, (d - a) / 6.0 + (b - c) / 2.0]
    };
    (0..=LOBES as usize * STEPS).map(piece).collect()
});

impl<T: Real> Default for TemperatureCorrection<T> {
    fn default() -> Self {
        Self::new()
    }
}

impl<T: Real> TemperatureCorrection<T> {
    /// The plan; it serves every ratio.
    pub fn new() -> Self {
        Self { table: &TABLE, kind: std::marker::PhantomData }
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
    pub fn run(&self, ir_in: &[T], rho: f64, ir_out: &mut [T]) {
        if rho == 1.0 {
            return crop(ir_in, ir_out);
        }
        let fc = rho.min(1.0);
        let reach = LOBES / fc;
        for (m, out) in ir_out.iter_mut().enumerate() {
            let centre = m as f64 / rho;
            let first = (centre - reach).ceil().max(0.0) as usize;
            let end = ((centre + reach).floor() as usize + 1).min(ir_in.len());
            let taps = ir_in.get(first..end).unwrap_or(&[]);
            let offset = centre - first as f64;
            let sum: f64 = (0u32..).zip(taps).map(|(i, x)| x.f64() * self.at(fc * (offset - f64::from(i)))).sum();
            *out = T::of(GAIN * fc * sum);
        }
    }

    fn at(&self, u: f64) -> f64 {
        let position = u.abs() * STEPS as f64;
        let index = position as u32;
        let t = position - f64::from(index);
        let Some([c0, c1, c2, c3]) = self.table.get(index as usize) else { return 0.0 };
        c0 + t * (c1 + t * (c2 + t * c3))
    }
}

/// The first samples, with zeros where there are fewer.
pub fn crop<T: Real>(from: &[T], to: &mut [T]) {
    let kept = from.len().min(to.len());
    to[..kept].copy_from_slice(&from[..kept]);
    to[kept..].fill(T::default());
}

fn kernel(u: f64) -> f64 {
    // Just past the edge the window goes on smoothly, which the interpolation of the last lobe needs.
    let window = 1.0 - (u / LOBES).powi(2);
    let sinc = if u == 0.0 { 1.0 } else { (PI * u).sin() / (PI * u) };
    sinc * bessel_i0(KAISER_BETA * KAISER_BETA * window) / bessel_i0(KAISER_BETA * KAISER_BETA)
}

/// Modified Bessel function of order 0 at sqrt(x), by its power series (Abramowitz and Stegun 9.6.12).
fn bessel_i0(x: f64) -> f64 {
    let quarter = x / 4.0;
    let (mut term, mut sum) = (1.0, 1.0);
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
        for i in 0..100_000 {
            let u = f64::from(i) / 10_000.0;
            assert!((plan.at(u) - kernel(u)).abs() < 1e-9, "{u}: {} {}", plan.at(u), kernel(u));
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
            TemperatureCorrection::<f64>::new().run(&pulse(from, 440), rho, &mut out);
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
            TemperatureCorrection::new().run(&x, rho, &mut all);
            TemperatureCorrection::new().run(&x[..needed], rho, &mut some);
            assert_eq!(all, some, "{rho}");
        }
    }

    #[test]
    fn the_reference_temperature_changes_nothing() {
        let x: Vec<f32> = (0..100).map(|i| i as f32).collect();
        let mut out = vec![1.0; 120];
        TemperatureCorrection::new().run(&x, resampling_ratio(20.0, 20.0), &mut out);
        assert_eq!(&out[..100], &x[..]);
        assert_eq!(&out[100..], &[0.0; 20]);
    }
}
