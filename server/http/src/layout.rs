//! `GET /api/v1/layouts/echolake.json`: how Foxglove and Lichtblick show a run or a slice. Of the lake it has only the
//! length and the rate of responses, so it needs no token.

use std::sync::Arc;

use axum::Router;
use axum::extract::State;
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse as _, Response};
use echolake_dsp::chain::raw_len;
use echolake_dsp::temperature::ReferenceAir;
use echolake_schema::Rig;
use sha2::{Digest as _, Sha256};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::conditions::ConditionOutcome;
use super::ranges::{POLICY, cors_layer};

/// The panel with the arms, the response that was heard last, the air, verdicts, the log. Repeated fields come first in
/// Lichtblick's table of a message, which has no choice of columns, so verdicts are shown as a list of fields.
const TEMPLATE: &str = include_str!("layout.json");
/// The template's mark for a response's last sample. Without a limit Lichtblick shows no response while messages of
/// other topics come.
const LAST_SAMPLE: &str = "\"LAST_SAMPLE\"";
/// Its mark for the rate of responses.
const RATE_KHZ: &str = "RATE_KHZ";

/// The layout for the runs of a lake.
#[derive(Clone)]
pub struct ViewerLayout {
    text: Arc<str>,
    etag: Arc<str>,
}

impl ViewerLayout {
    /// The layout for runs of a rig.
    pub fn new(rig: &Rig) -> Self {
        let length = raw_len(rig.impulse_response.length, &ReferenceAir::from_response(&rig.impulse_response));
        let rate_khz = rig.sweep.rate_hz.get() / 1e3;
        let text = TEMPLATE
            .replace(LAST_SAMPLE, &length.saturating_sub(1).to_string())
            .replace(RATE_KHZ, &rate_khz.to_string());
        let etag = format!("\"{}\"", hex::encode(&Sha256::digest(&text)[..16]));
        Self { text: text.into(), etag: etag.into() }
    }
}

/// The route of the layout. Lichtblick names a layout from a URL by its file name, and replaces its own layout of that
/// name.
pub(super) fn layout_routes() -> OpenApiRouter<ViewerLayout> {
    OpenApiRouter::new().routes(routes!(layout))
}

/// The layout for viewers on pages of any origin.
pub fn for_viewers(layout: ViewerLayout) -> Router {
    Router::from(layout_routes())
        .method_not_allowed_fallback(super::problem::refuse_method)
        .layer(cors_layer())
        .with_state(layout)
}

/// A layout for Foxglove and Lichtblick: panel and arms, response, air, measurement, log.
#[utoipa::path(
    get,
    path = "/api/v1/layouts/echolake.json",
    tag = "runs",
    responses((status = 200, description = "OK", body = HashMap<String, Value>))
)]
async fn layout(State(layout): State<ViewerLayout>, headers: HeaderMap) -> Response {
    let common = [
        (header::CONTENT_TYPE, "application/json"),
        (header::CACHE_CONTROL, "no-cache"),
        (header::ETAG, &layout.etag),
        (POLICY, "cross-origin"),
    ];
    let instead = ConditionOutcome::new(&headers, &layout.etag).early_response(&layout.etag, common.clone());
    instead.unwrap_or_else(|| (common, layout.text.to_string()).into_response())
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
        let text = ViewerLayout::new(&Rig::paper()).text;
        let layout: Value = serde_json::from_str(&text).expect("JSON");
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
        let named: BTreeSet<_> = text.split('"').filter(|t| t.starts_with('/')).collect();
        for name in &named {
            let topic = name.split('.').next().expect("a topic");
            assert!(known.contains(&topic), "{name}");
        }
        assert!(named.contains("/ir.samples[:]"));
        let response = &layout["configById"]["Plot!response"];
        assert_eq!(response["maxXValue"], 461, "the rig's, and some more for cold air");
        assert_eq!(response["lichtblickPanelTitle"], "Impulse response by sample, 96 kHz");
    }
}
