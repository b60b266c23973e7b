//! Reads a recording on this machine's disk as ingest reads one in a store: all that is whole of it, past any damage.

use std::collections::HashSet;
use std::fs::File;
use std::path::Path;
use std::pin::pin;
use std::task::{Context, Poll, Waker};

use bytes::Bytes;
use mcap::records::{Metadata, Record};

use crate::chunk::DecodedChunk;
use crate::resync_reader::{FileIntegrity, ResyncError, ResyncItem, ResyncReader, StoredAttachment, list_damage};

/// Something of a recording that is proven whole.
pub enum RecordingItem {
    /// A chunk whose CRC is right. One that is there twice comes once.
    Chunk(WholeChunk),
    /// An attachment whose CRC is right.
    Attachment(StoredAttachment),
    /// A metadata record.
    Metadata(Metadata),
    /// A schema or channel outside of chunks, as in a summary.
    Definition(Record<'static>),
}

/// The records of a chunk, and where it stands.
pub struct WholeChunk {
    /// Byte of the file at which its record begins.
    pub offset: u64,
    /// Bytes of its record.
    pub length: u64,
    /// Its records.
    pub records: Vec<Record<'static>>,
}

/// Reads one file from its first byte to its last.
pub struct RecordingReader {
    walk: ResyncReader,
    seen: HashSet<crate::ChunkIdentity>,
    /// What is damaged in chunks.
    damage: Vec<String>,
}

impl RecordingReader {
    /// Opens a file.
    ///
    /// # Errors
    /// [`ResyncError`], if it cannot be read or is no MCAP file.
    pub fn open(path: &Path) -> Result<Self, ResyncError> {
        let name = path.display().to_string();
        let file = File::open(path).map_err(|e| ResyncError::Read { file: name.clone(), source: e.into() })?;
        let walk = block_on(ResyncReader::from_file(file, name))?;
        Ok(Self { walk, seen: HashSet::new(), damage: Vec::new() })
    }

    /// Returns the next whole item; None at the end of the file.
    ///
    /// # Errors
    /// [`ResyncError::Read`] if the system refuses; damage is no error but listed by [`Self::finish`].
    pub fn next_item(&mut self) -> Result<Option<RecordingItem>, ResyncError> {
        loop {
            let Some(item) = block_on(self.walk.next_item())? else { return Ok(None) };
            return Ok(Some(match item {
                ResyncItem::Attachment(attachment) => RecordingItem::Attachment(attachment),
                ResyncItem::Metadata(metadata) => RecordingItem::Metadata(metadata),
                ResyncItem::Definition(record) => RecordingItem::Definition(record),
                ResyncItem::Chunk(raw) => match whole_records(&raw.body) {
                    Ok((identity, _)) if !self.seen.insert(identity) => {
                        let offset = raw.offset;
                        list_damage(&mut self.damage, || {
                            format!("the chunk at byte {offset}: a copy of one before it")
                        });
                        continue;
                    }
                    Ok((_, records)) => {
                        let length = self.walk.offset() - raw.offset;
                        RecordingItem::Chunk(WholeChunk { offset: raw.offset, length, records })
                    }
                    Err(reason) => {
                        list_damage(&mut self.damage, || format!("the chunk at byte {}: {reason}", raw.offset));
                        block_on(self.walk.look_into(raw.offset))?;
                        continue;
                    }
                },
            }));
        }
    }

    /// Returns the state of the whole file, damage in chunks included, once [`Self::next_item`] returned None.
    ///
    /// # Errors
    /// [`ResyncError::Read`].
    pub fn finish(self) -> Result<FileIntegrity, ResyncError> {
        let mut integrity = block_on(self.walk.finish())?;
        integrity.is_data_whole &= self.damage.is_empty();
        integrity.damage.extend(self.damage);
        Ok(integrity)
    }
}

fn whole_records(body: &Bytes) -> Result<(crate::ChunkIdentity, Vec<Record<'static>>), String> {
    let chunk = DecodedChunk::decode(body).map_err(|e| e.to_string())?;
    let identity = chunk.identity();
    let mut cursor = chunk.into_cursor();
    let mut records = Vec::new();
    while let Some(record) = cursor.next_record().map_err(|e| e.to_string())? {
        records.push(record.into_owned());
    }
    Ok((identity, records))
}

// A walk over a file of this machine never waits.
fn block_on<T>(walk: impl Future<Output = T>) -> T {
    let mut walk = pin!(walk);
    loop {
        if let Poll::Ready(done) = walk.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
            return done;
        }
    }
}
