//! Plans are kept of the right statements, and are those of their snapshot.

use std::sync::Arc;

use arrow::array::AsArray as _;
use arrow::datatypes::Int64Type;
use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_schema::Rig;

use crate::views::tests::put;
use crate::{EngineClient, Error, QueryEngine, QueryQuota, Session};

async fn test_lake() -> Lake {
    let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
    lake.ensure_tables().await.expect("tables");
    put(&lake, "flat", "r0").await;
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
    let sql = "select count(*) from measurements where surface_id <> 'wall' or run_id > 'r'";
    let kept = async || session.engine.catalog().find_plan(sql).await.expect("a lake");
    assert!(kept().await.is_none());
    let rows = first_number(&session, sql).await.expect("rows");
    let first = kept().await.expect("it is kept");
    assert_eq!(first_number(&session, sql).await.expect("rows"), rows);
    assert!(Arc::ptr_eq(&first, &kept().await.expect("it is kept")));
    put(&lake, "hall", "r1").await;
    assert!(kept().await.is_none(), "the lake has another snapshot");
    assert_eq!(first_number(&session, sql).await.expect("rows"), 2 * rows);
    assert!(!Arc::ptr_eq(&first, &kept().await.expect("it is kept")));
}

#[tokio::test]
async fn plans_that_differ_from_run_to_run_or_are_large_are_not_kept() {
    let lake = test_lake().await;
    let session = open_session(&lake);
    let long = format!("select count(*) from runs where run_id <> '{}'", "x".repeat(5000));
    let wide = format!("select count(*) from points where x_mm in ({}1)", "1,".repeat(2000));
    for (sql, is_kept) in [
        ("select 1", true),
        ("select * from measurements order by log_time_ns limit 2", true),
        ("select run_id from runs where run_id in (select run_id from tnce)", true),
        ("select count(*) from ir", true),
        ("explain select * from runs", false),
        ("select now() from runs", false),
        ("select * from runs where now() > to_timestamp(0)", false),
        ("select * from runs where run_id in (select run_id from tnce where random() < 2)", false),
        ("select uuid()", false),
        ("select * from system.ingests", false),
        ("select * from runs version as of 1", false),
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
