//! A square field of heights, its picture and its NumPy file.

use std::f64::consts::TAU;

mod picture;

/// Heights in mm over a square, at the centres of its cells; origin at the square's centre.
///
/// ```
/// let field = echolake_dsp::height_field::HeightField::from_fn(100.0, 4, |x, _| x / 10.0);
/// assert_eq!((field.pitch_mm(), field.extent_mm()), (25.0, [-3.75, 3.75]));
/// assert!((field.height_at(20.0, 0.0) - 2.0).abs() < 1e-9);
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct HeightField {
    size_mm: f64,
    cells: usize,
    heights_mm: Vec<f32>,
}

impl HeightField {
    /// Heights given by a function of x and y, mm. At least two cells a side are made.
    pub fn from_fn(size_mm: f64, cells: usize, mut height: impl FnMut(f64, f64) -> f64) -> Self {
        let cells = cells.max(2);
        let at = |i: usize| ((i as f64 + 0.5) / cells as f64 - 0.5) * size_mm;
        let mut heights_mm = Vec::with_capacity(cells * cells);
        for iy in 0..cells {
            heights_mm.extend((0..cells).map(|ix| height(at(ix), at(iy)) as f32));
        }
        Self { size_mm, cells, heights_mm }
    }

    /// Heights `[cells x cells]`, row by row along x with y ascending, mm; None if they are no square of two cells a
    /// side or more, or not all finite.
    pub fn from_rows(size_mm: f64, heights_mm: Vec<f32>) -> Option<Self> {
        let cells = heights_mm.len().isqrt();
        let is_field = cells > 1 && cells * cells == heights_mm.len() && heights_mm.iter().all(|h| h.is_finite());
        is_field.then_some(Self { size_mm, cells, heights_mm })
    }

    /// The same field, higher by this, mm.
    pub fn raised_by(mut self, mm: f64) -> Self {
        self.heights_mm.iter_mut().for_each(|h| *h = (f64::from(*h) + mm) as f32);
        self
    }

    /// Edge of the square, mm.
    pub fn size_mm(&self) -> f64 {
        self.size_mm
    }

    /// Cells along each side.
    pub fn cells(&self) -> usize {
        self.cells
    }

    /// `[cells x cells]`, row by row along x, y ascending.
    pub fn heights_mm(&self) -> &[f32] {
        &self.heights_mm
    }

    /// Edge of a cell, mm.
    pub fn pitch_mm(&self) -> f64 {
        self.size_mm / self.cells as f64
    }

    /// Coordinate of a cell's centre along either axis, mm.
    pub fn centre_mm(&self, index: usize) -> f64 {
        ((index as f64 + 0.5) / self.cells as f64 - 0.5) * self.size_mm
    }

    /// Height of a cell, mm.
    pub fn cell_height(&self, ix: usize, iy: usize) -> f32 {
        self.heights_mm[iy * self.cells + ix]
    }

    /// Slope of a cell along x and y, from its neighbours.
    pub fn gradient_at(&self, ix: usize, iy: usize) -> [f32; 2] {
        let last = self.cells - 1;
        let pitch = self.pitch_mm() as f32;
        let left = ix.saturating_sub(1);
        let right = (ix + 1).min(last);
        let below = iy.saturating_sub(1);
        let above = (iy + 1).min(last);
        [
            (self.cell_height(right, iy) - self.cell_height(left, iy)) / (pitch * (right - left) as f32),
            (self.cell_height(ix, above) - self.cell_height(ix, below)) / (pitch * (above - below) as f32),
        ]
    }

    /// Height at a place, linear between the cells' centres and level beyond the outermost, mm.
    pub fn height_at(&self, x_mm: f64, y_mm: f64) -> f64 {
        let position = |v: f64| {
            let at = ((v / self.size_mm + 0.5) * self.cells as f64 - 0.5).clamp(0.0, (self.cells - 1) as f64);
            let low = (at.floor() as usize).min(self.cells - 2);
            (low, at - low as f64)
        };
        let ((ix, u), (iy, v)) = (position(x_mm), position(y_mm));
        let h = |i, j| f64::from(self.cell_height(i, j));
        let lower = h(ix, iy) * (1.0 - u) + h(ix + 1, iy) * u;
        let upper = h(ix, iy + 1) * (1.0 - u) + h(ix + 1, iy + 1) * u;
        lower * (1.0 - v) + upper * v
    }

    /// Area of the relief over that of its plane: of the facets between the cells' centres.
    pub fn area_ratio(&self) -> f64 {
        let pitch = self.pitch_mm();
        let last = self.cells - 1;
        let facet = |ix: usize, iy: usize| {
            let h = |i, j| f64::from(self.cell_height(i, j));
            let [near, right, above, far] = [h(ix, iy), h(ix + 1, iy), h(ix, iy + 1), h(ix + 1, iy + 1)];
            let triangle = |x: f64, y: f64| (1.0 + (x * x + y * y) / (pitch * pitch)).sqrt() / 2.0;
            triangle(right - near, above - near) + triangle(far - above, far - right)
        };
        let sum: f64 = (0..last * last).map(|at| facet(at % last, at / last)).sum();
        sum / (last * last) as f64
    }

    /// Root mean square of the heights beside their mean over squares of this width around them, mm: of what is
    /// narrower. Squares end at the field's edges.
    pub fn detail_rms_mm(&self, width_mm: f64) -> f64 {
        let cells = self.cells;
        let reach = ((width_mm / self.pitch_mm() - 1.0) / 2.0).round().clamp(0.0, cells as f64) as usize;
        let span = |i: usize| i.saturating_sub(reach)..(i + reach + 1).min(cells);
        // Sums over all cells below and left.
        let mut sums = vec![0.0; (cells + 1) * (cells + 1)];
        for iy in 0..cells {
            let mut row = 0.0;
            for ix in 0..cells {
                row += f64::from(self.cell_height(ix, iy));
                sums[(iy + 1) * (cells + 1) + ix + 1] = sums[iy * (cells + 1) + ix + 1] + row;
            }
        }
        let sum = |ix: usize, iy: usize| sums[iy * (cells + 1) + ix];
        let mut squares = 0.0;
        for iy in 0..cells {
            let rows = span(iy);
            for ix in 0..cells {
                let columns = span(ix);
                let inside = sum(columns.end, rows.end) - sum(columns.start, rows.end) - sum(columns.end, rows.start)
                    + sum(columns.start, rows.start);
                let mean = inside / (columns.len() * rows.len()) as f64;
                squares += (f64::from(self.cell_height(ix, iy)) - mean).powi(2);
            }
        }
        (squares / (cells * cells) as f64).sqrt()
    }

    /// Phase of the details that are narrower than a wavelength: their root mean square times 2 pi over the wavelength,
    /// rad. None if cells are half a wavelength wide, which show nothing within one.
    pub fn detail_phase(&self, wavelength_mm: f64) -> Option<f64> {
        let phase = TAU / wavelength_mm * self.detail_rms_mm(wavelength_mm);
        (wavelength_mm > 2.0 * self.pitch_mm()).then_some(phase)
    }

    /// A NumPy file of the heights, `[cells x cells]` f32, mm, rows along x with y ascending.
    pub fn to_npy(&self) -> Vec<u8> {
        let shape = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({0}, {0}), }}", self.cells);
        // NPY 1.0: magic, version, length of the header; the data begin at a multiple of 64.
        let len = (shape.len() + 11).next_multiple_of(64) - 10;
        let mut file = b"\x93NUMPY\x01\x00".to_vec();
        file.extend((len as u16).to_le_bytes());
        file.extend(format!("{shape:<width$}\n", width = len - 1).into_bytes());
        file.extend(self.heights_mm.iter().flat_map(|h| h.to_le_bytes()));
        file
    }

    /// Lowest and highest height, mm.
    pub fn extent_mm(&self) -> [f32; 2] {
        let low = self.heights_mm.iter().copied().fold(f32::INFINITY, f32::min);
        let high = self.heights_mm.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        [low, high]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numpy_files_hold_the_heights() {
        let plane = HeightField::from_fn(100.0, 7, |x, y| x + y / 7.0);
        let read = ndarray_npy::ReadNpyExt::read_npy(plane.to_npy().as_slice());
        let again: ndarray::Array2<f32> = read.expect("its own file");
        assert_eq!((again.nrows(), again.ncols()), (7, 7));
        assert!(again.iter().eq(plane.heights_mm()));
    }

    #[test]
    fn details_are_what_is_narrower() {
        let stripes = HeightField::from_fn(100.0, 100, |x, _| if x.floor() as i64 % 2 == 0 { 2.0 } else { 0.0 });
        // Over three cells the mean is a third of the height off the middle.
        for (width_mm, expected) in [(1.0, 0.0), (3.0, 4.0 / 3.0), (51.0, 1.0)] {
            let rms = stripes.detail_rms_mm(width_mm);
            assert!((rms - expected).abs() < 0.02, "{width_mm}: {rms}");
        }
        let whole = HeightField::from_fn(100.0, 7, |x, y| x - y / 2.0);
        let slope = HeightField::from_fn(100.0, 100, |x, _| 0.01 * x);
        assert!(slope.detail_rms_mm(9.0) < 0.02 && (whole.detail_rms_mm(1e6) - 31.94).abs() < 0.1);
    }

    #[test]
    fn a_plane_keeps_its_slope_and_heights() {
        let plane = HeightField::from_fn(100.0, 50, |x, y| 0.1 * x - 0.2 * y);
        for (ix, iy) in [(0, 0), (10, 30), (49, 49)] {
            let [dx, dy] = plane.gradient_at(ix, iy);
            assert!((dx - 0.1).abs() < 1e-5 && (dy + 0.2).abs() < 1e-5, "{dx} {dy}");
        }
        assert!((plane.height_at(12.3, -4.5) - (1.23 + 0.9)).abs() < 1e-4);
        assert_eq!(plane.height_at(1e9, 0.0), plane.height_at(49.0, 0.0));
    }
}
