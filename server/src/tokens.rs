//! Access control: tokens, stored as hashes in a file, each with scopes and quotas.

use std::collections::BTreeSet;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::SystemTime;

use base64::Engine as _;
use base64::alphabet::STANDARD;
use base64::engine::GeneralPurpose;
use base64::engine::general_purpose::NO_PAD;
use chrono::{DateTime, Utc};
use echolake_schema::ProjectName;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use subtle::{Choice, ConstantTimeEq as _};

use crate::Error;
use crate::client_identity::ClientIdentity;
use crate::fault::RequestFault;
use crate::scram_verifier::ScramVerifier;
use crate::sessions::BrowserSessions;

/// Of basic credentials; padding is cut off before, since gRPC's clients leave it out.
const BASE64: GeneralPurpose = GeneralPurpose::new(&STANDARD, NO_PAD.with_decode_allow_trailing_bits(true));

/// Prefix of all tokens, so that leaked ones can be found by searching.
const PREFIX: &str = "echolake_";

/// A permission of a token.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TokenScope {
    /// Queries, and what the tables are.
    Sql,
    /// The runs' and tables' files.
    Files,
    /// The server's own figures.
    Metrics,
}

impl fmt::Display for TokenScope {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Sql => "SQL",
            Self::Files => "files",
            Self::Metrics => "metrics",
        })
    }
}

/// The tokens of a file.
pub struct TokenFile {
    path: PathBuf,
    entries: Vec<TokenEntry>,
}

struct TokenEntry {
    client: Arc<ClientIdentity>,
    hash: [u8; 32],
    /// For logins that do not send the token; a line from an older version has none.
    scram: Option<Arc<ScramVerifier>>,
    expires: Option<DateTime<Utc>>,
}

impl TokenEntry {
    fn is_valid(&self) -> bool {
        self.expires.is_none_or(|expires| Utc::now() < expires)
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct TokenList {
    #[serde(default)]
    token: Vec<Line>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    name: String,
    sha256: String,
    scram: Option<String>,
    #[serde(default = "reading")]
    scopes: Vec<TokenScope>,
    projects: Option<BTreeSet<ProjectName>>,
    seconds: Option<u64>,
    memory_mb: Option<usize>,
    rows: Option<u64>,
    concurrent: Option<usize>,
    expires: Option<toml::value::Datetime>,
}

// What a reader of the lake needs. A client with SQL reads all rows, and the catalogue's pages show meshes and link to
// run files: without files a signed-in browser would be refused in the middle of a page.
fn reading() -> Vec<TokenScope> {
    vec![TokenScope::Sql, TokenScope::Files]
}

impl Line {
    fn entry(&self) -> Result<TokenEntry, String> {
        let name = &self.name;
        let mut hash = [0; 32];
        hex::decode_to_slice(&self.sha256, &mut hash)
            .map_err(|_| format!("the sha256 of `{name}` is not 64 hexadecimal digits"))?;
        let at_least_one = |what: &str, value: Option<u64>| match value {
            Some(0) => Err(format!("{what} of `{name}` is 0; hint: leave it out where there is no limit")),
            _ => Ok(()),
        };
        at_least_one("seconds", self.seconds)?;
        at_least_one("memory_mb", self.memory_mb.map(|v| v as u64))?;
        at_least_one("rows", self.rows)?;
        at_least_one("concurrent", self.concurrent.map(|v| v as u64))?;
        self.check_projects()?;
        let client = ClientIdentity {
            name: name.clone(),
            is_open: false,
            scopes: self.scopes.clone(),
            projects: self.projects.clone(),
            seconds: self.seconds,
            memory_bytes: self.memory_mb.map(|mb| mb.saturating_mul(1_000_000)),
            rows: self.rows,
            concurrent: self.concurrent,
            token: hash.first_chunk().map(|head| u64::from_le_bytes(*head)),
        };
        let expires = self.expires.map(|time| {
            let time = DateTime::parse_from_rfc3339(&time.to_string()).map(|time| time.to_utc());
            time.map_err(|_| format!("expires of `{name}` is no time with a zone, as 2027-01-31T12:00:00Z"))
        });
        let scram = self.scram.as_ref().map(|text| {
            text.parse().map(Arc::new).map_err(|wrong: String| format!("the scram of `{name}` is wrong: {wrong}"))
        });
        Ok(TokenEntry { client: Arc::new(client), hash, scram: scram.transpose()?, expires: expires.transpose()? })
    }

    fn check_projects(&self) -> Result<(), String> {
        let Some(projects) = &self.projects else { return Ok(()) };
        let name = &self.name;
        if projects.is_empty() {
            return Err(format!("projects of `{name}` are none; hint: leave them out where it may see all"));
        }
        // They count runs and queries of all projects.
        if self.scopes.contains(&TokenScope::Metrics) {
            return Err(format!(
                "`{name}` has projects and the scope metrics; hint: the server's figures are of all projects"
            ));
        }
        Ok(())
    }
}

impl TokenFile {
    /// Reads a file of tokens.
    ///
    /// # Errors
    /// [`Error::ReadTokens`], [`Error::Tokens`].
    pub fn read(path: &Path) -> Result<Self, Error> {
        let file = Self::read_any(path)?;
        if file.entries.is_empty() {
            let message = "there is none; hint: `echolake token NAME` makes one".to_owned();
            return Err(Error::Tokens { path: path.to_owned(), message });
        }
        Ok(file)
    }

    // Also a file in which no token is left.
    fn read_any(path: &Path) -> Result<Self, Error> {
        let text =
            std::fs::read_to_string(path).map_err(|source| Error::ReadTokens { path: path.to_owned(), source })?;
        let entries = Self::parse(&text).map_err(|message| Error::Tokens { path: path.to_owned(), message })?;
        Ok(Self { path: path.to_owned(), entries })
    }

    fn parse(text: &str) -> Result<Vec<TokenEntry>, String> {
        let file: TokenList = toml::from_str(text).map_err(|e| e.to_string())?;
        let entries = file.token.iter().map(Line::entry).collect::<Result<Vec<_>, _>>()?;
        for (i, entry) in entries.iter().enumerate() {
            if entries[..i].iter().any(|e| e.client.name == entry.client.name || e.hash == entry.hash) {
                return Err(format!("`{}` is there twice", entry.client.name));
            }
        }
        Ok(entries)
    }

    // Every hash is compared to its end, so that the time does not tell which token is nearly right.
    fn find(&self, hash: &[u8; 32]) -> Option<&TokenEntry> {
        let mut found = None;
        for entry in &self.entries {
            let same: Choice = entry.hash.ct_eq(hash);
            if same.into() {
                found = Some(entry);
            }
        }
        found.filter(|entry| entry.is_valid())
    }
}

/// A new token, and the lines that let it in.
pub struct FreshToken {
    /// The token: it is nowhere else.
    pub token: String,
    /// Lines for the file of tokens.
    pub lines: String,
}

/// Makes a token, which expires after so many days and sees these projects; without any it sees all.
///
/// # Errors
/// [`Error::Random`].
pub fn fresh(name: &str, days: Option<u32>, projects: &[ProjectName]) -> Result<FreshToken, Error> {
    let mut secret = [0; 32];
    getrandom::fill(&mut secret).map_err(|failed| Error::Random(failed.into()))?;
    let token = format!("{PREFIX}{}", hex::encode(secret));
    let hash = hex::encode(Sha256::digest(token.as_bytes()));
    let scram = ScramVerifier::new(&token).map_err(|failed| Error::Random(failed.into()))?;
    let name = toml::Value::from(name);
    let lines = format!(
        "[[token]]\nname = {name}\nsha256 = \"{hash}\"\nscram = \"{scram}\"\nscopes = [\"sql\", \"files\"]\n\
         seconds = 60\nmemory_mb = 2000\nrows = 10_000_000\nconcurrent = 4\n"
    );
    let expires = days.map(|days| {
        let time = Utc::now() + chrono::Duration::days(days.into());
        format!("expires = {}\n", time.to_rfc3339_opts(chrono::SecondsFormat::Secs, true))
    });
    let names: Vec<_> = projects.iter().map(|project| format!("\"{project}\"")).collect();
    let projects = (!names.is_empty()).then(|| format!("projects = [{}]\n", names.join(", ")));
    let lines = lines + &expires.unwrap_or_default() + &projects.unwrap_or_default();
    Ok(FreshToken { token, lines })
}

/// The access rule of a server.
pub(crate) enum TokenAccess {
    /// All clients on this machine.
    Open,
    /// Holders of a token, or of a browser session that was begun with one.
    Tokens(RwLock<TokenFile>, BrowserSessions),
}

impl TokenAccess {
    /// Access by `tokens`, or open access without them.
    pub(crate) fn new(tokens: Option<TokenFile>) -> Self {
        match tokens {
            Some(tokens) => Self::Tokens(RwLock::new(tokens), BrowserSessions::default()),
            None => Self::Open,
        }
    }

    /// Returns whether no token is required.
    pub(crate) fn is_open(&self) -> bool {
        matches!(self, Self::Open)
    }

    /// Returns the client of a token; on a server without tokens, the client that `local` makes.
    ///
    /// # Errors
    /// [`RequestFault::Unauthenticated`].
    pub(crate) fn client(
        &self,
        token: Option<&str>,
        local: impl FnOnce() -> ClientIdentity,
    ) -> Result<Arc<ClientIdentity>, RequestFault> {
        match self {
            Self::Open => Ok(Arc::new(local())),
            Self::Tokens(tokens, _) => holder(tokens, &hash_of(token.unwrap_or_default())),
        }
    }

    /// Returns the client of a token's name, and what tells whether it has the token; None if its line has no such verifier.
    pub(crate) fn scram_client(&self, name: &str) -> Option<(Arc<ClientIdentity>, Arc<ScramVerifier>)> {
        let Self::Tokens(tokens, _) = self else { return None };
        let tokens = tokens.read().unwrap_or_else(PoisonError::into_inner);
        let entry = tokens.entries.iter().find(|entry| entry.client.name == name && entry.is_valid())?;
        Some((entry.client.clone(), entry.scram.clone()?))
    }

    /// Returns the client of a token's name; on a server without tokens, the one of this name that asks over HTTP.
    ///
    /// # Errors
    /// [`RequestFault::Unauthenticated`].
    pub(crate) fn client_of_name(&self, name: &str) -> Result<Arc<ClientIdentity>, RequestFault> {
        match self {
            Self::Open => {
                let known = [ClientIdentity::pages(), ClientIdentity::programs()];
                let found = known.into_iter().find(|client| client.name == name);
                found.map(Arc::new).ok_or(RequestFault::Unauthenticated)
            }
            Self::Tokens(tokens, _) => {
                let tokens = tokens.read().unwrap_or_else(PoisonError::into_inner);
                let found = tokens.entries.iter().find(|entry| entry.client.name == name && entry.is_valid());
                found.map(|entry| entry.client.clone()).ok_or(RequestFault::Unauthenticated)
            }
        }
    }

    /// Checks that a client's token was not taken back and has not expired since, and sees the same projects.
    ///
    /// # Errors
    /// [`RequestFault::Unauthenticated`].
    pub(crate) fn check_current(&self, client: &ClientIdentity) -> Result<(), RequestFault> {
        let Self::Tokens(tokens, _) = self else { return Ok(()) };
        let tokens = tokens.read().unwrap_or_else(PoisonError::into_inner);
        let is_its = |entry: &TokenEntry| {
            entry.client.token == client.token && entry.client.projects == client.projects && entry.is_valid()
        };
        tokens.entries.iter().any(is_its).then_some(()).ok_or(RequestFault::Unauthenticated)
    }

    /// Reads the file again if it changed; returns the names of clients that may no longer ask, or see other projects now. A file that cannot be read
    /// changes nothing.
    pub(crate) fn renew(&self, known: &mut TokenFileState) -> Vec<String> {
        let Self::Tokens(tokens, _) = self else { return Vec::new() };
        let mut tokens = tokens.write().unwrap_or_else(PoisonError::into_inner);
        let valid_before = std::mem::take(&mut known.valid);
        let changed =
            std::fs::metadata(&tokens.path).ok().and_then(|about| Some((about.modified().ok()?, about.len())));
        if known.file.replace(changed).is_some_and(|before| before != changed) {
            match TokenFile::read_any(&tokens.path) {
                Ok(renewed) => {
                    *tokens = renewed;
                    tracing::info!(tokens = tokens.entries.len(), "the file of tokens was read again");
                }
                Err(e) => tracing::warn!(error = &e as &dyn std::error::Error, "the tokens stay as they were"),
            }
        }
        let valid = tokens.entries.iter().filter(|entry| entry.is_valid());
        known.valid = valid.map(|entry| (entry.hash, entry.client.clone())).collect();
        let is_same = |(hash, client): &(_, Arc<ClientIdentity>)| {
            known.valid.iter().any(|(h, c)| h == hash && c.name == client.name && c.projects == client.projects)
        };
        valid_before.into_iter().filter(|token| !is_same(token)).map(|(_, client)| client.name.clone()).collect()
    }

    /// Begins a browser's session; returns its secret.
    ///
    /// # Errors
    /// [`RequestFault::Unauthenticated`]; [`RequestFault::NotFound`] if there are no tokens.
    pub(crate) fn begin_session(&self, token: &str) -> Result<String, RequestFault> {
        let Self::Tokens(tokens, sessions) = self else {
            let hint = "this server has no tokens, ask right away";
            return Err(RequestFault::NotFound { what: "a session".to_owned(), hint });
        };
        let hash = hash_of(token);
        holder(tokens, &hash)?;
        sessions.begin(hash).map_err(RequestFault::defect("no session can begin"))
    }

    /// Returns the client of the session with this secret; as [`TokenAccess::client`].
    ///
    /// # Errors
    /// As [`TokenAccess::client`].
    pub(crate) fn client_of_session(
        &self,
        secret: &str,
        local: impl FnOnce() -> ClientIdentity,
    ) -> Result<Arc<ClientIdentity>, RequestFault> {
        let (tokens, sessions) = match self {
            Self::Open => return Ok(Arc::new(local())),
            Self::Tokens(tokens, sessions) => (tokens, sessions),
        };
        holder(tokens, &sessions.holder(secret).ok_or(RequestFault::Unauthenticated)?)
    }
}

/// State of a file of tokens when it was last looked at.
#[derive(Default)]
pub(crate) struct TokenFileState {
    file: Option<Option<(SystemTime, u64)>>,
    valid: Vec<([u8; 32], Arc<ClientIdentity>)>,
}

fn hash_of(token: &str) -> [u8; 32] {
    Sha256::digest(token.as_bytes()).into()
}

fn holder(tokens: &RwLock<TokenFile>, hash: &[u8; 32]) -> Result<Arc<ClientIdentity>, RequestFault> {
    let tokens = tokens.read().unwrap_or_else(PoisonError::into_inner);
    tokens.find(hash).map(|entry| entry.client.clone()).ok_or(RequestFault::Unauthenticated)
}

/// The token of an `Authorization` header: a bearer's, or the password of a basic one.
pub(crate) fn of_header(value: &str) -> Option<String> {
    let (scheme, rest) = value.split_once(' ')?;
    if scheme.eq_ignore_ascii_case("bearer") {
        return Some(rest.trim().to_owned());
    }
    if !scheme.eq_ignore_ascii_case("basic") {
        return None;
    }
    let pair = String::from_utf8(BASE64.decode(rest.trim().trim_end_matches('=')).ok()?).ok()?;
    Some(pair.split_once(':')?.1.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn access_by(lines: &str) -> TokenAccess {
        let entries = TokenFile::parse(lines).expect("tokens");
        TokenAccess::new(Some(TokenFile { path: PathBuf::from("no-such-file.toml"), entries }))
    }

    #[test]
    fn a_token_that_expired_or_was_taken_back_lets_nobody_in() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("tokens.toml");
        let hash = hex::encode(Sha256::digest("x"));
        let line = |rest: &str| format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\n{rest}\n");
        std::fs::write(&path, line("expires = 2126-01-01T00:00:00Z")).expect("written");
        let access = TokenAccess::new(Some(TokenFile::read(&path).expect("tokens")));
        let mut known = TokenFileState::default();
        assert!(access.renew(&mut known).is_empty());
        let client = access.client(Some("x"), ClientIdentity::pages).expect("let in");
        let session = access.begin_session("x").expect("a session");
        let is_in = || {
            let by_session = access.client_of_session(&session, ClientIdentity::pages).is_ok();
            let by_token = access.client(Some("x"), ClientIdentity::pages).is_ok();
            assert_eq!((by_session, by_token), (by_token, access.check_current(&client).is_ok()));
            by_token
        };
        assert!(is_in());
        // A half-written file changes nothing.
        std::fs::write(&path, "[[token]]\nname = 'a").expect("written");
        assert!(access.renew(&mut known).is_empty() && is_in());
        std::fs::write(&path, line("expires = 2026-01-01T00:00:00Z")).expect("written");
        assert_eq!(access.renew(&mut known), ["a"]);
        assert!(!is_in());
        std::fs::write(&path, line("")).expect("written");
        assert!(access.renew(&mut known).is_empty() && is_in());
        // Other projects are another view of the lake: what was asked so far ends.
        std::fs::write(&path, line("projects = ['brick']")).expect("written");
        assert_eq!(access.renew(&mut known), ["a"]);
        assert!(access.check_current(&client).is_err());
        std::fs::write(&path, line("")).expect("written");
        assert_eq!(access.renew(&mut known), ["a"]);
        assert!(is_in());
        std::fs::write(&path, "").expect("written");
        assert_eq!(access.renew(&mut known), ["a"]);
        assert!(!is_in());
        assert!(TokenFile::read(&path).map(drop).expect_err("no tokens").to_string().contains("there is none"));
    }

    #[test]
    fn a_fresh_token_lets_in_and_no_other_does() {
        let project: ProjectName = "brick".parse().expect("a name");
        let fresh = fresh("a \"quoted\" name", Some(1), std::slice::from_ref(&project)).expect("a token");
        assert!(!fresh.lines.contains(&fresh.token), "only hashes of it are kept");
        let access = access_by(&fresh.lines);
        let local = ClientIdentity::pages;
        let client = access.client(Some(&fresh.token), local).expect("let in");
        assert_eq!(client.name, "a \"quoted\" name");
        assert_eq!(client.projects, Some([project].into()));
        assert_eq!(client.quota().time, Some(std::time::Duration::from_secs(60)));
        assert!(client.require(TokenScope::Files).is_ok(), "pages show meshes and link to files");
        assert!(matches!(client.require(TokenScope::Metrics), Err(RequestFault::Forbidden { .. })));
        let secret = access.begin_session(&fresh.token).expect("a session");
        assert_eq!(access.client_of_session(&secret, local).expect("let in"), client);
        assert!(matches!(access.client_of_session(&fresh.token, local), Err(RequestFault::Unauthenticated)));
        assert!(matches!(access.begin_session(&secret), Err(RequestFault::Unauthenticated)));
        let (by_name, _) = access.scram_client("a \"quoted\" name").expect("a verifier");
        assert_eq!(by_name, client);
        assert!(access.scram_client("b").is_none());
        let other = super::fresh("b", None, &[]).expect("a token").token;
        let cut = &fresh.token[..fresh.token.len() - 1];
        for wrong in [None, Some(""), Some(other.as_str()), Some(cut)] {
            assert!(matches!(access.client(wrong, local), Err(RequestFault::Unauthenticated)), "{wrong:?}");
        }
    }

    #[test]
    fn scopes_are_those_that_a_line_names() {
        let hash = hex::encode(Sha256::digest("x"));
        let allowed = |scopes: &str| {
            let access = access_by(&format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\n{scopes}"));
            let client = access.client(Some("x"), ClientIdentity::pages).expect("let in");
            [TokenScope::Sql, TokenScope::Files, TokenScope::Metrics].map(|scope| client.require(scope).is_ok())
        };
        assert_eq!(allowed(""), [true, true, false]);
        assert_eq!(allowed("scopes = ['sql']"), [true, false, false]);
        assert_eq!(allowed("scopes = ['metrics']"), [false, false, true]);
    }

    #[test]
    fn wrong_files_say_what_is_wrong() {
        let hash = "ab".repeat(32);
        for (text, expected) in [
            (format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\nexpires = 2027-01-31"), "no time with a zone"),
            ("[[token]]\nname = 'a'\nsha256 = 'ab'".to_owned(), "64 hexadecimal"),
            (format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\nscram = 'md5'"), "the scram of `a` is wrong"),
            (format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\nrows = 0"), "rows of `a` is 0"),
            (format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\nscopes = ['all']"), "unknown variant"),
            (format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\nprojects = []"), "projects of `a` are none"),
            (format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\nprojects = ['a b']"), "not a valid project name"),
            (
                format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\nscopes = ['metrics']\nprojects = ['x']"),
                "has projects and the scope metrics",
            ),
            (format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\n").repeat(2), "twice"),
        ] {
            let error = TokenFile::parse(&text).map(|_| ()).expect_err(&text);
            assert!(error.contains(expected), "{text}: {error}");
        }
    }

    #[test]
    fn tokens_of_headers() {
        for (value, expected) in [
            ("Bearer x", Some("x")),
            ("bearer  x ", Some("x")),
            ("Basic dXNlcjpwYXNzOndvcmQ=", Some("pass:word")),
            ("Basic dXNlcjpwYXNzOndvcmQ", Some("pass:word")),
            ("Basic !!", None),
            ("Basic dXNlcg==", None),
            ("Digest x", None),
            ("x", None),
        ] {
            assert_eq!(of_header(value).as_deref(), expected, "{value}");
        }
    }
}
