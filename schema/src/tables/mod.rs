//! The tables of a lake: their names and Arrow schemas. Column metadata carries `unit` and `comment`.
//!
//! Keys come first, because Delta keeps statistics of the first 32 columns only. Lists are `LIST` with
//! the child `element`; times are microseconds beside a `BIGINT` of nanoseconds, which Delta cannot hold.

mod column;
mod contributions;
mod definitions;
mod rows;

use std::sync::Arc;

use arrow_schema::{Schema, SchemaRef};

pub use column::{COMMENT, LIST_CHILD, UNIT};
pub use contributions::predicted_columns;
pub use rows::BandStatistics;
use serde::{Deserialize, Serialize};

use self::column::Column;
use crate::Rig;

/// A table of the lake.
///
/// ```
/// use echolake_schema::Rig;
/// use echolake_schema::tables::{Table, UNIT};
///
/// let schema = Table::Pairs.schema(&Rig::paper());
/// assert_eq!(schema.field(0).name(), "pair_id");
/// assert_eq!(schema.field_with_name("direct_mm").map(|field| field.metadata()[UNIT].as_str()).ok(), Some("mm"));
/// assert_eq!(Table::by_name("tnce_d4"), Some(Table::TnceD4));
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Table {
    /// One row per run, with its record of the surface.
    Surfaces,
    /// One row per run; readers see only the rows of runs that it names.
    Runs,
    /// One row per grid point.
    Points,
    /// One row per pair.
    Pairs,
    /// One row per accepted measurement, with its impulse response.
    Measurements,
    /// One row per measurement: its reflected response and its cumulative energy curves.
    Nce,
    /// One row per measurement: its energies.
    Tnce,
    /// One row per measurement and symmetry: energies with transformed positions.
    TnceD4,
    /// One row per surface and symmetry.
    Heightmaps,
    /// One row per reading of the ambient sensor.
    Environment,
    /// One row per line of a run's log.
    Events,
    /// One row per surface and band.
    SurfaceStats,
    /// One row per label, verdict or note of a user.
    Annotations,
    /// One row per prediction of a model.
    Predictions,
}

impl Table {
    /// All tables.
    pub const ALL: [Self; 14] = [
        Self::Surfaces,
        Self::Runs,
        Self::Points,
        Self::Pairs,
        Self::Measurements,
        Self::Nce,
        Self::Tnce,
        Self::TnceD4,
        Self::Heightmaps,
        Self::Environment,
        Self::Events,
        Self::SurfaceStats,
        Self::Annotations,
        Self::Predictions,
    ];

    /// The tables of what users add, which no other source has.
    pub const OF_USERS: [Self; 2] = [Self::Annotations, Self::Predictions];

    /// Its name in SQL and its folder.
    pub fn name(self) -> &'static str {
        self.definition().name
    }

    /// Meaning of a row of it.
    pub fn meaning(self) -> &'static str {
        match self {
            Self::Surfaces => "One row per surface: its description, as its newest run has it.",
            Self::Runs => "One row per run: a measurement of one surface, with its file, air, counts and state.",
            Self::Points => "One row per grid point: its coordinates.",
            Self::Pairs => "One row per pair of grid points: distances and angles.",
            Self::Measurements => "One row per accepted measurement: its impulse response, air and quality.",
            Self::Nce => "One row per measurement: the reflected response and its cumulative energy curves.",
            Self::Tnce => "One row per measurement: energies by band and over Flat's, linear.",
            Self::TnceD4 => "One row per measurement and symmetry: energies with moved positions.",
            Self::Heightmaps => "One row per surface and symmetry: the relief's heights.",
            Self::Environment => "One row per reading of the ambient sensor.",
            Self::Events => "One row per line of a run's log.",
            Self::SurfaceStats => "One row per surface and band: statistics of its levels.",
            Self::Annotations => "One row per annotation: a label, verdict or note of a user on a run or some pairs.",
            Self::Predictions => "One row per model, its version, surface and pair: TNCE as a model predicts them.",
        }
    }

    /// The table of a name.
    pub fn by_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|t| t.name() == name)
    }

    /// Source of its rows.
    pub fn source(self) -> Source {
        self.definition().source
    }

    /// Columns of which no two visible rows have the same values; none if rows may repeat. If `surface_id` is one of
    /// them, only the newest run of a surface has visible rows.
    pub fn key(self) -> &'static [&'static str] {
        self.definition().key
    }

    /// Its schema in a lake of this rig.
    pub fn schema(self, rig: &Rig) -> SchemaRef {
        let columns = (self.definition().columns)(&rig.band_names());
        Arc::new(Schema::new(columns.into_iter().map(Column::into_field).collect::<Vec<_>>()))
    }

    /// Cells along each side of a stored height map.
    pub const HEIGHTMAP_CELLS: usize = 128;

    fn definition(self) -> TableDefinition {
        match self {
            Self::Surfaces => define_table("surfaces", Source::Run, &["surface_id"], definitions::surface_columns),
            Self::Runs => define_table("runs", Source::Pointer, &["run_id"], |_| definitions::run_columns()),
            Self::Points => define_table("points", Source::Rig, &["point_id"], |_| definitions::point_columns()),
            Self::Pairs => define_table("pairs", Source::Rig, &["pair_id"], |_| definitions::pair_columns()),
            Self::Measurements => {
                define_table("measurements", Source::Run, &PAIR_KEY, |_| definitions::measurement_columns())
            }
            Self::Nce => define_table("nce", Source::References, &PAIR_KEY, definitions::nce_columns),
            Self::Tnce => define_table("tnce", Source::References, &PAIR_KEY, definitions::tnce_columns),
            Self::TnceD4 => {
                define_table("tnce_d4", Source::References, &["run_id", "pair_id", "symmetry"], definitions::tnce_d4)
            }
            Self::Heightmaps => define_table("heightmaps", Source::Run, &["surface_id", "symmetry"], |_| {
                definitions::heightmap_columns()
            }),
            Self::Environment => define_table("environment", Source::Run, &[], |_| definitions::environment_columns()),
            Self::Events => define_table("events", Source::Run, &[], |_| definitions::event_columns()),
            Self::SurfaceStats => {
                define_table("surface_stats", Source::References, &["run_id", "band"], |_| definitions::surface_stats())
            }
            Self::Annotations => {
                define_table("annotations", Source::Users, &[], |_| contributions::annotation_columns())
            }
            Self::Predictions => define_table("predictions", Source::Users, &[], contributions::prediction_columns),
        }
    }
}

const PAIR_KEY: [&str; 2] = ["run_id", "pair_id"];

/// A table's definition. [`Table`] describes each part.
struct TableDefinition {
    name: &'static str,
    source: Source,
    key: &'static [&'static str],
    /// Its columns in a lake whose bands have these names.
    columns: fn(&[String]) -> Vec<Column>,
}

fn define_table(
    name: &'static str,
    source: Source,
    key: &'static [&'static str],
    columns: fn(&[String]) -> Vec<Column>,
) -> TableDefinition {
    TableDefinition { name, source, key, columns }
}

/// Source of a table's rows, which decides when they change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// The rig alone: written once per lake.
    Rig,
    /// One run alone.
    Run,
    /// One run and the references of its surface: rewritten when a reference changes.
    References,
    /// The table that decides which rows of the others are visible.
    Pointer,
    /// Users, who add rows that no other source has: nothing makes them again.
    Users,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_column_says_what_it_means() {
        let rig = Rig::paper();
        for table in Table::ALL {
            assert_eq!(Table::by_name(table.name()), Some(table));
            for field in table.schema(&rig).fields() {
                assert!(
                    field.metadata().get(COMMENT).is_some_and(|c| c.len() > 5),
                    "{}.{}",
                    table.name(),
                    field.name()
                );
                assert!(field.metadata().contains_key(UNIT), "{}.{}", table.name(), field.name());
            }
        }
    }

    #[test]
    fn band_columns_follow_the_rig() {
        let mut rig = Rig::paper();
        rig.bands.centres_hz = vec![500.0, 1000.0];
        let schema = Table::Tnce.schema(&rig);
        for name in ["tnce_500", "tnce_1000", "tnce_total", "tnce_band_500", "energy_1000"] {
            assert!(schema.field_with_name(name).is_ok(), "{name}");
        }
        assert!(schema.field_with_name("tnce_2500").is_err());
    }

    #[test]
    fn names_do_not_repeat_and_keys_lead() {
        for table in Table::ALL {
            let schema = table.schema(&Rig::paper());
            let mut names: Vec<_> = schema.fields().iter().map(|f| f.name().clone()).collect();
            if table.source() != Source::Rig {
                assert_eq!(names[..2], ["surface_id", "run_id"], "{}", table.name());
            }
            assert!(table.key().iter().all(|key| names.iter().any(|name| name == key)), "{}", table.name());
            let count = names.len();
            names.sort();
            names.dedup();
            assert_eq!(names.len(), count, "{}", table.name());
        }
    }

    #[test]
    fn names_end_in_their_units() {
        let suffixes = [
            ("_mm", "mm"),
            ("_db", "dB"),
            ("_per_ms", "1/ms"),
            ("_ms", "ms"),
            ("_ns", "ns"),
            ("_us", "us"),
            ("_c", "C"),
            ("_pct", "%"),
            ("_hpa", "hPa"),
            ("_ppm", "ppm"),
            ("_hz", "Hz"),
            ("_deg", "deg"),
            ("_bytes", "B"),
            ("chunk_offset", "B"),
        ];
        for table in Table::ALL {
            for field in table.schema(&Rig::paper()).fields() {
                // After the unit comes the reference of a level.
                let unit = field.metadata()[UNIT].split(' ').next().unwrap_or_default();
                let expected =
                    suffixes.iter().find(|(suffix, _)| field.name().ends_with(suffix)).map(|(_, unit)| *unit);
                let agrees = expected.map_or(matches!(unit, "" | "1"), |expected| unit == expected);
                assert!(agrees, "{}.{} has the unit `{unit}`", table.name(), field.name());
            }
        }
    }
}
