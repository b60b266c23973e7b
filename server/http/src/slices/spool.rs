//! Slices that are read by ranges: cut once, cached in files without names up to a number of bytes, and while other
//! clients have room on the disk. Disks are waited for on threads of their own.
//!
//! The cache weighs a slice once it is complete and until it is evicted. On the disk its bytes count from when they are
//! written until the last reader closes the file, so that these are counted beside it.

use std::fs::File;
use std::io::{self, Write as _};
use std::ops::Range;
use std::os::unix::fs::FileExt as _;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use echolake_service::RequestFault;
use futures::stream::{self, Stream};
use quick_cache::Weighter;
use quick_cache::sync::Cache;

use super::SliceTask;

/// Bytes of all slices that are kept, and of one.
const MOST_BYTES: u64 = 2 << 30;
/// Part of the disk's space that a client's slices may take of what they and the free space have together: an engine
/// has one client, and the others write to the same disk.
const SHARE: u64 = 4;
/// Bytes that are read at a time.
const BLOCK: u64 = 256 << 10;

/// Something that comes in pieces, of which a file is kept.
pub(super) trait PieceSource: Send {
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

/// Cache of slices, by their digest.
#[derive(Clone)]
pub(super) struct SliceSpool(Arc<SharedSpool>);

struct SharedSpool {
    slices: Cache<String, Arc<SpooledSlice>, SliceWeighter>,
    /// Bytes of all open files, cached or not.
    open_bytes: Mutex<u64>,
    /// Free bytes of the disk; None if the system does not tell.
    free_bytes: fn() -> Option<u64>,
}

impl Default for SliceSpool {
    fn default() -> Self {
        Self::new(free_temp_bytes)
    }
}

fn free_temp_bytes() -> Option<u64> {
    let disk = rustix::fs::statvfs(std::env::temp_dir()).ok()?;
    Some(disk.f_bavail * disk.f_frsize)
}

/// Weighs slices by their bytes.
#[derive(Clone)]
struct SliceWeighter;

impl Weighter<String, Arc<SpooledSlice>> for SliceWeighter {
    fn weight(&self, _: &String, slice: &Arc<SpooledSlice>) -> u64 {
        slice.bytes.max(1)
    }
}

/// A slice in a file without a name: the system deletes it when it is closed, even by a crash.
pub(super) struct SpooledSlice {
    file: File,
    /// Those that are counted in its spool.
    bytes: u64,
    spool: SliceSpool,
}

impl Drop for SpooledSlice {
    fn drop(&mut self) {
        *self.spool.open_bytes() -= self.bytes;
    }
}

impl SliceSpool {
    fn new(free_bytes: fn() -> Option<u64>) -> Self {
        // So few items are one shard, in which a slice may take all the room.
        let slices = Cache::with_weighter(32, MOST_BYTES, SliceWeighter);
        Self(Arc::new(SharedSpool { slices, open_bytes: Mutex::default(), free_bytes }))
    }

    /// Returns the slice of this name; it is cut if it is neither cached nor being cut by another request. If that
    /// request is dropped, the work is cancelled, and another waiting one starts it again.
    ///
    /// # Errors
    /// Those of cutting, and [`RequestFault::NoRoom`].
    pub async fn get_or_cut<S: PieceSource>(
        &self,
        key: &str,
        cut: impl Future<Output = Result<S, RequestFault>> + Send,
    ) -> Result<Arc<SpooledSlice>, RequestFault> {
        let fill = async { self.fill_slice(cut.await?).await.map(Arc::new) };
        self.0.slices.get_or_insert_async(key, fill).await
    }

    async fn fill_slice(&self, mut cutting: impl PieceSource) -> Result<SpooledSlice, RequestFault> {
        let file = on_disk(tempfile::tempfile).await.map_err(disk_fault)?;
        let mut slice = SpooledSlice { file, bytes: 0, spool: self.clone() };
        while let Some(piece) = cutting.next_piece().await? {
            self.make_room(piece.len() as u64)?;
            slice.bytes += piece.len() as u64;
            // It moves along: even if the request is dropped meanwhile, its bytes count as long as it is written to.
            let written = on_disk(move || slice.file.write_all(&piece).map(|()| slice)).await;
            slice = written.map_err(disk_fault)?;
        }
        Ok(slice)
    }

    // Counts bytes that are about to be written, and evicts slices for them.
    fn make_room(&self, bytes: u64) -> Result<(), RequestFault> {
        let slices = &self.0.slices;
        loop {
            let free_bytes = (self.0.free_bytes)().unwrap_or(u64::MAX);
            let mut open_bytes = self.open_bytes();
            let limit = MOST_BYTES.min(open_bytes.saturating_add(free_bytes) / SHARE);
            let lacking = (*open_bytes + bytes).saturating_sub(limit);
            if lacking == 0 {
                *open_bytes += bytes;
                return Ok(());
            }
            // An evicted slice is dropped, unless it is being read, which takes this lock.
            drop(open_bytes);
            let cached = slices.weight();
            if cached == 0 {
                return Err(RequestFault::NoRoom { limit });
            }
            slices.set_capacity(cached.saturating_sub(lacking));
            slices.set_capacity(MOST_BYTES);
        }
    }

    fn open_bytes(&self) -> MutexGuard<'_, u64> {
        self.0.open_bytes.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

// Away from the threads that answer connections.
async fn on_disk<T: Send + 'static>(work: impl FnOnce() -> io::Result<T> + Send + 'static) -> io::Result<T> {
    tokio::task::spawn_blocking(work).await?
}

fn disk_fault(error: io::Error) -> RequestFault {
    tracing::warn!(error = &error as &dyn std::error::Error, folder = %std::env::temp_dir().display(), "a slice cannot \
        be kept");
    RequestFault::NoRoom { limit: MOST_BYTES }
}

impl SpooledSlice {
    /// Its length.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Bytes of it, a block at a time.
    pub fn read_range(
        self: &Arc<Self>,
        range: Range<u64>,
    ) -> impl Stream<Item = Result<Bytes, RequestFault>> + Send + use<> {
        stream::try_unfold((self.clone(), range), |(slice, range)| async move {
            if range.is_empty() {
                return Ok(None);
            }
            let end = range.end.min(range.start + BLOCK);
            let from = range.start;
            let reading = slice.clone();
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

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::*;

    /// What is left of a slice.
    struct ZeroSource(u64);

    impl PieceSource for ZeroSource {
        async fn next_piece(&mut self) -> Result<Option<Bytes>, RequestFault> {
            let bytes = self.0.min(10_000);
            self.0 -= bytes;
            FREE.fetch_sub(bytes, Ordering::Relaxed);
            Ok((bytes > 0).then(|| Bytes::from(vec![0; bytes as usize])))
        }
    }

    /// Free bytes of the disk in this test.
    static FREE: AtomicU64 = AtomicU64::new(1_000_000);

    #[tokio::test]
    async fn a_client_evicts_its_own_and_leaves_the_disk_to_others() {
        let spool = SliceSpool::new(|| Some(FREE.load(Ordering::Relaxed)));
        let keep = async |key, bytes| spool.get_or_cut(key, async { Ok(ZeroSource(bytes)) }).await.map(drop);
        for key in ["a", "b"] {
            keep(key, 100_000).await.expect("room");
        }
        // The disk of this test is not freed: it is as if others took what was evicted.
        keep("c", 100_000).await.expect("the oldest made room");
        assert_eq!(["a", "b", "c"].map(|key| spool.0.slices.contains_key(key)), [false, true, true]);
        let others: u64 = 500_000;
        FREE.fetch_sub(others, Ordering::Relaxed);
        keep("d", 10_000).await.expect("both made room");
        let kept = *spool.open_bytes();
        assert!(kept <= (kept + FREE.load(Ordering::Relaxed)) / SHARE + 10_000, "{kept}");
        assert!(matches!(keep("e", 400_000).await, Err(RequestFault::NoRoom { limit }) if limit < 300_000));
        assert!(FREE.load(Ordering::Relaxed) > 0, "others have room");
        assert_eq!(*spool.open_bytes(), 0, "what was begun is gone");
    }
}
