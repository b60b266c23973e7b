//! The schema of one query: tables that many queries share, and its own over them.

use std::collections::HashMap;
use std::sync::{Arc, PoisonError, RwLock};

use async_trait::async_trait;
use datafusion::catalog::{SchemaProvider, TableProvider};
use datafusion::common::exec_err;
use datafusion::error::Result;

/// Tables by name.
pub(crate) type NamedTables = HashMap<String, Arc<dyn TableProvider>>;

/// A schema whose shared tables are made once per snapshot. A query adds its own, such as past tables, to the overlay
/// alone.
#[derive(Debug)]
pub(crate) struct OverlaySchema {
    shared: Arc<NamedTables>,
    own: RwLock<NamedTables>,
}

impl OverlaySchema {
    /// Lays an empty schema over shared tables.
    pub fn new(shared: &Arc<NamedTables>) -> Self {
        Self { shared: shared.clone(), own: RwLock::default() }
    }

    fn find_table(&self, name: &str) -> Option<Arc<dyn TableProvider>> {
        let own = self.own.read().unwrap_or_else(PoisonError::into_inner);
        own.get(name).or_else(|| self.shared.get(name)).cloned()
    }
}

#[async_trait]
impl SchemaProvider for OverlaySchema {
    fn table_names(&self) -> Vec<String> {
        let own = self.own.read().unwrap_or_else(PoisonError::into_inner);
        self.shared.keys().chain(own.keys()).cloned().collect()
    }

    async fn table(&self, name: &str) -> Result<Option<Arc<dyn TableProvider>>> {
        Ok(self.find_table(name))
    }

    fn register_table(&self, name: String, table: Arc<dyn TableProvider>) -> Result<Option<Arc<dyn TableProvider>>> {
        if self.table_exist(&name) {
            return exec_err!("The table {name} already exists");
        }
        Ok(self.own.write().unwrap_or_else(PoisonError::into_inner).insert(name, table))
    }

    fn table_exist(&self, name: &str) -> bool {
        self.find_table(name).is_some()
    }
}

#[cfg(test)]
mod tests {
    use arrow::datatypes::Schema;
    use datafusion::datasource::empty::EmptyTable;

    use super::*;

    #[tokio::test]
    async fn a_query_adds_tables_to_its_own_schema_alone() {
        let table = || Arc::new(EmptyTable::new(Arc::new(Schema::empty()))) as Arc<dyn TableProvider>;
        let shared = Arc::new(NamedTables::from([("runs".to_owned(), table())]));
        let [first, second] = [(); 2].map(|()| OverlaySchema::new(&shared));
        assert!(first.register_table("runs@1".to_owned(), table()).expect("added").is_none());
        let error = first.register_table("runs".to_owned(), table()).expect_err("a shared table is not replaced");
        assert!(error.to_string().contains("already exists"), "{error}");
        assert!(first.table("runs@1").await.expect("found").is_some() && first.table_exist("runs"));
        assert!(second.table("runs@1").await.expect("looked up").is_none());
        assert_eq!(second.table_names(), ["runs"]);
        assert_eq!(shared.len(), 1);
    }
}
