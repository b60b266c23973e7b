//! Failures as `application/problem+json` (RFC 9457), with the code that stays the same.

use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use echolake_query::QueryPlace;
use echolake_service::{FaultCode, RequestFault};
use serde::Serialize;
use utoipa::ToSchema;
use utoipa::openapi::{ObjectBuilder, RefOr, Schema, Type};

/// A failure, to be answered.
pub struct ProblemResponse(pub RequestFault);

/// RFC 9457; `code` is stable and made for programs.
#[derive(Serialize, ToSchema)]
#[schema(as = Problem)]
pub struct ProblemBody<'a> {
    #[serde(rename = "type")]
    kind: String,
    title: &'a str,
    status: u16,
    #[schema(schema_with = code_schema)]
    code: &'a str,
    /// What is wrong, where, and what to do: the text that all protocols and the prompt have.
    #[schema(required = false)]
    detail: String,
    /// What to do.
    #[schema(required = false, nullable = false)]
    #[serde(skip_serializing_if = "Option::is_none")]
    hint: Option<String>,
    /// The place of an error in a query's text.
    #[schema(required = false, nullable = false)]
    #[serde(skip_serializing_if = "Option::is_none")]
    place: Option<ProblemPlace>,
}

/// A place in a query's text; all count from 1, in characters.
#[derive(Serialize, ToSchema)]
pub(super) struct ProblemPlace {
    line: u64,
    column: u64,
    /// Position in the whole text.
    position: u64,
    /// The line, and below it a mark under the place.
    mark: String,
}

impl From<QueryPlace> for ProblemPlace {
    fn from(QueryPlace { line, column, position, mark }: QueryPlace) -> Self {
        Self { line, column, position, mark }
    }
}

fn code_schema() -> RefOr<Schema> {
    let codes = FaultCode::ALL.iter().map(|code| code.name());
    ObjectBuilder::new().schema_type(Type::String).enum_values(Some(codes)).into()
}

impl From<RequestFault> for ProblemResponse {
    fn from(fault: RequestFault) -> Self {
        Self(fault)
    }
}

impl ProblemResponse {
    /// Returns the failure as a response.
    pub fn to_response(&self) -> Response {
        let code = self.0.code();
        let (status, title) = status_and_title(code);
        let parts = self.0.text_parts();
        let body = ProblemBody {
            kind: format!("urn:echolake:problem:{}", code.name()),
            title,
            status: status.as_u16(),
            code: code.name(),
            detail: self.0.to_string(),
            hint: parts.hint,
            place: parts.place.map(ProblemPlace::from),
        };
        let mut response = (status, axum::Json(body)).into_response();
        response.extensions_mut().insert(code);
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
        if let Some(secs) = self.0.retry_secs() {
            headers.insert(header::RETRY_AFTER, HeaderValue::from(secs));
        }
        if code == FaultCode::Stopping {
            headers.insert(header::CONNECTION, HeaderValue::from_static("close"));
        }
        if status == StatusCode::UNAUTHORIZED {
            headers.insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer realm=\"echolake\""));
        }
        response
    }
}

impl IntoResponse for ProblemResponse {
    fn into_response(self) -> Response {
        self.to_response()
    }
}

/// Refuses a method that a path does not have.
pub(super) async fn refuse_method() -> ProblemResponse {
    ProblemResponse(RequestFault::Method)
}

fn status_and_title(code: FaultCode) -> (StatusCode, &'static str) {
    match code {
        FaultCode::Query => (StatusCode::BAD_REQUEST, "The query is not right"),
        FaultCode::ReadOnly => (StatusCode::FORBIDDEN, "Only reading is allowed"),
        FaultCode::Execution => (StatusCode::UNPROCESSABLE_ENTITY, "The query failed"),
        FaultCode::Format => (StatusCode::UNPROCESSABLE_ENTITY, "The answer does not fit its format"),
        FaultCode::Lake => (StatusCode::SERVICE_UNAVAILABLE, "The lake cannot be read"),
        FaultCode::Request => (StatusCode::BAD_REQUEST, "The request is not right"),
        FaultCode::Unsupported => (StatusCode::NOT_IMPLEMENTED, "Not supported"),
        FaultCode::NotFound => (StatusCode::NOT_FOUND, "Not there"),
        FaultCode::Gone => (StatusCode::GONE, "No longer there"),
        FaultCode::Taken => (StatusCode::CONFLICT, "The name is taken"),
        FaultCode::Unconfirmed => (StatusCode::CONFLICT, "It needs a confirmation"),
        FaultCode::Unwritable => (StatusCode::SERVICE_UNAVAILABLE, "The lake cannot be written"),
        FaultCode::Changed => (StatusCode::CONFLICT, "A run's file has changed"),
        FaultCode::NoData => (StatusCode::NOT_FOUND, "There are no such data"),
        FaultCode::Method => (StatusCode::METHOD_NOT_ALLOWED, "Not for this method"),
        FaultCode::Precondition => (StatusCode::PRECONDITION_FAILED, "Not this version"),
        FaultCode::Range => (StatusCode::RANGE_NOT_SATISFIABLE, "Not in the file"),
        FaultCode::TooLarge => (StatusCode::PAYLOAD_TOO_LARGE, "The request is too large"),
        FaultCode::Unauthenticated => (StatusCode::UNAUTHORIZED, "A token is needed"),
        FaultCode::Forbidden => (StatusCode::FORBIDDEN, "The token is not for this"),
        FaultCode::Foreign => (StatusCode::FORBIDDEN, "Not from here"),
        FaultCode::Cancelled => (StatusCode::CONFLICT, "The query was cancelled"),
        FaultCode::TimeLimit => (StatusCode::REQUEST_TIMEOUT, "The query took too long"),
        FaultCode::MemoryLimit => (StatusCode::INSUFFICIENT_STORAGE, "There is not enough memory or disk"),
        FaultCode::RowLimit => (StatusCode::UNPROCESSABLE_ENTITY, "The answer is too long"),
        FaultCode::TooMany => (StatusCode::TOO_MANY_REQUESTS, "Too much at once"),
        FaultCode::EngineEnded => (StatusCode::INTERNAL_SERVER_ERROR, "The query ended its engine"),
        FaultCode::WorkerLost => (StatusCode::SERVICE_UNAVAILABLE, "A worker was lost"),
        FaultCode::Internal => (StatusCode::INTERNAL_SERVER_ERROR, "The server failed"),
        FaultCode::Stopping => (StatusCode::SERVICE_UNAVAILABLE, "The server is stopping"),
        FaultCode::NotReady => (StatusCode::SERVICE_UNAVAILABLE, "The server is not ready"),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_refusal_for_a_while_says_for_how_long() {
        let retry = |fault| {
            let answer = ProblemResponse(fault).to_response();
            let secs = answer.headers().get(header::RETRY_AFTER).and_then(|secs| secs.to_str().ok()?.parse().ok());
            (answer.status().as_u16(), secs)
        };
        let wait = Duration::from_millis(7_500);
        assert_eq!(retry(RequestFault::Backoff { ends: 8, wait }), (429, Some(8)));
        assert_eq!(retry(RequestFault::FailedLogins { wait }), (429, Some(8)));
        assert_eq!(retry(RequestFault::Draining), (503, Some(5)));
        assert_eq!(retry(RequestFault::Unauthenticated), (401, None));
    }
}
