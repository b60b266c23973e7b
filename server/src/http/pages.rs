//! The catalogue's pages, which are part of the program. They hold no data, so they need no token.

use std::io::Read as _;
use std::sync::LazyLock;

use axum::body::Bytes;
use axum::http::{HeaderMap, HeaderValue, Method, Uri, header};
use axum::response::{IntoResponse as _, Response};
use flate2::read::GzDecoder;
use sha2::{Digest as _, Sha256};

use super::conditions::ConditionOutcome;
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
    /// As it is, or packed by gzip: few clients want it unpacked, and it is a megabyte less of the program.
    bytes: &'static [u8],
    is_gzip: bool,
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
    is_gzip: false,
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
    let caching = if page.path.starts_with(ASSETS) { "public, max-age=31536000, immutable" } else { "no-cache" };
    let common = [
        (header::CONTENT_TYPE, page.media_type),
        (header::CACHE_CONTROL, caching),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::VARY, "Accept-Encoding"),
        (header::ETAG, tag),
    ];
    if let Some(instead) = ConditionOutcome::new(&headers, tag).response(tag, common.clone()) {
        return instead;
    }
    let (body, encoding) = page.body(&headers);
    let encoding = encoding.map(|encoding| [(header::CONTENT_ENCODING, encoding)]);
    (common, encoding, body).into_response()
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
    fn body(&self, headers: &HeaderMap) -> (Bytes, Option<&'static str>) {
        match self.brotli.filter(|_| takes(headers, "br")) {
            Some(packed) => (Bytes::from_static(packed), Some("br")),
            None if self.is_gzip && takes(headers, "gzip") => (Bytes::from_static(self.bytes), Some("gzip")),
            None if self.is_gzip => (self.unpack().into(), None),
            None => (Bytes::from_static(self.bytes), None),
        }
    }

    fn unpack(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        // It was packed by the build, and what cannot be read of it is not there.
        let _ = GzDecoder::new(self.bytes).read_to_end(&mut bytes);
        bytes
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
        let packed = HeaderMap::from_iter([(header::ACCEPT_ENCODING, HeaderValue::from_static("gzip"))]);
        let (gzip, named) = script.body(&packed);
        assert_eq!(named, Some("gzip"));
        let (plain, named) = script.body(&HeaderMap::new());
        assert_eq!(named, None);
        // gzip ends with the length of what it packed.
        let length = gzip.last_chunk().map(|length| u32::from_le_bytes(*length));
        assert_eq!(length, u32::try_from(plain.len()).ok());
        assert!(gzip.len() < plain.len());
    }
}
