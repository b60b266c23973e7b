//! Takes what is whole of one recording into another: messages, attachments and metadata as they are, chunks anew.

use std::collections::{BTreeMap, HashMap};

use echolake_recording::{ChunkLane, ChunkWriter, McapResult, MessageHeader, PrefixItem, Record};
use echolake_schema::topics;

/// Messages of each topic.
pub(crate) type Counts = BTreeMap<String, u64>;

/// A copy that is being made.
pub(crate) struct Copy<'a> {
    out: &'a mut ChunkWriter,
    channels: HashMap<u16, (String, ChunkLane)>,
    /// What was copied so far.
    pub(crate) counts: Counts,
    /// The highest number of a message.
    pub(crate) sequence: u32,
}

impl<'a> Copy<'a> {
    /// A copy into `out`.
    pub(crate) fn new(out: &'a mut ChunkWriter) -> Self {
        Self { out, channels: HashMap::new(), counts: Counts::new(), sequence: 0 }
    }

    /// Copies one thing, of a chunk only the messages that `keep` wants.
    ///
    /// # Errors
    /// The writer's.
    pub(crate) fn take(
        &mut self,
        item: PrefixItem,
        keep: &dyn Fn(ChunkLane, &MessageHeader) -> bool,
    ) -> McapResult<()> {
        match item {
            PrefixItem::Chunk(records) => {
                for record in records {
                    self.record(record, keep)?;
                }
                // In the order of their parts as soon as one is large: a verdict never gets ahead of its recording.
                [ChunkLane::Sweeps, ChunkLane::Responses, ChunkLane::Light]
                    .into_iter()
                    .try_for_each(|p| self.out.end_large(p))
            }
            PrefixItem::Attachment(attachment) => {
                self.out.end_all()?;
                self.out.mcap.attach(&attachment)
            }
            PrefixItem::Metadata(metadata) => {
                self.out.end_all()?;
                self.out.mcap.write_metadata(&metadata)
            }
        }
    }

    fn record(&mut self, record: Record<'_>, keep: &dyn Fn(ChunkLane, &MessageHeader) -> bool) -> McapResult<()> {
        match record {
            Record::Schema { header, data } => {
                self.out.mcap.add_schema_with_id(header.id, &header.name, &header.encoding, &data)?;
            }
            Record::Channel(channel) => {
                let (topic, encoding) = (&channel.topic, &channel.message_encoding);
                let (id, schema) = (channel.id, channel.schema_id);
                self.out.mcap.add_channel_with_id(id, schema, topic, encoding, &channel.metadata)?;
                self.channels.insert(id, (topic.clone(), ChunkLane::from_topic(topic)));
            }
            Record::Message { header, data } => {
                let Some((topic, part)) = self.channels.get(&header.channel_id) else { return Ok(()) };
                if keep(*part, &header) {
                    *self.counts.entry(topic.clone()).or_default() += 1;
                    self.sequence = self.sequence.max(header.sequence);
                    self.out.push(*part, header, &data);
                }
            }
            _ => {}
        }
        Ok(())
    }
}

/// Whether a metadata record says how the run ended.
pub(crate) fn is_end(item: &PrefixItem) -> bool {
    matches!(item, PrefixItem::Metadata(m) if m.name == topics::RUN_END_METADATA)
}
