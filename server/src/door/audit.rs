//! The audit: who was refused, who came in, and which files were handed out, as lines of the log. A server without
//! tokens has none: it knows nobody.

use std::net::SocketAddr;

use axum::http::{Method, StatusCode};
use echolake_http::AddedContribution;
use echolake_schema::tables::Table;
use echolake_service::{FaultCode, ServerProtocol};

/// The target of its lines, by which a log's levels leave them out.
const TARGET: &str = "echolake_server::audit";

/// Writes a line about a client that was refused.
pub(super) fn record_refusal(peer: SocketAddr, protocol: ServerProtocol, code: FaultCode) {
    if matches!(code, FaultCode::Unauthenticated | FaultCode::Forbidden | FaultCode::Foreign) {
        tracing::warn!(target: TARGET, %peer, protocol = protocol.name(), code = code.name(), "a client was refused");
    }
}

/// Writes a line about a client that has shown its token on a connection.
pub(super) fn record_login(peer: SocketAddr, protocol: ServerProtocol, client: &str) {
    tracing::info!(target: TARGET, %peer, protocol = protocol.name(), client, "a client has logged in");
}

/// An answer that may be a file.
pub(super) struct HandedFile<'a> {
    pub client: &'a str,
    /// Its path without parameters: they may be texts of statements.
    pub path: &'a str,
    /// The runs of a slice.
    pub runs: Option<&'a str>,
}

/// Writes a line about a file that is handed out, if its path is one of files.
pub(super) fn record_file(peer: SocketAddr, method: &Method, status: StatusCode, file: &HandedFile<'_>) {
    let HandedFile { client, path, runs } = file;
    if is_file(path) && *method == Method::GET && status.is_success() {
        let status = status.as_u16();
        tracing::info!(target: TARGET, %peer, client, path, runs, status, "a file is handed out");
    }
}

/// Writes a line about what a client added to the lake.
pub(super) fn record_contribution(peer: SocketAddr, client: &str, table: Table, added: &AddedContribution) {
    let AddedContribution { lake_version, is_new, .. } = added;
    let table = table.name();
    tracing::info!(target: TARGET, %peer, client, table, lake_version, is_new, "a contribution is stored");
}

fn is_file(path: &str) -> bool {
    const ENDINGS: [&str; 5] = [".mcap", ".parquet", ".wav", ".glb", ".sofa"];
    path.starts_with("/api/") && ENDINGS.iter().any(|ending| path.ends_with(ending))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_told_by_their_paths() {
        for path in ["/api/v1/slices.mcap", "/api/v1/runs/r/file.mcap", "/api/v1/tables/tnce/x.parquet"] {
            assert!(is_file(path), "{path}");
        }
        for path in ["/api/v1/sql", "/api/v1/files", "/assets/x.glb", "/api/v1/runs"] {
            assert!(!is_file(path), "{path}");
        }
    }
}
