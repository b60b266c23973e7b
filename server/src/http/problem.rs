//! Failures as `application/problem+json` (RFC 9457), with the code that stays the same.

use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use crate::fault::{Code, Fault};

/// A failure, to be answered.
pub(crate) struct Problem(pub(crate) Fault);

#[derive(Serialize)]
struct Body<'a> {
    #[serde(rename = "type")]
    kind: String,
    title: &'a str,
    status: u16,
    code: &'a str,
    detail: String,
}

impl From<Fault> for Problem {
    fn from(fault: Fault) -> Self {
        Self(fault)
    }
}

impl Problem {
    /// It as a response.
    pub(crate) fn answer(&self) -> Response {
        let code = self.0.code();
        let (status, title) = status(code);
        let body = Body {
            kind: format!("urn:echolake:problem:{}", code.name()),
            title,
            status: status.as_u16(),
            code: code.name(),
            detail: self.0.to_string(),
        };
        let mut response = (status, axum::Json(body)).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
        if status == StatusCode::UNAUTHORIZED {
            headers.insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer realm=\"echolake\""));
        }
        response
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        self.answer()
    }
}

fn status(code: Code) -> (StatusCode, &'static str) {
    match code {
        Code::Query => (StatusCode::BAD_REQUEST, "The query is not right"),
        Code::ReadOnly => (StatusCode::FORBIDDEN, "Only reading is allowed"),
        Code::Execution => (StatusCode::UNPROCESSABLE_ENTITY, "The query failed"),
        Code::Format => (StatusCode::UNPROCESSABLE_ENTITY, "The answer does not fit its format"),
        Code::Lake => (StatusCode::SERVICE_UNAVAILABLE, "The lake cannot be read"),
        Code::Request => (StatusCode::BAD_REQUEST, "The request is not right"),
        Code::Unsupported => (StatusCode::NOT_IMPLEMENTED, "Not supported"),
        Code::NotFound => (StatusCode::NOT_FOUND, "Not there"),
        Code::Gone => (StatusCode::GONE, "No longer there"),
        Code::Changed => (StatusCode::CONFLICT, "A run's file has changed"),
        Code::NoData => (StatusCode::NOT_FOUND, "There are no such data"),
        Code::Method => (StatusCode::METHOD_NOT_ALLOWED, "Not for this method"),
        Code::Range => (StatusCode::RANGE_NOT_SATISFIABLE, "Not in the file"),
        Code::TooLarge => (StatusCode::PAYLOAD_TOO_LARGE, "The request is too large"),
        Code::Unauthenticated => (StatusCode::UNAUTHORIZED, "A token is needed"),
        Code::Forbidden => (StatusCode::FORBIDDEN, "The token is not for this"),
        Code::Foreign => (StatusCode::FORBIDDEN, "Not from here"),
        Code::Cancelled => (StatusCode::CONFLICT, "The query was cancelled"),
        Code::TimeLimit => (StatusCode::REQUEST_TIMEOUT, "The query took too long"),
        Code::MemoryLimit => (StatusCode::INSUFFICIENT_STORAGE, "There is not enough memory or disk"),
        Code::RowLimit => (StatusCode::UNPROCESSABLE_ENTITY, "The answer is too long"),
        Code::TooMany => (StatusCode::TOO_MANY_REQUESTS, "Too much at once"),
        Code::EngineEnded => (StatusCode::INTERNAL_SERVER_ERROR, "The query ended its engine"),
        Code::Internal => (StatusCode::INTERNAL_SERVER_ERROR, "The server failed"),
    }
}
