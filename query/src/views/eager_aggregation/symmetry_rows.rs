//! The rows of `tnce_d4` from those of `tnce`: one for each measurement and symmetry, with the measurement's energies
//! and the moved pair. Aggregates over `tnce_d4` then read an eighth of the rows, and narrower ones. The stored table stays
//! for other readers, and for all other queries.

use arrow::datatypes::{Field, FieldRef};
use datafusion::common::Column;
use datafusion::datasource::{provider_as_source, source_as_provider};
use datafusion::functions::core::coalesce;
use datafusion::logical_expr::logical_plan::{Join, TableScan};
use datafusion::logical_expr::{Expr, LogicalPlan, LogicalPlanBuilder, lit};
use datafusion::prelude::ident;
use datafusion::scalar::ScalarValue;
use echolake_lake_tables::LakeTable;
use echolake_schema::tables::Table;

use crate::views::LookupFunctions;

/// Alias of the list of symmetries.
const SYMMETRIES: &str = "__symmetries";
const SYMMETRY_ID: &str = "symmetry_id";
const SYMMETRY: &str = "symmetry";

/// What a scan of `tnce_d4` reads, by measurements and symmetries.
pub(super) struct SymmetryRows {
    /// The scan's columns.
    pub columns: Vec<Expr>,
    /// Joins all symmetries, on the left, with all measurements.
    pub join: Join,
}

impl SymmetryRows {
    /// Returns the same rows as those of a scan; None if it is of another table, or the two tables do not have rows of
    /// the same measurements.
    pub fn from_scan(scan: &TableScan, lookups: &LookupFunctions) -> Option<Self> {
        if scan.fetch.is_some() {
            return None;
        }
        let provider = source_as_provider(&scan.source).ok()?;
        let provider: &dyn std::any::Any = provider.as_ref();
        let moved = provider.downcast_ref::<LakeTable>().filter(|table| table.table() == Table::TnceD4)?;
        let measured = moved.measured_rows()?;
        let symmetries = lookups.moved_symmetries();
        let is_same = moved.table_size().rows == measured.table_size().rows * symmetries.len() as u64;
        if symmetries.is_empty() || !is_same || moved.is_faulty() || measured.is_faulty() {
            return None;
        }
        let ids = symmetries.iter().map(|(id, symmetry)| vec![lit(*id), lit(symmetry.name())]).collect();
        let symmetries = LogicalPlanBuilder::values(ids).ok()?;
        let named = [ident("column1").alias(SYMMETRY_ID), ident("column2").alias(SYMMETRY)];
        let symmetries = symmetries.project(named).ok()?.alias(SYMMETRIES).ok()?;
        let measured = LogicalPlanBuilder::scan(Table::Tnce.name(), provider_as_source(measured.clone()), None).ok()?;
        let measured = measured.build().ok()?;
        let column = |field: &FieldRef| {
            moved_column(field, lookups).or_else(|| {
                let place = measured.schema().index_of_column_by_name(None, field.name())?;
                let (relation, own) = measured.schema().qualified_field(place);
                (own.data_type() == field.data_type()).then(|| Expr::Column(Column::from((relation, own))))
            })
        };
        let columns = scan.projected_schema.fields().iter().map(column).collect::<Option<_>>()?;
        let LogicalPlan::Join(join) = symmetries.cross_join(measured).ok()?.build().ok()? else { return None };
        Some(Self { columns, join })
    }
}

// A column of the symmetry, or of the pair that it moves the measured one to. The lookups' results may be null, the
// table's columns are not.
fn moved_column(field: &Field, lookups: &LookupFunctions) -> Option<Expr> {
    let of_symmetries = |name: &str| Expr::Column(Column::new(Some(SYMMETRIES), name));
    if field.name() == SYMMETRY {
        return Some(of_symmetries(SYMMETRY));
    }
    let lookup = lookups.of_moved_pair(field.name())?;
    let pair = Expr::Column(Column::new(Some(Table::Tnce.name()), "pair_id"));
    let moved = lookup.call(vec![pair, of_symmetries(SYMMETRY_ID)]);
    let none = Expr::Literal(ScalarValue::new_default(field.data_type()).ok()?, None);
    Some(coalesce().call(vec![moved, none]))
}
