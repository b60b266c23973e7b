//! Files over HTTP: parsing of ranges, and the headers that viewers of other origins need.

use std::ops::Range;

use axum::body::Body;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use echolake_service::RequestFault;
use tower_http::cors::{Any, CorsLayer};

use super::conditions::ConditionOutcome;
use super::problem::ProblemResponse;

/// The header that says which origins may embed an answer.
pub(super) const POLICY: HeaderName = HeaderName::from_static("cross-origin-resource-policy");
const API_VERSION: HeaderName = HeaderName::from_static("api-version");
const FETCH_MODE: HeaderName = HeaderName::from_static("sec-fetch-mode");

/// The CORS headers of routes that other origins may read: from anywhere, without credentials, with what ranges need.
pub fn cors_layer() -> CorsLayer {
    CorsLayer::new()
        .allow_origin(Any)
        .allow_methods([Method::GET, Method::HEAD])
        // Lichtblick sends the last two with every request.
        .allow_headers([
            header::RANGE,
            header::IF_RANGE,
            header::IF_MATCH,
            header::IF_NONE_MATCH,
            header::AUTHORIZATION,
            header::CONTENT_TYPE,
            API_VERSION,
        ])
        .expose_headers([header::ACCEPT_RANGES, header::CONTENT_LENGTH, header::CONTENT_RANGE, header::ETAG])
        .allow_private_network(true)
}

/// Returns whether the answer must state the file's length: for ranges, or because viewers in a browser read it before
/// they request ranges.
pub(super) fn needs_length(method: &Method, headers: &HeaderMap) -> bool {
    let is_script = headers.get(FETCH_MODE).is_some_and(|mode| mode == "cors") || headers.contains_key(header::ORIGIN);
    method == Method::HEAD || headers.contains_key(header::RANGE) || is_script
}

/// A file that never changes, as its answers describe it.
pub(super) struct FileDescription {
    pub etag: String,
    pub media_type: &'static str,
    /// The origins that may embed it, as `Cross-Origin-Resource-Policy` has them.
    pub policy: &'static str,
}

/// The kind of answer to a request.
pub(super) enum RangeAnswer {
    /// This, without any of the file's bytes.
    Answer(Response),
    /// These bytes.
    Part(FilePart),
}

/// Bytes of a file.
pub(super) struct FilePart {
    pub range: Range<u64>,
    /// The file's length, if these are not all of its bytes.
    of: Option<u64>,
}

impl FileDescription {
    /// Determines the answer to a request, for a file of `bytes` bytes.
    pub fn range_answer(&self, headers: &HeaderMap, bytes: u64) -> RangeAnswer {
        if let Some(instead) = self.condition_answer(headers) {
            return RangeAnswer::Answer(instead);
        }
        match self.wanted_range(headers, bytes) {
            WantedRange::Whole => RangeAnswer::Part(FilePart { range: 0..bytes, of: None }),
            WantedRange::Part(range) => RangeAnswer::Part(FilePart { range, of: Some(bytes) }),
            WantedRange::Nothing => RangeAnswer::Answer(self.unsatisfiable_response(bytes)),
        }
    }

    /// Returns the answer to a client that has this version already, 304, or that wants another one, 412.
    pub fn condition_answer(&self, headers: &HeaderMap) -> Option<Response> {
        let outcome = ConditionOutcome::new(headers, &self.etag);
        let mut response = outcome.early_response(&self.etag, ())?;
        if outcome == ConditionOutcome::NotModified {
            return Some(self.with_headers(response));
        }
        insert_header(response.headers_mut(), POLICY, self.policy);
        Some(response)
    }

    /// Bytes as they were asked for.
    pub fn part_response(&self, part: &FilePart, body: Body) -> Response {
        let status = if part.of.is_some() { StatusCode::PARTIAL_CONTENT } else { StatusCode::OK };
        let mut response = self.with_headers((status, body).into_response());
        let out = response.headers_mut();
        let range = &part.range;
        out.insert(header::CONTENT_LENGTH, (range.end - range.start).into());
        if let Some(bytes) = part.of {
            insert_header(out, header::CONTENT_RANGE, &format!("bytes {}-{}/{bytes}", range.start, range.end - 1));
        }
        response
    }

    /// All bytes, as they come.
    pub fn stream_response(&self, body: Body) -> Response {
        self.with_headers(body.into_response())
    }

    fn unsatisfiable_response(&self, bytes: u64) -> Response {
        let mut response = ProblemResponse(RequestFault::Range { bytes }).into_response();
        insert_header(response.headers_mut(), header::CONTENT_RANGE, &format!("bytes */{bytes}"));
        insert_header(response.headers_mut(), POLICY, self.policy);
        response
    }

    fn with_headers(&self, mut response: Response) -> Response {
        let out = response.headers_mut();
        for (name, value) in [
            (header::CONTENT_TYPE, self.media_type),
            (header::ACCEPT_RANGES, "bytes"),
            (header::ETAG, &self.etag),
            // Ranges are of the file as it is.
            (header::CACHE_CONTROL, "private, no-cache, no-transform"),
            (POLICY, self.policy),
        ] {
            insert_header(out, name, value);
        }
        response
    }

    fn wanted_range(&self, headers: &HeaderMap, bytes: u64) -> WantedRange {
        let text = |name: HeaderName| headers.get(name).and_then(|v| v.to_str().ok());
        // A range of what the file no longer is would be none of it.
        if text(header::IF_RANGE).is_some_and(|known| known != self.etag) {
            return WantedRange::Whole;
        }
        text(header::RANGE).map_or(WantedRange::Whole, |range| WantedRange::from_header(range, bytes))
    }
}

fn insert_header(headers: &mut HeaderMap, name: HeaderName, value: &str) {
    if let Ok(value) = HeaderValue::from_str(value) {
        headers.insert(name, value);
    }
}

/// The requested part of a file.
#[derive(Debug, PartialEq, Eq)]
enum WantedRange {
    Whole,
    Part(Range<u64>),
    /// A range outside of the file.
    Nothing,
}

impl WantedRange {
    // RFC 9110, section 14: a header that makes no sense, and several ranges at once, are answered by the whole file.
    fn from_header(range: &str, bytes: u64) -> Self {
        let Some((first, last)) = range.strip_prefix("bytes=").and_then(|r| r.trim().split_once('-')) else {
            return Self::Whole;
        };
        let number = |text: &str| text.bytes().all(|b| b.is_ascii_digit()).then(|| text.parse::<u64>().ok()).flatten();
        let range = match (first.is_empty(), number(first), last.is_empty(), number(last)) {
            (true, _, false, Some(length)) => bytes.saturating_sub(length)..bytes,
            (false, Some(first), true, _) => first..bytes,
            (false, Some(first), false, Some(last)) if first <= last => first..last.saturating_add(1).min(bytes),
            _ => return Self::Whole,
        };
        if range.start >= range.end { Self::Nothing } else { Self::Part(range) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_as_the_standard_has_them() {
        for (range, expected) in [
            ("bytes=0-99", WantedRange::Part(0..100)),
            ("bytes=990-", WantedRange::Part(990..1000)),
            ("bytes=-10", WantedRange::Part(990..1000)),
            ("bytes=-5000", WantedRange::Part(0..1000)),
            ("bytes=500-5000", WantedRange::Part(500..1000)),
            ("bytes=1000-", WantedRange::Nothing),
            ("bytes=-0", WantedRange::Nothing),
            ("bytes=5-4", WantedRange::Whole),
            ("bytes=0-1,5-6", WantedRange::Whole),
            ("bytes=a-b", WantedRange::Whole),
            ("bytes=-", WantedRange::Whole),
            ("bytes=+1-2", WantedRange::Whole),
            ("lines=1-2", WantedRange::Whole),
            ("bytes=0-18446744073709551615", WantedRange::Part(0..1000)),
            ("bytes=99999999999999999999-", WantedRange::Whole),
        ] {
            assert_eq!(WantedRange::from_header(range, 1000), expected, "{range}");
        }
    }
}
