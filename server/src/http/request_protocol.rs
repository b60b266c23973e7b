//! The protocol of a request over HTTP, by its path: that of agents is a protocol of its own in `system.queries`, in
//! figures and in the log.

use axum::extract::{Request, State};
use axum::middleware::Next;
use axum::response::Response;

use crate::metrics::ServerProtocol;

tokio::task_local! {
    static PROTOCOL: ServerProtocol;
}

/// Returns the protocol of the request that this task answers; that of HTTP itself if its routes name none.
pub(crate) fn request_protocol() -> ServerProtocol {
    PROTOCOL.try_with(|protocol| *protocol).unwrap_or(ServerProtocol::Http)
}

/// Answers a request as one of a protocol; a layer of its routes.
pub(super) async fn set_protocol(State(protocol): State<ServerProtocol>, request: Request, next: Next) -> Response {
    PROTOCOL.scope(protocol, next.run(request)).await
}
