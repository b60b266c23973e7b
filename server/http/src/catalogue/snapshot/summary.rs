//! All surfaces in short, read once per snapshot and cached: the input of facets, map and correlations.

use std::collections::HashMap;

use serde::{Deserialize, Deserializer, Serialize};
use serde_json::{Map, Value};
use utoipa::ToSchema;

use super::bands::BandDescription;

/// Typology of references.
const REFERENCE: &str = "reference";
/// Nanoseconds of a day.
const DAY_NS: f64 = 86_400e9;

/// A surface as the pages know it.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Surface)]
pub(crate) struct SurfaceSummary {
    pub surface_id: String,
    pub run_id: Option<String>,
    panel: String,
    side: Option<i32>,
    pub typology: String,
    pub macrostructure: Option<String>,
    pub mesostructure: Option<String>,
    microstructure: Option<String>,
    pub material: String,
    pub flat_reference: String,
    pub foam_reference: String,
    pub origin: String,
    #[schema(format = DateTime)]
    started: Option<String>,
    relief_min_mm: Option<f64>,
    relief_max_mm: Option<f64>,
    pub relief_rms_mm: Option<f64>,
    /// Mean TNCE of the values up to the 90th percentile, dB re Flat total, mean over the runs, without Foam's own
    /// reflection unless `has_foam`. One value per band in the order of `lake.bands`, the total last; null if there is
    /// no value.
    pub level_db: Vec<Option<f64>>,
    /// `level_db` less that of the surface's Flat.
    pub against_flat_db: Vec<Option<f64>>,
    /// Standard uncertainty of `level_db` and of `against_flat_db`, dB, by noise, subtraction, air and the estimate of
    /// Foam's reflection, of the runs and of Flat's, and by repositioning if both have several runs; null if it is not
    /// known.
    pub level_u_db: Vec<Option<f64>>,
    /// Levels hold Foam's own reflection, which is not known.
    pub has_foam: bool,
    /// Standard deviation of the pairs' TNCE in dB, by band as `level_db`.
    pub spread_db: Vec<Option<f64>>,
}

impl SurfaceSummary {
    /// Returns whether it is a reference, which is no design.
    pub fn is_reference(&self) -> bool {
        self.typology == REFERENCE
    }

    /// Returns whether it has levels, which need its Flat and Foam.
    pub fn has_levels(&self) -> bool {
        self.level_db.iter().any(Option::is_some)
    }

    /// Returns whether it is the Foam that is subtracted from it, which leaves nothing.
    pub fn is_foam(&self) -> bool {
        self.surface_id == self.foam_reference
    }
}

/// A surface, and what it is found and compared by.
pub(crate) struct SurfaceEntry {
    pub surface: SurfaceSummary,
    /// Parameters of its relief's generator.
    pub parameters: Map<String, Value>,
    pub mesh_triangles: Option<i64>,
    pub mesh_watertight: Option<bool>,
    pub reflection_factor: Option<f64>,
    /// Start of its run, days since 1970.
    pub day: Option<f64>,
    /// The searched text, in lower case.
    pub words: String,
}

impl SurfaceEntry {
    /// From the lowest to the highest point.
    pub fn relief_range_mm(&self) -> Option<f64> {
        Some(self.surface.relief_max_mm? - self.surface.relief_min_mm?)
    }
}

/// All surfaces, by name.
pub(crate) struct CatalogueSummary {
    pub bands: Vec<BandDescription>,
    pub entries: Vec<SurfaceEntry>,
    places: HashMap<String, usize>,
}

/// A surface and the start of its run.
#[derive(Deserialize)]
pub(crate) struct SurfaceRow {
    surface_id: String,
    run_id: Option<String>,
    panel: String,
    side: Option<i32>,
    typology: String,
    macrostructure: Option<String>,
    mesostructure: Option<String>,
    microstructure: Option<String>,
    material: Option<String>,
    flat_reference: String,
    foam_reference: String,
    parameters: Option<String>,
    mesh_triangles: Option<i64>,
    mesh_watertight: Option<bool>,
    reflection_factor: Option<f64>,
    #[serde(deserialize_with = "decimal")]
    relief_min_mm: Option<f64>,
    #[serde(deserialize_with = "decimal")]
    relief_max_mm: Option<f64>,
    #[serde(deserialize_with = "decimal")]
    relief_rms_mm: Option<f64>,
    origin: String,
    started: Option<String>,
    started_ns: Option<i64>,
}

// A number of single precision as tables show it, so that a filter by 0.1 finds 0.1: not 0.10000000149.
fn decimal<'de, D: Deserializer<'de>>(column: D) -> Result<Option<f64>, D::Error> {
    let number = Option::<f32>::deserialize(column)?;
    Ok(number.map(|x| x.to_string().parse().unwrap_or(f64::from(x))))
}

/// Level and spread of a surface in a band.
#[derive(Deserialize)]
pub(crate) struct BandStatistic {
    surface_id: String,
    band: String,
    shown_db: Option<f64>,
    shown_against_flat_db: Option<f64>,
    shown_u_db: Option<f64>,
    has_foam: bool,
    spread_db: Option<f64>,
}

/// Statistics of a surface by band.
type SurfaceLevels = HashMap<String, HashMap<String, BandStatistic>>;

/// The query of [`SurfaceRow`].
pub(crate) const SURFACES: &str = "select s.surface_id, s.run_id, s.panel, s.side, s.typology, s.macrostructure, \
    s.mesostructure, s.microstructure, s.material, s.flat_reference, s.foam_reference, s.parameters, s.mesh_triangles, \
    s.mesh_watertight, s.reflection_factor, s.relief_min_mm, s.relief_max_mm, s.relief_rms_mm, s.origin, r.started, \
    r.started_ns from surfaces s left join runs r on r.run_id = s.run_id order by s.surface_id, s.run_id";
/// The query of [`BandStatistic`].
pub(crate) const BAND_STATISTICS: &str =
    "select surface_id, band, shown_db, shown_against_flat_db, shown_u_db, has_foam, spread_db from levels";

impl CatalogueSummary {
    /// The surfaces of the rows of [`SURFACES`] with the statistics of [`BAND_STATISTICS`].
    pub fn new(rows: Vec<SurfaceRow>, statistics: Vec<BandStatistic>, bands: Vec<BandDescription>) -> Self {
        let mut levels = SurfaceLevels::new();
        for stat in statistics {
            levels.entry(stat.surface_id.clone()).or_default().insert(stat.band.clone(), stat);
        }
        // The newest of several rows counts, as run names sort by time.
        let newest: HashMap<_, _> = rows.into_iter().map(|row| (row.surface_id.clone(), row)).collect();
        let mut entries: Vec<_> = newest.into_values().map(|row| surface_entry(row, &levels, &bands)).collect();
        entries.sort_by(|a, b| a.surface.surface_id.cmp(&b.surface.surface_id));
        let places = entries.iter().enumerate().map(|(i, e)| (e.surface.surface_id.clone(), i)).collect();
        Self { bands, entries, places }
    }

    /// The surface of a name.
    pub fn find_entry(&self, surface: &str) -> Option<&SurfaceEntry> {
        self.places.get(surface).map(|place| &self.entries[*place])
    }
}

fn surface_entry(row: SurfaceRow, levels: &SurfaceLevels, bands: &[BandDescription]) -> SurfaceEntry {
    let of_surface = levels.get(&row.surface_id);
    let own: Vec<_> = bands.iter().map(|band| of_surface.and_then(|own| own.get(&band.key))).collect();
    let parameters = row.parameters.unwrap_or_default();
    let some = |text: &Option<String>| text.clone().unwrap_or_default();
    let words = [
        &row.surface_id,
        &row.panel,
        &row.typology,
        &some(&row.macrostructure),
        &some(&row.mesostructure),
        &some(&row.microstructure),
        &some(&row.material),
        &parameters,
    ];
    SurfaceEntry {
        words: words.map(|w| w.to_lowercase()).join(" "),
        parameters: serde_json::from_str(&parameters).unwrap_or_default(),
        mesh_triangles: row.mesh_triangles,
        mesh_watertight: row.mesh_watertight,
        reflection_factor: row.reflection_factor,
        day: row.started_ns.map(|ns| ns as f64 / DAY_NS),
        surface: SurfaceSummary {
            surface_id: row.surface_id,
            run_id: row.run_id,
            panel: row.panel,
            side: row.side,
            typology: row.typology,
            macrostructure: row.macrostructure,
            mesostructure: row.mesostructure,
            microstructure: row.microstructure,
            material: row.material.unwrap_or_default(),
            flat_reference: row.flat_reference,
            foam_reference: row.foam_reference,
            origin: row.origin,
            started: row.started,
            relief_min_mm: row.relief_min_mm,
            relief_max_mm: row.relief_max_mm,
            relief_rms_mm: row.relief_rms_mm,
            level_db: own.iter().map(|own| (*own)?.shown_db).collect(),
            against_flat_db: own.iter().map(|own| (*own)?.shown_against_flat_db).collect(),
            level_u_db: own.iter().map(|own| (*own)?.shown_u_db).collect(),
            has_foam: own.iter().flatten().any(|own| own.has_foam),
            spread_db: own.iter().map(|own| (*own)?.spread_db).collect(),
        },
    }
}
