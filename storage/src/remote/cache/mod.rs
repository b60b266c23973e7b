//! A cache of a lake's immutable objects: blocks in memory, and in a folder that several processes share.
//!
//! Files of tables and of runs never change under their names, so that a block is valid for as long as the lake exists.
//! What is not cached: `lake.toml`, logs, leases, the inbox, listings, and the tables of the rig, whose names do not
//! tell their content. Blocks in the folder stand under the id of the lake's table `runs`, which every new lake draws
//! anew.

mod block_cache;
mod block_folder;
mod cache_counters;
mod cached_store;
#[cfg(test)]
mod tests;

pub(crate) use block_cache::BlockCache;
pub use block_cache::CACHE_MEMORY_BYTES;
pub(crate) use block_folder::BlockFolder;
pub use block_folder::CacheFolder;
pub use cache_counters::{CacheCounters, CacheCounts};
pub(crate) use cached_store::CachedStore;
