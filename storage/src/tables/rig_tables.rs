//! The two tables that come from the rig alone: points and pairs.

use arrow::record_batch::RecordBatch;
use echolake_dsp::fresnel::first_fresnel_zone;
use echolake_dsp::geometry::{direct_mm, image_mm, incidence_deg, specular_point};
use echolake_schema::tables::Table;
use echolake_schema::{Grid, Rig};

use super::BatchBuilder;
use crate::Result;

/// Speed of sound that geometry alone is stated at, m/s: that of the published GIR combinations.
const GEOMETRY_SPEED_OF_SOUND: f64 = 343.0;

/// The rows of table `points`.
pub(crate) fn point_rows(rig: &Rig, grid: &Grid) -> Result<RecordBatch> {
    let points = grid.points();
    let axis = |i: usize| points.iter().map(move |p| p.position_mm[i]);
    BatchBuilder::new(Table::Points, rig, points.len())
        .push_ints("point_id", points.iter().map(|p| p.id.0 as i32))
        .push_ints("layer", points.iter().map(|p| p.layer as i32))
        .push_ints("gridx", points.iter().map(|p| p.gridx as i32))
        .push_ints("gridy", points.iter().map(|p| p.gridy as i32))
        .push_doubles("x_mm", axis(0))
        .push_doubles("y_mm", axis(1))
        .push_doubles("z_mm", axis(2))
        .finish()
}

/// The rows of table `pairs`.
pub(crate) fn pair_rows(rig: &Rig, grid: &Grid) -> Result<RecordBatch> {
    let ends: Vec<([f64; 3], [f64; 3])> = grid
        .pairs()
        .iter()
        .map(|p| [p.microphone, p.speaker].map(|id| grid.points()[id.index()].position_mm).into())
        .collect();
    let each = |f: &dyn Fn([f64; 3], [f64; 3]) -> f64| -> Vec<f64> { ends.iter().map(|(m, s)| f(*m, *s)).collect() };
    let zone = |hz: f64, major: bool| {
        each(&move |m, s| {
            let zone = first_fresnel_zone(m, s, hz, GEOMETRY_SPEED_OF_SOUND);
            2.0 * if major { zone.semi_major_mm } else { zone.semi_minor_mm }
        })
    };
    BatchBuilder::new(Table::Pairs, rig, ends.len())
        .push_pairs("", grid.pairs().iter().map(Some))
        .push_positions(grid, grid.pairs().iter().map(Some))
        .push_doubles("direct_mm", each(&direct_mm))
        .push_doubles("image_mm", each(&image_mm))
        .push_doubles("incidence_deg", each(&incidence_deg))
        .push_doubles("specular_x_mm", each(&|m, s| specular_point(m, s)[0]))
        .push_doubles("specular_y_mm", each(&|m, s| specular_point(m, s)[1]))
        .push_doubles("fresnel_major_2000_mm", zone(2_000.0, true))
        .push_doubles("fresnel_minor_2000_mm", zone(2_000.0, false))
        .push_doubles("fresnel_major_40000_mm", zone(40_000.0, true))
        .push_doubles("fresnel_minor_40000_mm", zone(40_000.0, false))
        .finish()
}
