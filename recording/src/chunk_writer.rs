//! Puts what is heavy into chunks of its own, so that a reader of poses or verdicts fetches no sweeps, and writes a
//! verdict's chunk only behind those of what it rests on.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::ops::Range;

use echolake_schema::topics;
use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{McapResult, WriteOptions, Writer};

/// A chunk is ended at this size; a message never straddles two.
const CHUNK_BYTES: usize = 1 << 20;

/// The chunks that a message goes to. Lanes are written in this order at a checkpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum ChunkLane {
    /// Sweeps and their audio, which zstd finds again in the sweep.
    Sweeps,
    /// Impulse responses.
    Responses,
    /// Everything else, verdicts among it.
    Light,
}

impl ChunkLane {
    const ALL: [Self; 3] = [Self::Sweeps, Self::Responses, Self::Light];

    /// Returns the lane of a topic's messages.
    pub fn from_topic(topic: &str) -> Self {
        match topic {
            topics::SWEEP | topics::SWEEP_REPEAT | topics::SWEEP_AUDIO => Self::Sweeps,
            topics::IR => Self::Responses,
            _ => Self::Light,
        }
    }
}

/// An MCAP writer whose chunks are sorted by [`ChunkLane`].
pub struct ChunkWriter {
    /// The library's writer, for channels, attachments and metadata.
    pub mcap: Writer<BufWriter<File>>,
    /// The same open file, for what is no writing: syncs.
    file: File,
    pending: [PendingMessages; 3],
}

/// Messages that wait for their chunk's end.
#[derive(Default)]
struct PendingMessages {
    messages: Vec<(MessageHeader, Range<usize>)>,
    bytes: Vec<u8>,
}

impl ChunkWriter {
    /// Begins a file.
    pub fn new(file: File) -> McapResult<Self> {
        let kept = file.try_clone()?;
        let mcap = write_options().create(BufWriter::new(file))?;
        Ok(Self { mcap, file: kept, pending: Default::default() })
    }

    /// Takes a message; it is written with its chunk.
    pub fn push_message(&mut self, part: ChunkLane, header: MessageHeader, data: &[u8]) {
        let PendingMessages { messages, bytes } = &mut self.pending[part as usize];
        let begin = bytes.len();
        bytes.extend_from_slice(data);
        messages.push((header, begin..bytes.len()));
    }

    /// Returns the bytes of the messages whose chunks are not written yet.
    pub fn pending_bytes(&self) -> usize {
        self.pending.iter().map(|pending| pending.bytes.len()).sum()
    }

    /// Ends a part's chunk where it is large enough, and before it the chunks of what it rests on.
    pub fn end_large(&mut self, part: ChunkLane) -> McapResult<()> {
        match self.pending[part as usize].bytes.len() >= CHUNK_BYTES {
            true if part == ChunkLane::Light => self.end_all(),
            true => self.end_chunk(part),
            false => Ok(()),
        }
    }

    /// Ends all chunks and hands them to the system.
    pub fn end_all(&mut self) -> McapResult<()> {
        for part in ChunkLane::ALL {
            self.end_chunk(part)?;
        }
        self.mcap.flush()
    }

    /// Ends all chunks and waits until they are on the disk.
    pub fn sync_chunks(&mut self) -> McapResult<()> {
        self.end_all()?;
        Ok(self.file.sync_data()?)
    }

    /// Writes the summary and waits until the whole file is on the disk.
    pub fn finish(&mut self) -> McapResult<()> {
        self.end_all()?;
        self.mcap.finish()?;
        Ok(self.file.sync_all()?)
    }

    fn end_chunk(&mut self, part: ChunkLane) -> McapResult<()> {
        // Taken out, so that what could not be written is not written behind its own half.
        let mut pending = std::mem::take(&mut self.pending[part as usize]);
        for (header, range) in &pending.messages {
            self.mcap.write_to_known_channel(header, &pending.bytes[range.clone()])?;
        }
        if !pending.messages.is_empty() {
            self.mcap.flush()?;
        }
        pending.messages.clear();
        pending.bytes.clear();
        self.pending[part as usize] = pending;
        Ok(())
    }
}

/// A writer of a file that is given out while it grows.
pub type StreamWriter<W> = Writer<NoSeek<W>>;

/// Begins a file that is only appended to. Its chunks end at each flush.
///
/// # Errors
/// Those of `out`.
pub fn stream_writer<W: Write>(out: W) -> McapResult<StreamWriter<W>> {
    write_options().disable_seeking(true).create(NoSeek::new(out))
}

fn write_options() -> WriteOptions {
    WriteOptions::new()
        .profile("")
        .library(concat!("echolake ", env!("CARGO_PKG_VERSION")))
        // Chunks end where their writer says.
        .chunk_size(None)
        // One thread: the same run gives the same bytes, and runs are recorded side by side.
        .compression_threads(0)
}

impl Drop for ChunkWriter {
    // What is held is worth keeping, and nobody is there to hear of a failure.
    fn drop(&mut self) {
        // A finished writer takes no more, and holds nothing.
        if self.pending.iter().any(|pending| !pending.messages.is_empty()) {
            let _ = self.end_all();
        }
    }
}
