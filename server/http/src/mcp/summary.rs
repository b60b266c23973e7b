//! `surface_summary` and `run_summary`: what the catalogue's pages show, with links to them.

use echolake_service::RequestFault;
use serde_json::{Value, json};

use super::tools::ToolCall;

/// Lines of a run's log.
const MOST_EVENTS: usize = 20;

impl ToolCall<'_> {
    /// A surface.
    ///
    /// # Errors
    /// [`RequestFault::NotFound`], or those of its queries.
    pub async fn surface_summary(&self, surface: &str) -> Result<Value, RequestFault> {
        let mut summary = self.agents.catalogue.surface_value(surface).await?;
        // A name that is found has letters, digits, `_` and `-` alone.
        let origin = self.origin;
        let path = format!("/surfaces/{surface}");
        summary["links"] = json!({
            "page": format!("{origin}{path}"),
            "mesh": format!("{origin}/api/v1{path}/mesh.glb"),
            "json": format!("{origin}/api/v1{path}"),
        });
        Ok(summary)
    }

    /// A run.
    ///
    /// # Errors
    /// [`RequestFault::NotFound`], or those of its queries.
    pub async fn run_summary(&self, run: &str) -> Result<Value, RequestFault> {
        let mut summary = self.agents.catalogue.run_value(run).await?;
        if let Some(events) = summary["events"].as_array_mut() {
            let left_out = events.len().saturating_sub(MOST_EVENTS);
            events.drain(..left_out);
            summary["events_left_out"] = left_out.into();
        }
        let origin = self.origin;
        let path = format!("/runs/{run}");
        summary["links"] = json!({
            "page": format!("{origin}{path}"),
            "file": format!("{origin}/api/v1{path}/file.mcap"),
            "foxglove_manifest": format!("{origin}/api/v1/foxglove/manifest?run={run}"),
            "json": format!("{origin}/api/v1{path}"),
        });
        Ok(summary)
    }
}
