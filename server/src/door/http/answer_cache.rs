//! Answers of the catalogue that the door gives again without an engine.
//!
//! An answer is given again to the client that received it, with the same rights, for as long as the version of the
//! lake is the one that the engine named in [`LASTING_VERSION`]. The log is looked at for each request, so that what
//! has been ingested before a request is in its answer. Engines name a version for whole answers only, never for
//! errors.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::body::{Body, to_bytes};
use axum::extract::Request;
use axum::http::{HeaderMap, Method, header};
use axum::response::{IntoResponse as _, Response};
use bytes::Bytes;
use echolake_http::{ConditionOutcome, LASTING_VERSION, accepts_encoding, prefers_arrow};
use echolake_lake::Lake;
use echolake_service::{ClientIdentity, RequestFault};
use hyper::body::Body as _;
use quick_cache::Weighter;
use quick_cache::sync::Cache;

/// Maximum size of all cached answers, and of one of them, bytes.
const CACHED_BYTES: u64 = 64 << 20;
const LARGEST_ANSWER: u64 = 1 << 20;
/// Bytes of an entry beside its body.
const ENTRY_BYTES: u64 = 2_000;
/// Time after which an engine is asked again, which notices that `optimize` has merged files.
const LONGEST: Duration = Duration::from_secs(30);

/// Cache of answers of all clients.
pub(crate) struct AnswerCache {
    lake: Lake,
    answers: Cache<AnswerKey, Arc<CachedAnswer>, AnswerWeighter>,
}

/// Everything that an answer depends on, the rights of its client apart.
#[derive(Clone, PartialEq, Eq, Hash)]
pub(crate) struct AnswerKey {
    client: String,
    address: String,
    as_arrow: bool,
    as_gzip: bool,
}

struct CachedAnswer {
    client: Arc<ClientIdentity>,
    version: u64,
    /// The tag of that version of the lake.
    tag: String,
    since: Instant,
    headers: HeaderMap,
    bytes: Bytes,
}

#[derive(Clone)]
struct AnswerWeighter;

impl Weighter<AnswerKey, Arc<CachedAnswer>> for AnswerWeighter {
    fn weight(&self, key: &AnswerKey, answer: &Arc<CachedAnswer>) -> u64 {
        (answer.bytes.len() + key.address.len()) as u64 + ENTRY_BYTES
    }
}

impl AnswerKey {
    /// The key of a client's request; None if its answer is not to be cached.
    pub fn from_request(client: &ClientIdentity, request: &Request) -> Option<Self> {
        let headers = request.headers();
        (*request.method() == Method::GET).then(|| Self {
            client: client.name.clone(),
            address: request.uri().path_and_query().map_or_else(String::new, ToString::to_string),
            as_arrow: prefers_arrow(headers),
            as_gzip: accepts_encoding(headers, "gzip"),
        })
    }
}

impl AnswerCache {
    pub fn new(lake: &Lake) -> Self {
        let answers = (CACHED_BYTES / ENTRY_BYTES) as usize;
        Self { lake: lake.clone(), answers: Cache::with_weighter(answers, CACHED_BYTES, AnswerWeighter) }
    }

    /// Finds the answer to a client's request with these headers.
    pub async fn find_answer(&self, client: &ClientIdentity, key: &AnswerKey, headers: &HeaderMap) -> Option<Response> {
        let cached = self.answers.get(key)?;
        let is_right = *cached.client == *client
            && cached.since.elapsed() < LONGEST
            && self.lake.newest_tag(cached.version).await.is_ok_and(|tag| tag.as_ref() == Some(&cached.tag));
        if !is_right {
            self.answers.remove(key);
            return None;
        }
        let etag = cached.headers.get(header::ETAG)?.to_str().ok()?;
        let early = ConditionOutcome::new(headers, etag).early_response(etag, [(header::ETAG, etag)]);
        Some(early.unwrap_or_else(|| (cached.headers.clone(), cached.bytes.clone()).into_response()))
    }

    /// Caches the answer to a client's request if its engine allows that, and returns it.
    ///
    /// # Errors
    /// [`RequestFault::Internal`] if the engine ended while it answered.
    pub async fn keep_answer(
        &self,
        client: Arc<ClientIdentity>,
        key: Option<AnswerKey>,
        mut response: Response,
    ) -> Result<Response, RequestFault> {
        let version = response.headers_mut().remove(LASTING_VERSION).and_then(|text| text.to_str().ok()?.parse().ok());
        // On an object store, a look at the log is a request: engines look once a second.
        let version = version.filter(|_| !self.lake.is_remote());
        let is_short = response.body().size_hint().upper().is_some_and(|bytes| bytes <= LARGEST_ANSWER);
        let (Some(version), Some(key), true) = (version, key, is_short) else { return Ok(response) };
        let Ok(Some(tag)) = self.lake.newest_tag(version).await else { return Ok(response) };
        let (mut parts, body) = response.into_parts();
        // The time of each answer is its own.
        parts.headers.remove(header::DATE);
        let bytes = to_bytes(body, LARGEST_ANSWER as usize).await;
        let bytes = bytes.map_err(RequestFault::defect("an engine broke off an answer"))?;
        let headers = parts.headers.clone();
        self.answers.insert(
            key,
            Arc::new(CachedAnswer { client, version, tag, since: Instant::now(), headers, bytes: bytes.clone() }),
        );
        Ok(Response::from_parts(parts, Body::from(bytes)))
    }
}

#[cfg(test)]
mod tests {
    use echolake_lake::ReferenceSurfaces;
    use echolake_schema::Rig;

    use super::*;

    #[tokio::test]
    async fn an_answer_is_its_clients_while_the_lake_stays_as_it_is() {
        let rig = Rig::paper();
        let lake = Lake::open_or_create("memory://", &rig, &ReferenceSurfaces::default()).await.expect("a lake");
        lake.ensure_tables().await.expect("tables");
        let cache = AnswerCache::new(&lake);
        let ann = ClientIdentity::local_client("ann");
        let bob = ClientIdentity::local_client("bob");
        let restricted = ClientIdentity { projects: Some(["ours".parse().expect("a name")].into()), ..ann.clone() };
        let key = |client: &ClientIdentity, accept: &str| {
            let request = Request::get("/api/v1/runs?limit=1").header(header::ACCEPT, accept).body(Body::empty());
            AnswerKey::from_request(client, &request.expect("a request")).expect("a key")
        };
        let keep = async |version: &str, bytes: usize| {
            let headers = [(LASTING_VERSION, version), (header::ETAG, "\"tag\"")];
            let answer = (headers, vec![7; bytes]).into_response();
            let kept = cache.keep_answer(Arc::new(ann.clone()), Some(key(&ann, "*/*")), answer).await.expect("whole");
            assert!(!kept.headers().contains_key(LASTING_VERSION));
            assert_eq!(to_bytes(kept.into_body(), usize::MAX).await.expect("bytes").len(), bytes);
        };
        let find = async |client: &ClientIdentity, key: &AnswerKey| {
            cache.find_answer(client, key, &HeaderMap::new()).await.is_some()
        };
        let own = key(&ann, "*/*");
        keep("0", 5).await;
        assert!(find(&ann, &own).await);
        assert!(!find(&bob, &key(&bob, "*/*")).await);
        assert!(!find(&ann, &key(&ann, "application/vnd.apache.arrow.stream")).await);
        assert!(!find(&restricted, &own).await, "the same name with other rights");
        assert!(!find(&ann, &own).await, "it has been removed with that");
        // Another version of the lake, none, and an answer that is too large.
        for (version, bytes) in [("7", 5), ("", 5), ("0", LARGEST_ANSWER as usize + 1)] {
            keep(version, bytes).await;
            assert!(!find(&ann, &own).await, "{version} {bytes}");
        }
        let post = Request::post("/api/v1/runs").body(Body::empty()).expect("a request");
        assert!(AnswerKey::from_request(&ann, &post).is_none());
    }
}
