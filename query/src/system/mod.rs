//! Tables of the schema `system`: versions and files of the lake and how its runs came into it, all as the query's
//! snapshot has them; run files that are not in it yet; those that the program around the engine has of itself
//! ([`SystemSource`]), and its workers.

mod files;
mod inbox;
mod ingests;
mod source;
mod versions;
mod workers;

use std::collections::HashMap;
use std::sync::Arc;

use arrow::array::ArrayRef;
use arrow::datatypes::{DataType, Field, Schema, SchemaRef, TimeUnit};
use arrow::record_batch::RecordBatch;
use async_trait::async_trait;
use datafusion::catalog::Session;
use datafusion::datasource::memory::MemorySourceConfig;
use datafusion::datasource::{TableProvider, TableType};
use datafusion::error::Result;
use datafusion::logical_expr::Expr;
use datafusion::physical_plan::ExecutionPlan;
use echolake_lake::{Lake, LakeSnapshot};
use echolake_lake_tables::FileReaders;
use echolake_schema::tables::{COMMENT, UNIT};

use files::LakeFiles;
use inbox::LakeInbox;
use ingests::LakeIngests;
use source::SourceRows;
pub use source::SystemSource;
use versions::LakeVersions;
use workers::ClusterWorkers;

use crate::spread::WorkerCluster;

/// The schema of the system tables.
pub const SYSTEM_SCHEMA: &str = "system";

/// Computes the rows of a table when it is scanned.
#[async_trait]
pub(crate) trait SystemRows: std::fmt::Debug + Send + Sync {
    /// Returns its columns.
    fn schema(&self) -> SchemaRef;

    /// Returns its rows.
    async fn read_rows(&self, session: &dyn Session) -> Result<RecordBatch>;
}

/// A table whose rows are computed when it is scanned.
#[derive(Debug)]
pub(crate) struct SystemTable(pub Box<dyn SystemRows>);

#[async_trait]
impl TableProvider for SystemTable {
    fn schema(&self) -> SchemaRef {
        self.0.schema()
    }

    fn table_type(&self) -> TableType {
        TableType::Temporary
    }

    async fn scan(
        &self,
        session: &dyn Session,
        projection: Option<&Vec<usize>>,
        _: &[Expr],
        _: Option<usize>,
    ) -> Result<Arc<dyn ExecutionPlan>> {
        let rows = self.0.read_rows(session).await?;
        Ok(MemorySourceConfig::try_new_exec(&[vec![rows]], self.0.schema(), projection.cloned())?)
    }
}

/// The tables of one snapshot; `runs` is its table of that name, whose files `readers` read.
pub(crate) fn lake_tables(
    lake: &Lake,
    snapshot: &Arc<LakeSnapshot>,
    runs: Arc<dyn TableProvider>,
    readers: &FileReaders,
) -> [(&'static str, Arc<dyn TableProvider>); 4] {
    let ingests = LakeIngests { lake: lake.clone(), snapshot: snapshot.clone(), runs, readers: readers.clone() };
    let table = |rows: Box<dyn SystemRows>| Arc::new(SystemTable(rows)) as Arc<dyn TableProvider>;
    [
        ("versions", table(Box::new(LakeVersions { lake: lake.clone() }))),
        ("files", table(Box::new(LakeFiles { snapshot: snapshot.clone() }))),
        ("inbox", table(Box::new(LakeInbox { lake: lake.clone() }))),
        ("ingests", table(Box::new(ingests))),
    ]
}

/// Returns the names and columns of the tables that every lake has; `runs` are the columns of its table of that name.
pub(crate) fn lake_columns(runs: &SchemaRef) -> [(&'static str, SchemaRef); 4] {
    [
        ("versions", versions::table_schema()),
        ("files", files::table_schema()),
        ("inbox", inbox::table_schema()),
        ("ingests", ingests::table_schema(runs)),
    ]
}

/// Returns the meaning of a system table.
pub(crate) fn system_meaning(name: &str) -> Option<&'static str> {
    Some(match name {
        "versions" => "One row per version of a table: time, operation, files and rows that came and went.",
        "files" => "One row per data file of the snapshot: table, path, bytes, rows, surface and run.",
        "inbox" => "One row per run file that is in no table yet: waiting, being recorded, or refused with a reason.",
        "ingests" => {
            "One row per run of the snapshot: the version of the lake that has its present rows, and its time."
        }
        "queries" => "One row per query of the server that runs, or ran lately: client, statement, times, outcome.",
        "connections" => "One row per open connection to the server: client, protocol, address.",
        "workers" => "One row per worker over which heavy queries are spread: address, state, figures.",
        _ => return None,
    })
}

/// Returns the tables that the program around the engine has of itself, and that of the engine's workers. A server has
/// the latter even without workers, so that its tables are the same in all of its engines.
pub(crate) fn engine_tables(
    source: Option<&Arc<dyn SystemSource>>,
    cluster: Option<&Arc<WorkerCluster>>,
) -> Vec<(&'static str, Arc<dyn TableProvider>)> {
    let make_table = |rows: Box<dyn SystemRows>| Arc::new(SystemTable(rows)) as Arc<dyn TableProvider>;
    let mut tables = Vec::new();
    if source.is_some() || cluster.is_some() {
        tables.push(("workers", make_table(Box::new(ClusterWorkers { cluster: cluster.cloned() }))));
    }
    if let Some(source) = source {
        for (name, schema) in source.table_schemas() {
            tables.push((name, make_table(Box::new(SourceRows { source: source.clone(), name, schema }))));
        }
    }
    tables
}

/// A column with its unit, empty if it has none, and its meaning.
fn column_field(name: &str, kind: DataType, is_nullable: bool, unit: &str, comment: &str) -> Field {
    let metadata = [(UNIT.to_owned(), unit.to_owned()), (COMMENT.to_owned(), comment.to_owned())];
    Field::new(name, kind, is_nullable).with_metadata(HashMap::from(metadata))
}

/// The type of times.
fn time_type() -> DataType {
    DataType::Timestamp(TimeUnit::Microsecond, Some("UTC".into()))
}

fn build_schema(columns: impl IntoIterator<Item = Field>) -> SchemaRef {
    Arc::new(Schema::new(columns.into_iter().collect::<Vec<_>>()))
}

fn build_batch(schema: SchemaRef, columns: Vec<ArrayRef>) -> Result<RecordBatch> {
    Ok(RecordBatch::try_new(schema, columns)?)
}

#[cfg(test)]
mod tests;
