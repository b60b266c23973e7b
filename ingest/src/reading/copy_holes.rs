//! Holes of a copy that fills out of order: it has its size and its end before its middle.

use std::ops::Range;

use echolake_recording::{FileIntegrity, ResyncError, ResyncReader};
use object_store::ObjectStoreExt as _;

use super::RunContent;
use crate::error::{Error, Result};
use crate::inbox::OpenedRun;

/// Bytes of a hole: copies are made in blocks of as many, at least.
const HOLE: u64 = 4096;
/// Bytes that are read at once.
const WINDOW: u64 = 1 << 20;

/// Checks that a file that was read, or not, has no hole: its data have another CRC than it says, and what is lost of
/// them are zeros. Whatever else is damaged is damage.
///
/// # Errors
/// [`Error::Unfilled`].
pub(crate) async fn check_filled(opened: &OpenedRun, read: &Result<RunContent>) -> Result<()> {
    let hole = match read {
        Ok(content) => find_hole(opened, &content.integrity).await,
        Err(why) if why.is_refusal() && !why.keeps_place() => match walk_file(opened).await {
            Ok(integrity) => find_hole(opened, &integrity).await,
            // No file of another make begins with zeros and has the end of an MCAP file.
            Err(ResyncError::NotMcap { .. }) => find_zeros(opened, 0..HOLE).await,
            Err(_) => None,
        },
        Err(_) => None,
    };
    match hole {
        Some(hole) => Err(Error::Unfilled { file: opened.name.clone(), hole }),
        None => Ok(()),
    }
}

// What is lost of a file that is refused: its description is in no chunk.
async fn walk_file(opened: &OpenedRun) -> std::result::Result<FileIntegrity, ResyncError> {
    let mut reader = ResyncReader::open(opened.store.clone(), opened.path.clone(), opened.name.clone()).await?;
    while reader.next_item().await?.is_some() {}
    reader.finish().await
}

// A hole may begin and end within records that tolerate zeros, as an index does that can be made again: what is lost
// begins later and ends earlier then, so that its first and last block are looked at as a whole.
async fn find_hole(opened: &OpenedRun, integrity: &FileIntegrity) -> Option<Range<u64>> {
    let lost = integrity.lost.iter().filter(|_| integrity.has_wrong_crc);
    for range in lost {
        let blocks = range.start / HOLE * HOLE..range.end.next_multiple_of(HOLE).min(integrity.bytes);
        if let Some(hole) = find_zeros(opened, blocks).await {
            return Some(hole);
        }
    }
    None
}

// The first block of a range that is nothing but zeros. What cannot be read has its own error.
async fn find_zeros(opened: &OpenedRun, range: Range<u64>) -> Option<Range<u64>> {
    let mut at = range.start.next_multiple_of(HOLE);
    while at + HOLE <= range.end {
        let bytes = opened.store.get_range(&opened.path, at..range.end.min(at + WINDOW)).await.ok()?;
        let mut blocks = bytes.chunks_exact(HOLE as usize);
        if let Some(number) = blocks.position(|block| block.iter().all(|byte| *byte == 0)) {
            let start = at + number as u64 * HOLE;
            return Some(start..start + HOLE);
        }
        at += WINDOW;
    }
    None
}
