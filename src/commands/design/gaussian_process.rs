//! A Gaussian process over ranges of parameters: what is known of a figure between panels whose figure is known.
//!
//! A figure is what a simulation would say and a difference from it, which has a process of its own: the simulation is
//! wrong in the same way for panels that are alike (Kennedy and O'Hagan 2000, Biometrika 87, 1-13).

use std::cmp::Ordering;

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

/// Length scales that are tried, as shares of the ranges.
const LENGTH_SCALES: [f64; 6] = [0.1, 0.2, 0.3, 0.5, 0.8, 1.3];

/// Variances that are tried, over that of the figures.
const VARIANCES: [f64; 4] = [0.25, 1.0, 4.0, 16.0];

/// A figure that is known at a place.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct KnownFigure {
    pub place: Vec<f64>,
    pub value: f64,
    /// Its own standard uncertainty.
    pub uncertainty: f64,
    /// False if it is simulated.
    pub is_measured: bool,
}

/// A process of measured figures with the length scale and the variance under which its figures are most likely.
pub(super) struct GaussianProcess {
    known: Vec<KnownFigure>,
    /// Of what simulations say, and of the difference.
    variance: f64,
    difference_variance: f64,
    length_scale: f64,
    factor: Cholesky<f64, Dyn>,
    mean: f64,
    weights: DVector<f64>,
}

impl GaussianProcess {
    /// Fits figures, of which simulated ones differ from measured ones by so much; None if there are fewer than three,
    /// or all are alike.
    pub fn fit_figures(known: &[KnownFigure], difference: f64) -> Option<Self> {
        let count = known.len() as f64;
        let mean = known.iter().map(|figure| figure.value).sum::<f64>() / count;
        let variance = known.iter().map(|figure| (figure.value - mean).powi(2)).sum::<f64>() / count;
        if known.len() < 3 || variance.partial_cmp(&0.0) != Some(Ordering::Greater) {
            return None;
        }
        let tried = LENGTH_SCALES.iter().flat_map(|scale| VARIANCES.map(|factor| (*scale, factor * variance)));
        let fits = tried.filter_map(|(scale, variance)| {
            let process = Self::with_scale(known.to_vec(), [variance, difference.powi(2)], scale)?;
            Some((process.log_likelihood(), process))
        });
        fits.max_by(|(a, _), (b, _)| a.total_cmp(b)).map(|(_, process)| process)
    }

    fn with_scale(known: Vec<KnownFigure>, variances: [f64; 2], length_scale: f64) -> Option<Self> {
        let [variance, difference_variance] = variances;
        let covariance = |i: usize, j: usize| {
            let both = if known[i].is_measured && known[j].is_measured { difference_variance } else { 0.0 };
            let shared = (variance + both) * similarity(&known[i].place, &known[j].place, length_scale);
            // The last term keeps places that are nearly one from being singular.
            if i == j { shared + known[i].uncertainty.powi(2) + 1e-6 * variance } else { shared }
        };
        let factor = DMatrix::from_fn(known.len(), known.len(), covariance).cholesky()?;
        let values = DVector::from_iterator(known.len(), known.iter().map(|figure| figure.value));
        // The mean by generalised least squares: places that are near each other count less.
        let shares = factor.solve(&DVector::from_element(known.len(), 1.0));
        let mean = shares.dot(&values) / shares.sum();
        let weights = factor.solve(&values.add_scalar(-mean));
        Some(Self { known, variance, difference_variance, length_scale, factor, mean, weights })
    }

    fn log_likelihood(&self) -> f64 {
        let residuals = self.known.iter().map(|figure| figure.value - self.mean);
        let fit: f64 = residuals.zip(self.weights.iter()).map(|(residual, weight)| residual * weight).sum();
        let volume: f64 = self.factor.l_dirty().diagonal().iter().map(|x| x.ln()).sum();
        -0.5 * fit - volume
    }

    /// Returns the figure that a measurement at a place is expected to give, and its standard deviation.
    pub fn predict_figure(&self, place: &[f64]) -> (f64, f64) {
        let shared = |figure: &KnownFigure| {
            let both = if figure.is_measured { self.difference_variance } else { 0.0 };
            (self.variance + both) * similarity(&figure.place, place, self.length_scale)
        };
        let shared = DVector::from_iterator(self.known.len(), self.known.iter().map(shared));
        let explained = shared.dot(&self.factor.solve(&shared));
        (self.mean + shared.dot(&self.weights), (self.variance + self.difference_variance - explained).max(0.0).sqrt())
    }

    /// Adds a figure as expected at a place that is to be measured.
    pub fn expect_at(self, place: &[f64], uncertainty: f64) -> Option<Self> {
        let (value, _) = self.predict_figure(place);
        let mut known = self.known;
        known.push(KnownFigure { place: place.to_vec(), value, uncertainty, is_measured: true });
        Self::with_scale(known, [self.variance, self.difference_variance], self.length_scale)
    }
}

// 1 at one place, and less with the distance.
fn similarity(a: &[f64], b: &[f64], length_scale: f64) -> f64 {
    let square: f64 = a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum();
    (-0.5 * square / length_scale.powi(2)).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn known(place: f64, uncertainty: f64) -> KnownFigure {
        KnownFigure { place: vec![place], value: (6.0 * place).sin(), uncertainty, is_measured: true }
    }

    #[test]
    fn figures_are_known_where_they_are_and_unknown_in_gaps() {
        let all: Vec<_> = [0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.9, 0.95, 1.0].map(|at| known(at, 1e-3)).to_vec();
        let process = GaussianProcess::fit_figures(&all, 0.0).expect("a fit");
        let (value, deviation) = process.predict_figure(&[0.2]);
        assert!((value - 1.2f64.sin()).abs() < 0.01 && deviation < 0.01, "{value} {deviation}");
        let (_, within_gap) = process.predict_figure(&[0.6]);
        assert!(within_gap > 10.0 * deviation, "{within_gap}");
        let filled = process.expect_at(&[0.6], 1e-3).expect("a fit");
        assert!(filled.predict_figure(&[0.6]).1 < 0.1 * within_gap);
    }

    // However many simulated panels lie there, their common error stays; what is expected is what they say, until a
    // measurement says how wrong they are.
    #[test]
    fn errors_of_simulations_do_not_average_out() {
        let simulated = |n: usize| KnownFigure { is_measured: false, ..known(n as f64 / 40.0, 0.05) };
        let mut all: Vec<_> = (0..40).map(simulated).collect();
        let process = GaussianProcess::fit_figures(&all, 0.3).expect("a fit");
        let (value, deviation) = process.predict_figure(&[0.5]);
        assert!((value - 3.0f64.sin()).abs() < 0.05 && (0.29..0.32).contains(&deviation), "{value} {deviation}");
        let measured = known(0.5, 0.05);
        all.push(KnownFigure { value: measured.value - 0.4, ..measured });
        let (value, deviation) = GaussianProcess::fit_figures(&all, 0.3).expect("a fit").predict_figure(&[0.5]);
        assert!((value - 3.0f64.sin() + 0.4).abs() < 0.05 && deviation < 0.06, "{value} {deviation}");
    }

    // The table of docs/devices.md: joints of 0.6, 1.2 and 1.5 mm, mean levels by band, simulated and by boundary
    // elements, which stand for a measurement.
    const WIDTHS: [f64; 3] = [0.0, 0.67, 1.0];
    const JOINTS_DB: [[[f64; 3]; 2]; 5] = [
        [[0.0, 0.0, -0.01], [-0.01, 0.0, 0.0]],
        [[0.0, -0.01, -0.01], [0.0, 0.01, 0.01]],
        [[-0.01, -0.03, -0.04], [0.02, 0.03, 0.03]],
        [[-0.01, -0.06, -0.08], [0.08, 0.14, 0.18]],
        [[0.06, 0.13, 0.18], [0.25, 0.87, 1.21]],
    ];

    #[test]
    fn boundary_elements_are_within_the_difference_of_simulations() {
        let difference = echolake_schema::simulation::UNTRUSTED_ERROR_DB;
        for (band, [simulated, exact]) in JOINTS_DB.iter().enumerate() {
            let figure = |at: usize, value: f64, is_measured: bool| KnownFigure {
                place: vec![WIDTHS[at]],
                value,
                uncertainty: 0.1,
                is_measured,
            };
            for left_out in 0..3 {
                let others = (0..3).filter(|at| *at != left_out);
                let measured: Vec<_> = others.map(|at| figure(at, exact[at], true)).collect();
                let all: Vec<_> =
                    (0..3).map(|at| figure(at, simulated[at], false)).chain(measured.iter().cloned()).collect();
                let error = |known: &[KnownFigure]| {
                    let process = GaussianProcess::fit_figures(known, difference).expect("a fit");
                    let (value, deviation) = process.predict_figure(&[WIDTHS[left_out]]);
                    ((value - exact[left_out]).abs(), deviation)
                };
                let ((alone, _), (off, deviation)) = (error(&all[..3]), error(&all));
                assert!(off <= 1.96 * deviation.hypot(0.1), "band {band}, {left_out}: {off} of {deviation}");
                // Measurements beside it tell how wrong the simulation is.
                assert!(off < alone + 0.1, "band {band}, {left_out}: {off} and {alone}");
            }
        }
    }

    #[test]
    fn too_little_gives_no_process() {
        assert!(GaussianProcess::fit_figures(&[known(0.1, 0.1), known(0.5, 0.1)], 0.0).is_none());
        let same = KnownFigure { value: 1.0, ..known(0.2, 0.1) };
        assert!(GaussianProcess::fit_figures(&[same.clone(), same.clone(), same], 0.0).is_none());
    }
}
