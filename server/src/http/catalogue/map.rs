//! `GET /api/v1/map`: surfaces as points, close together if they reflect alike. Computed once per snapshot.

use arrow::array::AsArray as _;
use arrow::datatypes::{Float32Type, Int32Type};
use arrow::record_batch::RecordBatch;
use datafusion::common::ScalarValue;
use echolake_dsp::components::PrincipalComponents;
use serde::Serialize;

use std::collections::HashMap;

use super::asked::CatalogueRequest;
use super::content::AnswerContent;
use crate::fault::RequestFault;

/// Components that are answered.
const COMPONENTS: usize = 3;
/// Surfaces that are placed; more are left out.
const MOST_SURFACES: usize = 2000;
/// Products of features that the distances may take: beyond, pairs are left out evenly. One core does about a billion
/// a second.
const MOST_PRODUCTS: usize = 4_000_000_000;

/// Surfaces on the map.
pub(super) struct SurfacePositions {
    names: Vec<String>,
    components: PrincipalComponents,
}

#[derive(Serialize)]
struct SurfaceMap<'a> {
    features: usize,
    explained: Vec<f64>,
    points: Vec<MapPoint<'a>>,
    left_out: Vec<&'a str>,
}

#[derive(Serialize)]
struct MapPoint<'a> {
    surface_id: &'a str,
    typology: &'a str,
    position: Vec<f64>,
    neighbours: Vec<SurfaceNeighbour<'a>>,
}

#[derive(Serialize)]
struct SurfaceNeighbour<'a> {
    surface_id: &'a str,
    distance_db: f64,
}

/// The surfaces' places and nearest neighbours.
pub(super) async fn map(asked: CatalogueRequest) -> Result<AnswerContent, RequestFault> {
    let count = asked.params.whole("neighbours", 1..=20)?.unwrap_or(6);
    let (summary, places) = (asked.summary().await?, asked.places().await?);
    let typology = |name: &str| summary.entry(name).map_or("", |entry| entry.surface.typology.as_str());
    let point = |(i, name)| MapPoint {
        surface_id: name,
        typology: typology(name),
        position: places.components.position(i),
        neighbours: places.neighbours(i, count),
    };
    let names: std::collections::HashSet<_> = places.names.iter().map(String::as_str).collect();
    let all = summary.entries.iter().map(|entry| entry.surface.surface_id.as_str());
    AnswerContent::json(&SurfaceMap {
        features: places.components.features(),
        explained: places.components.explained(),
        points: places.names.iter().map(String::as_str).enumerate().map(point).collect(),
        left_out: all.filter(|name| !names.contains(name)).collect(),
    })
}

impl SurfacePositions {
    /// # Errors
    /// Those of its query.
    pub(super) async fn find(asked: &CatalogueRequest) -> Result<Self, RequestFault> {
        let summary = asked.summary().await?;
        let rig = asked.catalogue.lake().rig();
        let known = summary.entries.iter().filter(|e| e.surface.against_flat_db.iter().any(Option::is_some));
        let names: Vec<_> = known.map(|e| e.surface.surface_id.clone()).take(MOST_SURFACES).collect();
        let bands = rig.band_names();
        let pairs = asked.catalogue.lake().grid().pairs().len();
        let products = names.len() * names.len() / 2 * pairs * bands.len();
        let step = products.div_ceil(MOST_PRODUCTS).max(1);
        let mut vectors = LevelVectors::new(&names, pairs.div_ceil(step), bands.len(), step);
        let columns: Vec<_> = bands.iter().map(|b| format!("cast(10 * log10(tnce_band_{b}) as float)")).collect();
        let sql =
            format!("select surface_id, pair_id, {} from tnce where pair_id % $1 = 0", numbered(&columns).join(", "));
        let mut rows = asked.batches(&sql, vec![ScalarValue::Int32(i32::try_from(step).ok())]).await?;
        while let Some(batch) = rows.next().await? {
            vectors.add(&batch)?;
        }
        let found =
            asked.catalogue.service().crunch(move || PrincipalComponents::of(&mut vectors.rows, COMPONENTS)).await?;
        let components = found.map_err(|e| {
            eprintln!("surfaces have no places: {e}");
            RequestFault::Internal
        })?;
        Ok(Self { names, components })
    }

    fn neighbours(&self, of: usize, count: usize) -> Vec<SurfaceNeighbour<'_>> {
        let others = self.names.iter().enumerate().filter(|(i, _)| *i != of);
        let mut near: Vec<_> = others.map(|(i, name)| (self.components.distance(of, i), name)).collect();
        near.sort_by(|a, b| a.0.total_cmp(&b.0));
        near.into_iter()
            .take(count)
            .map(|(distance_db, surface_id)| SurfaceNeighbour { surface_id, distance_db })
            .collect()
    }
}

fn numbered(columns: &[String]) -> Vec<String> {
    columns.iter().enumerate().map(|(i, column)| format!("{column} as band_{i}")).collect()
}

/// A surface's levels, pair by pair and band by band; NaN if there is none.
struct LevelVectors {
    places: HashMap<String, usize>,
    rows: Vec<Vec<f32>>,
    bands: usize,
    step: usize,
}

impl LevelVectors {
    fn new(names: &[String], pairs: usize, bands: usize, step: usize) -> Self {
        let places = names.iter().enumerate().map(|(i, name)| (name.clone(), i)).collect();
        Self { places, rows: vec![vec![f32::NAN; pairs * bands]; names.len()], bands, step }
    }

    fn add(&mut self, batch: &RecordBatch) -> Result<(), RequestFault> {
        let columns = batch.columns();
        let (Some(names), Some(pairs)) =
            (columns[0].as_string_opt::<i32>(), columns[1].as_primitive_opt::<Int32Type>())
        else {
            eprintln!("the map's columns are not as expected: {}", batch.schema());
            return Err(RequestFault::Internal);
        };
        for (band, column) in columns[2..].iter().enumerate() {
            let Some(levels) = column.as_primitive_opt::<Float32Type>() else { return Err(RequestFault::Internal) };
            for (i, level) in levels.iter().enumerate() {
                let place = self.places.get(names.value(i)).map(|place| &mut self.rows[*place]);
                let at = usize::try_from(pairs.value(i)).unwrap_or(0) / self.step * self.bands + band;
                // Of several runs of a surface, the last one that comes counts: they are of the same surface.
                if let (Some(cell), Some(level)) = (place.and_then(|row| row.get_mut(at)), level) {
                    *cell = level;
                }
            }
        }
        Ok(())
    }
}
