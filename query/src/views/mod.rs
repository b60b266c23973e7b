//! Views with the joins that most queries need. Computed by each query, never stored.
//!
//! Each is SQL over the lake's tables, planned once per snapshot, by the first query that names it, and merged into the
//! queries that name it, so that their filters and columns reach the scans beneath.

mod augmented;
mod catalogue;
mod eager_aggregation;
mod flat_drift;
mod ir;
mod lazy_view;
mod levels;
mod lookup;
mod materials;
mod pair_join;
mod percentile_calls;
mod repeatability;
mod room_parameters;
mod sorted_nulls;
mod tnce_db;
mod unused_join;

use std::collections::HashMap;
use std::sync::Arc;

use arrow::datatypes::{Field, SchemaRef};
use datafusion::common::metadata::FieldMetadata;
use datafusion::datasource::empty::EmptyTable;
use datafusion::datasource::{TableProvider, ViewTable};
use datafusion::error::{DataFusionError, Result};
use datafusion::logical_expr::{LogicalPlan, LogicalPlanBuilder};
use datafusion::prelude::{SessionContext, ident};
use echolake_functions::exact_aggregates;
use echolake_lake::Lake;
use echolake_schema::tables::{COMMENT, Table, UNIT};
use futures::FutureExt as _;

use crate::system::{self, SYSTEM_SCHEMA};

pub(crate) use eager_aggregation::EagerAggregation;
pub(crate) use lazy_view::LazyView;
pub(crate) use lookup::LookupFunctions;
pub(crate) use pair_join::{PairJoin, scanned_table};
pub(crate) use percentile_calls::PercentileCalls;
pub(crate) use sorted_nulls::SortedNulls;
pub(crate) use unused_join::{UnusedJoin, has_table_key};

/// A view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum LakeView {
    /// One row per measurement: geometry and samples.
    Ir,
    /// One row per measurement: TNCE in dB, with geometry.
    TnceDb,
    /// One row per measurement and symmetry: transformed geometry, samples, transformed height map.
    Augmented,
    /// One row per surface: its description and its measurements.
    Catalogue,
    /// One row per surface and band: level and uncertainty over all of its runs.
    Levels,
    /// One row per measurement and octave: reverberation times and energies.
    RoomParameters,
    /// One row per surface and band: absorption and scattering at full scale.
    Materials,
    /// One row per surface, band and kind of level: by how much its runs differ.
    Repeatability,
    /// One row per run of a Flat and band: a control chart.
    FlatDrift,
}

/// Unit of levels over Flat's energy in all bands.
pub(crate) const RE_FLAT_TOTAL: &str = "dB re Flat total";
/// Unit of levels over Flat's energy in the same band, which is what "against Flat" means.
pub(crate) const RE_FLAT_BAND: &str = "dB re Flat, same band";

/// Metadata of columns by name: unit and meaning.
type ColumnNotes = HashMap<String, HashMap<String, String>>;

/// Returns what a row of a table or view is; None if there is none of this name.
///
/// ```
/// assert_eq!(echolake_query::table_meaning("pairs"), Some("One row per pair of grid points: distances and angles."));
/// assert_eq!(echolake_query::table_meaning("postgres"), None);
/// ```
pub fn table_meaning(name: &str) -> Option<&'static str> {
    if let Some((SYSTEM_SCHEMA, name)) = name.split_once('.') {
        return system::system_meaning(name);
    }
    Table::by_name(name).map(Table::meaning).or_else(|| LakeView::by_name(name).map(LakeView::meaning))
}

impl LakeView {
    /// All views.
    pub const ALL: [Self; 9] = [
        Self::Ir,
        Self::TnceDb,
        Self::Augmented,
        Self::Catalogue,
        Self::Levels,
        Self::RoomParameters,
        Self::Materials,
        Self::Repeatability,
        Self::FlatDrift,
    ];

    /// Returns its name in SQL.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ir => "ir",
            Self::TnceDb => "tnce_db",
            Self::Augmented => "augmented",
            Self::Catalogue => "catalogue",
            Self::Levels => "levels",
            Self::RoomParameters => "room_parameters",
            Self::Materials => "materials",
            Self::Repeatability => "repeatability",
            Self::FlatDrift => "flat_drift",
        }
    }

    fn meaning(self) -> &'static str {
        match self {
            Self::Ir => "One row per measurement: geometry of the pair, responses and curves.",
            Self::TnceDb => "One row per measurement: TNCE in dB by band, with the geometry of the pair.",
            Self::Augmented => {
                "One row per measurement and symmetry: moved geometry and height map, and responses as they were \
                 measured. The rig's aim and directivity do not turn with the panel, so that energies are off by 0.5 \
                 dB rms at 20 kHz and 1 dB at 40 kHz; flat_ratio_* corrects them."
            }
            Self::Catalogue => "One row per surface: its description, its run and the statistics of its levels.",
            Self::Levels => "One row per surface and band: level and uncertainty over all of its runs.",
            Self::RoomParameters => "One row per measurement and octave: reverberation times, clarity, centre time.",
            Self::Materials => {
                "One row per surface and octave, mean over its runs: absorption and scattering for simulations of \
                 rooms at full scale, with standard uncertainties, and reasons for what is missing."
            }
            Self::Repeatability => {
                "One row per surface, band and kind of level: repeatability and reproducibility over its runs, days \
                 and rigs (ISO 5725-2)."
            }
            Self::FlatDrift => {
                "One row per run of a Flat and band: a control chart, with alarms where the rig drifted or a run \
                 differs."
            }
        }
    }

    /// Returns the view with this name.
    pub fn by_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|v| v.name() == name)
    }

    /// Returns the tables that it reads.
    pub fn source_tables(self) -> &'static [Table] {
        match self {
            Self::Ir => &[Table::Measurements, Table::Nce],
            Self::TnceDb => &[Table::Tnce],
            Self::Augmented => &[Table::Measurements, Table::Nce, Table::Tnce, Table::Heightmaps],
            Self::Catalogue => &[Table::Surfaces, Table::Runs, Table::SurfaceStats],
            Self::Levels | Self::Materials => &[Table::Surfaces, Table::SurfaceStats],
            Self::RoomParameters => &[Table::Measurements],
            Self::Repeatability => &[Table::Runs, Table::SurfaceStats],
            Self::FlatDrift => &[Table::Surfaces, Table::Runs, Table::SurfaceStats],
        }
    }

    /// Returns its definition over the tables.
    pub fn definition_sql(self, lake: &Lake) -> String {
        match self {
            Self::Ir => ir::view_sql(),
            Self::TnceDb => tnce_db::view_sql(lake.rig()),
            Self::Augmented => augmented::view_sql(lake.grid(), lake.rig()),
            Self::Catalogue => catalogue::view_sql(lake.rig()),
            Self::Levels => levels::view_sql(),
            Self::RoomParameters => room_parameters::view_sql(lake.rig()),
            Self::Materials => materials::view_sql(lake.rig()),
            Self::Repeatability => repeatability::view_sql(),
            Self::FlatDrift => flat_drift::view_sql(),
        }
    }

    // Columns taken from the tables keep their own metadata; these are the others.
    fn column_notes(self, lake: &Lake) -> ColumnNotes {
        match self {
            Self::Ir => notes_of(Table::Pairs, lake),
            Self::TnceDb => notes_of(Table::Pairs, lake).into_iter().chain(tnce_db::column_notes(lake.rig())).collect(),
            Self::Augmented => {
                notes_of(Table::TnceD4, lake).into_iter().chain(augmented::column_notes(lake.rig())).collect()
            }
            Self::Catalogue => catalogue::column_notes(lake.rig()),
            Self::Levels => levels::column_notes(),
            Self::RoomParameters => room_parameters::column_notes(),
            Self::Materials => materials::column_notes(),
            Self::Repeatability => repeatability::column_notes(),
            Self::FlatDrift => flat_drift::column_notes(),
        }
    }

    /// Plans the view over tables, which are those of [`LakeView::source_tables`].
    ///
    /// # Errors
    /// If the view does not fit the tables, which is a bug in this crate.
    pub fn plan_over(
        self,
        lake: &Lake,
        lookups: &LookupFunctions,
        tables: &HashMap<Table, Arc<dyn TableProvider>>,
    ) -> Result<ViewTable> {
        let context = SessionContext::new();
        for (table, provider) in tables {
            context.register_table(table.name(), provider.clone())?;
        }
        lookups.register_functions(&context);
        // Aggregates are those of statements, as which a plan of another process understands their names.
        exact_aggregates().into_iter().for_each(|function| context.register_udaf(function));
        let sql = self.definition_sql(lake);
        // Planning only needs tables in memory, so it does not wait.
        let plan = context.state().create_logical_plan(&sql).now_or_never().ok_or_else(|| {
            DataFusionError::Internal(format!("planning the view {} waits for something", self.name()))
        })??;
        Ok(ViewTable::new(annotate_columns(plan, &self.column_notes(lake))?, Some(sql)))
    }

    /// Returns its schema, which is empty if the view does not fit the lake's tables.
    pub fn schema(self, lake: &Lake, lookups: &LookupFunctions) -> SchemaRef {
        let empty = |table: &Table| -> (Table, Arc<dyn TableProvider>) {
            (*table, Arc::new(EmptyTable::new(table.schema(lake.rig()))))
        };
        LazyView::new(self, lake, lookups, self.source_tables().iter().map(empty).collect()).schema()
    }
}

fn annotate_columns(plan: LogicalPlan, notes: &ColumnNotes) -> Result<LogicalPlan> {
    let column = |field: &Arc<Field>| match notes.get(field.name()) {
        Some(note) => ident(field.name()).alias_with_metadata(field.name(), Some(FieldMetadata::from(note))),
        None => ident(field.name()),
    };
    let columns: Vec<_> = plan.schema().fields().iter().map(column).collect();
    LogicalPlanBuilder::from(plan).project(columns)?.build()
}

fn column_note(column: impl Into<String>, unit: &str, comment: impl Into<String>) -> (String, HashMap<String, String>) {
    let metadata = [(UNIT.to_owned(), unit.to_owned()), (COMMENT.to_owned(), comment.into())];
    (column.into(), HashMap::from(metadata))
}

fn notes_of(table: Table, lake: &Lake) -> ColumnNotes {
    table.schema(lake.rig()).fields().iter().map(|f| (f.name().clone(), f.metadata().clone())).collect()
}

#[cfg(test)]
pub(crate) mod tests;
