//! Joins by order beside the same joins as loops over all pairs of rows, of random tables: with nulls, repeated rows, NaN,
//! both zeros and empty sides, in batches of few rows.

use std::collections::BTreeMap;
use std::sync::Arc;

use arrow::array::{ArrayRef, Float64Array, Int64Array, RecordBatch, StringArray, TimestampMicrosecondArray};
use arrow::datatypes::{DataType, Field, Schema, TimeUnit};
use arrow::util::pretty::pretty_format_batches;
use datafusion::datasource::MemTable;
use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_schema::Rig;

use crate::Session;
use crate::session::function_tests::{SmallLake, answer_lines};

/// Conditions of range joins of `a` and `b`; `#` is a column of one of the types of positions.
const RANGES: [&str; 16] = [
    "a.k = b.k and b.# >= a.# and b.# <= a.#2",
    "a.k = b.k and b.# > a.# and b.# < a.#2",
    "b.# between a.# and a.#2 and a.k = b.k",
    "a.k = b.k and a.# >= b.# and a.# < b.#2",
    "a.k = b.k and a.s = b.s and a.# > b.# and b.#2 >= a.#",
    "b.# >= a.# and b.# <= a.#2",
    "a.# >= b.# and b.#2 > a.#",
    "a.# >= b.#",
    "a.# < b.#",
    "a.# <= b.# and a.id <> b.id",
    "b.# between a.# and a.#2 and (a.id + b.id) % 3 = 0",
    "a.k = b.k and b.# between a.# and a.#2 and a.s >= b.s",
    "a.k = b.k and a.# >= b.# and a.# < b.#2 and (a.id * b.id) % 2 = 1",
    "a.k = b.k and b.# >= a.# and b.# <= a.#2 and a.#2 <> b.#2",
    "a.f = b.f and b.# >= a.# and b.# <= a.#2",
    "a.k + 1 = b.k and b.# >= a.# and b.# <= a.#2 and a.id > 3",
];

/// Keys of as-of joins.
const KEYS: [&str; 4] = ["", "a.k = b.k and ", "a.s = b.s and a.k = b.k and ", "a.f = b.f and "];

struct Random(u64);

impl Random {
    // SplitMix64.
    fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (mixed ^ (mixed >> 31)) % end
    }

    fn pick<'a>(&mut self, all: &[&'a str]) -> &'a str {
        all[self.below(all.len() as u64) as usize]
    }

    fn optional<T>(&mut self, make: impl FnOnce(&mut Self) -> T) -> Option<T> {
        (self.below(8) > 0).then(|| make(self))
    }

    fn float(&mut self) -> f64 {
        match self.below(12) {
            0 => f64::NAN,
            1 => -0.0,
            2 => 0.0,
            3 => f64::INFINITY,
            _ => self.below(9) as f64 - 4.0,
        }
    }

    fn rows(&mut self) -> RecordBatch {
        let count = if self.below(10) == 0 { 0 } else { self.below(40) as usize };
        let spread = 1 + self.below(12);
        let keys = 1 + self.below(4);
        let column = |random: &mut Self, kind: &str| -> ArrayRef {
            let mut rows = 0..count;
            let mut each = || rows.next();
            match kind {
                "id" => Arc::new(Int64Array::from_iter_values((0..count).map(|row| row as i64))),
                "k" => Arc::new(Int64Array::from_iter(std::iter::from_fn(|| {
                    each().map(|_| random.optional(|random| random.below(keys) as i64))
                }))),
                "i" | "i2" => Arc::new(Int64Array::from_iter(std::iter::from_fn(|| {
                    each().map(|_| random.optional(|random| random.below(spread) as i64 - 3))
                }))),
                "s" | "s2" => Arc::new(StringArray::from_iter(std::iter::from_fn(|| {
                    each().map(|_| random.optional(|random| "ab".repeat(random.below(3) as usize)))
                }))),
                "t" | "t2" => {
                    let times = std::iter::from_fn(|| {
                        each().map(|_| random.optional(|random| random.below(spread) as i64 * 1_000_000))
                    });
                    Arc::new(TimestampMicrosecondArray::from_iter(times).with_timezone("UTC"))
                }
                _ => Arc::new(Float64Array::from_iter(std::iter::from_fn(|| {
                    each().map(|_| random.optional(Self::float))
                }))),
            }
        };
        let columns = schema().fields().iter().map(|field| column(self, field.name())).collect();
        RecordBatch::try_new(schema(), columns).expect("rows")
    }

    // Two tables, each in parts.
    fn table(&mut self) -> MemTable {
        let rows = self.rows();
        let parts = 1 + self.below(3) as usize;
        let length = rows.num_rows().div_ceil(parts);
        let part = |part: usize| {
            let start = (part * length).min(rows.num_rows());
            vec![rows.slice(start, length.min(rows.num_rows() - start))]
        };
        MemTable::try_new(schema(), (0..parts).map(part).collect()).expect("a table")
    }
}

fn schema() -> Arc<Schema> {
    let time = DataType::Timestamp(TimeUnit::Microsecond, Some("UTC".into()));
    let field = |name: &str, kind: &DataType| Field::new(name, kind.clone(), name != "id");
    let kinds = [
        ("id", DataType::Int64),
        ("k", DataType::Int64),
        ("s", DataType::Utf8),
        ("s2", DataType::Utf8),
        ("i", DataType::Int64),
        ("i2", DataType::Int64),
        ("f", DataType::Float64),
        ("f2", DataType::Float64),
        ("t", time.clone()),
        ("t2", time),
    ];
    Arc::new(Schema::new(kinds.iter().map(|(name, kind)| field(name, kind)).collect::<Vec<_>>()))
}

// A session with tables `a` and `b` beside the lake's, whose batches have few rows.
async fn open_session(lake: &Lake, random: &mut Random) -> Session {
    let tables: BTreeMap<_, _> = ["a", "b", "c"].map(|name| (name, Arc::new(random.table()))).into();
    let batch_rows = 1 << random.below(6);
    let partitions = 1 + random.below(3) as usize;
    Session::new(lake).expect("a session").with_extension(Arc::new(move |context| {
        for (name, table) in &tables {
            context.register_table(*name, table.clone())?;
        }
        let state = context.state_ref();
        let mut state = state.write();
        let options = state.config_mut().options_mut();
        options.set("datafusion.execution.batch_size", &batch_rows.to_string())?;
        options.set("datafusion.execution.target_partitions", &partitions.to_string())
    }))
}

async fn lake() -> Lake {
    Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake")
}

async fn is_sorted_join(session: &Session, sql: &str) -> bool {
    let plan = answer_lines(session, &format!("explain {sql}")).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
    plan.join("\n").contains("SortedJoinExec")
}

async fn compare(session: &Session, seed: u64, sql: &str, plain: &str) {
    assert!(is_sorted_join(session, sql).await, "{sql}");
    assert!(!is_sorted_join(session, plain).await, "{plain}");
    let given = answer_lines(session, sql).await.unwrap_or_else(|e| panic!("seed {seed}: {sql}: {e}"));
    let expected = answer_lines(session, plain).await.unwrap_or_else(|e| panic!("seed {seed}: {plain}: {e}"));
    assert_eq!(given, expected, "seed {seed}: {sql}");
}

// A condition of which no part can be taken out.
fn conceal(condition: &str) -> String {
    format!("case when {condition} then true else false end")
}

async fn compare_ranges(session: &Session, seed: u64, random: &mut Random) {
    let position = random.pick(&["i", "f", "t", "s"]);
    let condition = random.pick(&RANGES).replace('#', position);
    let columns = random.pick(&["a.id, b.id", "*", "count(*)", "b.id, b.f, a.t2", "a.k, count(b.id), sum(b.id)"]);
    let kind = random.pick(&["join", "left join"]);
    let group = if columns.starts_with("a.k") { " group by a.k" } else { "" };
    let query = |condition: &str| format!("select {columns} from a {kind} b on {condition}{group}");
    compare(session, seed, &query(&condition), &query(&conceal(&condition))).await;
}

async fn compare_as_of(session: &Session, seed: u64, random: &mut Random) {
    let position = random.pick(&["i", "f", "t", "s"]);
    let operator = random.pick(&[">=", ">", "<=", "<"]);
    let keys = random.pick(&KEYS);
    let kind = random.pick(&["", "left "]);
    let (on_right, of_right) = random.pick(&["|", " and b.id % 2 = 0|and b.id % 2 = 0"]).split_once('|').expect("two");
    let filter = random.pick(&["", " where a.id > 3", " where b.id > 3", " where a.k = 1 and b.id <> a.id"]);
    let condition = format!("{keys}a.{position} {operator} b.{position}");
    let sql = format!("select a.id, b.id, b.{position} from a asof {kind}join b on {condition}{on_right}{filter}");
    let order = if operator.starts_with('>') { "desc" } else { "asc" };
    // Of equal positions the first by the columns that are read: `id` is the first of them.
    let nearest = format!(
        "select * from (select *, row_number() over (partition by a_id order by b_at {order}, b_id) as place from \
         (select a.id as a_id, b.id as b_id, b.{position} as b_at from a join b on {} {of_right})) where place = 1",
        conceal(&condition)
    );
    let plain = format!(
        "select a.id, b.id, n.b_at from a {kind}join ({nearest}) n on n.a_id = a.id {kind}join b on b.id = \
         n.b_id{filter}"
    );
    compare(session, seed, &sql, &plain).await;
}

#[tokio::test]
async fn range_joins_answer_as_loops_over_all_pairs() {
    let lake = lake().await;
    for seed in 0..300 {
        let mut random = Random(seed);
        let session = open_session(&lake, &mut random).await;
        compare_ranges(&session, seed, &mut random).await;
        compare_ranges(&session, seed, &mut random).await;
    }
}

#[tokio::test]
async fn as_of_joins_answer_as_ranks_of_all_pairs() {
    let lake = lake().await;
    for seed in 1000..1300 {
        let mut random = Random(seed);
        let session = open_session(&lake, &mut random).await;
        compare_as_of(&session, seed, &mut random).await;
        compare_as_of(&session, seed, &mut random).await;
    }
}

#[tokio::test]
async fn as_of_joins_are_read_in_all_places() {
    let lake = lake().await;
    let session = open_session(&lake, &mut Random(7)).await;
    let a = "(values (1, 10), (1, 20), (2, 15), (3, 1)) a(k, t)";
    let b = "(values (1, 5, 'x'), (1, 12, 'y'), (2, 15, 'z'), (2, 15, 'w'), (4, 1, 'v')) b(k, t, v)";
    for (sql, expected) in [
        (format!("select a.k, a.t, v from {a} asof join {b} on a.k = b.k and a.t >= b.t"), "1|10|x;1|20|y;2|15|w"),
        (format!("select k, t, v from {a} asof join {b} using (k, t)"), "1|10|x;1|20|y;2|15|w"),
        (format!("select * from {a} asof left join {b} using (k, t)"), "1|10|x;1|20|y;2|15|w;3|1|null"),
        (format!("select k, t from {a} asof join {b} using (k, t) where t > 10 order by t"), "1|20;2|15"),
        (format!("select k, max(t) from {a} asof join {b} using (k, t) group by k"), "1|20;2|15"),
        (format!("select a.t, b.t from {a} ASOF INNER JOIN {b} ON b.t <= a.t AND b.k = a.k"), "10|5;15|15;20|12"),
        (format!("select a.t, v from {a} asof join {b} on a.k = b.k and a.t > b.t"), "10|x;20|y"),
        (format!("select a.t, v from {a} asof join {b} on a.t < b.t"), "1|x;10|y"),
        (format!("select a.t, v from {a} asof left join {b} on a.t <= b.t and b.v <> 'x'"), "10|y;15|w;1|v;20|null"),
        // Conditions after the join are about the nearest row.
        (format!("select a.t, v from {a} asof join {b} on a.k = b.k and a.t >= b.t where v <> 'y'"), "10|x;15|w"),
        (format!("select a.t, v from {a} asof join {b} on a.k = b.k and a.t >= b.t where a.k = 1"), "10|x;20|y"),
        (format!("with n as (select a.t, v from {a} asof join {b} using (k, t)) select count(*) from n"), "3"),
        (format!("select count(*) from {a} asof join {b} on a.t >= b.t"), "4"),
        (
            format!(
                "select a.t, b.v, c.v from {a} asof join {b} using (k, t) asof left join (select * from {b}) c(k, t, v) \
                     on a.k = c.k and a.t < c.t"
            ),
            "10|x|y;15|w|null;20|y|null",
        ),
        (format!("select (select count(*) from {a} asof join {b} using (k, t)) as n"), "3"),
        (
            format!(
                "select n.v from (({a} asof join {b} on a.k = b.k and a.t >= b.t) join (values ('w')) n(v) on n.v = b.v)"
            ),
            "w",
        ),
        ("select asof.k from (select 1 as k) as asof join (values (1)) b(x) on true".to_owned(), "1"),
        ("select asof.k from (select 1 as k) as asof left join (values (1)) b(x) on x = k".to_owned(), "1"),
    ] {
        let given = answer_lines(&session, &sql).await.unwrap_or_else(|e| panic!("{sql}: {e}"));
        let mut expected: Vec<_> = expected.split(';').collect();
        expected.sort_unstable();
        assert_eq!(given, expected, "{sql}");
    }
}

#[tokio::test]
async fn what_is_no_as_of_join_is_refused() {
    let lake = lake().await;
    let session = open_session(&lake, &mut Random(7)).await;
    for (sql, part) in [
        ("select 1 from a asof join b on a.k = b.k", "not equalities alone"),
        ("select 1 from a asof join b on a.i >= b.i and a.t >= b.t", "takes equalities and one inequality"),
        ("select 1 from a asof join b on a.i + b.i >= 3", "not `a.i + b.i >= "),
        ("select 1 from a asof left join b on a.i >= b.i and a.id = 3", "not `a.id = "),
        ("select 1 from a asof join b on a.i <> b.i", "not `a.i != b.i`"),
        ("select 1 from a asof join b", "JOIN without ON or USING"),
        ("select 1 from a asof full join b on a.i >= b.i", "ASOF FULL JOIN"),
        ("select 1 from a asof cross join b", "ASOF JOIN of this kind"),
        ("select 1 from a global join b on a.i = b.i", "GLOBAL JOIN"),
        ("select 1 from a global join b on a.i = b.i asof join c on a.t >= c.t", "GLOBAL JOIN"),
        ("select 1 from a asof join b match_condition (a.t >= b.t) on a.k = b.k", "MATCH_CONDITION"),
        ("select 1 from a asof join b on a.t >= b.i", "ompar"),
    ] {
        let error = answer_lines(&session, sql).await.expect_err(sql).to_string();
        assert!(error.contains(part) && error.contains("hint: "), "{sql}: {error}");
        assert!(!error.contains("Internal") && !error.contains("AsOfSide"), "{sql}: {error}");
    }
}

#[tokio::test]
async fn few_pairs_are_joined_as_before() {
    let lake = lake().await;
    let session = open_session(&lake, &mut Random(7)).await;
    for sql in [
        // A side of one row, or of few.
        "select count(*) from a, (select avg(i) as m from b) n where a.i > n.m",
        "select count(*) from a join (values (0, 5), (5, 10)) n(low, high) on a.i >= low and a.i < high",
        "select count(*) from a join (select * from b limit 3) n on a.i >= n.i",
        // A key that is unique.
        "select count(*) from a join (select k, min(i) low, max(i) high from b group by k) n on a.k = n.k and a.i >= \
         low and a.i < high",
        "select count(*) from a join pairs p on a.id = p.pair_id and a.i between p.microphone and p.speaker",
        "select count(*) from a join b on a.k = b.k and a.i >= b.i",
        // Lists, which are not sorted for half of all pairs.
        "select count(n.list), count(b.i) from (select [i] as list, i from a) n join b on n.i < b.i",
    ] {
        assert!(!is_sorted_join(&session, sql).await, "{sql}");
    }
}

#[tokio::test]
async fn conditions_on_keys_reach_both_scans() {
    let lake = lake().await;
    let session = open_session(&lake, &mut Random(7)).await;
    let sql = "explain select m.pair_id, e.temperature_c from measurements m asof join environment e on m.run_id = \
               e.run_id and m.log_time >= e.log_time where m.run_id = 'r' and m.pair_id = 3 and e.temperature_c > 20";
    let plan = answer_lines(&session, sql).await.expect("a plan").join("\n");
    let logical: Vec<_> = plan.lines().filter(|line| line.contains("Filter: ")).collect();
    assert!(plan.contains("m.run_id = Utf8(\"r\")") || plan.contains("run_id = Utf8(\"r\")"), "{plan}");
    assert!(logical.iter().any(|line| line.contains("temperature_c > ")), "{plan}");
}

#[tokio::test]
async fn rows_of_the_window_with_other_keys_are_not_sorted() {
    let small = SmallLake::new().await;
    let ask = async |sql: &str| {
        let table = pretty_format_batches(&small.batches(sql).await.unwrap_or_else(|e| panic!("{sql}: {e}")));
        table.expect("a table").to_string()
    };
    let query = |table: &str, condition: &str| {
        format!(
            "select m.run_id, m.pair_id, e.pair_id, e.run_id from measurements m asof join {table} e on m.run_id = \
             e.run_id and m.pair_id > e.pair_id where {condition} order by 1, 2"
        )
    };
    let reduced = query("nce", "m.surface_id = '0015_0'");
    let whole = query("nce", "concat(m.surface_id, substr(e.run_id, 1, 0)) = '0015_0'");
    for (sql, has_semi_join) in [(&reduced, true), (&whole, false)] {
        let plan = ask(&format!("explain {sql}")).await;
        assert_eq!(plan.contains("Semi"), has_semi_join, "{plan}");
        assert!(plan.contains("SortedJoinExec"), "{plan}");
    }
    let answer = ask(&reduced).await;
    assert!(answer.lines().count() > 5, "{answer}");
    assert_eq!(answer, ask(&whole).await);
}
