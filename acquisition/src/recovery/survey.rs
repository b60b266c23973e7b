//! What is whole of a recording, found in one walk over it before anything is written.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use echolake_recording::{Channel, ChannelDefinitions, FileIntegrity, Record, RecordingItem, RecordingReader};
use echolake_schema::manifest::RunManifest;
use echolake_schema::topics;

use super::{Error, MessageCounts, Report};
use crate::run::recorder::{SOFTWARE, own_channels};

/// What is whole of a recording.
pub(crate) struct RecordingSurvey {
    /// The file's channels. What describes them may stand anywhere in it.
    pub channels: BTreeMap<u16, Arc<Channel<'static>>>,
    /// Metadata by name; the first of a name counts.
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
    /// The rig's attachment.
    pub rig: Option<String>,
    /// Messages by topic.
    pub counts: MessageCounts,
    chunks: u64,
    integrity: FileIntegrity,
}

impl RecordingSurvey {
    /// Reads a recording.
    ///
    /// # Errors
    /// [`Error::Read`], [`Error::Headless`] if it is no MCAP file, [`Error::Unusable`] if its channels contradict each
    /// other.
    pub fn from_file(path: &Path) -> Result<Self, Error> {
        let mut walk = RecordingReader::open(path)?;
        let mut definitions = ChannelDefinitions::default();
        let mut metadata = BTreeMap::new();
        let mut rig = None;
        let mut by_channel = BTreeMap::new();
        let mut chunks = 0;
        while let Some(item) = walk.next_item()? {
            match item {
                RecordingItem::Metadata(m) => drop(metadata.entry(m.name).or_insert(m.metadata)),
                RecordingItem::Attachment(a) if a.name == topics::RIG_ATTACHMENT => {
                    rig = String::from_utf8(a.data.to_vec()).ok();
                }
                RecordingItem::Attachment(_) => {}
                // Those of a chunk have a CRC and count for more.
                RecordingItem::Definition(record) => drop(definitions.learn_definition(&record)),
                RecordingItem::Chunk(chunk) => {
                    chunks += 1;
                    for record in &chunk.records {
                        definitions.learn_definition(record).map_err(|what| Error::Unusable {
                            path: path.to_owned(),
                            source: format!("the chunk at byte {}: {what}", chunk.offset).into(),
                        })?;
                        if let Record::Message { header, .. } = record {
                            *by_channel.entry(header.channel_id).or_insert(0) += 1;
                        }
                    }
                }
            }
        }
        let integrity = walk.finish()?;
        let counts = MessageCounts::new();
        let channels = definitions.into_channels();
        let mut survey = Self { channels, metadata, rig, counts, chunks, integrity };
        survey.name_channels(&by_channel);
        Ok(survey)
    }

    // The chunk that describes the channels may be damaged, and a recording that was cut off has no summary. Its
    // channels are then those that this version's recorder gives every run.
    fn name_channels(&mut self, by_channel: &BTreeMap<u16, u64>) {
        let is_unknown = |survey: &Self, id: &u16| !survey.channels.contains_key(id);
        let is_ours =
            self.metadata.get(topics::RUN_METADATA).and_then(|m| m.get("software")).is_some_and(|s| s == SOFTWARE);
        if is_ours && by_channel.keys().any(|id| is_unknown(self, id)) {
            for (id, channel) in own_channels() {
                self.channels.entry(id).or_insert(channel);
            }
        }
        for (id, count) in by_channel {
            match self.channels.get(id) {
                Some(channel) => *self.counts.entry(channel.topic.clone()).or_default() += count,
                None => {
                    self.integrity.damage.push(format!("{count} messages of channel {id}, which no record describes"))
                }
            }
        }
        self.integrity.is_data_whole &= !by_channel.keys().any(|id| is_unknown(self, id));
    }

    /// Returns the run's manifest.
    ///
    /// # Errors
    /// [`Error::Headless`] if nothing was measured, [`Error::Unusable`] if something was and no run can be made of it.
    pub fn run_manifest(&self, path: &Path) -> Result<RunManifest, Error> {
        let path = path.to_owned();
        let found = self.integrity.damage.first().cloned().unwrap_or_else(|| "it ends".to_owned());
        let whole = format!("{} chunks of it are whole", self.chunks);
        let manifest = self.metadata.get(topics::RUN_METADATA).map(RunManifest::from_metadata);
        let fault = match manifest {
            _ if self.chunks == 0 => {
                return Err(Error::Headless { path, source: format!("{found}, and no chunk of it is whole").into() });
            }
            Some(_) if self.counts.is_empty() && self.channels.is_empty() => {
                format!("nothing describes its channels, though {whole}")
            }
            None => format!("its manifest is missing or damaged, though {whole}"),
            Some(Err(e)) => format!("{e}, though {whole}"),
            Some(Ok(manifest)) if self.is_undamaged() || manifest.fits_file_name(&path.to_string_lossy()) => {
                return Ok(manifest);
            }
            Some(Ok(manifest)) => format!(
                "it is damaged, and its manifest may be: it says run `{}`, which is not the file's name; if it is \
                 right, name the file after the run",
                manifest.run_id
            ),
        };
        Err(Error::Unusable { path, source: fault.into() })
    }

    /// Returns whether it says how its run ended.
    pub fn has_end(&self) -> bool {
        self.metadata.contains_key(topics::RUN_END_METADATA)
    }

    /// Returns whether the file was closed and nothing in it is damaged.
    pub fn is_undamaged(&self) -> bool {
        self.integrity.closed && self.integrity.damage.is_empty()
    }

    /// Returns what is damaged, in words; nothing if it is the summary alone, which can be made again.
    pub fn damage(&self) -> &[String] {
        if self.integrity.is_data_whole { &[] } else { &self.integrity.damage }
    }

    /// Returns the bytes that are lost, and the file's size.
    pub fn loss_and_size(&self) -> (&[Range<u64>], u64) {
        (&self.integrity.lost, self.integrity.bytes)
    }

    /// Returns the report of a recording that was only read.
    pub fn survey_report(&self, from: &Path) -> Report {
        let FileIntegrity { bytes, lost, .. } = &self.integrity;
        let lost_bytes: u64 = lost.iter().map(|range| range.end - range.start).sum();
        Report {
            from: from.to_owned(),
            to: None,
            bytes: *bytes,
            verified_bytes: bytes - lost_bytes,
            messages: self.counts.clone(),
            has_end: self.has_end(),
            damage: self.damage().to_vec(),
            lost: lost.clone(),
        }
    }
}
