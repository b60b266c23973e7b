//! Single calls that take long: they do not check for cancellation while they run.

use super::sql_attack::{SqlAttack, define_attack, repeat_numbered};

pub(super) const ATTACKS: &[SqlAttack] = &[
    define_attack("levenshtein of long texts", || {
        "select sum(levenshtein(repeat('a', 30000 + v % 2), repeat('b', 30000))) from generate_series(1,1000000) t(v)"
            .into()
    }),
    define_attack("levenshtein of one row", || {
        "select levenshtein(repeat(run_id, 40000), repeat(surface_id, 200000)) from runs".into()
    }),
    define_attack("regular expression of counted groups", || {
        "select regexp_count(repeat('a', 50000000 + v), '(a{1,50}){1,50}b') from generate_series(1,9) t(v)".into()
    }),
    define_attack("regular expression with backtracking", || {
        "select count(*) from generate_series(1,1000000) t(v) where regexp_like(repeat('a',10000) || v, '(a+)+(a+)+$')"
            .into()
    }),
    define_attack("a regular expression for each row", || {
        "select count(*) from generate_series(1,10000000) t(v) where regexp_like('aaaa', '(' || v || '|a{1,200}){1,9}')"
            .into()
    }),
    define_attack("large regular expression", || {
        format!("select regexp_like(run_id, '{}') from runs", nested_groups())
    }),
    define_attack("like with many wildcards", || {
        format!(
            "select count(*) from generate_series(1,1000) t(v) where repeat('a',100000) || v like '{}b'",
            "%a".repeat(500)
        )
    }),
    define_attack("strpos of long texts", || {
        "select sum(strpos(repeat('a',100000000) || v, repeat('a',50000000) || 'b')) from generate_series(1,9) t(v)"
            .into()
    }),
    define_attack("split_part of commas", || {
        "select sum(length(split_part(repeat(',',50000000) || v, ',', 49999999))) from generate_series(1,100) t(v)"
            .into()
    }),
    define_attack("reverse of long texts", || {
        "select sum(length(reverse(repeat('ä', 50000000) || v))) from generate_series(1,100) t(v)".into()
    }),
    define_attack("initcap of long texts", || {
        "select sum(length(initcap(repeat('ab ', 50000000) || v))) from generate_series(1,100) t(v)".into()
    }),
    define_attack("array_position of a range", || {
        "select sum(array_position(range(0,10000000), 9999999 + v)) from generate_series(1,1000) t(v)".into()
    }),
    define_attack("array_intersect of ranges", || {
        "select cardinality(array_intersect(range(0, 20000000 + v), range(1,20000000))) from generate_series(1,9) t(v)"
            .into()
    }),
    define_attack("array_remove_all of lists", || {
        "select cardinality(array_remove_all(array_repeat([v, v], 10000000), [v, v])) from generate_series(1,9) t(v)"
            .into()
    }),
    define_attack("decimals of 76 digits", || {
        "select sum(power(v::decimal(76,0), 9) * 1e30::decimal(76,0)) from generate_series(1,50000000) t(v)".into()
    }),
    define_attack("decimal divisions", || {
        let divided = repeat_numbered("/ 7.{}::decimal(38,10)", " ", 30);
        format!("select sum(v::decimal(38,20) {divided}) from generate_series(1,30000000) t(v)")
    }),
    define_attack("factorials", || {
        "select sum(factorial(v % 21)) + sum(gcd(v, 9007199254740993)) from generate_series(1,300000000) t(v)".into()
    }),
    define_attack("interval of a million years", || "select now() + interval '999999999 years' x".into()),
    define_attack("date_bin by a nanosecond", || {
        "select count(distinct date_bin(interval '1 nanosecond', now() + v * interval '1 second')) from \
         generate_series(1,100000000) t(v)"
            .into()
    }),
    define_attack("to_timestamp with many formats", || {
        let formats = repeat_numbered("'%Y-%m-%d {}'", ",", 500);
        format!("select count(to_timestamp('2000-01-01 x' || v, {formats})) from generate_series(1,1000000) t(v)")
    }),
    define_attack("casts of wrong texts", || {
        "select count(try_cast(repeat('9', 10000) || v as decimal(38,10))) from generate_series(1,1000000) t(v)".into()
    }),
    define_attack("json path of a long text", || format!("select '{}' -> 'a' x", "{\"a\":".repeat(50_000))),
    define_attack("spectra of ranges", || "select cardinality(spectrum(range(0, 20000000))) x".into()),
    define_attack("levels of huge lists", || "select cardinality(list_db(range(1, 30000000))) x".into()),
];

fn nested_groups() -> String {
    ["(?:", "a{0,50}", "){0,50}"].concat().repeat(40)
}
