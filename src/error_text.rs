//! The text of an error for a user.

/// Returns the error's text and its causes', each behind a colon, up to the one that says the innermost cause: many
/// errors name it amid their text, before a hint, and keep it as their source.
pub(crate) fn describe_error(error: &anyhow::Error) -> String {
    let innermost = error.root_cause().to_string();
    let mut text = String::new();
    for cause in error.chain() {
        let cause = cause.to_string();
        let is_last = cause.contains(&innermost);
        text.push_str(&cause);
        if is_last {
            break;
        }
        text.push_str(": ");
    }
    echolake_schema::escape_controls(&text)
}
