//! What a run's file has outside of its chunks: manifest, rig, surface, heights.

use std::collections::BTreeMap;

use bytes::Bytes;
use echolake_lake::Lake;
use echolake_recording::{Metadata, ResyncItem, ResyncReader};
use echolake_schema::manifest::{Origin, RunManifest};
use echolake_schema::{ErrorCause, Rig, SurfaceId, SurfaceRecord, topics};

use crate::error::{Error, Result};
use crate::inbox::OpenedRun;

/// The records outside of chunks, as far as ingest needs them: a file may have any number of others.
#[derive(Default)]
pub(super) struct RunEnvelope {
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
    attachments: BTreeMap<String, Bytes>,
}

const NEEDED_METADATA: [&str; 4] =
    [topics::RUN_METADATA, topics::RUN_PLAN_METADATA, topics::RUN_END_METADATA, topics::RECOVERY_METADATA];
const NEEDED_ATTACHMENTS: [&str; 3] = [topics::RIG_ATTACHMENT, topics::SURFACE_ATTACHMENT, topics::HEIGHTS_ATTACHMENT];
/// Largest heights that are kept: those of 2048 by 2048 points.
const LARGEST_HEIGHTS: usize = 16 << 20;
/// Largest text that is kept; what it is parsed to is a multiple of it.
const LARGEST_TEXT: usize = 1 << 20;

/// The records of a run before its first measurement.
#[derive(Debug)]
pub(crate) struct RunHead {
    pub surface: SurfaceId,
    pub references: Vec<SurfaceId>,
    pub origin: Origin,
    /// It has the plan by which the run is resumed.
    pub has_plan: bool,
    pub rig: Option<Rig>,
}

impl RunHead {
    /// Reads them; None if the file does not begin as a run.
    pub async fn read_from(opened: &OpenedRun) -> Option<Self> {
        let store = opened.store.clone();
        let path = opened.path.clone();
        let mut reader = ResyncReader::open(store, path, opened.name.clone()).await.ok()?.without_digest();
        let mut envelope = RunEnvelope::default();
        while let Ok(Some(item)) = reader.next_item().await {
            match item {
                ResyncItem::Attachment(found) => envelope.keep_attachment(found.name, found.data),
                ResyncItem::Metadata(record) => envelope.keep_metadata(record),
                ResyncItem::Definition(_) => {}
                ResyncItem::Chunk(_) => break,
            }
        }
        let manifest = RunManifest::from_metadata(envelope.metadata.get(topics::RUN_METADATA)?).ok()?;
        let surface = envelope.parse_surface(&opened.name).ok()?;
        let references = [surface.flat_reference, surface.foam_reference].into_iter().flatten().collect();
        let has_plan = envelope.metadata.contains_key(topics::RUN_PLAN_METADATA);
        let rig = envelope.parse_rig(&opened.name).ok();
        Some(Self { surface: manifest.surface_id, references, origin: manifest.origin, has_plan, rig })
    }
}

impl RunEnvelope {
    // The first of a name counts.
    pub fn keep_attachment(&mut self, name: String, data: Bytes) {
        let most = if name == topics::HEIGHTS_ATTACHMENT { LARGEST_HEIGHTS } else { LARGEST_TEXT };
        if NEEDED_ATTACHMENTS.contains(&name.as_str()) && data.len() <= most {
            // A copy: the bytes are part of whatever was fetched with them.
            self.attachments.entry(name).or_insert_with(|| Bytes::copy_from_slice(&data));
        }
    }

    pub fn keep_metadata(&mut self, record: Metadata) {
        if NEEDED_METADATA.contains(&record.name.as_str()) {
            self.metadata.entry(record.name).or_insert(record.metadata);
        }
    }

    // Other writers may put what the run is behind its first chunks.
    pub fn is_complete(&self) -> bool {
        self.metadata.contains_key(topics::RUN_METADATA) && self.attachments.contains_key(topics::RIG_ATTACHMENT)
    }

    // Checked before chunks are measured where that can be, so that a wrong file costs nothing.
    pub fn checked_manifest(&self, lake: &Lake, name: &str) -> Result<RunManifest> {
        let Some(record) = self.metadata.get(topics::RUN_METADATA) else {
            return Err(Error::Foreign { file: name.to_owned() });
        };
        let manifest =
            RunManifest::from_metadata(record).map_err(|cause| Error::Manifest { file: name.to_owned(), cause })?;
        lake.check_rig(&self.parse_rig(name)?)?;
        Ok(manifest)
    }

    fn parse_rig(&self, name: &str) -> Result<Rig> {
        let wrong = |source: ErrorCause| Error::Attachment {
            file: name.to_owned(),
            attachment: topics::RIG_ATTACHMENT,
            source,
        };
        let bytes = self.attachments.get(topics::RIG_ATTACHMENT).ok_or_else(|| wrong("is missing".into()))?;
        let text = std::str::from_utf8(bytes).map_err(|e| wrong(format!("is no text: {e}").into()))?;
        Rig::from_toml(text).map_err(|e| wrong(e.into()))
    }

    pub fn parse_surface(&self, name: &str) -> Result<SurfaceRecord> {
        let wrong = |source: ErrorCause| Error::Attachment {
            file: name.to_owned(),
            attachment: topics::SURFACE_ATTACHMENT,
            source,
        };
        let bytes = self.attachments.get(topics::SURFACE_ATTACHMENT).ok_or_else(|| wrong("is missing".into()))?;
        serde_json::from_slice(bytes).map_err(|e| wrong(e.into()))
    }

    pub fn decode_heights(&self) -> Vec<f32> {
        let bytes = self.attachments.get(topics::HEIGHTS_ATTACHMENT).map_or(&[][..], |b| &b[..]);
        bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
    }
}
