//! Lists that clients send as texts. Postgres allows spaces around their elements, which the library takes for parts of
//! them.

use std::borrow::Cow;

/// The text of a list, as `{"a", b}`, without spaces around its elements; other texts stay as they are.
pub(super) fn without_spaces(text: &str) -> Cow<'_, str> {
    let trimmed = text.trim();
    if !trimmed.starts_with('{') || !trimmed.contains(char::is_whitespace) {
        return Cow::Borrowed(text);
    }
    let mut dense = String::with_capacity(trimmed.len());
    let mut spaces = String::new();
    let mut is_quoted = false;
    let mut is_escaped = false;
    for character in trimmed.chars() {
        if character.is_whitespace() && !is_quoted && !is_escaped {
            spaces.push(character);
            continue;
        }
        // Spaces within an element are its own.
        let is_between = matches!(character, ',' | '}') || dense.ends_with([',', '{']);
        if !is_between {
            dense.push_str(&spaces);
        }
        spaces.clear();
        dense.push(character);
        is_quoted ^= character == '"' && !is_escaped;
        is_escaped = character == '\\' && !is_escaped;
    }
    Cow::Owned(dense)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spaces_around_elements_go() {
        for (text, expected) in [
            (r#"{"p", "r"}"#, r#"{"p","r"}"#),
            (" { 1 , 2 } ", "{1,2}"),
            (r#"{a b, "c , d" ,"\" e"}"#, r#"{a b,"c , d","\" e"}"#),
            ("{}", "{}"),
            ("a, b", "a, b"),
        ] {
            assert_eq!(without_spaces(text), expected, "{text}");
        }
    }
}
