//! That the catalogue's table, and what else is routed, is what the contract says.

use std::collections::BTreeSet;

use serde_json::Value;

use super::super::{files, openapi};
use super::ENDPOINTS;

#[test]
fn paths_are_those_of_the_contract() {
    let document: Value = serde_json::from_str(openapi::DOCUMENT).expect("JSON");
    let contract: BTreeSet<_> = document["paths"].as_object().expect("paths").keys().map(String::as_str).collect();
    let others = [
        "/api/v1/sql",
        "/api/v1/session",
        "/api/v1/openapi.json",
        "/api/v1/files",
        "/api/v1/slices.mcap",
        "/api/v1/foxglove/manifest",
        "/api/v1/layouts/echolake.json",
        "/metrics",
        "/health",
    ];
    let routed: BTreeSet<_> =
        ENDPOINTS.iter().map(|e| e.path).chain([files::RUN, files::TABLE]).chain(others).collect();
    assert_eq!(routed, contract);
}

#[test]
fn the_contract_knows_every_code() {
    let document: Value = serde_json::from_str(openapi::DOCUMENT).expect("JSON");
    let known = &document["components"]["schemas"]["Problem"]["properties"]["code"]["enum"];
    let known: BTreeSet<_> = known.as_array().expect("codes").iter().filter_map(Value::as_str).collect();
    assert_eq!(known, crate::fault::FaultCode::ALL.iter().map(|code| code.name()).collect());
}
