//! Pictures of reliefs: what a raking lamp at the upper left shows, with the shade of what lies deep.

use super::HeightField;

/// Towards the lamp: from the left, above, and 30 degrees over the wall.
const LAMP: [f64; 3] = [-0.55, 0.67, 0.5];
/// Directions in which the sky is looked for, and how far away, in cells.
const DIRECTIONS: [[f64; 2]; 8] = [
    [1.0, 0.0],
    [0.707, 0.707],
    [0.0, 1.0],
    [-0.707, 0.707],
    [-1.0, 0.0],
    [-0.707, -0.707],
    [0.0, -1.0],
    [0.707, -0.707],
];
const STEPS: [f64; 9] = [1.0, 2.0, 3.5, 6.0, 9.0, 14.0, 21.0, 32.0, 48.0];
/// A shadow is followed this far, in cells: the deepest relief's.
const SHADOW: u32 = 96;
/// Cells along each side of a pixel: joints of two pixels would flicker otherwise.
const OVERSAMPLING: usize = 2;
/// Shares of the sky's and the lamp's light: a level wall is at 0.55.
const SKY: f64 = 0.2;
const LAMPLIGHT: f64 = 0.7;
/// The screen's answer to light, with more contrast than nature has.
const GAMMA: f64 = 1.0 / 1.6;
/// Shadows are this soft: tangent over which the lamp goes.
const SOFTNESS: f64 = 0.15;

impl HeightField {
    /// Returns a grey picture with as many rows as columns, rows from the top; a pixel is two cells wide and high.
    pub fn to_pixels(&self) -> Vec<u8> {
        let width = self.cells() / OVERSAMPLING;
        let top = f64::from(self.extent_mm()[1]);
        let mut pixels = Vec::with_capacity(width * width);
        for row in (0..width).rev() {
            pixels.extend((0..width).map(|column| self.pixel_value(column, row, top)));
        }
        pixels
    }

    fn pixel_value(&self, column: usize, row: usize, top: f64) -> u8 {
        let within = (0..OVERSAMPLING).flat_map(|j| (0..OVERSAMPLING).map(move |i| (i, j)));
        let light: f64 =
            within.map(|(i, j)| self.light_at(column * OVERSAMPLING + i, row * OVERSAMPLING + j, top)).sum();
        let light = light / (OVERSAMPLING * OVERSAMPLING) as f64;
        (255.0 * light.clamp(0.0, 1.0).powf(GAMMA)).round() as u8
    }

    fn light_at(&self, ix: usize, iy: usize, top: f64) -> f64 {
        let [sx, sy] = self.gradient_at(ix, iy).map(f64::from);
        let along = LAMP[2] - sx * LAMP[0] - sy * LAMP[1];
        let facing = (along / (1.0 + sx * sx + sy * sy).sqrt()).max(0.0);
        SKY * self.open_sky(ix, iy) + if facing > 0.0 { LAMPLIGHT * facing * self.lit_share(ix, iy, top) } else { 0.0 }
    }

    /// Tangent of the horizon's angle.
    fn horizon_tangent(&self, ix: usize, iy: usize, [dx, dy]: [f64; 2], steps: impl Iterator<Item = f64>) -> f64 {
        let here = f64::from(self.cell_height(ix, iy));
        let pitch = self.pitch_mm();
        let last = (self.cells() - 1) as f64;
        let mut highest = 0.0f64;
        for step in steps {
            let x = (ix as f64 + dx * step).round();
            let y = (iy as f64 + dy * step).round();
            if x < 0.0 || y < 0.0 || x > last || y > last {
                break;
            }
            let rise = f64::from(self.cell_height(x as usize, y as usize)) - here;
            highest = highest.max(rise / (step * pitch));
        }
        highest
    }

    /// Share of the sky that is seen.
    fn open_sky(&self, ix: usize, iy: usize) -> f64 {
        let seen = |direction| {
            let tangent = self.horizon_tangent(ix, iy, direction, STEPS.into_iter());
            1.0 - tangent / (1.0 + tangent * tangent).sqrt()
        };
        DIRECTIONS.into_iter().map(seen).sum::<f64>() / DIRECTIONS.len() as f64
    }

    /// Share of the lamp that is seen.
    fn lit_share(&self, ix: usize, iy: usize, top: f64) -> f64 {
        let level = (LAMP[0] * LAMP[0] + LAMP[1] * LAMP[1]).sqrt();
        // What is farther away than this cannot reach up to the light.
        let far = (top - f64::from(self.cell_height(ix, iy))) / self.pitch_mm() * level / (LAMP[2] - SOFTNESS * level);
        let steps = 1..SHADOW.min(far as u32 + 2);
        let horizon = self.horizon_tangent(ix, iy, [LAMP[0] / level, LAMP[1] / level], steps.map(f64::from));
        (0.5 - (horizon - LAMP[2] / level) / SOFTNESS).clamp(0.0, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // A step that faces the lamp is brighter than level ground, one that turns away darker, and its foot lies in shade.
    #[test]
    fn light_comes_from_the_upper_left() {
        let ridge = HeightField::from_fn(100.0, 100, |x, _| if x.abs() < 20.0 { 10.0 } else { 0.0 });
        let level = ridge.light_at(5, 50, 10.0);
        assert!(ridge.light_at(29, 50, 10.0) > level, "towards the lamp");
        assert!(ridge.light_at(70, 50, 10.0) < level, "away from the lamp");
        assert!(ridge.light_at(76, 50, 10.0) < level, "in the shadow");
        let plane = HeightField::from_fn(100.0, 100, |_, _| 0.0);
        assert_eq!(ridge.light_at(50, 50, 10.0), plane.light_at(50, 50, 0.0));
        assert_eq!(plane.to_pixels().len(), 50 * 50, "a pixel for four cells");
    }
}
