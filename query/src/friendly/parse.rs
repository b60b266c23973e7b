//! Hooks of the dialect: syntax that the parser does not know.

use datafusion::sql::sqlparser::ast::{
    Array, Expr, GroupByExpr, Ident, LimitClause, PivotValueSource, Select, SelectItem, Statement, TableFactor,
    UnaryOperator, WildcardAdditionalOptions,
};
use datafusion::sql::sqlparser::dialect::{Dialect as _, Precedence};
use datafusion::sql::sqlparser::keywords::Keyword;
use datafusion::sql::sqlparser::parser::{Parser, ParserError};
use datafusion::sql::sqlparser::tokenizer::{Location, Token};

use super::budget::RewriteBudget;
use super::{pivot, tree};
use crate::Error;
use crate::dialect::LakeDialect;

type Parsed<T> = Result<T, ParserError>;

/// Reads a list, `[1, 2]`, or a list comprehension, `[x * 2 FOR x IN list IF x > 1]`.
pub(crate) fn parse_prefix(parser: &mut Parser<'_>) -> Option<Parsed<Expr>> {
    (parser.peek_token_ref().token == Token::LBracket).then(|| {
        let list = parse_list(parser)?;
        parser.parse_compound_expr(list, Vec::new())
    })
}

/// Reads what follows an expression: `x: 42`, `x IN list`; refuses `^`, which means other things in other databases.
pub(crate) fn parse_infix(parser: &mut Parser<'_>, expr: &Expr) -> Option<Parsed<Expr>> {
    let token = parser.peek_token_ref();
    match &token.token {
        Token::Colon => Some(parse_named(parser, expr)),
        Token::Caret => Some(refused("`^` means power or XOR", token.span.start, "power(a, b) or bit_xor over rows")),
        Token::Word(word) if matches!(word.keyword, Keyword::IN | Keyword::NOT) => parse_in_list(parser, expr),
        _ => None,
    }
}

/// Reads `PIVOT table ON ...` and `UNPIVOT table ON ...`.
pub(crate) fn parse_statement(parser: &mut Parser<'_>) -> Option<Parsed<Statement>> {
    if parser.parse_keyword(Keyword::PIVOT) {
        Some(parse_pivot(parser))
    } else if parser.parse_keyword(Keyword::UNPIVOT) {
        Some(parse_unpivot(parser))
    } else {
        None
    }
}

// The parser's errors have the place at their end.
fn refused<T>(message: &str, at: Location, hint: &str) -> Parsed<T> {
    Err(ParserError::ParserError(format!("{message}; hint: {hint} at Line: {}, Column: {}", at.line, at.column)))
}

fn refused_as<T>(error: &Error, at: Location) -> Parsed<T> {
    match error {
        Error::Query { message, hint, .. } => refused(message, at, hint.as_deref().unwrap_or_default()),
        other => refused(&other.to_string(), at, ""),
    }
}

fn parse_list(parser: &mut Parser<'_>) -> Parsed<Expr> {
    parser.expect_token(&Token::LBracket)?;
    let mut elem = Vec::new();
    while !parser.consume_token(&Token::RBracket) {
        let expr = parser.parse_expr()?;
        if elem.is_empty() && parser.parse_keyword(Keyword::FOR) {
            return parse_comprehension(parser, expr);
        }
        elem.push(expr);
        if !parser.consume_token(&Token::Comma) {
            parser.expect_token(&Token::RBracket)?;
            break;
        }
    }
    Ok(Expr::Array(Array { elem, named: false }))
}

fn parse_comprehension(parser: &mut Parser<'_>, expr: Expr) -> Parsed<Expr> {
    let name = parser.parse_identifier()?;
    parser.expect_keyword_is(Keyword::IN)?;
    let mut list = parser.parse_expr()?;
    if parser.parse_keyword(Keyword::IF) {
        list = tree::call("array_filter", [list, tree::lambda(name.clone(), parser.parse_expr()?)]);
    }
    parser.expect_token(&Token::RBracket)?;
    Ok(tree::call("array_transform", [list, tree::lambda(name, expr)]))
}

// `Expr::Named` becomes an alias where it is a select item.
fn parse_named(parser: &mut Parser<'_>, name: &Expr) -> Parsed<Expr> {
    let Expr::Identifier(name) = name else {
        return parser.expected("the end of the expression", parser.peek_token());
    };
    parser.expect_token(&Token::Colon)?;
    Ok(Expr::Named { expr: Box::new(parser.parse_expr()?), name: name.clone() })
}

fn parse_in_list(parser: &mut Parser<'_>, expr: &Expr) -> Option<Parsed<Expr>> {
    let is_word =
        |n: usize, keyword| matches!(&parser.peek_nth_token_ref(n).token, Token::Word(w) if w.keyword == keyword);
    let is_negated = is_word(0, Keyword::NOT);
    let list = usize::from(is_negated) + 1;
    let is_list = match &parser.peek_nth_token_ref(list).token {
        Token::LBracket => true,
        Token::Word(word) => word.keyword != Keyword::UNNEST,
        _ => false,
    };
    if !is_word(list - 1, Keyword::IN) || !is_list {
        return None;
    }
    (0..list).for_each(|_| parser.advance_token());
    Some(parse_operand(parser).map(|list| {
        let has = tree::call("array_has", [list, expr.clone()]);
        if is_negated { Expr::UnaryOp { op: UnaryOperator::Not, expr: Box::new(has) } } else { has }
    }))
}

fn parse_operand(parser: &mut Parser<'_>) -> Parsed<Expr> {
    parser.parse_subexpr(LakeDialect.prec_value(Precedence::Between))
}

fn parse_pivot(parser: &mut Parser<'_>) -> Parsed<Statement> {
    let table = parser.parse_table_factor()?;
    parser.expect_keyword_is(Keyword::ON)?;
    let column = parse_operand(parser)?;
    if !parser.parse_keyword(Keyword::IN) {
        let hint = "PIVOT runs ON origin IN ('measured', 'simulated') USING count(*)";
        return refused("PIVOT needs its values listed", parser.peek_token_ref().span.start, hint);
    }
    parser.expect_token(&Token::LParen)?;
    let values = parser.parse_comma_separated(Parser::parse_expr_with_alias)?;
    parser.expect_token(&Token::RParen)?;
    parser.expect_keyword_is(Keyword::USING)?;
    let aggregates = parser.parse_comma_separated(Parser::parse_expr_with_alias)?;
    let groups = match parser.parse_optional_group_by()? {
        Some(GroupByExpr::Expressions(groups, modifiers)) if modifiers.is_empty() => Some(groups),
        None => None,
        Some(_) => return parser.expected("columns after GROUP BY", parser.peek_token()),
    };
    let select = match groups {
        Some(groups) => {
            let at = parser.peek_token_ref().span.start;
            pivot::pivoted(groups, &aggregates, &column, &values, tree::from(table), &mut RewriteBudget::new())
                .or_else(|error| refused_as(&error, at))?
        }
        None => {
            let relation = TableFactor::Pivot {
                table: Box::new(table),
                aggregate_functions: aggregates,
                value_column: vec![column],
                value_source: PivotValueSource::List(values),
                default_on_null: None,
                alias: None,
            };
            tree::select(vec![all_columns()], tree::from(relation))
        }
    };
    parse_end(parser, select)
}

fn parse_unpivot(parser: &mut Parser<'_>) -> Parsed<Statement> {
    let table = parser.parse_table_factor()?;
    parser.expect_keyword_is(Keyword::ON)?;
    let columns = parser.parse_comma_separated(Parser::parse_expr_with_alias)?;
    let (mut name, mut value) = (Ident::new("name"), Ident::new("value"));
    if parser.parse_keyword(Keyword::INTO) {
        parser.expect_keyword_is(Keyword::NAME)?;
        name = parser.parse_identifier()?;
        parser.expect_keyword_is(Keyword::VALUE)?;
        value = parser.parse_identifier()?;
    }
    let relation = TableFactor::Unpivot {
        table: Box::new(table),
        value: Expr::Identifier(value),
        null_inclusion: None,
        name,
        columns,
        alias: None,
    };
    parse_end(parser, tree::select(vec![all_columns()], tree::from(relation)))
}

fn parse_end(parser: &mut Parser<'_>, select: Select) -> Parsed<Statement> {
    let mut query = tree::query(select);
    query.order_by = parser.parse_optional_order_by()?;
    if parser.parse_keyword(Keyword::LIMIT) {
        let limit = parser.parse_limit()?;
        query.limit_clause = Some(LimitClause::LimitOffset { limit, offset: None, limit_by: Vec::new() });
    }
    Ok(Statement::Query(Box::new(query)))
}

fn all_columns() -> SelectItem {
    SelectItem::Wildcard(WildcardAdditionalOptions::default())
}
