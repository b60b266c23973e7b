//! What an engine's rights share, and what they do not; timers.

use std::collections::BTreeSet;

use arrow::array::AsArray as _;
use echolake_lake::ReferenceSurfaces;
use echolake_schema::Rig;

use super::*;
use crate::session::tests::put_events;
use crate::{EngineClient, Session};

async fn lake() -> (tempfile::TempDir, Lake) {
    let folder = tempfile::tempdir().expect("a folder");
    let url = folder.path().join("lake").display().to_string();
    let lake = Lake::open_or_create(&url, &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
    (folder, lake)
}

fn session(engine: &QueryEngine) -> Session {
    engine.open_session(&Arc::new(EngineClient::new("test", QueryQuota::default())))
}

fn reader_of(lake: &Lake, project: &str) -> Lake {
    lake.restricted_to([project.parse().expect("a name")].into())
}

async fn texts(engine: &QueryEngine, sql: &str) -> BTreeSet<String> {
    let mut answer = session(engine).query(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
    let mut texts = BTreeSet::new();
    while let Some(batch) = answer.next().await.unwrap_or_else(|e| panic!("{sql}: {e}")) {
        texts.extend(batch.column(0).as_string::<i32>().iter().flatten().map(str::to_owned));
    }
    texts
}

fn set(texts: &[&str]) -> BTreeSet<String> {
    texts.iter().map(|text| (*text).to_owned()).collect()
}

#[tokio::test]
async fn a_timer_ends_with_its_query() {
    let (_folder, lake) = lake().await;
    let engine = QueryEngine::new(&lake, None).expect("an engine");
    let tasks = engine.process.watch.handle().expect("threads").metrics();
    let before = tasks.num_alive_tasks();
    let ticket = || engine.start_ticket(QueryTicket::new("test".into(), None, false), Some(Duration::from_secs(3600)));
    let tickets: Vec<_> = (0..100).map(|_| ticket()).collect();
    assert_eq!(tasks.num_alive_tasks(), before + 100);
    drop(tickets);
    let ended = async {
        while tasks.num_alive_tasks() > before {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(Duration::from_secs(60), ended).await.expect("no task sleeps for an hour");
}

/// Rows of small tables are cached, rows of merged files are hidden in part: whoever reads first, each right sees its
/// own.
#[tokio::test]
async fn rights_of_one_process_see_their_own_runs() {
    let (_folder, lake) = lake().await;
    for (surface, run) in [("flat", "r0"), ("a-wall", "r1"), ("b-wall", "r2"), ("b-hall", "r3"), ("c-wall", "r4")] {
        put_events(&lake, surface, run, "d", 3).await;
    }
    let whole = QueryEngine::new(&lake, None).expect("an engine");
    let [ours, others] = ["a", "b"].map(|project| whole.of_lake(&reader_of(&lake, project)).expect("an engine"));
    let (all, a, b) = (set(&["r0", "r1", "r2", "r3", "r4"]), set(&["r0", "r1"]), set(&["r0", "r2", "r3"]));
    for _ in 0..2 {
        for sql in [
            "select run_id from runs",
            "select run_id from events",
            "select distinct run_id from events where surface_id in ('flat', 'a-wall', 'b-wall', 'b-hall', 'c-wall')",
            "select run_id from system.ingests",
        ] {
            assert_eq!(texts(&whole, sql).await, all, "{sql}");
            assert_eq!(texts(&ours, sql).await, a, "{sql}");
            assert_eq!(texts(&others, sql).await, b, "{sql}");
            assert_eq!(texts(&whole, sql).await, all, "{sql}");
        }
        lake.optimize(128 << 20, &Default::default(), &mut |_| {}).await.expect("merged");
    }
    assert_eq!(whole.count_running(), 0, "they share what the process has");
}

#[tokio::test]
async fn a_right_is_opened_once_and_the_least_used_ones_go() {
    let (_folder, lake) = lake().await;
    let whole = QueryEngine::new(&lake, None).expect("an engine");
    let in_use = whole.of_lake(&reader_of(&lake, "used")).expect("an engine");
    let catalog = |engine: &QueryEngine| std::ptr::from_ref(engine.catalog()).addr();
    let snapshot = async |project: &str| {
        let engine = whole.of_lake(&reader_of(&lake, project)).expect("an engine");
        session(&engine).current_snapshot().await.expect("a snapshot")
    };
    let first = snapshot("first").await;
    assert!(Arc::ptr_eq(&first, &snapshot("first").await), "its snapshot is cached");
    for number in 0..15 {
        whole.of_lake(&reader_of(&lake, &format!("p{number}"))).expect("an engine");
    }
    assert!(!Arc::ptr_eq(&first, &snapshot("first").await), "it is not cached any more");
    let again = whole.of_lake(&reader_of(&lake, "used")).expect("an engine");
    assert_eq!(catalog(&again), catalog(&in_use));
    assert_eq!(catalog(&whole.of_lake(&lake).expect("an engine")), catalog(&whole));
    let (_other, another) = self::lake().await;
    assert!(matches!(whole.of_lake(&another), Err(Error::Execution { .. })));
}

#[tokio::test]
async fn the_programs_own_statements_are_not_as_nice_as_those_from_outside() {
    let (_folder, lake) = lake().await;
    let limits = EngineLimits { niceness: Some(7), ..EngineLimits::default() };
    let engine = QueryEngine::with_limits(&lake, limits).expect("an engine");
    let niceness = async |client: EngineClient| {
        let asked = async { Ok::<_, Error>(rustix::process::getpriority_process(None).expect("a priority")) };
        engine.open_session(&Arc::new(client)).supervise_work(asked).await.expect("it runs")
    };
    assert_eq!(niceness(EngineClient::new("outside", QueryQuota::default())).await, 7);
    assert_ne!(niceness(EngineClient::new_program("program", QueryQuota::default())).await, 7);
}
