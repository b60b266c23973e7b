//! A store over another one that counts requests, and fails as a test decides.

use std::fmt::{self, Debug};
use std::future::ready;
use std::sync::{Arc, Mutex, PoisonError};

use async_trait::async_trait;
use futures::StreamExt as _;
use futures::stream::{self, BoxStream};
use object_store::path::Path;
use object_store::{
    CopyOptions, Error as StoreError, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta, ObjectStore,
    PutMode, PutMultipartOptions, PutOptions, PutPayload, PutResult, RenameOptions, Result as StoreResult,
};

/// Kind of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RequestKind {
    /// Writes an object that must not be there yet.
    Create,
    /// Writes an object.
    Put,
    /// Reads an object's metadata.
    Head,
    /// Reads an object.
    Get,
    /// Lists objects.
    List,
    /// Deletes objects.
    Delete,
    /// Copies or renames an object, or begins an upload in parts.
    Move,
}

impl RequestKind {
    /// Returns whether it changes what is stored.
    pub fn is_write(self) -> bool {
        !matches!(self, Self::Head | Self::Get | Self::List)
    }

    fn name(self) -> &'static str {
        match self {
            Self::Create | Self::Put => "PUT",
            Self::Head => "HEAD",
            Self::Get => "GET",
            Self::List => "LIST",
            Self::Delete => "DELETE",
            Self::Move => "MOVE",
        }
    }
}

/// What becomes of a request.
#[derive(Debug)]
pub enum RequestFate {
    /// The store does it.
    Done,
    /// The store does not do it.
    Refused(StoreError),
    /// The store does it, and the client gets an error; a listing is cut off after its first object.
    AnswerLost(StoreError),
}

/// What a store double does beside passing requests on; by default nothing.
#[async_trait]
pub trait StoreBehaviour: Debug + Send + Sync + 'static {
    /// Decides what becomes of a request.
    fn decide_fate(&self, _kind: RequestKind, _path: Option<&Path>) -> RequestFate {
        RequestFate::Done
    }

    /// Changes what is written before the store writes it.
    async fn change_put(&self, _path: &Path, payload: PutPayload, _options: &mut PutOptions) -> PutPayload {
        payload
    }
}

impl StoreBehaviour for () {}

/// A store over another one.
#[derive(Debug)]
pub struct StoreDouble<B> {
    inner: Arc<dyn ObjectStore>,
    /// Its behaviour.
    pub behaviour: B,
    requests: Mutex<Vec<String>>,
}

impl<B: StoreBehaviour> StoreDouble<B> {
    /// Creates a double over a store.
    pub fn new(inner: Arc<dyn ObjectStore>, behaviour: B) -> Arc<Self> {
        Arc::new(Self { inner, behaviour, requests: Mutex::default() })
    }

    /// Returns the requests since the last call, as `GET path`.
    pub fn take_requests(&self) -> Vec<String> {
        std::mem::take(&mut *self.requests.lock().unwrap_or_else(PoisonError::into_inner))
    }

    fn decide_fate(&self, kind: RequestKind, path: Option<&Path>) -> RequestFate {
        let text = format!("{} {}", kind.name(), path.map(Path::as_ref).unwrap_or_default());
        self.requests.lock().unwrap_or_else(PoisonError::into_inner).push(text);
        self.behaviour.decide_fate(kind, path)
    }

    async fn send<T>(
        &self,
        kind: RequestKind,
        path: Option<&Path>,
        work: impl Future<Output = StoreResult<T>>,
    ) -> StoreResult<T> {
        match self.decide_fate(kind, path) {
            RequestFate::Done => work.await,
            RequestFate::Refused(error) => Err(error),
            RequestFate::AnswerLost(error) => work.await.and(Err(error)),
        }
    }
}

impl<B> fmt::Display for StoreDouble<B> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("StoreDouble")
    }
}

#[async_trait]
impl<B: StoreBehaviour> ObjectStore for StoreDouble<B> {
    async fn put_opts(&self, path: &Path, payload: PutPayload, mut options: PutOptions) -> StoreResult<PutResult> {
        let kind = if options.mode == PutMode::Create { RequestKind::Create } else { RequestKind::Put };
        let work = async {
            let payload = self.behaviour.change_put(path, payload, &mut options).await;
            self.inner.put_opts(path, payload, options).await
        };
        self.send(kind, Some(path), work).await
    }

    async fn put_multipart_opts(
        &self,
        path: &Path,
        options: PutMultipartOptions,
    ) -> StoreResult<Box<dyn MultipartUpload>> {
        self.send(RequestKind::Move, Some(path), self.inner.put_multipart_opts(path, options)).await
    }

    async fn get_opts(&self, path: &Path, options: GetOptions) -> StoreResult<GetResult> {
        let kind = if options.head { RequestKind::Head } else { RequestKind::Get };
        // A real store's answer comes later, and others ask meanwhile.
        tokio::task::yield_now().await;
        self.send(kind, Some(path), self.inner.get_opts(path, options)).await
    }

    fn delete_stream(&self, paths: BoxStream<'static, StoreResult<Path>>) -> BoxStream<'static, StoreResult<Path>> {
        match self.decide_fate(RequestKind::Delete, None) {
            RequestFate::Done => self.inner.delete_stream(paths),
            RequestFate::Refused(error) => stream::iter([Err(error)]).boxed(),
            RequestFate::AnswerLost(error) => {
                let failed = self.inner.delete_stream(paths).filter_map(|deleted| ready(deleted.err().map(Err)));
                failed.chain(stream::iter([Err(error)])).boxed()
            }
        }
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, StoreResult<ObjectMeta>> {
        match self.decide_fate(RequestKind::List, prefix) {
            RequestFate::Done => self.inner.list(prefix),
            RequestFate::Refused(error) => stream::iter([Err(error)]).boxed(),
            RequestFate::AnswerLost(error) => self.inner.list(prefix).take(1).chain(stream::iter([Err(error)])).boxed(),
        }
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> StoreResult<ListResult> {
        self.send(RequestKind::List, prefix, self.inner.list_with_delimiter(prefix)).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> StoreResult<()> {
        self.send(RequestKind::Move, Some(to), self.inner.copy_opts(from, to, options)).await
    }

    // Atomic, as in a file system.
    async fn rename_opts(&self, from: &Path, to: &Path, options: RenameOptions) -> StoreResult<()> {
        self.send(RequestKind::Move, Some(to), self.inner.rename_opts(from, to, options)).await
    }
}
