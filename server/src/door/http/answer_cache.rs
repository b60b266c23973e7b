//! Answers of the catalogue that the door gives again without an engine, to every client with the same rights.
//!
//! An answer is given again for as long as the version of the lake is the one that the engine named in
//! [`LASTING_VERSION`]. The log is looked at for each request, so that what has been ingested before a request is in its
//! answer. Once the version has changed, the engine is shown the answer's tag: if nothing that the answer rests on has
//! changed, it says so instead of computing it again. Engines name a version for whole answers only, never for errors.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::{Duration, Instant};

use axum::body::{Body, to_bytes};
use axum::extract::Request;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use bytes::Bytes;
use echolake_http::{ConditionOutcome, LASTING_VERSION, accepts_encoding, prefers_arrow};
use echolake_lake::Lake;
use echolake_service::{ClientIdentity, RequestFault};
use hyper::body::Body as _;
use quick_cache::Weighter;
use quick_cache::sync::Cache;
use tokio::sync::OwnedMutexGuard;

/// Maximum size of all cached answers, and of one of them, bytes.
const CACHED_BYTES: u64 = 96 << 20;
const LARGEST_ANSWER: u64 = 16 << 20;
/// Bytes of an entry beside its body.
const ENTRY_BYTES: u64 = 2_000;
/// Time after which an engine is asked again, which notices that `optimize` has merged files.
const LONGEST: Duration = Duration::from_secs(30);
/// Time for which a look at the log is good, if the lake is on an object store: there it is a request.
const REMOTE_CHECK_LASTS: Duration = Duration::from_secs(1);

/// Cache of answers of all clients.
pub(crate) struct AnswerCache {
    lake: Lake,
    answers: Cache<AnswerKey, Arc<CachedAnswer>, AnswerWeighter>,
    /// Held while an answer is computed: others who want it wait for it.
    computing: Mutex<HashMap<AnswerKey, Weak<tokio::sync::Mutex<()>>>>,
    /// The version of the lake that was last found to be the newest, with its tag.
    checked: Mutex<Option<(Instant, u64, String)>>,
}

/// Everything that an answer depends on.
#[derive(Clone, PartialEq, Eq, Hash)]
pub(crate) struct AnswerKey {
    rights: Arc<str>,
    address: String,
    as_arrow: bool,
    as_gzip: bool,
}

struct CachedAnswer {
    /// The version of the lake, its tag, and when an engine last said that the answer is right in it.
    version: u64,
    tag: String,
    since: Instant,
    etag: HeaderValue,
    headers: HeaderMap,
    bytes: Bytes,
}

/// What the cache has for a request.
pub(crate) enum CachedOutcome {
    /// The answer.
    Answer(Response),
    /// The tag of an answer that was right in another version of the lake.
    Outdated(HeaderValue),
    /// Nothing.
    Nothing,
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
            rights: client.rights_text().into(),
            address: request.uri().path_and_query().map_or_else(String::new, ToString::to_string),
            as_arrow: prefers_arrow(headers),
            as_gzip: accepts_encoding(headers, "gzip"),
        })
    }
}

impl CachedAnswer {
    fn to_response(&self, headers: &HeaderMap) -> Response {
        let etag = self.etag.to_str().unwrap_or_default();
        let early = ConditionOutcome::new(headers, etag).early_response(etag, [(header::ETAG, etag)]);
        early.unwrap_or_else(|| (self.headers.clone(), self.bytes.clone()).into_response())
    }
}

impl AnswerCache {
    pub fn new(lake: &Lake) -> Self {
        let answers = (CACHED_BYTES / ENTRY_BYTES) as usize;
        Self {
            lake: lake.clone(),
            answers: Cache::with_weighter(answers, CACHED_BYTES, AnswerWeighter),
            computing: Mutex::default(),
            checked: Mutex::default(),
        }
    }

    /// Finds the answer to a request with these headers.
    pub async fn find_answer(&self, key: &AnswerKey, headers: &HeaderMap) -> CachedOutcome {
        let Some(cached) = self.answers.get(key) else { return CachedOutcome::Nothing };
        match cached.since.elapsed() < LONGEST && self.is_newest(cached.version, &cached.tag).await {
            true => CachedOutcome::Answer(cached.to_response(headers)),
            false => CachedOutcome::Outdated(cached.etag.clone()),
        }
    }

    /// Waits until nobody else computes this answer.
    pub async fn computing_turn(&self, key: &AnswerKey) -> OwnedMutexGuard<()> {
        let turn = {
            let mut computing = self.computing.lock().unwrap_or_else(PoisonError::into_inner);
            match computing.get(key).and_then(Weak::upgrade) {
                Some(turn) => turn,
                None => {
                    computing.retain(|_, turn| turn.strong_count() > 0);
                    let turn = Arc::new(tokio::sync::Mutex::new(()));
                    computing.insert(key.clone(), Arc::downgrade(&turn));
                    turn
                }
            }
        };
        turn.lock_owned().await
    }

    /// Forgets which version of the lake is the newest: one was just added.
    pub fn expire_check(&self) {
        *self.checked.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }

    async fn is_newest(&self, version: u64, tag: &str) -> bool {
        if self.lake.is_remote()
            && let Some((at, newest, known)) = &*self.checked.lock().unwrap_or_else(PoisonError::into_inner)
            && at.elapsed() < REMOTE_CHECK_LASTS
        {
            return (*newest, known.as_str()) == (version, tag);
        }
        self.newest_tag(version).await.as_deref() == Some(tag)
    }

    // The tag of a version, if it is the newest.
    async fn newest_tag(&self, version: u64) -> Option<String> {
        let tag = self.lake.newest_tag(version).await.ok().flatten()?;
        *self.checked.lock().unwrap_or_else(PoisonError::into_inner) = Some((Instant::now(), version, tag.clone()));
        Some(tag)
    }

    /// Caches the answer to a client's request with these headers if its engine allows that, and returns it. An engine
    /// that was shown the tag of a cached answer may say that this is still right.
    ///
    /// # Errors
    /// [`RequestFault::Internal`] if the engine ended while it answered.
    pub async fn keep_answer(
        &self,
        key: Option<&AnswerKey>,
        headers: &HeaderMap,
        mut response: Response,
    ) -> Result<Response, RequestFault> {
        let version = response.headers_mut().remove(LASTING_VERSION).and_then(|text| text.to_str().ok()?.parse().ok());
        let (Some(version), Some(key)) = (version, key) else { return Ok(response) };
        if response.status() == StatusCode::NOT_MODIFIED {
            return Ok(self.renew_answer(key, headers, version, response).await);
        }
        let is_short = response.body().size_hint().upper().is_some_and(|bytes| bytes <= LARGEST_ANSWER);
        let etag = response.headers().get(header::ETAG).cloned();
        let (StatusCode::OK, true, Some(etag)) = (response.status(), is_short, etag) else { return Ok(response) };
        let Some(tag) = self.newest_tag(version).await else { return Ok(response) };
        let (mut parts, body) = response.into_parts();
        // The time of each answer is its own.
        parts.headers.remove(header::DATE);
        let bytes = to_bytes(body, LARGEST_ANSWER as usize).await;
        let bytes = bytes.map_err(RequestFault::defect("an engine broke off an answer"))?;
        let headers = parts.headers.clone();
        let since = Instant::now();
        self.answers
            .insert(key.clone(), Arc::new(CachedAnswer { version, tag, since, etag, headers, bytes: bytes.clone() }));
        Ok(Response::from_parts(parts, Body::from(bytes)))
    }

    // The cached answer, if the tag that the engine says is still right is its own.
    async fn renew_answer(&self, key: &AnswerKey, headers: &HeaderMap, version: u64, unchanged: Response) -> Response {
        let cached = self.answers.get(key).filter(|cached| unchanged.headers().get(header::ETAG) == Some(&cached.etag));
        let Some(cached) = cached else { return unchanged };
        if let Some(tag) = self.newest_tag(version).await {
            let (etag, headers, bytes) = (cached.etag.clone(), cached.headers.clone(), cached.bytes.clone());
            let renewed = CachedAnswer { version, tag, since: Instant::now(), etag, headers, bytes };
            self.answers.insert(key.clone(), Arc::new(renewed));
        }
        cached.to_response(headers)
    }
}

#[cfg(test)]
mod tests {
    use echolake_lake::ReferenceSurfaces;
    use echolake_schema::Rig;

    use super::*;

    const ANSWER: &str = "\"tag\"";

    async fn empty_cache() -> AnswerCache {
        let lake =
            Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await.expect("a lake");
        lake.ensure_tables().await.expect("tables");
        AnswerCache::new(&lake)
    }

    fn key_of(client: &ClientIdentity, accept: &str) -> AnswerKey {
        let request = Request::get("/api/v1/runs?limit=1").header(header::ACCEPT, accept).body(Body::empty());
        AnswerKey::from_request(client, &request.expect("a request")).expect("a key")
    }

    async fn keep(cache: &AnswerCache, key: &AnswerKey, version: &str, bytes: usize) {
        let headers = [(LASTING_VERSION, version), (header::ETAG, ANSWER)];
        let answer = (headers, vec![7; bytes]).into_response();
        let kept = cache.keep_answer(Some(key), &HeaderMap::new(), answer).await.expect("whole");
        assert!(!kept.headers().contains_key(LASTING_VERSION));
        assert_eq!(to_bytes(kept.into_body(), usize::MAX).await.expect("bytes").len(), bytes);
    }

    async fn has_answer(cache: &AnswerCache, key: &AnswerKey) -> bool {
        matches!(cache.find_answer(key, &HeaderMap::new()).await, CachedOutcome::Answer(_))
    }

    #[tokio::test]
    async fn an_answer_is_for_all_with_the_same_rights_while_the_lake_stays_as_it_is() {
        let cache = empty_cache().await;
        let token = |name: &str| ClientIdentity { is_open: false, ..ClientIdentity::local_client(name) };
        let ann = token("ann");
        let restricted = ClientIdentity { projects: Some(["ours".parse().expect("a name")].into()), ..ann.clone() };
        let fewer = ClientIdentity { scopes: vec![echolake_service::TokenScope::Sql], ..ann.clone() };
        let own = key_of(&ann, "*/*");
        keep(&cache, &own, "0", 5).await;
        assert!(has_answer(&cache, &own).await);
        assert!(has_answer(&cache, &key_of(&token("bob"), "*/*")).await);
        assert!(!has_answer(&cache, &key_of(&ann, "application/vnd.apache.arrow.stream")).await);
        for other in [restricted, fewer, ClientIdentity::own_pages()] {
            assert!(!has_answer(&cache, &key_of(&other, "*/*")).await, "{other:?}");
        }
        let [pages, foreign] =
            [ClientIdentity::own_pages(), ClientIdentity::foreign_pages()].map(|c| key_of(&c, "*/*"));
        keep(&cache, &pages, "0", 5).await;
        assert!(has_answer(&cache, &pages).await && !has_answer(&cache, &foreign).await, "a page of elsewhere");
        let post = Request::post("/api/v1/runs").body(Body::empty()).expect("a request");
        assert!(AnswerKey::from_request(&ann, &post).is_none());
    }

    #[tokio::test]
    async fn answers_of_other_versions_and_large_ones_are_not_kept() {
        let cache = empty_cache().await;
        let own = key_of(&ClientIdentity::local_client("ann"), "*/*");
        for (version, bytes) in [("7", 5), ("", 5), ("0", LARGEST_ANSWER as usize + 1)] {
            keep(&cache, &own, version, bytes).await;
            assert!(!has_answer(&cache, &own).await, "{version} {bytes}");
        }
    }

    #[tokio::test]
    async fn an_outdated_answer_is_renewed_by_its_tag() {
        let cache = empty_cache().await;
        let own = key_of(&ClientIdentity::local_client("ann"), "*/*");
        keep(&cache, &own, "0", 5).await;
        let cached = cache.answers.get(&own).expect("kept");
        let outdated = CachedAnswer {
            version: 0,
            tag: "of another lake".to_owned(),
            since: cached.since,
            etag: cached.etag.clone(),
            headers: cached.headers.clone(),
            bytes: cached.bytes.clone(),
        };
        cache.answers.insert(own.clone(), Arc::new(outdated));
        let CachedOutcome::Outdated(tag) = cache.find_answer(&own, &HeaderMap::new()).await else { panic!("outdated") };
        assert_eq!(tag, ANSWER);
        let unchanged = |tag: &'static str| {
            (StatusCode::NOT_MODIFIED, [(LASTING_VERSION, "0"), (header::ETAG, tag)]).into_response()
        };
        let other = cache.keep_answer(Some(&own), &HeaderMap::new(), unchanged("\"x\"")).await.expect("an answer");
        assert_eq!(other.status(), StatusCode::NOT_MODIFIED, "it is another answer's");
        let renewed = cache.keep_answer(Some(&own), &HeaderMap::new(), unchanged(ANSWER)).await.expect("an answer");
        assert_eq!(renewed.status(), StatusCode::OK);
        assert!(has_answer(&cache, &own).await);
    }

    #[tokio::test]
    async fn one_request_computes_an_answer_and_the_others_wait_for_it() {
        let cache = empty_cache().await;
        let own = key_of(&ClientIdentity::local_client("ann"), "*/*");
        let turn = cache.computing_turn(&own).await;
        let mut second = Box::pin(cache.computing_turn(&own));
        assert!(futures::poll!(&mut second).is_pending());
        drop(turn);
        drop(second.await);
        assert!(cache.computing.lock().expect("no panic").values().all(|turn| turn.strong_count() == 0));
    }
}
