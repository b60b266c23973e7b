//! A self-organising map: rows on a grid of units, alike rows on units that are close together.
//!
//! Trained in batches from the rows' inner products alone (Kohonen's batch map in its relational form): a unit is a
//! weighted mean of rows, so that neither units nor rows are needed feature by feature. Nothing is left to chance: rows
//! begin where their principal components put them.

use crate::components::PrincipalComponents;

/// Rounds of training.
const ROUNDS: usize = 40;
/// Width of the neighbourhood in the last round, units.
const LAST_WIDTH: f64 = 0.6;
/// Units per square root of the number of rows (Vesanto and Alhoniemi 2000).
const UNITS_PER_ROOT: f64 = 5.0;
/// Most that the grid is longer than it is wide.
const LONGEST: f64 = 2.0;

/// A trained map.
///
/// ```
/// use echolake_dsp::components::PrincipalComponents;
/// use echolake_dsp::self_organising_map::SelfOrganisingMap;
///
/// let mut rows: Vec<Vec<f32>> = (0..40).map(|i| vec![i as f32, 0.5 * i as f32, if i < 20 { 0.0 } else { 30.0
/// }]).collect(); let map = SelfOrganisingMap::from_components(&PrincipalComponents::from_rows(&mut rows, 2)?);
/// // Neighbours share a unit or are beside one another; the ends are far apart.
/// let distance = |a: [usize; 2], b: [usize; 2]| a[0].abs_diff(b[0]).max(a[1].abs_diff(b[1]));
/// assert!(distance(map.units[3], map.units[4]) <= 1);
/// assert!(distance(map.units[0], map.units[39]) >= 4);
/// # Ok::<(), echolake_dsp::Error>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct SelfOrganisingMap {
    /// Columns and rows of units.
    pub size: [usize; 2],
    /// `[rows]`: column and row of each row's unit, the nearest one.
    pub units: Vec<[usize; 2]>,
    /// `[size[1] x size[0]]`: mean distance of a unit from those beside it, row by row, in the rows' unit. Great values
    /// are borders between groups.
    pub borders: Vec<f64>,
}

impl SelfOrganisingMap {
    /// Trains a map of the rows whose components these are; without rows it has no units.
    pub fn from_components(components: &PrincipalComponents) -> Self {
        let count = components.row_count();
        let size = size_of(components);
        let [columns, rows] = size;
        let total = columns * rows;
        if total == 0 {
            return Self { size, units: Vec::new(), borders: Vec::new() };
        }
        let mut winners = first_winners(components, size);
        let first_width = (columns.max(rows) as f64 / 2.0).max(LAST_WIDTH);
        let mut units = UnitMeans::new(total, count);
        for round in 0..ROUNDS {
            let width = first_width * (LAST_WIDTH / first_width).powf(round as f64 / (ROUNDS - 1) as f64);
            units.train_round(components, &winners, size, width);
            winners = (0..count).map(|row| units.nearest_unit(components, row)).collect();
        }
        let borders = (0..total).map(|unit| units.unit_border(unit, size)).collect();
        let scale = (components.feature_count().max(1) as f64).sqrt();
        Self {
            size,
            units: winners.into_iter().map(|unit| [unit % columns, unit / columns]).collect(),
            borders: Vec::into_iter(borders).map(|border: f64| border / scale).collect(),
        }
    }
}

/// Units as weighted means of rows.
struct UnitMeans {
    count: usize,
    /// `[units x rows]`: inner products of units and rows.
    products: Vec<f64>,
    /// `[units x units]`: inner products of units.
    between: Vec<f64>,
}

impl UnitMeans {
    fn new(units: usize, count: usize) -> Self {
        Self { count, products: vec![0.0; units * count], between: vec![0.0; units * units] }
    }

    fn train_round(&mut self, components: &PrincipalComponents, winners: &[usize], size: [usize; 2], width: f64) {
        let count = self.count;
        let units = self.between.len().isqrt();
        // Sums over the rows of each unit: a mean is made of these, as the neighbourhood counts units.
        let mut sums = vec![0.0; units * count];
        let mut members = vec![0.0; units];
        for (row, unit) in winners.iter().enumerate() {
            members[*unit] += 1.0;
            let products = components.row_products(row);
            sums[unit * count..][..count].iter_mut().zip(products).for_each(|(sum, product)| *sum += product);
        }
        let place = |unit: usize| [(unit % size[0]) as f64, (unit / size[0]) as f64];
        let near = |a: usize, b: usize| {
            let ([x, y], [u, v]) = (place(a), place(b));
            (-((x - u).powi(2) + (y - v).powi(2)) / (2.0 * width * width)).exp()
        };
        let weights = |unit: usize| -> Vec<f64> {
            let raw: Vec<f64> = (0..units).map(|other| near(unit, other)).collect();
            let whole: f64 = raw.iter().zip(&members).map(|(near, members)| near * members).sum();
            raw.into_iter().map(|near| near / whole.max(f64::MIN_POSITIVE)).collect()
        };
        self.products.fill(0.0);
        let weights: Vec<Vec<f64>> = (0..units).map(weights).collect();
        for (weights, products) in weights.iter().zip(self.products.chunks_exact_mut(count)) {
            for (weight, sums) in weights.iter().zip(sums.chunks_exact(count)) {
                products.iter_mut().zip(sums).for_each(|(product, sum)| *product += weight * sum);
            }
        }
        for (products, between) in self.products.chunks_exact(count).zip(self.between.chunks_exact_mut(units)) {
            let mut of_unit = vec![0.0; units];
            winners.iter().zip(products).for_each(|(unit, product)| of_unit[*unit] += product);
            for (weights, between) in weights.iter().zip(between) {
                *between = weights.iter().zip(&of_unit).map(|(weight, sum)| weight * sum).sum();
            }
        }
    }

    fn nearest_unit(&self, components: &PrincipalComponents, row: usize) -> usize {
        let own = components.row_products(row)[row];
        let units = self.between.len().isqrt();
        let square =
            |unit: usize| own - 2.0 * self.products[unit * self.count + row] + self.between[unit * (units + 1)];
        // The first of equals.
        (0..units).min_by(|a, b| square(*a).total_cmp(&square(*b))).unwrap_or(0)
    }

    fn unit_border(&self, unit: usize, [columns, rows]: [usize; 2]) -> f64 {
        let units = columns * rows;
        let x = unit % columns;
        let y = unit / columns;
        let beside = [(x > 0, unit.wrapping_sub(1)), (x + 1 < columns, unit + 1)];
        let beside = beside.into_iter().chain([(y > 0, unit.wrapping_sub(columns)), (y + 1 < rows, unit + columns)]);
        let at = |a: usize, b: usize| self.between[a * units + b];
        let distances: Vec<f64> = beside
            .filter_map(|(is_there, other)| is_there.then_some(other))
            .map(|other| (at(unit, unit) + at(other, other) - 2.0 * at(unit, other)).max(0.0).sqrt())
            .collect();
        distances.iter().sum::<f64>() / distances.len().max(1) as f64
    }
}

// As long and wide as the first two components vary.
fn size_of(components: &PrincipalComponents) -> [usize; 2] {
    let explained = components.explained_shares();
    let [first, second] = [0, 1].map(|i| explained.get(i).copied().unwrap_or(0.0));
    let longer = if second > 0.0 { (first / second).sqrt().clamp(1.0, LONGEST) } else { LONGEST };
    let units = UNITS_PER_ROOT * (components.row_count() as f64).sqrt();
    let columns = (units * longer).sqrt().round();
    [columns as usize, (columns / longer).round() as usize]
}

// The units where the first two components put the rows.
fn first_winners(components: &PrincipalComponents, size: [usize; 2]) -> Vec<usize> {
    let places: Vec<[f64; 2]> = (0..components.row_count())
        .map(|row| {
            let position = components.row_position(row);
            [0, 1].map(|axis| position.get(axis).copied().unwrap_or(0.0))
        })
        .collect();
    let along = |axis: usize| {
        let values = places.iter().map(move |place| place[axis]);
        let (low, high) = values.fold((f64::MAX, f64::MIN), |(low, high), x| (low.min(x), high.max(x)));
        let span = high - low;
        move |place: &[f64; 2]| {
            let share = if span > 0.0 { (place[axis] - low) / span } else { 0.5 };
            (share * (size[axis] - 1) as f64).round() as usize
        }
    };
    let column = along(0);
    let row = along(1);
    places.iter().map(|place| row(place) * size[0] + column(place)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn trained(rows: &mut [Vec<f32>]) -> SelfOrganisingMap {
        SelfOrganisingMap::from_components(&PrincipalComponents::from_rows(rows, 2).expect("equally long"))
    }

    #[test]
    fn groups_have_units_of_their_own_with_a_border_between() {
        // Three groups in ten features.
        let mut rows: Vec<Vec<f32>> = (0..90)
            .map(|i| (0..10).map(|f| if f == i % 3 { 20.0 } else { ((i * 31 + f * 17) % 13) as f32 / 13.0 }).collect())
            .collect();
        let map = trained(&mut rows);
        let mut groups = vec![Vec::new(); map.size[0] * map.size[1]];
        for (i, [column, row]) in map.units.iter().enumerate() {
            groups[row * map.size[0] + column].push(i % 3);
        }
        assert!(groups.iter().all(|of_unit| of_unit.iter().all(|group| *group == of_unit[0])), "{groups:?}");
        let inside = groups.iter().filter(|of_unit| !of_unit.is_empty()).count();
        assert!(inside >= 9, "{groups:?}");
        let (least, greatest) = map.borders.iter().fold((f64::MAX, 0.0_f64), |(a, b), x| (a.min(*x), b.max(*x)));
        assert!(greatest > 5.0 * least, "{:?}", map.borders);
    }

    #[test]
    fn maps_are_the_same_each_time_and_few_rows_do_no_harm() {
        let rows = |n: usize| -> Vec<Vec<f32>> { (0..n).map(|i| vec![i as f32, (i * i % 7) as f32]).collect() };
        assert_eq!(trained(&mut rows(50)), trained(&mut rows(50)));
        for n in [1, 2, 3] {
            let map = trained(&mut rows(n));
            assert_eq!(map.units.len(), n);
            assert!(map.borders.iter().all(|border| border.is_finite()), "{map:?}");
        }
        assert_eq!(trained(&mut []).borders, Vec::<f64>::new());
        let alike = trained(&mut vec![vec![1.0; 5]; 9]);
        assert!(alike.borders.iter().all(|border| *border == 0.0), "{alike:?}");
    }
}
