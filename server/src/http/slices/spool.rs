//! Slices that are read by ranges: cut once, cached in files without names up to a number of bytes, the oldest evicted
//! first. Disks are waited for on threads of their own.
//!
//! It is none of the caches by `quick_cache`, which count an item once it is complete and until it is evicted: here bytes
//! count from when they are written until the last reader closes the file.

use std::collections::{HashMap, VecDeque};
use std::fs::File;
use std::io::{self, Write as _};
use std::ops::Range;
use std::os::unix::fs::FileExt as _;
use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use futures::stream::{self, Stream};
use tokio::sync::OnceCell;

use super::SliceTask;
use crate::fault::RequestFault;
use crate::running::RunningQuery;

/// Bytes of all slices that are kept, and of one.
const MOST_BYTES: u64 = 2 << 30;
/// Bytes that are read at a time.
const BLOCK: u64 = 256 << 10;

/// Something that comes in pieces, of which a file is kept.
pub(in crate::http) trait PieceSource: Send {
    /// The next bytes; None after the last.
    ///
    /// # Errors
    /// Cause that it does not come to its end.
    fn next_piece(&mut self) -> impl Future<Output = Result<Option<Bytes>, RequestFault>> + Send;
}

impl PieceSource for SliceTask {
    fn next_piece(&mut self) -> impl Future<Output = Result<Option<Bytes>, RequestFault>> + Send {
        self.next()
    }
}

impl PieceSource for RunningQuery<Bytes> {
    fn next_piece(&mut self) -> impl Future<Output = Result<Option<Bytes>, RequestFault>> + Send {
        self.next()
    }
}

/// Cache of slices, by their digest.
#[derive(Clone, Default)]
pub(in crate::http) struct SliceSpool(Arc<Mutex<SpoolState>>);

#[derive(Default)]
struct SpoolState {
    slices: HashMap<String, Arc<OnceCell<Arc<SpooledSlice>>>>,
    /// Keys of complete slices, the most recently used last.
    order: VecDeque<String>,
    /// Bytes of all open files, cached or not.
    bytes: u64,
}

/// A slice in a file without a name: the system deletes it when it is closed, even by a crash.
pub(in crate::http) struct SpooledSlice {
    file: File,
    /// Those that are counted in its spool.
    bytes: u64,
    spool: SliceSpool,
}

impl Drop for SpooledSlice {
    fn drop(&mut self) {
        self.spool.kept().bytes -= self.bytes;
    }
}

/// A request that waits for a slice. The last one that is dropped without a slice removes the empty entry.
struct SliceWaiter<'a> {
    spool: &'a SliceSpool,
    cell: Arc<OnceCell<Arc<SpooledSlice>>>,
    key: &'a str,
}

impl Drop for SliceWaiter<'_> {
    fn drop(&mut self) {
        let mut kept = self.spool.kept();
        // Two: the map's and this one.
        if !self.cell.initialized() && Arc::strong_count(&self.cell) <= 2 {
            kept.slices.remove(self.key);
        }
    }
}

impl SliceSpool {
    /// Returns the slice of this name; it is cut if it is neither cached nor being cut by another request. If that
    /// request is dropped, the work is cancelled, and another waiting one starts it again.
    ///
    /// # Errors
    /// Those of cutting, and [`RequestFault::NoRoom`].
    pub(in crate::http) async fn once<S: PieceSource>(
        &self,
        key: &str,
        cut: impl Future<Output = Result<S, RequestFault>> + Send,
    ) -> Result<Arc<SpooledSlice>, RequestFault> {
        let cell = self.kept().slices.entry(key.to_owned()).or_default().clone();
        let waiting = SliceWaiter { spool: self, cell, key };
        let spooled =
            waiting.cell.get_or_try_init(|| async { self.fill(cut.await?).await.map(Arc::new) }).await?.clone();
        self.touch(key, &waiting.cell);
        Ok(spooled)
    }

    async fn fill(&self, mut cutting: impl PieceSource) -> Result<SpooledSlice, RequestFault> {
        let file = on_disk(tempfile::tempfile).await.map_err(no_room)?;
        let mut slice = SpooledSlice { file, bytes: 0, spool: self.clone() };
        while let Some(piece) = cutting.next_piece().await? {
            self.make_room(piece.len() as u64)?;
            slice.bytes += piece.len() as u64;
            // It moves along: even if the request is dropped meanwhile, its bytes count as long as it is written to.
            let written = on_disk(move || slice.file.write_all(&piece).map(|()| slice)).await;
            slice = written.map_err(no_room)?;
        }
        Ok(slice)
    }

    // Counts bytes that are about to be written, and evicts the oldest slices for them.
    fn make_room(&self, bytes: u64) -> Result<(), RequestFault> {
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
        if has_room { Ok(()) } else { Err(RequestFault::NoRoom { limit: MOST_BYTES }) }
    }

    fn touch(&self, key: &str, cell: &Arc<OnceCell<Arc<SpooledSlice>>>) {
        let mut kept = self.kept();
        // It may have had to go meanwhile.
        if kept.slices.get(key).is_some_and(|known| Arc::ptr_eq(known, cell)) {
            kept.order.retain(|known| known != key);
            kept.order.push_back(key.to_owned());
        }
    }

    fn kept(&self) -> std::sync::MutexGuard<'_, SpoolState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

// Away from the threads that answer connections.
async fn on_disk<T: Send + 'static>(work: impl FnOnce() -> io::Result<T> + Send + 'static) -> io::Result<T> {
    tokio::task::spawn_blocking(work).await?
}

fn no_room(error: io::Error) -> RequestFault {
    tracing::warn!(error = &error as &dyn std::error::Error, folder = %std::env::temp_dir().display(), "a slice cannot be kept");
    RequestFault::NoRoom { limit: MOST_BYTES }
}

impl SpooledSlice {
    /// Its length.
    pub(in crate::http) fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Bytes of it, a block at a time.
    pub(in crate::http) fn read(
        self: &Arc<Self>,
        range: Range<u64>,
    ) -> impl Stream<Item = Result<Bytes, RequestFault>> + Send + use<> {
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
                Err(failed) => Err(RequestFault::defect("a kept slice cannot be read")(failed)),
            }
        })
    }
}
