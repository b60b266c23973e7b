//! The bands of the lake as answers and queries name them.

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

/// Name of the total over all bands.
pub(super) const TOTAL: &str = "total";

/// The rig's bands, the total last.
pub(super) fn bands(rig: &Rig) -> Vec<BandDescription> {
    let label = |hz: f64| if hz >= 1000.0 { format!("{} kHz", hz / 1000.0) } else { format!("{hz} Hz") };
    let named = rig.band_names().into_iter().zip(&rig.bands.centres_hz);
    let bands = named.map(|(key, hz)| BandDescription { key, centre_hz: Some(*hz), label: label(*hz) });
    bands.chain([BandDescription { key: TOTAL.into(), centre_hz: None, label: "Total".into() }]).collect()
}

/// A column for each of the rig's bands and the total, as one list.
///
/// Names of bands come from `lake.toml`, and are digits.
pub(super) fn band_list(rig: &Rig, column: impl Fn(&str) -> String) -> String {
    let names = rig.band_names();
    let columns: Vec<_> = names
        .iter()
        .map(String::as_str)
        .chain([TOTAL])
        .map(|band| format!("cast({} as double)", column(band)))
        .collect();
    format!("make_array({})", columns.join(", "))
}

/// Energies over Flat's as levels; none of what has no energy.
pub(super) fn levels_db(linear: &[Option<f64>]) -> Vec<Option<f64>> {
    linear.iter().map(|x| x.filter(|x| *x > 0.0).map(|x| 10.0 * x.log10())).collect()
}
