//! The protocol of a request over HTTP, by its path: that of agents is a protocol of its own in `system.queries`, in
//! figures and in the log.

use echolake_query::Session;
use echolake_service::{QueryJob, QueryWork, ServerProtocol, StopSignal};
use std::sync::Arc;

use axum::extract::{Request, State};
use axum::middleware::Next;
use axum::response::Response;

tokio::task_local! {
    static PROTOCOL: ServerProtocol;
}

/// Returns the protocol of the request that this task answers; that of HTTP itself if its routes name none.
pub(crate) fn request_protocol() -> ServerProtocol {
    PROTOCOL.try_with(|protocol| *protocol).unwrap_or(ServerProtocol::Http)
}

/// A query of the HTTP request that this task answers: it ends with the request, or by its client's quota.
pub(crate) fn http_job(session: Arc<Session>, work: QueryWork) -> QueryJob {
    QueryJob { protocol: request_protocol(), session, work, limit: None, stop: StopSignal::new() }
}

/// Answers a request as one of a protocol; a layer of its routes.
pub(super) async fn set_protocol(State(protocol): State<ServerProtocol>, request: Request, next: Next) -> Response {
    PROTOCOL.scope(protocol, next.run(request)).await
}
