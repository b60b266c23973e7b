//! What chance explains of correlations: intervals, p values, and tests of a whole table.

use super::correlation::{pearson, spearman};
use crate::Error;

/// Fewer values have no correlation worth printing: three are on a line by chance, and of five the 95 % interval of
/// r = 0.8 is -0.28 to 0.99.
pub const LEAST_VALUES: usize = 6;
/// Share of chance findings that is accepted among the findings of a table.
pub const FALSE_DISCOVERY_RATE: f64 = 0.05;

/// Two-sided 95 % of the normal distribution.
const NORMAL_95: f64 = 1.959_963_984_540_054;
/// Terms of a continued fraction, if it does not converge earlier: it takes about the root of the number of values.
const MOST_TERMS: u32 = 100_000;

/// A correlation with its significance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CorrelationTest {
    /// The coefficient, -1 to 1.
    pub coefficient: f64,
    /// Probability that chance makes one of this size or greater.
    pub p_value: f64,
    /// The p value adjusted for all correlations of the table, by [`adjust_p_values`].
    pub adjusted_p: f64,
}

/// A cell of a table of correlations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CorrelationCell {
    /// Number of values.
    pub count: usize,
    /// Pearson's coefficient; none of fewer than [`LEAST_VALUES`], or if one side does not vary.
    pub linear: Option<CorrelationTest>,
    /// 95 % interval of Pearson's coefficient.
    pub interval: Option<[f64; 2]>,
    /// Spearman's coefficient.
    pub rank: Option<CorrelationTest>,
}

impl CorrelationCell {
    /// Returns whether chance does not explain the correlation: both coefficients hold at
    /// [`FALSE_DISCOVERY_RATE`], so that a single outlier makes no finding.
    pub fn is_beyond_chance(&self) -> bool {
        let holds = |test: &Option<CorrelationTest>| test.is_some_and(|test| test.adjusted_p <= FALSE_DISCOVERY_RATE);
        holds(&self.linear) && holds(&self.rank)
    }
}

/// Tests a table of correlations, each of two equally long columns. P values are adjusted over all of them.
///
/// # Errors
/// [`Error::Length`] if two columns are not equally long.
pub fn test_correlations(columns: &[[Vec<f64>; 2]]) -> Result<Vec<CorrelationCell>, Error> {
    let mut linear = Vec::with_capacity(columns.len());
    let mut rank = Vec::with_capacity(columns.len());
    for [x, y] in columns {
        let is_enough = x.len() >= LEAST_VALUES;
        linear.push(pearson(x, y)?.filter(|_| is_enough).and_then(|r| unadjusted_test(r, x.len())));
        rank.push(spearman(x, y)?.filter(|_| is_enough).and_then(|r| unadjusted_test(r, x.len())));
    }
    adjust_tests(&mut linear);
    adjust_tests(&mut rank);
    let cells = columns.iter().zip(linear).zip(rank).map(|(([x, _], linear), rank)| {
        let interval = linear.and_then(|test| correlation_interval(test.coefficient, x.len()));
        CorrelationCell { count: x.len(), linear, interval, rank }
    });
    Ok(cells.collect())
}

fn unadjusted_test(coefficient: f64, count: usize) -> Option<CorrelationTest> {
    let p_value = correlation_p_value(coefficient, count)?;
    Some(CorrelationTest { coefficient, p_value, adjusted_p: p_value })
}

fn adjust_tests(tests: &mut [Option<CorrelationTest>]) {
    let p_values: Vec<_> = tests.iter().flatten().map(|test| test.p_value).collect();
    tests.iter_mut().flatten().zip(adjust_p_values(&p_values)).for_each(|(test, adjusted)| test.adjusted_p = adjusted);
}

/// Returns the 95 % interval of a correlation of `count` pairs of values; none of fewer than 4.
///
/// Source: Fisher's z = atanh r, whose standard error is 1 / sqrt(count - 3) (Fisher 1921, Metron 1:3-32).
pub fn correlation_interval(coefficient: f64, count: usize) -> Option<[f64; 2]> {
    let freedom = count.checked_sub(3).filter(|freedom| *freedom > 0)?;
    let reach = NORMAL_95 / (freedom as f64).sqrt();
    let z = coefficient.atanh();
    (!z.is_nan()).then(|| [(z - reach).tanh(), (z + reach).tanh()])
}

/// Returns the probability, two-sided, that `count` pairs of values without any correlation have a coefficient of this
/// size or greater; none of fewer than 3, or if the coefficient is not within -1 and 1.
///
/// Exact for Pearson's coefficient of normally distributed values. For Spearman's it is the usual approximation.
///
/// ```
/// let p = echolake_dsp::significance::correlation_p_value(0.632, 10);
/// assert!(p.is_some_and(|p| (p - 0.05).abs() < 1e-4), "critical value of printed tables");
/// ```
///
/// Source: t = r sqrt(f / (1 - r^2)) has Student's distribution of f = count - 2, so that p is the incomplete beta
/// function I(1 - r^2; f/2, 1/2) (DLMF 8.17).
pub fn correlation_p_value(coefficient: f64, count: usize) -> Option<f64> {
    let freedom = count.checked_sub(2).filter(|freedom| *freedom > 0)?;
    if !(-1.0..=1.0).contains(&coefficient) {
        return None;
    }
    let a = freedom as f64 / 2.0;
    let square = coefficient * coefficient;
    let rest = (1.0 - coefficient.abs()) * (1.0 + coefficient.abs());
    // x^a (1 - x)^b / B(a, b) with b = 1/2, where Gamma(1/2)^2 is pi.
    let front = (a * rest.ln()).exp() * coefficient.abs() * half_gamma_ratio(a) / std::f64::consts::PI.sqrt();
    // The fraction converges on this side alone.
    let p = match rest < (a + 1.0) / (a + 2.5) {
        true => front * beta_fraction(rest, a, 0.5) / a,
        false => 1.0 - front * beta_fraction(square, 0.5, a) / 0.5,
    };
    Some(p.clamp(0.0, 1.0))
}

// Gamma(a + 1/2) / Gamma(a), by its series for great a (DLMF 5.11.13), to which small a are shifted.
fn half_gamma_ratio(a: f64) -> f64 {
    let mut factor = 1.0;
    let mut a = a;
    while a < 16.0 {
        factor *= a / (a + 0.5);
        a += 1.0;
    }
    let inverse = 1.0 / a;
    factor * a.sqrt() * (-inverse / 8.0 + inverse.powi(3) / 192.0 - inverse.powi(5) / 640.0).exp()
}

// The continued fraction of the incomplete beta function (DLMF 8.17.22), by Lentz's method.
fn beta_fraction(x: f64, a: f64, b: f64) -> f64 {
    let mut above = 1.0;
    let mut below = 1.0 / (1.0 - (a + b) * x / (a + 1.0));
    let mut value = below;
    for m in (1..=MOST_TERMS).map(f64::from) {
        let at = a + 2.0 * m;
        let even = m * (b - m) * x / ((at - 1.0) * at);
        let odd = -(a + m) * (a + b + m) * x / (at * (at + 1.0));
        let before = value;
        for term in [even, odd] {
            below = 1.0 / (1.0 + term * below);
            above = 1.0 + term / above;
            value *= above * below;
        }
        if (value - before).abs() <= f64::EPSILON * value.abs() {
            break;
        }
    }
    value
}

/// Adjusts p values for their number: those that stay at or below q are findings of which a share of q at most is
/// expected to be chance.
///
/// ```
/// let adjusted = echolake_dsp::significance::adjust_p_values(&[0.01, 0.04, 0.03]);
/// assert!(adjusted.iter().zip([0.03, 0.04, 0.04]).all(|(p, expected)| (p - expected).abs() < 1e-12));
/// ```
///
/// Source: Benjamini and Hochberg 1995, J. R. Stat. Soc. B 57(1):289-300.
pub fn adjust_p_values(p_values: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..p_values.len()).collect();
    order.sort_by(|i, j| p_values[*j].total_cmp(&p_values[*i]));
    let mut adjusted = vec![1.0; p_values.len()];
    let mut least = 1.0_f64;
    for (position, i) in order.into_iter().enumerate() {
        let rank = p_values.len() - position;
        least = least.min(p_values[i] * p_values.len() as f64 / rank as f64);
        adjusted[i] = least;
    }
    adjusted
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assert_near(actual: f64, expected: f64) {
        assert!((actual - expected).abs() <= 1e-11 * expected.abs(), "{actual} instead of {expected}");
    }

    // Printed by SciPy 1.17.1: pearsonr with its confidence_interval(), and spearmanr.
    #[test]
    fn tests_are_those_of_scipy() {
        let long: Vec<f64> = (0..40).map(f64::from).collect();
        let bent: Vec<f64> = long.iter().map(|x| x * x + 50.0 * (3.0 * x).sin()).collect();
        let cases = [
            (
                [vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0], vec![2.0, 1.0, 4.0, 3.0, 7.0, 5.0]],
                [0.7917946548886295, 0.06051140336275671, -0.055305159673339724, 0.9761145801153426],
                [0.8285714285714287, 0.04156268221574335],
            ),
            (
                [vec![0.1, 0.7, 1.3, 2.2, 2.9, 3.1, 4.8, 5.0, 6.6], vec![9.1, 7.7, 8.2, 4.1, 6.0, 3.3, 3.9, 1.2, 0.4]],
                [-0.9253216054049633, 0.0003481439848640523, -0.9844642643918238, -0.6776073334605686],
                [-0.9500000000000001, 8.762523965086185e-05],
            ),
            (
                [
                    vec![3.0, 1.0, 4.0, 1.0, 5.0, 9.0, 2.0, 6.0, 5.0, 3.0],
                    vec![2.0, 7.0, 1.0, 8.0, 2.0, 8.0, 1.0, 8.0, 2.0, 8.0],
                ],
                [0.10492284287735881, 0.7729913615627264, -0.561818407022287, 0.6890302986922733],
                [0.13471506281091267, 0.7106008805223829],
            ),
            (
                [long, bent],
                [0.9640876409240812, 1.7536614070121946e-23, 0.9326841550436555, 0.9809852347948427],
                [0.9883677298311446, 1.0791421856454792e-32],
            ),
        ];
        for (columns, [r, p, low, high], [rank, rank_p]) in cases {
            let cell = test_correlations(&[columns]).expect("equally long")[0];
            let linear = cell.linear.expect("a coefficient");
            assert_near(linear.coefficient, r);
            assert_near(linear.p_value, p);
            let interval = cell.interval.expect("an interval");
            assert_near(interval[0], low);
            assert_near(interval[1], high);
            let ranked = cell.rank.expect("a coefficient");
            assert_near(ranked.coefficient, rank);
            assert_near(ranked.p_value, rank_p);
        }
        // scipy.stats.pearsonr of 1000 values, and the ends.
        assert_near(correlation_p_value(0.035085348447872276, 1000).expect("one"), 0.26766763413057837);
        assert_eq!([0.0, 1.0, -1.0].map(|r| correlation_p_value(r, 9)), [Some(1.0), Some(0.0), Some(0.0)]);
        assert_eq!([(0.5, 2), (1.1, 9), (f64::NAN, 9)].map(|(r, n)| correlation_p_value(r, n)), [None; 3]);
        assert_eq!((correlation_interval(1.0, 9), correlation_interval(0.5, 3)), (Some([1.0; 2]), None));
    }

    // Printed by statsmodels 0.15.0: multipletests(p, method="fdr_bh").
    #[test]
    fn adjusted_p_values_are_those_of_statsmodels() {
        let adjusted = adjust_p_values(&[0.01, 0.03, 0.02, 0.6, 0.04, 0.001, 0.02]);
        let expected = [0.035, 0.042, 0.035, 0.6, 0.04666666666666667, 0.007, 0.035];
        adjusted.into_iter().zip(expected).for_each(|(actual, expected)| assert_near(actual, expected));
        assert!(adjust_p_values(&[]).is_empty());
    }

    #[test]
    fn few_values_have_no_coefficient() {
        let line: Vec<f64> = (0..5).map(f64::from).collect();
        let cell = test_correlations(&[[line.clone(), line]]).expect("equally long")[0];
        assert_eq!((cell.count, cell.linear, cell.interval, cell.rank), (5, None, None, None));
        assert!(!cell.is_beyond_chance());
    }

    // 15 parameters and 6 bands of 8 surfaces: normal noise has a finding in 5 % of the tables at most.
    #[test]
    fn chance_makes_no_finding() {
        let mut state = 52_u64;
        let mut uniform = || {
            // SplitMix64 (Steele, Lea and Flood 2014).
            state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
            let mut mixed = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            ((mixed ^ (mixed >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
        };
        let mut draw_columns = |count: usize| -> Vec<Vec<f64>> {
            (0..count).map(|_| (0..8).map(|_| (0..12).map(|_| uniform()).sum::<f64>() - 6.0).collect()).collect()
        };
        let tables = 1000;
        let mut found = 0;
        let mut greatest = 0.0;
        for _ in 0..tables {
            let parameters = draw_columns(15);
            let bands = draw_columns(6);
            let pairs = parameters.iter().flat_map(|x| bands.iter().map(|y| [x.clone(), y.clone()]));
            let cells = test_correlations(&pairs.collect::<Vec<_>>()).expect("equally long");
            found += usize::from(cells.iter().any(CorrelationCell::is_beyond_chance));
            let coefficients = cells.iter().filter_map(|cell| Some(cell.linear?.coefficient.abs()));
            greatest += coefficients.fold(0.0, f64::max) / f64::from(tables);
        }
        assert!(found <= 50, "{found} of {tables} tables have findings");
        assert!((greatest - 0.85).abs() < 0.02, "the greatest coefficient is {greatest}: noise, not zeros");
    }

    #[test]
    fn a_true_relation_is_found_among_noise() {
        let x: Vec<f64> = (0..12).map(f64::from).collect();
        let noise = |k: usize| -> Vec<f64> { (0..12).map(|i| ((i * 7 + k * 5) % 12) as f64).collect() };
        let y: Vec<f64> = x.iter().map(|x| -2.0 * x + (x * 2.3).sin()).collect();
        let mut columns: Vec<_> = (1..20).map(|k| [noise(k), noise(3 * k + 2)]).collect();
        columns.push([x, y]);
        let cells = test_correlations(&columns).expect("equally long");
        assert!(cells.last().is_some_and(CorrelationCell::is_beyond_chance));
    }
}
