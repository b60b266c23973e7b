//! The channels of a run's file, as far as ingest needs them: topics and names of schemas.

use std::collections::HashMap;
use std::sync::Arc;

use echolake_recording::{DecodedChunk, Record, opcode, parse_record};

/// Bytes of the longest name of a topic or schema that is kept. None that ingest knows is as long.
const LONGEST_NAME: usize = 256;

/// Channels by their ids.
pub(crate) type RunChannels = HashMap<u16, RunChannel>;

/// A channel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct RunChannel {
    pub(crate) topic: String,
    pub(crate) schema: String,
}

/// Schemas and channels seen so far; a channel comes behind its schema.
#[derive(Debug, Default, Clone)]
pub(crate) struct RunDefinitions {
    schemas: HashMap<u16, String>,
    /// Chunks that are being measured share them.
    pub(crate) channels: Arc<RunChannels>,
}

impl RunDefinitions {
    /// Learns a definition. The first of an id counts: a chunk's definitions have its CRC, those of the summary may be
    /// damaged.
    pub(crate) fn learn(&mut self, record: &Record<'_>) {
        match record {
            Record::Schema { header, .. } => {
                self.schemas.entry(header.id).or_insert_with(|| kept_name(&header.name));
            }
            Record::Channel(channel) if !self.channels.contains_key(&channel.id) => {
                let schema = self.schemas.get(&channel.schema_id).cloned().unwrap_or_default();
                let channels = Arc::make_mut(&mut self.channels);
                channels.insert(channel.id, RunChannel { topic: kept_name(&channel.topic), schema });
            }
            _ => {}
        }
    }

    /// Learns the schemas and channels that a chunk introduces.
    pub(crate) fn learn_chunk(&mut self, chunk: &DecodedChunk) {
        for (code, body) in chunk.records().filter(|(code, _)| matches!(*code, opcode::SCHEMA | opcode::CHANNEL)) {
            if let Ok(record) = parse_record(code, body) {
                self.learn(&record);
            }
        }
    }

    /// Returns whether the channels of all messages of a chunk are known.
    pub(crate) fn knows(&self, chunk: &DecodedChunk) -> bool {
        chunk.messages().all(|message| self.channels.contains_key(&message.channel))
    }
}

fn kept_name(name: &str) -> String {
    if name.len() <= LONGEST_NAME { name.to_owned() } else { String::new() }
}
