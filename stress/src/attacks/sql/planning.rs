//! Small statements whose plans are large, or are computed while they are planned: nothing runs yet that could be
//! ended.

use super::sql_attack::{SqlAttack, define_attack, query_chain, repeat_numbered};

pub(super) const ATTACKS: &[SqlAttack] = &[
    define_attack("folded levenshtein", || {
        format!("select {}", repeat_numbered("levenshtein(repeat('a',300000), repeat('b',300000)) as c{}", ",", 10_000))
    }),
    define_attack("folded levenshtein of literals", || {
        let text = "ab".repeat(400_000);
        format!("select levenshtein('{text}', '{text}c') x")
    }),
    define_attack("folded regular expressions", || {
        format!(
            "select {}",
            repeat_numbered("regexp_replace(repeat('ab{}',1000000), '(a|b)+', 'c', 'g') as c{}", ",", 500)
        )
    }),
    define_attack("cte doubled 18 times", || doubled_cte(18)),
    define_attack("cte doubled 22 times", || doubled_cte(22)),
    define_attack("cube of 30", || {
        let columns = repeat_numbered("v % {}", ",", 31).split_off("v % 0,".len());
        format!("select count(*) from generate_series(1,10) t(v) group by cube({columns})")
    }),
    define_attack("grouping sets", || {
        let sets = repeat_numbered("(a+{}, b+{}, c)", ",", 3000);
        format!("select count(*) from (values (1,2,3)) t(a, b, c) group by grouping sets({sets})")
    }),
    define_attack("rollup of 3000", || {
        format!(
            "select count(*) from generate_series(1,3) t(v) group by rollup({})",
            repeat_numbered("v+{}", ",", 3000)
        )
    }),
    define_attack("cross joins", || {
        format!("select 1 from {} limit 1", repeat_numbered("pairs p{}", " cross join ", 300))
    }),
    define_attack("joins on keys", || {
        let joins = repeat_numbered("join tnce t{} on t{}.pair_id = p.pair_id", " ", 150);
        format!("select count(*) from pairs p {joins}")
    }),
    define_attack("conjunction of disjunctions", || {
        format!("select 1 from pairs where {}", repeat_numbered("(pair_id = {} or direct_mm = {})", " and ", 400))
    }),
    define_attack("disjunction of conjunctions", || {
        format!("select 1 from pairs where {}", repeat_numbered("(pair_id = {} and direct_mm > {})", " or ", 400))
    }),
    define_attack("join on a disjunction", || {
        let condition = repeat_numbered("(a.pair_id = b.pair_id + {} and a.direct_mm < {})", " or ", 300);
        format!("select count(*) from pairs a join pairs b on {condition}")
    }),
    define_attack("windows of many orders", || {
        format!(
            "select {} from pairs",
            repeat_numbered("row_number() over (order by pair_id % ({} + 2)) w{}", ",", 800)
        )
    }),
    define_attack("correlated subqueries", || {
        let subquery = "(select max(b{}.pair_id) from pairs b{} where b{}.direct_mm < a.direct_mm) c{}";
        format!("select {} from pairs a", repeat_numbered(subquery, ",", 150))
    }),
    define_attack("correlated subqueries in each other", || {
        let begun = repeat_numbered("exists (select 1 from pairs a{} where a{}.pair_id = p.pair_id and ", "", 20);
        format!("select 1 from pairs p where {begun}true{}", ")".repeat(20))
    }),
    define_attack("in subqueries", || {
        let condition = repeat_numbered("pair_id in (select pair_id from tnce where pair_id <> {})", " and ", 150);
        format!("select count(*) from pairs where {condition}")
    }),
    define_attack("views in unions", || {
        repeat_numbered("select pair_id from augmented where pair_id = {}", " union ", 400)
    }),
    define_attack("columns of columns", || {
        let columns = repeat_numbered("a{}.*", ",", 60);
        let tables = repeat_numbered("measurements a{}", ",", 60);
        format!("select {columns} from {tables} limit 0")
    }),
    define_attack("64 expressions doubled 60 times", || {
        let columns = repeat_numbered("x{}", ",", 64);
        let doubled = repeat_numbered("x{} + x{} as x{}", ",", 64);
        format!(
            "select {columns} from ({}) t",
            query_chain(&format!("select {}", repeat_numbered("{} as x{}", ",", 64)), &doubled, 60)
        )
    }),
    define_attack("sort keys", || {
        format!("select 1 from pairs order by {}", repeat_numbered("pair_id + {}", ",", 5000))
    }),
    define_attack("aggregates with filters", || {
        format!("select {} from pairs", repeat_numbered("sum(direct_mm) filter (where pair_id = {}) c{}", ",", 3000))
    }),
    define_attack("expressions doubled 30 times", || {
        query_chain("select pair_id as x from pairs", "x + x + 1 as x", 30)
    }),
    define_attack("pivot by cases", || {
        let columns = repeat_numbered("max(case when pair_id = {} then direct_mm end) p{}", ",", 6000);
        format!("select {columns} from pairs")
    }),
];

// Each step joins the one before with itself.
fn doubled_cte(levels: usize) -> String {
    let mut steps = vec!["t0 as (select 1 a)".to_owned()];
    for level in 1..=levels {
        steps.push(format!("t{level} as (select x.a from t{0} x, t{0} y)", level - 1));
    }
    format!("with {} select count(*) from t{levels}", steps.join(", "))
}
