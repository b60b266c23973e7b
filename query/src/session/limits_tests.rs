//! Queries that must end: cancelled, over their time, row or memory limit, or because the answer was dropped.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use datafusion::sql::sqlparser::dialect::GenericDialect;
use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_schema::Rig;

use super::*;
use crate::check_statement_bounds;

/// Timeout for a stopped query to end; a busy machine needs some of it.
const END_LIMIT: Duration = Duration::from_secs(120);
/// Never ends by itself.
const ENDLESS: &str = "with recursive r as (select 1 n union all select n + 1 from r) select count(*) from r";
/// A join that runs for hours without a row.
const BARREN: &str = "select count(*) from generate_series(1, 1000000) a(x) join generate_series(1, 1000000) b(y) \
                      on a.x + b.y < 0";
/// The same by order.
const BARREN_ORDER: &str = "select count(*) from generate_series(1, 1000000) a(x) join generate_series(1, 1000000) b(y) \
                            on a.x >= b.y and a.x + b.y < 0";

async fn engine(memory: Option<usize>) -> (tempfile::TempDir, QueryEngine) {
    let folder = tempfile::tempdir().expect("a folder");
    let url = folder.path().join("lake").display().to_string();
    let lake = Lake::open_or_create(&url, &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
    (folder, QueryEngine::new(&lake, memory).expect("an engine"))
}

fn session(engine: &QueryEngine, quota: QueryQuota) -> Session {
    engine.open_session(&Arc::new(EngineClient::new("somebody", quota)))
}

async fn outcome(session: &Session, sql: &str) -> Result<u64, Error> {
    let rows = async {
        let mut answer = session.query(sql).await?;
        let mut rows = 0;
        while let Some(batch) = answer.next().await? {
            rows += batch.num_rows() as u64;
        }
        Ok(rows)
    };
    tokio::time::timeout(END_LIMIT, rows).await.unwrap_or_else(|_| panic!("{sql}: no end within {END_LIMIT:?}"))
}

#[tokio::test]
async fn a_query_ends_when_it_is_cancelled() {
    let (_folder, engine) = engine(None).await;
    for sql in [ENDLESS, BARREN, BARREN_ORDER] {
        let mut answer = session(&engine, QueryQuota::default()).query(sql).await.expect("it begins");
        let handle = answer.cancel_handle();
        let reading = tokio::spawn(async move { answer.next().await.map(|_| ()) });
        tokio::time::sleep(Duration::from_millis(50)).await;
        handle.cancel();
        let ended = tokio::time::timeout(END_LIMIT, reading).await.expect("in time").expect("no panic");
        assert!(matches!(ended, Err(Error::Cancelled)), "{sql}: {ended:?}");
    }
    assert_eq!(engine.count_running(), 0, "what is cancelled does not count");
}

#[tokio::test]
async fn time_rows_and_places_are_limited() {
    let (_folder, engine) = engine(None).await;
    let brief = session(&engine, QueryQuota { time: Some(Duration::from_millis(100)), ..QueryQuota::default() });
    assert!(matches!(outcome(&brief, ENDLESS).await, Err(Error::TimeLimit { .. })));
    let few = session(&engine, QueryQuota { rows: Some(10), ..QueryQuota::default() });
    assert!(matches!(outcome(&few, "select * from pairs").await, Err(Error::RowLimit { limit: 10 })));
    assert_eq!(outcome(&few, "select * from pairs limit 10").await.expect("ten rows"), 10);
    let alone = session(&engine, QueryQuota { concurrent: Some(1), ..QueryQuota::default() });
    let first = alone.query(BARREN).await.expect("it begins");
    assert!(matches!(alone.query("select 1").await, Err(Error::Busy { limit: 1, .. })));
    drop(first);
    let begun = Instant::now();
    while alone.query("select 1").await.is_err() {
        assert!(begun.elapsed() < END_LIMIT, "the place of a dropped query never came back");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

/// E3: work that is no query has the limits of one.
#[tokio::test]
async fn a_request_is_limited_as_a_query() {
    let (_folder, engine) = engine(Some(32 << 20)).await;
    let quota = QueryQuota { time: Some(Duration::from_millis(100)), concurrent: Some(1), ..QueryQuota::default() };
    let brief = session(&engine, quota);
    let ended = brief.run_request(|_| std::future::pending::<Result<(), Error>>()).await;
    assert!(matches!(ended, Err(Error::TimeLimit { .. })), "{ended:?}");
    let alone = session(&engine, QueryQuota { concurrent: Some(1), ..QueryQuota::default() });
    let (begin, mut begun) = mpsc::channel(1);
    let (end, mut ended) = mpsc::channel::<()>(1);
    let work = move |memory: RequestMemory| async move {
        // Dropped in reverse order: when the end is seen, the memory is free.
        let _end = end;
        let memory = memory;
        memory.reserve(20 << 20)?;
        begin.send(()).await.expect("somebody waits");
        std::future::pending::<Result<(), Error>>().await
    };
    let other = session(&engine, QueryQuota::default());
    {
        let running = alone.run_request(work);
        tokio::pin!(running);
        tokio::select! {
            done = &mut running => panic!("it does not end: {done:?}"),
            _ = begun.recv() => {}
        }
        assert_eq!(engine.count_running(), 1);
        assert!(matches!(alone.query("select 1").await, Err(Error::Busy { limit: 1, .. })));
        let held = other.run_request(|memory| async move { memory.reserve(20 << 20) }).await;
        assert!(matches!(held, Err(Error::MemoryLimit { .. })), "{held:?}");
    }
    // Its client left: the work is dropped, and with it what it held.
    assert_eq!(tokio::time::timeout(END_LIMIT, ended.recv()).await.expect("in time"), None);
    other.run_request(|memory| async move { memory.reserve(20 << 20) }).await.expect("it is free");
    let begun = Instant::now();
    while alone.query("select 1").await.is_err() {
        assert!(begun.elapsed() < END_LIMIT, "the place of a dropped request never came back");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

#[tokio::test]
async fn memory_is_limited() {
    let (_folder, engine) = engine(Some(32 << 20)).await;
    let session = session(&engine, QueryQuota::default());
    for sql in [
        // One list of all values, which cannot be spilled to disk.
        "select array_agg(x || 'abcdefghijklmnopqrstuvwxyz') from generate_series(1, 10000000) t(x)",
        // One window of all rows.
        "select count(*) from generate_series(1, 1000000) a(x) join generate_series(1, 5000000) b(y) on b.y >= a.x",
    ] {
        let ended = outcome(&session, sql).await;
        assert!(matches!(ended, Err(Error::MemoryLimit { .. })), "{sql}: {ended:?}");
    }
}

#[tokio::test]
async fn work_that_holds_its_threads_delays_no_query() {
    let (_folder, engine) = engine(None).await;
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let (release, released) = std::sync::mpsc::channel::<()>();
    let released = Arc::new(Mutex::new(released));
    let (begin, mut begun) = mpsc::unbounded_channel();
    // As an operator that does not wait, on one thread.
    let hold = move || {
        let (released, begin) = (released.clone(), begin.clone());
        async move {
            begin.send(()).expect("somebody counts");
            let _ = released.lock().expect("no panic").recv();
        }
    };
    let hold_all = async move {
        let holding: Vec<_> = (0..cores).map(|_| tokio::spawn(hold())).collect();
        for one in holding {
            one.await.expect("no panic");
        }
        Ok::<(), Error>(())
    };
    let holder = session(&engine, QueryQuota::default());
    let holding = tokio::spawn(async move { holder.supervise_work(hold_all).await });
    for _ in 0..cores {
        tokio::time::timeout(END_LIMIT, begun.recv()).await.expect("in time").expect("it begins");
    }
    assert_eq!(outcome(&session(&engine, QueryQuota::default()), "select 1").await.expect("a row"), 1);
    drop(release);
    holding.await.expect("no panic").expect("it ends");
}

#[tokio::test]
async fn an_answer_outlives_its_session() {
    let (_folder, engine) = engine(None).await;
    let mut answer = session(&engine, QueryQuota::default()).query("select * from pairs").await.expect("it begins");
    drop(engine);
    let mut rows = 0;
    while let Some(batch) = answer.next().await.expect("rows") {
        rows += batch.num_rows();
    }
    assert_eq!(rows, 2951);
}

mod slow {
    use super::*;

    // A stack that is too small ends the whole process, and this test with it.
    #[tokio::test]
    async fn the_longest_chains_that_pass_fit_the_stacks() {
        let (_folder, engine) = engine(None).await;
        let session = session(&engine, QueryQuota::default());
        for (again, end) in [
            ("1 + ", "1"),
            ("x + ", "1"),
            ("1.5 / x - ", "x"),
            ("x = 1 and ", "true"),
            ("x > 7 or ", "true"),
            ("'a' || ", "x"),
            ("cast(x as int) :: text || ", "x"),
            ("x union all select ", "1"),
        ] {
            let most = (1..1100).rev().find(|times| {
                check_statement_bounds(&format!("select {}{end}", again.repeat(*times)), &GenericDialect {}).is_ok()
            });
            let sql =
                format!("select {}{end} from generate_series(1, 2) t(x)", again.repeat(most.expect("one passes")));
            let ended =
                outcome(&session, &sql.replace("x union all", "x from generate_series(1, 2) t(x) union all")).await;
            assert!(ended.is_ok(), "{again}: {:.200}", format!("{ended:?}"));
        }
        // Postfix operators.
        for again in [" is null", "::bigint"] {
            let sql = format!("select x{} from generate_series(1, 2) t(x)", again.repeat(999));
            let ended = outcome(&session, &sql).await;
            assert!(ended.is_ok(), "{again}: {:.200}", format!("{ended:?}"));
        }
    }
}
