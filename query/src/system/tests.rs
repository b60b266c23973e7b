//! Tables of the schema `system`, on a lake without runs and with a source of the test's own.

use std::sync::Arc;

use arrow::array::{AsArray as _, Int64Array};
use arrow::datatypes::{DataType, Field, Int64Type, Schema, SchemaRef};
use arrow::record_batch::RecordBatch;
use async_trait::async_trait;
use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_schema::Rig;

use super::SystemSource;
use crate::{EngineClient, EngineLimits, Error, QueryEngine, QueryQuota, Session};

#[derive(Debug)]
struct Numbers;

#[async_trait]
impl SystemSource for Numbers {
    fn tables(&self) -> Vec<(&'static str, SchemaRef)> {
        vec![("numbers", Arc::new(Schema::new(vec![Field::new("n", DataType::Int64, false)])))]
    }

    async fn rows(&self, table: &'static str) -> Result<RecordBatch, String> {
        let [(name, schema)] = self.tables().try_into().map_err(|_| "one table")?;
        assert_eq!(table, name);
        RecordBatch::try_new(schema, vec![Arc::new(Int64Array::from(vec![1, 2]))]).map_err(|e| e.to_string())
    }
}

async fn session(source: Option<Arc<dyn SystemSource>>) -> Session {
    let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
    let engine = QueryEngine::new(&lake, EngineLimits::default()).expect("an engine");
    if let Some(source) = source {
        engine.add_system_tables(source);
    }
    engine.session(&Arc::new(EngineClient::new("test", QueryQuota::default())))
}

async fn number(session: &Session, sql: &str) -> i64 {
    let mut answer = session.query(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
    let rows = answer.next().await.expect("rows").expect("a row");
    rows.column(0).as_primitive::<Int64Type>().value(0)
}

#[tokio::test]
async fn the_lake_has_versions_and_files() {
    let session = session(None).await;
    let versions = "select count(*) from system.versions where \"table\" = 'pairs' and rows_added = 2951";
    assert_eq!(number(&session, versions).await, 1);
    let rows = "select rows from system.files where \"table\" = 'pairs' and run_id is null and runs = 0";
    assert_eq!(number(&session, rows).await, 2951);
    assert_eq!(number(&session, "select count(*) from datafusion.system.ingests").await, 0);
}

#[tokio::test]
async fn a_source_adds_tables() {
    let without = session(None).await;
    assert!(matches!(without.query("select * from system.numbers").await, Err(Error::Query { .. })));
    let with = session(Some(Arc::new(Numbers))).await;
    assert_eq!(number(&with, "select sum(n) from system.numbers where n > 1").await, 2);
    let listed = "select count(*) from information_schema.tables where table_schema = 'system'";
    assert_eq!(number(&with, listed).await, 5);
    assert_eq!(number(&with, "select count(*) from system.workers").await, 0);
}
