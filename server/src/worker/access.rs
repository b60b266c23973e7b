//! Access to a worker, and an engine's proof that it may use one.

use std::path::Path;

use echolake_query::{WorkerLink, WorkerToken};
use subtle::ConstantTimeEq as _;
use tonic::{Request, Status};

use crate::Error;

/// Checks that a worker's address may be used with a link, encrypted or not.
///
/// # Errors
/// [`Error::OpenWorker`], [`Error::PlainTextWorker`].
pub(super) fn check_address(
    link: &WorkerLink,
    address: &str,
    is_loopback: bool,
    is_encrypted: bool,
) -> Result<(), Error> {
    match (is_loopback, &link.token, is_encrypted || link.is_private) {
        (true, ..) | (false, Some(_), true) => Ok(()),
        (false, None, _) => Err(Error::OpenWorker { address: address.to_owned() }),
        (false, Some(_), false) => Err(Error::PlainTextWorker { address: address.to_owned() }),
    }
}

/// Reads the file of a worker's token.
///
/// # Errors
/// [`Error::WorkerToken`].
pub fn read_worker_token(path: &Path) -> Result<WorkerToken, Error> {
    let wrong = |message: String| Error::WorkerToken { path: path.to_owned(), message };
    let text = std::fs::read_to_string(path).map_err(|e| wrong(e.to_string()))?;
    let least = WorkerToken::LEAST;
    WorkerToken::parse(&text)
        .ok_or_else(|| wrong(format!("expected {least} letters and digits or more, and nothing else")))
}

/// Checks requests for the token.
#[derive(Clone)]
pub(super) struct WorkerAccess {
    /// The header that is expected; None if all may ask.
    expected: Option<String>,
}

impl WorkerAccess {
    pub(super) fn new(token: Option<WorkerToken>) -> Self {
        Self { expected: token.map(|token| format!("Bearer {}", token.secret())) }
    }

    pub(super) fn check(&self, request: Request<()>) -> Result<Request<()>, Status> {
        let Some(expected) = &self.expected else { return Ok(request) };
        let given = request.metadata().get("authorization").map(|value| value.as_bytes());
        match given {
            Some(given) if bool::from(given.ct_eq(expected.as_bytes())) => Ok(request),
            Some(_) => {
                Err(Status::unauthenticated("the token is not this worker's; hint: the same --worker-token everywhere"))
            }
            None => Err(Status::unauthenticated("this worker needs a token; hint: --worker-token FILE")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_token_lets_in() {
        let token = WorkerToken::parse("0123456789abcdef0123456789abcdef").expect("a token");
        let ask = |access: &WorkerAccess, header: Option<&'static str>| {
            let mut request = Request::new(());
            if let Some(header) = header {
                request.metadata_mut().insert("authorization", header.parse().expect("a header"));
            }
            access.check(request).is_ok()
        };
        let access = WorkerAccess::new(Some(token));
        assert!(ask(&access, Some("Bearer 0123456789abcdef0123456789abcdef")));
        for wrong in
            [None, Some(""), Some("Bearer "), Some("Bearer 0123456789abcdef0123456789abcdeX"), Some("Bearer 0123")]
        {
            assert!(!ask(&access, wrong), "{wrong:?}");
        }
        assert!(ask(&WorkerAccess::new(None), None), "of this machine alone");
    }

    #[test]
    fn beyond_this_machine_there_is_a_token_and_encryption_or_a_private_network() {
        let token = WorkerToken::parse("0123456789abcdef0123456789abcdef");
        let check = |token: &Option<WorkerToken>, is_private, is_loopback, is_encrypted| {
            let link = WorkerLink { token: token.clone(), trust: None, is_private };
            check_address(&link, "10.0.0.7", is_loopback, is_encrypted)
        };
        assert!(check(&None, false, true, false).is_ok());
        assert!(check(&token, true, false, false).is_ok());
        assert!(check(&token, false, false, true).is_ok());
        assert!(matches!(check(&None, true, false, true), Err(Error::OpenWorker { .. })));
        assert!(matches!(check(&token, false, false, false), Err(Error::PlainTextWorker { .. })));
    }
}
