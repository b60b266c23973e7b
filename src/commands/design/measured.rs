//! Figures of the lake's surfaces, as a design's target and beside its candidates.

use std::collections::BTreeMap;

use anyhow::Context as _;
use echolake_lake::Lake;
use echolake_query::Session;
use echolake_schema::SurfaceId;
use serde::Deserialize;

use super::target::{DesignGoal, FigureKind};

/// A surface of the lake.
#[derive(Debug, Clone)]
pub(super) struct MeasuredPanel {
    pub surface_id: String,
    pub origin: String,
    /// Relief by name, and its parameters as JSON; empty if they are not known.
    pub relief: String,
    pub parameters: String,
    /// Level over Flat in dB, spread in dB, scattering; by band.
    pub bands: Vec<[Option<f64>; 3]>,
}

#[derive(Deserialize)]
struct FigureRow {
    surface_id: String,
    origin: String,
    relief: Option<String>,
    parameters: Option<String>,
    band: String,
    level_db: Option<f64>,
    spread_db: Option<f64>,
    scattering: Option<f64>,
}

impl MeasuredPanel {
    /// Returns a figure of it.
    pub fn figure_of(&self, goal: &DesignGoal) -> Option<f64> {
        let [level, spread, scattering] = self.bands[goal.band];
        match goal.kind {
            FigureKind::Level => level,
            FigureKind::Spread => spread,
            FigureKind::Scattering => scattering,
        }
    }

    /// Returns its levels over Flat, dB.
    pub fn levels_db(&self) -> Vec<Option<f64>> {
        self.bands.iter().map(|[level, ..]| *level).collect()
    }
}

/// Reads the figures of the surfaces of a lake, their own references apart.
pub(super) async fn read_measured(lake: &Lake, bands: &[String]) -> anyhow::Result<Vec<MeasuredPanel>> {
    let session = Session::new(lake)?;
    // Foam's own reflection is taken away from both or from none.
    let sql = "select s.surface_id, s.origin, s.mesostructure as relief, s.parameters, l.band, \
               l.shown_against_flat_db as level_db, l.spread_db, t.scattering from surfaces s \
               join levels l on l.surface_id = s.surface_id \
               join (select surface_id, band, avg(scattering) as scattering from surface_stats \
               group by surface_id, band) t on t.surface_id = l.surface_id and t.band = l.band \
               where s.surface_id <> s.flat_reference and s.surface_id <> s.foam_reference and l.band_hz is not null \
               order by s.surface_id";
    let rows: Vec<FigureRow> = super::super::sql::query_rows(&session, sql).await?;
    let mut panels: BTreeMap<String, MeasuredPanel> = BTreeMap::new();
    for row in rows {
        let panel = panels.entry(row.surface_id.clone()).or_insert_with(|| MeasuredPanel {
            surface_id: row.surface_id,
            origin: row.origin,
            relief: row.relief.unwrap_or_default(),
            parameters: row.parameters.unwrap_or_default(),
            bands: vec![[None; 3]; bands.len()],
        });
        if let Some(band) = bands.iter().position(|band| *band == row.band) {
            panel.bands[band] = [row.level_db, row.spread_db, row.scattering];
        }
    }
    Ok(panels.into_values().collect())
}

/// Returns the levels of the surface that a target names.
pub(super) fn levels_of(measured: &[MeasuredPanel], surface: &SurfaceId) -> anyhow::Result<Vec<Option<f64>>> {
    let panel = measured.iter().find(|panel| panel.surface_id == surface.as_str());
    let panel = panel.with_context(|| {
        format!(
            "`levels_of` names surface `{surface}`, which the lake has no levels over Flat of; hint: --lake, echolake \
             ingest; Flat and Foam have none"
        )
    })?;
    Ok(panel.levels_db())
}
