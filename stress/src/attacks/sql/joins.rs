//! Joins, recursion and series that never come to an end, and sorts and groups of all that they make.

use super::sql_attack::{SqlAttack, attack, numbered};

pub(super) const ATTACKS: &[SqlAttack] = &[
    attack("endless recursion", || {
        "with recursive r as (select 1 n union all select n + 1 from r) select count(*) from r".into()
    }),
    attack("exploding recursion", || {
        "with recursive r as (select 1 n union all select n + v from r, generate_series(1,1000) t(v)) select count(*) \
         from r"
            .into()
    }),
    attack("recursion of growing texts", || {
        "with recursive r as (select 'a' x union all select x || x from r) select max(length(x)) from r".into()
    }),
    attack("cross join without rows", || {
        "select count(*) from generate_series(1, 1000000) a cross join generate_series(1, 1000000) b where a.value + \
         b.value = 7"
            .into()
    }),
    attack("cross join of three", || {
        "select count(*) from generate_series(1,100000) a, generate_series(1,100000) b, generate_series(1,100000) c"
            .into()
    }),
    attack("endless series", || {
        "select count(*) from generate_series(1, 1000000000000000000) t(v) where v % 7 = 3".into()
    }),
    attack("endless answer", || "select v, repeat('x', 200) x from generate_series(1, 1000000000000) t(v)".into()),
    attack("sort of a billion", || {
        "select v from generate_series(1, 1000000000) t(v) order by v % 1000, -v limit 3 offset 900000000".into()
    }),
    attack("distinct of a billion", || {
        "select count(*) from (select distinct v from generate_series(1, 1000000000) t(v))".into()
    }),
    attack("groups of texts", || {
        "select count(*) from (select v::varchar || 'xxxxxxxxxxxxxxxxxxxx' k, count(*) from generate_series(1, \
         1000000000) t(v) group by 1)"
            .into()
    }),
    attack("hash join of a billion", || {
        "select count(*) from generate_series(1,1000000000) a(v) join generate_series(1,1000000000) b(v) on a.v = b.v"
            .into()
    }),
    attack("join with one key", || {
        "select count(*) from generate_series(1,1000000) a(v) join generate_series(1,1000000) b(v) on a.v % 1 = b.v % 1 \
         and a.v + b.v < 0"
            .into()
    }),
    attack("full join on an inequality", || {
        "select count(*) from generate_series(1,300000) a(v) full join generate_series(1,300000) b(v) on a.v > b.v + \
         1000000"
            .into()
    }),
    attack("lateral unnest", || {
        "select count(*) from (select unnest(range(0, v % 1000000)) u, v from generate_series(1,1000000) t(v)) where u < 0"
            .into()
    }),
    attack("unnest in unnest", || {
        "select count(*) from (select unnest(unnest(array_repeat(range(0,10000),10000))) x from generate_series(1,1000))"
            .into()
    }),
    attack("intersection of series", || {
        "select count(*) from (select v from generate_series(1,500000000) t(v) intersect select v from \
         generate_series(2,500000000) t(v))"
            .into()
    }),
    attack("not in of a series", || {
        "select count(*) from generate_series(1,100000000) t(v) where v not in (select w from generate_series(1,100000000) \
         u(w))"
            .into()
    }),
    attack("union of sorts", || {
        numbered("(select v from generate_series(1,50000000) t(v) order by -v limit 10000000)", " union all ", 20)
    }),
];
