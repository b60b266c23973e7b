//! Failures as gRPC statuses, with the code that stays the same in the metadata `echolake-code`.

use tonic::metadata::{MetadataMap, MetadataValue};
use tonic::{Code as Grpc, Status};

use crate::fault::{Code, Fault};

/// The metadata key of the code that stays the same.
const CODE: &str = "echolake-code";

/// A failure as a status.
pub(crate) fn status(fault: &Fault) -> Status {
    let code = fault.code();
    let mut metadata = MetadataMap::new();
    metadata.insert(CODE, MetadataValue::from_static(code.name()));
    Status::with_metadata(grpc(code), fault.to_string(), metadata)
}

fn grpc(code: Code) -> Grpc {
    match code {
        Code::Query | Code::Request | Code::Format | Code::Method => Grpc::InvalidArgument,
        Code::ReadOnly | Code::Forbidden | Code::Foreign => Grpc::PermissionDenied,
        Code::Execution | Code::Changed => Grpc::FailedPrecondition,
        Code::Lake => Grpc::Unavailable,
        Code::Unsupported => Grpc::Unimplemented,
        Code::NotFound | Code::Gone | Code::NoData => Grpc::NotFound,
        Code::Range => Grpc::OutOfRange,
        Code::Unauthenticated => Grpc::Unauthenticated,
        Code::Cancelled => Grpc::Cancelled,
        Code::TimeLimit => Grpc::DeadlineExceeded,
        Code::TooLarge | Code::TooMany | Code::MemoryLimit | Code::RowLimit => Grpc::ResourceExhausted,
        Code::EngineEnded => Grpc::Aborted,
        Code::Internal => Grpc::Internal,
    }
}
