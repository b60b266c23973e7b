//! The catalogue of one query: tables of one frozen view of the lake, and what the query names beside them.

use std::sync::Arc;

use arrow::datatypes::SchemaRef;
use datafusion::prelude::SessionContext;
use datafusion::sql::parser::Statement;
use echolake_lake::Lake;
use echolake_schema::tables::Table;

use crate::Error;
use crate::mcap;
use crate::table::{LakeTable, Source};

/// Makes the tables of a lake known to a query's context.
pub(crate) struct Catalog {
    lake: Lake,
    source: Source,
    runs: Arc<mcap::Files>,
}

impl Catalog {
    pub(crate) fn new(lake: &Lake, source: Source) -> Self {
        Self { lake: lake.clone(), source, runs: Arc::new(mcap::Files::new(lake.store())) }
    }

    /// Registers what `statement` may name, all of one view of the lake. The statement is known before its plan, since
    /// what it names may have to be looked up, and planning cannot wait.
    ///
    /// # Errors
    /// [`Error::Lake`] where the lake cannot be read.
    pub(crate) async fn register(&self, context: &SessionContext, statement: &mut Statement) -> Result<(), Error> {
        let snapshot = self.lake.snapshot().await?;
        for table in Table::ALL {
            let files = snapshot.files(table).to_vec();
            let provider = LakeTable::new(table.schema(self.lake.rig()), files, self.source.clone());
            context.register_table(table.name(), Arc::new(provider)).map_err(|e| Error::execution(&e))?;
        }
        mcap::register(context, &snapshot, &self.runs, statement).await
    }

    /// The tables and their schemas.
    pub(crate) fn tables(&self) -> impl Iterator<Item = (&'static str, SchemaRef)> {
        Table::ALL.into_iter().map(|t| (t.name(), t.schema(self.lake.rig())))
    }
}
