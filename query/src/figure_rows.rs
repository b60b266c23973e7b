//! The queries behind figures, and their rows: the same for the catalogue's endpoints and for the command that writes
//! figures to files. Values are in the queries as placeholders, or as the literals of [`quote_literal`].

use std::collections::HashMap;
use std::ops::Range;

use arrow::array::AsArray as _;
use arrow::datatypes::{Float32Type, Int32Type};
use arrow::error::ArrowError;
use arrow::record_batch::RecordBatch;
use echolake_lake::LakeSnapshot;
use echolake_schema::{Grid, Rig};
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
         where surface_id = {surface}{filter} and not is_rejected(run_id, pair_id) \
         group by pair_id, microphone, speaker"
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

/// Returns the query of [`DiffusionRow`] for the rows of `tnce` that a condition selects, which begins with `where`, or
/// is empty.
///
/// Each grid point in turn is the source, and the points that it was measured with are the receivers, by reciprocity.
/// The coefficients of all points are averaged.
pub fn diffusion_query(rig: &Rig, condition: &str) -> String {
    let energies: Vec<_> = band_keys(rig).iter().map(|band| format!("energy_{band}")).collect();
    let coefficient = |band| format!("diffusion_coefficient(10 * log10(energy_{band})) as d_{band}");
    let coefficients: Vec<_> = band_keys(rig).iter().map(coefficient).collect();
    let means = band_list(rig, |band| format!("avg(d_{band})"));
    format!(
        "select surface_id, {means} as diffusion from (select surface_id, run_id, point, {} from (select surface_id, \
         run_id, unnest([microphone, speaker]) as point, {} from (select * from tnce where not is_rejected(run_id, \
         pair_id)) as tnce {condition}) group by surface_id, run_id, point) group by surface_id",
        coefficients.join(", "),
        energies.join(", ")
    )
}

/// Diffusion coefficients of a surface.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct DiffusionRow {
    /// The surface.
    pub surface_id: String,
    /// By band, the total last.
    pub diffusion: Vec<Option<f64>>,
}

/// Returns the query of [`CurveRow`] for surfaces, a list of literals or placeholders; `filter` goes on with `and`, or
/// is empty.
pub fn curves_query(rig: &Rig, surfaces: &str, filter: &str) -> String {
    let columns = curve_columns(rig);
    format!(
        "select surface_id, {columns} from nce where surface_id in ({surfaces}) and not is_rejected(run_id, \
         pair_id){filter} group by surface_id"
    )
}

// The columns of `CurveRow` behind its surface, aggregates over rows of `nce`.
fn curve_columns(rig: &Rig) -> String {
    let means: Vec<_> = rig.band_names().iter().map(|band| format!("avg_list(nce_{band})")).collect();
    format!("count(*) as pairs, make_array({}) as bands", means.join(", "))
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

/// Returns the query of energies for [`OrbitEnergies`]: surface, pair and an energy over Flat's for each band.
pub fn orbit_energies_query(rig: &Rig) -> String {
    let column = |(i, band): (usize, &String)| format!("cast(tnce_band_{band} as float) as band_{i}");
    let columns: Vec<_> = rig.band_names().iter().enumerate().map(column).collect();
    format!("select surface_id, pair_id, {} from tnce where not is_rejected(run_id, pair_id)", columns.join(", "))
}

/// Surfaces' energies, arranged by orbits of pairs (see [`Grid::pair_orbits`]), so that surfaces can be compared
/// whichever way their panels lay.
#[derive(Debug, Clone)]
pub struct OrbitEnergies {
    places: HashMap<String, usize>,
    /// By surface: band by band, then by slot; NaN if there is none.
    rows: Vec<Vec<f32>>,
    /// By pair: its slot. Pairs of an orbit are side by side; pairs of orbits that are left out have none.
    slots: Vec<Option<usize>>,
    /// By orbit: its slots.
    orbits: Vec<Range<usize>>,
    /// Number of slots.
    width: usize,
}

impl OrbitEnergies {
    /// Energies of `names`, of every `step`th orbit.
    pub fn new(names: &[String], grid: &Grid, bands: usize, step: usize) -> Self {
        let mut pairs: Vec<_> = grid.pair_orbits().into_iter().enumerate().collect();
        let mut slots = vec![None; pairs.len()];
        pairs.retain(|(_, orbit)| orbit % step == 0);
        pairs.sort_by_key(|(_, orbit)| *orbit);
        let mut orbits = Vec::new();
        for orbit in pairs.chunk_by(|a, b| a.1 == b.1) {
            let from = orbits.last().map_or(0, |last: &Range<usize>| last.end);
            orbits.push(from..from + orbit.len());
            orbit.iter().enumerate().for_each(|(i, (pair, _))| slots[*pair] = Some(from + i));
        }
        let width = pairs.len();
        let places = names.iter().enumerate().map(|(i, name)| (name.clone(), i)).collect();
        Self { places, rows: vec![vec![f32::NAN; width * bands]; names.len()], slots, orbits, width }
    }

    /// Adds rows of [`orbit_energies_query`].
    ///
    /// # Errors
    /// [`ArrowError::SchemaError`] if the rows are of another query.
    pub fn add_batch(&mut self, batch: &RecordBatch) -> Result<(), ArrowError> {
        let unexpected =
            || ArrowError::SchemaError(format!("energies of surfaces are not as expected: {}", batch.schema()));
        let columns = batch.columns();
        let (Some(names), Some(pairs)) =
            (columns[0].as_string_opt::<i32>(), columns[1].as_primitive_opt::<Int32Type>())
        else {
            return Err(unexpected());
        };
        for (band, column) in columns[2..].iter().enumerate() {
            let energies = column.as_primitive_opt::<Float32Type>().ok_or_else(unexpected)?;
            for (i, energy) in energies.iter().enumerate() {
                let place = self.places.get(names.value(i)).map(|place| &mut self.rows[*place]);
                let slot = usize::try_from(pairs.value(i)).ok().and_then(|pair| *self.slots.get(pair)?);
                // Of several runs of a surface, the last one that comes counts: they are of the same surface.
                if let (Some(row), Some(slot), Some(energy)) = (place, slot, energy) {
                    row[band * self.width + slot] = energy;
                }
            }
        }
        Ok(())
    }

    /// Returns levels by surface, dB: for each band and orbit the mean energy of the weaker and of the stronger half of
    /// its pairs. NaN if the surface has no pair of the orbit.
    ///
    /// A symmetry permutes the pairs of an orbit, so that a turned panel has the same levels. Energies are averaged
    /// before the logarithm, so that a dip of a single pair does not outweigh its orbit.
    pub fn into_level_rows(self) -> Vec<Vec<f32>> {
        let Self { rows, orbits, width, .. } = self;
        let level_row = |mut row: Vec<f32>| -> Vec<f32> {
            let bands = row.chunks_exact_mut(width.max(1));
            bands.flat_map(|band| orbits.iter().flat_map(|orbit| half_levels(&mut band[orbit.clone()]))).collect()
        };
        rows.into_iter().map(level_row).collect()
    }
}

// Sorts the energies, those that are none last.
fn half_levels(energies: &mut [f32]) -> [f32; 2] {
    energies.sort_unstable_by(f32::total_cmp);
    let known = &energies[..energies.iter().filter(|energy| !energy.is_nan()).count()];
    let half = known.len().div_ceil(2);
    [&known[..half], &known[known.len() - half..]].map(|half| {
        let sum: f32 = half.iter().sum();
        10.0 * (sum / half.len() as f32).log10()
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use arrow::array::{ArrayRef, Float32Array, Int32Array, StringArray};
    use echolake_dsp::components::PrincipalComponents;
    use echolake_schema::Symmetry;

    use super::*;

    // A panel, the same panel in all eight positions, and another one: the first nine are one point.
    #[test]
    fn a_panel_is_at_no_distance_from_its_turned_selves() {
        let grid = Rig::paper().build_grid().expect("the built-in rig is valid");
        let count = grid.pairs().len();
        let noise = |pair: usize, band: usize, panel: usize| {
            let hashed = (pair * 2_654_435_761 + band * 40_503 + panel * 97_531) % 1_000_003;
            0.01 + (hashed as f32 / 1_000_003.0).powi(4)
        };
        let names: Vec<_> = (0..10).map(|i| i.to_string()).collect();
        let mut energies = OrbitEnergies::new(&names, &grid, 2, 1);
        for (i, name) in names.iter().enumerate() {
            let symmetry = Symmetry::ALL[i.saturating_sub(1) % Symmetry::ALL.len()];
            let pairs = grid.moved_pairs(symmetry).expect("the grid is square");
            let pairs: Int32Array = pairs.iter().map(|moved| moved.pair.id.index() as i32).collect();
            let bands = [0, 1].map(|band| -> ArrayRef {
                Arc::new((0..count).map(|pair| noise(pair, band, i / 9)).collect::<Float32Array>())
            });
            let [low, high] = bands;
            let columns: [(&str, ArrayRef); 4] = [
                ("surface_id", Arc::new(StringArray::from(vec![name.as_str(); count]))),
                ("pair_id", Arc::new(pairs)),
                ("band_0", low),
                ("band_1", high),
            ];
            energies.add_batch(&RecordBatch::try_from_iter(columns).expect("a batch")).expect("the query's columns");
        }
        let found = PrincipalComponents::from_rows(&mut energies.into_level_rows(), 2).expect("equally long");
        assert!((1..9).all(|turned| found.row_distance(0, turned) == 0.0));
        assert!(found.row_distance(0, 9) > 1.0, "{}", found.row_distance(0, 9));
    }

    #[test]
    fn halves_are_means_of_energies() {
        let tens = |level: f32| 10f32.powf(level / 10.0);
        assert_eq!(
            half_levels(&mut [4.0, f32::NAN, 1.0, 2.0, 3.0]).map(tens),
            [1.5, 3.5].map(|x: f32| tens(10.0 * x.log10()))
        );
        assert_eq!(half_levels(&mut [f32::NAN, 10.0]), [10.0; 2]);
        assert!(half_levels(&mut [f32::NAN; 3]).iter().all(|level| level.is_nan()));
    }

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
