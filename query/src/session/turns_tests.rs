//! Statements of several clients: turns to compute, blame for what does not end, and who is stopped for memory.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_schema::Rig;

use super::*;
use crate::{EngineLimits, StatementBlame, continue_request};

/// Timeout for what must come; a busy machine needs some of it.
const END_LIMIT: Duration = Duration::from_secs(120);
/// A join that computes for hours without a row.
const BARREN: &str = "select count(*) from generate_series(1, 1000000) a(x) join generate_series(1, 1000000) b(y) \
                      on a.x + b.y < 0";
/// Never ends by itself, and looks often whether it must.
const ENDLESS: &str = "with recursive r as (select 1 n union all select n + 1 from r) select count(*) from r";
/// More batches than wait for a reader.
const LONG: &str = "select x from generate_series(1, 200000) t(x)";
const LONG_ROWS: u64 = 200_000;

async fn engine(computing: usize) -> QueryEngine {
    let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
    let limits = EngineLimits { computing: Some(computing), ..EngineLimits::default() };
    QueryEngine::with_limits(&lake, limits).expect("an engine")
}

fn session(engine: &QueryEngine, client: &str) -> Session {
    engine.open_session(&Arc::new(EngineClient::new(client, QueryQuota::default())))
}

async fn count_rows(mut answer: QueryAnswer) -> Result<u64, Error> {
    let mut rows = 0;
    while let Some(batch) = answer.next().await? {
        rows += batch.num_rows() as u64;
    }
    Ok(rows)
}

async fn outcome(session: &Session, sql: &str) -> Result<u64, Error> {
    let rows = async { count_rows(session.query(sql).await?).await };
    within(rows, sql).await
}

async fn within<T>(work: impl Future<Output = T>, what: &str) -> T {
    tokio::time::timeout(END_LIMIT, work).await.unwrap_or_else(|_| panic!("{what}: no end within {END_LIMIT:?}"))
}

async fn wait_until(mut is_met: impl FnMut() -> bool, what: &str) {
    let begun = Instant::now();
    while !is_met() {
        assert!(begun.elapsed() < END_LIMIT, "{what}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

#[tokio::test]
async fn endless_statements_of_one_client_delay_no_other_one() {
    let engine = engine(3).await;
    let endless: Vec<_> = (0..20)
        .map(|_| {
            let session = session(&engine, "many");
            tokio::spawn(async move { outcome(&session, BARREN).await })
        })
        .collect();
    wait_until(|| engine.count_running() == 20, "all wait or compute").await;
    let (other, third) = (session(&engine, "other"), session(&engine, "third"));
    for _ in 0..3 {
        let answers = tokio::join!(outcome(&other, "select 1"), outcome(&third, "select 1"));
        assert_eq!((answers.0.expect("a row"), answers.1.expect("a row")), (1, 1));
    }
    assert_eq!(engine.count_running(), 20);
    engine.cancel_client("many");
    for one in endless {
        assert!(matches!(one.await.expect("no panic"), Err(Error::Cancelled)));
    }
    wait_until(|| engine.count_running() == 0, "they were cancelled, waiting or not").await;
}

#[tokio::test]
async fn what_nobody_reads_holds_no_turn() {
    let engine = engine(1).await;
    let (first, second) = (session(&engine, "first"), session(&engine, "second"));
    let mut cursors = Vec::new();
    for session in [&first, &second, &first, &second, &first] {
        cursors.push(within(session.query(LONG), "a cursor").await.expect("it begins"));
    }
    assert_eq!(outcome(&second, "select 1").await.expect("a row"), 1);
    // Each goes on where it was, beside the others.
    let mut rows = vec![0; cursors.len()];
    for (cursor, rows) in cursors.iter_mut().zip(&mut rows) {
        let batch = within(cursor.next(), "the first rows").await.expect("rows").expect("rows");
        *rows += batch.num_rows() as u64;
    }
    for (cursor, rows) in cursors.into_iter().zip(rows) {
        assert_eq!(rows + within(count_rows(cursor), "the rest").await.expect("rows"), LONG_ROWS);
    }
    assert_eq!(outcome(&first, LONG).await.expect("rows"), LONG_ROWS);
}

#[tokio::test]
async fn waiting_for_a_turn_takes_of_the_time_and_can_be_cancelled() {
    let engine = engine(1).await;
    let busy = session(&engine, "busy");
    let computing = busy.query(ENDLESS).await.expect("it begins");
    let quota = QueryQuota { time: Some(Duration::from_millis(100)), ..QueryQuota::default() };
    let brief = engine.open_session(&Arc::new(EngineClient::new("brief", quota)));
    assert!(matches!(outcome(&brief, "select 1").await, Err(Error::TimeLimit { .. })));
    let waiting = session(&engine, "waiting");
    let waiting = tokio::spawn(async move { outcome(&waiting, "select 1").await });
    wait_until(|| engine.count_running() == 2, "it waits").await;
    engine.cancel_client("nobody");
    engine.cancel_client("waiting");
    assert!(matches!(waiting.await.expect("no panic"), Err(Error::Cancelled)));
    drop(computing);
    assert_eq!(outcome(&session(&engine, "waiting"), "select 1").await.expect("the turn is free"), 1);
}

/// A request waits for its own query, which needs no turn beside the request's.
#[tokio::test]
async fn a_request_with_queries_of_its_own_needs_one_turn() {
    let engine = engine(1).await;
    let (outer, inner) = (session(&engine, "outer"), session(&engine, "inner"));
    for is_spawned in [false, true] {
        let inner = inner.clone();
        let work = move |_: RequestMemory| async move {
            let query = async move {
                let prepared = inner.prepare("select x from generate_series(1, 200000) t(x) where x > $1").await?;
                let one = ParamValues::List(vec![datafusion::common::ScalarValue::Int64(Some(1)).into()]);
                let answer = inner.execute(&prepared, one).await?;
                // A second one beside it.
                assert_eq!(count_rows(inner.query("select 1").await?).await?, 1);
                count_rows(answer).await
            };
            match is_spawned {
                true => tokio::spawn(continue_request(query)).await.expect("no panic"),
                false => query.await,
            }
        };
        let rows = within(outer.run_request(work), "its own queries").await.expect("rows");
        assert_eq!(rows, LONG_ROWS - 1, "as a task of its own: {is_spawned}");
    }
    assert_eq!(outcome(&outer, "select 1").await.expect("the turn is free"), 1);
}

#[tokio::test]
async fn the_statement_that_holds_most_memory_is_stopped_and_named() {
    let engine = engine(4).await;
    assert_eq!(engine.cancel_largest(), None);
    let hold = |client: &str, bytes: usize, request: u64| {
        let session = session(&engine, client).of_request(Some(request));
        let (begin, begun) = tokio::sync::oneshot::channel();
        let work = move |memory: RequestMemory| async move {
            memory.reserve(bytes)?;
            begin.send(()).expect("somebody waits");
            let held = std::future::pending::<Result<(), Error>>().await;
            drop(memory);
            held
        };
        (tokio::spawn(async move { session.run_request(work).await }), begun)
    };
    let (small, small_begun) = hold("small", 10 << 20, 1);
    let (large, large_begun) = hold("large", 20 << 20, 2);
    within(small_begun, "it holds").await.expect("it begins");
    within(large_begun, "it holds").await.expect("it begins");
    let blame =
        |client: &str, request| StatementBlame { client: client.to_owned(), request: Some(request), statement: None };
    assert_eq!(engine.cancel_largest(), Some(blame("large", 2)));
    let ended = within(large, "it is stopped").await.expect("no panic").expect_err("stopped");
    assert!(matches!(ended, Error::MemoryLimit { .. }), "{ended}");
    assert!(ended.to_string().contains("the server's memory is exhausted"), "{ended}");
    assert_eq!(engine.cancel_largest(), Some(blame("small", 1)));
    assert!(matches!(within(small, "it is stopped").await.expect("no panic"), Err(Error::MemoryLimit { .. })));
    assert_eq!(engine.cancel_largest(), None);
}

/// Work that holds its thread after it was stopped is found by the time that it computes; work that waits is not.
#[tokio::test]
async fn what_computes_on_after_its_end_is_found_and_named() {
    let engine = engine(4).await;
    let grace = Duration::from_millis(50);
    let quota = QueryQuota { time: Some(Duration::from_millis(100)), ..QueryQuota::default() };
    let session = engine.open_session(&Arc::new(EngineClient::new("brief", quota))).of_request(Some(7));
    let hold = async |computes: bool| {
        let (release, released) = std::sync::mpsc::channel::<()>();
        let released = Mutex::new(released);
        let work = async move {
            let released = released.into_inner().expect("no panic");
            match computes {
                true => while released.try_recv() == Err(std::sync::mpsc::TryRecvError::Empty) {},
                false => drop(released.recv()),
            }
            Ok::<(), Error>(())
        };
        let ended = within(session.supervise_work(work), "its time").await;
        assert!(matches!(ended, Err(Error::TimeLimit { .. })), "{ended:?}");
        release
    };
    let waits = hold(false).await;
    for _ in 0..2 {
        assert_eq!(engine.find_runaway(grace), None, "it does not compute");
        tokio::time::sleep(grace * 2).await;
    }
    let computes = hold(true).await;
    wait_until(|| engine.find_runaway(grace).is_some(), "it computes on").await;
    let blame = engine.find_runaway(grace).expect("it still does");
    assert_eq!((blame.client.as_str(), blame.request), ("brief", Some(7)));
    drop(computes);
    wait_until(|| engine.find_runaway(grace).is_none(), "it is over, and is not forgotten").await;
    drop(waits);
    let sql = "select levenshtein(repeat('a', 3), repeat('b', 3))";
    assert_eq!(outcome(&session, sql).await.expect("a row"), 1, "other seats are free");
}
