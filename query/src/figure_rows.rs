//! The queries behind figures, and their rows: the same for the catalogue's endpoints and for the command that writes
//! figures to files. Values are in the queries as placeholders, or as the literals of [`quote_literal`].

use std::collections::HashMap;

use arrow::array::AsArray as _;
use arrow::datatypes::{Float32Type, Int32Type};
use arrow::error::ArrowError;
use arrow::record_batch::RecordBatch;
use echolake_lake::LakeSnapshot;
use echolake_schema::Rig;
use serde::Deserialize;

use crate::views::{RE_FLAT_BAND, RE_FLAT_TOTAL};

/// Name of the total over all bands.
pub const TOTAL_BAND: &str = "total";

/// The normalisation of levels by band. The total is always over Flat's total.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LevelReference {
    /// Flat's energy in all bands, as in the paper's tables.
    FlatTotal,
    /// Flat's energy in the same band, as in the paper's grid plots.
    FlatBand,
}

impl LevelReference {
    /// Returns the unit of the levels, as views, pages and titles name it.
    pub fn unit(self) -> &'static str {
        match self {
            Self::FlatTotal => RE_FLAT_TOTAL,
            Self::FlatBand => RE_FLAT_BAND,
        }
    }
}

/// Returns a text as an SQL literal.
pub fn quote_literal(text: &str) -> String {
    format!("'{}'", text.replace('\'', "''"))
}

/// Returns the rig's bands as columns and options name them, the total last.
pub fn band_keys(rig: &Rig) -> Vec<String> {
    rig.band_names().into_iter().chain([TOTAL_BAND.to_owned()]).collect()
}

/// Returns names of the rig's bands as pictures have them, the total last.
pub fn band_labels(rig: &Rig) -> Vec<String> {
    let label = |hz: &f64| if *hz >= 1000.0 { format!("{} kHz", hz / 1000.0) } else { format!("{hz} Hz") };
    rig.bands.centres_hz.iter().map(label).chain(["Total".to_owned()]).collect()
}

/// Returns a column for each of the rig's bands and the total, as one list.
///
/// Names of bands come from `lake.toml`, and are digits.
pub fn band_list(rig: &Rig, column: impl Fn(&str) -> String) -> String {
    let columns: Vec<_> = band_keys(rig).iter().map(|band| format!("cast({} as double)", column(band))).collect();
    format!("make_array({})", columns.join(", "))
}

/// Returns energies over Flat's as levels; none of what has no energy.
pub fn levels_db(linear: &[Option<f64>]) -> Vec<Option<f64>> {
    linear.iter().map(|x| x.filter(|x| *x > 0.0).map(|x| 10.0 * x.log10())).collect()
}

/// Returns the version of a snapshot as queries name it: that of table `runs`.
pub fn lake_version(snapshot: &LakeSnapshot) -> String {
    format!("runs@{}", snapshot.lake_version().unwrap_or(0))
}

/// Returns the condition, with `and` before it, that a pair has this grid point.
pub fn point_filter(point: &str) -> String {
    format!(" and (microphone = {point} or speaker = {point})")
}

/// Returns the query of [`GridCell`] for a surface and a grid point.
pub fn grid_query(rig: &Rig, over: LevelReference, surface: &str, microphone: &str) -> String {
    let energies = band_list(rig, |band| match band == TOTAL_BAND || over == LevelReference::FlatTotal {
        true => format!("avg(tnce_{band})"),
        false => format!("avg(tnce_band_{band})"),
    });
    let filter = point_filter(microphone);
    format!(
        "select pair_id, microphone, speaker, {energies} as energies from tnce \
         where surface_id = {surface}{filter} group by pair_id, microphone, speaker"
    )
}

/// The energies of a pair.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct GridCell {
    /// The pair.
    pub pair_id: i32,
    /// Grid point of the microphone.
    pub microphone: usize,
    /// Grid point of the speaker.
    pub speaker: usize,
    /// By band, the total last, over Flat's.
    pub energies: Vec<Option<f64>>,
}

/// Levels over the grid for one microphone point.
#[derive(Debug, Clone, PartialEq)]
pub struct GridLevels {
    /// Pair with the microphone by point; none if the pair was not measured or is the microphone itself.
    pub pairs: Vec<Option<i32>>,
    /// By point: the pair was measured with microphone and speaker exchanged.
    pub swapped: Vec<bool>,
    /// By band, then by point: dB.
    pub bands: Vec<Vec<Option<f64>>>,
}

impl GridLevels {
    /// Arranges cells by the point that is not the microphone's. Pairs that were measured the other way round are used
    /// by reciprocity; if both directions were measured, the requested one counts.
    pub fn from_cells(mut cells: Vec<GridCell>, microphone: usize, points: usize, bands: usize) -> Self {
        cells.sort_by_key(|cell| cell.microphone == microphone);
        let mut grid =
            Self { pairs: vec![None; points], swapped: vec![false; points], bands: vec![vec![None; points]; bands] };
        for cell in cells {
            let swapped = cell.microphone != microphone;
            let other = if swapped { cell.microphone } else { cell.speaker };
            if other >= points {
                continue;
            }
            grid.pairs[other] = Some(cell.pair_id);
            grid.swapped[other] = swapped;
            for (band, level) in grid.bands.iter_mut().zip(levels_db(&cell.energies)) {
                band[other] = level;
            }
        }
        grid
    }
}

/// Returns the query of [`CurveRow`] for surfaces, a list of literals or placeholders; `filter` goes on with `and`, or
/// is empty.
pub fn curves_query(rig: &Rig, surfaces: &str, filter: &str) -> String {
    let means: Vec<_> = rig.band_names().iter().map(|band| format!("avg_list(nce_{band})")).collect();
    format!(
        "select surface_id, count(*) as pairs, make_array({}) as bands from nce \
         where surface_id in ({surfaces}){filter} group by surface_id",
        means.join(", ")
    )
}

/// Returns the query of [`CurveRow`] for surfaces' means over all pairs, as ingest keeps them; no row for surfaces of
/// several runs, or of a version that kept none.
pub fn kept_curves_query(rig: &Rig, surfaces: &str) -> String {
    let of_band = |band| format!("avg_list(mean_nce) filter (where band = '{band}')");
    let bands: Vec<_> = rig.band_names().into_iter().map(of_band).collect();
    format!(
        "select surface_id, cast(max(measurements) as bigint) as pairs, make_array({}) as bands from surface_stats \
         where surface_id in ({surfaces}) group by surface_id having count(*) = {all} and count(mean_nce) = {all}",
        bands.join(", "),
        all = bands.len() + 1
    )
}

/// NCE of a surface, a mean over pairs.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct CurveRow {
    /// The surface.
    pub surface_id: String,
    /// Measurements that the mean is over.
    pub pairs: i64,
    /// By band (no total), then by time.
    pub bands: Vec<Option<Vec<f32>>>,
}

impl CurveRow {
    /// Returns its curves at these samples.
    pub fn curves_at(&self, kept: &[usize]) -> Vec<Vec<f32>> {
        let thin = |curve: &Option<Vec<f32>>| {
            let curve = curve.as_deref().unwrap_or_default();
            kept.iter().filter_map(|i| curve.get(*i).copied()).collect()
        };
        self.bands.iter().map(thin).collect()
    }
}

/// Returns at most `points` samples of `length`, evenly; first and last are always among them.
pub fn thinned_samples(length: usize, points: usize) -> Vec<usize> {
    if length <= points {
        return (0..length).collect();
    }
    let step = (length - 1) as f64 / (points - 1) as f64;
    (0..points).map(|i| (i as f64 * step).round() as usize).collect()
}

/// Returns the times of these samples, ms.
pub fn times_ms(rig: &Rig, kept: &[usize]) -> Vec<f64> {
    kept.iter().map(|i| 1000.0 * *i as f64 / rig.sweep.rate_hz.get()).collect()
}

/// Returns the sum of curves over their bands; none if there are no bands.
pub fn total_curve(bands: &[Vec<f32>]) -> Vec<f32> {
    let length = bands.first().map_or(0, Vec::len);
    (0..length).map(|i| bands.iter().filter_map(|band| band.get(i)).sum()).collect()
}

/// Returns the query of levels for [`LevelVectors`]: surface, pair and a level for each band, of the pairs that
/// `step` divides.
pub fn level_vectors_query(rig: &Rig, step: &str) -> String {
    let column = |(i, band): (usize, &String)| format!("cast(10 * log10(tnce_band_{band}) as float) as band_{i}");
    let columns: Vec<_> = rig.band_names().iter().enumerate().map(column).collect();
    format!("select surface_id, pair_id, {} from tnce where pair_id % {step} = 0", columns.join(", "))
}

/// Surfaces' levels, pair by pair and band by band; NaN if there is none.
#[derive(Debug, Clone)]
pub struct LevelVectors {
    places: HashMap<String, usize>,
    /// By surface.
    pub rows: Vec<Vec<f32>>,
    bands: usize,
    step: usize,
}

impl LevelVectors {
    /// Levels of `names`, of every `step`th pair.
    pub fn new(names: &[String], pairs: usize, bands: usize, step: usize) -> Self {
        let places = names.iter().enumerate().map(|(i, name)| (name.clone(), i)).collect();
        Self { places, rows: vec![vec![f32::NAN; pairs.div_ceil(step) * bands]; names.len()], bands, step }
    }

    /// Adds rows of [`level_vectors_query`].
    ///
    /// # Errors
    /// [`ArrowError::SchemaError`] if the rows are of another query.
    pub fn add_batch(&mut self, batch: &RecordBatch) -> Result<(), ArrowError> {
        let unexpected =
            || ArrowError::SchemaError(format!("levels of surfaces are not as expected: {}", batch.schema()));
        let columns = batch.columns();
        let (Some(names), Some(pairs)) =
            (columns[0].as_string_opt::<i32>(), columns[1].as_primitive_opt::<Int32Type>())
        else {
            return Err(unexpected());
        };
        for (band, column) in columns[2..].iter().enumerate() {
            let levels = column.as_primitive_opt::<Float32Type>().ok_or_else(unexpected)?;
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_by_the_other_point() {
        let cell = |pair_id, microphone, speaker, energy| GridCell {
            pair_id,
            microphone,
            speaker,
            energies: vec![Some(energy), None],
        };
        let cells = vec![cell(4, 1, 0, 10.0), cell(7, 2, 1, 1.0), cell(9, 1, 2, 0.1), cell(11, 1, 8, 1.0)];
        let grid = GridLevels::from_cells(cells, 1, 3, 2);
        assert_eq!(grid.pairs, [Some(4), None, Some(9)], "the requested direction counts; no point 8");
        assert_eq!(grid.swapped, [false; 3]);
        assert_eq!(grid.bands, [[Some(10.0), None, Some(-10.0)], [None, None, None]]);
    }

    #[test]
    fn thinning_keeps_both_ends() {
        assert_eq!(thinned_samples(4, 16), [0, 1, 2, 3]);
        let kept = thinned_samples(384, 192);
        assert_eq!((kept.len(), kept[0], kept[191]), (192, 0, 383));
        assert!(kept.windows(2).all(|two| two[0] < two[1]));
    }
}
