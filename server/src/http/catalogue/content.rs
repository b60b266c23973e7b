//! An answer's bytes, packed once.

use std::sync::OnceLock;

use arrow::ipc::writer::StreamWriter;
use arrow::record_batch::RecordBatch;
use axum::http::HeaderMap;
use bytes::Bytes;
use serde::Serialize;

use super::super::format::takes;
use crate::fault::RequestFault;

pub(super) const ARROW: &str = "application/vnd.apache.arrow.stream";
/// Shorter answers fit a packet or two as they are.
const WORTH_PACKING: usize = 2000;
/// Of zlib's levels: a tenth larger than with 6, in a third of the time.
const LEVEL: u8 = 3;
/// gzip's first ten bytes: deflate, no name, no time, unknown system (RFC 1952).
const GZIP_HEAD: [u8; 10] = [0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 255];

/// An answer.
pub(super) struct AnswerContent {
    pub(super) media_type: &'static str,
    pub(super) bytes: Bytes,
    /// File name under which a browser saves it.
    pub(super) name: Option<String>,
    packed: OnceLock<Bytes>,
}

impl AnswerContent {
    /// Bytes of a media type.
    pub(super) fn new(media_type: &'static str, bytes: impl Into<Bytes>) -> Self {
        Self { media_type, bytes: bytes.into(), name: None, packed: OnceLock::new() }
    }

    /// The same, to be saved as a file of this name.
    #[must_use]
    pub(super) fn named(mut self, name: String) -> Self {
        self.name = Some(name);
        self
    }

    /// A value as JSON; what is not finite becomes null.
    ///
    /// # Errors
    /// [`RequestFault::Internal`] if it cannot be written, which is a defect.
    pub(super) fn json(value: &impl Serialize) -> Result<Self, RequestFault> {
        let bytes = serde_json::to_vec(value).map_err(|e| {
            eprintln!("an answer makes no JSON: {e}");
            RequestFault::Internal
        })?;
        Ok(Self::new("application/json", bytes))
    }

    /// Rows as an Arrow stream.
    ///
    /// # Errors
    /// As [`AnswerContent::json`].
    pub(super) fn arrow(batch: &RecordBatch) -> Result<Self, RequestFault> {
        let written = || {
            let mut writer = StreamWriter::try_new(Vec::new(), &batch.schema())?;
            writer.write(batch)?;
            writer.into_inner()
        };
        let bytes = written().map_err(|e| {
            eprintln!("an answer makes no Arrow stream: {e}");
            RequestFault::Internal
        })?;
        Ok(Self::new(ARROW, bytes))
    }

    /// Returns its size in memory, in bytes.
    pub(super) fn weight(&self) -> usize {
        self.bytes.len() + self.packed.get().map_or(0, Bytes::len) + self.name.as_ref().map_or(0, String::len)
    }

    /// The bytes to send, and whether they are packed.
    pub(super) fn body(&self, headers: &HeaderMap) -> (Bytes, bool) {
        let packs = matches!(self.media_type, "application/json" | "application/octet-stream" | ARROW);
        if !packs || self.bytes.len() < WORTH_PACKING || !takes(headers, "gzip") {
            return (self.bytes.clone(), false);
        }
        (self.packed.get_or_init(|| gzip(&self.bytes)).clone(), true)
    }
}

fn gzip(bytes: &[u8]) -> Bytes {
    let mut file = GZIP_HEAD.to_vec();
    file.extend(miniz_oxide::deflate::compress_to_vec(bytes, LEVEL));
    file.extend(crc32fast::hash(bytes).to_le_bytes());
    file.extend((bytes.len() as u32).to_le_bytes());
    file.into()
}

#[cfg(test)]
mod tests {
    use axum::http::header;

    use super::*;

    #[test]
    fn long_answers_are_packed_for_those_who_take_it() {
        let content = AnswerContent::new("application/json", vec![b'7'; 5000]);
        let accepting = |value: &str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::ACCEPT_ENCODING, value.parse().expect("a value"));
            content.body(&headers)
        };
        let (packed, is_packed) = accepting("br, gzip;q=0.9");
        assert!(is_packed && packed.len() < 100);
        let end = packed.len() - 8;
        let plain = miniz_oxide::inflate::decompress_to_vec(&packed[10..end]).expect("deflated");
        assert_eq!(plain, content.bytes);
        assert_eq!(packed[end..end + 4], crc32fast::hash(&plain).to_le_bytes());
        for other in ["identity", "gzip;q=0", "br"] {
            assert!(!accepting(other).1, "{other}");
        }
        assert!(!AnswerContent::new("image/png", vec![0; 5000]).body(&HeaderMap::new()).1);
    }
}
