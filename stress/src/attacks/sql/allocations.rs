//! Calls and casts that make much of little: one call allocates all of it between two looks at the memory.

use super::sql_attack::{SqlAttack, define_attack, query_chain, repeat_numbered};

pub(super) const ATTACKS: &[SqlAttack] = &[
    define_attack("array_repeat of a range in a list", || {
        "select cardinality(array_repeat(make_array(range(0,30000000)),3000000)) x".into()
    }),
    define_attack("array_resize with a long text", || {
        "select cardinality(array_resize([''], 1000, repeat('x',100000000))) x".into()
    }),
    define_attack("cast to a fixed list", || {
        "select arrow_cast(make_array(1), 'FixedSizeList(400000000, Int64)') is null x".into()
    }),
    define_attack("make_array of long texts", || {
        let texts = vec!["arrow_cast(repeat('x',50000000),'LargeUtf8')"; 60].join(",");
        format!("select cardinality(make_array({texts})) x")
    }),
    define_attack("unnest of ranges", || {
        "select count(*) from (select unnest(range(0,100000000)) x, unnest(range(0,100000000)) y)".into()
    }),
    define_attack("array_has_any of ranges", || {
        "select array_has_any(range(0,99999999),range(99999999,199999999)) x".into()
    }),
    define_attack("repeat to 2 GB", || "select length(repeat('x', 2147483000)) x".into()),
    define_attack("lpad to 2 GB", || "select length(lpad('x', 2147483000, 'ab')) x".into()),
    define_attack("repeat for every row", || {
        "select sum(length(repeat('x', 20000000 + v))) from generate_series(1,100000) t(v)".into()
    }),
    define_attack("rows of 100 MB", || "select repeat('x', 100000000 + v) x from generate_series(1,40) t(v)".into()),
    define_attack("replace with a long text", || {
        "select length(replace(repeat('a',100000), 'a', repeat('b',100000))) x".into()
    }),
    define_attack("translate of a long text", || "select length(translate(repeat('a',250000000), 'a', 'bb')) x".into()),
    define_attack("concatenation doubled", || query_chain("select run_id as x from runs", "x || x as x", 40)),
    define_attack("list concatenation doubled", || {
        query_chain("select range(0, 9) as x", "array_concat(x, x) as x", 30)
    }),
    define_attack("array_append of a long list", || {
        "select cardinality(array_append([range(0,50000000)], range(0,50000000))) x".into()
    }),
    define_attack("flatten of long lists", || {
        "select cardinality(flatten(array_repeat(range(0,1000000), 200))) x".into()
    }),
    define_attack("array_union of ranges", || {
        "select cardinality(array_union(range(0,30000000), range(1,30000001))) x".into()
    }),
    define_attack("array_distinct of a range", || "select cardinality(array_distinct(range(0,33000000))) x".into()),
    define_attack("array_except of ranges", || {
        "select cardinality(array_except(range(0,30000000), range(1,30000001))) x".into()
    }),
    define_attack("array_sort of a range", || "select cardinality(array_sort(range(0,33000000), 'DESC')) x".into()),
    define_attack("array_replace_all by lists", || {
        "select cardinality(array_replace_all(array_repeat([1], 300000), [1], range(0,100000))) x".into()
    }),
    define_attack("map of ranges", || "select cardinality(map(range(0,30000000), range(0,30000000))) x".into()),
    define_attack("string_to_array of commas", || {
        "select cardinality(string_to_array(repeat(',',200000000), ',')) x".into()
    }),
    define_attack("list as text", || "select length(cast(range(0,33000000) as varchar)) x".into()),
    define_attack("array_to_string with a long separator", || {
        "select length(array_to_string(range(0,100000), repeat('x',20000))) x".into()
    }),
    define_attack("regexp_match of everything", || {
        "select cardinality(regexp_match(repeat('ab',100000000), '(a|b)*')) x".into()
    }),
    define_attack("string_agg of long texts", || {
        "select length(string_agg(repeat('x', 1000000), ',')) from generate_series(1,100000) t(v)".into()
    }),
    define_attack("array_agg of lists", || {
        "select cardinality(array_agg(range(0,100000))) from generate_series(1,100000) t(v)".into()
    }),
    define_attack("array_agg of groups", || {
        "select count(*) from (select array_agg(v) a from generate_series(1,100000000) t(v) group by v % 1000003)"
            .into()
    }),
    define_attack("distinct of long texts", || {
        "select count(distinct repeat(v::varchar, 100000)) from generate_series(1,1000000) t(v)".into()
    }),
    define_attack("series of nanoseconds", || {
        "select cardinality(generate_series(timestamp '2000-01-01', timestamp '2100-01-01', interval '1 microsecond')) \
            x"
        .into()
    }),
    define_attack("range of dates", || {
        "select cardinality(range(date '0001-01-01', date '9999-12-31', interval '1 second')) x".into()
    }),
    define_attack("struct of long texts", || {
        format!(
            "select {} from generate_series(1,1000) t(v)",
            repeat_numbered("named_struct('a', repeat('x',10000000)) s{}", ",", 50)
        )
    }),
    define_attack("fixed binary cast", || "select arrow_cast('a', 'FixedSizeBinary(2000000000)') is null x".into()),
];
