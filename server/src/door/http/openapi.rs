//! The contract: the paths that there are and their answers, for people, generated clients and tests. It is derived
//! from the handlers and their types; `web/openapi.json`, which the types of the pages are generated from, is a copy.

use std::sync::LazyLock;

use axum::http::header;
use axum::response::IntoResponse;
use echolake_http::{ProblemBody, contract_parts};
use serde::Serialize as _;
use serde_json::ser::{PrettyFormatter, Serializer};
use serde_json::{Map, Value, json};
use utoipa::OpenApi as _;
use utoipa::openapi::{Header, Object, OpenApi, RefOr, Response, Type};

use super::router::door_routes;

/// The document.
static DOCUMENT: LazyLock<String> = LazyLock::new(|| {
    let mut text = Vec::new();
    // A value whose keys are texts is always written.
    let _ = build_openapi().serialize(&mut Serializer::with_formatter(&mut text, PrettyFormatter::with_indent(b" ")));
    text.push(b'\n');
    String::from_utf8(text).unwrap_or_default()
});

/// The head of the document.
#[derive(utoipa::OpenApi)]
#[openapi(
    info(
        title = "echolake",
        version = "1",
        description = "The lake over HTTP. Everything but annotations and predictions is read-only. `x-sql` says which \
                       query over the lake's tables answers an endpoint. Numbers that do not exist (energies over \
                       nothing, missing references) are null, never NaN. Errors are application/problem+json.",
        license(name = "Apache-2.0 OR MIT", identifier = "Apache-2.0 OR MIT")
    ),
    servers((url = "/")),
    components(schemas(ProblemBody))
)]
struct ContractHead;

/// This document.
#[utoipa::path(
    get,
    path = "/api/v1/openapi.json",
    operation_id = "openapi",
    tag = "operation",
    responses((status = 200, description = "OK", body = HashMap<String, Value>))
)]
pub(super) async fn get_openapi() -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/json"), (header::CACHE_CONTROL, "no-cache")], DOCUMENT.as_str())
}

fn build_openapi() -> Value {
    let [validated, mut others] = contract_parts();
    others.merge(door_routes().into_openapi());
    let mut document = ContractHead::openapi();
    document.merge(with_validators(validated));
    document.merge(others);
    let mut document = serde_json::to_value(document).unwrap_or_default();
    describe_failures(&mut document);
    complete_schemas(&mut document);
    document
}

// Describes the answers' ETag, and 304.
fn with_validators(mut part: OpenApi) -> OpenApi {
    for get in part.paths.paths.values_mut().filter_map(|path| path.get.as_mut()) {
        let answers = &mut get.responses.responses;
        if let Some(RefOr::T(answer)) = answers.get_mut("200") {
            answer.headers.insert("ETag".to_owned(), RefOr::T(Header::new(Object::with_type(Type::String))));
        }
        let unchanged = Response::new("Not changed since the ETag of If-None-Match");
        answers.insert("304".to_owned(), RefOr::T(unchanged));
    }
    part
}

// All paths fail in one form.
fn describe_failures(document: &mut Value) {
    let schema = json!({ "$ref": "#/components/schemas/Problem" });
    document["components"]["responses"]["Problem"] = json!({
        "description": "What went wrong and what to do",
        "content": { "application/problem+json": { "schema": schema } },
    });
    let paths = document["paths"].as_object_mut().into_iter().flat_map(Map::values_mut);
    for operation in paths.filter_map(Value::as_object_mut).flat_map(Map::values_mut) {
        let failure = json!({ "$ref": "#/components/responses/Problem" });
        if operation["responses"].get("206").is_some() {
            operation["responses"]["416"] = failure.clone();
        }
        operation["responses"]["default"] = failure;
    }
}

// Says of schemas what holds for all answers: they have all of their fields, null or not, and no others; and JSON has
// one form of numbers.
fn complete_schemas(value: &mut Value) {
    match value {
        Value::Array(items) => items.iter_mut().for_each(complete_schemas),
        Value::Object(schema) => {
            if schema.get("type").is_some_and(|of| ["integer", "number"].iter().any(|number| is_type(of, number))) {
                schema.remove("format");
            }
            if let Some(Value::Object(properties)) = schema.get("properties") {
                let nullable = properties.iter().filter(|(_, property)| is_nullable(property));
                let nullable: Vec<_> = nullable.map(|(name, _)| Value::from(name.as_str())).collect();
                if let Value::Array(required) = schema.entry("required").or_insert_with(|| json!([])) {
                    required.extend(nullable);
                }
                schema.insert("additionalProperties".to_owned(), Value::Bool(false));
            }
            schema.values_mut().for_each(complete_schemas);
        }
        _ => {}
    }
}

fn is_type(of: &Value, name: &str) -> bool {
    of == name || of.as_array().is_some_and(|several| several.iter().any(|one| one == name))
}

fn is_nullable(property: &Value) -> bool {
    let any = |key: &str| property[key].as_array().is_some_and(|several| several.iter().any(is_nullable));
    is_type(&property["type"], "null") || any("oneOf") || any("anyOf")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Path of the copy; tests run in their package's folder.
    const COPY: &str = "../web/openapi.json";
    /// Set to write the copy.
    const RENEW: &str = "ECHOLAKE_RENEW";

    #[test]
    fn contract_is_fresh() {
        if std::env::var_os(RENEW).is_some() {
            std::fs::write(COPY, DOCUMENT.as_str()).expect("the copy is written");
        }
        let written = std::fs::read_to_string(COPY).unwrap_or_default();
        let command = format!("{RENEW}=1 cargo test --profile quick --workspace contract_is_fresh");
        assert!(written == *DOCUMENT, "web/openapi.json is stale; `{command}` renews it, then `just api`");
    }
}
