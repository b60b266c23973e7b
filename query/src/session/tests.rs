//! Sessions on a small lake: answers, refusals, and what an error says.

use arrow::array::AsArray as _;
use arrow::datatypes::{Float64Type, Int64Type};
use echolake_lake::References;
use echolake_schema::Rig;
use futures::TryStreamExt as _;

use super::*;

async fn lake() -> (tempfile::TempDir, Lake) {
    let folder = tempfile::tempdir().expect("a folder");
    let url = folder.path().join("lake").display().to_string();
    let lake = Lake::open_or_create(&url, &Rig::paper(), &References::default()).await.expect("a lake");
    (folder, lake)
}

async fn rows(session: &Session, sql: &str) -> Vec<arrow::record_batch::RecordBatch> {
    let answer = session.query(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
    answer.batches.try_collect().await.unwrap_or_else(|e| panic!("{sql}: {e}"))
}

#[tokio::test]
async fn tables_are_asked_and_joined() {
    let (_folder, lake) = lake().await;
    let session = Session::new(&lake).expect("a session");
    let count = rows(&session, "select count(*) from pairs").await;
    assert_eq!(count[0].column(0).as_primitive::<Int64Type>().value(0), 2951);
    let highest = rows(
        &session,
        "select max(p.z_mm) from pairs join points p on p.point_id = pairs.speaker where pairs.pair_id > 2900",
    )
    .await;
    assert_eq!(highest[0].column(0).as_primitive::<Float64Type>().value(0), 474.0);
    let one = rows(&session, "select direct_mm from pairs where pair_id = 0").await;
    assert_eq!(one.iter().map(|b| b.num_rows()).sum::<usize>(), 1);
    assert_eq!(
        one.iter().find(|b| b.num_rows() > 0).expect("a row").column(0).as_primitive::<Float64Type>().value(0),
        75.0
    );
    assert_eq!(rows(&session, "select * from measurements").await.iter().map(|b| b.num_rows()).sum::<usize>(), 0);
    assert!(!rows(&session, "show tables").await.is_empty());
    assert!(!rows(&session, "describe measurements").await.is_empty());
    assert!(!rows(&session, "explain select * from runs").await.is_empty());
}

#[tokio::test]
async fn nothing_but_reading_is_allowed() {
    let (folder, lake) = lake().await;
    let session = Session::new(&lake).expect("a session");
    let outside = folder.path().join("out.csv");
    for sql in [
        "create table x as select 1".to_owned(),
        "drop table runs".to_owned(),
        "insert into points values (1)".to_owned(),
        "delete from runs".to_owned(),
        format!("copy (select 1) to '{}'", outside.display()),
        "set datafusion.execution.batch_size = 1".to_owned(),
        "create external table x stored as parquet location '/etc'".to_owned(),
        "begin".to_owned(),
        "explain insert into points values (1)".to_owned(),
        "select 1 as a into x".to_owned(),
    ] {
        let error = session.query(&sql).await.map(drop).expect_err(&sql);
        assert!(matches!(error, Error::NotReading { .. }), "{sql}: {error}");
    }
    assert!(!outside.exists());
    let file = format!("select * from '{}'", folder.path().join("lake/lake.toml").display());
    assert!(session.query(&file).await.is_err(), "files are no tables");
    let machine = session.runtime.object_store(ObjectStoreUrl::parse(MACHINE).expect("a URL"));
    assert!(machine.is_err(), "the machine's files are no store of a query");
    assert_eq!(rows(&session, "select * from points").await.iter().map(|b| b.num_rows()).sum::<usize>(), 78);
}

#[tokio::test]
async fn errors_point_at_the_place() {
    let (_folder, lake) = lake().await;
    let session = Session::new(&lake).expect("a session");
    let check = async |sql: &str, expected: &[&str]| {
        let error = session.query(sql).await.map(drop).expect_err(sql).to_string();
        for text in expected {
            assert!(error.contains(text), "{sql}: {error}");
        }
    };
    check(
        "select nonsense from runs",
        &["no column `nonsense`", "\n  select nonsense from runs\n         ^", "hint: "],
    )
    .await;
    check("select pair_idd from pairs", &["did you mean `pair_id`"]).await;
    check("selec 1", &["selec", "^"]).await;
    check("select * from rums", &["no table `rums`", "did you mean `runs`"]).await;
    check("select 1; select 2", &["one statement at a time"]).await;
    check("select 1 +", &["the end of the query", "\n  select 1 +\n            ^"]).await;
}
