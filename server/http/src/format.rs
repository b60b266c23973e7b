//! Formats of answers: their negotiation and their encoding.

use std::io::{self, Write};
use std::mem::take;
use std::sync::{Arc, Mutex, PoisonError};

use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use axum::http::{HeaderMap, header};
use bytes::Bytes;
use echolake_query::output::{AnswerFormat, AnswerWriter};
use echolake_service::RequestFault;
use echolake_service::running::AnswerEncoder;

/// The formats of answers, each with its media types, the first of them ours.
const FORMATS: [(AnswerFormat, &[&str]); 4] = [
    (AnswerFormat::Json, &["application/json", "application/*", "*/*"]),
    (AnswerFormat::Arrow, &["application/vnd.apache.arrow.stream"]),
    (AnswerFormat::Csv, &["text/csv", "text/*"]),
    (AnswerFormat::Parquet, &["application/vnd.apache.parquet", "application/x-parquet"]),
];

/// The format of this name.
pub(super) fn format_by_name(name: &str) -> Result<AnswerFormat, RequestFault> {
    let known = FORMATS.iter().map(|(format, _)| *format).find(|f| f.name() == name);
    known.ok_or_else(|| RequestFault::bad_request(format!("no format `{name}`; hint: {}", format_names().join(", "))))
}

/// The names of all formats.
pub(super) fn format_names() -> [&'static str; 4] {
    FORMATS.map(|(format, _)| format.name())
}

/// The format that an `Accept` header likes best.
pub(super) fn accepted_format(accept: &str) -> Result<AnswerFormat, RequestFault> {
    let mut best: Option<(f32, AnswerFormat)> = None;
    for range in accept.split(',') {
        let mut parts = range.split(';').map(str::trim);
        let kind = parts.next().unwrap_or_default().to_ascii_lowercase();
        let quality = parts.find_map(|p| p.strip_prefix("q=")).map_or(1.0, |q| q.parse().unwrap_or(0.0));
        let known = FORMATS.iter().find(|(_, types)| types.contains(&kind.as_str()));
        if let Some((format, _)) = known
            && quality > best.map_or(0.0, |(q, _)| q)
        {
            best = Some((quality, *format));
        }
    }
    best.map(|(_, format)| format).ok_or_else(|| {
        let types: Vec<_> = FORMATS.iter().map(|(_, types)| types[0]).collect();
        RequestFault::bad_request(format!("nothing in `Accept: {accept}` can be had; hint: {}", types.join(", ")))
    })
}

/// Returns whether an Arrow stream is preferred to JSON.
pub fn prefers_arrow(headers: &HeaderMap) -> bool {
    let accept = headers.get(header::ACCEPT).and_then(|v| v.to_str().ok()).unwrap_or_default();
    accepted_format(accept).is_ok_and(|format| format == AnswerFormat::Arrow)
}

/// Returns whether the client accepts an encoding of HTTP.
pub fn accepts_encoding(headers: &HeaderMap, encoding: &str) -> bool {
    let accepted = headers.get(header::ACCEPT_ENCODING).and_then(|v| v.to_str().ok()).unwrap_or_default();
    accepted.split(',').any(|one| {
        let mut parts = one.split(';').map(str::trim);
        parts.next() == Some(encoding) && !parts.any(|p| p == "q=0")
    })
}

/// The media type of a format.
pub(super) fn media_type(format: AnswerFormat) -> &'static str {
    let format = if format == AnswerFormat::SpreadsheetCsv { AnswerFormat::Csv } else { format };
    FORMATS.iter().find(|(known, _)| *known == format).map_or("application/octet-stream", |(_, types)| types[0])
}

/// Writes an answer into bytes that are taken as they come.
pub(super) struct FormatEncoder {
    writer: AnswerWriter<SharedBuffer>,
    written: SharedBuffer,
}

#[derive(Clone, Default)]
struct SharedBuffer(Arc<Mutex<Vec<u8>>>);

impl SharedBuffer {
    fn take_bytes(&self) -> Vec<Bytes> {
        let bytes = take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner));
        if bytes.is_empty() { Vec::new() } else { vec![bytes.into()] }
    }
}

impl Write for SharedBuffer {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl FormatEncoder {
    /// Begins an answer of this schema.
    pub fn new(format: AnswerFormat, schema: &SchemaRef) -> Result<Self, RequestFault> {
        let written = SharedBuffer::default();
        Ok(Self { writer: AnswerWriter::new(format, schema, written.clone())?, written })
    }
}

impl AnswerEncoder for FormatEncoder {
    type Item = Bytes;

    fn encode_batch(&mut self, batch: RecordBatch) -> Result<Vec<Bytes>, RequestFault> {
        self.writer.write(&batch)?;
        Ok(self.written.take_bytes())
    }

    fn encode_end(self) -> Result<Vec<Bytes>, RequestFault> {
        self.writer.finish()?;
        Ok(self.written.take_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_liked_format_is_chosen() {
        for (accept, expected) in [
            ("*/*", Some(AnswerFormat::Json)),
            ("text/csv", Some(AnswerFormat::Csv)),
            ("text/html,application/xhtml+xml,*/*;q=0.8", Some(AnswerFormat::Json)),
            ("application/json;q=0.1, application/vnd.apache.arrow.stream", Some(AnswerFormat::Arrow)),
            ("text/csv;q=0.5, application/vnd.apache.parquet;q=0.9", Some(AnswerFormat::Parquet)),
            ("TEXT/CSV; charset=utf-8", Some(AnswerFormat::Csv)),
            ("text/html", None),
            ("application/json;q=0", None),
            ("", None),
        ] {
            assert_eq!(accepted_format(accept).ok(), expected, "{accept}");
        }
    }

    #[test]
    fn formats_have_names_and_types() {
        for (format, types) in FORMATS {
            assert_eq!(format_by_name(format.name()).ok(), Some(format));
            assert_eq!(media_type(format), types[0]);
            assert_eq!(accepted_format(types[0]).ok(), Some(format));
        }
        assert!(format_by_name("table").is_err_and(|e| e.to_string().contains("json, arrow, csv, parquet")));
    }
}
