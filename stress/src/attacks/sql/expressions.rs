//! Deep and long expressions: what parses, plans, prints or drops them recurses along them or tries them again.

use super::sql_attack::{SqlAttack, attack, nested, numbered};

pub(super) const ATTACKS: &[SqlAttack] = &[
    attack("chain of plus", || format!("select {}", numbered("1", "+", 8000))),
    attack("type of nested lists", || format!("select cast(NULL as int{}) x", "[]".repeat(8000))),
    attack("chain of concatenations", || format!("select {} x", numbered("'a'", "||", 8000))),
    attack("chain of casts", || format!("select 1{} x", "::int".repeat(8000))),
    attack("chain of is null", || format!("select 1{} x", " is null".repeat(8000))),
    attack("chain of and", || format!("select {} x", numbered("true", " and ", 8000))),
    attack("chain of or", || format!("select 1 from pairs where {}", numbered("pair_id={}", " or ", 16_000))),
    attack("name of a nested type", || format!("select arrow_cast(NULL, '{}') x", nested("List(", "Int8", ")", 8000))),
    attack("array type in angle brackets", || format!("select cast(NULL as {}) x", nested("array<", "int", ">", 8000))),
    attack("struct type in angle brackets", || {
        format!("select cast(NULL as {}) x", nested("struct<a ", "int", ">", 8000))
    }),
    attack("unions", || numbered("select {} as n", " union all ", 4000)),
    attack("position in position", || format!("select {}!{}", "position(".repeat(22), " in 'x')".repeat(22))),
    attack("cast in cast", || format!("select {}!{}", "cast(".repeat(22), " as int)".repeat(22))),
    attack("as of clauses", || format!("select 1 from runs {}", "a version as of 1, ".repeat(20_000))),
    attack("parentheses", || format!("select {} x", nested("(", "1", ")", 100_000))),
    attack("case in case", || format!("select {} x", nested("case when 1=1 then ", "1", " else 0 end", 3000))),
    attack("case arms", || format!("select case pair_id {} end from pairs", numbered("when {} then {}", " ", 60_000))),
    attack("chain of not", || format!("select {}true x", "not ".repeat(50_000))),
    attack("chain of minus signs", || format!("select {}1 x", "- ".repeat(50_000))),
    attack("calls in calls", || format!("select {} x", nested("abs(", "1", ")", 5000))),
    attack("extract in substring in trim", || {
        format!("select {}!{}", "extract(year from substring(trim(".repeat(8), ") from 1))".repeat(8))
    }),
    attack("array literals in each other", || format!("select {} x", nested("[", "1", "]", 5000))),
    attack("structs in each other", || format!("select {} x", nested("named_struct('a', ", "1", ")", 3000))),
    attack("subqueries in each other", || format!("select {} x", nested("(select ", "1", ")", 3000))),
    attack("in list", || format!("select 1 from pairs where pair_id in ({})", numbered("{}", ",", 300_000))),
    attack("values", || format!("select count(*) from (values {}) t", numbered("({})", ",", 250_000))),
    attack("chain of like", || format!("select 'a'{} x", " like 'a'".repeat(8000))),
    attack("chain of between", || format!("select 1{} x", " between 0 and 2".repeat(4000))),
    attack("chain of subscripts", || format!("select [1]{} x", "[1]".repeat(8000))),
    attack("chain of time zones", || format!("select now(){} x", " at time zone 'UTC'".repeat(4000))),
    attack("chain of collate", || format!("select 'a'{} x", " collate \"C\"".repeat(8000))),
    attack("comments in comments", || format!("select {} 1 x", nested("/*", "", "*/", 300_000))),
    attack("joins in parentheses", || {
        format!("select 1 from {} limit 1", nested("(pairs natural join ", "pairs", ")", 2000))
    }),
    attack("names of 1 MB", || format!("select 1 as \"{0}\", 2 as \"{0}b\"", "n".repeat(900_000))),
    attack("columns", || format!("select {} from pairs", numbered("pair_id + {} as c{}", ",", 20_000))),
    attack("statements", || numbered("select {} as n", ";", 50_000)),
    // The same, of sizes that a server may well take.
    attack("1900 plus", || format!("select {}", numbered("1", "+", 1900))),
    attack("1900 casts", || format!("select 1{} x", "::int".repeat(1900))),
    attack("1900 concatenations", || format!("select {} x", numbered("'a'", "||", 1900))),
    attack("1900 or", || format!("select 1 from pairs where {}", numbered("pair_id={}", " or ", 1900))),
    attack("1900 is null", || format!("select 1{} x", " is null".repeat(1900))),
    attack("1900 unions", || numbered("select {} as n", " union all ", 1900)),
    attack("1900 unions of distinct rows", || numbered("select {} as n", " union ", 1900)),
    attack("1900 subscripts", || format!("select [1]{} x", "[1]".repeat(950))),
    attack("90 parentheses", || format!("select {} x", nested("(", "1", ")", 90))),
    attack("90 cases", || format!("select {} x", nested("case when 1=1 then ", "1", " else 0 end", 90))),
    attack("90 subqueries", || format!("select {} x", nested("(select ", "1", ")", 90))),
    attack("12 calls", || format!("select {} x", nested("abs(", "1", ")", 12))),
    attack("5 positions", || format!("select {}!{}", "position(".repeat(5), " in 'x')".repeat(5))),
    attack("many small bombs", || {
        let bomb = format!("{}!{}", "position(".repeat(5), " in 'x')".repeat(5));
        format!("select {}", vec![bomb.as_str(); 20_000].join(","))
    }),
];
