//! Conditional requests: whether a request's headers want 304 or 412 instead of the answer.
//!
//! The order is that of RFC 9110, section 13.2.2: If-Match, then If-None-Match; `ranges.rs` judges If-Range after them.
//! Nothing here has a date of modification, so If-Unmodified-Since and If-Modified-Since are ignored (sections 13.1.3
//! and 13.1.4). Conditions count only for what exists: an answer that would be 404 without them stays 404.

use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse as _, IntoResponseParts, Response};
use echolake_service::RequestFault;

use super::problem::ProblemResponse;

/// The outcome of a request's conditions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ConditionOutcome {
    /// They hold, or there are none.
    Answer,
    /// The client has this version: 304.
    NotModified,
    /// The client wants another version: 412.
    Failed,
}

impl ConditionOutcome {
    /// Evaluates a request's conditions for a resource that exists and has this strong tag.
    pub fn new(headers: &HeaderMap, etag: &str) -> Self {
        // Only If-None-Match compares weakly.
        if headers.contains_key(header::IF_MATCH)
            && !any_tag(headers, header::IF_MATCH, |tag| tag == "*" || tag == etag)
        {
            return Self::Failed;
        }
        let is_known = |tag: &str| tag == "*" || tag.strip_prefix("W/").unwrap_or(tag) == etag;
        if any_tag(headers, header::IF_NONE_MATCH, is_known) { Self::NotModified } else { Self::Answer }
    }

    /// Returns the response instead of the answer; `headers` are those that 304 and the answer have in common.
    pub fn early_response(self, etag: &str, headers: impl IntoResponseParts) -> Option<Response> {
        match self {
            Self::Answer => None,
            Self::NotModified => Some((StatusCode::NOT_MODIFIED, headers, ()).into_response()),
            Self::Failed => {
                let mut response =
                    ProblemResponse(RequestFault::Precondition { etag: etag.to_owned() }).into_response();
                if let Ok(etag) = HeaderValue::from_str(etag) {
                    response.headers_mut().insert(header::ETAG, etag);
                }
                Some(response)
            }
        }
    }
}

/// Returns whether If-None-Match names this tag itself, not only by `*`.
pub(super) fn is_named(headers: &HeaderMap, etag: &str) -> bool {
    any_tag(headers, header::IF_NONE_MATCH, |tag| tag.strip_prefix("W/").unwrap_or(tag) == etag)
}

// No tag of ours has a comma in it.
fn any_tag(headers: &HeaderMap, name: HeaderName, matches: impl Fn(&str) -> bool) -> bool {
    let lines = headers.get_all(name).into_iter().filter_map(|line| line.to_str().ok());
    lines.flat_map(|line| line.split(',')).any(|tag| matches(tag.trim()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn conditions_have_the_order_of_the_standard() {
        use ConditionOutcome::{Answer, Failed, NotModified};
        for (conditions, expected) in [
            (&[][..], Answer),
            (&[("if-match", "\"a\"")], Answer),
            (&[("if-match", "\"b\", \"a\"")], Answer),
            (&[("if-match", "\"b\""), ("if-match", "\"a\"")], Answer),
            (&[("if-match", "*")], Answer),
            (&[("if-match", "\"b\"")], Failed),
            (&[("if-match", "W/\"a\"")], Failed),
            (&[("if-match", "nope")], Failed),
            (&[("if-match", "")], Failed),
            (&[("if-match", "\"b\""), ("if-none-match", "\"a\"")], Failed),
            (&[("if-match", "\"a\""), ("if-none-match", "\"a\"")], NotModified),
            (&[("if-match", "\"b\""), ("if-unmodified-since", "Sat, 29 Oct 1994 19:43:31 GMT")], Failed),
            (&[("if-unmodified-since", "Sat, 29 Oct 1994 19:43:31 GMT")], Answer),
            (&[("if-modified-since", "Fri, 31 Dec 2100 23:59:59 GMT")], Answer),
            (&[("if-none-match", "\"a\"")], NotModified),
            (&[("if-none-match", "W/\"a\"")], NotModified),
            (&[("if-none-match", "*")], NotModified),
            (&[("if-none-match", "\"b\", \"c\"")], Answer),
            (&[("if-none-match", "\"b\""), ("if-modified-since", "Fri, 31 Dec 2100 23:59:59 GMT")], Answer),
        ] {
            let mut headers = HeaderMap::new();
            for (name, value) in conditions {
                headers.append(HeaderName::from_static(name), HeaderValue::from_static(value));
            }
            assert_eq!(ConditionOutcome::new(&headers, "\"a\""), expected, "{conditions:?}");
        }
    }
}
