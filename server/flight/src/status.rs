//! Failures as gRPC statuses: the text with place, mark and hint, and in the metadata the code that stays the same
//! (`echolake-code`) and the place in the query (`echolake-line`, `echolake-column`).

use echolake_service::{FaultCode, RequestFault};
use tonic::metadata::{MetadataMap, MetadataValue};
use tonic::{Code as Grpc, Status};

/// The metadata key of the code that stays the same.
const CODE: &str = "echolake-code";
/// The metadata key of the line of an error in a query.
const LINE: &str = "echolake-line";
/// The metadata key of its column.
const COLUMN: &str = "echolake-column";

/// A failure as a status.
pub fn grpc_status(fault: &RequestFault) -> Status {
    let code = fault.code();
    let mut metadata = MetadataMap::new();
    metadata.insert(CODE, MetadataValue::from_static(code.name()));
    if let Some(place) = fault.text_parts().place {
        metadata.insert(LINE, MetadataValue::from(place.line));
        metadata.insert(COLUMN, MetadataValue::from(place.column));
    }
    Status::with_metadata(grpc_code(code), fault.to_string(), metadata)
}

fn grpc_code(code: FaultCode) -> Grpc {
    match code {
        FaultCode::Query | FaultCode::Request | FaultCode::Format | FaultCode::Method => Grpc::InvalidArgument,
        FaultCode::ReadOnly | FaultCode::Forbidden | FaultCode::Foreign => Grpc::PermissionDenied,
        FaultCode::Execution | FaultCode::Changed | FaultCode::Precondition => Grpc::FailedPrecondition,
        FaultCode::Taken | FaultCode::Unconfirmed => Grpc::FailedPrecondition,
        FaultCode::Lake | FaultCode::Unwritable | FaultCode::Stopping | FaultCode::NotReady => Grpc::Unavailable,
        FaultCode::WorkerLost => Grpc::Unavailable,
        FaultCode::Unsupported => Grpc::Unimplemented,
        FaultCode::NotFound | FaultCode::Gone | FaultCode::NoData => Grpc::NotFound,
        FaultCode::Range => Grpc::OutOfRange,
        FaultCode::Unauthenticated => Grpc::Unauthenticated,
        FaultCode::Cancelled => Grpc::Cancelled,
        FaultCode::TimeLimit => Grpc::DeadlineExceeded,
        FaultCode::TooLarge | FaultCode::TooMany | FaultCode::MemoryLimit | FaultCode::RowLimit => {
            Grpc::ResourceExhausted
        }
        FaultCode::EngineEnded => Grpc::Aborted,
        FaultCode::Internal => Grpc::Internal,
    }
}
