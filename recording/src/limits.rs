//! Limits of run files. All readers share them, so that a chunk that is ingested can also be queried, replayed and
//! sliced.

/// Bytes of the largest chunk that is read: as it is stored and decompressed, together.
pub const LARGEST_CHUNK: u64 = 256 << 20;
/// Bytes of the largest attachment that is ingested.
pub const LARGEST_ATTACHMENT: u64 = LARGEST_CHUNK;
/// Bytes of the largest schema, channel or metadata record that is ingested.
pub const LARGEST_DEFINITION: u64 = 4 << 20;
/// Bytes of the largest record that is recovered. The recorder's chunks have a few MiB; a panel's mesh is one
/// attachment.
pub const LARGEST_RECORD: u64 = 1 << 30;
/// Records of which one is in memory at a time, in all files together, are larger than this. A recorder's chunks have
/// 1 MiB.
pub(crate) const LARGE_RECORD: u64 = 8 << 20;
/// Bytes of the largest summary that is read.
pub const LARGEST_SUMMARY: u64 = 256 << 20;
