//! Facts of the lake's rig that functions need.

use echolake_schema::symmetry::MovedPair;
use echolake_schema::{Error, Grid, PointId, Rig, Symmetry};

/// Rate, bands and grid of a rig, with the images of points and pairs under the symmetries.
pub(crate) struct RigFacts {
    pub rate_hz: f64,
    pub centres_hz: Vec<f64>,
    pub band_names: Vec<String>,
    /// By symmetry, in the order of [`Symmetry::ALL`]; None if the grid lacks it.
    points: Vec<Option<Vec<PointId>>>,
    pairs: Vec<Option<Vec<MovedPair>>>,
}

impl RigFacts {
    pub fn from_rig(rig: &Rig) -> Result<Self, Error> {
        let grid: Grid = rig.build_grid()?;
        Ok(Self {
            rate_hz: rig.sweep.rate_hz.get(),
            centres_hz: rig.bands.centres_hz.clone(),
            band_names: rig.band_names(),
            points: Symmetry::ALL.map(|s| grid.point_permutation(s)).into(),
            pairs: Symmetry::ALL.map(|s| grid.moved_pairs(s)).into(),
        })
    }

    /// Returns the band with this centre, within the rounding of decimals.
    pub fn band_index(&self, centre_hz: f64) -> Option<usize> {
        self.centres_hz.iter().position(|hz| (hz / centre_hz - 1.0).abs() < 1e-3)
    }

    /// Returns the centres, for a hint.
    pub fn bands_hint(&self) -> String {
        format!("the lake's bands are at {} Hz", self.band_names.join(", "))
    }

    /// Returns the image of each point.
    pub fn moved_points(&self, symmetry: Symmetry) -> Option<&[PointId]> {
        self.points[symmetry as usize].as_deref()
    }

    /// Returns the image of each pair.
    pub fn moved_pairs(&self, symmetry: Symmetry) -> Option<&[MovedPair]> {
        self.pairs[symmetry as usize].as_deref()
    }
}
