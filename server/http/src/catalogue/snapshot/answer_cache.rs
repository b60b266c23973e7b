//! Cache of answers: each is computed once for all requests that wait for it, and packed once.

use std::future::Future;
use std::io::{self, Read as _};
use std::sync::{Arc, OnceLock};

use axum::body::to_bytes;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use bytes::Bytes;
use echolake_service::RequestFault;
use flate2::Compression;
use flate2::read::GzEncoder;
use quick_cache::Weighter;
use quick_cache::sync::Cache;

use crate::catalogue::content::ARROW;
use crate::format::accepts_encoding;
use crate::problem::ProblemResponse;

/// Maximum size of the cached answers of snapshots of one version, bytes.
const CACHED_BYTES: u64 = 96 << 20;
/// Shorter answers fit a packet or two as they are.
const WORTH_PACKING: usize = 2000;
/// Of zlib's levels: a tenth larger than with 6, in a third of the time.
const LEVEL: Compression = Compression::new(3);

/// An address with its parameters, whether the answer is an Arrow stream, whether its client may annotate, and the
/// version of what the answer rests on. The cache is of clients with the same rights to see runs.
pub(crate) type AnswerKey = (String, bool, bool, String);

/// Cache of answers of snapshots of one version.
pub(crate) struct AnswerCache(Cache<AnswerKey, Arc<CachedAnswer>, AnswerWeighter>);

/// Weighs answers by their bytes, with those that they will have once they are packed, too.
#[derive(Clone)]
struct AnswerWeighter;

impl Weighter<AnswerKey, Arc<CachedAnswer>> for AnswerWeighter {
    fn weight(&self, (address, ..): &AnswerKey, answer: &Arc<CachedAnswer>) -> u64 {
        (answer.bytes.len() * 3 / 2 + address.len() + 1000) as u64
    }
}

impl Default for AnswerCache {
    fn default() -> Self {
        // So few items are one shard, in which an answer may take all the room.
        Self(Cache::with_weighter(32, CACHED_BYTES, AnswerWeighter))
    }
}

impl AnswerCache {
    /// Returns the answer for a key; `make` runs if it is neither cached nor being made by another request.
    ///
    /// # Errors
    /// What `make` answers instead of 200, which is not cached.
    pub async fn get_or_make(
        &self,
        key: &AnswerKey,
        make: impl Future<Output = Response>,
    ) -> Result<Arc<CachedAnswer>, Response> {
        let make = async { CachedAnswer::from_response(make.await).await.map(Arc::new) };
        self.0.get_or_insert_async(key, make).await
    }
}

/// An answer, without the headers that depend on the request.
pub(crate) struct CachedAnswer {
    headers: HeaderMap,
    bytes: Bytes,
    /// None if it cannot be packed.
    packed: OnceLock<Option<Bytes>>,
}

impl CachedAnswer {
    async fn from_response(response: Response) -> Result<Self, Response> {
        if response.status() != StatusCode::OK {
            return Err(response);
        }
        let (mut parts, body) = response.into_parts();
        parts.headers.remove(header::CONTENT_LENGTH);
        match to_bytes(body, usize::MAX).await {
            Ok(bytes) => Ok(Self { headers: parts.headers, bytes, packed: OnceLock::new() }),
            Err(e) => Err(ProblemResponse(RequestFault::defect("an answer broke off")(e)).into_response()),
        }
    }

    /// Returns the response to a request with these headers.
    pub fn to_response(&self, request: &HeaderMap) -> Response {
        let packs = self.headers.get(header::CONTENT_TYPE).is_some_and(is_packable);
        let is_worth = packs && self.bytes.len() >= WORTH_PACKING && accepts_encoding(request, "gzip");
        let packed = is_worth.then(|| self.packed.get_or_init(|| pack_gzip(&self.bytes).ok()).clone());
        match packed.flatten() {
            Some(packed) => (self.headers.clone(), [(header::CONTENT_ENCODING, "gzip")], packed).into_response(),
            None => (self.headers.clone(), self.bytes.clone()).into_response(),
        }
    }
}

// Pictures and meshes are packed already.
fn is_packable(media_type: &HeaderValue) -> bool {
    ["application/json", "application/octet-stream", ARROW].contains(&media_type.to_str().unwrap_or_default())
}

fn pack_gzip(bytes: &[u8]) -> io::Result<Bytes> {
    let mut packed = Vec::new();
    GzEncoder::new(bytes, LEVEL).read_to_end(&mut packed)?;
    Ok(packed.into())
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use flate2::read::GzDecoder;

    use super::*;
    use crate::catalogue::content::AnswerContent;

    fn key(name: &str) -> AnswerKey {
        (name.to_owned(), false, false, String::new())
    }

    fn answer(bytes: impl Into<Bytes>) -> Response {
        AnswerContent::new("application/json", bytes).into_response()
    }

    #[tokio::test]
    async fn an_answer_is_made_once_and_a_failure_again() {
        let answers = AnswerCache::default();
        let made = AtomicUsize::new(0);
        let make = || async {
            made.fetch_add(1, Ordering::Relaxed);
            tokio::task::yield_now().await;
            answer("x")
        };
        let same = key("a");
        let (a, b) = tokio::join!(answers.get_or_make(&same, make()), answers.get_or_make(&same, make()));
        assert!(Arc::ptr_eq(&a.expect("made"), &b.expect("the same")));
        assert_eq!(made.load(Ordering::Relaxed), 1);
        let failing = async { ProblemResponse(RequestFault::Internal).into_response() };
        let failed = answers.get_or_make(&key("b"), failing).await;
        assert_eq!(failed.err().expect("a failure").status(), StatusCode::INTERNAL_SERVER_ERROR);
        assert!(answers.get_or_make(&key("b"), make()).await.is_ok());
    }

    #[tokio::test]
    async fn a_request_that_is_dropped_leaves_its_work_to_the_next() {
        let answers = AnswerCache::default();
        let c = key("c");
        let mut first = Box::pin(answers.get_or_make(&c, std::future::pending()));
        assert!(futures::poll!(&mut first).is_pending());
        let mut second = Box::pin(answers.get_or_make(&c, async { answer("x") }));
        assert!(futures::poll!(&mut second).is_pending());
        drop(first);
        assert!(second.await.is_ok());
    }

    #[tokio::test]
    async fn cached_bytes_are_bounded() {
        let answers = AnswerCache::default();
        for i in 0..60 {
            assert!(answers.get_or_make(&key(&i.to_string()), async { answer(vec![0; 4 << 20]) }).await.is_ok());
            assert!(answers.0.weight() <= CACHED_BYTES);
        }
        assert!(answers.0.len() > 10);
        let too_large = key("too large");
        let too_large = answers.get_or_make(&too_large, async { answer(vec![0; CACHED_BYTES as usize]) });
        assert_eq!(too_large.await.expect("an answer").bytes.len(), CACHED_BYTES as usize);
        assert!(answers.0.weight() <= CACHED_BYTES);
    }

    #[tokio::test]
    async fn long_answers_are_packed_for_those_who_take_it() {
        let accepting =
            |value: &str| HeaderMap::from_iter([(header::ACCEPT_ENCODING, value.parse().expect("a value"))]);
        let cached = CachedAnswer::from_response(answer(vec![b'7'; 5000])).await.expect("an answer");
        let packed = cached.to_response(&accepting("br, gzip;q=0.9"));
        assert_eq!(packed.headers()[header::CONTENT_ENCODING], "gzip");
        let packed = to_bytes(packed.into_body(), usize::MAX).await.expect("bytes");
        assert!(packed.len() < 100);
        let mut plain = Vec::new();
        GzDecoder::new(&packed[..]).read_to_end(&mut plain).expect("gzip");
        assert_eq!(plain, cached.bytes);
        for other in ["identity", "gzip;q=0", "br"] {
            assert!(!cached.to_response(&accepting(other)).headers().contains_key(header::CONTENT_ENCODING), "{other}");
        }
        let picture = AnswerContent::new("image/png", vec![0; 5000]).into_response();
        let picture = CachedAnswer::from_response(picture).await.expect("an answer");
        assert!(!picture.to_response(&accepting("gzip")).headers().contains_key(header::CONTENT_ENCODING));
    }
}
