//! Shrinks a statement: drops clauses, items and subtrees for as long as what is wrong with it stays.
//!
//! It works on tokens, so that it shrinks statements of any source. A candidate lacks a span of balanced tokens, or has
//! `1`, NULL or the inner tokens instead of a call or of a group. Most candidates are no SQL, which costs a parse. What
//! makes an answer depend on chance if a part of it is missing is one token: `ORDER BY` with its `LIMIT`, and the
//! `OVER (...)` of a window.

/// Most candidates that are tried.
const MOST_TRIALS: usize = 6_000;

/// Returns the smallest statement that was found for which `is_wrong` still returns true.
pub(crate) fn shrink_statement(sql: &str, is_wrong: &mut dyn FnMut(&str) -> bool) -> String {
    let mut tokens = split_tokens(sql);
    let mut trials = 0;
    let mut attempt = |candidate: &[String]| {
        trials += 1;
        (trials < MOST_TRIALS && is_wrong(&join_tokens(candidate))).then(|| candidate.to_vec())
    };
    loop {
        let before = tokens.len();
        tokens = drop_spans(tokens, &mut attempt);
        tokens = replace_groups(tokens, &mut attempt);
        if tokens.len() == before {
            return join_tokens(&tokens);
        }
    }
}

type CandidateTrial<'a> = &'a mut dyn FnMut(&[String]) -> Option<Vec<String>>;

// The longest spans first.
fn drop_spans(mut tokens: Vec<String>, attempt: CandidateTrial<'_>) -> Vec<String> {
    let mut length = tokens.len().saturating_sub(1);
    while length > 0 {
        let mut start = 0;
        while start + length <= tokens.len() {
            if is_balanced(&tokens[start..start + length]) {
                let candidate = [&tokens[..start], &tokens[start + length..]].concat();
                if let Some(smaller) = attempt(&candidate) {
                    tokens = smaller;
                    continue;
                }
            }
            start += 1;
        }
        length = (length - 1).min(tokens.len());
    }
    tokens
}

// `f(x)` and `(x)` become x, 1 or NULL.
fn replace_groups(mut tokens: Vec<String>, attempt: CandidateTrial<'_>) -> Vec<String> {
    let mut start = 0;
    while start < tokens.len() {
        let Some(end) = group_end(&tokens, start) else {
            start += 1;
            continue;
        };
        let is_call = start > 0 && tokens[start - 1].chars().all(|c| c.is_alphanumeric() || c == '_');
        let begins = if is_call { vec![start - 1, start] } else { vec![start] };
        let inner = tokens[start + 1..end].to_vec();
        let one = vec!["1".to_owned()];
        let null = vec!["null".to_owned()];
        let replacements = [&inner, &one, &null];
        let candidates = begins
            .iter()
            .flat_map(|begin| replacements.map(|middle| [&tokens[..*begin], middle, &tokens[end + 1..]].concat()));
        let candidates: Vec<_> = candidates.filter(|candidate| candidate.len() < tokens.len()).collect();
        match candidates.iter().find_map(|candidate| attempt(candidate)) {
            Some(smaller) => tokens = smaller,
            None => start += 1,
        }
    }
    tokens
}

fn depth_change(token: &str) -> i32 {
    match token {
        "(" | "[" => 1,
        ")" | "]" => -1,
        word if word.eq_ignore_ascii_case("case") => 1,
        word if word.eq_ignore_ascii_case("end") => -1,
        _ => 0,
    }
}

fn is_balanced(tokens: &[String]) -> bool {
    let mut depth = 0;
    tokens.iter().all(|token| {
        depth += depth_change(token);
        depth >= 0
    }) && depth == 0
}

// Where the group ends that begins at this token, if one does.
fn group_end(tokens: &[String], start: usize) -> Option<usize> {
    if depth_change(&tokens[start]) != 1 {
        return None;
    }
    (start + 1..tokens.len()).find(|end| is_balanced(&tokens[start..=*end]))
}

fn join_tokens(tokens: &[String]) -> String {
    let mut text = String::new();
    let mut last = "";
    for token in tokens {
        let is_tight = matches!(token.as_str(), ")" | "," | "." | "::" | "[" | "]")
            || matches!(last, "" | "(" | "." | "::" | "[")
            || token == "(" && is_function_name(last);
        if !is_tight {
            text.push(' ');
        }
        text.push_str(token);
        last = token;
    }
    text
}

/// Words before a parenthesis that are no functions.
const PLAIN_WORDS: [&str; 22] = [
    "in", "from", "and", "or", "not", "where", "on", "using", "values", "as", "exists", "any", "all", "some", "when",
    "then", "else", "select", "by", "over", "sets", "join",
];

fn is_function_name(word: &str) -> bool {
    word.chars().all(|c| c.is_alphanumeric() || c == '_') && !PLAIN_WORDS.contains(&word.to_lowercase().as_str())
}

fn split_tokens(sql: &str) -> Vec<String> {
    let mut plain = Vec::new();
    let mut rest = sql.trim_start();
    while let Some(first) = rest.chars().next() {
        let end = match first {
            '\'' | '"' => quoted_end(rest, first),
            c if c.is_ascii_digit() => rest.find(|c: char| !is_number_part(c)).unwrap_or(rest.len()),
            c if is_word_part(c) => rest.find(|c| !is_word_part(c)).unwrap_or(rest.len()),
            _ => ["::", "<=", ">=", "<>", "||", "->"]
                .iter()
                .find(|operator| rest.starts_with(**operator))
                .map_or(first.len_utf8(), |operator| operator.len()),
        };
        plain.push(rest[..end].to_owned());
        rest = rest[end..].trim_start();
    }
    merge_tokens(plain)
}

fn is_word_part(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

fn is_number_part(c: char) -> bool {
    c.is_ascii_alphanumeric() || c == '.'
}

fn quoted_end(text: &str, quote: char) -> usize {
    let inside = text.char_indices().skip(1);
    let mut is_open = true;
    for (place, c) in inside {
        if c == quote {
            is_open = !is_open;
        } else if !is_open {
            return place;
        }
    }
    text.len()
}

// Makes one token of each part that must stay whole.
fn merge_tokens(plain: Vec<String>) -> Vec<String> {
    let mut merged = Vec::new();
    let mut place = 0;
    while place < plain.len() {
        let is = |offset: usize, word: &str| plain.get(place + offset).is_some_and(|t| t.eq_ignore_ascii_case(word));
        let end = if is(0, "over") && is(1, "(") {
            group_end(&plain, place + 1).map(|end| end + 1)
        } else if is(0, "order") && is(1, "by") {
            limited_end(&plain, place)
        } else if is_function_name(&plain[place]) && is(1, "(") && !is(2, "select") {
            // An aggregate of rows in an order.
            group_end(&plain, place + 1).filter(|end| has_inner_order(&plain[place + 2..*end])).map(|end| end + 1)
        } else {
            None
        };
        let end = end.unwrap_or(place + 1);
        merged.push(join_tokens(&plain[place..end]));
        place = end;
    }
    merged
}

// Where `ORDER BY ... LIMIT n OFFSET m` ends, if it has a LIMIT on the same level.
fn limited_end(tokens: &[String], start: usize) -> Option<usize> {
    let mut depth = 0;
    for (place, token) in tokens.iter().enumerate().skip(start) {
        depth += depth_change(token);
        if depth < 0 {
            return None;
        }
        if depth == 0 && token.eq_ignore_ascii_case("limit") {
            let has_offset = tokens.get(place + 2).is_some_and(|token| token.eq_ignore_ascii_case("offset"));
            return Some((place + if has_offset { 4 } else { 2 }).min(tokens.len()));
        }
    }
    None
}

fn has_inner_order(tokens: &[String]) -> bool {
    let mut depth = 0;
    tokens.iter().any(|token| {
        depth += depth_change(token);
        depth == 0 && token.eq_ignore_ascii_case("order")
    })
}
