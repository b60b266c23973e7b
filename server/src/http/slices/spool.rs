//! Slices that are read by ranges: cut once, kept in files without names, so many bytes of them, the oldest going
//! first. Disks are waited for on threads of their own.

use std::collections::{HashMap, VecDeque};
use std::fs::File;
use std::io::{self, Write as _};
use std::ops::Range;
use std::os::unix::fs::FileExt as _;
use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use futures::stream::{self, Stream};
use tokio::sync::OnceCell;

use super::Cutting;
use crate::fault::Fault;

/// Bytes of all slices that are kept, and of one.
const MOST_BYTES: u64 = 2 << 30;
/// Bytes that are read at a time.
const BLOCK: u64 = 256 << 10;

/// Slices that are kept, by what they are.
#[derive(Clone, Default)]
pub(super) struct Spool(Arc<Mutex<Kept>>);

#[derive(Default)]
struct Kept {
    slices: HashMap<String, Arc<OnceCell<Arc<Spooled>>>>,
    /// Those that are whole, the one that was asked for last at the end.
    order: VecDeque<String>,
    /// Of all files that are open, kept or not.
    bytes: u64,
}

/// A slice in a file without a name: the system deletes it when it is closed, even by a crash.
pub(super) struct Spooled {
    file: File,
    /// Those that are counted in its spool.
    bytes: u64,
    spool: Spool,
}

impl Drop for Spooled {
    fn drop(&mut self) {
        self.spool.kept().bytes -= self.bytes;
    }
}

/// A request that waits for a slice. The last one that is dropped without a slice removes the empty entry.
struct Waiting<'a> {
    spool: &'a Spool,
    cell: Arc<OnceCell<Arc<Spooled>>>,
    key: &'a str,
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        let mut kept = self.spool.kept();
        // Two: the map's and this one.
        if !self.cell.initialized() && Arc::strong_count(&self.cell) <= 2 {
            kept.slices.remove(self.key);
        }
    }
}

impl Spool {
    /// Returns the slice of this name; it is cut if it is neither cached nor being cut by another request. If that
    /// request is dropped, the work is cancelled, and another waiting one starts it again.
    ///
    /// # Errors
    /// Those of cutting, and [`Fault::NoRoom`].
    pub(super) async fn once(
        &self,
        key: &str,
        cut: impl FnOnce() -> Result<Cutting, Fault>,
    ) -> Result<Arc<Spooled>, Fault> {
        let cell = self.kept().slices.entry(key.to_owned()).or_default().clone();
        let waiting = Waiting { spool: self, cell, key };
        let spooled = waiting.cell.get_or_try_init(|| async { self.fill(cut()?).await.map(Arc::new) }).await?.clone();
        self.touch(key, &waiting.cell);
        Ok(spooled)
    }

    async fn fill(&self, mut cutting: Cutting) -> Result<Spooled, Fault> {
        let file = on_disk(tempfile::tempfile).await.map_err(no_room)?;
        let mut slice = Spooled { file, bytes: 0, spool: self.clone() };
        while let Some(piece) = cutting.next().await? {
            self.make_room(piece.len() as u64)?;
            slice.bytes += piece.len() as u64;
            // It goes along: whoever leaves meanwhile, it is counted for as long as it is written to.
            let written = on_disk(move || slice.file.write_all(&piece).map(|()| slice)).await;
            slice = written.map_err(no_room)?;
        }
        Ok(slice)
    }

    // Counts bytes that are about to be written, and lets the oldest slices go for them.
    fn make_room(&self, bytes: u64) -> Result<(), Fault> {
        let mut gone = Vec::new();
        let has_room = loop {
            let mut kept = self.kept();
            if kept.bytes + bytes <= MOST_BYTES {
                kept.bytes += bytes;
                break true;
            }
            let Some(oldest) = kept.order.pop_front() else { break false };
            gone.extend(kept.slices.remove(&oldest));
            drop(kept);
            // Its bytes are free once it is dropped, unless it is being read; dropping takes the lock.
            gone.clear();
        };
        if has_room { Ok(()) } else { Err(Fault::NoRoom { limit: MOST_BYTES }) }
    }

    fn touch(&self, key: &str, cell: &Arc<OnceCell<Arc<Spooled>>>) {
        let mut kept = self.kept();
        // It may have had to go meanwhile.
        if kept.slices.get(key).is_some_and(|known| Arc::ptr_eq(known, cell)) {
            kept.order.retain(|known| known != key);
            kept.order.push_back(key.to_owned());
        }
    }

    fn kept(&self) -> std::sync::MutexGuard<'_, Kept> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

// Away from the threads that answer connections.
async fn on_disk<T: Send + 'static>(work: impl FnOnce() -> io::Result<T> + Send + 'static) -> io::Result<T> {
    tokio::task::spawn_blocking(work).await?
}

fn no_room(error: io::Error) -> Fault {
    eprintln!("a slice cannot be kept in `{}`: {error}", std::env::temp_dir().display());
    Fault::NoRoom { limit: MOST_BYTES }
}

impl Spooled {
    /// Its length.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Bytes of it, a block at a time.
    pub(super) fn read(self: &Arc<Self>, range: Range<u64>) -> impl Stream<Item = Result<Bytes, Fault>> + Send + use<> {
        stream::try_unfold((self.clone(), range), |(slice, range)| async move {
            if range.is_empty() {
                return Ok(None);
            }
            let end = range.end.min(range.start + BLOCK);
            let (from, reading) = (range.start, slice.clone());
            let read = on_disk(move || {
                let mut block = vec![0; (end - from) as usize];
                reading.file.read_exact_at(&mut block, from).map(|()| Bytes::from(block))
            });
            match read.await {
                Ok(block) => Ok(Some((block, (slice, end..range.end)))),
                Err(failed) => {
                    eprintln!("a kept slice cannot be read: {failed}");
                    Err(Fault::Internal)
                }
            }
        })
    }
}
