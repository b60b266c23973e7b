//! `slice_url`: the address of an MCAP file of chosen measurements.

use echolake_service::RequestFault;
use serde_json::{Value, json};

use super::super::slices::SliceParameters;
use super::tools::{SliceArguments, ToolCall};

impl ToolCall<'_> {
    /// The addresses of a slice, and what is in it.
    ///
    /// # Errors
    /// A defect of the predicate, a missing scope, or a slice without measurements.
    pub async fn slice_url(&self, wanted: SliceArguments) -> Result<Value, RequestFault> {
        let params = SliceParameters::new(wanted.predicate, wanted.runs, wanted.topics);
        let slice = self.agents.slices.slice_address(params).await?;
        let origin = self.origin;
        Ok(json!({
            "url": format!("{origin}{}", slice.path),
            "foxglove_manifest": format!("{origin}{}", slice.manifest_path),
            "measurements": slice.measurements,
            "runs": slice.runs,
            "note": "an MCAP file; the same token opens it: Authorization: Bearer TOKEN",
        }))
    }
}
