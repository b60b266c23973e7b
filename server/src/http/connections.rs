//! HTTP connections: so many at once, each of which must say what it wants in time.

use std::pin::pin;
use std::time::Duration;

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;

use crate::places::{Place, Places};

/// Connections at once; more wait until one ends. Systems often allow a process 1024 open files.
const MOST: usize = 512;
/// How long a request's head may take, and how long a connection may stand idle between two.
const HEAD: Duration = Duration::from_secs(30);

/// Answers connections until `stop`, then lets those that are at it end.
pub(super) async fn serve(listener: TcpListener, router: Router, stop: impl Future<Output = ()>) {
    let (places, stopping) = (Places::new(listener, MOST), watch::Sender::new(false));
    let (mut stop, mut open) = (pin!(stop), JoinSet::new());
    loop {
        let (stream, place) = tokio::select! {
            () = &mut stop => break,
            accepted = places.next() => accepted,
            Some(_) = open.join_next() => continue,
        };
        open.spawn(answer(stream, place, router.clone(), stopping.subscribe()));
    }
    stopping.send_replace(true);
    while open.join_next().await.is_some() {}
}

async fn answer(stream: TcpStream, _place: Place, router: Router, mut stopping: watch::Receiver<bool>) {
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD)
        .serve_connection(TokioIo::new(stream), TowerToHyperService::new(router));
    let mut connection = pin!(connection);
    // A connection that breaks off is its client's matter.
    tokio::select! {
        _ = connection.as_mut() => return,
        _ = stopping.wait_for(|stopping| *stopping) => connection.as_mut().graceful_shutdown(),
    }
    let _ = connection.await;
}
