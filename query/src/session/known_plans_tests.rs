//! Which statements have plans that are kept, and that these are their snapshot's.

use std::sync::Arc;

use arrow::array::AsArray as _;
use arrow::datatypes::Int64Type;
use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_schema::Rig;

use super::tests::put_events;
use crate::{EngineClient, Error, QueryEngine, QueryQuota, Session};

async fn test_lake() -> Lake {
    let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
    lake.ensure_tables().await.expect("tables");
    put_events(&lake, "flat", "r0", "d", 3).await;
    lake
}

fn open_session(lake: &Lake) -> Session {
    let engine = QueryEngine::new(lake, None).expect("an engine");
    engine.open_session(&Arc::new(EngineClient::new("test", QueryQuota::default())))
}

async fn first_number(session: &Session, sql: &str) -> Result<i64, Error> {
    let mut answer = session.query(sql).await?;
    let rows = answer.next().await?.expect("a row");
    assert!(answer.next().await?.is_none(), "{sql}");
    Ok(rows.column(0).as_primitive::<Int64Type>().value(0))
}

#[tokio::test]
async fn a_statement_is_planned_once_on_each_snapshot() {
    let lake = test_lake().await;
    let session = open_session(&lake);
    let sql = "select count(*) from events where surface_id <> 'wall' or run_id > 'r'";
    let kept = async || session.engine.catalog().find_plan(sql).await.expect("a lake");
    assert!(kept().await.is_none());
    assert_eq!(first_number(&session, sql).await.expect("rows"), 3);
    let first = kept().await.expect("it is kept");
    assert_eq!(first_number(&session, sql).await.expect("rows"), 3);
    assert!(Arc::ptr_eq(&first, &kept().await.expect("it is kept")));
    put_events(&lake, "hall", "r1", "d", 4).await;
    assert!(kept().await.is_none(), "the lake has another snapshot");
    assert_eq!(first_number(&session, sql).await.expect("rows"), 7);
    assert!(!Arc::ptr_eq(&first, &kept().await.expect("it is kept")));
}

#[tokio::test]
async fn plans_that_differ_from_run_to_run_or_are_large_are_not_kept() {
    let lake = test_lake().await;
    let session = open_session(&lake);
    let long = format!("select count(*) from events where message <> '{}'", "x".repeat(5000));
    let wide = format!("select {} 1 from points", "x_mm + y_mm, ".repeat(300));
    for (sql, is_kept) in [
        ("select 1", true),
        ("select * from events order by log_time_ns limit 2", true),
        ("select run_id from runs where run_id in (select run_id from events)", true),
        ("select count(*) from ir", true),
        ("explain select * from runs", false),
        ("select now() from runs", false),
        ("select * from events where log_time < now()", false),
        ("select * from runs where run_id in (select run_id from events where random() < 2)", false),
        ("select uuid()", false),
        ("select * from system.ingests", false),
        ("select * from runs as of version 0", false),
        ("select * from information_schema.tables", false),
        ("select repeat('x', 1000000)", false),
        (long.as_str(), false),
        (wide.as_str(), false),
    ] {
        for _ in 0..2 {
            let mut answer = session.query(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
            while answer.next().await.unwrap_or_else(|e| panic!("{sql}: {e}")).is_some() {}
        }
        let kept = session.engine.catalog().find_plan(sql).await.expect("a lake");
        assert_eq!(kept.is_some(), is_kept, "{sql}");
    }
    assert!(session.query("select $1 + 1").await.is_err());
}
