//! `SUMMARIZE table` and `SUMMARIZE SELECT ...`: one row a column with its range, mean, quantiles and nulls.
//!
//! `SUMMARIZE tnce` is read as `SELECT * FROM summarize((SELECT * FROM tnce))`, so that the rest keeps its place in the
//! text, and the rewrite puts the summary there.

use std::fmt::Write as _;

use arrow::datatypes::{DataType, Schema};
use datafusion::sql::sqlparser::ast::{Expr, FunctionArg, FunctionArgExpr, Query, TableAlias, TableFactor};
use datafusion::sql::sqlparser::keywords::Keyword;
use datafusion::sql::sqlparser::tokenizer::{Span, Token, TokenWithSpan, Word};

use super::tree;
use crate::Error;

/// The statement, and the function as which it is read.
const SUMMARIZE: &str = "summarize";
/// The common table that a summary reads.
const SUMMARIZED: &str = "summarized";
/// First words of what is a query and no table's name.
const QUERY_WORDS: [Keyword; 4] = [Keyword::SELECT, Keyword::WITH, Keyword::FROM, Keyword::VALUES];

/// Replaces `SUMMARIZE` at the start of a statement by a call in FROM.
pub(super) fn read_summarize(tokens: Vec<TokenWithSpan>) -> Vec<TokenWithSpan> {
    let is_blank = |token: &TokenWithSpan| matches!(token.token, Token::Whitespace(_) | Token::SemiColon | Token::EOF);
    let mut words = tokens.iter().enumerate().filter(|(_, token)| !is_blank(token));
    let (Some((at, first)), Some((from, second))) = (words.next(), words.next()) else { return tokens };
    let to = words.next_back().map_or(from, |(last, _)| last) + 1;
    if !matches!(&first.token, Token::Word(word) if is_summarize(word)) {
        return tokens;
    }
    let is_query = matches!(&second.token, Token::Word(word) if QUERY_WORDS.contains(&word.keyword));
    let before = &format!("SELECT * FROM {SUMMARIZE} ( ( SELECT * FROM {}", if is_query { "( " } else { "" });
    let after = if is_query { ") ) )" } else { ") )" };
    let mut out = written_tokens(before, tokens[at].span);
    out.extend_from_slice(&tokens[from..to]);
    out.extend(written_tokens(after, tokens[to - 1].span));
    out.extend_from_slice(&tokens[to..]);
    out
}

/// Returns the query that a table in FROM summarises, and its alias; None for all other tables.
pub(super) fn summarized_query(factor: &TableFactor) -> Option<(Box<Query>, Option<TableAlias>)> {
    let TableFactor::Table { name, args: Some(arguments), alias, .. } = factor else { return None };
    match arguments.args.as_slice() {
        [FunctionArg::Unnamed(FunctionArgExpr::Expr(Expr::Subquery(query)))]
            if tree::plain_name(name).is_some_and(|name| name == SUMMARIZE) =>
        {
            Some((query.clone(), alias.clone()))
        }
        _ => None,
    }
}

/// Writes the query that summarises a query of these columns in one scan.
///
/// # Errors
/// [`Error::Query`] if the summary cannot be parsed.
pub(super) fn write_summary(query: Box<Query>, schema: &Schema) -> Result<Box<Query>, Error> {
    let mut summary = tree::parse_query(&summary_text(schema))?;
    if let Some(source) = summary.with.as_mut().and_then(|with| with.cte_tables.first_mut()) {
        source.query = query;
    }
    Ok(summary)
}

fn summary_text(schema: &Schema) -> String {
    let mut columns: [Vec<String>; 11] = Default::default();
    for field in schema.fields() {
        let name = format!("\"{}\"", field.name().replace('"', "\"\""));
        let text = |text: &str| format!("'{}'", text.replace('\'', "''"));
        let is_nested = field.data_type().is_nested();
        let is_numeric = field.data_type().is_numeric();
        let when = |is_known: bool, expression: String| if is_known { expression } else { "null".to_owned() };
        let number = |call: String| when(is_numeric, format!("cast({call} as double)"));
        let quantile = |q: f64| number(format!("approx_percentile_cont({q}) within group (order by {name})"));
        let values = [
            text(field.name()),
            text(&type_name(field.data_type())),
            when(!is_nested, format!("cast(min({name}) as varchar)")),
            when(!is_nested, format!("cast(max({name}) as varchar)")),
            when(!is_nested, format!("approx_distinct(cast({name} as varchar))")),
            number(format!("avg({name})")),
            number(format!("stddev({name})")),
            quantile(0.25),
            quantile(0.5),
            quantile(0.75),
            format!("count(*) - count({name})"),
        ];
        columns.iter_mut().zip(values).for_each(|(column, value)| column.push(value));
    }
    const NAMES: [(&str, &str); 11] = [
        ("column_name", "varchar[]"),
        ("column_type", "varchar[]"),
        ("min", "varchar[]"),
        ("max", "varchar[]"),
        ("approx_unique", "bigint[]"),
        ("avg", "double[]"),
        ("std", "double[]"),
        ("q25", "double[]"),
        ("q50", "double[]"),
        ("q75", "double[]"),
        ("nulls", "bigint[]"),
    ];
    let mut outer = String::new();
    let mut inner = String::new();
    for ((name, list), values) in NAMES.into_iter().zip(columns) {
        let _ = write!(outer, "unnest(\"{name}\") as \"{name}\", ");
        let _ = write!(inner, "cast([{}] as {list}) as \"{name}\", ", values.join(", "));
    }
    format!(
        "with {SUMMARIZED} as (select 1) \
         select {outer}count from (select {inner}count(*) as count from {SUMMARIZED}) as summary"
    )
}

fn type_name(data_type: &DataType) -> String {
    data_type.to_string().to_lowercase()
}

fn is_summarize(word: &Word) -> bool {
    word.quote_style.is_none() && word.value.eq_ignore_ascii_case(SUMMARIZE)
}

fn written_tokens(text: &str, span: Span) -> Vec<TokenWithSpan> {
    text.split_whitespace().map(|word| TokenWithSpan { token: token_of(word), span }).collect()
}

fn token_of(word: &str) -> Token {
    match word {
        "(" => Token::LParen,
        ")" => Token::RParen,
        "*" => Token::Mul,
        word => Token::make_word(word, None),
    }
}
