//! Rows of table `heightmaps`: the relief at 128 x 128, under each symmetry.

use arrow::record_batch::RecordBatch;
use echolake_dsp::heights::move_heights;
use echolake_schema::tables::Table;
use echolake_schema::{Rig, Symmetry};

use super::RunKeys;
use crate::error::{Error, Result};

const CELLS: usize = Table::HEIGHTMAP_CELLS;

/// Builds one row per symmetry; None if the heights are not a square.
pub(crate) fn heightmap_rows(rig: &Rig, keys: &RunKeys, heights_mm: &[f32]) -> Result<Option<RecordBatch>> {
    let side = heights_mm.len().isqrt();
    if side == 0 || side * side != heights_mm.len() {
        return Ok(None);
    }
    let small = area_mean(heights_mm, side);
    let rows = Symmetry::ALL.len();
    let mut all = vec![0.0; rows * small.len()];
    for (symmetry, out) in Symmetry::ALL.into_iter().zip(all.chunks_exact_mut(small.len())) {
        move_heights(&small, symmetry, out).map_err(|cause| Error::Kernel { file: keys.run.to_string(), cause })?;
    }
    let batch = keys
        .begin_rows(Table::Heightmaps, rig, rows)
        .push_texts("symmetry", Symmetry::ALL.map(Symmetry::name))
        .push_ints("cells", std::iter::repeat_n(CELLS as i32, rows))
        .push_floats("size_mm", std::iter::repeat_n(rig.panel.size_mm as f32, rows))
        .push_lists("heights_mm", all)
        .finish()?;
    Ok(Some(batch))
}

// Each small cell is the mean of the area it covers, first along x, then along y.
fn area_mean(heights: &[f32], side: usize) -> Vec<f32> {
    let weights = cell_weights(side);
    let narrow: Vec<f32> = heights.chunks_exact(side).flat_map(|row| shrink_line(row, &weights)).collect();
    let mut small = vec![0.0; CELLS * CELLS];
    for x in 0..CELLS {
        let column: Vec<f32> = (0..side).map(|y| narrow[y * CELLS + x]).collect();
        for (y, mean) in shrink_line(&column, &weights).into_iter().enumerate() {
            small[y * CELLS + x] = mean;
        }
    }
    small
}

/// Returns for each small cell the first large cell that it covers, and the weight of each covered cell.
fn cell_weights(side: usize) -> Vec<(usize, Vec<f64>)> {
    let scale = side as f64 / CELLS as f64;
    let weights = |cell: usize| {
        let from = cell as f64 * scale;
        let to = (cell + 1) as f64 * scale;
        let first = from.floor() as usize;
        let last = (to.ceil() as usize).min(side);
        let share = |i: usize| ((to.min((i + 1) as f64) - from.max(i as f64)) / scale).max(0.0);
        (first, (first..last).map(share).collect())
    };
    (0..CELLS).map(weights).collect()
}

fn shrink_line(line: &[f32], weights: &[(usize, Vec<f64>)]) -> Vec<f32> {
    let mean = |(first, shares): &(usize, Vec<f64>)| {
        line[*first..].iter().zip(shares).map(|(h, share)| f64::from(*h) * share).sum::<f64>() as f32
    };
    weights.iter().map(mean).collect()
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
}
