//! What functions need to know of the lake's rig.

use echolake_schema::symmetry::MovedPair;
use echolake_schema::{Error, Grid, PointId, Rig, Symmetry};

/// Rate, bands and grid of a rig, with what the symmetries do to it.
pub(super) struct Facts {
    pub(super) rate_hz: f64,
    pub(super) centres_hz: Vec<f64>,
    pub(super) band_names: Vec<String>,
    /// By symmetry, in the order of [`Symmetry::ALL`]; None where the grid lacks it.
    points: Vec<Option<Vec<PointId>>>,
    pairs: Vec<Option<Vec<MovedPair>>>,
}

impl Facts {
    pub(super) fn of(rig: &Rig) -> Result<Self, Error> {
        let grid: Grid = rig.grid()?;
        Ok(Self {
            rate_hz: rig.sweep.rate_hz.get(),
            centres_hz: rig.bands.centres_hz.clone(),
            band_names: rig.band_names(),
            points: Symmetry::ALL.map(|s| grid.permutation(s)).into(),
            pairs: Symmetry::ALL.map(|s| grid.moved_pairs(s)).into(),
        })
    }

    /// The band of a centre, as near as decimals write it.
    pub(super) fn band(&self, centre_hz: f64) -> Option<usize> {
        self.centres_hz.iter().position(|hz| (hz / centre_hz - 1.0).abs() < 1e-3)
    }

    /// The centres, for a hint.
    pub(super) fn bands_hint(&self) -> String {
        format!("the lake's bands are at {} Hz", self.band_names.join(", "))
    }

    /// Where each point goes.
    pub(super) fn moved_points(&self, symmetry: Symmetry) -> Option<&[PointId]> {
        self.points[symmetry as usize].as_deref()
    }

    /// Where each pair goes.
    pub(super) fn moved_pairs(&self, symmetry: Symmetry) -> Option<&[MovedPair]> {
        self.pairs[symmetry as usize].as_deref()
    }
}
