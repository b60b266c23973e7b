//! The summary of a run file, read by ranges from its end: whoever has the bytes, on a disk or in a store, asks for the
//! range of the tail, then for that of the summary, and parses it.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use mcap::records::{AttachmentIndex, ChunkIndex, MetadataIndex, Record, Statistics, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{Channel, MAGIC, McapError, Schema};

use crate::limits::LARGEST_SUMMARY;
use crate::record_frame::FRAME_BYTES;

/// Bytes of a file's end that are read first: the summary of a run of a hundred measurements is within.
const TAIL_BYTES: u64 = 64 << 10;
/// The footer: its frame, two offsets and a CRC; magic bytes follow.
const FOOTER_BYTES: usize = FRAME_BYTES + 20;
/// A record that ends the data section and has no CRC: behind it the library checks that of the summary.
const DATA_END: [u8; FRAME_BYTES + 4] = [op::DATA_END, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];

/// The content of a summary.
#[derive(Debug, Default)]
pub struct RunSummary {
    /// Counts of the whole file.
    pub statistics: Option<Statistics>,
    /// Channels with their schemas, by id. The first definition of an id counts.
    pub channels: BTreeMap<u16, Arc<Channel<'static>>>,
    /// Chunks, in the order of the summary.
    pub chunk_indexes: Vec<ChunkIndex>,
    /// Attachments.
    pub attachment_indexes: Vec<AttachmentIndex>,
    /// Metadata records.
    pub metadata_indexes: Vec<MetadataIndex>,
}

/// Returns the range of a file's end that has its footer, and most often its summary.
pub fn tail_range(file_bytes: u64) -> Range<u64> {
    file_bytes.saturating_sub(TAIL_BYTES)..file_bytes
}

/// Returns the range of the summary up to the end of the file, as the footer in the file's `tail` tells it; None if the
/// file has no summary, because it was cut off or its writer makes none.
pub fn summary_range(tail: &[u8], file_bytes: u64) -> Option<Range<u64>> {
    let footer = tail.strip_suffix(MAGIC)?;
    let footer = footer.get(footer.len().checked_sub(FOOTER_BYTES)?..)?;
    if footer[0] != op::FOOTER {
        return None;
    }
    let Ok(Record::Footer(footer)) = crate::chunk::parse_record(op::FOOTER, &footer[FRAME_BYTES..]) else {
        return None;
    };
    let inside = MAGIC.len() as u64..file_bytes - (FOOTER_BYTES + MAGIC.len()) as u64;
    let start = footer.summary_start;
    (inside.contains(&start) && file_bytes - start <= LARGEST_SUMMARY).then_some(start..file_bytes)
}

impl RunSummary {
    /// Parses the bytes of [`summary_range`] and checks their CRC.
    ///
    /// # Errors
    /// The library's, if they are damaged.
    pub fn parse(summary: &[u8]) -> Result<Self, McapError> {
        let mut found = Self::default();
        let mut definitions = ChannelDefinitions::default();
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_validate_summary_section_crc(true)
            .with_record_length_limit(summary.len());
        let mut reader = LinearReader::new_with_options(options);
        let mut next = DATA_END.as_slice();
        let mut behind = Some(summary);
        while let Some(event) = reader.next_event() {
            match event? {
                LinearReadEvent::ReadRequest(_) => {
                    if next.is_empty() {
                        next = behind.take().ok_or(McapError::UnexpectedEof)?;
                    }
                    reader.insert(next.len()).copy_from_slice(next);
                    reader.notify_read(next.len());
                    next = &[];
                }
                LinearReadEvent::Record { opcode, data } => match crate::chunk::parse_record(opcode, data)? {
                    Record::Statistics(statistics) => found.statistics = Some(statistics),
                    Record::ChunkIndex(index) => found.chunk_indexes.push(index),
                    Record::AttachmentIndex(index) => found.attachment_indexes.push(index),
                    Record::MetadataIndex(index) => found.metadata_indexes.push(index),
                    other => definitions.learn(&other),
                },
            }
        }
        found.channels = definitions.into_channels();
        Ok(found)
    }
}

/// Schemas and channels in the order in which they come.
#[derive(Debug, Default)]
pub struct ChannelDefinitions {
    schemas: BTreeMap<u16, Arc<Schema<'static>>>,
    channels: BTreeMap<u16, mcap::records::Channel>,
}

impl ChannelDefinitions {
    /// Takes note of a schema or channel; the first one of an id counts, a second one repeats it.
    pub fn learn(&mut self, record: &Record<'_>) {
        match record {
            Record::Schema { header, data } => {
                self.schemas.entry(header.id).or_insert_with(|| {
                    Arc::new(Schema {
                        id: header.id,
                        name: header.name.clone(),
                        encoding: header.encoding.clone(),
                        data: data.to_vec().into(),
                    })
                });
            }
            Record::Channel(channel) => {
                self.channels.entry(channel.id).or_insert_with(|| channel.clone());
            }
            _ => {}
        }
    }

    /// Returns all channels with their schemas. A channel whose schema is missing has none.
    pub fn into_channels(self) -> BTreeMap<u16, Arc<Channel<'static>>> {
        let schemas = self.schemas;
        let with_schema = |channel: mcap::records::Channel| Channel {
            id: channel.id,
            topic: channel.topic,
            schema: schemas.get(&channel.schema_id).cloned(),
            message_encoding: channel.message_encoding,
            metadata: channel.metadata,
        };
        self.channels.into_iter().map(|(id, channel)| (id, Arc::new(with_schema(channel)))).collect()
    }
}

#[cfg(test)]
mod tests {
    use mcap::records::MessageHeader;

    use super::*;

    fn file() -> Vec<u8> {
        let mut file = std::io::Cursor::new(Vec::new());
        let mut writer = mcap::Writer::new(&mut file).expect("a writer");
        let schema = writer.add_schema("a.B", "protobuf", b"x").expect("added");
        let channel = writer.add_channel(schema, "/a", "protobuf", &Default::default()).expect("added");
        let header = MessageHeader { channel_id: channel, sequence: 1, log_time: 2, publish_time: 2 };
        writer.write_to_known_channel(&header, b"data").expect("written");
        writer.finish().expect("finished");
        drop(writer);
        file.into_inner()
    }

    #[test]
    fn a_summary_is_found_from_the_end_and_its_crc_is_checked() {
        let mut file = file();
        let bytes = file.len() as u64;
        let range = summary_range(&file[tail_range(bytes).start as usize..], bytes).expect("a summary");
        assert_eq!(range.end, bytes);
        let summary = RunSummary::parse(&file[range.start as usize..]).expect("sound");
        assert_eq!((summary.chunk_indexes.len(), summary.statistics.map(|s| s.message_count)), (1, Some(1)));
        let channel = summary.channels.values().next().expect("a channel");
        assert_eq!((channel.topic.as_str(), channel.schema.as_ref().map(|s| s.name.as_str())), ("/a", Some("a.B")));
        file[range.start as usize + FRAME_BYTES + 3] ^= 1;
        assert!(RunSummary::parse(&file[range.start as usize..]).is_err());
    }

    #[test]
    fn files_without_a_summary_have_no_range() {
        let file = file();
        for cut in [0, 1, 8, 40, file.len() - 1] {
            assert_eq!(summary_range(&file[..cut], cut as u64), None, "{cut}");
        }
    }
}
