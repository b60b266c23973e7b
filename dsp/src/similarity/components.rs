//! Principal components of a few long rows, by way of their Gram matrix, and how far rows are apart.

use crate::Error;
use crate::error::check_len;

/// Values that are summed up in f32 before they go into an f64: short enough to lose nothing that counts, long enough
/// to be computed many at a time.
const BLOCK: usize = 64;
const LANES: usize = 8;
/// Steps of the power iteration, if it does not converge earlier.
const STEPS: usize = 500;
/// Change of a component's direction that counts as none.
const SETTLED: f64 = 1e-10;

/// Rows as points: their distances, and their places along the components of greatest variance.
///
/// Distances are root mean squares over the features, so that they have the features' unit.
///
/// ```
/// let mut rows = [vec![0.0, 7.0], vec![2.0, 7.0], vec![4.0, 7.0]];
/// let found = echolake_dsp::components::PrincipalComponents::from_rows(&mut rows, 1)?;
/// assert!((found.explained_shares()[0] - 1.0).abs() < 1e-9);
/// assert!((found.row_distance(0, 2) - 8f64.sqrt()).abs() < 1e-9);
/// # Ok::<(), echolake_dsp::Error>(())
/// ```
#[derive(Debug, Clone)]
pub struct PrincipalComponents {
    features: usize,
    rows: usize,
    /// Inner products of the centred rows, `[rows x rows]`.
    gram: Vec<f64>,
    vectors: Vec<Vec<f64>>,
    values: Vec<f64>,
}

impl PrincipalComponents {
    /// Finds the leading `count` components. A feature that is not finite in one of the rows is left out; the rows are
    /// centred in place.
    ///
    /// rows  `[rows][features]`
    ///
    /// # Errors
    /// [`Error::Length`] if the rows are not equally long.
    pub fn from_rows(rows: &mut [Vec<f32>], count: usize) -> Result<Self, Error> {
        let length = rows.first().map_or(0, Vec::len);
        for row in rows.iter() {
            check_len("a row", row.len(), length)?;
        }
        let features = centre_features(rows, length);
        let n = rows.len();
        let mut gram = vec![0.0; n * n];
        for i in 0..n {
            for j in 0..=i {
                let product = inner_product(&rows[i], &rows[j]);
                gram[i * n + j] = product;
                gram[j * n + i] = product;
            }
        }
        let mut left = gram.clone();
        let mut found = Self { features, rows: n, gram, vectors: Vec::new(), values: Vec::new() };
        for _ in 0..count.min(n) {
            let (value, vector) = take_eigenpair(&mut left, n);
            found.values.push(value);
            found.vectors.push(vector);
        }
        Ok(found)
    }

    /// Features that all rows have.
    pub fn feature_count(&self) -> usize {
        self.features
    }

    /// Rows.
    pub fn row_count(&self) -> usize {
        self.rows
    }

    /// Inner products of a row with all rows, centred.
    ///
    /// # Panics
    /// If there is no such row.
    pub fn row_products(&self, row: usize) -> &[f64] {
        &self.gram[row * self.rows..][..self.rows]
    }

    /// Share of the variance by component; 0 if nothing varies.
    pub fn explained_shares(&self) -> Vec<f64> {
        let all: f64 = (0..self.rows).map(|i| self.gram[i * self.rows + i]).sum();
        self.values.iter().map(|value| if all > 0.0 { value / all } else { 0.0 }).collect()
    }

    /// Coordinates of a row along the components.
    ///
    /// # Panics
    /// If there is no such row.
    pub fn row_position(&self, row: usize) -> Vec<f64> {
        let scale = (self.features.max(1) as f64).sqrt();
        let along = |(value, vector): (&f64, &Vec<f64>)| vector[row] * value.max(0.0).sqrt() / scale;
        self.values.iter().zip(&self.vectors).map(along).collect()
    }

    /// Distance of two rows, root mean square over the features.
    ///
    /// # Panics
    /// If there are no such rows.
    pub fn row_distance(&self, one: usize, other: usize) -> f64 {
        let at = |i: usize, j: usize| self.gram[i * self.rows + j];
        let square = at(one, one) + at(other, other) - 2.0 * at(one, other);
        (square.max(0.0) / self.features.max(1) as f64).sqrt()
    }
}

// Takes each feature's mean off; returns how many are kept. Those that are not make no difference: they become zeros.
fn centre_features(rows: &mut [Vec<f32>], length: usize) -> usize {
    let count = rows.len() as f64;
    let mut features = 0;
    for f in 0..length {
        let sum: f64 = rows.iter().map(|row| f64::from(row[f])).sum();
        let mean = sum / count;
        for row in rows.iter_mut() {
            row[f] = if sum.is_finite() { (f64::from(row[f]) - mean) as f32 } else { 0.0 };
        }
        features += usize::from(sum.is_finite());
    }
    features
}

fn inner_product(a: &[f32], b: &[f32]) -> f64 {
    let block = |(a, b): (&[f32], &[f32])| {
        let mut sums = [0.0_f32; LANES];
        let (whole_a, rest_a) = a.as_chunks::<LANES>();
        let (whole_b, rest_b) = b.as_chunks::<LANES>();
        for (a, b) in whole_a.iter().zip(whole_b) {
            for k in 0..LANES {
                sums[k] += a[k] * b[k];
            }
        }
        let rest: f32 = rest_a.iter().zip(rest_b).map(|(a, b)| a * b).sum();
        f64::from(sums.iter().sum::<f32>() + rest)
    };
    a.chunks(BLOCK).zip(b.chunks(BLOCK)).map(block).sum()
}

// The greatest eigenvalue and its vector, by power iteration; takes them out of the matrix.
fn take_eigenpair(matrix: &mut [f64], n: usize) -> (f64, Vec<f64>) {
    // Of the columns, the longest: it is never across all that is left.
    let norm = |column: &[f64]| column.iter().map(|x| x * x).sum::<f64>().sqrt();
    let longest = matrix.chunks_exact(n).max_by(|a, b| norm(a).total_cmp(&norm(b)));
    let mut vector = longest.map_or_else(Vec::new, <[f64]>::to_vec);
    let mut value = norm(&vector);
    if value > 0.0 {
        vector.iter_mut().for_each(|x| *x /= value);
        for _ in 0..STEPS {
            let mut next: Vec<f64> =
                matrix.chunks_exact(n).map(|row| row.iter().zip(&vector).map(|(a, b)| a * b).sum()).collect();
            value = norm(&next);
            if value == 0.0 {
                break;
            }
            next.iter_mut().for_each(|x| *x /= value);
            let change = next.iter().zip(&vector).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            vector = next;
            if change < SETTLED {
                break;
            }
        }
    }
    for (i, row) in matrix.chunks_exact_mut(n).enumerate() {
        row.iter_mut().zip(&vector).for_each(|(x, v)| *x -= value * vector[i] * v);
    }
    (value, vector)
}

#[cfg(test)]
mod tests {
    use super::*;

    // Points on a line and a little off it: all is known.
    #[test]
    fn a_line_is_found() {
        let (long, short) = ([3.0, -1.0, -2.0, 0.0], [0.1, 0.1, -0.1, -0.1]);
        let mut rows: Vec<Vec<f32>> =
            (0..4).map(|i| vec![5.0 + 3.0 * long[i] - 4.0 * short[i], 4.0 * long[i] + 3.0 * short[i]]).collect();
        let found = PrincipalComponents::from_rows(&mut rows, 3).expect("equally long");
        assert_eq!(found.feature_count(), 2);
        // Both directions have a length of five.
        for (i, along) in long.iter().enumerate() {
            let expected = 5.0 * along.abs() / 2f32.sqrt();
            assert!((found.row_position(i)[0].abs() as f32 - expected).abs() < 2e-2, "{:?}", found.row_position(i));
        }
        let explained = found.explained_shares();
        assert!(explained[0] > 0.99 && (explained.iter().sum::<f64>() - 1.0).abs() < 1e-6, "{explained:?}");
        let apart = 5.0 * f32::hypot(long[0] - long[1], short[0] - short[1]) / 2f32.sqrt();
        assert!((found.row_distance(0, 1) as f32 - apart).abs() < 1e-4);
    }

    #[test]
    fn what_is_not_a_number_is_left_out() {
        let mut rows = vec![vec![1.0, f32::NAN, 2.0], vec![3.0, 1.0, 2.0], vec![5.0, 1.0, 2.0]];
        let found = PrincipalComponents::from_rows(&mut rows, 2).expect("equally long");
        assert_eq!(found.feature_count(), 2);
        assert!((found.row_distance(0, 2) - 4.0 / 2f64.sqrt()).abs() < 1e-6);
        assert!(PrincipalComponents::from_rows(&mut [vec![1.0], vec![]], 1).is_err());
        let nothing = PrincipalComponents::from_rows(&mut [], 3).expect("nothing");
        assert!(nothing.explained_shares().is_empty());
        let alike = PrincipalComponents::from_rows(&mut [vec![1.0; 9], vec![1.0; 9]], 1).expect("equally long");
        assert_eq!((alike.explained_shares(), alike.row_position(0)), (vec![0.0], vec![0.0]));
    }

    // The sum in blocks is the sum.
    #[test]
    fn inner_products_are_exact_enough() {
        for length in [0, 1, 7, 8, 63, 64, 65, 1000] {
            let a: Vec<f32> = (0..length).map(|i| (i as f32 * 0.37).sin()).collect();
            let b: Vec<f32> = (0..length).map(|i| (i as f32 * 0.91).cos() + 0.5).collect();
            let plain: f64 = a.iter().zip(&b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum();
            assert!((inner_product(&a, &b) - plain).abs() < 1e-5 * (length as f64).max(1.0), "{length}");
        }
    }
}
