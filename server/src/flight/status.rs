//! Failures as gRPC statuses, with the code that stays the same in the metadata `echolake-code`.

use tonic::metadata::{MetadataMap, MetadataValue};
use tonic::{Code as Grpc, Status};

use crate::fault::{FaultCode, RequestFault};

/// The metadata key of the code that stays the same.
const CODE: &str = "echolake-code";

/// A failure as a status.
pub(crate) fn status(fault: &RequestFault) -> Status {
    let code = fault.code();
    let mut metadata = MetadataMap::new();
    metadata.insert(CODE, MetadataValue::from_static(code.name()));
    Status::with_metadata(grpc(code), fault.to_string(), metadata)
}

fn grpc(code: FaultCode) -> Grpc {
    match code {
        FaultCode::Query | FaultCode::Request | FaultCode::Format | FaultCode::Method => Grpc::InvalidArgument,
        FaultCode::ReadOnly | FaultCode::Forbidden | FaultCode::Foreign => Grpc::PermissionDenied,
        FaultCode::Execution | FaultCode::Changed => Grpc::FailedPrecondition,
        FaultCode::Lake => Grpc::Unavailable,
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
