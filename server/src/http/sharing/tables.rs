//! The shared tables: the tables, and the views without lists, for programs that have no use for 384 samples in a cell.

use arrow::datatypes::SchemaRef;
use echolake_lake::delta_schema;
use echolake_schema::tables::Table;
use sha2::{Digest as _, Sha256};

use super::super::catalogue::LakeCatalogue;
use crate::fault::RequestFault;

/// Columns by which the rows of a file that is made on request are sorted, so that it is the same each time.
const SORTED_BY: [&str; 4] = ["surface_id", "run_id", "pair_id", "symmetry"];

/// A shared table.
pub(super) struct SharedTable {
    name: &'static str,
    schema: SchemaRef,
    /// The table; None for a view.
    pub(super) table: Option<Table>,
}

impl SharedTable {
    /// All of them.
    pub(super) fn all(catalogue: &LakeCatalogue) -> Vec<Self> {
        let all = catalogue.service().tables().into_iter();
        let shared = all.map(|(name, schema)| Self { name, schema, table: Table::by_name(name) });
        shared.filter(|shared| shared.table.is_some() || !shared.has_lists()).collect()
    }

    /// The table of a name.
    ///
    /// # Errors
    /// [`RequestFault::NotFound`].
    pub(super) fn by_name(catalogue: &LakeCatalogue, name: &str) -> Result<Self, RequestFault> {
        let found = Self::all(catalogue).into_iter().find(|shared| shared.name.eq_ignore_ascii_case(name));
        found.ok_or_else(|| RequestFault::NotFound {
            what: format!("shared table `{name}`"),
            hint: "GET /delta-sharing/shares/echolake/all-tables lists what there is; views with lists are not shared",
        })
    }

    /// Its name.
    pub(super) fn name(&self) -> &'static str {
        self.name
    }

    /// A number that is the table's, in the form of a UUID.
    pub(super) fn id(&self, lake: &str) -> String {
        let digest = hex::encode(Sha256::digest(format!("{lake} {}", self.name)));
        let parts = [&digest[..8], &digest[8..12], &digest[12..16], &digest[16..20], &digest[20..32]];
        parts.join("-")
    }

    /// Its schema, as Delta writes it.
    pub(super) fn schema_text(&self) -> String {
        delta_schema(&self.schema).to_string()
    }

    /// The query of its rows with a condition, sorted.
    pub(super) fn select(&self, condition: &str) -> String {
        let keys = SORTED_BY.into_iter().filter(|key| self.schema.field_with_name(key).is_ok());
        let keys: Vec<_> = keys.collect();
        let order = if keys.is_empty() { String::new() } else { format!(" order by {}", keys.join(", ")) };
        format!("select * from {}{condition}{order}", self.name)
    }

    fn has_lists(&self) -> bool {
        self.schema.fields().iter().any(|field| field.data_type().is_nested())
    }
}
