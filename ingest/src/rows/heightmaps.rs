//! Rows of table `heightmaps`: the relief at 128 x 128, under each symmetry.

use arrow::record_batch::RecordBatch;
use echolake_schema::tables::Table;
use echolake_schema::{Rig, Symmetry};

use super::{Columns, Keys};
use crate::CODE_VERSION;
use crate::error::Result;

const CELLS: usize = Table::HEIGHTMAP_CELLS;

/// A row a symmetry; none where the heights are no square.
pub(crate) fn rows(rig: &Rig, keys: &Keys, heights_mm: &[f32]) -> Result<Option<RecordBatch>> {
    let side = heights_mm.len().isqrt();
    if side == 0 || side * side != heights_mm.len() {
        return Ok(None);
    }
    let small = area_mean(heights_mm, side);
    let all: Vec<f32> = Symmetry::ALL.into_iter().flat_map(|s| moved(&small, s)).collect();
    let rows = Symmetry::ALL.len();
    let mut columns = Columns::of_run(Table::Heightmaps, rows, keys);
    columns
        .texts(Symmetry::ALL.map(|s| Some(s.name())))
        .ints(std::iter::repeat_n(Some(CELLS as i32), rows))
        .floats(std::iter::repeat_n(Some(rig.panel.size_mm as f32), rows))
        .lists(all)
        .same(CODE_VERSION);
    columns.finish(rig).map(Some)
}

// Each small cell is the mean of what it covers, first along x, then along y.
fn area_mean(heights: &[f32], side: usize) -> Vec<f32> {
    let weights = weights(side);
    let narrow: Vec<f32> = heights.chunks_exact(side).flat_map(|row| shrink(row, &weights)).collect();
    let mut small = vec![0.0; CELLS * CELLS];
    for x in 0..CELLS {
        let column: Vec<f32> = (0..side).map(|y| narrow[y * CELLS + x]).collect();
        for (y, mean) in shrink(&column, &weights).into_iter().enumerate() {
            small[y * CELLS + x] = mean;
        }
    }
    small
}

/// For each small cell: the first large cell that it covers, and how much of each.
fn weights(side: usize) -> Vec<(usize, Vec<f64>)> {
    let scale = side as f64 / CELLS as f64;
    let weights = |cell: usize| {
        let (from, to) = (cell as f64 * scale, (cell + 1) as f64 * scale);
        let first = from.floor() as usize;
        let last = (to.ceil() as usize).min(side);
        let share = |i: usize| ((to.min((i + 1) as f64) - from.max(i as f64)) / scale).max(0.0);
        (first, (first..last).map(share).collect())
    };
    (0..CELLS).map(weights).collect()
}

fn shrink(line: &[f32], weights: &[(usize, Vec<f64>)]) -> Vec<f32> {
    let mean = |(first, shares): &(usize, Vec<f64>)| {
        line[*first..].iter().zip(shares).map(|(h, share)| f64::from(*h) * share).sum::<f64>() as f32
    };
    weights.iter().map(mean).collect()
}

// The height at p stands at M p afterwards; M is orthogonal, so its transpose leads back.
fn moved(heights: &[f32], symmetry: Symmetry) -> Vec<f32> {
    let [[a, b], [c, d]] = symmetry.matrix();
    let last = CELLS as i32 - 1;
    let at = |x: i32, y: i32| heights[(y as usize) * CELLS + x as usize];
    let mut out = Vec::with_capacity(CELLS * CELLS);
    for y in 0..CELLS as i32 {
        for x in 0..CELLS as i32 {
            // Doubled coordinates about the centre stay whole numbers.
            let (u, v) = (2 * x - last, 2 * y - last);
            out.push(at((a * u + c * v + last) / 2, (b * u + d * v + last) / 2));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shrinking_keeps_the_mean_and_a_slope() {
        for side in [128, 274, 300, 512, 100] {
            let slope: Vec<f32> = (0..side * side).map(|i| (i % side) as f32 / side as f32).collect();
            let small = area_mean(&slope, side);
            let mean = |h: &[f32]| h.iter().map(|x| f64::from(*x)).sum::<f64>() / h.len() as f64;
            assert!((mean(&small) - mean(&slope)).abs() < 1e-5, "{side}");
            assert!(small[..CELLS].windows(2).all(|w| w[1] >= w[0]), "{side}");
        }
    }

    #[test]
    fn symmetries_move_cells_as_they_move_points() {
        let heights: Vec<f32> = (0..CELLS * CELLS).map(|i| i as f32).collect();
        let centre = (CELLS as f64 - 1.0) / 2.0;
        for symmetry in Symmetry::ALL {
            let after = moved(&heights, symmetry);
            for (x, y) in [(0, 0), (5, 0), (127, 3), (64, 100)] {
                let [u, v, _] = symmetry.apply([x as f64 - centre, y as f64 - centre, 0.0]);
                let (to_x, to_y) = ((u + centre).round() as usize, (v + centre).round() as usize);
                assert_eq!(after[to_y * CELLS + to_x], heights[y * CELLS + x], "{}", symmetry.name());
            }
        }
    }
}
