//! Connections to a worker: accepted, and encrypted if it has a certificate. Handshakes are shaken side by side, so that
//! who is silent in one keeps nobody waiting.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use futures::Stream;
use futures::stream;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, mpsc};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;
use tokio_util::either::Either;
use tonic::transport::server::Connected;

use crate::door::ProtocolEncryption;

/// Handshakes at once; more connections wait.
const HANDSHAKES: usize = 1024;
/// Time limit for a handshake.
const HANDSHAKE: Duration = Duration::from_secs(10);
/// Time until the next try if the system gives no connection.
const PAUSE: Duration = Duration::from_millis(100);

/// Returns the connections of a listener as they come; encrypted, if they are to be.
pub(super) fn incoming(
    listener: TcpListener,
    encryption: ProtocolEncryption,
) -> impl Stream<Item = io::Result<WorkerStream>> {
    let (send, receive) = mpsc::channel(1);
    tokio::spawn(accept(listener, encryption, send));
    stream::unfold(receive, |mut receive| async move { Some((Ok(receive.recv().await?), receive)) })
}

// Until nobody wants them any more.
async fn accept(listener: TcpListener, encryption: ProtocolEncryption, send: mpsc::Sender<WorkerStream>) {
    let places = Arc::new(Semaphore::new(HANDSHAKES));
    while let Ok(place) = places.clone().acquire_owned().await {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = send.closed() => return,
        };
        match accepted {
            Ok((stream, _)) => {
                let (acceptor, send) = (encryption.acceptor(), send.clone());
                tokio::spawn(async move {
                    let _place = place;
                    if let Some(stream) = shake_hands(stream, acceptor).await {
                        // The worker may be stopping.
                        let _ = send.send(stream).await;
                    }
                });
            }
            Err(e) => {
                tracing::warn!(error = &e as &dyn std::error::Error, "a connection cannot be accepted");
                tokio::time::sleep(PAUSE).await;
            }
        }
    }
}

async fn shake_hands(stream: TcpStream, acceptor: Option<TlsAcceptor>) -> Option<WorkerStream> {
    stream.set_nodelay(true).ok()?;
    let Some(acceptor) = acceptor else { return Some(WorkerStream(Either::Left(stream))) };
    match tokio::time::timeout(HANDSHAKE, acceptor.accept(stream)).await {
        Ok(Ok(encrypted)) => Some(WorkerStream(Either::Right(Box::new(encrypted)))),
        Ok(Err(e)) => {
            tracing::debug!(error = &e as &dyn std::error::Error, "a handshake failed");
            None
        }
        Err(_) => None,
    }
}

/// A connection, encrypted or not.
pub(super) struct WorkerStream(Either<TcpStream, Box<TlsStream<TcpStream>>>);

impl Connected for WorkerStream {
    type ConnectInfo = ();

    fn connect_info(&self) {}
}

impl AsyncRead for WorkerStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.0).poll_read(context, buffer)
    }
}

impl AsyncWrite for WorkerStream {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.0).poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.0).poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.0.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.0).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.0).poll_shutdown(context)
    }
}
