//! Splits the text of a script into statements.

use datafusion::sql::sqlparser::tokenizer::{Location, Token, TokenWithSpan, Tokenizer};

use super::dialect::LakeDialect;

/// Returns the text before the first semicolon that ends a statement, and the text after it; None if there is none.
/// A semicolon in a text, a name or a comment ends nothing.
///
/// ```
/// assert_eq!(echolake_query::split_statement("select ';'; select 2"), Some(("select ';'", " select 2")));
/// assert_eq!(echolake_query::split_statement("select 1 -- ;"), None);
/// ```
pub fn split_statement(script: &str) -> Option<(&str, &str)> {
    let tokens = read_tokens(script);
    let semicolon = tokens.iter().find(|token| token.token == Token::SemiColon)?;
    let at = byte_position(script, semicolon.span.start)?;
    Some((&script[..at], &script[at + 1..]))
}

/// Returns whether a text is without a statement: blanks and comments alone.
///
/// ```
/// assert!(echolake_query::is_blank_statement(" -- the surfaces\n"));
/// assert!(!echolake_query::is_blank_statement("select 1"));
/// ```
pub fn is_blank_statement(text: &str) -> bool {
    let mut tokens = Vec::new();
    let whole = Tokenizer::new(&LakeDialect, text).tokenize_with_location_into_buf(&mut tokens);
    whole.is_ok() && tokens.iter().all(|token| matches!(token.token, Token::Whitespace(_)))
}

// Of a text that ends within quotes, the tokens before them.
fn read_tokens(text: &str) -> Vec<TokenWithSpan> {
    let mut tokens = Vec::new();
    let _ = Tokenizer::new(&LakeDialect, text).tokenize_with_location_into_buf(&mut tokens);
    tokens
}

fn byte_position(text: &str, place: Location) -> Option<usize> {
    let lines = usize::try_from(place.line.checked_sub(1)?).ok()?;
    let characters = usize::try_from(place.column.checked_sub(1)?).ok()?;
    let line: usize = text.split_inclusive('\n').take(lines).map(str::len).sum();
    let (within, _) = text[line..].char_indices().nth(characters)?;
    Some(line + within)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_statement_ends_at_its_own_semicolon() {
        assert_eq!(
            split_statement("select 'é;',\n \"a;\" /* ; */;\nb"),
            Some(("select 'é;',\n \"a;\" /* ; */", "\nb"))
        );
        assert_eq!(split_statement("a; select 'open"), Some(("a", " select 'open")));
        assert_eq!(split_statement("select 'open; b"), None);
        assert!(!is_blank_statement("/* open"));
    }
}
