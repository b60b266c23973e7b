//! Deep and long expressions: what parses, plans, prints or drops them recurses along them or tries them again.

use super::sql_attack::{SqlAttack, define_attack, nest_expression, repeat_numbered};

pub(super) const ATTACKS: &[SqlAttack] = &[
    define_attack("chain of plus", || format!("select {}", repeat_numbered("1", "+", 8000))),
    define_attack("type of nested lists", || format!("select cast(NULL as int{}) x", "[]".repeat(8000))),
    define_attack("chain of concatenations", || format!("select {} x", repeat_numbered("'a'", "||", 8000))),
    define_attack("chain of casts", || format!("select 1{} x", "::int".repeat(8000))),
    define_attack("chain of is null", || format!("select 1{} x", " is null".repeat(8000))),
    define_attack("chain of and", || format!("select {} x", repeat_numbered("true", " and ", 8000))),
    define_attack("chain of or", || {
        format!("select 1 from pairs where {}", repeat_numbered("pair_id={}", " or ", 16_000))
    }),
    define_attack("name of a nested type", || {
        format!("select arrow_cast(NULL, '{}') x", nest_expression("List(", "Int8", ")", 8000))
    }),
    define_attack("array type in angle brackets", || {
        format!("select cast(NULL as {}) x", nest_expression("array<", "int", ">", 8000))
    }),
    define_attack("struct type in angle brackets", || {
        format!("select cast(NULL as {}) x", nest_expression("struct<a ", "int", ">", 8000))
    }),
    define_attack("unions", || repeat_numbered("select {} as n", " union all ", 4000)),
    define_attack("position in position", || format!("select {}!{}", "position(".repeat(22), " in 'x')".repeat(22))),
    define_attack("cast in cast", || format!("select {}!{}", "cast(".repeat(22), " as int)".repeat(22))),
    define_attack("as of clauses", || format!("select 1 from runs {}", "a version as of 1, ".repeat(20_000))),
    define_attack("parentheses", || format!("select {} x", nest_expression("(", "1", ")", 100_000))),
    define_attack("case in case", || {
        format!("select {} x", nest_expression("case when 1=1 then ", "1", " else 0 end", 3000))
    }),
    define_attack("case arms", || {
        format!("select case pair_id {} end from pairs", repeat_numbered("when {} then {}", " ", 60_000))
    }),
    define_attack("chain of not", || format!("select {}true x", "not ".repeat(50_000))),
    define_attack("chain of minus signs", || format!("select {}1 x", "- ".repeat(50_000))),
    define_attack("calls in calls", || format!("select {} x", nest_expression("abs(", "1", ")", 5000))),
    define_attack("extract in substring in trim", || {
        format!("select {}!{}", "extract(year from substring(trim(".repeat(8), ") from 1))".repeat(8))
    }),
    define_attack("array literals in each other", || format!("select {} x", nest_expression("[", "1", "]", 5000))),
    define_attack("structs in each other", || {
        format!("select {} x", nest_expression("named_struct('a', ", "1", ")", 3000))
    }),
    define_attack("subqueries in each other", || format!("select {} x", nest_expression("(select ", "1", ")", 3000))),
    define_attack("in list", || {
        format!("select 1 from pairs where pair_id in ({})", repeat_numbered("{}", ",", 300_000))
    }),
    define_attack("values", || format!("select count(*) from (values {}) t", repeat_numbered("({})", ",", 250_000))),
    define_attack("chain of like", || format!("select 'a'{} x", " like 'a'".repeat(8000))),
    define_attack("chain of between", || format!("select 1{} x", " between 0 and 2".repeat(4000))),
    define_attack("chain of subscripts", || format!("select [1]{} x", "[1]".repeat(8000))),
    define_attack("chain of time zones", || format!("select now(){} x", " at time zone 'UTC'".repeat(4000))),
    define_attack("chain of collate", || format!("select 'a'{} x", " collate \"C\"".repeat(8000))),
    define_attack("comments in comments", || format!("select {} 1 x", nest_expression("/*", "", "*/", 300_000))),
    define_attack("joins in parentheses", || {
        format!("select 1 from {} limit 1", nest_expression("(pairs natural join ", "pairs", ")", 2000))
    }),
    define_attack("names of 1 MB", || format!("select 1 as \"{0}\", 2 as \"{0}b\"", "n".repeat(900_000))),
    define_attack("columns", || format!("select {} from pairs", repeat_numbered("pair_id + {} as c{}", ",", 20_000))),
    define_attack("statements", || repeat_numbered("select {} as n", ";", 50_000)),
    // The same, of sizes that a server may well take.
    define_attack("1900 plus", || format!("select {}", repeat_numbered("1", "+", 1900))),
    define_attack("1900 casts", || format!("select 1{} x", "::int".repeat(1900))),
    define_attack("1900 concatenations", || format!("select {} x", repeat_numbered("'a'", "||", 1900))),
    define_attack("1900 or", || format!("select 1 from pairs where {}", repeat_numbered("pair_id={}", " or ", 1900))),
    define_attack("1900 is null", || format!("select 1{} x", " is null".repeat(1900))),
    define_attack("1900 unions", || repeat_numbered("select {} as n", " union all ", 1900)),
    define_attack("1900 unions of distinct rows", || repeat_numbered("select {} as n", " union ", 1900)),
    define_attack("1900 subscripts", || format!("select [1]{} x", "[1]".repeat(950))),
    define_attack("90 parentheses", || format!("select {} x", nest_expression("(", "1", ")", 90))),
    define_attack("90 cases", || {
        format!("select {} x", nest_expression("case when 1=1 then ", "1", " else 0 end", 90))
    }),
    define_attack("90 subqueries", || format!("select {} x", nest_expression("(select ", "1", ")", 90))),
    define_attack("12 calls", || format!("select {} x", nest_expression("abs(", "1", ")", 12))),
    define_attack("5 positions", || format!("select {}!{}", "position(".repeat(5), " in 'x')".repeat(5))),
    define_attack("many small bombs", || {
        let bomb = format!("{}!{}", "position(".repeat(5), " in 'x')".repeat(5));
        format!("select {}", vec![bomb.as_str(); 20_000].join(","))
    }),
];
