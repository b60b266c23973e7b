//! Joins, recursion and series that never come to an end, and sorts and groups of all that they make.

use super::sql_attack::{SqlAttack, define_attack, repeat_numbered};

pub(super) const ATTACKS: &[SqlAttack] = &[
    define_attack("endless recursion", || {
        "with recursive r as (select 1 n union all select n + 1 from r) select count(*) from r".into()
    }),
    define_attack("exploding recursion", || {
        "with recursive r as (select 1 n union all select n + v from r, generate_series(1,1000) t(v)) select count(*) \
         from r"
            .into()
    }),
    define_attack("recursion of growing texts", || {
        "with recursive r as (select 'a' x union all select x || x from r) select max(length(x)) from r".into()
    }),
    define_attack("cross join without rows", || {
        "select count(*) from generate_series(1, 1000000) a cross join generate_series(1, 1000000) b where a.value + \
         b.value = 7"
            .into()
    }),
    define_attack("cross join of three", || {
        "select count(*) from generate_series(1,100000) a, generate_series(1,100000) b, generate_series(1,100000) c"
            .into()
    }),
    define_attack("endless series", || {
        "select count(*) from generate_series(1, 1000000000000000000) t(v) where v % 7 = 3".into()
    }),
    define_attack("endless answer", || {
        "select v, repeat('x', 200) x from generate_series(1, 1000000000000) t(v)".into()
    }),
    define_attack("sort of a billion", || {
        "select v from generate_series(1, 1000000000) t(v) order by v % 1000, -v limit 3 offset 900000000".into()
    }),
    define_attack("distinct of a billion", || {
        "select count(*) from (select distinct v from generate_series(1, 1000000000) t(v))".into()
    }),
    define_attack("groups of texts", || {
        "select count(*) from (select v::varchar || 'xxxxxxxxxxxxxxxxxxxx' k, count(*) from generate_series(1, \
         1000000000) t(v) group by 1)"
            .into()
    }),
    define_attack("hash join of a billion", || {
        "select count(*) from generate_series(1,1000000000) a(v) join generate_series(1,1000000000) b(v) on a.v = b.v"
            .into()
    }),
    define_attack("join with one key", || {
        "select count(*) from generate_series(1,1000000) a(v) join generate_series(1,1000000) b(v) on a.v % 1 = b.v % \
         1 and a.v + b.v < 0"
            .into()
    }),
    define_attack("full join on an inequality", || {
        "select count(*) from generate_series(1,300000) a(v) full join generate_series(1,300000) b(v) on a.v > b.v + \
         1000000"
            .into()
    }),
    define_attack("lateral unnest", || {
        "select count(*) from (select unnest(range(0, v % 1000000)) u, v from generate_series(1,1000000) t(v)) where u \
            < 0"
        .into()
    }),
    define_attack("unnest in unnest", || {
        "select count(*) from (select unnest(unnest(array_repeat(range(0,10000),10000))) x from \
            generate_series(1,1000))"
            .into()
    }),
    define_attack("intersection of series", || {
        "select count(*) from (select v from generate_series(1,500000000) t(v) intersect select v from \
         generate_series(2,500000000) t(v))"
            .into()
    }),
    define_attack("not in of a series", || {
        "select count(*) from generate_series(1,100000000) t(v) where v not in (select w from \
         generate_series(1,100000000) u(w))"
            .into()
    }),
    define_attack("union of sorts", || {
        repeat_numbered(
            "(select v from generate_series(1,50000000) t(v) order by -v limit 10000000)",
            " union all ",
            20,
        )
    }),
];
