//! Sessions on a small lake: answers, refusals, and error texts.

use std::sync::atomic::AtomicBool;

use arrow::array::{ArrayRef, AsArray as _, Int64Array, StringArray, new_null_array};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Field, Float64Type, Int64Type};
use arrow::record_batch::RecordBatch;
use datafusion::execution::object_store::ObjectStoreUrl;
use echolake_lake::{FileName, ReferenceSurfaces, VisibleRun, encode_batches};
use echolake_schema::Rig;
use echolake_schema::tables::Table;
use expect_test::{Expect, expect};

use super::*;
use crate::PredicateForm;

pub(super) async fn lake() -> (tempfile::TempDir, Lake) {
    let folder = tempfile::tempdir().expect("a folder");
    let url = folder.path().join("lake").display().to_string();
    let lake = Lake::open_or_create(&url, &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
    (folder, lake)
}

pub(super) async fn rows(session: &Session, sql: &str) -> Vec<RecordBatch> {
    let mut answer = session.query(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
    let mut batches = Vec::new();
    while let Some(batch) = answer.next().await.unwrap_or_else(|e| panic!("{sql}: {e}")) {
        batches.push(batch);
    }
    batches
}

#[tokio::test]
async fn placeholders_have_the_types_that_the_query_determines() {
    let (_folder, lake) = lake().await;
    let session = Session::new(&lake).expect("a session");
    let int_list = || DataType::new_list(DataType::Int32, true);
    for (sql, expected) in [
        ("select $1::int", vec![Some(DataType::Int32)]),
        ("select $1::bigint + 1", vec![Some(DataType::Int64)]),
        ("select pair_id from pairs limit $1 offset $2", vec![Some(DataType::Int64); 2]),
        ("select (select max(pair_id) from pairs where direct_mm < $1::double)", vec![Some(DataType::Float64)]),
        ("select 1 from pairs where array_has($1, pair_id)", vec![Some(int_list())]),
        ("select 1 from pairs where array_has($1::int[], pair_id)", vec![Some(int_list())]),
        ("select 1 from pairs where pair_id = $1", vec![Some(DataType::Int32)]),
        ("select coalesce($1, 5), nullif('x', $2)", vec![Some(DataType::Int64), Some(DataType::Utf8)]),
        ("select not $1", vec![Some(DataType::Boolean)]),
        ("select $1", vec![None]),
    ] {
        let prepared = session.prepare(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
        assert_eq!(prepared.parameter_types().expect(sql), expected, "{sql}");
    }
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
async fn a_predicate_stays_within_its_parentheses() {
    let (_folder, lake) = lake().await;
    let session = Session::new(&lake).expect("a session");
    let select = "select pair_id from pairs where pair_id < 10 and";
    let count = async |predicate: &str| {
        let sql = session.append_predicate(select, predicate, PredicateForm::AnyExpression)?;
        let (mut answer, mut count) = (session.query(&sql).await?, 0);
        while let Some(batch) = answer.next().await? {
            count += batch.num_rows();
        }
        Ok::<_, Error>(count)
    };
    for (predicate, expected) in [
        ("true", 10),
        ("pair_id > 6 -- the last", 3),
        ("pair_id = 1 or pair_id = 20", 1),
        ("pair_id in (select pair_id from pairs where pair_id % 2 = 0)", 5),
        ("(pair_id = 3) and (true)", 1),
        ("exists (select 1) /* ) */", 10),
    ] {
        assert_eq!(count(predicate).await.expect(predicate), expected, "{predicate}");
    }
    for wrong in [
        "",
        "true) or (true",
        "true) or true and (true",
        "true) union all (select 1 where true",
        "true) union all select run_id from runs where (true",
        "true) limit 5 --",
        "true); drop table runs; --",
        "true; select 1",
        "true) group by pair_id having (true",
        "true) and (select 1) = (1",
        "order by 1",
        "selec",
        "a b",
        "1,2",
    ] {
        assert!(matches!(count(wrong).await, Err(Error::Query { .. })), "{wrong}");
    }
}

#[tokio::test]
async fn a_predicate_of_comparisons_has_nothing_else() {
    let (_folder, lake) = lake().await;
    let session = Session::new(&lake).expect("a session");
    let select = "select pair_id from pairs where run_id = 'a' and";
    let selecting = |predicate: &str| session.append_predicate(select, predicate, PredicateForm::Comparisons);
    let longest = format!("pair_id in ({})", "1,".repeat(1_017) + "1");
    assert!(longest.len() <= 2_048);
    for comparisons in [
        "true",
        "pair_id between 1 and 3",
        "not (\"pair_id\" not between -1 and 3.5e1) and (snr_db < 35 or surface_id = 'flat')",
        "surface_id <> 'it''s' and pair_id >= -5 and gain_db is not null or attempt is null and 3 <= pair_id",
        "surface_id in ('flat', 'foam', null) and pair_id not in (1, -2) -- the rest",
        &longest,
    ] {
        selecting(comparisons).expect(comparisons);
    }
    let too_long = format!("{longest} or pair_id = 123");
    let chain = format!("pair_id{}", "+1".repeat(900));
    for more in [
        "exists (select 1)",
        "pair_id in (select 1)",
        "abs((select min(pair_id) from pairs)) = 1",
        "pair_id in (1, abs(2))",
        "pair_id in (1, pair_id)",
        "pair_id = any(select 1)",
        "abs(pair_id) = 1",
        "pair_id + 1 = 2",
        "pair_id % 2 = 0",
        "- pair_id = 1",
        "-(1) = pair_id",
        "+1 = pair_id",
        "pair_id::text = '1'",
        "cast(pair_id as text) = '1'",
        "surface_id like 'f%'",
        "surface_id ilike 'f%'",
        "surface_id ~ '(a+)+b'",
        "surface_id similar to 'f%'",
        "surface_id || 'x' = 'flatx'",
        "case when true then true end",
        "pairs.pair_id = 1",
        "ir[1] = 0",
        "array[1] = ir",
        "(pair_id, 1) = (1, 1)",
        "started = timestamp '2026-01-01'",
        "started < current_date",
        "started > interval '1 day'",
        "pair_id is distinct from 1",
        "true is true",
        "pair_id xor true",
        "pair_id = $1",
        "@@version = 1",
        "x'00' = surface_id",
        "\"no plain name\" = 1",
        "cardinality(array_repeat(make_array(range(0,30000000)),3000000)) > pair_id",
        &chain,
        &too_long,
    ] {
        assert!(matches!(selecting(more), Err(Error::Query { .. })), "{more}");
    }
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
    let machine = ObjectStoreUrl::parse("file:///").expect("a URL");
    let machine = session.engine.create_context().runtime_env().object_store(machine);
    assert!(machine.is_err(), "the machine's files are no store of a query");
    assert_eq!(rows(&session, "select * from points").await.iter().map(|b| b.num_rows()).sum::<usize>(), 78);
}

#[tokio::test]
async fn clauses_that_would_be_dropped_are_refused() {
    let (_folder, lake) = lake().await;
    let session = Session::new(&lake).expect("a session");
    for (sql, clause) in [
        ("select count(*) from points tablesample bernoulli (10)", "TABLESAMPLE"),
        ("select count(*) from points tablesample (5 rows)", "TABLESAMPLE"),
        ("select count(*) from (select 1) tablesample system (10)", "TABLESAMPLE"),
        ("select count(*) from points positional join pairs", "POSITIONAL JOIN"),
        ("select count(*) from points join pairs", "JOIN without ON or USING"),
        ("select count(*) from (points left join pairs)", "JOIN without ON or USING"),
        ("select count(*) from points for xml auto", "FOR XML"),
        ("select count(*) from points partition (p0)", "PARTITION"),
        ("select * from generate_series(1, 2) with ordinality", "ORDINALITY"),
        ("select sum(0.5)(point_id) from points", "parameters of sum"),
        ("select abs(point_id) over () from points", "OVER in a call of abs"),
        ("select abs(point_id) filter (where false) from points", "FILTER in a call of abs"),
        ("select abs(distinct point_id) from points", "DISTINCT in a call of abs"),
        ("explain select * from points tablesample (10)", "TABLESAMPLE"),
        // Syntax of other databases, which the parser no longer reads.
        ("select count(*) from points prewhere point_id = 1", "prewhere"),
        ("select point_id from points connect by point_id = 1", "connect"),
        ("select count(*) from points settings x = 1", "settings"),
        ("select 12x", "`12x` is no number"),
        ("select 1_", "is no number"),
    ] {
        let error = session.query(sql).await.map(drop).expect_err(sql);
        assert!(matches!(error, Error::Query { .. }), "{sql}: {error}");
        assert!(error.to_string().contains(clause), "{sql}: {error}");
    }
    let sql = "select *\nfrom points\ntablesample (10)";
    let error = session.query(sql).await.map(drop).expect_err(sql).to_string();
    assert!(error.contains("\n  tablesample (10)\n  ^\nhint: WHERE random() < 0.1"), "{error}");
}

#[tokio::test]
async fn friendly_syntax_is_planned() {
    let (_folder, lake) = lake().await;
    let session = Session::new(&lake).expect("a session");
    for (friendly, plain) in [
        ("from points", "select * from points"),
        ("from points select point_id order by all", "select point_id from points order by point_id"),
        ("select layer, count(*), from points group by all", "select layer, count(*) from points group by layer"),
        (
            "select point_id from points order by 1 fetch first 3 rows only",
            "select point_id from points order by 1 limit 3",
        ),
        ("select 10_000 as x", "select 10000 as x"),
        ("select * exclude (layer) from points", "select * except (layer) from points"),
        ("select array_transform([1, 2], x -> x * 2) as x", "select [2, 4] as x"),
        ("select list_filter([1, 2, 3], x -> x > 1) as x", "select [2, 3] as x"),
        (
            "select arg_max(point_id, z_mm * 1000 + point_id) as x, min_by(point_id, point_id) as y from points",
            "select cast(77 as int) as x, cast(0 as int) as y",
        ),
        (
            "select max_by(point_id, case when layer = 0 then point_id end) as x from points",
            "select cast(35 as int) as x",
        ),
        (
            "select first_value(point_id) over (order by point_id) as x from points",
            "select cast(0 as int) as x from points",
        ),
    ] {
        assert_eq!(sorted(&session, friendly).await, sorted(&session, plain).await, "{friendly}");
    }
}

#[tokio::test]
async fn a_summary_has_a_row_a_column() {
    let (_folder, lake) = lake().await;
    let session = Session::new(&lake).expect("a session");
    let sql = "select * exclude (approx_unique, std, q25, q50, q75) from (values ('x', 'y')) as t(a, b)";
    assert!(session.query(sql).await.is_err(), "columns that are not there are named");
    let lines = sorted(&session, "summarize points").await;
    assert_eq!(lines.len(), 7, "{lines:?}");
    let layer = lines.iter().find(|line| line.starts_with("| layer")).expect("a row");
    let cells: Vec<_> = layer.split('|').map(str::trim).collect();
    assert_eq!(cells[1..6], ["layer", "int32", "0", "3", "4"]);
    assert_eq!(cells[11..13], ["0", "78"], "{layer}");
    let lines = sorted(&session, "summarize select 'a' as \"it's\", [1, 2] as l").await;
    assert!(lines[0].starts_with("| it's") && lines[0].contains("| a "), "{lines:?}");
    assert!(lines[1].starts_with("| l "), "{lines:?}");
    let error = session.query("summarize nothing_here").await.map(drop).expect_err("no table").to_string();
    assert!(error.contains("no table `nothing_here`"), "{error}");
}

// The rows of an answer as text, in an order of their own.
async fn sorted(session: &Session, sql: &str) -> Vec<String> {
    let batches = rows(session, sql).await;
    let table = arrow::util::pretty::pretty_format_batches(&batches).expect("a table").to_string();
    let mut lines: Vec<_> = table.lines().filter(|line| line.starts_with('|')).skip(1).map(str::to_owned).collect();
    lines.sort();
    lines
}

#[tokio::test]
async fn errors_point_at_the_place() {
    let (_folder, lake) = lake().await;
    let session = Session::new(&lake).expect("a session");
    let check = async |sql: &str, expected: Expect| {
        expected.assert_eq(&session.query(sql).await.map(drop).expect_err(sql).to_string());
    };
    check("select nonsense from runs", expect![[r#"
        no column `nonsense` (line 1, column 8)
          select nonsense from runs
                 ^
        hint: the columns are surface_id, run_id, state, missing, origin, project, rig, started_ns, started, ended_ns, ended, measurements, ...; DESCRIBE lists all of a table"#]]).await;
    check(
        "select pair_idd from pairs",
        expect![[r#"
            no column `pair_idd` (line 1, column 8)
              select pair_idd from pairs
                     ^
            hint: did you mean `pair_id`?"#]],
    )
    .await;
    check(
        "select pair_id from pairs where 'a' = \"prd\"",
        expect![[r#"
            no column `prd` (line 1, column 39)
              select pair_id from pairs where 'a' = "prd"
                                                    ^
            hint: did you mean the text 'prd'? Texts have single quotes, names of columns double ones"#]],
    )
    .await;
    check(
        "select\n'1.5 dB'::double",
        expect![[r#"
            Cannot cast string '1.5 dB' to value of Float64 type (line 2, column 1)
              '1.5 dB'::double
              ^
            hint: TRY_CAST(x AS type) is null for what does not fit"#]],
    )
    .await;
    check(
        "selec 1",
        expect![[r#"
            Expected: an SQL statement, found: selec (line 1, column 1)
              selec 1
              ^
            hint: docs/clients.md lists the syntax, docs/functions.md the functions; DESCRIBE (query) shows columns and types"#]],
    )
    .await;
    check(
        "select * from rums",
        expect![[r#"
            no table `rums` (line 1, column 15)
              select * from rums
                            ^
            hint: did you mean `runs`?"#]],
    )
    .await;
    check(
        "select 1; select 2",
        expect![[r#"
        one statement at a time
        hint: `echolake sql` takes several, each ended by ;"#]],
    )
    .await;
    check(
        "select 1 +",
        expect![[r#"
            Expected: an expression, found the end of the query (line 1, column 11)
              select 1 +
                        ^
            hint: docs/clients.md lists the syntax, docs/functions.md the functions; DESCRIBE (query) shows columns and types"#]],
    )
    .await;
}

/// Adds a run's log lines, or others in their place, as ingest does. A surface `a-wall` is of the project `a`.
pub(crate) async fn put_events(lake: &Lake, surface: &str, run: &str, derivation: &str, lines: usize) {
    let pointer = VisibleRun {
        surface: surface.parse().expect("an id"),
        run: run.parse().expect("an id"),
        run_derivation: derivation.into(),
        reference_derivation: None,
        verdicts: None,
    };
    let part = FileName::Rows {
        surface: pointer.surface.clone(),
        run: pointer.run.clone(),
        derivation: derivation.to_owned(),
    };
    let old: Vec<_> = lake.snapshot().await.expect("a view").files_of(Table::Runs, &pointer.run).cloned().collect();
    let mut staged = Vec::new();
    for (table, name, count) in [(Table::Events, part, lines), (Table::Runs, FileName::Pointer(pointer.clone()), 1)] {
        let schema = table.schema(lake.rig());
        let column = |field: &Arc<Field>| -> ArrayRef {
            let text = match field.name().as_str() {
                "surface_id" => surface,
                "run_id" => run,
                _ => derivation,
            };
            match field.data_type() {
                kind if field.name() == "project" => match surface.split_once('-') {
                    Some((project, _)) => Arc::new(StringArray::from(vec![project; count])),
                    None => new_null_array(kind, count),
                },
                DataType::Utf8 => Arc::new(StringArray::from(vec![text; count])),
                kind => cast(&(0..count as i64).collect::<Int64Array>(), kind).expect("numbers"),
            }
        };
        let batch = RecordBatch::try_new(schema.clone(), schema.fields().iter().map(column).collect()).expect("rows");
        let file = encode_batches(table, &schema, &[batch]).expect("encoded");
        staged.push(lake.stage_file(table, &name, file).await.expect("staged"));
    }
    let row = staged.pop().expect("the run's row").with_replaced_rows(&pointer, &old);
    staged.push(row);
    lake.commit_staged(&staged).await.expect("committed");
}

// Names of runs are longer than what the log's statistics are trusted with.
#[tokio::test]
async fn a_query_of_one_run_opens_its_files_alone() {
    let (_folder, lake) = lake().await;
    let runs = [1, 2, 3].map(|day| format!("2026010{day}T080000Z-flat-911a348a2ed4d04{day}"));
    for (surface, (run, lines)) in ["flat", "foam", "wood"].into_iter().zip(runs.iter().zip([20_000, 20_000, 0])) {
        put_events(&lake, surface, run, "old", lines).await;
    }
    let session = Session::new(&lake).expect("a session");
    let text = |batches: &[RecordBatch]| format!("{:?}", batches[0].column(batches[0].num_columns() - 1));
    let plan = text(&rows(&session, &format!("explain select message from events where run_id = '{}'", runs[1])).await);
    assert!(plan.contains(&runs[1]) && !plan.contains(&format!("tables/events/flat.{}", runs[0])), "{plan}");
    let last = text(&rows(&session, "select max(run_id) from events").await);
    assert!(last.contains(&runs[1]), "the third has no lines: {last}");
}

async fn check_replaced_rows(others: usize) {
    let (_folder, lake) = lake().await;
    for (surface, run, lines) in [("flat", "r1", 3), ("foam", "r2", 5), ("wood", "r3", 7), ("prd", "r4", others)] {
        put_events(&lake, surface, run, "old", lines).await;
    }
    lake.optimize(128 << 20, &AtomicBool::new(false), &mut |_| {}).await.expect("merged");
    let session = Session::new(&lake).expect("a session");
    let number = async |sql: &str| rows(&session, sql).await[0].column(0).as_primitive::<Int64Type>().value(0);
    let others = others as i64;
    assert_eq!(number("select count(*) from events").await, 15 + others);
    put_events(&lake, "foam", "r2", "new", 2).await;
    let view = lake.snapshot().await.expect("a view");
    let hidden: Vec<_> = view.files(Table::Events).iter().map(|f| f.hidden.len()).collect();
    assert_eq!(hidden, [0, 1], "not cleaned up yet");
    for (sql, expected) in [
        ("select count(*) from events", 12 + others),
        ("select count(log_time_ns) from events", 12 + others),
        ("select count(*) from events where surface_id = 'foam'", 2),
        ("select count(*) from events where run_id = 'r3'", 7),
        ("select count(distinct message) from events where surface_id = 'foam'", 1),
        ("select max(log_time_ns) from events where surface_id = 'foam'", 1),
        ("select count(*) from (select message from events limit 100000)", 12 + others),
        ("select count(*) from (select message from events limit 11)", 11),
    ] {
        assert_eq!(number(sql).await, expected, "{sql}");
    }
    let all = rows(&session, "select * from events order by surface_id, log_time_ns").await;
    assert_eq!(all.iter().map(RecordBatch::num_rows).sum::<usize>() as i64, 12 + others);
    assert_eq!(all[0].schema().fields().len(), Table::Events.schema(lake.rig()).fields().len());

    // Rows that are in a file of their own again are seen once.
    put_events(&lake, "foam", "r2", "old", 5).await;
    put_events(&lake, "wood", "r3", "empty", 0).await;
    assert_eq!(number("select count(*) from events").await, 8 + others);
}

mod slow {
    use super::*;

    // Between the commit of a run's new rows and the clean-up, a merged file still holds its old ones. A small table is
    // in memory, a larger one is scanned.
    #[tokio::test]
    async fn replaced_rows_of_a_merged_file_are_not_seen() {
        for others in [1, 20_000] {
            check_replaced_rows(others).await;
        }
    }
}
