//! `POST /api/v1/sql`: a query, its answer as it comes.

use std::sync::Arc;

use axum::body::Body;
use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use bytes::Bytes;
use echolake_query::output::AnswerFormat;
use echolake_service::running::RunningQuery;
use echolake_service::{QueryService, QueryWork, RequestFault};
use futures::stream;
use serde::Deserialize;
use utoipa::openapi::{ObjectBuilder, RefOr, Schema, Type};
use utoipa::{IntoParams, ToSchema};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::extract::{BinaryContent, QueryParams};
use super::format::{FormatEncoder, accepted_format, format_by_name, format_names, media_type};
use super::guard::MayQuery;
use super::problem::ProblemResponse;
use crate::request_protocol::http_job;

/// Bytes of a request, axum's own limit.
const LARGEST: usize = 2 << 20;

/// The parameters after the path's `?`.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct SqlParams {
    #[param(schema_with = format_schema)]
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    format: Option<String>,
    /// CSV alone: `'` before texts that a spreadsheet would take for formulas. False by default.
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    escape_formulas: Option<bool>,
}

/// A query.
#[derive(Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = Query)]
struct SqlRequest {
    query: String,
    #[schema(schema_with = format_schema, required = false)]
    format: Option<String>,
    /// As the parameter of this name.
    #[schema(required = false, nullable = false)]
    escape_formulas: Option<bool>,
}

fn format_schema() -> RefOr<Schema> {
    let names = ObjectBuilder::new().schema_type(Type::String).enum_values(Some(format_names()));
    names.description(Some("Instead of the Accept header.")).into()
}

/// The route of queries.
pub(super) fn sql_routes() -> OpenApiRouter<QueryService> {
    OpenApiRouter::new().routes(routes!(post_sql))
}

/// Answers one read-only query.
///
/// The Accept header chooses the form, JSON if there is none. Closing the connection cancels it.
#[utoipa::path(
    post,
    path = "/api/v1/sql",
    operation_id = "sql",
    tag = "sql",
    params(SqlParams),
    request_body(content(
        (SqlRequest = "application/json"), (String = "application/sql"), (String = "text/plain")
    )),
    responses((status = 200, description = "The rows", content(
        (inline(BinaryContent) = "application/vnd.apache.arrow.stream"),
        (inline(BinaryContent) = "application/vnd.apache.parquet"),
        (String = "text/csv"),
        (Vec<HashMap<String, Value>> = "application/json")
    )))
)]
async fn post_sql(
    State(service): State<QueryService>,
    MayQuery(client): MayQuery,
    QueryParams(params): QueryParams<SqlParams>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, ProblemResponse> {
    let request = parse_body(&headers, &whole_body(body)?)?;
    let format = choose_format(&headers, params.format.or(request.format))?;
    let format = match (params.escape_formulas.or(request.escape_formulas).unwrap_or(false), format) {
        (false, format) => format,
        (true, AnswerFormat::Csv) => AnswerFormat::SpreadsheetCsv,
        (true, other) => {
            let message = format!("`escape_formulas` is for CSV, and the answer is {}; hint: format=csv", other.name());
            return Err(RequestFault::bad_request(message).into());
        }
    };
    let job = http_job(Arc::new(service.begin_session(&client)), QueryWork::Sql(request.query));
    let mut running = service.begin_query(job, move |schema| FormatEncoder::new(format, schema)).await?;
    // A query that fails at once still has a status to say so with.
    let first = running.next_part().await?;
    let headers = [(header::CONTENT_TYPE, media_type(format))];
    Ok((headers, Body::from_stream(remaining_parts(first, running))).into_response())
}

// An error on the way breaks the connection off: a short answer would look like a whole one.
fn remaining_parts(
    first: Option<Bytes>,
    running: RunningQuery<Bytes>,
) -> impl stream::Stream<Item = Result<Bytes, RequestFault>> + Send {
    stream::try_unfold((first, running), |(first, mut running)| async move {
        let part = match first {
            Some(part) => Some(part),
            None => running.next_part().await?,
        };
        Ok(part.map(|part| (part, (None, running))))
    })
}

/// The body of a request.
///
/// # Errors
/// [`RequestFault::TooLarge`], [`RequestFault::Request`].
pub(super) fn whole_body(body: Result<Bytes, BytesRejection>) -> Result<Bytes, RequestFault> {
    body.map_err(|rejection| match rejection.status() {
        StatusCode::PAYLOAD_TOO_LARGE => RequestFault::TooLarge { limit: LARGEST },
        _ => RequestFault::bad_request("the request's body did not come whole"),
    })
}

fn parse_body(headers: &HeaderMap, body: &[u8]) -> Result<SqlRequest, RequestFault> {
    let kind = headers.get(header::CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or_default();
    match kind.split(';').next().unwrap_or_default().trim().to_ascii_lowercase().as_str() {
        "application/json" => serde_json::from_slice(body).map_err(|e| {
            RequestFault::bad_request(format!("the body is not as expected: {e}; hint: {{\"query\": \"select 1\"}}"))
        }),
        "text/plain" | "application/sql" => match std::str::from_utf8(body) {
            Ok(query) => Ok(SqlRequest { query: query.to_owned(), format: None, escape_formulas: None }),
            Err(_) => Err(RequestFault::bad_request("the query is not UTF-8")),
        },
        other => Err(RequestFault::bad_request(format!(
            "a query does not come as `{other}`; hint: Content-Type application/json, application/sql or text/plain"
        ))),
    }
}

fn choose_format(headers: &HeaderMap, name: Option<String>) -> Result<AnswerFormat, RequestFault> {
    match (name, headers.get(header::ACCEPT).and_then(|v| v.to_str().ok())) {
        (Some(name), _) => format_by_name(&name),
        (None, Some(accept)) => accepted_format(accept),
        (None, None) => Ok(AnswerFormat::Json),
    }
}
