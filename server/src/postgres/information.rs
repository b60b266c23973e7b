//! `information_schema` as Postgres has it, by whose types clients choose kinds of columns, and DataFusion's tables that
//! are not in it. Over the other protocols it is DataFusion's, with Arrow's types.

use std::collections::HashMap;
use std::sync::{Arc, Weak};

use async_trait::async_trait;
use datafusion::catalog::information_schema::InformationSchemaProvider;
use datafusion::catalog::{CatalogProviderList, SchemaProvider, TableFunction, TableProvider};
use datafusion::error::Result;
use datafusion::execution::session_state::SessionState;

use super::relations::NamedTables;

/// Postgres' tables, then DataFusion's of a query's catalogues.
#[derive(Debug)]
pub(super) struct InformationSchema {
    own: Arc<NamedTables>,
    /// Of which one holds this.
    catalogs: Weak<dyn CatalogProviderList>,
    functions: HashMap<String, Arc<TableFunction>>,
}

impl InformationSchema {
    /// For queries that begin in this state.
    pub(super) fn new(own: Arc<NamedTables>, state: &SessionState) -> Self {
        let functions = state.table_functions().clone();
        Self { own, catalogs: Arc::downgrade(state.catalog_list()), functions }
    }

    fn inner(&self) -> Option<InformationSchemaProvider> {
        let catalogs = self.catalogs.upgrade()?;
        Some(InformationSchemaProvider::new(catalogs).with_table_functions(self.functions.clone()))
    }
}

#[async_trait]
impl SchemaProvider for InformationSchema {
    fn table_names(&self) -> Vec<String> {
        let mut names: Vec<_> = self.inner().map(|inner| inner.table_names()).unwrap_or_default();
        names.retain(|name| !self.own.contains_key(name));
        names.extend(self.own.keys().cloned());
        names
    }

    async fn table(&self, name: &str) -> Result<Option<Arc<dyn TableProvider>>> {
        match (self.own.get(name), self.inner()) {
            (Some(own), _) => Ok(Some(own.clone())),
            (None, Some(inner)) => inner.table(name).await,
            (None, None) => Ok(None),
        }
    }

    fn table_exist(&self, name: &str) -> bool {
        self.own.contains_key(name) || self.inner().is_some_and(|inner| inner.table_exist(name))
    }
}
