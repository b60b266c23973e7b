//! What an endpoint answers.

use arrow::ipc::writer::StreamWriter;
use arrow::record_batch::RecordBatch;
use axum::http::{HeaderValue, header};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use echolake_service::RequestFault;
use serde::Serialize;
use serde_json::Value;

use super::super::problem::ProblemResponse;

pub(super) const ARROW: &str = "application/vnd.apache.arrow.stream";

/// The content of an answer.
pub(super) struct AnswerContent {
    media_type: &'static str,
    bytes: Bytes,
    /// File name under which a browser saves it.
    name: Option<String>,
}

impl AnswerContent {
    /// Bytes of a media type.
    pub fn new(media_type: &'static str, bytes: impl Into<Bytes>) -> Self {
        Self { media_type, bytes: bytes.into(), name: None }
    }

    /// The same, to be saved as a file of this name.
    #[must_use]
    pub fn with_name(mut self, name: String) -> Self {
        self.name = Some(name);
        self
    }

    /// A value as JSON; what is not finite becomes null.
    ///
    /// # Errors
    /// [`RequestFault::Internal`] if it cannot be written, which is a defect.
    pub fn encode_json(value: &impl Serialize) -> Result<Self, RequestFault> {
        let bytes = serde_json::to_vec(value).map_err(RequestFault::defect("an answer makes no JSON"))?;
        Ok(Self::new("application/json", bytes))
    }

    /// Reads JSON back as a value.
    ///
    /// # Errors
    /// As [`AnswerContent::encode_json`].
    pub fn decode_json(&self) -> Result<Value, RequestFault> {
        serde_json::from_slice(&self.bytes).map_err(RequestFault::defect("an answer is no JSON"))
    }

    /// Rows as an Arrow stream.
    ///
    /// # Errors
    /// As [`AnswerContent::encode_json`].
    pub fn encode_arrow(batch: &RecordBatch) -> Result<Self, RequestFault> {
        let written = || {
            let mut writer = StreamWriter::try_new(Vec::new(), &batch.schema())?;
            writer.write(batch)?;
            writer.into_inner()
        };
        let bytes = written().map_err(RequestFault::defect("an answer makes no Arrow stream"))?;
        Ok(Self::new(ARROW, bytes))
    }
}

impl IntoResponse for AnswerContent {
    fn into_response(self) -> Response {
        let mut response = ([(header::CONTENT_TYPE, self.media_type)], self.bytes).into_response();
        let name = self.name.map(|name| HeaderValue::try_from(format!("attachment; filename=\"{name}\"")));
        if let Some(Ok(name)) = name {
            response.headers_mut().insert(header::CONTENT_DISPOSITION, name);
        }
        response
    }
}

/// What the function of an endpoint returns.
pub(super) type EndpointAnswer = Result<AnswerContent, ProblemResponse>;
