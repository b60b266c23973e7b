//! Foam's own reflection, estimated from responses of Foam and Flat, and the direct sound without it.
//!
//! No foam absorbs everything. What it reflects is in every response of Foam, and to subtract that response takes the
//! same away from every surface: in phase from Flat, which it weakens, and out of phase from a relief whose reflection
//! arrives at other times, to which it adds energy.
//!
//! Flat and Foam lie in the same plane, so both reflect the same waves: for each pair, Foam's reflection is that of
//! Flat less Foam through a short filter, which depends on the angle of incidence. It is a sum of filters of some
//! angles, linearly interpolated by the square of the angle's sine. They are fitted by least squares to what arrives
//! about the reflection and later. The direct sound has low frequencies that last until then: its waveform is the mean
//! over all pairs, each brought to one distance, and is subtracted first. Filters and waveform are fitted in turn.
//!
//! The direct sound of a pair is Foam's response less its filter applied to the difference.

use std::sync::Arc;

use realfft::num_complex::Complex;
use realfft::{ComplexToReal, RealToComplex};

use crate::error::check_len;
use crate::{Error, RealSample};

/// Least time between both arrivals of a pair that filters are fitted to, s.
const LEAST_SEPARATION_SECS: f64 = 0.25e-3;
/// Time before the reflection's arrival at which the fitted part begins to rise, and the length of that rise, s.
const GATE_SECS: [f64; 2] = [0.2e-3, 0.2e-3];
/// Times that the filters span about the reflection by Flat, s: sound that enters 50 mm of foam and comes back from the
/// wall behind it is 0.3 ms late.
const FILTER_SECS: [f64; 2] = [-0.1e-3, 0.6e-3];
/// Angles that have filters of their own, by the square of the sine.
const CLASSES: [f64; 6] = [0.0, 0.15, 0.3, 0.45, 0.6, 0.75];
/// Square of the sine that the last variant adds.
const ADDED_SINE_SQUARE: f64 = 0.03;
/// Least number of pairs for an estimate, and for a class of angles: one with fewer has no filter of its own.
pub const LEAST_PAIRS: usize = 24;
/// Most pairs that are fitted: with more, the estimate is no better.
const MOST_PAIRS: usize = 1_000;
/// Parts of the pairs, each of which is left out of one variant of the estimate.
const PARTS: usize = 4;
/// Number of fits, each with the direct sound's waveform of the one before.
const ROUNDS: usize = 3;
/// Power added to each tap, relative to the mean: nothing is known of frequencies that the sweep lacks.
const LOADING: f64 = 1e-5;

/// Path of a pair's sound by the panel's plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReflectionPath {
    /// Arrival of the direct sound, s.
    pub direct_secs: f64,
    /// Arrival of the reflection, s.
    pub reflected_secs: f64,
    /// Angle of incidence, degrees.
    pub incidence_deg: f64,
}

/// Fits the filters to Foam's and Flat's responses of many pairs.
///
/// ```
/// use echolake_dsp::foam_reflection::{FoamReflectionFit, ReflectionPath};
///
/// let mut fit = FoamReflectionFit::new(384, 96e3)?;
/// let response = |reflection: f64| {
///     let mut ir = vec![0.0; 384];
///     (ir[80], ir[160]) = (1.0, reflection);
///     ir
/// };
/// let path = ReflectionPath { direct_secs: 80.0 / 96e3, reflected_secs: 160.0 / 96e3, incidence_deg: 30.0 };
/// for _ in 0..24 {
///     assert!(fit.add_pair(&response(0.04), &response(0.84), path)?);
/// }
/// let reflection = fit.finish().ok_or("24 pairs are enough")?.best;
/// let mut direct = vec![0.0; 384];
/// reflection.direct_sound(&response(0.04), &response(0.84), 30.0, &mut direct)?;
/// assert!((direct[80] - 1.0).abs() < 1e-3 && direct[160].abs() < 1e-3);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct FoamReflectionFit {
    rate_hz: f64,
    len: usize,
    pairs: Vec<FittedPair>,
}

struct FittedPair {
    path: ReflectionPath,
    foam: Vec<f64>,
    /// Flat's response less Foam's.
    difference: Vec<f64>,
}

/// Foam's reflection relative to what Flat reflects more.
#[derive(Debug, Clone, PartialEq)]
pub struct FoamReflection {
    /// Samples by which the first tap comes before the reflection by Flat.
    lead: usize,
    /// Squares of the sine of the angles, ascending, and the filter of each.
    classes: Vec<f64>,
    filters: Vec<Vec<f64>>,
}

/// An estimate, and variants of it, whose differences show its error.
#[derive(Debug, Clone, PartialEq)]
pub struct FoamReflectionEstimate {
    /// The estimate.
    pub best: FoamReflection,
    /// Variants: without each part of the pairs, by the time between their arrivals; last, as if the sound came less
    /// steeply, because a panel's edges and a relief's faces reflect at other angles than its plane does.
    pub variants: Vec<FoamReflection>,
}

/// Least squares for the filters of some classes: the lower triangle of its matrix, row by row, and its right side.
#[derive(Clone)]
struct NormalEquations {
    classes: Vec<f64>,
    taps: usize,
    matrix: Vec<f64>,
    wanted: Vec<f64>,
}

/// A pair whose filters are fitted by what the gate lets through.
struct GatedPair<'a> {
    pair: &'a FittedPair,
    /// `[len]`: squares of the gate.
    gates: Vec<f64>,
    /// The difference backwards, between zeros, so that a slice is what the taps move to a sample.
    backwards: Vec<f64>,
}

/// Delays signals by fractions of a sample, around a circle twice as long as a response.
struct SignalDelay {
    forward: Arc<dyn RealToComplex<f64>>,
    inverse: Arc<dyn ComplexToReal<f64>>,
    /// Of the signal that was taken last.
    spectrum: Vec<Complex<f64>>,
    turned: Vec<Complex<f64>>,
    delayed: Vec<f64>,
    work: Vec<Complex<f64>>,
}

impl ReflectionPath {
    fn sine_square(&self) -> f64 {
        self.incidence_deg.to_radians().sin().powi(2)
    }

    fn separation_secs(&self) -> f64 {
        self.reflected_secs - self.direct_secs
    }
}

impl FoamReflectionFit {
    /// Begins a fit to responses of `len` samples.
    ///
    /// # Errors
    /// [`Error::Setting`] for no samples, or a rate at which the filters have no tap.
    pub fn new(len: usize, rate_hz: f64) -> Result<Self, Error> {
        if len == 0 || !(rate_hz.is_finite() && rate_hz * FILTER_SECS[1] >= 1.0) {
            let actual = format!("{len} samples at {rate_hz} Hz");
            return Err(Error::Setting { what: "the response", actual, expected: "samples at some kHz" });
        }
        Ok(Self { rate_hz, len, pairs: Vec::new() })
    }

    /// Adds a pair by its responses of Foam and Flat. Returns false, and adds nothing, if the reflection arrives too
    /// soon after the direct sound or too late.
    ///
    /// # Errors
    /// [`Error::Length`] or [`Error::NotFinite`].
    pub fn add_pair<T: RealSample>(&mut self, foam: &[T], flat: &[T], path: ReflectionPath) -> Result<bool, Error> {
        check_len("Foam's response", foam.len(), self.len)?;
        check_len("Flat's response", flat.len(), self.len)?;
        let inside = (path.reflected_secs + FILTER_SECS[1]) * self.rate_hz < self.len as f64;
        let apart = path.direct_secs > 0.0 && path.separation_secs() >= LEAST_SEPARATION_SECS;
        if !(inside && apart && path.incidence_deg.is_finite()) {
            return Ok(false);
        }
        if !foam.iter().chain(flat).all(|x| x.f64().is_finite()) {
            return Err(Error::NotFinite { what: "a reference's response" });
        }
        let difference = flat.iter().zip(foam).map(|(flat, foam)| flat.f64() - foam.f64()).collect();
        self.pairs.push(FittedPair { path, foam: foam.iter().map(|x| x.f64()).collect(), difference });
        Ok(true)
    }

    /// Fits the filters; None of fewer than [`LEAST_PAIRS`], or if Flat reflects no more than Foam.
    pub fn finish(self) -> Option<FoamReflectionEstimate> {
        if self.pairs.len() < LEAST_PAIRS {
            return None;
        }
        let stride = self.pairs.len().div_ceil(MOST_PAIRS);
        let classes = supported_classes(&self.pairs);
        let taps = self.lead() + self.samples(FILTER_SECS[1]) + 1;
        let mut pairs: Vec<_> = self.pairs.iter().step_by(stride).map(|pair| self.gate_pair(pair, taps)).collect();
        pairs.sort_by(|a, b| a.pair.path.separation_secs().total_cmp(&b.pair.path.separation_secs()));
        let part_of = |number: usize| number * PARTS / pairs.len();
        let mut parts = vec![NormalEquations::new(classes, taps); PARTS];
        for (number, pair) in pairs.iter().enumerate() {
            parts[part_of(number)].add_products(pair.pair.path.sine_square(), &pair.tap_products(taps));
        }
        let mut delay = SignalDelay::new(2 * self.len);
        let mut waveform = vec![0.0; 2 * self.len];
        let mut best = None;
        for _ in 0..ROUNDS {
            if let Some(best) = &best {
                waveform = self.direct_waveform(&pairs, best, &mut delay)?;
            }
            delay.take_signal(&waveform)?;
            parts.iter_mut().for_each(|equations| equations.wanted.fill(0.0));
            for (number, pair) in pairs.iter().enumerate() {
                let secs = pair.pair.path.direct_secs;
                let correlations = pair.tap_correlations(taps, delay.delay_signal(secs * self.rate_hz)?);
                parts[part_of(number)].add_correlations(pair.pair.path.sine_square(), &correlations);
            }
            best = Some(self.solve_equations(NormalEquations::sum_without(&parts, None))?);
        }
        let best = best?;
        let without = (0..PARTS).map(|part| self.solve_equations(NormalEquations::sum_without(&parts, Some(part))));
        let variants = without.chain([Some(best.at_higher_angles())]).collect::<Option<_>>()?;
        Some(FoamReflectionEstimate { best, variants })
    }

    fn solve_equations(&self, equations: NormalEquations) -> Option<FoamReflection> {
        let taps = equations.taps;
        let classes = equations.classes.clone();
        let filters = equations.solve()?.chunks_exact(taps).map(<[f64]>::to_vec).collect();
        Some(FoamReflection { lead: self.lead(), classes, filters })
    }

    fn gate_pair<'a>(&self, pair: &'a FittedPair, taps: usize) -> GatedPair<'a> {
        let later = std::iter::repeat_n(0.0, self.lead());
        let earlier = std::iter::repeat_n(0.0, taps);
        GatedPair {
            pair,
            gates: (0..self.len).map(|n| self.gate(pair, n).powi(2)).collect(),
            backwards: later.chain(pair.difference.iter().rev().copied()).chain(earlier).collect(),
        }
    }

    // The mean of all direct sounds, each from its arrival, at a distance that sound travels in a second. Times before
    // the arrival are at the end.
    fn direct_waveform(
        &self,
        pairs: &[GatedPair<'_>],
        reflection: &FoamReflection,
        delay: &mut SignalDelay,
    ) -> Option<Vec<f64>> {
        let circle = 2 * self.len;
        let mut sums = vec![(0.0, 0.0); circle];
        for GatedPair { pair, .. } in pairs {
            let arrival = pair.path.direct_secs * self.rate_hz;
            delay.take_signal(&reflection.remove_reflection(&pair.foam, &pair.difference, pair.path.sine_square()))?;
            let advanced = delay.delay_signal(-arrival)?;
            for (at, (sum, x)) in sums.iter_mut().zip(advanced).enumerate() {
                let lag = if at < self.len { at as f64 } else { at as f64 - circle as f64 };
                if (0.0..self.len as f64).contains(&(lag + arrival)) {
                    *sum = (sum.0 + x * pair.path.direct_secs, sum.1 + 1.0);
                }
            }
        }
        Some(sums.into_iter().map(|(sum, count)| if count > 0.0 { sum / count } else { 0.0 }).collect())
    }

    fn gate(&self, pair: &FittedPair, sample: usize) -> f64 {
        let secs = sample as f64 / self.rate_hz - (pair.path.reflected_secs - GATE_SECS[0]);
        match secs / GATE_SECS[1] {
            ..=0.0 => 0.0,
            rise @ 0.0..1.0 => 0.5 - 0.5 * (std::f64::consts::PI * rise).cos(),
            _ => 1.0,
        }
    }

    fn samples(&self, secs: f64) -> usize {
        (secs * self.rate_hz).round() as usize
    }

    fn lead(&self) -> usize {
        self.samples(-FILTER_SECS[0])
    }
}

impl GatedPair<'_> {
    // What each tap moves to the sample before this one.
    fn moved_before(&self, sample: usize) -> &[f64] {
        &self.backwards[self.gates.len() - sample..]
    }

    // Sums of products of the gated difference, moved by each tap, with itself moved by each: the lower triangle.
    //
    // With both taps one later, a sample has the gate of the next one. So the sum changes only where the gate does,
    // which is at its rise and at the ends of the response.
    fn tap_products(&self, taps: usize) -> Vec<f64> {
        let mut first = vec![0.0; taps];
        let mut changes = vec![0.0; taps * taps];
        let mut gate_before = 0.0;
        for (sample, gate) in self.gates.iter().chain([&0.0]).enumerate() {
            let moved = &self.moved_before(sample)[..taps];
            first.iter_mut().zip(moved).for_each(|(sum, x)| *sum += gate_before * moved[0] * x);
            let change = gate - gate_before;
            if change != 0.0 {
                for (tap, row) in changes.chunks_exact_mut(taps).enumerate() {
                    let factor = change * moved[tap];
                    row[..=tap].iter_mut().zip(moved).for_each(|(sum, x)| *sum += factor * x);
                }
            }
            gate_before = *gate;
        }
        let mut products = vec![0.0; taps * taps];
        for tap in 0..taps {
            let (above, own) = products.split_at_mut(tap * taps);
            own[0] = first[tap];
            if let Some(before) = tap.checked_sub(1).map(|before| before * taps) {
                let sums = above[before..].iter().zip(&changes[before..]);
                own[1..=tap].iter_mut().zip(sums).for_each(|(sum, (above, change))| *sum = above + change);
            }
        }
        products
    }

    // Sums of products of the gated difference, moved by each tap, with the gated response of Foam less the direct
    // sound, which is given at a distance that sound travels in a second.
    fn tap_correlations(&self, taps: usize, direct: &[f64]) -> Vec<f64> {
        let mut correlations = vec![0.0; taps];
        for (n, ((foam, direct), gate)) in self.pair.foam.iter().zip(direct).zip(&self.gates).enumerate() {
            let reflected = gate * (foam - direct / self.pair.path.direct_secs);
            correlations.iter_mut().zip(self.moved_before(n + 1)).for_each(|(sum, x)| *sum += reflected * x);
        }
        correlations
    }
}

// Classes that enough pairs are near to, each weighed as interpolation does; if there are none, those that most are
// near to.
fn supported_classes(pairs: &[FittedPair]) -> Vec<f64> {
    let mut counts = [0.0; CLASSES.len()];
    for pair in pairs {
        class_weights(&CLASSES, pair.path.sine_square()).iter().for_each(|(class, weight)| counts[*class] += weight);
    }
    let most = counts.iter().copied().fold(0.0, f64::max);
    let supported = CLASSES.iter().zip(counts).filter(|(_, count)| *count >= most.min(LEAST_PAIRS as f64));
    supported.map(|(class, _)| *class).collect()
}

// Indices and weights of the classes between which a value lies; beyond them all, the outermost alone.
fn class_weights(classes: &[f64], value: f64) -> [(usize, f64); 2] {
    let above = classes.partition_point(|class| *class < value).min(classes.len() - 1);
    let below = above.saturating_sub(1);
    let share = (value - classes[below]) / (classes[above] - classes[below]);
    let share = if above == below { 1.0 } else { share.clamp(0.0, 1.0) };
    [(below, 1.0 - share), (above, share)]
}

impl NormalEquations {
    fn new(classes: Vec<f64>, taps: usize) -> Self {
        let unknowns = classes.len() * taps;
        Self { classes, taps, matrix: vec![0.0; unknowns * unknowns], wanted: vec![0.0; unknowns] }
    }

    fn sum_without(parts: &[Self], omitted: Option<usize>) -> Self {
        let mut sum = Self::new(parts[0].classes.clone(), parts[0].taps);
        for (_, part) in parts.iter().enumerate().filter(|(number, _)| Some(*number) != omitted) {
            sum.matrix.iter_mut().zip(&part.matrix).for_each(|(sum, x)| *sum += x);
            sum.wanted.iter_mut().zip(&part.wanted).for_each(|(sum, x)| *sum += x);
        }
        sum
    }

    // Adds a pair whose angle has this square of the sine.
    fn add_products(&mut self, sine_square: f64, products: &[f64]) {
        let taps = self.taps;
        let unknowns = self.wanted.len();
        let [below, above] = class_weights(&self.classes, sine_square);
        for (rows, columns) in [(below, below), (above, below), (above, above)] {
            // The only class is both, with weights 0 and 1.
            let weight = rows.1 * columns.1;
            for row in 0..taps {
                let first = (rows.0 * taps + row) * unknowns + columns.0 * taps;
                let sums = &mut self.matrix[first..first + taps];
                let of_row = |column: usize| products[row.max(column) * taps + row.min(column)];
                sums.iter_mut().enumerate().for_each(|(column, sum)| *sum += weight * of_row(column));
            }
        }
    }

    fn add_correlations(&mut self, sine_square: f64, correlations: &[f64]) {
        for (class, weight) in class_weights(&self.classes, sine_square) {
            let sums = &mut self.wanted[class * self.taps..(class + 1) * self.taps];
            sums.iter_mut().zip(correlations).for_each(|(sum, x)| *sum += weight * x);
        }
    }

    // By Cholesky's factors; None of a matrix that is not positive definite.
    fn solve(mut self) -> Option<Vec<f64>> {
        let unknowns = self.wanted.len();
        let trace: f64 = (0..unknowns).map(|i| self.matrix[i * unknowns + i]).sum();
        for i in 0..unknowns {
            let (above, row) = self.matrix.split_at_mut(i * unknowns);
            row[i] += LOADING * trace / unknowns as f64;
            for j in 0..i {
                let factor = &above[j * unknowns..=j * unknowns + j];
                row[j] = (row[j] - f64::dot_product(&row[..j], &factor[..j])) / factor[j];
            }
            let square = row[i] - f64::dot_product(&row[..i], &row[..i]);
            if !(square > 0.0) {
                return None;
            }
            row[i] = square.sqrt();
        }
        let mut solution = self.wanted;
        for i in 0..unknowns {
            let row = &self.matrix[i * unknowns..=i * unknowns + i];
            solution[i] = (solution[i] - f64::dot_product(&row[..i], &solution[..i])) / row[i];
        }
        for i in (0..unknowns).rev() {
            let row = &self.matrix[i * unknowns..=i * unknowns + i];
            solution[i] /= row[i];
            let x = solution[i];
            solution[..i].iter_mut().zip(row).for_each(|(sum, factor)| *sum -= factor * x);
        }
        Some(solution)
    }
}

impl SignalDelay {
    fn new(circle: usize) -> Self {
        let forward = f64::plan_real_forward(circle);
        let inverse = f64::plan_real_inverse(circle);
        let work = forward.get_scratch_len().max(inverse.get_scratch_len());
        Self {
            spectrum: forward.make_output_vec(),
            turned: forward.make_output_vec(),
            delayed: inverse.make_output_vec(),
            work: vec![Complex::default(); work],
            forward,
            inverse,
        }
    }

    // None if the signal is longer than the circle.
    fn take_signal(&mut self, signal: &[f64]) -> Option<()> {
        self.delayed.fill(0.0);
        self.delayed.get_mut(..signal.len())?.copy_from_slice(signal);
        self.forward.process_with_scratch(&mut self.delayed, &mut self.spectrum, &mut self.work).ok()
    }

    // Returns the signal that was taken last, delayed.
    fn delay_signal(&mut self, samples: f64) -> Option<&[f64]> {
        let circle = self.delayed.len() as f64;
        let step = Complex::cis(-std::f64::consts::TAU * samples / circle);
        let mut factor = Complex::from(circle.recip());
        for (turned, x) in self.turned.iter_mut().zip(&self.spectrum) {
            *turned = x * factor;
            factor *= step;
        }
        // The end of a real signal's spectrum is real.
        self.turned.last_mut()?.im = 0.0;
        self.inverse.process_with_scratch(&mut self.turned, &mut self.delayed, &mut self.work).ok()?;
        Some(&self.delayed)
    }
}

impl FoamReflection {
    /// Computes the direct sound of a pair with this angle of incidence: Foam's response without its reflection.
    ///
    /// foam, flat, direct  `[n]`
    ///
    /// # Errors
    /// [`Error::Length`].
    pub fn direct_sound<T: RealSample>(
        &self,
        foam: &[T],
        flat: &[T],
        incidence_deg: f64,
        direct: &mut [T],
    ) -> Result<(), Error> {
        check_len("Flat's response", flat.len(), foam.len())?;
        check_len("the direct sound", direct.len(), foam.len())?;
        let difference: Vec<f64> = flat.iter().zip(foam).map(|(flat, foam)| flat.f64() - foam.f64()).collect();
        let foam: Vec<f64> = foam.iter().map(|x| x.f64()).collect();
        let sine_square = incidence_deg.to_radians().sin().powi(2);
        let found = self.remove_reflection(&foam, &difference, sine_square);
        direct.iter_mut().zip(found).for_each(|(direct, x)| *direct = T::of(x));
        Ok(())
    }

    // Every angle has the filter of a somewhat higher one.
    fn at_higher_angles(&self) -> Self {
        let classes = self.classes.iter().map(|sine_square| sine_square - ADDED_SINE_SQUARE).collect();
        Self { classes, ..self.clone() }
    }

    fn remove_reflection(&self, foam: &[f64], difference: &[f64], sine_square: f64) -> Vec<f64> {
        let [below, above] = class_weights(&self.classes, sine_square);
        let mut direct = foam.to_vec();
        for (tap, (a, b)) in self.filters[below.0].iter().zip(&self.filters[above.0]).enumerate() {
            let factor = below.1 * a + above.1 * b;
            let from = self.lead.saturating_sub(tap).min(difference.len());
            let to = tap.saturating_sub(self.lead).min(direct.len());
            direct[to..].iter_mut().zip(&difference[from..]).for_each(|(x, reflected)| *x -= factor * reflected);
        }
        direct
    }
}

/// Computes the standard error of a value of the best estimate from its values of the variants: that of leaving out
/// parts (jackknife), and the difference that another angle makes. NaN without variants.
///
/// Source: Efron & Stein 1981, Annals of Statistics 9(3), 586-596, for the jackknife.
pub fn estimate_error(best: f64, variants: &[f64]) -> f64 {
    let Some((moved, parts)) = variants.split_last() else { return f64::NAN };
    let count = parts.len() as f64;
    let mean = parts.iter().sum::<f64>() / count;
    let variance = (count - 1.0) / count * parts.iter().map(|x| (x - mean).powi(2)).sum::<f64>();
    variance.sqrt().hypot(moved - best)
}

#[cfg(test)]
mod tests;
