//! A store whose answers may be cut off or lost: what can be repeated is repeated.
//!
//! The client below repeats requests that a store answered with a fault of its own, and resumes bodies of objects where
//! the store lets it. It gives up on a listing that is cut off and on a body that cannot be resumed, and it repeats
//! nothing that was sent without an answer, unless that is safe. Here reads, listings, overwrites and deletions are
//! repeated. A creation without an answer is looked up: if the object is there with the same content, it was made. What
//! is created must therefore be unlike what others create under its name, or its author must not care who made it.

use std::error::Error;
use std::fmt;
use std::iter;
use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use bytes::Bytes;
use futures::stream::{self, BoxStream};
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::path::Path;
use object_store::{
    CopyMode, CopyOptions, Error as StoreError, GetOptions, GetResult, GetResultPayload, ListResult, MultipartUpload,
    ObjectMeta, ObjectStore, PutMode, PutMultipartOptions, PutOptions, PutPayload, PutResult, Result as StoreResult,
};
use uuid::Uuid;

/// Tries of one operation whose outcome is unknown, those of the client below among them, unless the environment says
/// another number.
pub(super) const RETRY_LIMIT: u32 = 11;
/// Time after which no further try begins: what failed so late was repeated by the client below.
const RETRY_FOR: Duration = Duration::from_secs(20);
/// Time after the first failure; it doubles with each further one.
const FIRST_BACKOFF: Duration = Duration::from_millis(100);
const LONGEST_BACKOFF: Duration = Duration::from_secs(5);
/// A body up to this size is fetched as a whole, so that it can be fetched again.
const WHOLE_BODY: u64 = 16 << 20;

/// An operation that failed each time.
#[derive(Debug, thiserror::Error)]
#[error("{source}")]
pub(crate) struct RetriedError {
    pub tries: u32,
    pub source: StoreError,
}

/// Time to wait after this many failures, half of it by chance, so that writers that met once do not meet again.
pub(crate) fn backoff_time(failures: u32) -> Duration {
    let longest = FIRST_BACKOFF.saturating_mul(1 << failures.saturating_sub(1).min(10)).min(LONGEST_BACKOFF);
    let chance = (Uuid::new_v4().as_u128() >> 96) as f64 / f64::from(u32::MAX);
    longest.mul_f64(0.5 + chance / 2.0)
}

/// Returns whether an error leaves open if the operation was done, and if it would succeed another time.
fn may_have_happened(error: &StoreError) -> bool {
    matches!(error, StoreError::Generic { .. } | StoreError::JoinError { .. }) && !is_forbidden(error)
}

/// Returns whether the store refused the client's credentials: the same request is refused again. Of some requests the
/// client below says so in its text alone.
pub(crate) fn is_forbidden(error: &StoreError) -> bool {
    if matches!(error, StoreError::PermissionDenied { .. } | StoreError::Unauthenticated { .. }) {
        return true;
    }
    let is_refusal = |text: &str| ["status code: 401", "status code: 403"].iter().any(|status| text.contains(status));
    list_causes(error).any(|cause| is_refusal(&cause.to_string()))
}

/// Returns the number of requests that an error stands for: the client below says in its text how often it retried.
pub(crate) fn count_requests(error: &StoreError) -> u32 {
    let retries =
        |text: &str| text.split_once(", after ")?.1.split_once(" retries, max_retries")?.0.parse::<u32>().ok();
    list_causes(error).filter_map(|cause| retries(&cause.to_string())).max().unwrap_or(0) + 1
}

/// Returns an error and its causes.
pub(crate) fn list_causes(error: &StoreError) -> impl Iterator<Item = &(dyn Error + 'static)> {
    let mut next: Option<&(dyn Error + 'static)> = Some(error);
    iter::from_fn(move || {
        let cause = next?;
        next = cause.source();
        Some(cause)
    })
}

/// A store over another one, as described above.
#[derive(Debug)]
pub(crate) struct RetryingStore {
    inner: Arc<dyn ObjectStore>,
    /// Tries of one operation.
    limit: u32,
}

impl RetryingStore {
    pub fn new(inner: Arc<dyn ObjectStore>, limit: u32) -> Self {
        Self { inner, limit }
    }
}

/// Repeats an operation that may be repeated until it succeeds, fails for good, or was tried too often.
pub(super) async fn retry_operation<T, F: Future<Output = StoreResult<T>>>(
    limit: u32,
    work: impl Fn() -> F,
) -> StoreResult<T> {
    let begun = Instant::now();
    let mut failures = 0;
    let mut tries = 0;
    loop {
        let error = match work().await {
            Err(error) if may_have_happened(&error) => error,
            done => return done,
        };
        failures += 1;
        tries += count_requests(&error);
        if tries >= limit || begun.elapsed() >= RETRY_FOR {
            return Err(given_up(tries, error));
        }
        tokio::time::sleep(backoff_time(failures)).await;
    }
}

fn given_up(tries: u32, source: StoreError) -> StoreError {
    StoreError::Generic { store: "remote", source: Box::new(RetriedError { tries, source }) }
}

// The object may be there because of an own try that was not answered, and it may be absent though the store says that
// it is there: some refuse both of two that meet.
async fn put_new(
    inner: &dyn ObjectStore,
    location: &Path,
    payload: &PutPayload,
    opts: &PutOptions,
    limit: u32,
) -> StoreResult<PutResult> {
    let begun = Instant::now();
    let mut tries = 1;
    loop {
        let error = match inner.put_opts(location, payload.clone(), opts.clone()).await {
            Err(error) if may_have_happened(&error) || matches!(error, StoreError::AlreadyExists { .. }) => error,
            done => return done,
        };
        let there = || async { inner.get_opts(location, GetOptions::default()).await?.bytes().await };
        match retry_operation(limit, there).await {
            Ok(there) if there == Bytes::from(payload.clone()) => return Ok(PutResult { e_tag: None, version: None }),
            Ok(_) => return Err(StoreError::AlreadyExists { path: location.to_string(), source: Box::new(error) }),
            Err(StoreError::NotFound { .. }) if tries < limit && begun.elapsed() < RETRY_FOR => {
                tokio::time::sleep(backoff_time(tries)).await;
            }
            Err(_) => return Err(given_up(tries, error)),
        }
        tries += 1;
    }
}

// Fetches a body of moderate size as a whole.
async fn get_whole(inner: &dyn ObjectStore, location: &Path, options: GetOptions) -> StoreResult<GetResult> {
    let has_body = !options.head;
    let found = inner.get_opts(location, options).await?;
    if !has_body || found.range.end - found.range.start > WHOLE_BODY {
        return Ok(found);
    }
    let GetResult { payload, meta, range, attributes, .. } = found;
    let GetResultPayload::Stream(body) = payload else {
        return Ok(GetResult { payload, meta, range, attributes });
    };
    let parts: Vec<Bytes> = body.try_collect().await?;
    let length: usize = parts.iter().map(Bytes::len).sum();
    if length as u64 != range.end - range.start {
        let source = format!("{length} bytes came of {}", range.end - range.start).into();
        return Err(StoreError::Generic { store: "remote", source });
    }
    let payload = GetResultPayload::Stream(stream::iter(parts.into_iter().map(Ok)).boxed());
    Ok(GetResult { payload, meta, range, attributes })
}

// A stream of what comes as a whole.
fn stream_of<T: Send + 'static>(
    whole: impl Future<Output = StoreResult<Vec<T>>> + Send + 'static,
) -> BoxStream<'static, StoreResult<T>> {
    stream::once(whole).map_ok(|whole| stream::iter(whole.into_iter().map(Ok))).try_flatten().boxed()
}

impl fmt::Display for RetryingStore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.inner.fmt(f)
    }
}

#[async_trait]
impl ObjectStore for RetryingStore {
    async fn put_opts(&self, location: &Path, payload: PutPayload, opts: PutOptions) -> StoreResult<PutResult> {
        match opts.mode {
            PutMode::Overwrite => {
                retry_operation(self.limit, || self.inner.put_opts(location, payload.clone(), opts.clone())).await
            }
            PutMode::Create => put_new(self.inner.as_ref(), location, &payload, &opts, self.limit).await,
            PutMode::Update(_) => self.inner.put_opts(location, payload, opts).await,
        }
    }

    async fn put_multipart_opts(
        &self,
        location: &Path,
        opts: PutMultipartOptions,
    ) -> StoreResult<Box<dyn MultipartUpload>> {
        retry_operation(self.limit, || self.inner.put_multipart_opts(location, opts.clone())).await
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> StoreResult<GetResult> {
        retry_operation(self.limit, || get_whole(self.inner.as_ref(), location, options.clone())).await
    }

    async fn get_ranges(&self, location: &Path, ranges: &[Range<u64>]) -> StoreResult<Vec<Bytes>> {
        retry_operation(self.limit, || self.inner.get_ranges(location, ranges)).await
    }

    fn delete_stream(&self, locations: BoxStream<'static, StoreResult<Path>>) -> BoxStream<'static, StoreResult<Path>> {
        let inner = self.inner.clone();
        let limit = self.limit;
        let delete = async move {
            let locations: Vec<Path> = locations.try_collect().await?;
            // One that is gone already counts as deleted: the answer to its deletion may have been lost.
            let all = || async {
                let named: Vec<_> = locations.iter().cloned().map(Ok).collect();
                let mut done = inner.delete_stream(stream::iter(named).boxed());
                while let Some(deleted) = done.next().await {
                    match deleted {
                        Ok(_) | Err(StoreError::NotFound { .. }) => {}
                        Err(failed) => return Err(failed),
                    }
                }
                Ok(())
            };
            retry_operation(limit, all).await.map(|()| locations)
        };
        stream_of(delete)
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, StoreResult<ObjectMeta>> {
        let inner = self.inner.clone();
        let limit = self.limit;
        let prefix = prefix.cloned();
        stream_of(async move { retry_operation(limit, || inner.list(prefix.as_ref()).try_collect()).await })
    }

    fn list_with_offset(&self, prefix: Option<&Path>, offset: &Path) -> BoxStream<'static, StoreResult<ObjectMeta>> {
        let inner = self.inner.clone();
        let limit = self.limit;
        let prefix = prefix.cloned();
        let offset = offset.clone();
        stream_of(async move {
            retry_operation(limit, || inner.list_with_offset(prefix.as_ref(), &offset).try_collect()).await
        })
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> StoreResult<ListResult> {
        retry_operation(self.limit, || self.inner.list_with_delimiter(prefix)).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> StoreResult<()> {
        match options.mode {
            CopyMode::Overwrite => {
                retry_operation(self.limit, || self.inner.copy_opts(from, to, options.clone())).await
            }
            CopyMode::Create => self.inner.copy_opts(from, to, options).await,
        }
    }
}
