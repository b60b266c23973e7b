//! Refuses a statement by its tokens, before it is parsed, if its shape alone makes it too expensive.
//!
//! The parser backtracks: it tries a call's arguments again for each possible syntax of the call, so that time doubles
//! or quadruples with every nested call. Parser and planner recurse along chains, so that thousands of `+` in a row
//! exhaust a stack. Lists separated by commas (IN, VALUES) cost nothing but their length.

use std::any::TypeId;

use datafusion::sql::sqlparser::dialect::{Dialect, PostgreSqlDialect};
use datafusion::sql::sqlparser::tokenizer::{Token, Tokenizer, Word};

use super::columns::hinted_error;
use crate::Error;

/// Maximum nesting of brackets.
const MOST_NESTED: usize = 100;
/// Maximum number of operators and suffixes of one expression; also of set operators and joins of one query. Twice as
/// many are still harmless.
const MOST_CHAINED: usize = 1_000;
/// Maximum number of arms of one CASE: the planner looks at each of them many times.
const MOST_ARMS: usize = 10_000;
/// Maximum number of statements in one text.
const MOST_STATEMENTS: usize = 1_000;
/// Maximum doublings of the parser's time: 2^14 tries take a few hundredths of a second.
const MOST_DOUBLINGS: f64 = 14.0;
/// Maximum number of WITHs in WITHs: for each of them DataFusion looks for tables twice in what stands inside.
const MOST_NESTED_WITH: usize = 14;
/// Calls with a syntax of their own, which the parser tries up to five times.
const TRIED_FIVE_TIMES: [&str; 20] = [
    "ANY",
    "CAST",
    "CEIL",
    "CONVERT",
    "CURRENT_DATE",
    "CURRENT_TIME",
    "CURRENT_TIMESTAMP",
    "EXTRACT",
    "FLOOR",
    "INTERVAL",
    "LOCALTIME",
    "LOCALTIMESTAMP",
    "NOT",
    "OVERLAY",
    "POSITION",
    "SAFE_CAST",
    "SUBSTR",
    "SUBSTRING",
    "TRIM",
    "TRY_CAST",
];
/// Words between two expressions, or after one.
const OPERATORS: [&str; 15] = [
    "AND", "AT", "BETWEEN", "COLLATE", "DIV", "ILIKE", "IS", "LIKE", "NOT", "OR", "OVERLAPS", "REGEXP", "RLIKE",
    "SIMILAR", "XOR",
];
/// Words between two queries or tables; a comma does not end their chain.
const QUERY_OPERATORS: [&str; 5] = ["EXCEPT", "INTERSECT", "JOIN", "MINUS", "UNION"];
/// Words after a table that wrap it in one more query.
const PIVOT_WORDS: [&str; 2] = ["PIVOT", "UNPIVOT"];
/// Maximum number of pivots in one statement: each is planned for its columns.
const MOST_PIVOTS: usize = 20;
/// Functions whose strings are types, which nest by brackets as well.
const TYPE_FUNCTIONS: [&str; 2] = ["ARROW_CAST", "ARROW_TRY_CAST"];

/// Words between the branches of CASE, each of which is an expression of its own.
const BRANCH_WORDS: [&str; 3] = ["WHEN", "THEN", "ELSE"];

/// Counts within an open bracket of a statement. CASE and its END are brackets, too.
#[derive(Default)]
struct OpenBracket {
    is_case: bool,
    has_with: bool,
    /// Arms of a CASE.
    arms: usize,
    /// Operators since the last comma, or the last word between branches.
    operators: usize,
    /// Set operators and joins.
    query_operators: usize,
    /// Doublings of the parser's time that the bracket adds.
    doublings: f64,
}

/// Accepts statements whose shape is cheap to parse and plan.
///
/// ```
/// use datafusion::sql::sqlparser::dialect::GenericDialect;
/// use echolake_query::check_statement_bounds;
///
/// assert!(check_statement_bounds("select 1 + 1", &GenericDialect {}).is_ok());
/// assert!(check_statement_bounds(&format!("select 1{}", " + 1".repeat(2000)), &GenericDialect {}).is_err());
/// ```
///
/// # Errors
/// [`Error::Query`] with the exceeded limit for all others.
pub fn check_statement_bounds(sql: &str, dialect: &dyn Dialect) -> Result<(), Error> {
    // Invalid SQL is left to the parser's message; the parser also tokenizes everything before it parses.
    let Ok(tokens) = Tokenizer::new(dialect, sql).tokenize() else { return Ok(()) };
    let call_doublings = if dialect.dialect() == TypeId::of::<PostgreSqlDialect>() { 1.0 } else { 0.0 };
    let is_one_of = |word: &Word, words: &[&str]| {
        word.quote_style.is_none() && words.iter().any(|w| word.value.eq_ignore_ascii_case(w))
    };
    let has_types = tokens.iter().any(|t| matches!(t, Token::Word(w) if is_one_of(w, &TYPE_FUNCTIONS)));
    let mut open = vec![OpenBracket::default()];
    let mut doublings = 0.0;
    let mut statements = 0;
    let pivots = tokens.iter().filter(|t| matches!(t, Token::Word(w) if is_one_of(w, &PIVOT_WORDS))).count();
    if pivots > MOST_PIVOTS {
        return refuse_excess("pivots", MOST_PIVOTS, "WITH gives a name to what stands inside");
    }
    let mut before = &Token::EOF;
    // `1_000_` is a number with a column's name behind it, and `12x` as well.
    if let Some([Token::Number(number, _), Token::Word(word)]) =
        tokens.array_windows().find(|[a, b]| matches!(a, Token::Number(..)) && matches!(b, Token::Word(_)))
    {
        return Err(hinted_error(format!("`{number}{word}` is no number"), "a blank between a number and a name"));
    }
    for token in tokens.iter().filter(|t| !matches!(t, Token::Whitespace(_))) {
        let Some(innermost) = open.last_mut() else { break };
        match token {
            Token::LParen | Token::LBracket | Token::LBrace => {
                // `x[1][1]...` is a chain, whatever is in its brackets.
                innermost.operators += usize::from(*token == Token::LBracket);
                let added = match before {
                    Token::Word(word) if is_one_of(word, &TRIED_FIVE_TIMES) => 2.3,
                    Token::Word(word) if word.value.eq_ignore_ascii_case("array") => 1.0,
                    Token::Word(_) => call_doublings,
                    _ => 0.0,
                };
                doublings += added;
                open.push(OpenBracket { doublings: added, ..OpenBracket::default() });
            }
            Token::RParen | Token::RBracket | Token::RBrace => {
                if open.len() > 1 {
                    doublings -= open.pop().map_or(0.0, |closed| closed.doublings);
                }
            }
            Token::Comma => innermost.operators = 0,
            Token::SemiColon => {
                statements += 1;
                *innermost = OpenBracket { doublings: innermost.doublings, ..OpenBracket::default() };
            }
            Token::Word(word) if is_one_of(word, &["CASE"]) => {
                open.push(OpenBracket { is_case: true, ..OpenBracket::default() });
            }
            Token::Word(word) if innermost.is_case && is_one_of(word, &BRANCH_WORDS) => {
                innermost.operators = 0;
                innermost.arms += usize::from(is_one_of(word, &["WHEN"]));
                if innermost.arms > MOST_ARMS {
                    return refuse_excess("arms in one CASE", MOST_ARMS, "a join with VALUES takes long lists");
                }
            }
            Token::Word(word) if innermost.is_case && is_one_of(word, &["END"]) => drop(open.pop()),
            Token::Word(word) if is_one_of(word, &QUERY_OPERATORS) => innermost.query_operators += 1,
            Token::Word(word) if is_one_of(word, &["WITH"]) => {
                innermost.has_with = true;
                if open.iter().filter(|bracket| bracket.has_with).count() > MOST_NESTED_WITH {
                    let hint = "one WITH can name all of them, one after the other";
                    return refuse_excess("WITHs in WITHs", MOST_NESTED_WITH, hint);
                }
            }
            Token::Word(word) => innermost.operators += usize::from(is_one_of(word, &OPERATORS)),
            Token::Number(..) | Token::Placeholder(_) => {}
            literal if has_types && nesting_depth(literal) > MOST_NESTED => {
                return refuse_excess("brackets in the name of a type", MOST_NESTED, "types that are less deep");
            }
            literal if is_string(literal) => {}
            _ => innermost.operators += 1,
        }
        let innermost = open.last().map_or((0, 0), |bracket| (bracket.operators, bracket.query_operators));
        if open.len() > MOST_NESTED {
            return refuse_excess("brackets in brackets", MOST_NESTED, "WITH gives a name to what stands inside");
        }
        if doublings > MOST_DOUBLINGS {
            let most = (MOST_DOUBLINGS / if call_doublings > 0.0 { 1.0 } else { 2.3 }) as usize;
            return refuse_excess("calls in calls", most, "WITH gives a name to what stands inside");
        }
        if innermost.0 > MOST_CHAINED {
            return refuse_excess(
                "operators in one expression",
                MOST_CHAINED,
                "IN, or a join with VALUES, takes long lists",
            );
        }
        if innermost.1 > MOST_CHAINED {
            return refuse_excess("joins or unions in one query", MOST_CHAINED, "VALUES takes long lists");
        }
        if statements > MOST_STATEMENTS {
            return refuse_excess("statements", MOST_STATEMENTS, "send them one after the other");
        }
        before = token;
    }
    Ok(())
}

fn refuse_excess(what: &str, most: usize, hint: &str) -> Result<(), Error> {
    Err(hinted_error(format!("the query has more than {most} {what}"), hint))
}

fn is_string(token: &Token) -> bool {
    literal_text(token).is_some()
}

/// Returns the maximum nesting of brackets in a literal.
fn nesting_depth(token: &Token) -> usize {
    let mut now = 0usize;
    let mut most = 0;
    for byte in literal_text(token).unwrap_or_default().bytes() {
        match byte {
            b'(' | b'[' | b'<' => now += 1,
            b')' | b']' | b'>' => now = now.saturating_sub(1),
            _ => {}
        }
        most = most.max(now);
    }
    most
}

fn literal_text(token: &Token) -> Option<&str> {
    match token {
        Token::SingleQuotedString(text)
        | Token::DoubleQuotedString(text)
        | Token::TripleSingleQuotedString(text)
        | Token::TripleDoubleQuotedString(text)
        | Token::SingleQuotedByteStringLiteral(text)
        | Token::DoubleQuotedByteStringLiteral(text)
        | Token::SingleQuotedRawStringLiteral(text)
        | Token::DoubleQuotedRawStringLiteral(text)
        | Token::NationalStringLiteral(text)
        | Token::EscapedStringLiteral(text)
        | Token::UnicodeStringLiteral(text)
        | Token::HexStringLiteral(text) => Some(text),
        Token::DollarQuotedString(text) => Some(&text.value),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use datafusion::sql::sqlparser::dialect::GenericDialect;
    use datafusion::sql::sqlparser::parser::Parser;

    use super::*;

    fn passes(sql: &str) -> bool {
        let [generic, postgres] =
            [&GenericDialect {} as &dyn Dialect, &PostgreSqlDialect {}].map(|d| check_statement_bounds(sql, d).is_ok());
        assert_eq!(generic, postgres, "{}", &sql[..sql.len().min(80)]);
        generic
    }

    // Whatever passes is parsed in few tries: the limit is one of time, and nested calls are what costs it.
    #[test]
    fn as_many_nested_calls_as_pass_are_parsed_at_once() {
        let postgres = PostgreSqlDialect {};
        for call in ["f", "cast", "position", "current_date", "overlay", "array", "not"] {
            let nested = |n| format!("select {}!{}", format!("{call}(").repeat(n), ")".repeat(n));
            let most = (1..40).take_while(|n| check_statement_bounds(&nested(*n), &postgres).is_ok()).last();
            let most = most.expect("one");
            assert!((6..=14).contains(&most), "{call}: {most}");
            Parser::parse_sql(&postgres, &nested(most)).expect_err("no SQL");
        }
    }

    mod slow {
        use super::*;

        #[test]
        fn long_lists_and_what_people_write_pass() {
            let list = |one: &str| vec![one; 100_000].join(", ");
            for sql in [
                format!("select 1 where 1 in ({})", list("-1")),
                format!("select * from (values {})", list("(1 + 1, 'a(((')")),
                format!("select {}", list("a + b")),
                format!("select case{} else c end", " when a = 1 then -2".repeat(5_000)),
                format!("select {}1{}", "coalesce(".repeat(13), ")".repeat(13)),
                format!("select {}1{}", "cast(".repeat(6), " as int)".repeat(6)),
                format!("select 1 {}", "union all select 1 + 1 ".repeat(1_000)),
                "select '(((' || x[1]['a'] from t where not (a is null or b between 1 and 2)".to_owned(),
                format!("{}select 1{}", "with a as (".repeat(14), ") select * from a".repeat(14)),
                format!("with {} select 1", vec!["a as (with b as (select 1) select * from b)"; 100].join(", ")),
                "select 1)))) + 1".to_owned(),
                "select 1 + 1;".repeat(1_000),
                "not sql at all '".to_owned(),
            ] {
                assert!(passes(&sql), "{}", &sql[..sql.len().min(60)]);
            }
        }

        // The statements of which an unbounded server has died: a stack that was exhausted, or hours of parsing.
        #[test]
        fn statements_that_exhaust_a_stack_or_hours_are_refused() {
            let chain = |first: &str, again: &str, times| format!("select {first}{}", again.repeat(times));
            for sql in [
                chain("1", "+1", 8_000),
                format!("select cast(NULL as int{})", "[]".repeat(8_000)),
                chain("'a'", "||'b'", 8_000),
                chain("1", "::int", 8_000),
                chain("1", " + case when a then b end", 8_000),
                chain("", "case when a then ", 8_000),
                chain("case when a then b", " + b", 8_000),
                chain("1", " is null", 8_000),
                chain("true", " and true", 8_000),
                format!("select arrow_cast(NULL, '{}Int8{}')", "List(".repeat(8_000), ")".repeat(8_000)),
                format!("select cast(NULL as {}int", "array<".repeat(8_000)),
                format!("select cast(NULL as {}int", "struct<".repeat(8_000)),
                chain("1", " union all select 1", 4_000),
                chain("1 where 1=1", " or 1=1", 16_000),
                chain("", "not ", 8_000),
                chain("x", ".x", 8_000),
                chain("* from runs", " natural join runs", 4_000),
                format!("select {}!{}", "position(".repeat(22), " in 'x')".repeat(22)),
                format!("select {}!{}", "cast(".repeat(22), " as int)".repeat(22)),
                format!("select {}1{}", "(".repeat(101), ")".repeat(101)),
                format!("select {}!{}", "array[".repeat(22), "]".repeat(22)),
                format!("{}select 1{}", "with a as (".repeat(24), ") select * from a".repeat(24)),
                "select 1 as n;".repeat(50_000),
            ] {
                assert!(!passes(&sql), "{}", &sql[..60]);
            }
        }
    }
}
