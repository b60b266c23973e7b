//! Height maps under the symmetries of the square.

use echolake_schema::Symmetry;

use crate::Error;

/// Moves a square map of heights as [`Symmetry::apply`] moves points about its centre: what stood at p stands at M p.
///
/// heights, out  `[side x side]`, row by row along x, y ascending
///
/// # Errors
/// [`Error::Setting`] where they are no square, [`Error::Length`] where `out` is not as long.
pub fn moved<T: Copy>(heights: &[T], symmetry: Symmetry, out: &mut [T]) -> Result<(), Error> {
    let side = heights.len().isqrt();
    if side * side != heights.len() {
        let actual = format!("{} values", heights.len());
        return Err(Error::Setting { what: "the map of heights", actual, expected: "a square number of values" });
    }
    crate::error::check_len("the moved map", out.len(), heights.len())?;
    // M is orthogonal, so its transpose leads back; along a row, the place it leads to moves by a fixed step. Doubled
    // coordinates about the centre stay whole numbers.
    let [[a, b], [c, d]] = symmetry.matrix().map(|row| row.map(|x| x as isize));
    let (width, last) = (side as isize, side as isize - 1);
    let step = a + b * width;
    for (y, row) in out.chunks_exact_mut(side.max(1)).enumerate() {
        let (u, v) = (-last, 2 * y as isize - last);
        let mut from = (a * u + c * v + last) / 2 + (b * u + d * v + last) / 2 * width;
        for cell in row {
            *cell = heights[from as usize];
            from += step;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_move_as_points_do() {
        for side in [1usize, 2, 5, 128] {
            let heights: Vec<f32> = (0..side * side).map(|i| i as f32).collect();
            let centre = (side as f64 - 1.0) / 2.0;
            for symmetry in Symmetry::ALL {
                let mut after = vec![f32::NAN; heights.len()];
                moved(&heights, symmetry, &mut after).expect("a square");
                for (x, y) in [(0, 0), (side / 3, 0), (side - 1, side / 2), (side / 2, side - 1)] {
                    let [u, v, _] = symmetry.apply([x as f64 - centre, y as f64 - centre, 0.0]);
                    let (to_x, to_y) = ((u + centre).round() as usize, (v + centre).round() as usize);
                    assert_eq!(after[to_y * side + to_x], heights[y * side + x], "{} {side}", symmetry.name());
                }
            }
        }
    }

    // The group's table: one symmetry after another moves a map as the one that their matrices multiply to.
    #[test]
    fn symmetries_compose() {
        let heights: Vec<u32> = (0..25).collect();
        let apply = |heights: &[u32], symmetry| {
            let mut out = vec![0; heights.len()];
            moved(heights, symmetry, &mut out).expect("a square");
            out
        };
        for first in Symmetry::ALL {
            for second in Symmetry::ALL {
                let point = second.apply(first.apply([1.0, 3.0, 0.0]));
                let both = Symmetry::ALL.into_iter().find(|s| s.apply([1.0, 3.0, 0.0]) == point).expect("closed");
                assert_eq!(apply(&apply(&heights, first), second), apply(&heights, both));
            }
        }
    }

    #[test]
    fn what_is_no_square_is_refused() {
        assert!(moved(&[1.0; 3], Symmetry::Identity, &mut [0.0; 3]).is_err());
        assert!(moved(&[1.0; 4], Symmetry::Identity, &mut [0.0; 3]).is_err());
        assert_eq!(moved::<f64>(&[], Symmetry::Rot90, &mut []), Ok(()));
    }
}
