//! Locations as messages show them.

use std::fmt::Display;

/// Names an object of a lake in messages.
pub(crate) fn object_text(location: &str, path: impl Display) -> String {
    format!("{}/{path}", location.strip_suffix('/').unwrap_or(location))
}

/// Replaces the parts of a URL that may hold credentials: what precedes its host, and its query. A password may hold
/// characters that end a host, and the text may be no valid URL.
pub(crate) fn without_secrets(text: &str) -> String {
    let Some((scheme, rest)) = text.split_once("://") else { return text.to_owned() };
    let host = rest.split(['/', '?', '#']).next().unwrap_or_default();
    let named = match rest.rsplit_once('@') {
        Some((_, named)) if host.contains(['@', ':']) => format!("***@{named}"),
        _ => rest.to_owned(),
    };
    match named.split_once(['?', '#']) {
        Some((path, _)) => format!("{scheme}://{path}?***"),
        None => format!("{scheme}://{named}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_secret_stays() {
        assert_eq!(without_secrets("s3://bucket/team@lab"), "s3://bucket/team@lab");
        assert_eq!(without_secrets("http://host:9000"), "http://host:9000");
    }

    #[test]
    fn names_of_objects_have_one_slash() {
        for (text, expected) in [
            ("s3://bucket", "s3://bucket/lake.toml"),
            ("s3://bucket/", "s3://bucket/lake.toml"),
            ("s3://bucket/a/", "s3://bucket/a/lake.toml"),
            ("lake/", "lake/lake.toml"),
            ("memory://", "memory://lake.toml"),
        ] {
            assert_eq!(object_text(text, "lake.toml"), expected);
        }
    }
}
