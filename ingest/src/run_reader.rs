//! Walks a run's MCAP file from its first byte to its last, in one pass that also hashes it.
//!
//! The walk needs no summary, so a file that was cut off yields all that was complete. Where a record's
//! frame is damaged, the chunks behind it are found through the summary's index.

use std::sync::Arc;

use bytes::{Bytes, BytesMut};
use crc32fast::Hasher as Crc32;
use mcap::records::Record;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _};
use sha2::{Digest as _, Sha256};

use crate::error::{Error, Result};

const MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";
/// Opcode and length in front of every record.
const FRAME: u64 = 9;
/// How much is fetched at a time.
const BLOCK: u64 = 8 << 20;

/// Opcodes of the MCAP specification that the walk looks at.
mod opcode {
    pub(super) const FOOTER: u8 = 0x02;
    pub(super) const SCHEMA: u8 = 0x03;
    pub(super) const CHANNEL: u8 = 0x04;
    pub(super) const CHUNK: u8 = 0x06;
    pub(super) const ATTACHMENT: u8 = 0x09;
    pub(super) const METADATA: u8 = 0x0C;
    pub(super) const DATA_END: u8 = 0x0F;
    /// The highest opcode of the specification; from 0x80 on they are private.
    pub(super) const LAST: u8 = 0x0F;
}

/// Something that the walk came by.
#[derive(Debug)]
pub(crate) enum Item {
    /// A chunk, still compressed.
    Chunk(RawChunk),
    /// An attachment whose CRC is right.
    Attachment { name: String, data: Bytes },
    /// A metadata record.
    Metadata(mcap::records::Metadata),
    /// A schema or channel of the summary.
    Definition(Record<'static>),
}

/// A chunk's body and where its record begins.
#[derive(Debug, Clone)]
pub(crate) struct RawChunk {
    pub(crate) offset: u64,
    pub(crate) body: Bytes,
}

/// What the walk found out about the whole file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Integrity {
    /// Size.
    pub bytes: u64,
    /// Digest, lower-case hex.
    pub sha256: String,
    /// The file ends as a closed file does.
    pub closed: bool,
    /// What is damaged outside of chunks, in the file's order.
    pub damage: Vec<String>,
}

/// A walk over one file.
pub(crate) struct RunReader {
    store: Arc<dyn ObjectStore>,
    path: Path,
    name: String,
    size: u64,
    /// Where the next record begins.
    offset: u64,
    /// What is fetched of the file from `offset` on.
    buffer: BytesMut,
    digest: Sha256,
    crc: Crc32,
    in_summary: bool,
    summary: SummaryCrc,
    end: Option<End>,
    damage: Vec<String>,
    /// Chunks that the summary names behind a broken frame.
    detour: Option<std::vec::IntoIter<(u64, u64)>>,
}

/// The summary's own checksum, gathered while its records pass.
#[derive(Default)]
struct SummaryCrc {
    running: Crc32,
}

/// Why the walk is over.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum End {
    Closed,
    CutOff,
}

impl RunReader {
    /// Opens a file and checks its first bytes.
    pub(crate) async fn open(store: Arc<dyn ObjectStore>, path: Path, name: String) -> Result<Self> {
        let size = match store.head(&path).await {
            Ok(meta) => meta.size,
            Err(object_store::Error::NotFound { .. }) => return Err(Error::Gone { file: name }),
            Err(e) => return Err(Error::read(&name, e)),
        };
        let mut reader = Self {
            store,
            path,
            name,
            size,
            offset: 0,
            buffer: BytesMut::new(),
            digest: Sha256::new(),
            crc: Crc32::new(),
            in_summary: false,
            summary: SummaryCrc::default(),
            end: None,
            damage: Vec::new(),
            detour: None,
        };
        let start = reader.peek((MAGIC.len() as u64).min(size)).await?;
        if start[..] != MAGIC[..] {
            let actual = start.iter().map(|b| format!("{b:02x}")).collect::<Vec<_>>().join(" ");
            let actual =
                if actual.is_empty() { "nothing (the file is empty)".to_owned() } else { format!("`{actual}`") };
            return Err(Error::NotMcap { file: reader.name, actual });
        }
        reader.skip(MAGIC.len() as u64, true);
        Ok(reader)
    }

    /// The next item, or None at the end.
    pub(crate) async fn next(&mut self) -> Result<Option<Item>> {
        loop {
            if let Some(found) = self.detour_next().await? {
                return Ok(found);
            }
            if self.end.is_some() {
                return Ok(None);
            }
            if let Some(item) = self.record().await? {
                return Ok(Some(item));
            }
        }
    }

    /// What is known of the whole file, once [`Self::next`] returned None.
    pub(crate) async fn finish(mut self) -> Result<Integrity> {
        while self.offset < self.size {
            let some = (self.size - self.offset).min(BLOCK);
            self.peek(some).await?;
            self.skip(some, false);
        }
        Ok(Integrity {
            bytes: self.size,
            sha256: hex(&self.digest.finalize()),
            closed: self.end == Some(End::Closed),
            damage: self.damage,
        })
    }

    // One record; None where it is of no interest.
    async fn record(&mut self) -> Result<Option<Item>> {
        let left = self.size - self.offset;
        if left < FRAME {
            return self.stop_early("ends within a record's frame").await;
        }
        let frame = self.peek(FRAME).await?;
        let code = frame[0];
        let length = u64::from_le_bytes(frame[1..9].try_into().unwrap_or_default());
        if code == 0 || (code > opcode::LAST && code < 0x80) {
            return self.stop_early(&format!("has a record of unknown kind {code:#04x}")).await;
        }
        if length > left - FRAME {
            return self.stop_early(&format!("ends within a record of {length} bytes")).await;
        }
        let offset = self.offset;
        match code {
            opcode::CHUNK | opcode::ATTACHMENT | opcode::METADATA | opcode::DATA_END | opcode::FOOTER => {}
            opcode::SCHEMA | opcode::CHANNEL => {}
            _ => {
                self.pass(FRAME + length).await?;
                return Ok(None);
            }
        }
        if code == opcode::DATA_END {
            self.data_end(length).await?;
            return Ok(None);
        }
        if code == opcode::FOOTER {
            self.footer(length).await?;
            return Ok(None);
        }
        let record = self.peek(FRAME + length).await?;
        let body = Bytes::copy_from_slice(&record[FRAME as usize..]);
        self.skip(FRAME + length, true);
        Ok(self.item(code, offset, body))
    }

    fn item(&mut self, code: u8, offset: u64, body: Bytes) -> Option<Item> {
        if code == opcode::CHUNK {
            return Some(Item::Chunk(RawChunk { offset, body }));
        }
        match mcap::parse_record(code, &body) {
            Ok(Record::Attachment { header, data, crc }) => {
                // The CRC covers the record's fields up to itself.
                let sum = body.len().checked_sub(4).map(|end| crc32fast::hash(&body[..end]));
                if crc != 0 && sum != Some(crc) {
                    self.damage.push(format!("attachment `{}` at byte {offset}: wrong CRC", header.name));
                    return None;
                }
                Some(Item::Attachment { name: header.name, data: Bytes::copy_from_slice(&data) })
            }
            Ok(Record::Metadata(metadata)) => Some(Item::Metadata(metadata)),
            Ok(definition @ (Record::Schema { .. } | Record::Channel(_))) => {
                Some(Item::Definition(definition.into_owned()))
            }
            Ok(_) => None,
            Err(e) => {
                self.damage.push(format!("record at byte {offset}: {e}"));
                None
            }
        }
    }

    async fn data_end(&mut self, length: u64) -> Result<()> {
        let sum = self.crc.clone().finalize();
        let record = self.peek(FRAME + length).await?;
        let stored = record.get(9..13).and_then(|b| b.try_into().ok()).map(u32::from_le_bytes);
        if let Some(stored) = stored.filter(|s| *s != 0 && *s != sum) {
            let at = self.offset;
            self.damage.push(format!("data section up to byte {at}: CRC is {sum:08x}, expected {stored:08x}"));
        }
        self.skip(FRAME + length, true);
        self.in_summary = true;
        Ok(())
    }

    async fn footer(&mut self, length: u64) -> Result<()> {
        let record = self.peek(FRAME + length).await?;
        let at = self.offset;
        // The summary's CRC covers all of it up to the CRC itself, the footer's frame and offsets included.
        if length == 20 {
            self.summary.running.update(&record[..25]);
            let sum = self.summary.running.clone().finalize();
            let stored = u32::from_le_bytes(record[25..29].try_into().unwrap_or_default());
            let has_summary = record[9..17] != [0; 8];
            if has_summary && stored != 0 && stored != sum {
                self.damage.push(format!("summary before byte {at}: CRC is {sum:08x}, expected {stored:08x}"));
            }
        }
        self.skip(FRAME + length, false);
        let end = self.peek((MAGIC.len() as u64).min(self.size - self.offset)).await?;
        let closed = end[..] == MAGIC[..] && self.offset + MAGIC.len() as u64 == self.size;
        if !closed {
            self.damage.push(format!("no magic bytes at the end, byte {}", self.offset));
        }
        self.end = Some(if closed { End::Closed } else { End::CutOff });
        Ok(())
    }

    // The frame at `offset` makes no sense: whatever the summary still names behind it is read instead.
    async fn stop_early(&mut self, what: &str) -> Result<Option<Item>> {
        self.damage.push(format!("the file {what} at byte {}", self.offset));
        let behind = self.chunks_behind(self.offset).await;
        self.end = Some(if behind.is_some() { End::Closed } else { End::CutOff });
        self.detour = behind.map(Vec::into_iter);
        Ok(None)
    }

    async fn chunks_behind(&self, offset: u64) -> Option<Vec<(u64, u64)>> {
        let footer_start = self.size.checked_sub(FRAME + 20 + 8)?;
        let footer = self.store.get_range(&self.path, footer_start..self.size).await.ok()?;
        let intact = footer[0] == opcode::FOOTER && footer[29..] == MAGIC[..];
        let start = u64::from_le_bytes(footer[9..17].try_into().ok()?);
        if !intact || start == 0 || start >= footer_start {
            return None;
        }
        let summary = self.store.get_range(&self.path, start..footer_start).await.ok()?;
        let chunks = mcap::read::LinearReader::sans_magic(&summary).map_while(|r| r.ok()).filter_map(|r| match r {
            Record::ChunkIndex(index) => Some((index.chunk_start_offset, index.chunk_length)),
            _ => None,
        });
        let fits = |&(at, length): &(u64, u64)| at > offset && length >= FRAME && at.saturating_add(length) <= start;
        Some(chunks.filter(fits).collect())
    }

    async fn detour_next(&mut self) -> Result<Option<Option<Item>>> {
        let Some(chunks) = &mut self.detour else { return Ok(None) };
        let Some((offset, length)) = chunks.next() else {
            self.detour = None;
            return Ok(None);
        };
        let range = offset + FRAME..offset + length;
        let body = self.store.get_range(&self.path, range).await.map_err(|e| Error::read(&self.name, e))?;
        Ok(Some(Some(Item::Chunk(RawChunk { offset, body }))))
    }

    /// The next `count` bytes, which the file has.
    async fn peek(&mut self, count: u64) -> Result<Bytes> {
        let count = count as usize;
        if self.buffer.len() < count {
            let from = self.offset + self.buffer.len() as u64;
            let to = (from + BLOCK.max((count - self.buffer.len()) as u64)).min(self.size);
            let fetched = self.store.get_range(&self.path, from..to).await.map_err(|e| Error::read(&self.name, e))?;
            self.buffer.extend_from_slice(&fetched);
        }
        if self.buffer.len() < count {
            return Err(Error::read(&self.name, "it became shorter while it was read"));
        }
        Ok(Bytes::copy_from_slice(&self.buffer[..count]))
    }

    fn skip(&mut self, count: u64, counts_in_crc: bool) {
        let passed = self.buffer.split_to(count as usize);
        self.digest.update(&passed);
        if counts_in_crc && self.in_summary {
            self.summary.running.update(&passed);
        } else if counts_in_crc {
            self.crc.update(&passed);
        }
        self.offset += count;
    }

    // Passes over what may be larger than the buffer should become.
    async fn pass(&mut self, count: u64) -> Result<()> {
        let mut left = count;
        while left > 0 {
            let some = left.min(BLOCK);
            self.peek(some).await?;
            self.skip(some, true);
            left -= some;
        }
        Ok(())
    }
}

pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}
