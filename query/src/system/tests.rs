//! Tables of the schema `system`, on a lake without runs and with a source of the test's own.

use std::sync::Arc;

use arrow::array::{AsArray as _, Int64Array};
use arrow::datatypes::{DataType, Field, Int64Type, Schema, SchemaRef};
use arrow::record_batch::RecordBatch;
use async_trait::async_trait;
use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_schema::Rig;
use object_store::ObjectStoreExt as _;
use object_store::path::Path;

use super::SystemSource;
use crate::{ClusterSettings, EngineClient, Error, QueryEngine, QueryQuota, Session, WorkerCluster};

#[derive(Debug)]
struct Numbers;

#[async_trait]
impl SystemSource for Numbers {
    fn table_schemas(&self) -> Vec<(&'static str, SchemaRef)> {
        vec![("numbers", Arc::new(Schema::new(vec![Field::new("n", DataType::Int64, false)])))]
    }

    async fn read_rows(&self, table: &'static str) -> Result<RecordBatch, String> {
        let [(name, schema)] = self.table_schemas().try_into().map_err(|_| "one table")?;
        assert_eq!(table, name);
        RecordBatch::try_new(schema, vec![Arc::new(Int64Array::from(vec![1, 2]))]).map_err(|e| e.to_string())
    }
}

async fn empty_lake() -> Lake {
    Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake")
}

async fn session(source: Option<Arc<dyn SystemSource>>) -> Session {
    session_of(&empty_lake().await, source)
}

fn session_of(lake: &Lake, source: Option<Arc<dyn SystemSource>>) -> Session {
    let engine = QueryEngine::new(lake, None).expect("an engine");
    let session = engine.open_session(&Arc::new(EngineClient::new("test", QueryQuota::default())));
    match source {
        Some(source) => session.with_system(source),
        None => session,
    }
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
async fn the_inbox_has_what_waits_and_why_files_were_refused() {
    let lake = empty_lake().await;
    let session = session_of(&lake, None);
    assert_eq!(number(&session, "select count(*) from system.inbox").await, 0);
    for (path, content) in [
        ("inbox/a.mcap", "12345"),
        ("inbox/b.mcap.partial", "1"),
        ("inbox/notes.txt", "no run"),
        ("quarantine/c.mcap", "123"),
        ("quarantine/c.mcap.reason.txt", "no magic\n"),
        ("quarantine/d.mcap", "1"),
        ("quarantine/e.mcap", "1"),
        ("quarantine/e.mcap.reason.txt", &"x".repeat(5000)),
    ] {
        lake.store().put(&Path::from(path), content.to_owned().into()).await.expect("written");
    }
    let closed = [&[2, 20, 0, 0, 0, 0, 0, 0, 0][..], &[0; 20], b"\x89MCAP0\r\n"].concat();
    lake.store().put(&Path::from("inbox/closed.mcap"), closed.into()).await.expect("written");
    for (rows, condition) in [
        (6, "changed > timestamp '2026-01-01T00:00:00Z'"),
        (1, "state = 'incomplete' and path = 'inbox/a.mcap' and bytes = 5 and reason is null"),
        (1, "state = 'waiting' and path = 'inbox/closed.mcap' and bytes = 37"),
        (1, "state = 'recording' and path = 'inbox/b.mcap.partial'"),
        (1, "state = 'refused' and path = 'quarantine/c.mcap' and bytes = 3 and reason = 'no magic'"),
        (1, "path = 'quarantine/d.mcap' and reason is null"),
        (1, "path = 'quarantine/e.mcap' and length(reason) = 4096"),
    ] {
        let sql = format!("select count(*) from system.inbox where {condition}");
        assert_eq!(number(&session, &sql).await, rows, "{condition}");
    }
    let restricted = session_of(&lake.restricted_to(["ours".parse().expect("a name")].into()), None);
    assert_eq!(number(&restricted, "select count(*) from system.inbox").await, 0);
}

#[tokio::test]
async fn a_source_adds_tables() {
    let without = session(None).await;
    assert!(matches!(without.query("select * from system.numbers").await, Err(Error::Query { .. })));
    let with = session(Some(Arc::new(Numbers))).await;
    assert_eq!(number(&with, "select cast(sum(n) as bigint) from system.numbers where n > 1").await, 2);
    let listed = "select count(*) from information_schema.tables where table_schema = 'system'";
    assert_eq!(number(&with, listed).await, 6);
    assert_eq!(number(&with, "select count(*) from system.workers").await, 0);
}

#[tokio::test]
async fn a_cluster_adds_its_workers() {
    let lake = empty_lake().await;
    let without = session_of(&lake, None);
    assert!(matches!(without.query("select * from system.workers").await, Err(Error::Query { .. })));
    let engine = QueryEngine::new(&lake, None).expect("an engine");
    let settings = ClusterSettings {
        workers: vec!["http://127.0.0.1:1".to_owned(), "http://127.0.0.1:2".to_owned()],
        token: None,
        authorities: None,
        least_bytes: 0,
        build: "0.1.0-test".to_owned(),
    };
    engine.spread_over(Arc::new(WorkerCluster::new(&settings, "a lake").expect("a cluster")));
    // For readers with any right.
    let restricted = lake.restricted_to(["ours".parse().expect("a name")].into());
    for engine in [engine.of_lake(&restricted).expect("the same lake"), engine] {
        let session = engine.open_session(&Arc::new(EngineClient::new("test", QueryQuota::default())));
        assert_eq!(number(&session, "select count(*) from system.workers where state = 'not used'").await, 2);
    }
}
