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
    pub topic: String,
    pub schema: String,
}

/// Schemas and channels seen so far; a channel comes behind its schema.
#[derive(Debug, Default, Clone)]
pub(crate) struct RunDefinitions {
    schemas: HashMap<u16, String>,
    /// Chunks that are being measured share them.
    pub channels: Arc<RunChannels>,
}

impl RunDefinitions {
    /// Learns a definition outside of chunks. The first of an id counts: a chunk's definitions have its CRC, those of
    /// the summary may be damaged.
    pub fn learn_definition(&mut self, record: &Record<'_>) {
        match record {
            Record::Schema { header, .. } => {
                self.schemas.entry(header.id).or_insert_with(|| kept_name(&header.name));
            }
            Record::Channel(channel) if !self.channels.contains_key(&channel.id) => {
                let described = self.describe_channel(channel);
                Arc::make_mut(&mut self.channels).insert(channel.id, described);
            }
            _ => {}
        }
    }

    /// Learns the schemas and channels that a chunk introduces.
    ///
    /// # Errors
    /// What is different, if an id is used again for something else: nobody could tell whose the messages are.
    pub fn learn_chunk(&mut self, chunk: &DecodedChunk) -> Result<(), String> {
        for (code, body) in chunk.records().filter(|(code, _)| matches!(*code, opcode::SCHEMA | opcode::CHANNEL)) {
            let Ok(record) = parse_record(code, body) else { continue };
            self.learn_definition(&record);
            match &record {
                Record::Schema { header, .. } => {
                    let known = self.schemas.get(&header.id);
                    let now = kept_name(&header.name);
                    if let Some(known) = known.filter(|known| **known != now) {
                        return Err(format!("schema {} is used again: it is `{known}`, and now `{now}`", header.id));
                    }
                }
                Record::Channel(channel) => {
                    let known = self.channels.get(&channel.id);
                    let now = self.describe_channel(channel);
                    if let Some(known) = known.filter(|known| **known != now) {
                        let topics = [&known.topic, &now.topic];
                        let schemas = [&known.schema, &now.schema];
                        return Err(format!(
                            "channel {} is used again: it is `{}` of `{}`, and now `{}` of `{}`",
                            channel.id, topics[0], schemas[0], topics[1], schemas[1]
                        ));
                    }
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn describe_channel(&self, channel: &echolake_recording::ChannelRecord) -> RunChannel {
        let schema = self.schemas.get(&channel.schema_id).cloned().unwrap_or_default();
        RunChannel { topic: kept_name(&channel.topic), schema }
    }

    /// Returns whether the channels of all messages of a chunk are known.
    pub fn has_channels_of(&self, chunk: &DecodedChunk) -> bool {
        chunk.messages().all(|message| self.channels.contains_key(&message.channel))
    }
}

fn kept_name(name: &str) -> String {
    if name.len() <= LONGEST_NAME { name.to_owned() } else { String::new() }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use bytes::Bytes;
    use echolake_recording::{RecordSplitter, Writer};

    use super::*;

    /// A chunk that describes channel 1.
    fn chunk(schema: &str, topic: &str) -> DecodedChunk {
        let mut file = Cursor::new(Vec::new());
        let mut writer = Writer::new(&mut file).expect("a writer");
        writer.add_schema_with_id(1, schema, "protobuf", b"x").expect("added");
        writer.add_channel_with_id(1, 1, topic, "protobuf", &Default::default()).expect("added");
        writer.finish().expect("finished");
        drop(writer);
        let mut splitter = RecordSplitter::new(8);
        splitter.push_bytes(&file.into_inner()[8..]);
        loop {
            let record = splitter.next_record().expect("sound").expect("a chunk");
            if record.code == opcode::CHUNK {
                return DecodedChunk::decode(&Bytes::copy_from_slice(&record.body)).expect("sound");
            }
        }
    }

    #[test]
    fn a_channel_or_schema_that_is_used_again_for_something_else_is_refused() {
        let mut definitions = RunDefinitions::default();
        for _ in 0..2 {
            assert_eq!(definitions.learn_chunk(&chunk("a.A", "/a")), Ok(()));
        }
        for (schema, topic, expected) in
            [("a.A", "/b", "channel 1 is used again"), ("b.B", "/a", "schema 1 is used again")]
        {
            let refused = definitions.clone().learn_chunk(&chunk(schema, topic)).expect_err(expected);
            assert!(refused.starts_with(expected) && refused.contains("/a") | refused.contains("a.A"), "{refused}");
        }
    }
}
