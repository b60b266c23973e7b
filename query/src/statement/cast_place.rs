//! Finds the cast that failed, from the message of Arrow, which has the value and the type but no place.

use datafusion::sql::sqlparser::tokenizer::{Location, Token, Tokenizer};

use super::dialect::LakeDialect;

/// Arrow's names of types, and the names under which a statement casts to them.
const TYPES: [(&str, &[&str]); 10] = [
    ("Int8", &["TINYINT"]),
    ("Int16", &["SMALLINT", "INT2"]),
    ("Int32", &["INT", "INTEGER", "INT4"]),
    ("Int64", &["BIGINT", "INT8"]),
    ("UInt32", &["UINTEGER"]),
    ("UInt64", &["UBIGINT"]),
    ("Float32", &["REAL", "FLOAT", "FLOAT4"]),
    ("Float64", &["DOUBLE", "FLOAT8"]),
    ("Boolean", &["BOOL", "BOOLEAN"]),
    ("Date32", &["DATE"]),
];

/// Returns the place of the cast of a message such as `Cannot cast string 'x' to value of Int32 type`: the text `'x'`
/// itself, or the only cast of the statement to such a type. None if several fit.
pub(crate) fn find_cast(sql: &str, message: &str) -> Option<Location> {
    let (_, cast) = message.split_once("Cannot cast string '")?;
    let (value, kind) = cast.rsplit_once("' to value of ")?;
    let kind = kind.split(' ').next()?;
    let tokens = Tokenizer::new(&LakeDialect, sql).tokenize_with_location().ok()?;
    let mut texts = Vec::new();
    let mut casts = Vec::new();
    // The open brackets; those of a CAST have its place.
    let mut brackets: Vec<Option<Location>> = Vec::new();
    let mut before: Option<(&Token, Location)> = None;
    let mut pending = None;
    for token in tokens.iter().filter(|token| !matches!(token.token, Token::Whitespace(_))) {
        let place = token.span.start;
        if let Some(cast) = pending.take()
            && TYPES.iter().any(|(arrow, names)| *arrow == kind && names.iter().any(|name| is_word(&token.token, name)))
        {
            casts.push(cast);
        }
        match &token.token {
            Token::SingleQuotedString(text) if text == value => texts.push(place),
            Token::LParen => brackets.push(before.filter(|(token, _)| is_word(token, "CAST")).map(|(_, place)| place)),
            Token::RParen => drop(brackets.pop()),
            Token::DoubleColon => pending = Some(place),
            word if is_word(word, "AS") => pending = brackets.last().copied().flatten(),
            _ => {}
        }
        before = Some((&token.token, place));
    }
    match (texts.as_slice(), casts.as_slice()) {
        ([place], _) | ([], [place]) => Some(*place),
        _ => None,
    }
}

fn is_word(token: &Token, name: &str) -> bool {
    matches!(token, Token::Word(word) if word.quote_style.is_none() && word.value.eq_ignore_ascii_case(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cast_is_found_if_only_one_fits() {
        let column = |sql: &str, kind: &str| {
            let message = format!("Cannot cast string 'flat' to value of {kind} type");
            find_cast(sql, &message).map(|place| place.column)
        };
        assert_eq!(column("select cast(a as int), b::double", "Int32"), Some(8));
        assert_eq!(column("select cast(a as int), b::double", "Float64"), Some(25));
        assert_eq!(column("select a where a > 5", "Int64"), None);
        assert_eq!(column("select a::int, b::integer", "Int32"), None);
        assert_eq!(column("select 'flat'::int", "Int32"), Some(8));
        assert_eq!(column("select cast((select count(*) as n) as int)", "Int32"), Some(8));
        assert_eq!(column("select try_cast(a as int)", "Int32"), None);
    }
}
