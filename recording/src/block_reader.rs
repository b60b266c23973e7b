//! Fetches a run's file block by block: from a disk into the same memory again and again, which the cache then holds
//! while the block is hashed and decompressed.

use std::fs::File;
use std::io::{self, Read as _, Seek as _, SeekFrom};
use std::ops::Range;
#[cfg(feature = "store")]
use std::sync::Arc;

use bytes::Bytes;
use echolake_schema::ErrorCause;
#[cfg(feature = "store")]
use object_store::{GetOptions, GetResultPayload, ObjectStore, ObjectStoreExt as _, path::Path};

use crate::limits::LARGE_RECORD;

/// How much is fetched of a store at a time: a few chunks, as a request takes long.
#[cfg(feature = "store")]
const FROM_STORE: u64 = 4 << 20;
/// How much is read of a disk at a time where nothing more is needed. A chunk is read at once when its length is known,
/// so what is read ahead of it is read twice.
const FROM_DISK: u64 = 16 << 10;

/// One file, in a store or on this machine's disk.
pub struct BlockReader {
    /// Where a store has it; None for a file that was opened here.
    #[cfg(feature = "store")]
    stored: Option<(Arc<dyn ObjectStore>, Path)>,
    /// The file, if it is on a disk of this machine.
    file: Option<File>,
    /// The last block, for the next one to take its place.
    last: Bytes,
}

impl BlockReader {
    /// Opens a file of a store; what is wrong with it shows when it is read.
    #[cfg(feature = "store")]
    pub async fn open(store: Arc<dyn ObjectStore>, path: Path) -> Self {
        // A range, as other stores than a disk begin to send what is asked for.
        let first = GetOptions { range: Some((0..1).into()), ..GetOptions::default() };
        let file = match store.get_opts(&path, first).await.map(|found| found.payload) {
            Ok(GetResultPayload::File(file, _)) => Some(file),
            _ => None,
        };
        Self { stored: Some((store, path)), file, last: Bytes::new() }
    }

    /// Reads an open file.
    pub fn from_file(file: File) -> Self {
        Self {
            #[cfg(feature = "store")]
            stored: None,
            file: Some(file),
            last: Bytes::new(),
        }
    }

    /// Returns whether other files of a store are read beside it.
    #[cfg(feature = "store")]
    pub fn is_shared(&self) -> bool {
        self.stored.is_some()
    }

    /// Bytes that are fetched at least, where the file has them.
    pub fn readahead_bytes(&self) -> u64 {
        #[cfg(feature = "store")]
        if self.file.is_none() {
            return FROM_STORE;
        }
        FROM_DISK
    }

    /// Some of the file's bytes. Their memory serves the next block, where nothing holds this one any more.
    pub async fn read_block(&mut self, range: Range<u64>) -> Result<Bytes, ErrorCause> {
        if self.file.is_none() {
            return self.read_range(range).await;
        }
        let count = (range.end - range.start) as usize;
        let mut room = std::mem::take(&mut self.last).try_into_mut().unwrap_or_default();
        if room.len() < count {
            room.resize(count, 0);
        }
        let read = self.read_at(range.start, &mut room[..count])?;
        let block = room.freeze();
        // Of a large record nothing is kept once it is dealt with.
        if block.len() as u64 <= LARGE_RECORD {
            self.last = block.clone();
        }
        Ok(block.slice(..read))
    }

    /// Some of the file's bytes, elsewhere than where the walk is.
    pub async fn read_range(&mut self, range: Range<u64>) -> Result<Bytes, ErrorCause> {
        #[cfg(feature = "store")]
        if let Some((store, path)) = &self.stored {
            return Ok(store.get_range(path, range).await?);
        }
        let mut room = vec![0; (range.end - range.start) as usize];
        let read = self.read_at(range.start, &mut room)?;
        room.truncate(read);
        Ok(room.into())
    }

    // How many bytes there are, up to those asked for: fewer where the file has become shorter.
    fn read_at(&mut self, from: u64, room: &mut [u8]) -> io::Result<usize> {
        let Some(file) = &mut self.file else { return Ok(0) };
        file.seek(SeekFrom::Start(from))?;
        let mut done = 0;
        while done < room.len() {
            match file.read(&mut room[done..]) {
                Ok(0) => break,
                Ok(read) => done += read,
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                Err(e) => return Err(e),
            }
        }
        Ok(done)
    }
}
