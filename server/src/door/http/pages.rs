//! The catalogue's pages and the manual, which are part of the program. They hold no data, so they need no token.

use std::collections::BTreeSet;
use std::fmt;
use std::io::Read as _;
use std::sync::LazyLock;

use axum::body::Bytes;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri, header};
use axum::response::{IntoResponse as _, Redirect, Response};
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use echolake_http::{ConditionOutcome, ProblemResponse, accepts_encoding, refuse_unknown_path};
use echolake_service::RequestFault;
use flate2::read::GzDecoder;
use sha2::{Digest as _, Sha256};

/// Nothing inline, nothing from elsewhere.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; font-src 'self'; \
     media-src 'self' blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
const INDEX: &str = "/index.html";
/// Path of files that have a digest in their name.
const ASSETS: &str = "/assets/";
/// Paths that are no page's.
const OTHERS: [&str; 5] = ["/api", "/assets", "/health", "/mcp", "/metrics"];
/// The manual's path.
const MANUAL_PATH: &str = "/docs";
/// Its first page, relative to that path without and with a slash: a proxy may serve both below a path of its own.
const MANUAL_INDEX: &str = "docs/index.html";
const MANUAL_PAGE: &str = "index.html";

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

/// Words in place of a page of the manual, with `HINT` for what helps.
const MISSING_MANUAL_PAGE: &str = include_str!("missing_manual_page.html");

/// The files of the manual; none if the program was built without it.
static MANUAL: &[PageFile] = include!(concat!(env!("OUT_DIR"), "/manual.rs"));

/// The pages, each with its digest.
static TAGGED_PAGES: LazyLock<Vec<(&PageFile, String)>> = LazyLock::new(|| tag_files(PAGES));
/// The manual's files, each with its digest.
static TAGGED_MANUAL: LazyLock<Vec<(&PageFile, String)>> = LazyLock::new(|| tag_files(MANUAL));
/// The manual's own inline scripts, and nothing from elsewhere: its generator writes three into each page.
static MANUAL_POLICY: LazyLock<String> = LazyLock::new(|| {
    let texts: Vec<String> = MANUAL
        .iter()
        .filter(|file| file.path.ends_with(".html"))
        .map(|file| String::from_utf8_lossy(file.bytes).into_owned())
        .collect();
    let scripts: BTreeSet<&str> = texts.iter().flat_map(|text| inline_scripts(text)).collect();
    let hashes: String = scripts
        .iter()
        .map(|script| format!(" 'sha256-{}'", BASE64_STANDARD.encode(Sha256::digest(script.as_bytes()))))
        .collect();
    format!(
        "default-src 'none'; script-src 'self'{hashes}; style-src 'self'; img-src 'self' data:; connect-src 'self'; \
         worker-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
});

fn tag_files(files: &'static [PageFile]) -> Vec<(&'static PageFile, String)> {
    files.iter().map(|file| (file, hex::encode(&Sha256::digest(file.bytes)[..8]))).collect()
}

// The texts between `<script>` and `</script>`.
fn inline_scripts(page: &str) -> impl Iterator<Item = &str> {
    page.split("<script>").skip(1).filter_map(|rest| rest.split_once("</script>")).map(|(script, _)| script)
}

/// Answers all other paths. The pages decide themselves what an address shows, so every one of them has the same
/// file.
pub(super) async fn serve_page(method: Method, uri: Uri, headers: HeaderMap) -> Response {
    let manual_path = uri.path().strip_prefix(MANUAL_PATH).filter(|rest| rest.is_empty() || rest.starts_with('/'));
    let (found, policy) = match manual_path {
        Some("") if !MANUAL.is_empty() => return Redirect::permanent(MANUAL_INDEX).into_response(),
        Some("/") if !MANUAL.is_empty() => return Redirect::permanent(MANUAL_PAGE).into_response(),
        Some(path) => (find_manual_file(path), MANUAL_POLICY.as_str()),
        None => (find_page(uri.path()), POLICY),
    };
    let Some((page, digest)) = found else {
        return match manual_path {
            Some(_) => missing_manual_page(uri.path(), &headers),
            None => refuse_unknown_path().await.into_response(),
        };
    };
    if method != Method::GET && method != Method::HEAD {
        let mut response = ProblemResponse(RequestFault::Method).into_response();
        response.headers_mut().insert(header::ALLOW, HeaderValue::from_static("GET,HEAD"));
        return response;
    }
    let form = PageForm::choose(page, uri.path(), &headers);
    // A strong tag is for bytes as they are sent: packed ones are others.
    let tag = format!("\"{digest}-{form}\"");
    let caching = if page.path.starts_with(ASSETS) { "public, max-age=31536000, immutable" } else { "no-cache" };
    let common = [
        (header::CONTENT_TYPE, page.media_type),
        (header::CACHE_CONTROL, caching),
        (header::CONTENT_SECURITY_POLICY, policy),
        (header::VARY, "Accept-Encoding"),
        (header::ETAG, tag.as_str()),
    ];
    if let Some(instead) = ConditionOutcome::new(&headers, &tag).early_response(&tag, common.clone()) {
        return instead;
    }
    let encoding = form.encoding().map(|encoding| [(header::CONTENT_ENCODING, encoding)]);
    (common, encoding, page.body_as(form)).into_response()
}

// Words for a person whose browser followed a link, and the usual problem for a program.
fn missing_manual_page(path: &str, headers: &HeaderMap) -> Response {
    let hint = match MANUAL {
        [] => "this program was built without its manual; docs/build.sh makes it for the next build",
        _ => "/docs/index.html lists the manual's pages",
    };
    let accepted = headers.get(header::ACCEPT).and_then(|accepted| accepted.to_str().ok());
    if accepted.is_some_and(|accepted| accepted.contains("text/html")) {
        let common = [
            (header::CONTENT_TYPE, "text/html; charset=utf-8"),
            (header::CACHE_CONTROL, "no-cache"),
            (header::CONTENT_SECURITY_POLICY, POLICY),
            (header::VARY, "Accept"),
        ];
        let page = lead_to_root(&MISSING_MANUAL_PAGE.replace("HINT", hint), folder_depth(path));
        return (StatusCode::NOT_FOUND, common, page).into_response();
    }
    ProblemResponse(RequestFault::NotFound { what: "this page of the manual".to_owned(), hint }).into_response()
}

// The addresses of a document are relative, so that a proxy may serve the pages below a path of its own.
fn lead_to_root(document: &str, depth: usize) -> String {
    let root = if depth == 0 { "./".to_owned() } else { "../".repeat(depth) };
    document.replace("\"./", &format!("\"{root}"))
}

fn folder_depth(path: &str) -> usize {
    path.matches('/').count().saturating_sub(1)
}

fn find_manual_file(path: &str) -> Option<&'static (&'static PageFile, String)> {
    TAGGED_MANUAL.iter().find(|(file, _)| file.path == path)
}

fn find_page(path: &str) -> Option<&'static (&'static PageFile, String)> {
    let of_path = |path: &str| TAGGED_PAGES.iter().find(|(page, _)| page.path == path);
    let is_other =
        OTHERS.iter().any(|other| path.strip_prefix(other).is_some_and(|r| r.is_empty() || r.starts_with('/')));
    // A file that is not there is not there; names of surfaces and runs have no dots.
    let is_file = path.rsplit('/').next().is_some_and(|last| last.contains('.'));
    of_path(path).or_else(|| if is_other || is_file { None } else { of_path(INDEX) })
}

/// The form in which a file is sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum PageForm {
    Brotli,
    Gzip,
    Plain,
    /// The pages' document at an address so many folders below their root.
    Below(usize),
}

impl PageForm {
    fn choose(page: &PageFile, path: &str, headers: &HeaderMap) -> Self {
        let depth = folder_depth(path);
        match page.path == INDEX && depth > 0 {
            true => Self::Below(depth),
            false if page.brotli.is_some() && accepts_encoding(headers, "br") => Self::Brotli,
            false if page.is_gzip && accepts_encoding(headers, "gzip") => Self::Gzip,
            false => Self::Plain,
        }
    }

    fn encoding(self) -> Option<&'static str> {
        match self {
            Self::Brotli => Some("br"),
            Self::Gzip => Some("gzip"),
            Self::Plain | Self::Below(_) => None,
        }
    }
}

impl fmt::Display for PageForm {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Below(depth) => write!(f, "below-{depth}"),
            form => f.write_str(form.encoding().unwrap_or("plain")),
        }
    }
}

impl PageFile {
    fn body_as(&self, form: PageForm) -> Bytes {
        match (form, self.brotli) {
            (PageForm::Brotli, Some(packed)) => Bytes::from_static(packed),
            (PageForm::Gzip, _) => Bytes::from_static(self.bytes),
            (PageForm::Below(depth), _) => lead_to_root(&String::from_utf8_lossy(&self.plain_bytes()), depth).into(),
            _ => self.plain_bytes(),
        }
    }

    fn plain_bytes(&self) -> Bytes {
        if self.is_gzip { self.unpack_gzip().into() } else { Bytes::from_static(self.bytes) }
    }

    fn unpack_gzip(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        // It was packed by the build, and what cannot be read of it is not there.
        let _ = GzDecoder::new(self.bytes).read_to_end(&mut bytes);
        bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // A browser names text/html in what it accepts, and got raw JSON.
    #[tokio::test]
    async fn a_missing_page_of_the_manual_is_words_for_a_browser_and_a_problem_for_a_program() {
        for (accepted, media_type) in [
            ("text/html,application/xhtml+xml,*/*;q=0.8", "text/html; charset=utf-8"),
            ("*/*", "application/problem+json"),
        ] {
            let headers = HeaderMap::from_iter([(header::ACCEPT, HeaderValue::from_static(accepted))]);
            let response = serve_page(Method::GET, Uri::from_static("/docs/none.html"), headers).await;
            assert_eq!(response.status(), StatusCode::NOT_FOUND);
            assert_eq!(response.headers()[header::CONTENT_TYPE], media_type);
            let body = axum::body::to_bytes(response.into_body(), 1 << 16).await.expect("a body");
            let text = String::from_utf8_lossy(&body);
            assert!(text.contains("docs/build.sh") || text.contains("/docs/index.html lists"), "{text}");
            assert_eq!(text.starts_with("<!doctype html>"), media_type.starts_with("text/html"), "{text}");
        }
    }

    // A proxy may serve the pages below a path of its own, which a link to `/` leaves.
    #[tokio::test]
    async fn a_missing_page_of_the_manual_leads_to_the_catalogue_below_a_proxys_path() {
        for (path, root) in [("/docs/none.html", "../"), ("/docs/decisions/none.html", "../../")] {
            let headers = HeaderMap::from_iter([(header::ACCEPT, HeaderValue::from_static("text/html"))]);
            let response = serve_page(Method::GET, Uri::from_static(path), headers).await;
            let body = axum::body::to_bytes(response.into_body(), 1 << 16).await.expect("a body");
            let text = String::from_utf8_lossy(&body);
            assert!(text.contains(&format!("<a href=\"{root}\">The catalogue</a>")), "{path}: {text}");
        }
    }

    #[test]
    fn addresses_are_pages_and_files_are_themselves() {
        let path = |asked: &str| find_page(asked).map(|(page, _)| page.path);
        for address in ["/", "/surfaces/flat/pairs/7", "/sql", "/map", "/apis"] {
            assert_eq!(path(address), Some(INDEX), "{address}");
        }
        for missing in ["/api", "/api/v1/nothing", "/assets/none.js", "/assets", "/favicon.ico", "/a/../b.js"] {
            assert_eq!(path(missing), None, "{missing}");
        }
    }

    #[tokio::test]
    async fn the_manual_is_shown_with_its_own_scripts_alone() {
        let ask = async |path: &'static str| serve_page(Method::GET, Uri::from_static(path), HeaderMap::new()).await;
        if MANUAL.is_empty() {
            assert!(std::env::var_os("ECHOLAKE_NO_SKIP").is_none(), "the manual is not built; hint: docs/build.sh");
            let response = ask("/docs").await;
            assert_eq!(response.status(), StatusCode::NOT_FOUND);
            return;
        }
        assert_eq!(ask("/docs").await.headers()[header::LOCATION], MANUAL_INDEX);
        assert_eq!(ask("/docs/none.html").await.status(), StatusCode::NOT_FOUND);
        let response = ask("/docs/index.html").await;
        assert_eq!(response.status(), StatusCode::OK);
        assert_eq!(response.headers()[header::CONTENT_TYPE], "text/html; charset=utf-8");
        let policy = response.headers()[header::CONTENT_SECURITY_POLICY].to_str().expect("text").to_owned();
        let (page, _) = find_manual_file("/index.html").expect("a page");
        let scripts: Vec<&str> = inline_scripts(std::str::from_utf8(page.bytes).expect("text")).collect();
        assert!(!scripts.is_empty());
        for script in scripts {
            let hash = BASE64_STANDARD.encode(Sha256::digest(script.as_bytes()));
            assert!(policy.contains(&format!("'sha256-{hash}'")), "{policy}");
        }
        assert!(!policy.contains("unsafe"), "{policy}");
        for file in MANUAL {
            assert_eq!(ask_path(file.path).await, StatusCode::OK, "{}", file.path);
        }
    }

    async fn ask_path(path: &str) -> StatusCode {
        let uri = format!("{MANUAL_PATH}{path}").parse().expect("a path");
        serve_page(Method::GET, uri, HeaderMap::new()).await.status()
    }

    /// E20: the document's addresses lead to the root of the pages from wherever it stands, below a proxy's path, too.
    #[cfg(not(pages_not_built))]
    #[tokio::test]
    async fn the_document_names_nothing_by_a_path_from_the_root() {
        for (path, root) in
            [("/", "./"), ("/sql", "./"), ("/surfaces/flat", "../"), ("/surfaces/flat/pairs/7", "../../../")]
        {
            let response = serve_page(Method::GET, Uri::from_static(path), HeaderMap::new()).await;
            let page = axum::body::to_bytes(response.into_body(), usize::MAX).await.expect("a page");
            let page = String::from_utf8_lossy(&page).into_owned();
            let named: Vec<_> =
                page.split(['"', '\'']).filter(|part| part.contains('/') && !part.contains(' ')).collect();
            let addresses: Vec<_> =
                named.iter().filter(|part| part.ends_with(".js") || part.contains("api/")).collect();
            assert!(addresses.len() >= 3, "{page}");
            assert!(addresses.iter().all(|address| address.starts_with(root)), "{path}: {addresses:?}");
            assert!(!page.contains("=\"/"), "{page}");
        }
    }

    /// E23: packed bytes have a tag of their own.
    #[cfg(not(pages_not_built))]
    #[tokio::test]
    async fn each_encoding_has_its_own_tag() {
        let script =
            PAGES.iter().find(|p| p.path.starts_with("/assets/") && p.path.ends_with(".js")).expect("a script");
        let mut tags = BTreeSet::new();
        for accepted in ["identity", "gzip", "br"] {
            let headers = HeaderMap::from_iter([(header::ACCEPT_ENCODING, HeaderValue::from_static(accepted))]);
            let response = serve_page(Method::GET, Uri::from_static(script.path), headers).await;
            tags.insert(response.headers()[header::ETAG].to_str().expect("a tag").to_owned());
        }
        assert_eq!(tags.len(), 3, "{tags:?}");
    }

    #[cfg(not(pages_not_built))]
    #[test]
    fn scripts_are_there_and_packed() {
        let path = |asked: &str| find_page(asked).map(|(page, _)| page.path);
        assert_eq!(path("/theme.js"), Some("/theme.js"));
        let script = PAGES.iter().find(|p| p.path.starts_with("/assets/index-") && p.path.ends_with(".js"));
        let script = script.expect("a script");
        let packed = HeaderMap::from_iter([(header::ACCEPT_ENCODING, HeaderValue::from_static("gzip"))]);
        assert_eq!(PageForm::choose(script, script.path, &packed), PageForm::Gzip);
        assert_eq!(PageForm::choose(script, script.path, &HeaderMap::new()), PageForm::Plain);
        let gzip = script.body_as(PageForm::Gzip);
        let plain = script.body_as(PageForm::Plain);
        // gzip ends with the length of what it packed.
        let length = gzip.last_chunk().map(|length| u32::from_le_bytes(*length));
        assert_eq!(length, u32::try_from(plain.len()).ok());
        assert!(gzip.len() < plain.len());
    }
}
