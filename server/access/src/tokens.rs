//! The file of tokens, stored as hashes, each with scopes and quotas.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use chrono::{DateTime, Utc};
use echolake_schema::ProjectName;
use echolake_service::{ClientIdentity, Error};
use serde::Deserialize;
use sha2::{Digest as _, Sha256};
use subtle::{Choice, ConstantTimeEq as _};
use toml::Spanned;

use crate::scram_verifier::ScramVerifier;
pub use echolake_service::TokenScope;

/// Prefix of all tokens, so that leaked ones can be found by searching.
const PREFIX: &str = "echolake_";

/// The tokens of a file.
pub struct TokenFile {
    path: PathBuf,
    pub(crate) entries: Vec<TokenEntry>,
}

/// A line of a token.
pub(crate) struct TokenEntry {
    pub client: Arc<ClientIdentity>,
    hash: [u8; 32],
    /// For logins that do not send the token; a line from an older version has none.
    pub scram: Option<Arc<ScramVerifier>>,
    expires: Option<DateTime<Utc>>,
}

impl TokenEntry {
    /// Returns whether it has not expired.
    pub fn is_valid(&self) -> bool {
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
    name: Spanned<String>,
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
    fn to_entry(&self) -> Result<TokenEntry, String> {
        let name = self.name.get_ref();
        let mut hash = [0; 32];
        hex::decode_to_slice(&self.sha256, &mut hash)
            .map_err(|_| format!("the sha256 of `{name}` is not 64 hexadecimal digits"))?;
        let token = hash.first_chunk().map(|head| u64::from_le_bytes(*head));
        let expires = self.expires.map(|time| {
            let time = DateTime::parse_from_rfc3339(&time.to_string()).map(|time| time.to_utc());
            time.map_err(|_| format!("expires of `{name}` is no time with a zone, as 2027-01-31T12:00:00Z"))
        });
        let scram = self.scram.as_ref().map(|text| {
            text.parse().map(Arc::new).map_err(|wrong: String| format!("the scram of `{name}` is wrong: {wrong}"))
        });
        let client = Arc::new(self.to_identity(token)?);
        Ok(TokenEntry { client, hash, scram: scram.transpose()?, expires: expires.transpose()? })
    }

    fn to_identity(&self, token: Option<u64>) -> Result<ClientIdentity, String> {
        let name = self.name.get_ref();
        let at_least_one = |what: &str, value: Option<u64>| match value {
            Some(0) => Err(format!("{what} of `{name}` is 0; hint: leave it out where there is no limit")),
            _ => Ok(()),
        };
        at_least_one("seconds", self.seconds)?;
        at_least_one("memory_mb", self.memory_mb.map(|v| v as u64))?;
        at_least_one("rows", self.rows)?;
        at_least_one("concurrent", self.concurrent.map(|v| v as u64))?;
        self.check_projects()?;
        Ok(ClientIdentity {
            name: name.clone(),
            is_open: false,
            scopes: self.scopes.clone(),
            projects: self.projects.clone(),
            seconds: self.seconds,
            memory_bytes: self.memory_mb.map(|mb| mb.saturating_mul(1_000_000)),
            rows: self.rows,
            concurrent: self.concurrent,
            token,
        })
    }

    fn check_projects(&self) -> Result<(), String> {
        let Some(projects) = &self.projects else { return Ok(()) };
        let name = self.name.get_ref();
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
    pub fn read_from(path: &Path) -> Result<Self, Error> {
        let file = Self::read_any(path)?;
        if file.entries.is_empty() {
            let message = "there is none; hint: `echolake token NAME` makes one".to_owned();
            return Err(Error::Tokens { path: path.to_owned(), message });
        }
        Ok(file)
    }

    /// Reads a file in which no token may be left.
    ///
    /// # Errors
    /// As [`TokenFile::read_from`].
    pub(crate) fn read_any(path: &Path) -> Result<Self, Error> {
        let text =
            std::fs::read_to_string(path).map_err(|source| Error::ReadTokens { path: path.to_owned(), source })?;
        Self::parse(path, &text).map_err(|message| Error::Tokens { path: path.to_owned(), message })
    }

    /// Parses a file's text.
    ///
    /// # Errors
    /// The defect.
    pub(crate) fn parse(path: &Path, text: &str) -> Result<Self, String> {
        let file: TokenList = toml::from_str(text).map_err(|e| e.to_string())?;
        let entries = file.token.iter().map(Line::to_entry).collect::<Result<Vec<_>, _>>()?;
        let line_of = |at: usize| line_number(text, file.token[at].name.span().start);
        for (i, entry) in entries.iter().enumerate() {
            let is_same = |e: &TokenEntry| e.client.name == entry.client.name || e.hash == entry.hash;
            if let Some(earlier) = entries[..i].iter().position(is_same) {
                let names = [earlier, i].map(|at| &entries[at].client.name);
                let what = if names[0] == names[1] { "the name" } else { "the sha256 of" };
                let lines = [earlier, i].map(line_of);
                return Err(format!(
                    "{what} `{}` is there twice, in lines {} and {}; hint: remove the [[token]] of one",
                    names[1], lines[0], lines[1]
                ));
            }
        }
        Ok(Self { path: path.to_owned(), entries })
    }

    /// The file's path.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Finds a token's line by its hash.
    // Every hash is compared to its end, so that the time does not tell which token is nearly right.
    pub(crate) fn find_entry(&self, hash: &[u8; 32]) -> Option<&TokenEntry> {
        let mut found = None;
        for entry in &self.entries {
            let same: Choice = entry.hash.ct_eq(hash);
            if same.into() {
                found = Some(entry);
            }
        }
        found.filter(|entry| entry.is_valid())
    }

    /// A secret that is the same after a restart, and for as long as the first line stays.
    pub(crate) fn stable_secret(&self) -> [u8; 32] {
        self.entries.first().map_or([0; 32], |entry| entry.hash)
    }

    /// Finds a line by its name.
    pub(crate) fn find_name(&self, name: &str) -> Option<&TokenEntry> {
        self.entries.iter().find(|entry| entry.client.name == name && entry.is_valid())
    }
}

/// Returns the lines of a file of tokens that have a name; none if the text is no such file.
pub fn find_name_lines(text: &str, name: &str) -> Vec<usize> {
    let file: TokenList = toml::from_str(text).unwrap_or(TokenList { token: Vec::new() });
    let named = file.token.iter().filter(|line| line.name.get_ref() == name);
    named.map(|line| line_number(text, line.name.span().start)).collect()
}

fn line_number(text: &str, byte: usize) -> usize {
    1 + text.as_bytes()[..byte.min(text.len())].iter().filter(|byte| **byte == b'\n').count()
}

/// A new token, and the lines that let it in.
pub struct FreshToken {
    /// The token: it is nowhere else.
    pub token: String,
    /// Lines for the file of tokens.
    pub lines: String,
}

/// Makes a token for these scopes, which expires after so many days and sees these projects; without any it sees all.
///
/// # Errors
/// [`Error::Random`].
pub fn generate_token(
    name: &str,
    days: Option<u32>,
    projects: &[ProjectName],
    scopes: &[TokenScope],
) -> Result<FreshToken, Error> {
    let mut secret = [0; 32];
    getrandom::fill(&mut secret).map_err(|failed| Error::Random(failed.into()))?;
    let token = format!("{PREFIX}{}", hex::encode(secret));
    let hash = hex::encode(Sha256::digest(token.as_bytes()));
    let scram = ScramVerifier::new(&token).map_err(|failed| Error::Random(failed.into()))?;
    let name = toml::Value::from(name);
    let scopes = TokenScope::NAMED.into_iter().filter(|(_, scope)| scopes.contains(scope));
    let scopes: Vec<_> = scopes.map(|(name, _)| format!("\"{name}\"")).collect();
    let scopes = scopes.join(", ");
    let lines = format!(
        "[[token]]\nname = {name}\nsha256 = \"{hash}\"\nscram = \"{scram}\"\nscopes = [{scopes}]\n\
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_files_say_what_is_wrong() {
        let hash = "ab".repeat(32);
        for (text, expected) in [
            (format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\nexpires = 2027-01-31"), "no time with a zone"),
            ("[[token]]\nname = 'a'\nsha256 = 'ab'".to_owned(), "64 hexadecimal"),
            ("[[token]]\nname = 'a'".to_owned(), "missing field `sha256`"),
            (format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\nscram = 'md5'"), "the scram of `a` is wrong"),
            (format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\nrows = 0"), "rows of `a` is 0"),
            (format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\nscopes = ['all']"), "unknown variant"),
            (format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\nprojects = []"), "projects of `a` are none"),
            (format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\nprojects = ['a b']"), "not a valid project name"),
            (
                format!("[[token]]\nname = 'a'\nsha256 = '{hash}'\nscopes = ['metrics']\nprojects = ['x']"),
                "has projects and the scope metrics",
            ),
            // B13
            (
                format!("# Ana\n[[token]]\nname = 'a'\nsha256 = '{hash}'\n").repeat(2),
                "the name `a` is there twice, in lines 3 and 7; hint: remove",
            ),
            (
                ["a", "b"].map(|name| format!("[[token]]\nname = '{name}'\nsha256 = '{hash}'\n")).concat(),
                "the sha256 of `b` is there twice, in lines 2 and 5",
            ),
            ("[[group]]\nname = 'a'".to_owned(), "unknown field `group`"),
        ] {
            let error = TokenFile::parse(Path::new("tokens.toml"), &text).map(|_| ()).expect_err(&text);
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
