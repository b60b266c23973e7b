//! Hints for syntax that is not read, and for plans that are not made: what to write instead.

use datafusion::common::utils::datafusion_strsim::normalized_levenshtein;
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
    ("ASOF", super::as_of_join::FORM),
    ("PIVOT", PIVOT),
    ("UNPIVOT", UNPIVOT),
    ("FOR VERSION", "t VERSION AS OF 12"),
    ("FOR TIMESTAMP", "t TIMESTAMP AS OF '2026-11-21T10:00:00Z'"),
    ("SYSTEM_VERSION", "t VERSION AS OF 12"),
    ("VERSION AS OF", "VERSION AS OF 12, a number without quotes; TIMESTAMP AS OF 'tag'"),
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
/// Minimum similarity of a suggested function: the planner suggests the nearest, however far it is.
const ALIKE_FUNCTION: f64 = 0.75;
/// Functions of Postgres and DuckDB that are not here, and what to write instead.
const FUNCTIONS: [(&str, &str); 59] = [
    ("struct_pack", "{'x': 1}, or named_struct('x', 1)"),
    ("struct_extract", "s.x, or s['x']"),
    ("width_bucket", "floor((x - low) / (high - low) * n) + 1 is the bucket of x"),
    ("percentile_disc", "percentile_cont(0.5) WITHIN GROUP (ORDER BY x), which interpolates"),
    ("quantile", "quantile_cont(x, 0.5), which interpolates"),
    ("quantile_disc", "quantile_cont(x, 0.5), which interpolates"),
    ("list_aggregate", "list_sum(list), list_avg(list), list_min(list) or list_max(list)"),
    ("array_aggregate", "list_sum(list), list_avg(list), list_min(list) or list_max(list)"),
    ("list_apply", "list_transform(list, x -> x * 2)"),
    ("list_value", "[1, 2]"),
    ("list_unique", "array_length(list_distinct(list))"),
    ("list_reverse_sort", "list_sort(list, 'DESC')"),
    ("list_cosine_similarity", "dot_product(a, b) / sqrt(dot_product(a, a) * dot_product(b, b))"),
    ("len", "length(text), or array_length(list)"),
    ("array_upper", "array_length(list)"),
    ("array_lower", "1: lists begin at 1"),
    ("array_fill", "array_repeat(value, n)"),
    ("generate_subscripts", "unnest(range(1, array_length(list) + 1))"),
    ("group_concat", "string_agg(x, ', ')"),
    ("listagg", "string_agg(x, ', ')"),
    ("count_if", "count(*) FILTER (WHERE condition)"),
    ("sum_if", "sum(x) FILTER (WHERE condition)"),
    ("avg_if", "avg(x) FILTER (WHERE condition)"),
    ("every", "bool_and(x)"),
    ("product", "exp(sum(ln(x))), of numbers above 0"),
    ("geomean", "exp(avg(ln(x))), of numbers above 0"),
    ("geometric_mean", "exp(avg(ln(x))), of numbers above 0"),
    ("variance", "var_samp(x)"),
    ("sem", "stddev(x) / sqrt(count(x))"),
    ("mad", "median(abs(x - m)), with m the median from a subquery"),
    ("mod", "a % b"),
    ("fmod", "a % b"),
    ("div", "trunc(a / b)"),
    ("sign", "signum(x)"),
    ("ceiling", "ceil(x)"),
    ("isinf", "abs(x) = 'inf'::double"),
    ("isfinite", "abs(x) < 'inf'::double"),
    ("iff", "CASE WHEN condition THEN a ELSE b END"),
    ("age", "a - b, of two times"),
    ("date_diff", "a - b, of two times; date_part('epoch', a) - date_part('epoch', b) in seconds"),
    ("datediff", "a - b, of two times; date_part('epoch', a) - date_part('epoch', b) in seconds"),
    ("date_add", "t + INTERVAL '1 day'"),
    ("dateadd", "t + INTERVAL '1 day'"),
    ("date_sub", "t - INTERVAL '1 day'"),
    ("time_bucket", "date_bin(INTERVAL '5 minutes', t)"),
    ("strftime", "to_char(t, '%Y-%m-%d')"),
    ("strptime", "to_timestamp(text, '%Y-%m-%d')"),
    ("epoch", "date_part('epoch', t)"),
    ("epoch_ms", "date_part('epoch', t) * 1000"),
    ("string_split", "string_to_array(text, ',')"),
    ("str_split", "string_to_array(text, ',')"),
    ("regexp_extract", "regexp_match(text, pattern)[1]"),
    ("regexp_matches", "regexp_match(text, pattern), or text ~ pattern"),
    ("regexp_full_match", "text ~ '^(?:pattern)$'"),
    ("prefix", "starts_with(text, 'x')"),
    ("suffix", "ends_with(text, 'x')"),
    ("typeof", "arrow_typeof(x)"),
    ("pg_typeof", "arrow_typeof(x)"),
    ("gen_random_uuid", "uuid()"),
];
/// Parts of a time that DuckDB has as functions.
const TIME_PARTS: [&str; 8] = ["year", "quarter", "month", "week", "day", "hour", "minute", "second"];
/// Parts of messages of the planner, and what to write instead.
const PLANS: [(&str, &str); 17] = [
    ("Cannot cast string", "TRY_CAST(x AS type) is null for what does not fit"),
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
    ("not supported for", "CAST(x AS double) makes a number of a text or of a NULL without a type"),
    ("No function matches", "CAST(x AS type) or x::type, and SHOW FUNCTIONS LIKE 'name' for its arguments"),
];
/// Parts of messages of queries that fail while they run, and what to write instead.
const RUNS: [(&str, &str); 5] = [
    ("out of range: ", "CAST(x AS bigint), decimal(38, 0) or double before it"),
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
        if TIME_PARTS.contains(&name) {
            return format!("extract({name} from t)");
        }
        if let Some((column, function)) = name.rsplit_once('.') {
            return format!("{function}({column}): the column is an argument");
        }
        let nearest = message.split_once("Did you mean '").map(|(_, nearest)| nearest.trim_end_matches(['\'', '?']));
        let similar = nearest.filter(|nearest| normalized_levenshtein(name, nearest) >= ALIKE_FUNCTION);
        let similar = similar.map_or_else(String::new, |similar| format!("did you mean `{similar}`? "));
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

/// Returns the hint for a column that is not there, if the statement has its name in double quotes.
pub(crate) fn of_quoted_name(sql: &str, name: &str) -> Option<String> {
    let is_quoted = sql.contains(&format!("\"{name}\""));
    is_quoted.then(|| format!("did you mean the text '{name}'? Texts have single quotes, names of columns double ones"))
}

/// Returns the hint for the message of a query that failed while it ran.
pub(crate) fn of_run(message: &str) -> Option<&'static str> {
    RUNS.into_iter().find(|(part, _)| message.contains(part)).map(|(_, hint)| hint)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn functions_of_other_databases_have_a_hint_and_others_only_near_names() {
        let check = |name: &str, nearest: &str, expected: &str| {
            assert_eq!(of_plan(&format!("Invalid function '{name}'.\nDid you mean '{nearest}'?")), expected);
        };
        check("width_bucket", "list_except", "floor((x - low) / (high - low) * n) + 1 is the bucket of x");
        check("month", "sinh", "extract(month from t)");
        check("xyz", "exp", "SHOW FUNCTIONS lists all");
        check("initcapp", "initcap", "did you mean `initcap`? SHOW FUNCTIONS lists all");
    }
}
