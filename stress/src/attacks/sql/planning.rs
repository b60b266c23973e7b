//! Small statements whose plans are large, or are computed while they are planned: nothing runs yet that could be ended.

use super::sql_attack::{SqlAttack, attack, numbered, steps};

pub(super) const ATTACKS: &[SqlAttack] = &[
    attack("folded levenshtein", || {
        format!("select {}", numbered("levenshtein(repeat('a',300000), repeat('b',300000)) as c{}", ",", 10_000))
    }),
    attack("folded levenshtein of literals", || {
        let text = "ab".repeat(400_000);
        format!("select levenshtein('{text}', '{text}c') x")
    }),
    attack("folded regular expressions", || {
        format!("select {}", numbered("regexp_replace(repeat('ab{}',1000000), '(a|b)+', 'c', 'g') as c{}", ",", 500))
    }),
    attack("cte doubled 18 times", || doubled_cte(18)),
    attack("cte doubled 22 times", || doubled_cte(22)),
    attack("cube of 30", || {
        let columns = numbered("v % {}", ",", 31).split_off("v % 0,".len());
        format!("select count(*) from generate_series(1,10) t(v) group by cube({columns})")
    }),
    attack("grouping sets", || {
        let sets = numbered("(a+{}, b+{}, c)", ",", 3000);
        format!("select count(*) from (values (1,2,3)) t(a, b, c) group by grouping sets({sets})")
    }),
    attack("rollup of 3000", || {
        format!("select count(*) from generate_series(1,3) t(v) group by rollup({})", numbered("v+{}", ",", 3000))
    }),
    attack("cross joins", || format!("select 1 from {} limit 1", numbered("pairs p{}", " cross join ", 300))),
    attack("joins on keys", || {
        let joins = numbered("join tnce t{} on t{}.pair_id = p.pair_id", " ", 150);
        format!("select count(*) from pairs p {joins}")
    }),
    attack("conjunction of disjunctions", || {
        format!("select 1 from pairs where {}", numbered("(pair_id = {} or direct_mm = {})", " and ", 400))
    }),
    attack("disjunction of conjunctions", || {
        format!("select 1 from pairs where {}", numbered("(pair_id = {} and direct_mm > {})", " or ", 400))
    }),
    attack("join on a disjunction", || {
        let condition = numbered("(a.pair_id = b.pair_id + {} and a.direct_mm < {})", " or ", 300);
        format!("select count(*) from pairs a join pairs b on {condition}")
    }),
    attack("windows of many orders", || {
        format!("select {} from pairs", numbered("row_number() over (order by pair_id % ({} + 2)) w{}", ",", 800))
    }),
    attack("correlated subqueries", || {
        let subquery = "(select max(b{}.pair_id) from pairs b{} where b{}.direct_mm < a.direct_mm) c{}";
        format!("select {} from pairs a", numbered(subquery, ",", 150))
    }),
    attack("correlated subqueries in each other", || {
        let begun = numbered("exists (select 1 from pairs a{} where a{}.pair_id = p.pair_id and ", "", 20);
        format!("select 1 from pairs p where {begun}true{}", ")".repeat(20))
    }),
    attack("in subqueries", || {
        let condition = numbered("pair_id in (select pair_id from tnce where pair_id <> {})", " and ", 150);
        format!("select count(*) from pairs where {condition}")
    }),
    attack("views in unions", || numbered("select pair_id from augmented where pair_id = {}", " union ", 400)),
    attack("columns of columns", || {
        let columns = numbered("a{}.*", ",", 60);
        let tables = numbered("measurements a{}", ",", 60);
        format!("select {columns} from {tables} limit 0")
    }),
    attack("64 expressions doubled 60 times", || {
        let columns = numbered("x{}", ",", 64);
        let doubled = numbered("x{} + x{} as x{}", ",", 64);
        format!(
            "select {columns} from ({}) t",
            steps(&format!("select {}", numbered("{} as x{}", ",", 64)), &doubled, 60)
        )
    }),
    attack("sort keys", || format!("select 1 from pairs order by {}", numbered("pair_id + {}", ",", 5000))),
    attack("aggregates with filters", || {
        format!("select {} from pairs", numbered("sum(direct_mm) filter (where pair_id = {}) c{}", ",", 3000))
    }),
    attack("expressions doubled 30 times", || steps("select pair_id as x from pairs", "x + x + 1 as x", 30)),
    attack("pivot by cases", || {
        let columns = numbered("max(case when pair_id = {} then direct_mm end) p{}", ",", 6000);
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
