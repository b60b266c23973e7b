//! The lake's own tables, catalogues and run files, read many times in one statement.

use super::sql_attack::{SqlAttack, define_attack, repeat_numbered};

pub(super) const ATTACKS: &[SqlAttack] = &[
    define_attack("mcap in unions", || {
        repeat_numbered("select count(*) from mcap('flat', '/sweep')", " union all ", 300)
    }),
    define_attack("mcap joined with itself", || {
        let tables = repeat_numbered("mcap_messages('flat') m{}", ",", 6);
        format!("select count(*) from {tables} where m0.sequence + m1.sequence < 0")
    }),
    define_attack("mcap_topics of names", || {
        repeat_numbered("select count(*) from mcap_topics('{}')", " union all ", 1500)
    }),
    define_attack("mcap of a path outside", || "select * from mcap('../../../../etc/passwd', '/sweep')".into()),
    define_attack("mcap with a long name", || format!("select * from mcap('{}', '/sweep')", "a/".repeat(500_000))),
    define_attack("versions", || {
        let tables = repeat_numbered("(select pair_id + {} from nce version as of 1)", " union all ", 300);
        format!("select count(*) from ({tables})")
    }),
    define_attack("version without an end", || format!("select * from nce version as of {}", "9".repeat(100_000))),
    define_attack("catalogue joined with itself", || {
        let tables = repeat_numbered("information_schema.columns c{}", ",", 6);
        format!("select count(*) from {tables} where c0.ordinal_position < 0")
    }),
    define_attack("responses joined with themselves", || {
        "select max(pearson(a.ir, b.ir)) from measurements a, measurements b, measurements c, measurements d".into()
    }),
    define_attack("spectra of all responses", || {
        "select sum(list_energy(spectrum(a.ir))) from measurements a, generate_series(1,100000)".into()
    }),
    define_attack("responses as text", || {
        "select sum(length(cast(ir as varchar))) from measurements, generate_series(1,100000)".into()
    }),
    define_attack("tables joined by position", || {
        "select count(*) from tnce_d4 a join tnce_d4 b on abs(a.tnce_total - b.tnce_total) > 1e9 cross join tnce_d4 c \
         cross join tnce_d4 d"
            .into()
    }),
    define_attack("descriptions joined with themselves", || {
        let tables = repeat_numbered("pg_catalog.pg_attribute a{}", " cross join ", 6);
        format!("select count(*) from {tables} where a0.attnum + a1.attnum < -100000")
    }),
];
