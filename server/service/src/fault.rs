//! Failures of requests, each with a code that is stable over versions and protocols. Each protocol encodes them in one
//! place: `problem.rs` of HTTP, `status.rs` of Flight SQL, `sqlstate.rs` of Postgres' protocol.

use std::time::Duration;

use echolake_export::Error as SliceError;
use echolake_query::{Error as QueryError, QueryPlace};
use serde::{Deserialize, Serialize};

use crate::token_scope::TokenScope;

/// Seconds after which a client may ask again a server that stops or is not ready: a restart takes some.
const RESTART_SECS: u64 = 5;

/// The failure of a request.
#[derive(Debug, thiserror::Error)]
pub enum RequestFault {
    /// The query, or its run.
    #[error(transparent)]
    Query(#[from] QueryError),
    /// The request is not one that this server understands.
    #[error("{message}")]
    Request {
        /// The defect of the request, and the expected form.
        message: String,
    },
    /// The request is understood, but not supported by this server.
    #[error("{what} is not supported here")]
    Unsupported {
        /// The requested feature.
        what: String,
    },
    /// The requested item does not exist, or not any more.
    #[error("{what} is not there; hint: {hint}")]
    NotFound {
        /// The requested item.
        what: String,
        /// A remedy for the client.
        hint: &'static str,
    },
    /// The requested item existed, and was removed.
    #[error("{what} is no longer there; hint: {hint}")]
    Gone {
        /// The requested item.
        what: &'static str,
        /// A remedy for the client.
        hint: &'static str,
    },
    /// A slice cannot be cut.
    #[error(transparent)]
    Slice(#[from] SliceError),
    /// A slice of more measurements than are cut at once.
    #[error("a slice has {limit} measurements at most; hint: ask for fewer runs at a time")]
    SliceTooLarge {
        /// Maximal number of measurements.
        limit: usize,
    },
    /// There is no room on the server's disk for a slice that is asked for by ranges.
    #[error(
        "slices that are asked for by ranges are kept for a while, {limit} bytes of them and while the disk has room; \
         hint: ask for fewer measurements or topics, or for all of it without a range"
    )]
    NoRoom {
        /// Bytes that are kept.
        limit: u64,
    },
    /// The requested item exists, but has no such data.
    #[error("{what} has no {data}; hint: {hint}")]
    NoData {
        /// The requested item.
        what: String,
        /// The missing data.
        data: &'static str,
        /// A remedy for the client.
        hint: &'static str,
    },
    /// The name is another item's.
    #[error("{what} is there already; hint: {hint}")]
    Taken {
        /// The item.
        what: String,
        /// A remedy for the client.
        hint: &'static str,
    },
    /// A verdict on a run that levels of other surfaces rest on, without a confirmation.
    #[error(
        "the next `echolake ingest` derives {rows} rows of {surfaces} surfaces again after a verdict on run `{run}`, \
         which their levels rest on; hint: send it again with \"confirm_rederivation\": true"
    )]
    Unconfirmed {
        /// The run.
        run: String,
        /// Surfaces that the client sees.
        surfaces: usize,
        /// Their rows.
        rows: u64,
    },
    /// The lake's store does not take a contribution. The cause is in the server's log.
    #[error("the lake's store does not take it; hint: the server's log has the cause, and sending it again is safe")]
    Unwritable,
    /// The lake's store does not give a file. The cause is in the server's log.
    #[error("the lake's store does not give the file; hint: ask again")]
    Unreadable,
    /// The path exists for other methods.
    #[error("this path is not for this method; hint: the header `Allow` lists those it is for")]
    Method,
    /// The header If-Match names none of the versions there are.
    #[error("the ETag is {etag}, which `If-Match` does not name; hint: leave the header out for the present version")]
    Precondition {
        /// The tag of the present version.
        etag: String,
    },
    /// A part of a file that it does not have.
    #[error("the file has {bytes} bytes; hint: ask for a range within them")]
    Range {
        /// Length of the file.
        bytes: u64,
    },
    /// The request is larger than is read.
    #[error("the request is larger than {limit} bytes")]
    TooLarge {
        /// Maximal size in bytes.
        limit: usize,
    },
    /// The request has more of something than is taken at once.
    #[error("the request has more than {limit} {what}; hint: send it in several requests")]
    TooMuch {
        /// Of what.
        what: &'static str,
        /// The limit.
        limit: usize,
    },
    /// No token, or a wrong one.
    #[error("a valid token is needed; hint: `Authorization: Bearer TOKEN`, or the token as password")]
    Unauthenticated,
    /// The token is right, and is not for this.
    #[error("the token `{name}` is not for {scope}")]
    Forbidden {
        /// The token's name.
        name: String,
        /// The missing scope.
        scope: TokenScope,
    },
    /// The request comes from a web page of another origin, or names a host that is not this machine.
    #[error(
        "{what} `{found}` is not this server's; hint: without tokens only pages of this server are answered, and \
         others for files and slices of runs that they name (`run=RUN`)"
    )]
    Foreign {
        /// Part of the request: host, address, origin or fetch site.
        what: &'static str,
        /// Its value.
        found: String,
    },
    /// The query was cancelled.
    #[error("the query was cancelled")]
    Cancelled,
    /// The session's own limit of time.
    #[error("the query ran longer than the {limit:?} that this session allows")]
    Timeout {
        /// The limit.
        limit: Duration,
    },
    /// Too much of something at once.
    #[error("too many {what}: {limit} at most; hint: close some first")]
    TooMany {
        /// Of what.
        what: &'static str,
        /// The limit.
        limit: usize,
    },
    /// Too many failed logins of an address.
    #[error("too many failed logins from this address; hint: log in with a valid token in {} s", whole_secs(*wait))]
    FailedLogins {
        /// Time after which it may try again.
        wait: Duration,
    },
    /// The server is stopping, and takes no new request.
    #[error("the server is stopping; hint: ask again in a moment")]
    Draining,
    /// The server is stopping, and ends an idle connection.
    #[error("the server is stopping and ends this connection; hint: connect again in a moment")]
    Disconnected,
    /// Engines of the client have ended one after the other.
    #[error("queries of this client ended {ends} engines in a row; hint: ask again in {} s", whole_secs(*wait))]
    Backoff {
        /// Engines that ended.
        ends: u32,
        /// Time after which the client may ask again.
        wait: Duration,
    },
    /// Requests cannot be answered at present.
    #[error("the server is not ready: {reason}; hint: its log says more")]
    NotReady {
        /// The missing part.
        reason: &'static str,
    },
    /// The engine that ran the query ended for it.
    #[error("the query ended the engine that ran it: {reason}; hint: ask for less at a time, or for fewer rows")]
    EngineEnded {
        /// The cause of its end.
        reason: String,
    },
    /// The engine that ran the query ended for another one, or for a reason that nobody knows.
    #[error("the engine that ran the query ended, as far as is known not for it: {reason}; hint: ask again")]
    EngineLost {
        /// The cause of its end.
        reason: String,
    },
    /// A defect. Its cause is in the server's log.
    #[error("the server failed; the query is ended, the server goes on")]
    Internal,
}

/// Codes by which a client's program distinguishes failures; never renamed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FaultCode {
    /// The query is wrong.
    Query,
    /// The query would write.
    ReadOnly,
    /// The query failed while it ran.
    Execution,
    /// The answer has no such form.
    Format,
    /// The lake cannot be read.
    Lake,
    /// The request is not understood.
    Request,
    /// The server does not do this.
    Unsupported,
    /// It does not exist.
    NotFound,
    /// It existed, and was removed.
    Gone,
    /// A file changed while it was read.
    Changed,
    /// The name is taken.
    Taken,
    /// It changes more than the request shows, and needs a confirmation.
    Unconfirmed,
    /// The lake cannot be written.
    Unwritable,
    /// It has no such data.
    NoData,
    /// The path is not for this method.
    Method,
    /// There is another version.
    Precondition,
    /// The file has no such part.
    Range,
    /// The request is too large.
    TooLarge,
    /// No token, or a wrong one.
    Unauthenticated,
    /// The token is not for this.
    Forbidden,
    /// A page of another origin asks.
    Foreign,
    /// The query was cancelled.
    Cancelled,
    /// The query took too long.
    TimeLimit,
    /// The query held too much memory.
    MemoryLimit,
    /// The answer has too many rows.
    RowLimit,
    /// Too much at once.
    TooMany,
    /// The engine ended with the query.
    EngineEnded,
    /// A worker was lost after rows of the query had been sent.
    WorkerLost,
    /// A defect.
    Internal,
    /// The server is stopping.
    Stopping,
    /// The server is not ready.
    NotReady,
}

impl FaultCode {
    /// All of them.
    pub const ALL: [Self; 31] = [
        Self::Query,
        Self::ReadOnly,
        Self::Execution,
        Self::Format,
        Self::Lake,
        Self::Request,
        Self::Unsupported,
        Self::NotFound,
        Self::Gone,
        Self::Changed,
        Self::Taken,
        Self::Unconfirmed,
        Self::Unwritable,
        Self::NoData,
        Self::Method,
        Self::Precondition,
        Self::Range,
        Self::TooLarge,
        Self::Unauthenticated,
        Self::Forbidden,
        Self::Foreign,
        Self::Cancelled,
        Self::TimeLimit,
        Self::MemoryLimit,
        Self::RowLimit,
        Self::TooMany,
        Self::EngineEnded,
        Self::WorkerLost,
        Self::Internal,
        Self::Stopping,
        Self::NotReady,
    ];

    /// As clients and metrics see it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Query => "query_invalid",
            Self::ReadOnly => "read_only",
            Self::Execution => "query_failed",
            Self::Format => "format_impossible",
            Self::Lake => "lake_unreadable",
            Self::Request => "request_invalid",
            Self::Unsupported => "unsupported",
            Self::NotFound => "not_found",
            Self::Gone => "gone",
            Self::Changed => "file_changed",
            Self::Taken => "taken",
            Self::Unconfirmed => "unconfirmed",
            Self::Unwritable => "lake_unwritable",
            Self::NoData => "no_data",
            Self::Method => "method_not_allowed",
            Self::Precondition => "precondition_failed",
            Self::Range => "range_not_satisfiable",
            Self::TooLarge => "request_too_large",
            Self::Unauthenticated => "unauthenticated",
            Self::Forbidden => "forbidden",
            Self::Foreign => "foreign_origin",
            Self::Cancelled => "cancelled",
            Self::TimeLimit => "time_limit",
            Self::MemoryLimit => "memory_limit",
            Self::RowLimit => "row_limit",
            Self::TooMany => "too_many",
            Self::EngineEnded => "query_ended_engine",
            Self::WorkerLost => "worker_lost",
            Self::Internal => "internal",
            Self::Stopping => "server_stopping",
            Self::NotReady => "not_ready",
        }
    }
}

/// The parts of a failure's text, for protocols that have fields for them.
pub struct FaultParts {
    /// What is wrong.
    pub message: String,
    /// The place in the query.
    pub place: Option<QueryPlace>,
    /// What to do.
    pub hint: Option<String>,
}

impl RequestFault {
    /// Returns the parts of its text.
    pub fn text_parts(&self) -> FaultParts {
        if let Self::Query(QueryError::Execution { message, place, hint }) = self {
            let message = format!("the query failed: {message}");
            return FaultParts { message, place: place.clone(), hint: hint.clone() };
        }
        if let Self::Query(QueryError::Query { message, place, hint }) = self {
            return FaultParts { message: message.clone(), place: place.clone(), hint: hint.clone() };
        }
        let text = self.to_string();
        match text.split_once("; hint: ") {
            Some((message, hint)) => {
                FaultParts { message: message.to_owned(), place: None, hint: Some(hint.to_owned()) }
            }
            None => FaultParts { message: text, place: None, hint: None },
        }
    }

    /// A request that is not understood.
    pub fn bad_request(message: impl Into<String>) -> Self {
        Self::Request { message: message.into() }
    }

    /// A request for what this server does not do.
    pub fn unsupported(what: impl Into<String>) -> Self {
        Self::Unsupported { what: what.into() }
    }

    /// Turns the cause of a defect into [`RequestFault::Internal`], and writes it to the log: `what` failed.
    pub fn defect<E: std::error::Error + 'static>(what: &'static str) -> impl Fn(E) -> Self + Copy {
        move |cause| {
            tracing::error!(error = &cause as &dyn std::error::Error, "{what}");
            Self::Internal
        }
    }

    /// Writes it to the log: as a warning if the client is not to blame for it, else for debugging, because its text
    /// may quote a statement.
    pub fn log_failure(&self) {
        let code = self.code();
        let text = self.to_string();
        match code {
            FaultCode::Internal
            | FaultCode::Lake
            | FaultCode::Changed
            | FaultCode::EngineEnded
            | FaultCode::WorkerLost => {
                tracing::warn!(code = code.name(), text, "a request failed");
            }
            _ => tracing::debug!(code = code.name(), text, "a request failed"),
        }
    }

    /// Returns the seconds after which the client may ask again, if they are known.
    pub fn retry_secs(&self) -> Option<u64> {
        match self {
            Self::FailedLogins { wait } | Self::Backoff { wait, .. } => Some(whole_secs(*wait)),
            _ => matches!(self.code(), FaultCode::Stopping | FaultCode::NotReady).then_some(RESTART_SECS),
        }
    }

    /// Its code.
    pub fn code(&self) -> FaultCode {
        match self {
            Self::Query(error) => query_code(error),
            Self::Request { .. } => FaultCode::Request,
            Self::Unsupported { .. } => FaultCode::Unsupported,
            Self::NotFound { .. } => FaultCode::NotFound,
            Self::Gone { .. } => FaultCode::Gone,
            Self::Slice(error) => slice_code(error),
            Self::SliceTooLarge { .. } => FaultCode::TooLarge,
            Self::NoRoom { .. } => FaultCode::MemoryLimit,
            Self::NoData { .. } => FaultCode::NoData,
            Self::Unreadable => FaultCode::Lake,
            Self::Taken { .. } => FaultCode::Taken,
            Self::Unconfirmed { .. } => FaultCode::Unconfirmed,
            Self::Unwritable => FaultCode::Unwritable,
            Self::Method => FaultCode::Method,
            Self::Precondition { .. } => FaultCode::Precondition,
            Self::Range { .. } => FaultCode::Range,
            Self::TooLarge { .. } | Self::TooMuch { .. } => FaultCode::TooLarge,
            Self::Unauthenticated => FaultCode::Unauthenticated,
            Self::Forbidden { .. } => FaultCode::Forbidden,
            Self::Foreign { .. } => FaultCode::Foreign,
            Self::Cancelled => FaultCode::Cancelled,
            Self::Timeout { .. } => FaultCode::TimeLimit,
            Self::TooMany { .. } | Self::FailedLogins { .. } | Self::Backoff { .. } => FaultCode::TooMany,
            Self::EngineEnded { .. } | Self::EngineLost { .. } => FaultCode::EngineEnded,
            Self::Internal => FaultCode::Internal,
            Self::Draining | Self::Disconnected => FaultCode::Stopping,
            Self::NotReady { .. } => FaultCode::NotReady,
        }
    }
}

fn whole_secs(wait: Duration) -> u64 {
    wait.as_secs() + 1
}

fn slice_code(error: &SliceError) -> FaultCode {
    match error {
        SliceError::Unknown { .. } => FaultCode::Request,
        SliceError::Nothing { .. } => FaultCode::NoData,
        SliceError::Changed { .. } => FaultCode::Changed,
        SliceError::Uncuttable { .. } => FaultCode::Format,
        _ => FaultCode::Lake,
    }
}

fn query_code(error: &QueryError) -> FaultCode {
    match error {
        QueryError::Query { .. } => FaultCode::Query,
        QueryError::NotReading { .. } => FaultCode::ReadOnly,
        QueryError::Execution { .. } => FaultCode::Execution,
        QueryError::Cancelled => FaultCode::Cancelled,
        QueryError::TimeLimit { .. } => FaultCode::TimeLimit,
        QueryError::MemoryLimit { .. } => FaultCode::MemoryLimit,
        QueryError::RowLimit { .. } => FaultCode::RowLimit,
        QueryError::Busy { .. } => FaultCode::TooMany,
        QueryError::WorkerLost { .. } => FaultCode::WorkerLost,
        QueryError::Format { .. } => FaultCode::Format,
        QueryError::Write(_) | QueryError::Lake(_) => FaultCode::Lake,
    }
}
