//! A provider's keys: found by its discovery document, fetched from time to time, and when a token names one that is not
//! known. A provider that is away leaves its keys in use for a day.

use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, Instant};

use reqwest::redirect::Policy;
use reqwest::{Client, StatusCode};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use tokio::sync::{Notify, watch};
use url::Url;

use super::check_address;
use super::web_token::{KeyDocument, SigningKey, WebToken};

/// Path of the discovery document below the issuer.
const DISCOVERY: &str = "/.well-known/openid-configuration";
/// Time between two looks, if none is asked for.
const LOOK_EVERY: Duration = Duration::from_secs(300);
/// Time for which keys are used without the provider.
const KEPT: Duration = Duration::from_secs(24 * 3600);
/// Time limit for an answer of the provider, and for a token's wait for its key.
const ANSWER: Duration = Duration::from_secs(10);
const WAIT: Duration = Duration::from_secs(5);
/// Bytes of a document.
const LARGEST: usize = 1 << 20;

/// The keys of a provider.
pub(super) struct ProviderKeys {
    issuer: String,
    client: Client,
    fetched: RwLock<Option<FetchedKeys>>,
    /// Least time between two looks.
    pause: Duration,
    wanted: Notify,
    /// The end of the last look.
    looked: watch::Sender<Option<Instant>>,
}

struct FetchedKeys {
    at: Instant,
    keys: Arc<Vec<SigningKey>>,
}

/// The part of the discovery document that is used.
#[derive(Deserialize)]
struct ProviderDocument {
    issuer: String,
    jwks_uri: String,
}

/// The reason for which keys are not fetched.
#[derive(Debug, thiserror::Error)]
enum FetchError {
    #[error("the provider does not answer")]
    Request(#[from] reqwest::Error),
    #[error("`{url}` is answered by {status}, expected 200")]
    Status { url: String, status: StatusCode },
    #[error("`{url}` has more than {LARGEST} bytes")]
    TooLarge { url: String },
    #[error("`{url}` is not the expected document")]
    Document { url: String, source: serde_json::Error },
    #[error("the document is of the issuer `{found}`; hint: --oidc with that address, if it is right")]
    Issuer { found: String },
    #[error("the address of the keys, `{url}`, cannot be used: {message}")]
    Address { url: String, message: String },
    #[error("`{url}` has no key for RS256 or ES256")]
    NoKeys { url: String },
}

impl ProviderKeys {
    /// None so far.
    ///
    /// # Errors
    /// The HTTP client cannot be made.
    pub(super) fn new(issuer: &str, address: &Url, pause: Duration) -> Result<Self, reqwest::Error> {
        let builder = Client::builder().timeout(ANSWER).redirect(Policy::none());
        // A proxy does not reach this machine's own provider.
        let builder = if address.scheme() == "http" { builder.no_proxy() } else { builder };
        Ok(Self {
            issuer: issuer.to_owned(),
            client: builder.build()?,
            fetched: RwLock::default(),
            pause,
            wanted: Notify::new(),
            looked: watch::Sender::new(None),
        })
    }

    /// Returns the keys that may be used.
    pub(super) fn known(&self) -> Arc<Vec<SigningKey>> {
        let fetched = self.fetched.read().unwrap_or_else(PoisonError::into_inner);
        fetched.as_ref().filter(|fetched| fetched.at.elapsed() < KEPT).map_or_else(Arc::default, |f| f.keys.clone())
    }

    /// Waits for a look at the provider, if no known key is a token's and the last look is not of this moment.
    pub(super) async fn await_key(&self, token: &WebToken<'_>) {
        // A provider that gives its keys no names changes them all the same.
        if token.verify(&self.known()).is_ok() {
            return;
        }
        let mut looked = self.looked.subscribe();
        if looked.borrow_and_update().is_some_and(|at| at.elapsed() < self.pause) {
            return;
        }
        self.wanted.notify_one();
        // Whether the key is there is found out by whoever checks the token.
        let _ = tokio::time::timeout(WAIT, looked.changed()).await;
    }

    /// Fetches keys from time to time; never ends.
    pub(super) async fn keep_up(&self) {
        loop {
            let next = match self.fetch().await {
                Ok(keys) => {
                    tracing::debug!(
                        keys = keys.len(),
                        issuer = self.issuer,
                        "the identity provider's keys were fetched"
                    );
                    let fetched = FetchedKeys { at: Instant::now(), keys: Arc::new(keys) };
                    *self.fetched.write().unwrap_or_else(PoisonError::into_inner) = Some(fetched);
                    LOOK_EVERY
                }
                Err(e) => {
                    let error = &e as &dyn std::error::Error;
                    tracing::warn!(error, issuer = self.issuer, "the identity provider's keys stay as they were");
                    Duration::ZERO
                }
            };
            self.looked.send_replace(Some(Instant::now()));
            tokio::time::sleep(self.pause).await;
            let _ = tokio::time::timeout(next, self.wanted.notified()).await;
        }
    }

    async fn fetch(&self) -> Result<Vec<SigningKey>, FetchError> {
        let address = format!("{}{DISCOVERY}", self.issuer.trim_end_matches('/'));
        let document: ProviderDocument = self.get(&address).await?;
        if document.issuer != self.issuer {
            return Err(FetchError::Issuer { found: document.issuer });
        }
        let url = document.jwks_uri;
        check_address(&url).map_err(|message| FetchError::Address { url: url.clone(), message })?;
        let keys = self.get::<KeyDocument>(&url).await?.signing_keys();
        match keys.is_empty() {
            true => Err(FetchError::NoKeys { url }),
            false => Ok(keys),
        }
    }

    async fn get<T: DeserializeOwned>(&self, url: &str) -> Result<T, FetchError> {
        let mut response = self.client.get(url).send().await?;
        if response.status() != StatusCode::OK {
            return Err(FetchError::Status { url: url.to_owned(), status: response.status() });
        }
        let mut document = Vec::new();
        while let Some(part) = response.chunk().await? {
            document.extend_from_slice(&part);
            if document.len() > LARGEST {
                return Err(FetchError::TooLarge { url: url.to_owned() });
            }
        }
        serde_json::from_slice(&document).map_err(|source| FetchError::Document { url: url.to_owned(), source })
    }
}
