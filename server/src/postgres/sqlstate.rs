//! Failures as Postgres says them, with its five-letter states.

use echolake_query::Error as QueryError;
use pgwire::error::{ErrorInfo, PgWireError};

use crate::fault::{Code, Fault};

/// A failure that leaves the connection open.
pub(crate) fn error(fault: &Fault) -> PgWireError {
    info("ERROR", fault)
}

/// A failure that ends the connection.
pub(crate) fn fatal(fault: &Fault) -> PgWireError {
    info("FATAL", fault)
}

fn info(severity: &str, fault: &Fault) -> PgWireError {
    let (message, place, hint) = parts(fault);
    let mut info = ErrorInfo::new(severity.to_owned(), state(fault).to_owned(), message);
    info.detail = place;
    info.hint = hint;
    PgWireError::UserError(Box::new(info))
}

fn parts(fault: &Fault) -> (String, Option<String>, Option<String>) {
    if let Fault::Query(QueryError::Query { message, place, hint }) = fault {
        return (message.clone(), place.clone(), hint.clone());
    }
    let text = fault.to_string();
    match text.split_once("; hint: ") {
        Some((message, hint)) => (message.to_owned(), None, Some(hint.to_owned())),
        None => (text, None, None),
    }
}

// Appendix A of Postgres' manual.
fn state(fault: &Fault) -> &'static str {
    match fault {
        Fault::Query(QueryError::Query { message, .. }) if message.starts_with("no table ") => "42P01",
        Fault::Query(QueryError::Query { message, .. }) if message.starts_with("no column ") => "42703",
        Fault::TooMany { what: "connections", .. } => "53300",
        Fault::NotFound { what, .. } if what.starts_with("cursor ") => "34000",
        _ => match fault.code() {
            Code::Query => "42601",
            Code::ReadOnly => "25006",
            Code::Execution => "22000",
            Code::Format => "0A000",
            Code::Lake | Code::Changed => "58030",
            Code::Request | Code::Method | Code::Range => "22023",
            Code::Unsupported => "0A000",
            Code::NotFound | Code::Gone | Code::NoData => "42704",
            Code::MemoryLimit => "53200",
            Code::TooLarge | Code::RowLimit => "54000",
            Code::TooMany => "53300",
            Code::Unauthenticated => "28P01",
            Code::Forbidden | Code::Foreign => "42501",
            Code::Cancelled | Code::TimeLimit => "57014",
            Code::EngineEnded => "58000",
            Code::Internal => "XX000",
        },
    }
}
