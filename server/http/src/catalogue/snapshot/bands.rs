//! The bands of the lake as answers name them.

use echolake_query::figure_rows::{band_keys, band_labels};
use echolake_schema::Rig;
use serde::Serialize;
use utoipa::ToSchema;

/// A band, or the total, which has no centre.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Band)]
pub(crate) struct BandDescription {
    /// As in column names: `2500`, ..., `total`.
    pub key: String,
    centre_hz: Option<f64>,
    /// As in pictures: `2.5 kHz`.
    pub label: String,
}

/// The rig's bands, the total last.
pub(crate) fn describe_bands(rig: &Rig) -> Vec<BandDescription> {
    let keys = band_keys(rig).into_iter();
    let centres = rig.bands.centres_hz.iter().copied().map(Some).chain([None]);
    let described = keys.zip(centres).zip(band_labels(rig));
    described.map(|((key, centre_hz), label)| BandDescription { key, centre_hz, label }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_total_is_last_and_always_there() {
        let keys = |rig: &Rig| describe_bands(rig).into_iter().map(|band| band.key).collect::<Vec<_>>();
        let mut rig = Rig::paper();
        assert_eq!(keys(&rig), ["2500", "5000", "10000", "20000", "40000", "total"]);
        // No lake has such a rig; facets sort by the last band.
        rig.bands.centres_hz.clear();
        assert_eq!(keys(&rig), ["total"]);
    }
}
