//! Bodies of requests: read with limits of size and time, and read to their end if nobody wants them.

use std::future::poll_fn;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use axum::body::{Body, BodyDataStream};
use axum::http::{HeaderMap, header};
use bytes::{Bytes, BytesMut};
use echolake_service::RequestFault;
use futures::TryStreamExt as _;
use hyper::body::{Body as HttpBody, Frame, SizeHint};
use tokio::time::Instant;

/// Time limit for the body of a request.
const BODY_LIMIT: Duration = Duration::from_secs(30);
/// Parts of a body beyond which they must have so many bytes on average: each costs as much as one that says something.
const FREE_PARTS: usize = 4_096;
const LEAST_PART_BYTES: usize = 16;
/// Bytes of an unwanted body that are read, and the time for them.
const UNWANTED_BYTES: usize = 64 << 20;
const UNWANTED_LIMIT: Duration = Duration::from_secs(10);

/// Refuses a body whose headers declare more bytes than the limit.
///
/// # Errors
/// [`RequestFault::TooLarge`].
pub(super) fn check_declared_size(headers: &HeaderMap, limit: usize) -> Result<(), RequestFault> {
    let declared = headers.get(header::CONTENT_LENGTH).and_then(|v| v.to_str().ok()?.parse::<usize>().ok());
    if declared.is_some_and(|bytes| bytes > limit) { Err(RequestFault::TooLarge { limit }) } else { Ok(()) }
}

/// Reads a body of limited size in limited time.
///
/// # Errors
/// [`RequestFault::TooLarge`]; [`RequestFault::Request`] if it takes too long or breaks off.
pub(super) async fn read_whole_body(body: Body, headers: &HeaderMap, limit: usize) -> Result<Bytes, RequestFault> {
    check_declared_size(headers, limit)?;
    let whole = BodyReader::new(body, limit.saturating_add(1)).next_piece().await?;
    if whole.len() > limit { Err(RequestFault::TooLarge { limit }) } else { Ok(whole) }
}

/// A client's body, which may come a byte at a time and has to come in time.
pub(super) struct BodyReader {
    parts: BodyDataStream,
    end: Instant,
    piece_bytes: usize,
    part_count: usize,
    bytes: usize,
    is_ended: bool,
}

impl BodyReader {
    /// Reads pieces of at least so many bytes, but for the last.
    pub fn new(body: Body, piece_bytes: usize) -> Self {
        let parts = body.into_data_stream();
        let end = Instant::now() + BODY_LIMIT;
        Self { parts, end, piece_bytes, part_count: 0, bytes: 0, is_ended: false }
    }

    /// Returns whether all has been read.
    pub fn is_ended(&self) -> bool {
        self.is_ended
    }

    /// Reads the next piece; it is empty at the end.
    pub async fn next_piece(&mut self) -> Result<Bytes, RequestFault> {
        let mut piece = BytesMut::new();
        let filled = tokio::time::timeout_at(self.end, self.fill_piece(&mut piece)).await;
        filled.map_err(|_| RequestFault::bad_request(format!("the body took longer than {BODY_LIMIT:?}")))??;
        Ok(piece.freeze())
    }

    async fn fill_piece(&mut self, piece: &mut BytesMut) -> Result<(), RequestFault> {
        while !self.is_ended && piece.len() < self.piece_bytes {
            let part = self.parts.try_next().await;
            match part.map_err(|_| RequestFault::bad_request("the request's body did not come whole"))? {
                Some(part) => {
                    self.part_count += 1;
                    self.bytes += part.len();
                    piece.extend_from_slice(&part);
                }
                None => self.is_ended = true,
            }
            if self.part_count > FREE_PARTS && self.bytes < self.part_count * LEAST_PART_BYTES {
                return Err(RequestFault::bad_request(format!(
                    "the body comes in parts of less than {LEAST_PART_BYTES} bytes"
                )));
            }
        }
        Ok(())
    }
}

/// A body of HTTP/2 that is read to its end even if the request is refused.
///
/// HTTP/2 resets the stream of a body that is dropped, and curl then loses the answer, which may say why the request
/// was refused. Here the rest is read and thrown away beside the answer, within limits.
pub(super) struct ReadThroughBody<B: HttpBody<Data = Bytes> + Send + Unpin + 'static>(Option<B>);

impl<B: HttpBody<Data = Bytes> + Send + Unpin + 'static> ReadThroughBody<B> {
    pub fn new(body: B) -> Self {
        Self(Some(body))
    }
}

impl<B: HttpBody<Data = Bytes> + Send + Unpin + 'static> HttpBody for ReadThroughBody<B> {
    type Data = Bytes;
    type Error = B::Error;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, B::Error>>> {
        let Some(body) = &mut self.0 else { return Poll::Ready(None) };
        let frame = ready!(Pin::new(body).poll_frame(context));
        if !matches!(frame, Some(Ok(_))) {
            self.0 = None;
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.0.as_ref().is_none_or(HttpBody::is_end_stream)
    }

    fn size_hint(&self) -> SizeHint {
        self.0.as_ref().map_or_else(|| SizeHint::with_exact(0), HttpBody::size_hint)
    }
}

impl<B: HttpBody<Data = Bytes> + Send + Unpin + 'static> Drop for ReadThroughBody<B> {
    fn drop(&mut self) {
        let rest = self.0.take().filter(|body| !body.is_end_stream());
        if let (Some(rest), Ok(runtime)) = (rest, tokio::runtime::Handle::try_current()) {
            runtime.spawn(tokio::time::timeout(UNWANTED_LIMIT, discard_body(rest)));
        }
    }
}

async fn discard_body(mut body: impl HttpBody<Data = Bytes> + Unpin) {
    let mut bytes = 0;
    while let Some(Ok(frame)) = poll_fn(|context| Pin::new(&mut body).poll_frame(context)).await {
        bytes += frame.data_ref().map_or(0, Bytes::len);
        if bytes > UNWANTED_BYTES {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use futures::stream;

    use super::*;

    /// E12: a body that does not end is refused once its time is over, however little of it came.
    #[tokio::test]
    async fn a_body_has_limits_of_size_and_time() {
        let read = async |body: &'static str| read_whole_body(Body::from(body), &HeaderMap::new(), 10).await;
        assert_eq!(read("0123456789").await.ok().as_deref(), Some(&b"0123456789"[..]));
        assert!(matches!(read("0123456789a").await, Err(RequestFault::TooLarge { limit: 10 })));
        let never = || Body::from_stream(stream::pending::<Result<Bytes, std::io::Error>>());
        let declared = HeaderMap::from_iter([(header::CONTENT_LENGTH, 11.into())]);
        let refused = read_whole_body(never(), &declared, 10).await;
        assert!(matches!(refused, Err(RequestFault::TooLarge { limit: 10 })), "before anything is read");
        let mut reader = BodyReader::new(never(), 1);
        reader.end = Instant::now();
        let fault = reader.next_piece().await.expect_err("its time is over");
        assert_eq!(fault.to_string(), "the body took longer than 30s");
    }

    /// B1: what nobody reads is read to its end.
    #[tokio::test]
    async fn a_body_that_is_dropped_is_read_on() {
        let (sender, receiver) = tokio::sync::mpsc::channel::<Bytes>(1);
        let parts = stream::unfold(receiver, async |mut receiver| {
            Some((Ok::<_, std::io::Error>(receiver.recv().await?), receiver))
        });
        drop(ReadThroughBody::new(Body::from_stream(parts)));
        for _ in 0..100 {
            sender.send(Bytes::from_static(b"part")).await.expect("somebody reads");
        }
    }
}
