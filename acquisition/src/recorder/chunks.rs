//! Puts what is heavy into chunks of its own, so that a reader of poses or verdicts fetches no sweeps, and writes a
//! verdict's chunk only behind those of what it rests on.

use std::fs::File;
use std::io::BufWriter;
use std::ops::Range;

use echolake_schema::topics;
use mcap::records::MessageHeader;
use mcap::{McapResult, WriteOptions, Writer};

/// A chunk is ended at this size; a message never straddles two.
const CHUNK_BYTES: usize = 1 << 20;

/// Which chunks a message goes to. The order is that in which they are written at a checkpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Part {
    /// Sweeps and their audio, which zstd finds again in the sweep.
    Sweeps,
    /// Impulse responses.
    Responses,
    /// Everything else, verdicts among it.
    Light,
}

impl Part {
    const ALL: [Self; 3] = [Self::Sweeps, Self::Responses, Self::Light];

    /// Where a topic's messages go.
    pub(crate) fn of(topic: &str) -> Self {
        match topic {
            topics::SWEEP | topics::SWEEP_AUDIO => Self::Sweeps,
            topics::IR => Self::Responses,
            _ => Self::Light,
        }
    }
}

/// An MCAP writer whose chunks are sorted by [`Part`].
pub(crate) struct ChunkWriter {
    pub(crate) mcap: Writer<BufWriter<File>>,
    /// The same open file, for what is no writing: syncs.
    file: File,
    pending: [Pending; 3],
}

/// Messages that wait for their chunk's end.
#[derive(Default)]
struct Pending {
    messages: Vec<(MessageHeader, Range<usize>)>,
    bytes: Vec<u8>,
}

impl ChunkWriter {
    /// Begins a file.
    pub(crate) fn new(file: File) -> McapResult<Self> {
        let kept = file.try_clone()?;
        let mcap = WriteOptions::new()
            .profile("")
            .library(concat!("echolake ", env!("CARGO_PKG_VERSION")))
            // Chunks end where this file says.
            .chunk_size(None)
            // One thread: the same run gives the same bytes, and runs are recorded side by side.
            .compression_threads(0)
            .create(BufWriter::new(file))?;
        Ok(Self { mcap, file: kept, pending: Default::default() })
    }

    /// Takes a message; it is written with its chunk.
    pub(crate) fn push(&mut self, part: Part, header: MessageHeader, data: &[u8]) {
        let Pending { messages, bytes } = &mut self.pending[part as usize];
        let begin = bytes.len();
        bytes.extend_from_slice(data);
        messages.push((header, begin..bytes.len()));
    }

    /// Ends a part's chunk where it is large enough, and before it the chunks of what it rests on.
    pub(crate) fn end_large(&mut self, part: Part) -> McapResult<()> {
        match self.pending[part as usize].bytes.len() >= CHUNK_BYTES {
            true if part == Part::Light => self.end_all(),
            true => self.end(part),
            false => Ok(()),
        }
    }

    /// Ends all chunks and hands them to the system.
    pub(crate) fn end_all(&mut self) -> McapResult<()> {
        for part in Part::ALL {
            self.end(part)?;
        }
        self.mcap.flush()
    }

    /// Ends all chunks and waits until they are on the disk.
    pub(crate) fn sync(&mut self) -> McapResult<()> {
        self.end_all()?;
        Ok(self.file.sync_data()?)
    }

    /// Writes the summary and waits until the whole file is on the disk.
    pub(crate) fn finish(&mut self) -> McapResult<()> {
        self.end_all()?;
        self.mcap.finish()?;
        Ok(self.file.sync_all()?)
    }

    fn end(&mut self, part: Part) -> McapResult<()> {
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

impl Drop for ChunkWriter {
    // What is held is worth keeping, and nobody is there to hear of a failure.
    fn drop(&mut self) {
        // A finished writer takes no more, and holds nothing.
        if self.pending.iter().any(|pending| !pending.messages.is_empty()) {
            let _ = self.end_all();
        }
    }
}
