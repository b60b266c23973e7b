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
/// A message record without data: its frame, channel, sequence and two times.
const SMALLEST_MESSAGE: u64 = FRAME_BYTES as u64 + 22;
/// A message index without entries: its frame, channel and the size of its entries.
const INDEX_FRAME: u64 = FRAME_BYTES as u64 + 6;
/// An entry of a message index: a time and an offset.
const INDEX_ENTRY: u64 = 16;
/// A record that ends the data section and has no CRC: behind it the library checks that of the summary.
const DATA_END: [u8; FRAME_BYTES + 4] = [op::DATA_END, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];

/// The content of a summary.
#[derive(Debug, Default)]
pub struct RunSummary {
    /// Counts of the whole file.
    pub statistics: Option<Statistics>,
    /// Channels with their schemas, by id. The first definition of an id counts.
    pub channels: BTreeMap<u16, Arc<Channel<'static>>>,
    /// Digests of its schemas and channels.
    pub digests: DefinitionDigests,
    /// Number of schemas that it describes.
    pub schema_count: usize,
    /// A channel whose schema it does not describe.
    pub channel_without_schema: Option<u16>,
    /// Chunks, in the order of the summary.
    pub chunk_indexes: Vec<ChunkIndex>,
    /// Attachments.
    pub attachment_indexes: Vec<AttachmentIndex>,
    /// Metadata records.
    pub metadata_indexes: Vec<MetadataIndex>,
}

/// Bytes of a closed file's end: the footer and the closing magic.
pub const FILE_END_BYTES: u64 = (FOOTER_BYTES + MAGIC.len()) as u64;

/// Returns the range of a file's end that has its footer, and most often its summary.
pub fn tail_range(file_bytes: u64) -> Range<u64> {
    file_bytes.saturating_sub(TAIL_BYTES)..file_bytes
}

/// Returns whether a file's last bytes, [`FILE_END_BYTES`] or more, are those of a closed file: a footer, and the
/// closing magic behind it. A file that was cut off, or that is still being copied, has none.
pub fn has_file_end(tail: &[u8]) -> bool {
    let footer = tail.strip_suffix(MAGIC).and_then(|footer| footer.get(footer.len().checked_sub(FOOTER_BYTES)?..));
    footer.is_some_and(|footer| {
        footer[0] == op::FOOTER && footer[1..FRAME_BYTES] == ((FOOTER_BYTES - FRAME_BYTES) as u64).to_le_bytes()
    })
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
        let mut read_bytes = 0;
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
                LinearReadEvent::Record { opcode, data } => {
                    read_bytes += FRAME_BYTES + data.len();
                    match crate::chunk::parse_record(opcode, data)? {
                        Record::Statistics(statistics) => found.statistics = Some(statistics),
                        Record::ChunkIndex(index) => found.chunk_indexes.push(index),
                        Record::AttachmentIndex(index) => found.attachment_indexes.push(index),
                        Record::MetadataIndex(index) => found.metadata_indexes.push(index),
                        other => {
                            definitions.learn_definition(&other).map_err(McapError::ConflictingChannels)?;
                            found.digests.learn_definition(&other);
                        }
                    }
                }
            }
        }
        // A summary in front of another file's.
        if read_bytes != DATA_END.len() + summary.len() - MAGIC.len() {
            return Err(McapError::BytesAfterEndMagic);
        }
        found.schema_count = definitions.schemas.len();
        found.channel_without_schema = definitions.channel_without_schema();
        found.channels = definitions.into_channels();
        Ok(found)
    }

    /// Returns what of the file it does not account for, in words that follow "its summary"; None if it describes and
    /// lists all that its statistics count. Writers may leave out any part of a summary, and a reader that takes the
    /// rest for the whole loses messages without a word.
    pub fn describe_unaccounted(&self) -> Option<String> {
        let Some(statistics) = &self.statistics else { return Some("has no statistics".to_owned()) };
        let parts = [
            ("describes", "schemas", self.schema_count, usize::from(statistics.schema_count)),
            ("describes", "channels", self.channels.len(), statistics.channel_count as usize),
            ("lists", "chunks", self.chunk_indexes.len(), statistics.chunk_count as usize),
            ("lists", "attachments", self.attachment_indexes.len(), statistics.attachment_count as usize),
        ];
        if let Some((does, parts, has, all)) = parts.into_iter().find(|(_, _, has, all)| has != all) {
            return Some(format!("{does} {has} of {all} {parts}"));
        }
        if let Some(channel) = self.channel_without_schema {
            return Some(format!("does not describe the schema of channel {channel}"));
        }
        let counted = statistics.channel_message_counts.keys();
        let indexed = self.chunk_indexes.iter().flat_map(|chunk| chunk.message_index_offsets.keys());
        if let Some(channel) = counted.chain(indexed).find(|channel| !self.channels.contains_key(channel)) {
            return Some(format!("does not describe channel {channel}"));
        }
        self.unaccounted_messages(statistics)
    }

    fn unaccounted_messages(&self, statistics: &Statistics) -> Option<String> {
        let all = statistics.message_count;
        if self.chunk_indexes.is_empty() && all > 0 {
            return Some(format!("lists no chunks for {all} messages"));
        }
        let of_channels =
            statistics.channel_message_counts.values().fold(0u64, |sum, count| sum.saturating_add(*count));
        if of_channels != all {
            return Some(format!("counts {of_channels} messages by channel, {all} in all"));
        }
        let (with_index, without): (Vec<_>, Vec<_>) =
            self.chunk_indexes.iter().partition(|chunk| !chunk.message_index_offsets.is_empty());
        let indexed = with_index.iter().try_fold(0u64, |sum, chunk| sum.checked_add(indexed_messages(chunk)?));
        if indexed.is_none_or(|indexed| indexed > all || (without.is_empty() && indexed < all)) {
            return Some(format!("has message indexes whose sizes are not those of {all} messages"));
        }
        let first = self.chunk_indexes.iter().map(|chunk| chunk.message_start_time).min()?;
        let last = self.chunk_indexes.iter().map(|chunk| chunk.message_end_time).max()?;
        let covered = all == 0 || (first <= statistics.message_start_time && statistics.message_end_time <= last);
        (!covered).then(|| "lists chunks that do not cover the time of all messages".to_owned())
    }

    /// Returns the ranges in front of the summary, which begins at `summary_start`, that it does not account for and in
    /// which there is room for a message; None if what it lists overlaps or stands elsewhere.
    pub fn unlisted_ranges(&self, summary_start: u64) -> Option<Vec<Range<u64>>> {
        let chunks = self
            .chunk_indexes
            .iter()
            .map(|chunk| (chunk.chunk_start_offset, chunk.chunk_length.checked_add(chunk.message_index_length)));
        let attachments = self.attachment_indexes.iter().map(|index| (index.offset, Some(index.length)));
        let metadata = self.metadata_indexes.iter().map(|index| (index.offset, Some(index.length)));
        let mut listed: Vec<_> = chunks.chain(attachments).chain(metadata).collect();
        listed.sort_unstable();
        let mut unlisted = Vec::new();
        let mut end = MAGIC.len() as u64;
        for (start, bytes) in listed.into_iter().chain([(summary_start, Some(0))]) {
            if start.checked_sub(end)? >= SMALLEST_MESSAGE {
                unlisted.push(end..start);
            }
            end = start.checked_add(bytes?)?;
        }
        Some(unlisted)
    }
}

// Messages that the message indexes behind a chunk list, by their size; None if they have another one.
fn indexed_messages(chunk: &ChunkIndex) -> Option<u64> {
    let frames = INDEX_FRAME.checked_mul(chunk.message_index_offsets.len() as u64)?;
    let entries = chunk.message_index_length.checked_sub(frames)?;
    entries.is_multiple_of(INDEX_ENTRY).then_some(entries / INDEX_ENTRY)
}

/// Digests of a summary's schemas and channels, of all that messages are read by.
#[derive(Debug, Default, Clone, PartialEq, Eq)]
pub struct DefinitionDigests {
    /// By the opcode of a schema or channel, and its id.
    by_id: BTreeMap<(u8, u16), u32>,
}

impl DefinitionDigests {
    fn learn_definition(&mut self, record: &Record<'_>) {
        self.by_id.extend(digest_of(record));
    }

    /// Compares a record of a chunk with the summary.
    ///
    /// # Errors
    /// What is different, if it is a schema or channel whose id stands for something else: nobody could tell whose the
    /// messages are.
    pub fn check_definition(&self, record: &Record<'_>) -> Result<(), String> {
        let Some((key, digest)) = digest_of(record) else { return Ok(()) };
        match self.by_id.get(&key) {
            Some(known) if *known != digest => {
                let kind = if key.0 == op::SCHEMA { "schema" } else { "channel" };
                let id = key.1;
                Err(format!("{kind} {id} is used again: with other content than the summary has"))
            }
            _ => Ok(()),
        }
    }
}

fn digest_of(record: &Record<'_>) -> Option<((u8, u16), u32)> {
    match record {
        Record::Schema { header, data } => {
            Some(((op::SCHEMA, header.id), crc_of([header.name.as_bytes(), header.encoding.as_bytes(), data])))
        }
        Record::Channel(c) => {
            let parts = [c.topic.as_bytes(), c.message_encoding.as_bytes(), &c.schema_id.to_le_bytes()];
            Some(((op::CHANNEL, c.id), crc_of(parts)))
        }
        _ => None,
    }
}

fn crc_of(parts: [&[u8]; 3]) -> u32 {
    let mut digest = crc32fast::Hasher::new();
    for part in parts {
        digest.update(&(part.len() as u64).to_le_bytes());
        digest.update(part);
    }
    digest.finalize()
}

fn is_same_channel(one: &mcap::records::Channel, other: &mcap::records::Channel) -> bool {
    (&one.topic, one.schema_id, &one.message_encoding) == (&other.topic, other.schema_id, &other.message_encoding)
}

/// Schemas and channels in the order in which they come.
#[derive(Debug, Default)]
pub struct ChannelDefinitions {
    schemas: BTreeMap<u16, Arc<Schema<'static>>>,
    channels: BTreeMap<u16, mcap::records::Channel>,
}

impl ChannelDefinitions {
    /// Takes note of a schema or channel. One that comes again says the same.
    ///
    /// # Errors
    /// What is different, if an id is used again for something else: nobody could tell whose the messages are.
    pub fn learn_definition(&mut self, record: &Record<'_>) -> Result<(), String> {
        match record {
            Record::Schema { header, data } => match self.schemas.get(&header.id) {
                Some(known)
                    if known.encoding == header.encoding && known.data == *data && known.name == header.name => {}
                Some(known) => {
                    let id = header.id;
                    let before = &known.name;
                    let now = &header.name;
                    return Err(format!(
                        "schema {id} is used again: it is `{before}` and, with other content, `{now}`"
                    ));
                }
                None => {
                    let schema = Schema {
                        id: header.id,
                        name: header.name.clone(),
                        encoding: header.encoding.clone(),
                        data: data.to_vec().into(),
                    };
                    self.schemas.insert(header.id, Arc::new(schema));
                }
            },
            Record::Channel(channel) => match self.channels.get(&channel.id) {
                Some(known) if is_same_channel(known, channel) => {}
                Some(known) => {
                    let id = channel.id;
                    let before = &known.topic;
                    let now = &channel.topic;
                    return Err(format!(
                        "channel {id} is used again: it is `{before}` and, with other content, `{now}`"
                    ));
                }
                None => drop(self.channels.insert(channel.id, channel.clone())),
            },
            _ => {}
        }
        Ok(())
    }

    /// Returns a channel whose schema did not come.
    pub fn channel_without_schema(&self) -> Option<u16> {
        let lacks = |channel: &&mcap::records::Channel| {
            channel.schema_id != 0 && !self.schemas.contains_key(&channel.schema_id)
        };
        self.channels.values().find(lacks).map(|channel| channel.id)
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
    fn a_summary_says_what_it_does_not_account_for() {
        let file = file();
        let bytes = file.len() as u64;
        let range = summary_range(&file[tail_range(bytes).start as usize..], bytes).expect("a summary");
        let parse = || RunSummary::parse(&file[range.start as usize..]).expect("sound");
        assert_eq!(parse().describe_unaccounted(), None);
        type Change = fn(&mut RunSummary, &mut Statistics);
        let changes: [(&str, Change); 10] = [
            ("describes 0 of 1 schemas", |summary, _| summary.schema_count = 0),
            ("describes 0 of 1 channels", |summary, _| summary.channels.clear()),
            ("lists 0 of 1 chunks", |summary, _| summary.chunk_indexes.clear()),
            ("lists 0 of 2 attachments", |_, statistics| statistics.attachment_count = 2),
            ("does not describe the schema of channel 5", |summary, _| summary.channel_without_schema = Some(5)),
            ("does not describe channel 9", |summary, _| {
                summary.chunk_indexes[0].message_index_offsets.insert(9, 0);
            }),
            ("counts 1 messages by channel, 2 in all", |_, statistics| statistics.message_count = 2),
            ("has message indexes whose sizes are not those of 1 messages", |summary, _| {
                summary.chunk_indexes[0].message_index_length -= INDEX_ENTRY;
            }),
            ("lists chunks that do not cover the time of all messages", |_, statistics| {
                statistics.message_end_time = 3;
            }),
            ("lists no chunks for 1 messages", |summary, statistics| {
                summary.chunk_indexes.clear();
                statistics.chunk_count = 0;
            }),
        ];
        for (expected, change) in changes {
            let mut summary = parse();
            let mut statistics = summary.statistics.take().expect("statistics");
            change(&mut summary, &mut statistics);
            summary.statistics = Some(statistics);
            assert_eq!(summary.describe_unaccounted().as_deref(), Some(expected));
        }
        let mut summary = parse();
        summary.statistics = None;
        assert_eq!(summary.describe_unaccounted().as_deref(), Some("has no statistics"));
    }

    #[test]
    fn what_a_summary_does_not_list_is_found() {
        let file = file();
        let bytes = file.len() as u64;
        let range = summary_range(&file[tail_range(bytes).start as usize..], bytes).expect("a summary");
        let mut summary = RunSummary::parse(&file[range.start as usize..]).expect("sound");
        let chunk = summary.chunk_indexes[0].clone();
        let header = MAGIC.len() as u64..chunk.chunk_start_offset;
        let expected = if header.end - header.start >= SMALLEST_MESSAGE { vec![header] } else { Vec::new() };
        assert_eq!(summary.unlisted_ranges(range.start), Some(expected));
        summary.chunk_indexes[0].chunk_length = u64::MAX;
        assert_eq!(summary.unlisted_ranges(range.start), None);
        summary.chunk_indexes.clear();
        let all = MAGIC.len() as u64..range.start;
        assert_eq!(summary.unlisted_ranges(range.start), Some(vec![all]));
        summary.chunk_indexes = vec![chunk.clone(), chunk];
        assert_eq!(summary.unlisted_ranges(range.start), None);
    }

    #[test]
    fn files_without_a_summary_have_no_range() {
        let file = file();
        for cut in [0, 1, 8, 40, file.len() - 1] {
            assert_eq!(summary_range(&file[..cut], cut as u64), None, "{cut}");
        }
    }
}
