//! Walks a run's MCAP file from its first byte to its last, in one pass that also hashes it.
//!
//! The walk needs no summary, so a file that was cut off yields all that was complete. Where a record cannot be
//! one, the next that can is searched byte by byte, so damage costs the records that it touches and no others.

use std::borrow::Cow;
use std::collections::HashSet;
use std::sync::Arc;

use bytes::Bytes;
use crc32fast::Hasher as Crc32;
use mcap::records::Record;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _};
use sha2::{Digest as _, Sha256};

use crate::block_reader::BlockReader;
use crate::error::{Error, Result};
use crate::record_shape::{self, Frame, PREFIX, Shape, opcode};

const MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";
/// Opcode and length in front of every record.
const FRAME: u64 = record_shape::FRAME as u64;
/// Most that is passed over at a time.
const PASS: u64 = 1 << 20;
/// Bytes from the footer's frame to the end of the file.
const FOOTER: u64 = FRAME + 20 + MAGIC.len() as u64;

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
    file: BlockReader,
    name: String,
    size: u64,
    /// Where the next record begins.
    offset: u64,
    /// Where the last record began that nothing but the next one's place can confirm.
    doubtful: Option<u64>,
    /// Where the chunks began that were given out.
    chunks: HashSet<u64>,
    /// What is fetched of the file from `offset` on.
    buffer: Bytes,
    /// How far the file is in the digest; a search may begin before it.
    hashed: u64,
    digest: Sha256,
    crc: Crc32,
    in_summary: bool,
    /// The summary's own checksum, gathered while its records pass.
    summary: Crc32,
    end: Option<End>,
    damage: Vec<String>,
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
            file: BlockReader::open(store, path).await,
            name,
            size,
            offset: 0,
            doubtful: None,
            chunks: HashSet::new(),
            buffer: Bytes::new(),
            hashed: 0,
            digest: Sha256::new(),
            crc: Crc32::new(),
            in_summary: false,
            summary: Crc32::new(),
            end: None,
            damage: Vec::new(),
        };
        let length = (MAGIC.len() as u64).min(size);
        reader.fill(length).await?;
        let start = reader.skip(length, true);
        if start[..] != MAGIC[..] {
            let actual = start.iter().map(|b| format!("{b:02x}")).collect::<Vec<_>>().join(" ");
            let actual =
                if actual.is_empty() { "nothing (the file is empty)".to_owned() } else { format!("`{actual}`") };
            return Err(Error::NotMcap { file: reader.name, actual });
        }
        Ok(reader)
    }

    /// The next item, or None at the end.
    pub(crate) async fn next(&mut self) -> Result<Option<Item>> {
        loop {
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
        self.pass(self.size - self.offset).await?;
        Ok(Integrity {
            bytes: self.size,
            sha256: hex(&self.digest.finalize()),
            closed: self.end == Some(End::Closed),
            damage: self.damage,
        })
    }

    /// The chunk that began at `offset` is damaged. Where bytes of it are missing it reached too far, so the walk
    /// goes on at the next whole record behind its first byte; no chunk comes twice.
    pub(crate) async fn look_into(&mut self, offset: u64) -> Result<()> {
        self.doubtful = Some(offset);
        self.end = None;
        self.search().await
    }

    /// A chunk that the walk came by earlier, once more.
    pub(crate) async fn again(&self, offset: u64, length: u64) -> Result<RawChunk> {
        let start = offset + FRAME;
        let body = self.file.range(start..start + length).await;
        Ok(RawChunk { offset, body: body.map_err(|e| Error::read(&self.name, e))? })
    }

    // One record; None where it is of no interest.
    async fn record(&mut self) -> Result<Option<Item>> {
        let frame = match self.frame().await? {
            Ok(frame) => frame,
            Err(what) => {
                self.damage.push(format!("the file {what} at byte {}", self.offset));
                self.search().await?;
                return Ok(None);
            }
        };
        let offset = self.offset;
        self.doubtful = Some(offset);
        if let Some(most) = record_shape::largest(frame.code).filter(|most| frame.length > *most) {
            let Frame { code, length } = frame;
            self.damage
                .push(format!("record of kind {code:#04x} at byte {offset} has {length} bytes, more than {most}"));
            return self.pass(FRAME + length).await;
        }
        match frame.code {
            opcode::CHUNK | opcode::ATTACHMENT | opcode::METADATA | opcode::SCHEMA | opcode::CHANNEL => {
                self.fill(FRAME + frame.length).await?;
                let mut record = self.skip(FRAME + frame.length, true);
                let body = record.split_off(FRAME as usize);
                if frame.code == opcode::CHUNK {
                    return Ok(self.chunks.insert(offset).then_some(Item::Chunk(RawChunk { offset, body })));
                }
                let item = self.item(frame.code, offset, &body);
                if item.is_none() {
                    self.look_into(offset).await?;
                }
                Ok(item)
            }
            opcode::DATA_END => self.data_end().await,
            opcode::FOOTER => self.footer().await,
            _ => self.pass(FRAME + frame.length).await,
        }
    }

    // The frame at `offset`, or in words why no record begins there.
    async fn frame(&mut self) -> Result<std::result::Result<Frame, String>> {
        let left = self.size - self.offset;
        if left < FRAME {
            return Ok(Err("ends within a record's frame".to_owned()));
        }
        self.fill(left.min(FRAME + PREFIX as u64)).await?;
        let frame = Frame::read(&self.buffer);
        if frame.length > left - FRAME {
            return Ok(Err(format!("ends within a record of kind {:#04x} and {} bytes", frame.code, frame.length)));
        }
        let prefix = frame.length.min(PREFIX as u64);
        let sound = match frame.shape(&self.buffer[FRAME as usize..(FRAME + prefix) as usize]) {
            Shape::Sound => frame.code != opcode::FOOTER || self.ends_with_footer(),
            Shape::Unknown => self.goes_on(self.offset + FRAME + frame.length).await?,
            Shape::Broken => false,
        };
        Ok(if sound { Ok(frame) } else { Err(format!("has no whole record of kind {:#04x}", frame.code)) })
    }

    // Whether a record can begin at `offset`: that speaks for the one before it, where nothing else does.
    async fn goes_on(&self, offset: u64) -> Result<bool> {
        if self.size - offset < FRAME {
            return Ok(false);
        }
        let bytes = self.file.range(offset..offset + FRAME).await;
        let frame = Frame::read(&bytes.map_err(|e| Error::read(&self.name, e))?);
        Ok(frame.is_possible(self.size - offset - FRAME))
    }

    // Whether the footer at `offset` is followed by the magic bytes and by nothing else.
    fn ends_with_footer(&self) -> bool {
        self.buffer[..].ends_with(MAGIC) && self.size - self.offset == FOOTER && self.buffer.len() as u64 == FOOTER
    }

    // Goes on to the next bytes that can be a record. The record before may have swallowed it, where its length or
    // what is missing in it made it reach too far.
    async fn search(&mut self) -> Result<()> {
        if let Some(doubtful) = self.doubtful.take() {
            self.buffer.clear();
            self.offset = doubtful;
        }
        loop {
            self.fill(1).await?;
            self.skip(1, true);
            let left = self.size - self.offset;
            if left < FRAME {
                self.end = Some(End::CutOff);
                return Ok(());
            }
            self.fill(FRAME).await?;
            let last = self.buffer.len() - FRAME as usize;
            let worth = |at: &usize| Frame::read(&self.buffer[*at..]).is_worth_a_look(left - FRAME - *at as u64);
            match (0..=last).find(worth) {
                None => drop(self.skip(last as u64, true)),
                Some(at) => {
                    self.skip(at as u64, true);
                    if self.frame().await?.is_ok() {
                        return Ok(());
                    }
                }
            }
        }
    }

    fn item(&mut self, code: u8, offset: u64, body: &Bytes) -> Option<Item> {
        match mcap::parse_record(code, body) {
            Ok(Record::Attachment { header, data, crc }) => {
                // Its CRC was checked, but 0 stands for none: it may be what now stands at its end.
                self.doubtful = (crc == 0).then_some(offset);
                let data = match data {
                    Cow::Borrowed(part) => body.slice_ref(part),
                    Cow::Owned(copy) => copy.into(),
                };
                Some(Item::Attachment { name: header.name, data })
            }
            Ok(Record::Metadata(metadata)) => Some(Item::Metadata(metadata)),
            Ok(definition) => Some(Item::Definition(definition.into_owned())),
            Err(e) => {
                self.damage.push(format!("record at byte {offset}: {e}"));
                None
            }
        }
    }

    async fn data_end(&mut self) -> Result<Option<Item>> {
        let sum = self.crc.clone().finalize();
        let at = self.offset;
        let record = self.skip(FRAME + 4, true);
        let stored = u32_at(&record, FRAME as usize);
        if stored != 0 && stored != sum {
            self.damage.push(format!("data section up to byte {at}: CRC is {sum:08x}, expected {stored:08x}"));
        }
        self.in_summary = true;
        Ok(None)
    }

    async fn footer(&mut self) -> Result<Option<Item>> {
        let at = self.offset;
        let record = self.skip(FOOTER, false);
        // The summary's CRC covers all of it up to the CRC itself, the footer's frame and offsets included.
        let mut sum = self.summary.clone();
        sum.update(&record[..25]);
        let sum = sum.finalize();
        let stored = u32_at(&record, 25);
        let has_summary = record[9..17] != [0; 8];
        if has_summary && stored != 0 && stored != sum {
            self.damage.push(format!("summary before byte {at}: CRC is {sum:08x}, expected {stored:08x}"));
        }
        self.end = Some(End::Closed);
        Ok(None)
    }

    /// Fetches, so that the buffer has the next `count` bytes; the file has them. What was left of the buffer is fetched
    /// once more: that is less than to copy all behind it.
    async fn fill(&mut self, count: u64) -> Result<()> {
        if (self.buffer.len() as u64) < count {
            // Let go, so that its memory serves again.
            self.buffer = Bytes::new();
            let to = (self.offset + count.max(self.file.ahead())).min(self.size);
            let fetched = self.file.block(self.offset..to).await;
            self.buffer = fetched.map_err(|e| Error::read(&self.name, e))?;
        }
        if (self.buffer.len() as u64) < count {
            return Err(Error::read(&self.name, "it became shorter while it was read"));
        }
        Ok(())
    }

    /// Takes the next `count` bytes, which the buffer has.
    fn skip(&mut self, count: u64, counts_in_crc: bool) -> Bytes {
        let passed = self.buffer.split_to(count as usize);
        self.offset += count;
        // What a search goes over once more is in the sums already.
        let fresh = self.offset.saturating_sub(self.hashed).min(count);
        let fresh = &passed[(count - fresh) as usize..];
        self.hashed = self.hashed.max(self.offset);
        self.digest.update(fresh);
        if counts_in_crc && self.in_summary {
            self.summary.update(fresh);
        } else if counts_in_crc {
            self.crc.update(fresh);
        }
        passed
    }

    // Passes over what may be larger than the buffer should become.
    async fn pass(&mut self, count: u64) -> Result<Option<Item>> {
        let mut left = count;
        while left > 0 {
            let some = left.min(PASS);
            self.fill(some).await?;
            self.skip(some, true);
            left -= some;
        }
        Ok(None)
    }
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}
