//! Access control of viewers: programs, pages of this machine, and pages that its user names may connect; clients on
//! other machines need the token. A browser lets every page of the web open a WebSocket on loopback, and sends the
//! page's origin.

use std::net::SocketAddr;

use subtle::ConstantTimeEq as _;
use tungstenite::handshake::server::{ErrorResponse, Request};
use tungstenite::http::StatusCode;
use tungstenite::http::header::ORIGIN;

/// Origin of installed viewers: to their browser (Electron) they are files of this machine.
const INSTALLED_VIEWER: &str = "file://";

/// Access beside programs and pages of this machine.
#[derive(Debug, Clone, Default)]
pub struct ViewerAccess {
    /// Origins of other pages, as `https://viewer.example`.
    pub allowed_origins: Vec<String>,
    /// True if other machines need no token.
    pub is_open: bool,
}

/// Rules that handshakes are checked against.
pub(super) struct AccessCheck {
    allowed_origins: Vec<String>,
    /// None if none is needed.
    token: Option<String>,
}

impl AccessCheck {
    /// Draws a token if other machines reach the address.
    pub fn new(access: ViewerAccess, address: SocketAddr) -> Self {
        let needs_token = !address.ip().is_loopback() && !access.is_open;
        let token = needs_token.then(|| format!("{:032x}", rand::random::<u128>()));
        Self { allowed_origins: access.allowed_origins, token }
    }

    /// Returns the URL for viewers, with the token.
    pub fn viewer_url(&self, address: SocketAddr) -> String {
        let token = self.token.as_ref().map(|token| format!("/?token={token}")).unwrap_or_default();
        format!("ws://{address}{token}")
    }

    /// # Errors
    /// The refusal, if the handshake may not go on.
    #[expect(clippy::result_large_err, reason = "tungstenite's own type")]
    pub fn check_request(&self, request: &Request) -> Result<(), ErrorResponse> {
        for origin in request.headers().get_all(ORIGIN) {
            let origin = String::from_utf8_lossy(origin.as_bytes());
            if !self.allows_origin(&origin) {
                let hint = "hint: --allow-origin lets a page of elsewhere look on";
                return Err(refusal_response(
                    StatusCode::FORBIDDEN,
                    format!("pages of `{origin}` may not look on; {hint}\n"),
                ));
            }
        }
        let given = request.uri().query().unwrap_or_default().split('&').find_map(|pair| pair.strip_prefix("token="));
        let given = given.unwrap_or_default();
        match &self.token {
            Some(token) if !bool::from(token.as_bytes().ct_eq(given.as_bytes())) => {
                let sentence = "a token is needed here; hint: open the whole address that echolake printed\n";
                Err(refusal_response(StatusCode::FORBIDDEN, sentence.to_owned()))
            }
            _ => Ok(()),
        }
    }

    fn allows_origin(&self, origin: &str) -> bool {
        origin == INSTALLED_VIEWER || is_local(origin) || self.allowed_origins.iter().any(|allowed| allowed == origin)
    }
}

/// An answer that ends a handshake.
pub(super) fn refusal_response(status: StatusCode, sentence: String) -> ErrorResponse {
    let mut refused = ErrorResponse::new(Some(sentence));
    *refused.status_mut() = status;
    refused
}

// Pages that this machine serves.
fn is_local(origin: &str) -> bool {
    let Some(host) = origin.strip_prefix("http://") else { return false };
    let name = match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|b| b.is_ascii_digit()) => name,
        _ => host,
    };
    matches!(name, "localhost" | "127.0.0.1" | "[::1]")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn is_let_in(check: &AccessCheck, path: &str, origins: &[&str]) -> bool {
        let request =
            origins.iter().fold(Request::builder().uri(path), |request, origin| request.header(ORIGIN, *origin));
        check.check_request(&request.body(()).expect("a request")).is_ok()
    }

    #[test]
    fn pages_of_elsewhere_look_on_if_they_are_named() {
        let named = "https://viewer.example";
        let access = ViewerAccess { allowed_origins: vec![named.to_owned()], is_open: false };
        let check = AccessCheck::new(access, ([127, 0, 0, 1], 8765).into());
        assert_eq!(check.viewer_url(([127, 0, 0, 1], 8765).into()), "ws://127.0.0.1:8765");
        assert!(is_let_in(&check, "/", &[]));
        for origin in
            ["http://localhost", "http://localhost:8090", "http://127.0.0.1:80", "http://[::1]:8080", "file://", named]
        {
            assert!(is_let_in(&check, "/", &[origin]), "{origin}");
        }
        for origin in [
            "null",
            "",
            "http://evil.example",
            "https://viewer.example.evil.example",
            "http://viewer.example",
            "http://localhost.evil.example",
            "http://localhost@evil.example",
            "http://evil.example@localhost",
            "http://127.0.0.1.evil.example",
            "http://[::1]evil.example",
            "http://localhost/page",
            "https://localhost",
            "localhost",
            "file:///page.html",
        ] {
            assert!(!is_let_in(&check, "/", &[origin]), "{origin}");
            assert!(!is_let_in(&check, "/", &[named, origin]), "beside {origin}");
        }
    }

    #[test]
    fn other_machines_need_the_token() {
        let address = ([0, 0, 0, 0], 8765).into();
        let check = AccessCheck::new(ViewerAccess::default(), address);
        let url = check.viewer_url(address);
        let path = url.strip_prefix("ws://0.0.0.0:8765").expect("the address");
        let token = path.strip_prefix("/?token=").expect("a token");
        assert_eq!(token.len(), 32);
        assert!(is_let_in(&check, path, &[]) && is_let_in(&check, &format!("/any?a=b&token={token}"), &[]));
        assert!(!is_let_in(&check, path, &["http://evil.example"]), "a page needs both");
        for wrong in ["/", "/?token=", &path[..path.len() - 1], &format!("{path}0"), &format!("/?other={token}")] {
            assert!(!is_let_in(&check, wrong, &[]), "{wrong}");
        }
        assert_ne!(AccessCheck::new(ViewerAccess::default(), address).viewer_url(address), url);
        let open = AccessCheck::new(ViewerAccess { is_open: true, ..ViewerAccess::default() }, address);
        assert!(is_let_in(&open, "/", &[]) && !is_let_in(&open, "/", &["http://evil.example"]));
    }
}
