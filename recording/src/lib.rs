//! Run files: everything the workspace knows about the MCAP container. No other member reads or writes it by itself.
//!
//! Two readers differ in what they do about damage. `ResyncReader` (feature `store`), and [`RecordingReader`] over it
//! for files of this machine, search for the next whole record: ingest, recovery and replay lose only what the damage
//! touches, and list it. Queries are strict: [`RecordCursor`] fails, since an answer that silently lacks rows is wrong.
//! All of them decode chunks by [`DecodedChunk`], within the same [`limits`].
//!
//! ```
//! use echolake_recording::{RecordingItem, RecordingReader};
//!
//! # fn example(path: &std::path::Path) -> Result<(), Box<dyn std::error::Error>> {
//! let mut reader = RecordingReader::open(path)?;
//! while let Some(item) = reader.next_item()? {
//!     if let RecordingItem::Chunk(chunk) = item {
//!         println!("{} records at byte {}", chunk.records.len(), chunk.offset);
//!     }
//! }
//! println!("{:?}", reader.finish()?.damage);
//! # Ok(())
//! # }
//! ```

mod block_reader;
mod chunk;
mod chunk_writer;
mod file_proof;
pub mod limits;
mod record_frame;
mod record_splitter;
mod recording_reader;
mod resync_reader;
mod summary;

pub use block_reader::BlockReader;
pub use chunk::{
    ChunkError, ChunkIdentity, ChunkMessage, DecodedChunk, RecordCursor, RecordError, chunk_body, describe_mcap_error,
    parse_record, system_cause,
};
pub use chunk_writer::{ChunkLane, ChunkWriter, StreamWriter, stream_writer};
pub use file_proof::prove_file;
pub use mcap::records::{Channel as ChannelRecord, ChunkIndex, MessageHeader, Metadata, Record, op as opcode};
pub use mcap::{Attachment, Channel, MAGIC, McapError, McapResult, Writer};
pub use record_frame::{FRAME_BYTES, RecordFrame};
pub use record_splitter::{RecordSplitter, SplitRecord};
pub use recording_reader::{RecordingItem, RecordingReader, WholeChunk};
pub use resync_reader::{
    FileIntegrity, LargeRecordPermit, RawChunk, ResyncError, ResyncItem, ResyncReader, StoredAttachment, find_part,
    list_damage,
};
pub use summary::{
    ChannelDefinitions, DefinitionDigests, FILE_END_BYTES, RunSummary, has_file_end, summary_range, tail_range,
};
