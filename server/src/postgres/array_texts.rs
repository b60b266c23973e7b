//! Arrays that clients write as texts: `{a,"b, c",NULL}`.

/// Returns the elements of an array of one dimension, None for NULL; None if the text is no such array.
pub(super) fn array_elements(text: &str) -> Option<Vec<Option<String>>> {
    let inner = text.trim().strip_prefix('{')?.strip_suffix('}')?;
    let mut elements = Vec::new();
    let mut characters = inner.chars().peekable();
    let skip_spaces = |characters: &mut std::iter::Peekable<std::str::Chars<'_>>| {
        while characters.next_if(|c| c.is_whitespace()).is_some() {}
    };
    skip_spaces(&mut characters);
    if characters.peek().is_none() {
        return Some(elements);
    }
    loop {
        skip_spaces(&mut characters);
        let mut element = String::new();
        let is_quoted = characters.next_if_eq(&'"').is_some();
        // A space that is escaped is not one at the end.
        let mut kept = 0;
        loop {
            match characters.peek() {
                Some('"') if is_quoted => break,
                None | Some(',') if !is_quoted => break,
                Some('{' | '}' | '"') if !is_quoted => return None,
                None => return None,
                Some('\\') => {
                    characters.next();
                    element.push(characters.next()?);
                    kept = element.len();
                }
                Some(_) => element.extend(characters.next()),
            }
        }
        if is_quoted {
            characters.next();
            skip_spaces(&mut characters);
        } else {
            let trimmed = element.trim_end().len();
            element.truncate(trimmed.max(kept));
            if element.is_empty() {
                return None;
            }
        }
        let is_null = !is_quoted && kept == 0 && element.eq_ignore_ascii_case("null");
        elements.push((!is_null).then_some(element));
        match characters.next() {
            None => return Some(elements),
            Some(',') => {}
            Some(_) => return None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elements_are_read_as_in_postgres() {
        let read = |text: &str| array_elements(text).map(|all| format!("{all:?}").replace("Some", ""));
        for (text, expected) in [
            ("{}", "[]"),
            (" { 1 , 2 } ", r#"[("1"), ("2")]"#),
            (r#"{"a,b", c d ,"\" \\ e"}"#, r#"[("a,b"), ("c d"), ("\" \\ e")]"#),
            (r#"{NULL,"NULL","",null,\null}"#, r#"[None, ("NULL"), (""), None, ("null")]"#),
            ("{a\\ }", r#"[("a ")]"#),
        ] {
            assert_eq!(read(text).as_deref(), Some(expected), "{text}");
        }
        for text in ["", "a,b", "{a,}", "{,a}", "{{1},{2}}", "{\"a}", "{\"a\"b}", "{a\"b}", "{a\\}", "[0:1]={1,2}"] {
            assert_eq!(read(text), None, "{text}");
        }
    }
}
