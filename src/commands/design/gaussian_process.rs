//! A Gaussian process over the unit cube: what is known of a figure between panels whose figure is known.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

/// Length scales that are tried, as shares of the ranges.
const LENGTH_SCALES: [f64; 6] = [0.1, 0.2, 0.3, 0.5, 0.8, 1.3];

/// A figure that is known at a place.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct KnownFigure {
    /// Coordinates, 0 to 1.
    pub place: Vec<f64>,
    pub value: f64,
    /// Its standard uncertainty.
    pub uncertainty: f64,
}

/// A process with the length scale under which its figures are most likely.
pub(super) struct GaussianProcess {
    known: Vec<KnownFigure>,
    mean: f64,
    variance: f64,
    length_scale: f64,
    factor: Cholesky<f64, Dyn>,
    weights: DVector<f64>,
}

impl GaussianProcess {
    /// Fits figures; None if there are fewer than three, or all are alike.
    pub fn fit(known: &[KnownFigure]) -> Option<Self> {
        let count = known.len() as f64;
        let mean = known.iter().map(|figure| figure.value).sum::<f64>() / count;
        let variance = known.iter().map(|figure| (figure.value - mean).powi(2)).sum::<f64>() / count;
        if known.len() < 3 || variance.partial_cmp(&0.0) != Some(std::cmp::Ordering::Greater) {
            return None;
        }
        let fits = LENGTH_SCALES.iter().filter_map(|scale| {
            let process = Self::with_scale(known.to_vec(), mean, variance, *scale)?;
            Some((process.log_likelihood(), process))
        });
        fits.max_by(|(a, _), (b, _)| a.total_cmp(b)).map(|(_, process)| process)
    }

    fn with_scale(known: Vec<KnownFigure>, mean: f64, variance: f64, length_scale: f64) -> Option<Self> {
        let covariance = |i: usize, j: usize| {
            let shared = variance * similarity(&known[i].place, &known[j].place, length_scale);
            // The last term keeps places that are nearly one from being singular.
            if i == j { shared + known[i].uncertainty.powi(2) + 1e-9 * variance } else { shared }
        };
        let factor = DMatrix::from_fn(known.len(), known.len(), covariance).cholesky()?;
        let residuals = DVector::from_iterator(known.len(), known.iter().map(|figure| figure.value - mean));
        let weights = factor.solve(&residuals);
        Some(Self { known, mean, variance, length_scale, factor, weights })
    }

    fn log_likelihood(&self) -> f64 {
        let residuals = self.known.iter().map(|figure| figure.value - self.mean);
        let fit: f64 = residuals.zip(self.weights.iter()).map(|(residual, weight)| residual * weight).sum();
        let volume: f64 = self.factor.l_dirty().diagonal().iter().map(|x| x.ln()).sum();
        -0.5 * fit - volume
    }

    /// Returns the expected figure at a place, and its standard deviation.
    pub fn predict(&self, place: &[f64]) -> (f64, f64) {
        let shared = |figure: &KnownFigure| self.variance * similarity(&figure.place, place, self.length_scale);
        let shared = DVector::from_iterator(self.known.len(), self.known.iter().map(shared));
        let explained = shared.dot(&self.factor.solve(&shared));
        (self.mean + shared.dot(&self.weights), (self.variance - explained).max(0.0).sqrt())
    }

    /// Adds a figure as expected at a place that is to be measured.
    pub fn expect_at(self, place: &[f64], uncertainty: f64) -> Option<Self> {
        let (value, _) = self.predict(place);
        let mut known = self.known;
        known.push(KnownFigure { place: place.to_vec(), value, uncertainty });
        Self::with_scale(known, self.mean, self.variance, self.length_scale)
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
        KnownFigure { place: vec![place], value: (6.0 * place).sin(), uncertainty }
    }

    #[test]
    fn figures_are_known_where_they_are_and_unknown_in_gaps() {
        let all: Vec<_> = [0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.9, 0.95, 1.0].map(|at| known(at, 1e-3)).to_vec();
        let process = GaussianProcess::fit(&all).expect("a fit");
        let (value, deviation) = process.predict(&[0.2]);
        assert!((value - 1.2f64.sin()).abs() < 0.01 && deviation < 0.01, "{value} {deviation}");
        let (_, within_gap) = process.predict(&[0.6]);
        assert!(within_gap > 10.0 * deviation, "{within_gap}");
        let filled = process.expect_at(&[0.6], 1e-3).expect("a fit");
        assert!(filled.predict(&[0.6]).1 < 0.1 * within_gap);
    }

    #[test]
    fn too_little_gives_no_process() {
        assert!(GaussianProcess::fit(&[known(0.1, 0.1), known(0.5, 0.1)]).is_none());
        let same = KnownFigure { value: 1.0, ..known(0.2, 0.1) };
        assert!(GaussianProcess::fit(&[same.clone(), same.clone(), same]).is_none());
    }
}
