//! A folder of blocks that several processes share, with a limit for all of them together.
//!
//! A block is a file: written beside its name and renamed, so that it is there as a whole or not at all, and with a
//! checksum, because nothing is synced. `usage` has the bytes of all blocks; who writes holds its lock, and deletes the
//! blocks that were not read for longest if there is no room. All errors of the folder mean that a block is not cached:
//! a disk that is full or a folder that was deleted slows queries down and ends none.

use std::fs::{self, File, FileTimes, OpenOptions};
use std::io::{self, Read as _, Seek as _, Write as _};
use std::path::{Path as FsPath, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use chrono::{DateTime, Utc};
use object_store::path::Path;
use sha2::{Digest as _, Sha256};

/// A block, and what the store says of its object.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct CachedBlock {
    pub bytes: Bytes,
    pub object_bytes: u64,
    pub modified: DateTime<Utc>,
}

/// The folder for a cache, and the bytes that it may hold.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CacheFolder {
    /// The folder. It is made if it is missing.
    pub path: PathBuf,
    /// Bytes of all blocks in it, whichever process wrote them.
    pub bytes: u64,
}

/// The blocks of one lake in such a folder.
#[derive(Debug)]
pub(crate) struct BlockFolder {
    root: PathBuf,
    lake: PathBuf,
    limit: u64,
    written: AtomicU64,
}

/// A block's file, as eviction sees it.
struct BlockFile {
    read: SystemTime,
    bytes: u64,
    path: PathBuf,
}

const MAGIC: [u8; 8] = *b"elblock1";
/// Magic, checksum, the object's size, the time of its last change in milliseconds, and the bytes of its path.
const HEADER_BYTES: usize = 8 + 4 + 8 + 8 + 4;
/// The file with the bytes of all blocks, and with the lock.
const USAGE: &str = "usage";
/// Extension of a block that is being written.
const PARTIAL: &str = "partial";
/// Age of such a file whose writer is gone.
const ABANDONED: Duration = Duration::from_secs(600);
/// A block's time is renewed if it is older than this.
const TOUCHED: Duration = Duration::from_secs(60);
/// Part of the limit that eviction leaves, in eighths.
const KEPT_EIGHTHS: u64 = 7;

impl CacheFolder {
    /// Makes the folder, for its owner alone: blocks are the lake's data.
    ///
    /// # Errors
    /// The system refuses.
    pub fn create(&self) -> io::Result<()> {
        let mut folder = fs::DirBuilder::new();
        #[cfg(unix)]
        std::os::unix::fs::DirBuilderExt::mode(&mut folder, 0o700);
        folder.recursive(true).create(&self.path)
    }
}

impl BlockFolder {
    /// Opens the blocks of the lake with this id.
    ///
    /// # Errors
    /// The folder cannot be made.
    pub fn open(folder: &CacheFolder, lake_id: &str) -> io::Result<Self> {
        folder.create()?;
        let lake = folder.path.join(&digest_of(lake_id)[..16]);
        fs::create_dir_all(&lake)?;
        let folder = Self { root: folder.path.clone(), lake, limit: folder.bytes, written: AtomicU64::new(0) };
        folder.open_usage()?;
        Ok(folder)
    }

    /// Reads a block; None if it is not there, or is damaged.
    pub fn read_block(&self, object: &Path, number: u64) -> Option<CachedBlock> {
        let path = self.block_path(object, number);
        let mut file = File::open(&path).ok()?;
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes).ok()?;
        let Some(block) = decode_block(bytes.into(), object) else {
            // It is fetched and written again.
            let _ = fs::remove_file(&path);
            return None;
        };
        touch_block(&path, &file);
        Some(block)
    }

    /// Writes a block, if there is or can be room for it.
    pub fn write_block(&self, object: &Path, number: u64, block: &CachedBlock) {
        // The cache does without it.
        let _ = self.try_write(object, number, block);
    }

    fn try_write(&self, object: &Path, number: u64, block: &CachedBlock) -> io::Result<()> {
        let path = self.block_path(object, number);
        let bytes = encode_block(object, block);
        let size = bytes.len() as u64;
        if size > self.limit {
            return Ok(());
        }
        let mut usage = self.open_usage()?;
        usage.lock()?;
        if path.exists() {
            return Ok(());
        }
        let known = read_usage(&mut usage)?;
        let used = match known {
            Some(used) if used + size <= self.limit => used,
            Some(_) => self.evict_blocks((self.limit / 8 * KEPT_EIGHTHS).min(self.limit - size))?,
            None => self.evict_blocks(self.limit - size)?,
        };
        // Before the block: a process that dies in between has counted too much, never too little.
        write_usage(&mut usage, used + size)?;
        let unique = self.written.fetch_add(1, Ordering::Relaxed);
        let partial = path.with_extension(format!("{}-{unique}.{PARTIAL}", std::process::id()));
        let folder = path.parent().unwrap_or(&self.lake);
        fs::create_dir_all(folder)?;
        let written = fs::write(&partial, bytes).and_then(|()| fs::rename(&partial, &path));
        if written.is_err() {
            let _ = fs::remove_file(&partial);
        }
        written
    }

    // Deletes the blocks of all lakes that were not read for longest, until so many bytes are left; returns how many.
    fn evict_blocks(&self, target: u64) -> io::Result<u64> {
        let mut files = Vec::new();
        list_blocks(&self.root, &mut files)?;
        files.sort_by_key(|file| file.read);
        let mut used: u64 = files.iter().map(|file| file.bytes).sum();
        for file in files {
            let is_abandoned = file.path.extension().is_some_and(|extension| extension == PARTIAL)
                && file.read.elapsed().is_ok_and(|age| age > ABANDONED);
            if used <= target && !is_abandoned {
                continue;
            }
            match fs::remove_file(&file.path) {
                Ok(()) => used -= file.bytes,
                Err(error) if error.kind() == io::ErrorKind::NotFound => used -= file.bytes,
                Err(_) => {}
            }
        }
        // No block is written if what is there cannot be deleted.
        if used > target { Err(io::ErrorKind::StorageFull.into()) } else { Ok(used) }
    }

    fn open_usage(&self) -> io::Result<File> {
        OpenOptions::new().read(true).write(true).create(true).truncate(false).open(self.root.join(USAGE))
    }

    fn block_path(&self, object: &Path, number: u64) -> PathBuf {
        let digest = digest_of(object.as_ref());
        self.lake.join(&digest[..2]).join(format!("{}.{number}", &digest[2..34]))
    }
}

fn digest_of(text: &str) -> String {
    hex::encode(Sha256::digest(text))
}

// The file's time tells eviction when it was read.
fn touch_block(path: &FsPath, file: &File) {
    let is_recent = |time: SystemTime| time.elapsed().is_ok_and(|age| age < TOUCHED);
    if file.metadata().and_then(|metadata| metadata.modified()).is_ok_and(is_recent) {
        return;
    }
    let now = FileTimes::new().set_modified(SystemTime::now());
    let _ = OpenOptions::new().write(true).open(path).and_then(|file| file.set_times(now));
}

fn list_blocks(folder: &FsPath, files: &mut Vec<BlockFile>) -> io::Result<()> {
    for entry in fs::read_dir(folder)?.flatten() {
        let Ok(metadata) = entry.metadata() else { continue };
        if metadata.is_dir() {
            list_blocks(&entry.path(), files)?;
        } else if entry.file_name() != USAGE {
            let read = metadata.modified().unwrap_or(SystemTime::UNIX_EPOCH);
            files.push(BlockFile { read, bytes: metadata.len(), path: entry.path() });
        }
    }
    Ok(())
}

// None if the file is new, or its last writer was interrupted.
fn read_usage(file: &mut File) -> io::Result<Option<u64>> {
    let mut text = String::new();
    file.rewind()?;
    file.read_to_string(&mut text)?;
    Ok(text.strip_suffix('\n').and_then(|text| text.parse().ok()))
}

fn write_usage(file: &mut File, used: u64) -> io::Result<()> {
    file.rewind()?;
    file.set_len(0)?;
    file.write_all(format!("{used}\n").as_bytes())
}

fn encode_block(object: &Path, block: &CachedBlock) -> Vec<u8> {
    let path = object.as_ref().as_bytes();
    let mut bytes = Vec::with_capacity(HEADER_BYTES + path.len() + block.bytes.len());
    bytes.extend(MAGIC);
    bytes.extend([0; 4]);
    bytes.extend(block.object_bytes.to_le_bytes());
    bytes.extend(block.modified.timestamp_millis().to_le_bytes());
    bytes.extend((path.len() as u32).to_le_bytes());
    bytes.extend(path);
    bytes.extend(&block.bytes);
    let checksum = crc32fast::hash(&bytes[12..]);
    bytes[8..12].copy_from_slice(&checksum.to_le_bytes());
    bytes
}

// None if it is no whole block of this object.
fn decode_block(bytes: Bytes, object: &Path) -> Option<CachedBlock> {
    let (magic, rest) = bytes.split_first_chunk::<8>()?;
    let (checksum, rest) = rest.split_first_chunk::<4>()?;
    if *magic != MAGIC || u32::from_le_bytes(*checksum) != crc32fast::hash(rest) {
        return None;
    }
    let (object_bytes, rest) = rest.split_first_chunk::<8>()?;
    let (modified, rest) = rest.split_first_chunk::<8>()?;
    let (length, rest) = rest.split_first_chunk::<4>()?;
    let length = u32::from_le_bytes(*length) as usize;
    if rest.get(..length)? != object.as_ref().as_bytes() {
        return None;
    }
    Some(CachedBlock {
        bytes: bytes.slice(HEADER_BYTES + length..),
        object_bytes: u64::from_le_bytes(*object_bytes),
        modified: DateTime::from_timestamp_millis(i64::from_le_bytes(*modified))?,
    })
}
