//! Failures as Postgres says them, with its five-letter states.

use bytes::BytesMut;
use echolake_query::{Error as QueryError, OUT_OF_RANGE};
use echolake_service::{FaultCode, FaultParts, RequestFault};
use pgwire::error::{ErrorInfo, PgWireError};
use pgwire::messages::PgWireBackendMessage;

/// A failure that leaves the connection open.
pub(super) fn failure(fault: RequestFault) -> PgWireError {
    error_with_severity("ERROR", &fault)
}

/// A failure that ends the connection, as a message.
pub fn fatal_message(fault: &RequestFault) -> BytesMut {
    let mut bytes = BytesMut::new();
    // It is a message of a few hundred bytes, which is no reason for the library to refuse it.
    let _ = PgWireBackendMessage::ErrorResponse(ErrorInfo::from(fatal_error(fault)).into()).encode(&mut bytes);
    bytes
}

/// A failure that ends the connection.
pub(super) fn fatal_error(fault: &RequestFault) -> PgWireError {
    error_with_severity("FATAL", fault)
}

// Clients mark the place in their own copy of the text.
fn error_with_severity(severity: &str, fault: &RequestFault) -> PgWireError {
    let FaultParts { message, place, hint } = fault.text_parts();
    let mut info = ErrorInfo::new(severity.to_owned(), fault_sqlstate(fault).to_owned(), message);
    info.position = place.map(|place| place.position.to_string());
    info.hint = hint;
    PgWireError::UserError(Box::new(info))
}

// Appendix A of Postgres' manual.
fn fault_sqlstate(fault: &RequestFault) -> &'static str {
    match fault {
        RequestFault::Query(QueryError::Query { message, .. }) if message.starts_with("no table ") => "42P01",
        RequestFault::Query(QueryError::Query { message, .. }) if message.starts_with("no column ") => "42703",
        RequestFault::Query(QueryError::Execution { message, .. }) if message.starts_with(OUT_OF_RANGE) => "22003",
        RequestFault::TooMany { what: "connections", .. } => "53300",
        RequestFault::NotFound { what, .. } if what.starts_with("cursor ") => "34000",
        RequestFault::Disconnected => "57P01",
        _ => match fault.code() {
            FaultCode::Query => "42601",
            FaultCode::ReadOnly => "25006",
            FaultCode::Execution => "22000",
            FaultCode::Format => "0A000",
            FaultCode::Lake | FaultCode::Changed | FaultCode::Unwritable | FaultCode::WorkerLost => "58030",
            FaultCode::Request | FaultCode::Method | FaultCode::Range | FaultCode::Precondition => "22023",
            FaultCode::Taken | FaultCode::Unconfirmed => "22023",
            FaultCode::Unsupported => "0A000",
            FaultCode::NotFound | FaultCode::Gone | FaultCode::NoData => "42704",
            FaultCode::MemoryLimit => "53200",
            FaultCode::TooLarge | FaultCode::RowLimit => "54000",
            FaultCode::TooMany => "53300",
            FaultCode::Unauthenticated => "28P01",
            FaultCode::Forbidden | FaultCode::Foreign => "42501",
            FaultCode::Cancelled | FaultCode::TimeLimit => "57014",
            FaultCode::EngineEnded => "58000",
            FaultCode::Internal => "XX000",
            FaultCode::Stopping | FaultCode::NotReady => "57P03",
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// W2: A sum that its type cannot hold has Postgres' own state.
    #[test]
    fn an_overflow_is_out_of_range() {
        let message = format!("{OUT_OF_RANGE}9223372036854775807 + 1");
        let overflow = QueryError::Execution { message, place: None, hint: None };
        assert_eq!(fault_sqlstate(&RequestFault::Query(overflow)), "22003");
        let other = QueryError::Execution { message: "division by zero".to_owned(), place: None, hint: None };
        assert_eq!(fault_sqlstate(&RequestFault::Query(other)), "22000");
    }
}
