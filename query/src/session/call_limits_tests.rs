//! Calls of functions that make much of little: refused before they begin, where memory is limited.

use std::time::Duration;

use arrow::util::pretty::pretty_format_batches;
use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_schema::Rig;

use super::*;

async fn session(memory: Option<usize>) -> Session {
    let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
    let engine = QueryEngine::new(&lake, memory).expect("an engine");
    engine.open_session(&Arc::new(EngineClient::new("somebody", QueryQuota::default())))
}

async fn answered(session: &Session, sql: &str) -> Result<String, Error> {
    let mut answer = session.query(sql).await?;
    let mut batches = Vec::new();
    while let Some(batch) = answer.next().await? {
        batches.push(batch);
    }
    Ok(pretty_format_batches(&batches).expect("a table").to_string())
}

/// Statements of the campaign `attacks`, and others of their kinds.
#[tokio::test]
async fn calls_that_would_make_too_much_are_refused_with_the_limit() {
    let limited = session(Some(1 << 30)).await;
    for (sql, limit) in [
        ("select length(repeat('x', 2147483000)) x", "32 MiB"),
        ("select length(lpad('x', 2147483000, 'ab')) x", "32 MiB"),
        ("select sum(length(repeat('x', 20000000 + v))) from generate_series(1,100000) t(v)", "32 MiB"),
        ("select length(replace(repeat('a',100000), 'a', repeat('b',100000))) x", "32 MiB"),
        ("select length(regexp_replace(repeat('a',100000), 'a', repeat('b',100000), 'g')) x", "32 MiB"),
        ("select cardinality(array_repeat([1, 2], 3000000)) x", "32 MiB"),
        ("select cardinality(array_resize([''], 1000, repeat('x',100000))) x", "32 MiB"),
        ("select cardinality(range(0,30000000)) x", "32 MiB"),
        (
            "select count(*) from (select unnest(range(0, v % 1000000)) from generate_series(500000,600000) t(v))",
            "32 MiB",
        ),
        (
            "select cardinality(generate_series(timestamp '2000-01-01', timestamp '2100-01-01', interval '1 microsecond'))",
            "32 MiB",
        ),
        ("select cardinality(range(date '0001-01-01', date '9999-12-31', interval '1 second')) x", "32 MiB"),
        ("select length(array_to_string(range(0,100000), repeat('x',20000))) x", "32 MiB"),
        ("select cardinality(array_replace_all(array_repeat([1], 300000), [1], range(0,100000))) x", "32 MiB"),
        ("select cardinality(string_to_array(repeat(',',20000000), ',')) x", "64 MiB"),
        (
            "select length(x || x || x) from (select repeat('x', 1000000 + v) x from generate_series(1,33) t(v))",
            "64 MiB",
        ),
        (
            "select length(concat(x, x, x)) from (select repeat('x', 1000000 + v) x from generate_series(1,33) t(v))",
            "64 MiB",
        ),
        ("with recursive r as (select 'a' x union all select x || x from r) select max(length(x)) from r", "64 MiB"),
        (
            "with t as (select range(0, 4000000) x), u as (select array_concat(x, x, x, x) x from t) \
             select cardinality(array_concat(x, x, x)) from u",
            "256 MiB",
        ),
        (
            "select sum(levenshtein(repeat('a', 30000 + v % 2), repeat('b', 30000))) from generate_series(1,9) t(v)",
            "100000000 at most",
        ),
        (
            "select count(*) from generate_series(1,10000) t(v) where regexp_like('aaaa', '(' || v || '|a{1,200}){1,9}')",
            "100 at most",
        ),
        (
            "select count(*) from generate_series(1,10000) t(v) where 'aaaa' ~ ('(' || v || '|a{1,200}){1,9}')",
            "100 at most",
        ),
        ("select arrow_cast(make_array(1), 'FixedSizeList(400000000, Int64)') x", "1048576 at most"),
        ("select arrow_cast('a', 'FixedSizeBinary(2000000000)') x", "1048576 at most"),
    ] {
        let ended = tokio::time::timeout(Duration::from_secs(120), answered(&limited, sql)).await.expect("it ends");
        let error = ended.expect_err(sql).to_string();
        assert!(error.contains(limit), "{sql}: {error}");
    }
}

/// Limited functions answer as DataFusion's own do, and have the same names in results.
#[tokio::test]
async fn calls_within_the_limits_answer_as_without() {
    let (limited, free) = (session(Some(1 << 30)).await, session(None).await);
    for sql in [
        "select repeat('ab', 3), lpad('x', 4, 'ab'), rpad('x', 4), replace('aXa', 'X', 'yy'), repeat(null, 3), repeat('a', -1)",
        "select range(3), range(1, 10, 3), generate_series(1, 3), range(5, 1, -2), range(null, 3)",
        "select array_repeat([1, 2], 2), array_resize([1], 3, 7), array_to_string([1, 2, null], '-', 'n')",
        "select string_to_array('a,b', ','), array_replace_all([1, 2, 1], 1, 9), array_concat([1], [2, 3])",
        "select 'a' || 'b', x || 'c', x || null, 'a' || x || 'b' || x from (values ('p'), (null)) t(x)",
        "select arrow_typeof(x || 'a'), arrow_typeof('a' || 1) from (values (arrow_cast('p', 'LargeUtf8'))) t(x)",
        "select concat('a', null, 'b', x), concat_ws(',', 'a', 'b', x) from (values ('p'), (null)) t(x)",
        "select regexp_replace('aaa', 'a', 'b'), regexp_replace('aaa', 'a', 'b', 'g'), regexp_like('abc', '^a')",
        "select x ~ y, x !~ y, x ~* y, regexp_like(x, y) from (values ('ab', '^a'), ('ab', 'B'), (null, 'a')) t(x, y)",
        "select levenshtein('kitten', 'sitting'), to_timestamp('2000-01-02 03:04:05'), to_date('2000-01-02')",
        "select list_concat([1], [2]), list_repeat(1, 2), list_sort([3, 1]), array_distinct([1, 1]), upper('a')",
        "select sum(length(repeat(v::varchar, 10))) from generate_series(1, 10000) t(v)",
        "select count(*) from (select unnest(range(0, v)) from generate_series(1, 1000) t(v))",
        "select x || 'a' from (values ('p'), ('q')) t(x) union all select 'r' order by 1",
        "select x || 'a' k, count(*) from (values ('p'), ('p'), ('q')) t(x) group by x || 'a' order by x || 'a'",
        "select arrow_cast([1, 2], 'FixedSizeList(2, Int64)'), cast('7' as bigint)",
        "select cast([1.5, null] as varchar), x::varchar, try_cast(x as varchar), arrow_cast(x, 'LargeUtf8'), \
         cast(named_struct('a', x) as varchar) from (values ([1, 2]), (null), ([])) t(x)",
        "select cast(x as varchar), count(*) from (values ([1, 2]), ([1, 2]), ([])) t(x) group by cast(x as varchar) order by 1",
        "select count(cast(range(v, v + 3) as varchar)), max(range(v, v + 3)::varchar) from generate_series(1, 5000) t(v)",
        "select array_agg(v), array_agg(v order by v desc), array_agg(distinct v), string_agg(v::varchar, ','), \
         string_agg(distinct v::varchar, '-' order by v::varchar desc) from generate_series(1, 20) t(v) where v < 4",
        "select v % 2 k, array_agg(v order by v), string_agg(v::varchar, ',' order by v) filter (where v > 2), \
         string_agg(nullif(v, v)::varchar, ',') from generate_series(1, 9) t(v) group by 1 order by 1",
        "select v, array_agg(v) over (order by v rows between 1 preceding and current row), \
         string_agg(v::varchar, '') over (order by v), first_value(v) over w, last_value(v) over w, nth_value(v, 2) over w, \
         last_value(nullif(v, 3)) ignore nulls over (order by v rows between unbounded preceding and unbounded following) \
         from generate_series(1, 6) t(v) window w as (partition by v % 2 order by v desc) order by v",
        "select a.v, b.v from generate_series(1, 3) a(v) full join generate_series(2, 5) b(v) on a.v > b.v + 0 order by 1, 2",
        "select array_agg(distinct v order by v), array_agg(v) filter (where v > 9) from generate_series(1, 3) t(v)",
    ] {
        let (mine, expected) = (answered(&limited, sql).await, answered(&free, sql).await);
        let text = |given: Result<String, Error>| given.unwrap_or_else(|error| error.to_string());
        assert_eq!(text(mine), text(expected), "{sql}");
    }
}

/// Large constants are repeated for the rows of small batches, and an aggregate counts what it keeps of them.
#[tokio::test]
async fn large_constants_are_rows_of_small_batches() {
    let limited = session(Some(1 << 30)).await;
    for (sql, expected) in [
        ("select length(string_agg(repeat('x', 1000000), ',')) from generate_series(1,20) t(v)", "20000019"),
        ("select cardinality(array_agg(range(0,100000))) from generate_series(1,100) t(v)", "10000000"),
        (
            "select max(length(s['a'])) from (select named_struct('a', repeat('x', 1000000 + v * 0)) s, v \
          from generate_series(1,30) t(v))",
            "1000000",
        ),
    ] {
        let given = answered(&limited, sql).await.unwrap_or_else(|error| panic!("{sql}: {error}"));
        assert!(given.contains(expected), "{sql}: {given}");
    }
    let sql = "select cardinality(array_agg(range(0,100000))) from generate_series(1,100000) t(v)";
    let refused = answered(&limited, sql).await.expect_err(sql);
    assert!(matches!(refused, Error::MemoryLimit { .. }), "{sql}: {refused}");
    for sql in [
        "select length(string_agg(repeat('x', 1000000), ',')) from generate_series(1,100000) t(v)",
        "select v % 2, length(string_agg(repeat('x', 1000000), ',')) from generate_series(1,100000) t(v) group by 1",
        "select length(string_agg(repeat('x', 1000000), ',' order by v)) from generate_series(1,100000) t(v)",
    ] {
        let refused = answered(&limited, sql).await.expect_err(sql);
        assert!(refused.to_string().contains("more than 256 MiB of texts"), "{sql}: {refused}");
    }
    for call in ["array_agg(v) over (order by v desc)", "string_agg(repeat(v::varchar, 9), ',') over (order by v)"] {
        let sql = format!("select count(a) from (select {call} a from generate_series(1,100000) t(v))");
        let refused = answered(&limited, &sql).await.expect_err(&sql);
        assert!(refused.to_string().contains("over a window have more than 128 MiB"), "{sql}: {refused}");
    }
    // What the plan has no room for is computed when it runs.
    let calls: Vec<_> = (0..10).map(|n| format!("length(repeat('x', 20000000 + {n})) c{n}")).collect();
    let given = answered(&limited, &format!("select {}", calls.join(", "))).await.expect("lengths");
    assert!(given.contains("20000000") && given.contains("20000009"), "{given}");
}

mod slow {
    use std::time::Instant;

    use super::*;

    /// Constant calls are computed while a statement is planned, which waits for nothing.
    #[tokio::test]
    async fn a_statement_of_many_constant_calls_ends_with_its_time() {
        let lake =
            Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
        let engine = QueryEngine::new(&lake, Some(1 << 30)).expect("an engine");
        let quota = QueryQuota { time: Some(Duration::from_millis(200)), ..QueryQuota::default() };
        let session = engine.open_session(&Arc::new(EngineClient::new("brief", quota)));
        let call = "levenshtein(repeat('a', 3000), repeat('b', 3000))";
        let calls: Vec<_> = (0..900).map(|number| format!("{call} + {number} as c{number}")).collect();
        let ended = answered(&session, &format!("select {}", calls.join(", "))).await;
        assert!(matches!(ended, Err(Error::TimeLimit { .. })), "{ended:?}");
        // Without a check between them the calls take many seconds.
        let begun = Instant::now();
        while begun.elapsed() < Duration::from_secs(3) {
            assert_eq!(engine.find_runaway(Duration::from_secs(1)), None);
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }
}
