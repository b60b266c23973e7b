//! Positions of surfaces among each other, by their TNCE.

use echolake_dsp::components::PrincipalComponents;
use echolake_dsp::self_organising_map::SelfOrganisingMap;
use serde::Serialize;
use utoipa::ToSchema;

/// Surfaces on the map.
pub(crate) struct SurfacePositions {
    pub names: Vec<String>,
    pub components: PrincipalComponents,
    pub units: SelfOrganisingMap,
}

impl SurfacePositions {
    /// The `count` surfaces nearest to one.
    pub fn nearest_surfaces(&self, of: usize, count: usize) -> Vec<SurfaceNeighbour<'_>> {
        let others = self.names.iter().enumerate().filter(|(i, _)| *i != of);
        let mut near: Vec<_> = others.map(|(i, name)| (self.components.row_distance(of, i), name)).collect();
        near.sort_by(|a, b| a.0.total_cmp(&b.0));
        near.into_iter()
            .take(count)
            .map(|(distance_db, surface_id)| SurfaceNeighbour { surface_id, distance_db })
            .collect()
    }
}

/// A surface that is near another one.
#[derive(Serialize, ToSchema)]
pub(crate) struct SurfaceNeighbour<'a> {
    surface_id: &'a str,
    /// Root mean square over the features.
    distance_db: f64,
}
