//! Windows whose frames hold or compute again more than their rows.

use super::sql_attack::{SqlAttack, define_attack};

pub(super) const ATTACKS: &[SqlAttack] = &[
    define_attack("array_agg of what follows", || {
        "select max(cardinality(a)) from (select array_agg(value) over (order by value rows between current row and \
         unbounded following) a from generate_series(1, 100000))"
            .into()
    }),
    define_attack("string_agg of what precedes", || {
        "select max(length(a)) from (select string_agg(repeat('x',1000), ',') over (order by value) a from \
         generate_series(1, 100000))"
            .into()
    }),
    define_attack("median of a moving frame", || {
        "select max(m) from (select median(value) over (order by value rows between 100000 preceding and current row) \
         m from generate_series(1, 1000000))"
            .into()
    }),
    define_attack("distinct of a moving frame", || {
        "select max(m) from (select count(distinct value) over (order by value rows between 100000 preceding and \
         100000 following) m from generate_series(1, 1000000))"
            .into()
    }),
    define_attack("range frame of everything", || {
        "select max(m) from (select sum(value) over (order by value % 2 range between unbounded preceding and \
         1000000000 following) m from generate_series(1, 3000000))"
            .into()
    }),
    define_attack("last value without nulls", || {
        "select max(m) from (select last_value(nullif(value, value)) ignore nulls over (order by value rows between \
         unbounded preceding and unbounded following) m from generate_series(1, 1000000))"
            .into()
    }),
    define_attack("row numbers of one partition", || {
        "select max(r) from (select row_number() over (order by value desc) r, * from generate_series(1, 200000000))"
            .into()
    }),
    define_attack("a partition for each row", || {
        "select max(r) from (select rank() over (partition by value order by value) r from generate_series(1, \
         50000000))"
            .into()
    }),
    define_attack("lag over everything", || {
        "select max(r) from (select lag(value, 100000000) over (order by value) r from generate_series(1, 50000000))"
            .into()
    }),
    define_attack("percentiles of a moving frame", || {
        "select max(m) from (select approx_percentile_cont(value, 0.5) over (order by value rows between 10000 \
         preceding and current row) m from generate_series(1, 1000000))"
            .into()
    }),
];
