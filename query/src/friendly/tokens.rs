//! Rewrites in a statement's tokens, which keep their places: `* LIKE 'x%'`, and `FROM t WHERE ...` without SELECT.

use datafusion::sql::sqlparser::keywords::Keyword;
use datafusion::sql::sqlparser::tokenizer::{Span, Token, TokenWithSpan};

/// Rewrites what the parser has no hook for.
pub(crate) fn rewritten(tokens: Vec<TokenWithSpan>) -> Vec<TokenWithSpan> {
    let is_affected = |token: &TokenWithSpan| is_pattern_word(&token.token) || keyword(&token.token) == Keyword::FROM;
    if !tokens.iter().any(is_affected) {
        return tokens;
    }
    let tokens: Vec<_> = tokens.into_iter().filter(|token| !matches!(token.token, Token::Whitespace(_))).collect();
    with_selects(with_column_patterns(tokens))
}

// `* LIKE 'x%'`, `* ILIKE ...` and `* SIMILAR TO ...` become calls of `COLUMNS`.
fn with_column_patterns(tokens: Vec<TokenWithSpan>) -> Vec<TokenWithSpan> {
    let mut out = Vec::with_capacity(tokens.len());
    let mut at = 0;
    while let Some(token) = tokens.get(at) {
        match pattern_len(&tokens, at) {
            Some(len) => {
                push_call(&mut out, token.span, &tokens[at + 1..at + len]);
                at += len;
            }
            None => {
                out.push(token.clone());
                at += 1;
            }
        }
    }
    out
}

/// Part of a query in which a token stands, for each open bracket.
#[derive(Clone, Copy, PartialEq, Eq)]
enum QueryPart {
    /// Nothing yet, or a set operator.
    Begin,
    /// WITH, before the query itself.
    With,
    /// FROM before any SELECT.
    FromFirst,
    /// Anything else.
    Body,
}

// `FROM t WHERE x` becomes `FROM t SELECT * WHERE x`.
fn with_selects(tokens: Vec<TokenWithSpan>) -> Vec<TokenWithSpan> {
    let mut out = Vec::with_capacity(tokens.len() + 2);
    let mut open = vec![QueryPart::Begin];
    for token in tokens {
        match &token.token {
            Token::LParen | Token::LBracket | Token::LBrace => {
                if let Some(part) = open.last_mut().filter(|part| **part == QueryPart::Begin) {
                    *part = QueryPart::Body;
                }
                open.push(QueryPart::Begin);
            }
            Token::RParen | Token::RBracket | Token::RBrace => {
                if open.len() > 1 {
                    open.pop();
                }
            }
            other => {
                if let Some(part) = open.last_mut() {
                    let next = next_part(*part, other);
                    if *part == QueryPart::FromFirst && is_after_select(other) {
                        let added = [Token::make_word("SELECT", None), Token::Mul];
                        out.extend(added.map(|added| TokenWithSpan { token: added, span: token.span }));
                    }
                    *part = next;
                }
            }
        }
        out.push(token);
    }
    out
}

fn next_part(part: QueryPart, token: &Token) -> QueryPart {
    let word = keyword(token);
    if *token == Token::SemiColon || matches!(word, Keyword::UNION | Keyword::INTERSECT | Keyword::EXCEPT) {
        return QueryPart::Begin;
    }
    match (part, word) {
        (QueryPart::Begin | QueryPart::With, Keyword::FROM) => QueryPart::FromFirst,
        (QueryPart::Begin, Keyword::WITH) => QueryPart::With,
        (QueryPart::Begin, word) if keeps_begin(word) => QueryPart::Begin,
        (QueryPart::With, word) if !matches!(word, Keyword::SELECT | Keyword::VALUES) => QueryPart::With,
        (QueryPart::FromFirst, word) if word != Keyword::SELECT && !is_after_select(token) => QueryPart::FromFirst,
        _ => QueryPart::Body,
    }
}

// Words before a query or within a set operator: `EXPLAIN ANALYZE`, `UNION ALL BY NAME`.
fn keeps_begin(word: Keyword) -> bool {
    use Keyword::{ALL, ANALYZE, BY, DESC, DESCRIBE, DISTINCT, EXPLAIN, NAME, VERBOSE};
    matches!(word, ALL | ANALYZE | BY | DESC | DESCRIBE | DISTINCT | EXPLAIN | NAME | VERBOSE)
}

fn is_after_select(token: &Token) -> bool {
    matches!(keyword(token), Keyword::WHERE | Keyword::GROUP | Keyword::HAVING | Keyword::QUALIFY)
}

fn keyword(token: &Token) -> Keyword {
    match token {
        Token::Word(word) => word.keyword,
        _ => Keyword::NoKeyword,
    }
}

fn is_pattern_word(token: &Token) -> bool {
    matches!(token, Token::Word(w) if matches!(w.keyword, Keyword::LIKE | Keyword::ILIKE | Keyword::SIMILAR))
}

// The number of tokens of `* NOT LIKE 'x'`; None for what is no pattern.
fn pattern_len(tokens: &[TokenWithSpan], at: usize) -> Option<usize> {
    let token = |n: usize| tokens.get(at + n).map(|token| &token.token);
    let is_word = |n: usize, keyword| matches!(token(n), Some(Token::Word(w)) if w.keyword == keyword);
    let begins = match at.checked_sub(1).and_then(|before| tokens.get(before)).map(|token| &token.token) {
        Some(Token::Comma) => true,
        Some(Token::Word(word)) => matches!(word.keyword, Keyword::SELECT | Keyword::DISTINCT | Keyword::ALL),
        _ => false,
    };
    let not = usize::from(is_word(1, Keyword::NOT));
    let pattern = not + 2 + usize::from(is_word(not + 1, Keyword::SIMILAR) && is_word(not + 2, Keyword::TO));
    let is_pattern = begins
        && token(0) == Some(&Token::Mul)
        && token(not + 1).is_some_and(is_pattern_word)
        && matches!(token(pattern), Some(Token::SingleQuotedString(_)));
    is_pattern.then_some(pattern + 1)
}

// `COLUMNS(name -> name LIKE 'x')`
fn push_call(out: &mut Vec<TokenWithSpan>, span: Span, condition: &[TokenWithSpan]) {
    let name = || Token::make_word("column_name", None);
    let head = [Token::make_word("columns", None), Token::LParen, name(), Token::Arrow, name()];
    out.extend(head.map(|token| TokenWithSpan { token, span }));
    out.extend_from_slice(condition);
    out.push(TokenWithSpan { token: Token::RParen, span });
}
