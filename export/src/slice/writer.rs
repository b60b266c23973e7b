//! A slice as an MCAP file, given out in pieces as it grows.

use std::collections::HashMap;
use std::io::{self, Write};
use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use echolake_recording::{Attachment, McapError, MessageHeader, Metadata, StreamWriter, stream_writer};
use echolake_schema::topics;

use super::Layout;
use super::source::Message;
use crate::error::{Error, Result};

/// A chunk is ended at this size.
const CHUNK_BYTES: usize = 1 << 20;
/// A lane's first chunk is ended at this size, and each next one at twice as much: the first bytes come early.
const FIRST_CHUNK_BYTES: usize = 64 << 10;
/// Topics with messages of this size and more have chunks of their own.
const HEAVY_BYTES: usize = 1 << 10;

/// Where the MCAP writer writes to.
#[derive(Debug, Clone, Default)]
struct Shared(Arc<Mutex<Vec<u8>>>);

impl Shared {
    fn lock(&self) -> std::sync::MutexGuard<'_, Vec<u8>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Write for Shared {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        self.lock().extend_from_slice(data);
        Ok(data.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Writes a slice.
pub(super) struct SliceWriter {
    writer: StreamWriter<Shared>,
    out: Shared,
    layout: Layout,
    lanes: Vec<Lane>,
    /// The lane of each topic.
    lane_of: HashMap<String, usize>,
    sequence: u32,
    pub messages: u64,
    /// Whether there is more than what a file begins with.
    has_more: bool,
}

/// Messages on their way into one chunk.
struct Lane {
    messages: Vec<(MessageHeader, Bytes)>,
    bytes: usize,
    /// The size that its chunk is ended at.
    enough: usize,
}

impl Default for Lane {
    fn default() -> Self {
        Self { messages: Vec::new(), bytes: 0, enough: FIRST_CHUNK_BYTES }
    }
}

impl SliceWriter {
    pub fn new(layout: Layout) -> Result<Self> {
        let out = Shared::default();
        let writer = stream_writer(out.clone()).map_err(writer_error)?;
        let lanes = vec![Lane::default()];
        Ok(Self { writer, out, layout, lanes, lane_of: HashMap::new(), sequence: 0, messages: 0, has_more: false })
    }

    /// What was written since, where a chunk or an attachment is in it.
    pub fn take_written(&mut self) -> Option<Bytes> {
        std::mem::take(&mut self.has_more).then(|| std::mem::take(&mut *self.out.lock()).into())
    }

    pub fn write_metadata(&mut self, metadata: Metadata) -> Result<()> {
        self.flush_all()?;
        self.writer.write_metadata(&metadata).map_err(writer_error)
    }

    pub fn write_attachment(&mut self, attachment: &Attachment<'_>) -> Result<()> {
        self.flush_all()?;
        self.has_more = true;
        self.writer.attach(attachment).map_err(writer_error)
    }

    /// Writes a message; they come by time.
    pub fn write_message(&mut self, message: Message) -> Result<()> {
        let channel = &message.channel;
        let schema = match &channel.schema {
            Some(schema) => {
                self.writer.add_schema(&schema.name, &schema.encoding, &schema.data).map_err(writer_error)?
            }
            None => 0,
        };
        let added = self.writer.add_channel(schema, &channel.topic, &channel.message_encoding, &channel.metadata);
        let channel_id = added.map_err(writer_error)?;
        self.sequence = self.sequence.wrapping_add(1);
        self.messages += 1;
        let lane = self.lane_index(&message);
        let Message { log_time, publish_time, data, .. } = message;
        let header = MessageHeader { channel_id, sequence: self.sequence, log_time, publish_time };
        let of = &mut self.lanes[lane];
        of.bytes += data.len();
        of.messages.push((header, data));
        if of.bytes >= of.enough { self.flush_lane(lane) } else { Ok(()) }
    }

    // Light topics share a lane; one that turns out to be heavy gets its own.
    fn lane_index(&mut self, message: &Message) -> usize {
        if self.layout == Layout::InTime {
            return 0;
        }
        // What is played is a copy of what was recorded, and next to it nearly free (a quarter of a run's size).
        let topic = match message.channel.topic.as_str() {
            topics::SWEEP_AUDIO | topics::SWEEP_REPEAT => topics::SWEEP,
            other => other,
        };
        if let Some(lane) = self.lane_of.get(topic) {
            return *lane;
        }
        if message.data.len() < HEAVY_BYTES {
            return 0;
        }
        self.lanes.push(Lane::default());
        self.lane_of.insert(topic.to_owned(), self.lanes.len() - 1);
        self.lanes.len() - 1
    }

    // A lane becomes a chunk.
    fn flush_lane(&mut self, lane: usize) -> Result<()> {
        let of = &mut self.lanes[lane];
        if of.messages.is_empty() {
            return Ok(());
        }
        of.bytes = 0;
        of.enough = (of.enough * 2).min(CHUNK_BYTES);
        self.has_more = true;
        for (header, data) in of.messages.drain(..) {
            self.writer.write_to_known_channel(&header, &data).map_err(writer_error)?;
        }
        self.writer.flush().map_err(writer_error)
    }

    fn flush_all(&mut self) -> Result<()> {
        let first = |lane: &Lane| lane.messages.first().map_or(u64::MAX, |(header, _)| header.log_time);
        let mut order: Vec<_> = (0..self.lanes.len()).collect();
        order.sort_by_key(|lane| first(&self.lanes[*lane]));
        order.into_iter().try_for_each(|lane| self.flush_lane(lane))
    }

    /// Ends the file; returns the rest of it.
    pub fn finish(mut self) -> Result<Bytes> {
        self.flush_all()?;
        self.writer.finish().map_err(writer_error)?;
        Ok(std::mem::take(&mut *self.out.lock()).into())
    }
}

// It writes to memory, so what fails is what it is given.
fn writer_error(error: McapError) -> Error {
    Error::damaged("the slice", error)
}
