//! Height maps under the symmetries of the square.

use echolake_schema::Symmetry;

use crate::Error;

/// Moves a square map of heights as [`Symmetry::move_position`] moves points about its centre: the height at p moves to
/// M p.
///
/// heights, out  `[side x side]`, row by row along x, y ascending
///
/// ```
/// let mut turned = [0; 4];
/// echolake_dsp::heights::move_heights(&[1, 2, 3, 4], echolake_schema::Symmetry::Rot90, &mut turned)?;
/// assert_eq!(turned, [3, 1, 4, 2]);
/// # Ok::<(), echolake_dsp::Error>(())
/// ```
///
/// # Errors
/// [`Error::Setting`] if they are no square, [`Error::Length`] if `out` is not as long.
pub fn move_heights<T: Copy>(heights: &[T], symmetry: Symmetry, out: &mut [T]) -> Result<(), Error> {
    let side = heights.len().isqrt();
    if side * side != heights.len() {
        let actual = format!("{} values", heights.len());
        return Err(Error::Setting { what: "the map of heights", actual, expected: "a square number of values" });
    }
    crate::error::check_len("the moved map", out.len(), heights.len())?;
    // M is orthogonal, so its transpose leads back; along a row, the place it leads to moves by a fixed step. Doubled
    // coordinates about the centre stay whole numbers.
    let [[a, b], [c, d]] = symmetry.matrix().map(|row| row.map(|x| x as isize));
    let width = side as isize;
    let last = side as isize - 1;
    let step = a + b * width;
    for (y, row) in out.chunks_exact_mut(side.max(1)).enumerate() {
        let u = -last;
        let v = 2 * y as isize - last;
        let mut from = (a * u + c * v + last) / 2 + (b * u + d * v + last) / 2 * width;
        for cell in row {
            *cell = heights[from as usize];
            from += step;
        }
    }
    Ok(())
}

/// Towards the light: the upper left, 40 degrees over the plane.
const LIGHT: [f32; 3] = [-0.54, 0.54, 0.643];
/// Grey of what the light does not reach, and how much the light adds to it.
const SHADE: f32 = 40.0;
const LIT: f32 = 225.0;
/// Slopes count twice, so that shallow reliefs are seen.
const RELIEF: f32 = 2.0;
/// Neither black nor white, which the page around may be.
const GREYS: [f32; 2] = [18.0, 250.0];

/// A relief in oblique light from the upper left, by Lambert's law, without shadows: quick, and of the same light for
/// all reliefs.
///
/// heights  `[side x side]`  mm, row by row along x, y ascending
/// pitch    mm from cell to cell
/// returns  `[side x side]`  grey, rows from the top
///
/// # Errors
/// [`Error::Setting`] if they are no square.
pub fn shade_heights(heights: &[f32], pitch_mm: f32) -> Result<Vec<u8>, Error> {
    let side = heights.len().isqrt();
    if side * side != heights.len() {
        let actual = format!("{} values", heights.len());
        return Err(Error::Setting { what: "the map of heights", actual, expected: "a square number of values" });
    }
    let mut pixels = Vec::with_capacity(heights.len());
    for y in (0..side).rev() {
        let row = |y: usize| &heights[y * side..(y + 1) * side];
        let below = row(y.saturating_sub(1));
        let here = row(y);
        let above = row((y + 1).min(side - 1));
        for x in 0..side {
            // Differences go over two cells.
            let slope = RELIEF / (2.0 * pitch_mm);
            let along_x = slope * (here[(x + 1).min(side - 1)] - here[x.saturating_sub(1)]);
            let along_y = slope * (above[x] - below[x]);
            let facing = LIGHT[2] - along_x * LIGHT[0] - along_y * LIGHT[1];
            let light = facing / (1.0 + along_x * along_x + along_y * along_y).sqrt();
            pixels.push((SHADE + LIT * light).clamp(GREYS[0], GREYS[1]) as u8);
        }
    }
    Ok(pixels)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_comes_from_the_upper_left() {
        // A ridge along y in the middle of seven columns.
        let heights: Vec<f32> = (0..49).map(|i| if i % 7 == 3 { 5.0 } else { 0.0 }).collect();
        let pixels = shade_heights(&heights, 5.0).expect("a square");
        let row = &pixels[21..28];
        assert!(row[2] > row[0], "its left side faces the light: {row:?}");
        assert!(row[4] < row[0], "its right side turns away: {row:?}");
        assert_eq!(row[0], (SHADE + LIT * LIGHT[2]) as u8, "level ground");
        // What is higher in the picture has a greater y: a slope down towards smaller y turns away from the light.
        let slope: Vec<f32> = (0..49).map(|i| (i / 7) as f32 * 5.0).collect();
        assert!(shade_heights(&slope, 5.0).expect("a square")[24] < row[0]);
        assert!(shade_heights(&[0.0; 3], 1.0).is_err());
        assert_eq!(shade_heights(&[], 1.0).expect("nothing"), Vec::<u8>::new());
    }

    #[test]
    fn cells_move_as_points_do() {
        for side in [1usize, 2, 5, 128] {
            let heights: Vec<f32> = (0..side * side).map(|i| i as f32).collect();
            let centre = (side as f64 - 1.0) / 2.0;
            for symmetry in Symmetry::ALL {
                let mut after = vec![f32::NAN; heights.len()];
                move_heights(&heights, symmetry, &mut after).expect("a square");
                for (x, y) in [(0, 0), (side / 3, 0), (side - 1, side / 2), (side / 2, side - 1)] {
                    let [u, v, _] = symmetry.move_position([x as f64 - centre, y as f64 - centre, 0.0]);
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
            move_heights(heights, symmetry, &mut out).expect("a square");
            out
        };
        for first in Symmetry::ALL {
            for second in Symmetry::ALL {
                let point = second.move_position(first.move_position([1.0, 3.0, 0.0]));
                let both =
                    Symmetry::ALL.into_iter().find(|s| s.move_position([1.0, 3.0, 0.0]) == point).expect("closed");
                assert_eq!(apply(&apply(&heights, first), second), apply(&heights, both));
            }
        }
    }

    #[test]
    fn what_is_no_square_is_refused() {
        assert!(move_heights(&[1.0; 3], Symmetry::Identity, &mut [0.0; 3]).is_err());
        assert!(move_heights(&[1.0; 4], Symmetry::Identity, &mut [0.0; 3]).is_err());
        assert_eq!(move_heights::<f64>(&[], Symmetry::Rot90, &mut []), Ok(()));
    }
}
