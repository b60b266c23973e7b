//! A view that is planned when it is needed.

use std::borrow::Cow;
use std::collections::HashMap;
use std::sync::{Arc, LazyLock};

use arrow::datatypes::{Schema, SchemaRef};
use async_trait::async_trait;
use datafusion::catalog::Session;
use datafusion::datasource::{TableProvider, TableType, ViewTable};
use datafusion::error::{DataFusionError, Result};
use datafusion::logical_expr::{Expr, LogicalPlan};
use datafusion::physical_plan::ExecutionPlan;
use echolake_lake::Lake;
use echolake_schema::tables::Table;

use super::{LakeView, LookupFunctions};

type ViewPlanner = Box<dyn FnOnce() -> Result<ViewTable> + Send>;

/// A view over tables of one snapshot, planned by the first query that names it: planning all views takes longer than
/// most queries. If it cannot be planned, which is a bug in this crate, it has no columns, and its scan fails.
#[derive(Debug)]
pub(crate) struct LazyView(LazyLock<Result<ViewTable>, ViewPlanner>);

impl LazyView {
    /// `tables` are those of [`LakeView::source_tables`].
    pub fn new(
        view: LakeView,
        lake: &Lake,
        lookups: &LookupFunctions,
        tables: HashMap<Table, Arc<dyn TableProvider>>,
    ) -> Self {
        let lake = lake.clone();
        let lookups = lookups.clone();
        Self(LazyLock::new(Box::new(move || view.plan_over(&lake, &lookups, &tables))))
    }

    fn planned_view(&self) -> Option<&ViewTable> {
        self.0.as_ref().ok()
    }
}

#[async_trait]
impl TableProvider for LazyView {
    fn schema(&self) -> SchemaRef {
        self.planned_view().map_or_else(|| Arc::new(Schema::empty()), TableProvider::schema)
    }

    fn table_type(&self) -> TableType {
        TableType::View
    }

    fn get_table_definition(&self) -> Option<&str> {
        self.planned_view()?.get_table_definition()
    }

    fn get_logical_plan(&self) -> Option<Cow<'_, LogicalPlan>> {
        self.planned_view()?.get_logical_plan()
    }

    // DataFusion puts the plan of a view in the place of its scan.
    async fn scan(
        &self,
        _: &dyn Session,
        _: Option<&Vec<usize>>,
        _: &[Expr],
        _: Option<usize>,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        let error = self.0.as_ref().err().map(ToString::to_string);
        Err(DataFusionError::Internal(error.unwrap_or_else(|| "a view is scanned".to_owned())))
    }
}
