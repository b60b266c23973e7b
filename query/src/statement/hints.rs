//! Hints for syntax that is not read, and for plans that are not made: what to write instead.

use datafusion::sql::sqlparser::keywords::Keyword;
use datafusion::sql::sqlparser::tokenizer::{Token, Tokenizer};

use super::dialect::LakeDialect;

/// The hint if nothing better is known.
const GENERAL: &str =
    "docs/clients.md lists the syntax, docs/functions.md the functions; DESCRIBE (query) shows columns and types";
/// Statements that write, by their first word.
const WRITING: [&str; 15] = [
    "ALTER", "ATTACH", "CALL", "CREATE", "DELETE", "DETACH", "DROP", "EXPORT", "IMPORT", "INSERT", "INSTALL", "LOAD",
    "MERGE", "TRUNCATE", "UPDATE",
];
/// What to write instead of PIVOT.
pub(super) const PIVOT: &str = "max(x) FILTER (WHERE c = 'a') AS a for each value of c, with GROUP BY";
/// What to write instead of UNPIVOT.
pub(super) const UNPIVOT: &str = "SELECT unnest(['a', 'b']) AS name, unnest([a, b]) AS value FROM t";
/// What to write instead of `x: 42`.
pub(super) const NAMED: &str = "AS gives a name: SELECT 42 AS x; s['x'] is the field of a struct";
const FROM_FIRST: &str = "SELECT * FROM t WHERE ...; FROM t alone is all of a table";
const COLUMN_PATTERN: &str = "COLUMNS('_mm$'), with a regular expression";
/// Words in a row of a statement that is not read, and what to write instead. `^` is before the first word.
const SYNTAX: [(&str, &str); 30] = [
    ("MATERIALIZED", "WITH t AS (SELECT ...)"),
    ("USING SAMPLE", "WHERE random() < 0.1 takes a tenth of the rows, ORDER BY random() LIMIT 10 takes ten"),
    ("LIMIT # %", "QUALIFY percent_rank() over (order by x) < 0.1, or LIMIT with a number of rows"),
    ("ASOF", "JOIN ... ON a.t >= b.t QUALIFY row_number() over (partition by a.id order by b.t desc) = 1"),
    ("PIVOT", PIVOT),
    ("UNPIVOT", UNPIVOT),
    ("FOR VERSION", "t VERSION AS OF 12"),
    ("FOR TIMESTAMP", "t TIMESTAMP AS OF '2026-11-21T10:00:00Z'"),
    ("SYSTEM_VERSION", "t VERSION AS OF 12"),
    ("VERSION AS OF", "VERSION AS OF 12, a number without quotes"),
    ("* COLUMNS", "write the columns out: coalesce(a, b)"),
    ("* *", "power(a, b)"),
    ("GLOB", "x LIKE 'a%', or x ~ '^a' for a regular expression"),
    ("ISNULL", "x IS NULL"),
    ("SET", "write the value where it is used, or WITH settings AS (SELECT 1 AS x)"),
    ("* LIKE", COLUMN_PATTERN),
    ("* ILIKE", COLUMN_PATTERN),
    ("* NOT LIKE", COLUMN_PATTERN),
    ("* NOT ILIKE", COLUMN_PATTERN),
    ("* SIMILAR", COLUMN_PATTERN),
    ("* NOT SIMILAR", COLUMN_PATTERN),
    ("FOR", "array_transform(list, x -> x * 2), array_filter(list, x -> x > 1)"),
    ("NOT IN [", "NOT array_has(list, x)"),
    ("IN [", "array_has(list, x)"),
    ("^ FROM", FROM_FIRST),
    ("( FROM", FROM_FIRST),
    ("UNION ALL FROM", FROM_FIRST),
    ("UNION FROM", FROM_FIRST),
    (": #", NAMED),
    (": ", NAMED),
];
/// Functions of other databases, and what to write instead.
const FUNCTIONS: [(&str, &str); 1] = [("struct_pack", "{'x': 1}, or named_struct('x', 1)")];
/// Parts of messages of the planner, and what to write instead.
const PLANS: [(&str, &str); 15] = [
    ("min/max was called with", "array_agg(x ORDER BY x DESC)[1:3] for several values, greatest(x, y) of one row"),
    ("QUALIFY clause requires", "WHERE, or HAVING for aggregates; QUALIFY is for window functions"),
    ("unique expression names", "give one of them another name with AS"),
    ("Operator DIV", "a / b, which of whole numbers is a whole number"),
    ("array_slice", "substr(text, 1, 3) for text; list[2:3] for lists"),
    ("Invalid qualifier", "the name of a table in FROM; the fields of a struct are s.x and s['y']"),
    ("with RENAME", "* EXCLUDE (a), a AS b"),
    ("Dot access", "upper(x) for x.upper()"),
    ("OuterReferenceColumn", "JOIN ... ON, or a subquery with an aggregate"),
    ("LIMIT", "LIMIT with a number of rows"),
    ("Unsupported ast node", "docs/clients.md lists the syntax that is planned"),
    ("GROUP BY", "GROUP BY ALL groups by all columns that are no aggregates"),
    ("WHERE clause cannot contain", "HAVING for aggregates, QUALIFY for window functions"),
    ("Cannot infer common argument type", "CAST(x AS type) or x::type makes the types equal"),
    ("No function matches", "CAST(x AS type) or x::type, and SHOW FUNCTIONS LIKE 'name' for its arguments"),
];
/// Parts of messages of queries that fail while they run, and what to write instead.
const RUNS: [(&str, &str); 4] = [
    ("division by zero", "a / nullif(b, 0) is null there"),
    ("Cannot cast", "TRY_CAST(x AS type) is null for what does not fit"),
    ("verflow", "CAST(x AS double) or a wider type"),
    ("scalar subquery", "LIMIT 1, or an aggregate, in the subquery"),
];
/// Maximum characters of a message; the planner prints whole syntax trees.
const MOST_CHARS: usize = 300;

/// Returns the hint for a statement that is not read.
pub(crate) fn of_syntax(sql: &str) -> String {
    let tokens = Tokenizer::new(&LakeDialect, sql).tokenize().unwrap_or_default();
    let words: Vec<String> = ["^".to_owned()].into_iter().chain(tokens.iter().filter_map(word_of)).collect();
    if words.get(1).is_some_and(|first| WRITING.contains(&first.as_str())) {
        return "SELECT, EXPLAIN, DESCRIBE and SHOW are allowed here".to_owned();
    }
    let has = |phrase: &str| {
        let phrase: Vec<&str> = phrase.split(' ').collect();
        words.windows(phrase.len()).any(|window| window.iter().eq(phrase.iter()))
    };
    let known = SYNTAX.into_iter().find(|(phrase, _)| has(phrase)).map(|(_, hint)| hint);
    known.unwrap_or(GENERAL).to_owned()
}

/// Returns the hint for a message of the planner.
pub(crate) fn of_plan(message: &str) -> String {
    if let Some(name) = message.strip_prefix("Invalid function '").and_then(|rest| rest.split('\'').next()) {
        if let Some((_, hint)) = FUNCTIONS.into_iter().find(|(other, _)| *other == name) {
            return hint.to_owned();
        }
        if let Some((column, function)) = name.rsplit_once('.') {
            return format!("{function}({column}): the column is an argument");
        }
        let similar = message.split_once("Did you mean ").map(|(_, similar)| similar.trim_end_matches('?'));
        let similar = similar.map_or_else(String::new, |similar| format!("did you mean {similar}? "));
        return format!("{similar}SHOW FUNCTIONS lists all");
    }
    let known = PLANS.into_iter().find(|(part, _)| message.contains(part)).map(|(_, hint)| hint);
    known.unwrap_or(GENERAL).to_owned()
}

/// Returns the hint for a column that is not there, if the statement has an alias of its name.
pub(crate) fn of_alias(sql: &str, name: &str) -> Option<String> {
    let tokens = Tokenizer::new(&LakeDialect, sql).tokenize().ok()?;
    let mut words = tokens.iter().filter(|token| !matches!(token, Token::Whitespace(_)));
    let is_alias = |token: &Token| matches!(token, Token::Word(word) if word.value.eq_ignore_ascii_case(name));
    while let Some(token) = words.next() {
        if matches!(token, Token::Word(word) if word.keyword == Keyword::AS) && words.next().is_some_and(is_alias) {
            return Some(format!("an alias is no column of its own SELECT: ... FROM (SELECT ... AS {name} FROM ...)"));
        }
    }
    None
}

/// Returns the message of a query that failed while it ran, with a hint if one is known.
pub(crate) fn with_hint(message: String) -> String {
    let known = RUNS.into_iter().find(|(part, _)| message.contains(part) && !message.contains("hint: "));
    known.map_or(message.clone(), |(_, hint)| format!("{message}; hint: {hint}"))
}

/// Returns a message without the suggestion, which is in the hint, and without the planner's own structures.
pub(crate) fn shorten_message(message: &str) -> String {
    let message = match message.split_once("Did you mean ") {
        Some((message, _)) if message.starts_with("Invalid function") => {
            message.trim_end().trim_end_matches('.').replace("Invalid function '", "no function `").replace('\'', "`")
        }
        _ => message.to_owned(),
    };
    let tree = [" { ", "(Function {", "(Ident {"].iter().filter_map(|mark| message.find(mark)).min();
    let cut = tree.filter(|_| message.contains("span: Span(")).unwrap_or(message.len());
    let short: String = message[..cut].chars().take(MOST_CHARS).collect();
    if short.len() < message.len() { format!("{short}...") } else { short }
}

// Numbers are `#`, texts are empty; None for blanks.
fn word_of(token: &Token) -> Option<String> {
    match token {
        Token::Whitespace(_) => None,
        Token::Number(..) => Some("#".to_owned()),
        Token::SingleQuotedString(_) => Some(String::new()),
        Token::Word(word) if word.quote_style.is_some() => Some(String::new()),
        other => Some(other.to_string().to_uppercase()),
    }
}
