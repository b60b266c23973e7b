//! Access control of HTTP: without tokens it is for this machine's own programs and pages. A browser lets every page of
//! the web send requests to loopback, and a name that its owner points there (DNS rebinding) lets it read the answers
//! too; so without tokens `Host` and `Origin` must be this machine's.

use std::net::IpAddr;
use std::sync::Arc;

use axum::extract::{FromRequestParts, Request, State};
use axum::http::request::Parts;
use axum::http::uri::Authority;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Uri, header};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};
use echolake_query::EngineClient;
use echolake_service::{QueryService, RequestFault, TokenScope};

use super::problem::ProblemResponse;
use super::ranges::POLICY;

/// Scheme of a client's connection: set by this server if it encrypts, else by a proxy that does.
pub const FORWARDED_PROTO: HeaderName = HeaderName::from_static("x-forwarded-proto");
/// Schemes of an own page: of a host and port only one answers.
const ORIGIN_SCHEMES: [&str; 2] = ["http://", "https://"];
const FETCH_SITE: HeaderName = HeaderName::from_static("sec-fetch-site");

/// A client that is authorised for SQL.
pub(super) struct MayQuery(pub Arc<EngineClient>);

/// The origin of a request, according to its headers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RequestSite {
    /// A page of another origin.
    Foreign,
    /// A page of this server.
    OwnPage,
    /// A program of this machine.
    Program,
}

/// Determines the origin of a request to a server without tokens.
pub fn request_site(uri: &Uri, headers: &HeaderMap) -> RequestSite {
    match (is_own(uri, headers), headers.contains_key(FETCH_SITE)) {
        (Err(_), _) => RequestSite::Foreign,
        (Ok(()), true) => RequestSite::OwnPage,
        (Ok(()), false) => RequestSite::Program,
    }
}

/// Returns whether a client's connection is encrypted, by this server or by a proxy.
pub fn is_encrypted(headers: &HeaderMap) -> bool {
    headers.get(FORWARDED_PROTO).is_some_and(|scheme| scheme == "https")
}

impl FromRequestParts<QueryService> for MayQuery {
    type Rejection = ProblemResponse;

    async fn from_request_parts(_: &mut Parts, service: &QueryService) -> Result<Self, ProblemResponse> {
        Ok(Self(service.authorised_client(TokenScope::Sql)?))
    }
}

/// Refuses requests of pages from other origins, if there are no tokens.
pub async fn own_pages_only(State(is_open): State<bool>, request: Request, next: Next) -> Response {
    // With tokens there is nothing that a page could use without having one.
    match is_own(request.uri(), request.headers()) {
        Err(fault) if is_open => ProblemResponse(fault).into_response(),
        _ => next.run(request).await,
    }
}

/// Checks that a request comes from this machine's own programs and pages.
///
/// # Errors
/// [`RequestFault::Foreign`] if it does not.
pub(super) fn is_own(uri: &Uri, headers: &HeaderMap) -> Result<(), RequestFault> {
    // HTTP/1.1 wants one Host; with two, the check and the routing may use different ones.
    let host = match (headers.get_all(header::HOST).iter().count(), header_text(headers, &header::HOST)) {
        (1, Some(host)) => host,
        (_, host) => return Err(RequestFault::Foreign { what: "host", found: host.unwrap_or_default() }),
    };
    if !is_local(&host) {
        return Err(RequestFault::Foreign { what: "host", found: host });
    }
    // An address in absolute form takes precedence over Host in routing, so it must be the same.
    if let Some(authority) = uri.authority().filter(|authority| authority.as_str() != host) {
        return Err(RequestFault::Foreign { what: "address", found: authority.to_string() });
    }
    is_same_origin(headers)
}

/// Checks by the headers of browsers that a request is not made by a page of another origin.
///
/// # Errors
/// [`RequestFault::Foreign`] if it is.
pub fn is_same_origin(headers: &HeaderMap) -> Result<(), RequestFault> {
    let host = header_text(headers, &header::HOST).unwrap_or_default();
    let is_own_origin = |origin: &str| ORIGIN_SCHEMES.iter().any(|scheme| origin.strip_prefix(scheme) == Some(&host));
    check_single_header(headers, &header::ORIGIN, "origin", is_own_origin)?;
    check_single_header(headers, &FETCH_SITE, "site", |site| site == "same-origin" || site == "none")
}

// A browser sends each of these once; of two, another program could read the other one.
fn check_single_header(
    headers: &HeaderMap,
    name: &HeaderName,
    what: &'static str,
    is_right: impl Fn(&str) -> bool,
) -> Result<(), RequestFault> {
    let values: Vec<_> = headers.get_all(name).iter().map(|v| String::from_utf8_lossy(v.as_bytes())).collect();
    match values.as_slice() {
        [] => Ok(()),
        [one] if is_right(one) => Ok(()),
        _ => Err(RequestFault::Foreign { what, found: values.join(", ") }),
    }
}

fn header_text(headers: &HeaderMap, name: &HeaderName) -> Option<String> {
    headers.get(name).map(|v| String::from_utf8_lossy(v.as_bytes()).into_owned())
}

// A name or address that cannot be another machine's.
fn is_local(host: &str) -> bool {
    let Ok(authority) = host.parse::<Authority>() else { return false };
    let name = authority.host();
    let behind = host.strip_prefix(name).map(|port| port.strip_prefix(':').unwrap_or(port));
    // There is nothing before the name (a user), nor behind it but a port.
    if behind != Some(authority.port().as_ref().map_or("", |port| port.as_str())) {
        return false;
    }
    let address = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(name);
    // With a dot at its end a name is complete, which browsers send as it was typed.
    let full_name = name.strip_suffix('.').unwrap_or(name);
    full_name.eq_ignore_ascii_case("localhost") || address.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback())
}

/// Adds the security headers that every answer has, unless its route set its own.
pub(super) async fn security_headers(mut response: Response) -> Response {
    let headers = response.headers_mut();
    for (name, value) in [
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::X_FRAME_OPTIONS, "DENY"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CONTENT_SECURITY_POLICY, "default-src 'none'; frame-ancestors 'none'"),
        (POLICY, "same-origin"),
        (header::CACHE_CONTROL, "no-store"),
    ] {
        headers.entry(name).or_insert(HeaderValue::from_static(value));
    }
    response
}

#[cfg(test)]
mod tests {
    use axum::body::Body;

    use super::*;

    #[test]
    fn only_this_machine_is_local() {
        for (host, local) in [
            ("localhost", true),
            ("LOCALHOST:8080", true),
            ("127.0.0.1:8080", true),
            ("127.9.9.9", true),
            ("[::1]:8080", true),
            ("[::1]", true),
            // E23: the same name.
            ("localhost.", true),
            ("localhost.:8080", true),
            ("localhost..", false),
            (".localhost", false),
            ("localhost.evil.example.", false),
            ("evil.example", false),
            ("localhost.evil.example", false),
            ("127.0.0.1.evil.example:8080", false),
            ("192.168.1.2", false),
            ("[fe80::1]:80", false),
            ("0.0.0.0", false),
            ("", false),
            ("localhost@evil.example", false),
            ("localhost:1@evil.example", false),
            ("evil.example@localhost", false),
            ("[::1]evil.example", false),
            ("[::1]:80evil.example", false),
            ("localhost:80:80", false),
            ("localhost:http", false),
            ("localhost/", false),
            ("[127.0.0.1", false),
        ] {
            assert_eq!(is_local(host), local, "{host}");
        }
    }

    #[test]
    fn pages_of_elsewhere_are_refused() {
        let check = |headers: &[(&str, &str)]| {
            let request = headers.iter().fold(Request::builder(), |r, (name, value)| r.header(*name, *value));
            let request = request.body(Body::empty()).expect("a request");
            is_own(request.uri(), request.headers()).is_ok()
        };
        let own = ("host", "localhost:8080");
        assert!(check(&[own]));
        assert!(check(&[own, ("origin", "http://localhost:8080"), ("sec-fetch-site", "same-origin")]));
        for foreign in [
            &[("host", "evil.example")][..],
            &[],
            &[own, ("host", "evil.example")],
            &[own, ("origin", "http://evil.example")],
            &[own, ("origin", "http://localhost:9090")],
            &[own, ("origin", "null")],
            &[own, ("sec-fetch-site", "cross-site")],
            // E23: neither counts if there are two.
            &[own, ("origin", "http://localhost:8080"), ("origin", "http://evil.example")],
            &[own, ("origin", "http://localhost:8080"), ("origin", "http://localhost:8080")],
            &[own, ("sec-fetch-site", "same-origin"), ("sec-fetch-site", "cross-site")],
            &[own, ("sec-fetch-site", "same-site")],
        ] {
            assert!(!check(foreign), "{foreign:?}");
        }
    }

    #[test]
    fn an_address_in_absolute_form_is_that_of_the_host() {
        let check = |address: &str| {
            let request = Request::builder().uri(address).header("host", "localhost:8080").body(Body::empty());
            let request = request.expect("a request");
            is_own(request.uri(), request.headers()).is_ok()
        };
        assert!(check("/health") && check("http://localhost:8080/health"));
        assert!(!check("http://evil.example/health") && !check("http://localhost:8081/health"));
    }
}
