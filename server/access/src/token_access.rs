//! Access control: who a client is, by its token or browser session.

use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard};
use std::time::SystemTime;

use echolake_service::{ClientIdentity, RequestFault};
use sha2::{Digest as _, Sha256};

use crate::scram_verifier::ScramVerifier;
use crate::sessions::BrowserSessions;
use crate::tokens::TokenFile;

/// The access rule of a server.
pub enum TokenAccess {
    /// All clients on this machine.
    Open,
    /// Those whom the file of tokens names.
    Named(Box<NamedAccess>),
}

/// Access of those whom a file names.
pub struct NamedAccess {
    file: RwLock<TokenFile>,
    sessions: BrowserSessions,
}

impl NamedAccess {
    fn lock_file(&self) -> RwLockReadGuard<'_, TokenFile> {
        self.file.read().unwrap_or_else(PoisonError::into_inner)
    }

    // The client of a token.
    fn find_client(&self, hash: &[u8; 32]) -> Result<Arc<ClientIdentity>, RequestFault> {
        self.lock_file().find_entry(hash).map(|entry| entry.client.clone()).ok_or(RequestFault::Unauthenticated)
    }

    // All clients that may ask now.
    fn valid_clients(&self) -> Vec<Arc<ClientIdentity>> {
        let file = self.lock_file();
        file.entries.iter().filter(|entry| entry.is_valid()).map(|entry| entry.client.clone()).collect()
    }
}

impl TokenAccess {
    /// Access by `tokens`; open access without them.
    pub fn new(tokens: Option<TokenFile>) -> Self {
        match tokens {
            Some(file) => {
                let named = NamedAccess { file: RwLock::new(file), sessions: BrowserSessions::default() };
                Self::Named(Box::new(named))
            }
            None => Self::Open,
        }
    }

    /// Returns whether no token is required.
    pub fn is_open(&self) -> bool {
        matches!(self, Self::Open)
    }

    /// Returns the client of a token; on a server without tokens, the client that `local` makes.
    ///
    /// # Errors
    /// [`RequestFault::Unauthenticated`].
    pub fn client_of_token(
        &self,
        token: Option<&str>,
        local: impl FnOnce() -> ClientIdentity,
    ) -> Result<Arc<ClientIdentity>, RequestFault> {
        match self {
            Self::Open => Ok(Arc::new(local())),
            Self::Named(named) => named.find_client(&hash_of(token.unwrap_or_default())),
        }
    }

    /// Returns the verifier of a token's name, and its client. A name without one has a verifier that nobody passes and
    /// looks like others, and no client.
    pub fn scram_client(&self, name: &str) -> (Option<Arc<ClientIdentity>>, Arc<ScramVerifier>) {
        let Self::Named(named) = self else { return (None, Arc::new(ScramVerifier::unpassable(name, &[]))) };
        let file = named.lock_file();
        // Computed for known names, too, so that the time is the same.
        let unpassable = ScramVerifier::unpassable(name, &file.stable_secret());
        match file.find_name(name).and_then(|entry| Some((entry.client.clone(), entry.scram.clone()?))) {
            Some((client, verifier)) => (Some(client), verifier),
            None => (None, Arc::new(unpassable)),
        }
    }

    /// Checks that what a client may do has not changed, and that it may still ask.
    ///
    /// # Errors
    /// [`RequestFault::Unauthenticated`].
    pub fn check_current(&self, client: &ClientIdentity) -> Result<(), RequestFault> {
        let Self::Named(named) = self else { return Ok(()) };
        let file = named.lock_file();
        let is_current = file.find_name(&client.name).is_some_and(|entry| *entry.client == *client);
        is_current.then_some(()).ok_or(RequestFault::Unauthenticated)
    }

    /// Reads the file again if it changed; returns the names of clients that may no longer ask, or may do other things
    /// now. A file that cannot be read changes nothing.
    pub fn reload_changed(&self, known: &mut TokenFileState) -> Vec<String> {
        let Self::Named(named) = self else { return Vec::new() };
        let path = named.lock_file().path().to_owned();
        let changed = std::fs::metadata(&path).ok().and_then(|about| Some((about.modified().ok()?, about.len())));
        if known.file.replace(changed).is_some_and(|before| before != changed) {
            match TokenFile::read_any(&path) {
                Ok(renewed) => {
                    tracing::info!(tokens = renewed.entries.len(), "the file of tokens was read again");
                    *named.file.write().unwrap_or_else(PoisonError::into_inner) = renewed;
                }
                Err(e) => tracing::warn!(error = &e as &dyn std::error::Error, "the tokens stay as they were"),
            }
        }
        let before = std::mem::replace(&mut known.clients, named.valid_clients());
        let gone = before.into_iter().filter(|client| !known.clients.contains(client));
        gone.map(|client| client.name.clone()).collect()
    }

    /// Begins a browser's session; returns its secret.
    ///
    /// # Errors
    /// [`RequestFault::Unauthenticated`]; [`RequestFault::NotFound`] if there are no tokens.
    pub fn begin_session(&self, token: &str) -> Result<String, RequestFault> {
        let Self::Named(named) = self else {
            let hint = "this server has no tokens, ask right away";
            return Err(RequestFault::NotFound { what: "a session".to_owned(), hint });
        };
        let hash = hash_of(token);
        named.find_client(&hash)?;
        named.sessions.begin_session(hash).map_err(RequestFault::defect("no session can begin"))
    }

    /// Returns the client of the session with this secret; as [`TokenAccess::client_of_token`].
    ///
    /// # Errors
    /// As [`TokenAccess::client_of_token`].
    pub fn client_of_session(
        &self,
        secret: &str,
        local: impl FnOnce() -> ClientIdentity,
    ) -> Result<Arc<ClientIdentity>, RequestFault> {
        match self {
            Self::Open => Ok(Arc::new(local())),
            Self::Named(named) => {
                named.find_client(&named.sessions.find_holder(secret).ok_or(RequestFault::Unauthenticated)?)
            }
        }
    }
}

/// State of the file of tokens, and the clients that might ask, when it was last looked at.
#[derive(Default)]
pub struct TokenFileState {
    file: Option<Option<(SystemTime, u64)>>,
    clients: Vec<Arc<ClientIdentity>>,
}

fn hash_of(token: &str) -> [u8; 32] {
    Sha256::digest(token.as_bytes()).into()
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use echolake_schema::ProjectName;

    use super::*;
    use crate::tokens::generate_token;
    use echolake_service::TokenScope;

    fn access_by(lines: &str) -> TokenAccess {
        let file = TokenFile::parse(Path::new("no-such-file.toml"), lines).expect("tokens");
        TokenAccess::new(Some(file))
    }

    #[test]
    fn a_token_that_expired_or_was_taken_back_lets_nobody_in() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("tokens.toml");
        let hash = hex::encode(Sha256::digest("x"));
        let line = |rest: &str| format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\n{rest}\n");
        std::fs::write(&path, line("expires = 2126-01-01T00:00:00Z")).expect("written");
        let access = TokenAccess::new(Some(TokenFile::read_from(&path).expect("tokens")));
        let mut known = TokenFileState::default();
        assert!(access.reload_changed(&mut known).is_empty());
        let client = access.client_of_token(Some("x"), ClientIdentity::own_pages).expect("let in");
        let session = access.begin_session("x").expect("a session");
        let is_in = || {
            let by_session = access.client_of_session(&session, ClientIdentity::own_pages).is_ok();
            let by_token = access.client_of_token(Some("x"), ClientIdentity::own_pages).is_ok();
            assert_eq!((by_session, by_token), (by_token, access.check_current(&client).is_ok()));
            by_token
        };
        assert!(is_in());
        // A half-written file changes nothing.
        std::fs::write(&path, "[[token]]\nname = 'a").expect("written");
        assert!(access.reload_changed(&mut known).is_empty() && is_in());
        std::fs::write(&path, line("expires = 2026-01-01T00:00:00Z")).expect("written");
        assert_eq!(access.reload_changed(&mut known), ["a"]);
        assert!(!is_in());
        std::fs::write(&path, line("")).expect("written");
        assert!(access.reload_changed(&mut known).is_empty() && is_in());
        // Other projects are another view of the lake: what was asked so far ends.
        std::fs::write(&path, line("projects = ['brick']")).expect("written");
        assert_eq!(access.reload_changed(&mut known), ["a"]);
        assert!(access.check_current(&client).is_err());
        std::fs::write(&path, line("")).expect("written");
        assert_eq!(access.reload_changed(&mut known), ["a"]);
        assert!(is_in());
        std::fs::write(&path, "").expect("written");
        assert_eq!(access.reload_changed(&mut known), ["a"]);
        assert!(!is_in());
        assert!(TokenFile::read_from(&path).map(drop).expect_err("no tokens").to_string().contains("there is none"));
    }

    #[test]
    fn a_fresh_token_lets_in_and_no_other_does() {
        let project: ProjectName = "brick".parse().expect("a name");
        let fresh = generate_token(
            "a \"quoted\" name",
            Some(1),
            std::slice::from_ref(&project),
            &[TokenScope::Sql, TokenScope::Files],
        )
        .expect("a token");
        assert!(!fresh.lines.contains(&fresh.token), "only hashes of it are kept");
        let access = access_by(&fresh.lines);
        let local = ClientIdentity::own_pages;
        let client = access.client_of_token(Some(&fresh.token), local).expect("let in");
        assert_eq!(client.name, "a \"quoted\" name");
        assert_eq!(client.projects, Some([project].into()));
        assert_eq!(client.quota().time, Some(std::time::Duration::from_secs(60)));
        assert!(client.require_scope(TokenScope::Files).is_ok(), "pages show meshes and link to files");
        assert!(matches!(client.require_scope(TokenScope::Metrics), Err(RequestFault::Forbidden { .. })));
        let secret = access.begin_session(&fresh.token).expect("a session");
        assert_eq!(access.client_of_session(&secret, local).expect("let in"), client);
        assert!(matches!(access.client_of_session(&fresh.token, local), Err(RequestFault::Unauthenticated)));
        assert!(matches!(access.begin_session(&secret), Err(RequestFault::Unauthenticated)));
        let (by_name, verifier) = access.scram_client("a \"quoted\" name");
        assert_eq!(by_name, Some(client));
        let (nobody, unpassable) = access.scram_client("b");
        assert_eq!((nobody, unpassable.salt().len()), (None, verifier.salt().len()));
        assert_eq!(unpassable.iterations(), verifier.iterations());
        assert_eq!(access.scram_client("b").1, unpassable, "a name's salt is always the same");
        assert_ne!(access.scram_client("c").1.salt(), unpassable.salt());
        let other =
            access_by(&crate::tokens::generate_token("x", None, &[], &[TokenScope::Sql]).expect("a token").lines);
        assert_ne!(other.scram_client("b").1.salt(), unpassable.salt(), "nobody computes it");
        let other = crate::tokens::generate_token("b", None, &[], &[TokenScope::Sql]).expect("a token").token;
        let cut = &fresh.token[..fresh.token.len() - 1];
        for wrong in [None, Some(""), Some(other.as_str()), Some(cut)] {
            assert!(matches!(access.client_of_token(wrong, local), Err(RequestFault::Unauthenticated)), "{wrong:?}");
        }
    }

    #[test]
    fn scopes_are_those_that_a_line_names() {
        let hash = hex::encode(Sha256::digest("x"));
        let allowed = |scopes: &str| {
            let access = access_by(&format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\n{scopes}"));
            let client = access.client_of_token(Some("x"), ClientIdentity::own_pages).expect("let in");
            [TokenScope::Sql, TokenScope::Files, TokenScope::Metrics].map(|scope| client.require_scope(scope).is_ok())
        };
        assert_eq!(allowed(""), [true, true, false]);
        assert_eq!(allowed("scopes = ['sql']"), [true, false, false]);
        assert_eq!(allowed("scopes = ['metrics']"), [false, false, true]);
    }
}
