//! The two tables that come from the rig alone: points and pairs.

use std::sync::Arc;

use arrow::array::{ArrayRef, Float64Array, Int32Array};
use arrow::record_batch::RecordBatch;
use echolake_dsp::fresnel::first_fresnel_zone;
use echolake_dsp::geometry::{direct_mm, image_mm, incidence_deg, specular_point};
use echolake_schema::tables::Table;
use echolake_schema::{Grid, Rig};

use crate::{Error, Result};

/// Speed of sound that geometry alone is stated at, m/s: that of the published GIR combinations.
const GEOMETRY_SPEED_OF_SOUND: f64 = 343.0;

/// The rows of table `points`.
pub(crate) fn points(rig: &Rig, grid: &Grid) -> Result<RecordBatch> {
    let int = |f: fn(&echolake_schema::Point) -> u32| -> ArrayRef {
        Arc::new(grid.points().iter().map(|p| Some(f(p) as i32)).collect::<Int32Array>())
    };
    let axis = |i: usize| -> ArrayRef {
        Arc::new(grid.points().iter().map(|p| Some(p.position_mm[i])).collect::<Float64Array>())
    };
    let columns =
        vec![int(|p| p.id.0), int(|p| p.layer), int(|p| p.gridx), int(|p| p.gridy), axis(0), axis(1), axis(2)];
    batch(Table::Points, rig, columns)
}

/// The rows of table `pairs`.
pub(crate) fn pairs(rig: &Rig, grid: &Grid) -> Result<RecordBatch> {
    let ends: Vec<([f64; 3], [f64; 3])> = grid
        .pairs()
        .iter()
        .map(|p| [p.microphone, p.speaker].map(|id| grid.points()[id.index()].position_mm).into())
        .collect();
    let int = |f: fn(&echolake_schema::Pair) -> u32| -> ArrayRef {
        Arc::new(grid.pairs().iter().map(|p| Some(f(p) as i32)).collect::<Int32Array>())
    };
    let double = |f: &dyn Fn([f64; 3], [f64; 3]) -> f64| -> ArrayRef {
        Arc::new(ends.iter().map(|(m, s)| Some(f(*m, *s))).collect::<Float64Array>())
    };
    let zone = |hz: f64, major: bool| {
        double(&move |m, s| {
            let zone = first_fresnel_zone(m, s, hz, GEOMETRY_SPEED_OF_SOUND);
            2.0 * if major { zone.semi_major_mm } else { zone.semi_minor_mm }
        })
    };
    let mut columns = vec![int(|p| p.id.0), int(|p| p.microphone.0), int(|p| p.speaker.0)];
    columns.extend((0..3).map(|i| double(&move |m, _| m[i])));
    columns.extend((0..3).map(|i| double(&move |_, s| s[i])));
    columns.extend([
        double(&direct_mm),
        double(&image_mm),
        double(&incidence_deg),
        double(&|m, s| specular_point(m, s)[0]),
        double(&|m, s| specular_point(m, s)[1]),
        zone(2_000.0, true),
        zone(2_000.0, false),
        zone(40_000.0, true),
        zone(40_000.0, false),
    ]);
    batch(Table::Pairs, rig, columns)
}

fn batch(table: Table, rig: &Rig, columns: Vec<ArrayRef>) -> Result<RecordBatch> {
    RecordBatch::try_new(table.schema(rig), columns)
        .map_err(|e| Error::Encode { table: table.name(), reason: e.to_string() })
}
