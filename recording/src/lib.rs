//! Run files: everything the workspace knows about the MCAP container. No other member reads or writes it by itself.
//!
//! Three readers differ in what they do about damage. [`PrefixReader`] stops at the first record that is not whole: recovery
//! keeps what is proven. `ResyncReader` (feature `store`) searches for the next whole record: ingest loses only what the
//! damage touches. Queries are strict: [`RecordCursor`] fails, since an answer that silently lacks rows is wrong. All of
//! them decode chunks by [`DecodedChunk`], within the same [`limits`].
//!
//! ```
//! use echolake_recording::{PrefixItem, PrefixReader};
//!
//! # fn example(path: &std::path::Path) -> Result<(), Box<dyn std::error::Error>> {
//! let mut reader = PrefixReader::open(path)?;
//! while let Some(item) = reader.next_item()? {
//!     if let PrefixItem::Chunk(records) = item {
//!         println!("{} records", records.len());
//!     }
//! }
//! println!("{:?}", reader.defect);
//! # Ok(())
//! # }
//! ```

#[cfg(feature = "store")]
mod block_reader;
mod chunk;
mod chunk_writer;
mod file_proof;
pub mod limits;
mod prefix_reader;
mod record_frame;
#[cfg(feature = "store")]
mod record_shape;
mod record_splitter;
#[cfg(feature = "store")]
mod resync_reader;
mod summary;

pub use chunk::{
    ChunkError, ChunkIdentity, ChunkMessage, DecodedChunk, RecordCursor, RecordError, chunk_body, describe,
    parse_record, system_cause,
};
pub use chunk_writer::{ChunkLane, ChunkWriter, StreamWriter, stream_writer};
pub use file_proof::prove_file;
pub use mcap::records::{ChunkIndex, MessageHeader, Metadata, Record, op as opcode};
pub use mcap::{Attachment, Channel, MAGIC, McapError, McapResult, Writer};
pub use prefix_reader::{PrefixError, PrefixItem, PrefixReader};
pub use record_frame::{FRAME_BYTES, RecordFrame};
pub use record_splitter::{RecordSplitter, SplitRecord};
#[cfg(feature = "store")]
pub use resync_reader::{
    FileIntegrity, LargeRecordPermit, RawChunk, ResyncError, ResyncItem, ResyncReader, list_damage,
};
pub use summary::{ChannelDefinitions, FILE_END_BYTES, RunSummary, has_file_end, summary_range, tail_range};
