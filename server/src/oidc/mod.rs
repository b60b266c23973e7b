//! Users of an identity provider (OpenID Connect): a client shows a token that the provider has signed, and the groups in
//! it say what the client may.

mod provider_keys;
mod web_token;

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use chrono::Utc;
use url::{Host, Url};

use crate::Error;
use provider_keys::ProviderKeys;
use web_token::{TokenClaims, WebToken};

/// Users who have logged in and whose tokens have not expired, at most; then who comes first to an end is forgotten.
const MOST_LOGINS: usize = 1_000;
/// Least time between two looks at the provider.
const PAUSE: Duration = Duration::from_secs(10);
/// Characters of a user's name.
const MOST_NAME_CHARS: usize = 200;

/// An identity provider, and the parts of its tokens that are used.
#[derive(Debug, Clone)]
pub struct OidcSettings {
    /// Its address, as it stands in the tokens (`iss`).
    pub issuer: String,
    /// The audience for which tokens must be issued (`aud`).
    pub audience: String,
    /// The claim that has a user's name; it must be one that users cannot choose.
    pub name_claim: String,
    /// The claim that has a user's groups.
    pub groups_claim: String,
}

/// An identity provider whose tokens are accepted.
pub(crate) struct IdentityProvider {
    settings: OidcSettings,
    keys: ProviderKeys,
    /// By the hash of the token.
    logins: Mutex<HashMap<[u8; 32], UserLogin>>,
}

/// A user who has shown a token.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct UserLogin {
    pub(crate) name: String,
    pub(crate) groups: Vec<String>,
    /// Seconds since 1970.
    expires: i64,
}

impl IdentityProvider {
    /// A provider, whose keys are to be fetched by [`IdentityProvider::keep_up`].
    ///
    /// # Errors
    /// [`Error::Oidc`].
    pub(crate) fn new(settings: OidcSettings) -> Result<Arc<Self>, Error> {
        Self::with_pause(settings, PAUSE)
    }

    fn with_pause(settings: OidcSettings, pause: Duration) -> Result<Arc<Self>, Error> {
        let wrong = |message: String| Error::Oidc { issuer: settings.issuer.clone(), message };
        let issuer = check_address(&settings.issuer).map_err(wrong)?;
        let keys = ProviderKeys::new(&settings.issuer, &issuer, pause).map_err(|e| wrong(e.to_string()))?;
        Ok(Arc::new(Self { settings, keys, logins: Mutex::default() }))
    }

    /// Fetches its keys from time to time; never ends.
    pub(crate) async fn keep_up(self: Arc<Self>) {
        self.keys.keep_up().await;
    }

    /// Waits, for a few seconds at most, until the key of a token is fetched, if it is not known.
    pub(crate) async fn await_key(&self, token: &str) {
        if let Some(token) = WebToken::parse(token) {
            self.keys.await_key(&token).await;
        }
    }

    /// Checks a token and takes note of its user; None, with a line in the log, if it is refused.
    pub(crate) fn log_in(&self, token: &str, hash: [u8; 32]) -> Option<UserLogin> {
        let token = WebToken::parse(token)?;
        match self.checked(&token) {
            Ok(login) => {
                self.remember(hash, login.clone());
                Some(login)
            }
            Err(reason) => {
                tracing::info!(reason, "a token of the identity provider was refused");
                None
            }
        }
    }

    /// Returns the user of a token that was shown before and has not expired.
    pub(crate) fn known_login(&self, hash: &[u8; 32]) -> Option<UserLogin> {
        self.lock().get(hash).filter(|login| login.is_valid()).cloned()
    }

    /// Returns the users whose tokens have not expired, of those that are wanted.
    pub(crate) fn known_logins(&self, is_wanted: impl Fn(&UserLogin) -> bool) -> Vec<UserLogin> {
        self.lock().values().filter(|login| login.is_valid() && is_wanted(login)).cloned().collect()
    }

    fn checked(&self, token: &WebToken<'_>) -> Result<UserLogin, String> {
        let claims = token.verify(&self.keys.known())?;
        let OidcSettings { issuer, audience, name_claim, groups_claim } = &self.settings;
        let expires = claims.check(issuer, audience, Utc::now().timestamp())?;
        Ok(UserLogin { name: user_name(&claims, name_claim)?, groups: claims.texts(groups_claim), expires })
    }

    fn remember(&self, hash: [u8; 32], login: UserLogin) {
        let mut logins = self.lock();
        if logins.len() >= MOST_LOGINS {
            logins.retain(|_, login| login.is_valid());
        }
        if logins.len() >= MOST_LOGINS {
            let first = logins.iter().min_by_key(|(_, login)| login.expires).map(|(hash, _)| *hash);
            first.map(|first| logins.remove(&first));
        }
        logins.insert(hash, login);
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<[u8; 32], UserLogin>> {
        self.logins.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl UserLogin {
    fn is_valid(&self) -> bool {
        Utc::now().timestamp() < self.expires
    }
}

fn user_name(claims: &TokenClaims, claim: &str) -> Result<String, String> {
    let name = claims.text(claim).ok_or_else(|| format!("it has no text `{claim}`"))?;
    if name.is_empty() || name.chars().count() > MOST_NAME_CHARS || name.chars().any(char::is_control) {
        return Err(format!("its `{claim}` is no name of up to {MOST_NAME_CHARS} characters"));
    }
    // Some providers let users enter any address.
    if claim == "email" && claims.flag("email_verified") != Some(true) {
        return Err("its `email` is not verified; hint: --oidc-name sub".to_owned());
    }
    Ok(name.to_owned())
}

// Keys that came over plain text would be anybody's.
fn check_address(address: &str) -> Result<Url, String> {
    let url = Url::parse(address).map_err(|e| format!("it is no address: {e}"))?;
    match url.scheme() {
        "https" => Ok(url),
        "http" if is_loopback_url(&url) => Ok(url),
        other => Err(format!("it is {other}, expected https")),
    }
}

// Whether it is of this machine, whatever a resolver says.
fn is_loopback_url(url: &Url) -> bool {
    match url.host() {
        Some(Host::Ipv4(address)) => address.is_loopback(),
        Some(Host::Ipv6(address)) => address.is_loopback(),
        Some(Host::Domain(name)) => name == "localhost",
        None => false,
    }
}

#[cfg(test)]
mod tests;
