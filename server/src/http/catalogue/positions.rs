//! Positions of surfaces among each other, by their TNCE.

use std::collections::HashMap;

use arrow::array::AsArray as _;
use arrow::datatypes::{Float32Type, Int32Type};
use arrow::record_batch::RecordBatch;
use echolake_dsp::components::PrincipalComponents;
use serde::Serialize;
use utoipa::ToSchema;

use crate::fault::RequestFault;

/// Surfaces on the map.
pub(super) struct SurfacePositions {
    pub(super) names: Vec<String>,
    pub(super) components: PrincipalComponents,
}

impl SurfacePositions {
    /// The `count` surfaces nearest to one.
    pub(super) fn neighbours(&self, of: usize, count: usize) -> Vec<SurfaceNeighbour<'_>> {
        let others = self.names.iter().enumerate().filter(|(i, _)| *i != of);
        let mut near: Vec<_> = others.map(|(i, name)| (self.components.distance(of, i), name)).collect();
        near.sort_by(|a, b| a.0.total_cmp(&b.0));
        near.into_iter()
            .take(count)
            .map(|(distance_db, surface_id)| SurfaceNeighbour { surface_id, distance_db })
            .collect()
    }
}

/// A surface that is near another one.
#[derive(Serialize, ToSchema)]
pub(super) struct SurfaceNeighbour<'a> {
    surface_id: &'a str,
    /// Root mean square over the features.
    distance_db: f64,
}

/// A surface's levels, pair by pair and band by band; NaN if there is none.
pub(super) struct LevelVectors {
    places: HashMap<String, usize>,
    pub(super) rows: Vec<Vec<f32>>,
    bands: usize,
    step: usize,
}

impl LevelVectors {
    /// Levels of `names`, of every `step`th pair.
    pub(super) fn new(names: &[String], pairs: usize, bands: usize, step: usize) -> Self {
        let places = names.iter().enumerate().map(|(i, name)| (name.clone(), i)).collect();
        Self { places, rows: vec![vec![f32::NAN; pairs * bands]; names.len()], bands, step }
    }

    /// Adds rows of surface, pair and a level for each band.
    pub(super) fn add(&mut self, batch: &RecordBatch) -> Result<(), RequestFault> {
        let columns = batch.columns();
        let (Some(names), Some(pairs)) =
            (columns[0].as_string_opt::<i32>(), columns[1].as_primitive_opt::<Int32Type>())
        else {
            tracing::error!(schema = %batch.schema(), "the map\'s columns are not as expected");
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
