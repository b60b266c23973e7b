//! Takes what is whole of one recording into another: messages, attachments and metadata as they are, chunks anew.

use std::collections::BTreeMap;
use std::sync::Arc;

use echolake_recording::{
    Attachment, Channel, ChunkLane, ChunkWriter, McapResult, MessageHeader, Record, RecordingItem,
};
use echolake_schema::topics;

/// Messages of each topic.
pub(crate) type MessageCounts = BTreeMap<String, u64>;

/// A copy that is being made.
pub(crate) struct RecordingCopy<'a> {
    out: &'a mut ChunkWriter,
    channels: &'a BTreeMap<u16, Arc<Channel<'static>>>,
    /// Whether they are described in `out`: its first chunk describes them all.
    is_described: bool,
    /// What was copied so far.
    pub counts: MessageCounts,
    /// The highest number of a message.
    pub sequence: u32,
}

impl<'a> RecordingCopy<'a> {
    /// A copy into `out` of messages of these channels.
    pub fn new(out: &'a mut ChunkWriter, channels: &'a BTreeMap<u16, Arc<Channel<'static>>>) -> Self {
        Self { out, channels, is_described: false, counts: MessageCounts::new(), sequence: 0 }
    }

    /// Copies one item, of a chunk only the messages that `keep` wants.
    ///
    /// # Errors
    /// The writer's.
    pub fn copy_item(
        &mut self,
        item: RecordingItem,
        keep: &dyn Fn(ChunkLane, &MessageHeader) -> bool,
    ) -> McapResult<()> {
        match item {
            RecordingItem::Chunk(chunk) => {
                self.describe_channels()?;
                for record in chunk.records {
                    self.copy_message(record, keep);
                }
                // In the order of their parts as soon as one is large: a verdict never gets ahead of its recording.
                [ChunkLane::Sweeps, ChunkLane::Responses, ChunkLane::Light]
                    .into_iter()
                    .try_for_each(|p| self.out.end_large(p))
            }
            RecordingItem::Attachment(attachment) => {
                self.out.end_all()?;
                self.out.mcap.attach(&Attachment {
                    log_time: attachment.log_time,
                    create_time: attachment.create_time,
                    name: attachment.name,
                    media_type: attachment.media_type,
                    data: attachment.data[..].into(),
                })
            }
            RecordingItem::Metadata(metadata) => {
                self.out.end_all()?;
                self.out.mcap.write_metadata(&metadata)
            }
            RecordingItem::Definition(_) => Ok(()),
        }
    }

    fn describe_channels(&mut self) -> McapResult<()> {
        if std::mem::replace(&mut self.is_described, true) {
            return Ok(());
        }
        for channel in self.channels.values() {
            let topic = &channel.topic;
            let encoding = &channel.message_encoding;
            let schema = match &channel.schema {
                Some(s) => self.out.mcap.add_schema_with_id(s.id, &s.name, &s.encoding, &s.data)?,
                None => 0,
            };
            self.out.mcap.add_channel_with_id(channel.id, schema, topic, encoding, &channel.metadata)?;
        }
        Ok(())
    }

    fn copy_message(&mut self, record: Record<'_>, keep: &dyn Fn(ChunkLane, &MessageHeader) -> bool) {
        let Record::Message { header, data } = record else { return };
        let Some(channel) = self.channels.get(&header.channel_id) else { return };
        let lane = ChunkLane::from_topic(&channel.topic);
        if keep(lane, &header) {
            *self.counts.entry(channel.topic.clone()).or_default() += 1;
            self.sequence = self.sequence.max(header.sequence);
            self.out.push_message(lane, header, &data);
        }
    }
}

/// Returns whether a metadata record says how the run ended.
pub(crate) fn is_end(item: &RecordingItem) -> bool {
    matches!(item, RecordingItem::Metadata(m) if m.name == topics::RUN_END_METADATA)
}
