//! `GET /api/v1/layouts/echolake.json`: how Foxglove and Lichtblick show a run or a slice. It says nothing of the lake,
//! so it needs no token.

use axum::Router;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::catalogue::is_known;
use super::ranges::{POLICY, cors};

/// The panel with the arms, the response that was heard last, the air, verdicts, the log.
const LAYOUT: &str = include_str!("layout.json");
/// Changes with the program.
const ETAG: &str = concat!("\"layout-", env!("CARGO_PKG_VERSION"), "\"");

/// The route of the layout. Lichtblick names a layout from a URL by its file name, and replaces its own layout of that
/// name.
pub(super) fn routes() -> OpenApiRouter {
    OpenApiRouter::new().routes(routes!(layout))
}

/// The layout for viewers on pages of any origin.
pub(super) fn for_viewers() -> Router {
    Router::from(routes()).method_not_allowed_fallback(super::wrong_method).layer(cors())
}

/// A layout for Foxglove and Lichtblick: panel and arms, response, air, measurement, log.
#[utoipa::path(
    get,
    path = "/api/v1/layouts/echolake.json",
    tag = "runs",
    responses((status = 200, description = "OK", body = HashMap<String, Value>))
)]
async fn layout(headers: HeaderMap) -> Response {
    let common = [
        (header::CONTENT_TYPE, "application/json"),
        (header::CACHE_CONTROL, "no-cache"),
        (header::ETAG, ETAG),
        (POLICY, "cross-origin"),
    ];
    match is_known(&headers, ETAG) {
        true => (StatusCode::NOT_MODIFIED, common).into_response(),
        false => (common, LAYOUT).into_response(),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use serde_json::Value;

    use super::*;
    use echolake_schema::topics;

    // What a mosaic's leaves name.
    fn panels(tree: &Value, found: &mut BTreeSet<String>) {
        match tree {
            Value::String(panel) => drop(found.insert(panel.clone())),
            _ => ["first", "second"].iter().for_each(|side| panels(&tree[*side], found)),
        }
    }

    #[test]
    fn every_panel_is_set_up_and_shows_what_a_run_has() {
        let layout: Value = serde_json::from_str(LAYOUT).expect("JSON");
        let mut shown = BTreeSet::new();
        panels(&layout["layout"], &mut shown);
        let set_up = layout["configById"].as_object().expect("panels");
        assert_eq!(shown, set_up.keys().cloned().collect());
        let known = [
            topics::TF,
            topics::PANEL_SCENE,
            topics::PANEL_POINTS,
            topics::MICROPHONE_POSE,
            topics::SPEAKER_POSE,
            topics::IR,
            topics::ENVIRONMENT,
            topics::MEASUREMENT,
            topics::LOG,
            topics::ROBOT_DESCRIPTION,
        ];
        let text = LAYOUT.to_owned();
        let named: BTreeSet<_> = text.split('"').filter(|t| t.starts_with('/')).collect();
        for name in &named {
            let topic = name.split('.').next().expect("a topic");
            assert!(known.contains(&topic), "{name}");
        }
        assert!(named.contains("/ir.samples[:]"));
    }
}
