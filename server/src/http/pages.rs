//! The catalogue's pages, which are part of the program. They hold no data, so they need no token.

use std::sync::LazyLock;

use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri, header};
use axum::response::{IntoResponse as _, Response};
use sha2::{Digest as _, Sha256};

use super::catalogue::is_known;
use super::format::takes;
use super::problem::ProblemResponse;
use crate::fault::RequestFault;

/// Nothing inline, nothing from elsewhere.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; font-src 'self'; \
     media-src 'self' blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
const INDEX: &str = "/index.html";
/// Path of files that have a digest in their name.
const ASSETS: &str = "/assets/";
/// Paths that are no page's.
const OTHERS: [&str; 6] = ["/api", "/assets", "/delta-sharing", "/health", "/mcp", "/metrics"];

/// A file of the pages; `build.rs` lists them.
struct PageFile {
    path: &'static str,
    media_type: &'static str,
    bytes: &'static [u8],
    gzip: Option<&'static [u8]>,
    brotli: Option<&'static [u8]>,
}

#[cfg(not(pages_not_built))]
static PAGES: &[PageFile] = include!(concat!(env!("OUT_DIR"), "/pages.rs"));
/// The only page of a program that was built without Node.
#[cfg(pages_not_built)]
static PAGES: &[PageFile] = &[PageFile {
    path: INDEX,
    media_type: "text/html; charset=utf-8",
    bytes: include_bytes!("pages_not_built.html"),
    gzip: None,
    brotli: None,
}];

/// A page, each with its digest.
static TAGGED: LazyLock<Vec<(&PageFile, String)>> = LazyLock::new(|| {
    let tag = |page: &PageFile| format!("\"{}\"", hex::encode(&Sha256::digest(page.bytes)[..8]));
    PAGES.iter().map(|page| (page, tag(page))).collect()
});

/// Answers all other paths. The pages decide themselves what an address shows, so every one of them has the same
/// file.
pub(super) async fn fallback(method: Method, uri: Uri, headers: HeaderMap) -> Response {
    let Some((page, tag)) = page(uri.path()) else { return super::nothing().await.into_response() };
    if method != Method::GET && method != Method::HEAD {
        let mut response = ProblemResponse(RequestFault::Method).into_response();
        response.headers_mut().insert(header::ALLOW, HeaderValue::from_static("GET,HEAD"));
        return response;
    }
    let known = is_known(&headers, tag);
    let (body, encoding) = page.body(&headers);
    let mut response = if known {
        StatusCode::NOT_MODIFIED.into_response()
    } else {
        axum::body::Bytes::from_static(body).into_response()
    };
    let caching = if page.path.starts_with(ASSETS) { "public, max-age=31536000, immutable" } else { "no-cache" };
    let out = response.headers_mut();
    for (name, value) in [
        (header::CONTENT_TYPE, page.media_type),
        (header::CACHE_CONTROL, caching),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::VARY, "Accept-Encoding"),
        (header::ETAG, tag),
    ] {
        if let Ok(value) = HeaderValue::from_str(value) {
            out.insert(name, value);
        }
    }
    if let (Some(encoding), false) = (encoding, known) {
        out.insert(header::CONTENT_ENCODING, HeaderValue::from_static(encoding));
    }
    response
}

fn page(path: &str) -> Option<&'static (&'static PageFile, String)> {
    let of = |path: &str| TAGGED.iter().find(|(page, _)| page.path == path);
    let is_other =
        OTHERS.iter().any(|other| path.strip_prefix(other).is_some_and(|r| r.is_empty() || r.starts_with('/')));
    // A file that is not there is not there; names of surfaces and runs have no dots.
    let is_file = path.rsplit('/').next().is_some_and(|last| last.contains('.'));
    of(path).or_else(|| if is_other || is_file { None } else { of(INDEX) })
}

impl PageFile {
    fn body(&self, headers: &HeaderMap) -> (&'static [u8], Option<&'static str>) {
        match (self.brotli.filter(|_| takes(headers, "br")), self.gzip.filter(|_| takes(headers, "gzip"))) {
            (Some(packed), _) => (packed, Some("br")),
            (None, Some(packed)) => (packed, Some("gzip")),
            (None, None) => (self.bytes, None),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_pages_and_files_are_themselves() {
        let path = |asked: &str| page(asked).map(|(page, _)| page.path);
        for address in ["/", "/surfaces/flat/pairs/7", "/sql", "/map", "/apis"] {
            assert_eq!(path(address), Some(INDEX), "{address}");
        }
        for missing in ["/api", "/api/v1/nothing", "/assets/none.js", "/assets", "/favicon.ico", "/a/../b.js"] {
            assert_eq!(path(missing), None, "{missing}");
        }
    }

    #[cfg(not(pages_not_built))]
    #[test]
    fn scripts_are_there_and_packed() {
        let path = |asked: &str| page(asked).map(|(page, _)| page.path);
        assert_eq!(path("/theme.js"), Some("/theme.js"));
        let script = PAGES.iter().find(|p| p.path.starts_with("/assets/index-") && p.path.ends_with(".js"));
        let script = script.expect("a script");
        assert!(script.gzip.is_some_and(|packed| packed.len() < script.bytes.len()));
    }
}
