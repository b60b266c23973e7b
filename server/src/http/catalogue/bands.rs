//! The bands of the lake as answers name them.

use echolake_query::figure_rows::{TOTAL_BAND, band_labels};
use echolake_schema::Rig;
use serde::Serialize;
use utoipa::ToSchema;

/// A band, or the total, which has no centre.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Band)]
pub(super) struct BandDescription {
    /// As in column names: `2500`, ..., `total`.
    pub(super) key: String,
    centre_hz: Option<f64>,
    /// As in pictures: `2.5 kHz`.
    pub(super) label: String,
}

/// The rig's bands, the total last.
pub(super) fn bands(rig: &Rig) -> Vec<BandDescription> {
    let keys = rig.band_names().into_iter().chain([TOTAL_BAND.to_owned()]);
    let centres = rig.bands.centres_hz.iter().copied().map(Some).chain([None]);
    let described = keys.zip(centres).zip(band_labels(rig));
    described.map(|((key, centre_hz), label)| BandDescription { key, centre_hz, label }).collect()
}
