//! Walks a run's MCAP file from its first byte to its last, in one pass that also hashes it.
//!
//! The walk needs no summary, so a file that was cut off yields all that was complete. Where a record cannot be
//! one, the next that can is searched byte by byte, so damage costs the records that it touches and no others. Whatever
//! a file holds, the walk takes time in proportion to its size, and one large record is in memory at a time.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashSet};
use std::fs::File;
use std::ops::Range;
#[cfg(feature = "store")]
use std::sync::Arc;

use bytes::Bytes;
use crc32fast::Hasher as Crc32;
use echolake_schema::{ErrorCause, escape_controls, topics};
use mcap::MAGIC;
use mcap::records::{Metadata, Record, op};
#[cfg(feature = "store")]
use object_store::{ObjectStore, ObjectStoreExt as _, path::Path};
use sha2::{Digest as _, Sha256};
#[cfg(feature = "store")]
use tokio::sync::{Semaphore, SemaphorePermit};

use crate::block_reader::BlockReader;
use crate::chunk::describe_mcap_error;
use crate::limits::LARGE_RECORD;
use crate::record_frame::{FRAME_BYTES, PREFIX_BYTES, RecordFrame, RecordShape, largest_record};

const FRAME: u64 = FRAME_BYTES as u64;
/// Most that is passed over at a time, and what a search fetches at a time.
const PASS: u64 = 1 << 20;
/// How often the walk may go back over the file, all of its ways back together: false records that reach over each
/// other would have it read the same bytes without end.
const REWINDS: u64 = 4;
/// Most chunks of one file: their places are kept.
const MOST_CHUNKS: usize = 1 << 20;
/// Most lines about one file's damage: a hostile file has millions.
const MOST_DAMAGE: usize = 1000;
#[cfg(feature = "store")]
static LARGE_RECORDS: Semaphore = Semaphore::const_new(1);
/// Bytes from the footer's frame to the end of the file.
const FOOTER: u64 = FRAME + 20 + MAGIC.len() as u64;

/// Why a file cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum ResyncError {
    /// The store does not give it.
    #[error("cannot read `{file}`: {source}")]
    Read {
        /// The file.
        file: String,
        /// The store's error.
        source: ErrorCause,
    },
    /// No file of this name.
    #[error("`{file}` is gone")]
    Gone {
        /// The file.
        file: String,
    },
    /// Not an MCAP file at all.
    #[error("`{file}` is not an MCAP file: it begins with {actual}")]
    NotMcap {
        /// The file.
        file: String,
        /// Its first bytes.
        actual: String,
    },
}

impl ResyncError {
    fn read_failure(file: &str, source: impl Into<ErrorCause>) -> Self {
        Self::Read { file: file.to_owned(), source: source.into() }
    }
}

/// A record that matters to ingest.
#[derive(Debug)]
pub enum ResyncItem {
    /// A chunk, still compressed.
    Chunk(RawChunk),
    /// An attachment whose CRC is right.
    Attachment(StoredAttachment),
    /// A metadata record.
    Metadata(Metadata),
    /// A schema or channel of the summary.
    Definition(Record<'static>),
}

/// An attachment as it is in the file.
#[derive(Debug)]
pub struct StoredAttachment {
    /// Its name.
    pub name: String,
    /// Its media type.
    pub media_type: String,
    /// Time at which it was recorded, ns since 1970.
    pub log_time: u64,
    /// Time at which it was made, ns since 1970.
    pub create_time: u64,
    /// Its content.
    pub data: Bytes,
}

/// A chunk's body and where its record begins.
#[derive(Debug)]
pub struct RawChunk {
    /// Byte of the file at which the record begins.
    pub offset: u64,
    /// The record behind its frame.
    pub body: Bytes,
    /// Held by a large chunk until its messages are read.
    pub permit: Option<LargeRecordPermit>,
}

/// Permits one large record to be in memory.
#[cfg(feature = "store")]
pub type LargeRecordPermit = SemaphorePermit<'static>;
/// Without stores one file is read at a time.
#[cfg(not(feature = "store"))]
pub type LargeRecordPermit = std::convert::Infallible;

/// The state of a whole file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FileIntegrity {
    /// Size.
    pub bytes: u64,
    /// Digest, lower-case hex.
    pub sha256: String,
    /// The file ends as a closed file does.
    pub closed: bool,
    /// What is damaged outside of chunks, in the file's order.
    pub damage: Vec<String>,
    /// Bytes that belong to no whole record, in the file's order. Those of a summary are not among them if all data
    /// before it are right: it can be made again.
    pub lost: Vec<Range<u64>>,
    /// Nothing but the summary is damaged.
    pub is_data_whole: bool,
    /// The data have another CRC than the one behind them.
    pub has_wrong_crc: bool,
}

/// Reads one file from its first byte to its last.
pub struct ResyncReader {
    file: BlockReader,
    name: String,
    size: u64,
    /// Where the next record begins.
    offset: u64,
    /// Where the last record began that nothing but the next one's place can confirm.
    doubtful: Option<u64>,
    /// Where the chunks began that were given out.
    chunks: HashSet<u64>,
    /// The bytes that were fetched last.
    window: Bytes,
    /// Where they begin; a search may begin before `offset`.
    window_start: u64,
    /// Bytes that searches went back over.
    rewound: u64,
    /// How far the file is in the digest; a search may begin before it.
    hashed: u64,
    digest: Sha256,
    has_digest: bool,
    crc: Crc32,
    in_summary: bool,
    /// The summary's own checksum, gathered while its records pass.
    summary: Crc32,
    end: Option<FileEnd>,
    damage: Vec<String>,
    /// Where the last whole record ends.
    whole_end: u64,
    /// Bytes between whole records.
    lost: Vec<Range<u64>>,
    /// Behind the record that ends the data, if its CRC is right.
    data_end: Option<u64>,
    /// A CRC behind the data is not theirs.
    has_wrong_crc: bool,
    /// What is damaged behind that.
    summary_damage: Vec<String>,
    /// Where something begins that is none of this file.
    foreign: Option<u64>,
    /// What the file's first manifest says.
    manifest: Option<BTreeMap<String, String>>,
}

/// The end of a walk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum FileEnd {
    Closed,
    CutOff,
}

impl ResyncReader {
    /// Opens a file and checks its first bytes.
    #[cfg(feature = "store")]
    pub async fn open(store: Arc<dyn ObjectStore>, path: Path, name: String) -> Result<Self, ResyncError> {
        let size = match store.head(&path).await {
            Ok(meta) => meta.size,
            Err(object_store::Error::NotFound { .. }) => return Err(ResyncError::Gone { file: name }),
            Err(e) => return Err(ResyncError::read_failure(&name, e)),
        };
        Self::from_block_reader(BlockReader::open(store, path).await, size, name).await
    }

    /// Reads an open file of this machine; nothing in it waits for anything but the disk.
    pub(crate) async fn from_file(file: File, name: String) -> Result<Self, ResyncError> {
        let size = file.metadata().map_err(|e| ResyncError::read_failure(&name, e))?.len();
        Self::from_block_reader(BlockReader::from_file(file), size, name).await
    }

    async fn from_block_reader(file: BlockReader, size: u64, name: String) -> Result<Self, ResyncError> {
        let mut reader = Self {
            file,
            name,
            size,
            offset: 0,
            doubtful: None,
            chunks: HashSet::new(),
            window: Bytes::new(),
            window_start: 0,
            rewound: 0,
            hashed: 0,
            digest: Sha256::new(),
            has_digest: true,
            crc: Crc32::new(),
            in_summary: false,
            summary: Crc32::new(),
            end: None,
            damage: Vec::new(),
            whole_end: MAGIC.len() as u64,
            lost: Vec::new(),
            data_end: None,
            has_wrong_crc: false,
            summary_damage: Vec::new(),
            foreign: None,
            manifest: None,
        };
        let length = (MAGIC.len() as u64).min(size);
        reader.fill_window(length).await?;
        let start = reader.take_bytes(length, true);
        if start[..] != MAGIC[..] {
            let actual = start.iter().map(|b| format!("{b:02x}")).collect::<Vec<_>>().join(" ");
            let actual =
                if actual.is_empty() { "nothing (the file is empty)".to_owned() } else { format!("`{actual}`") };
            // One wrong byte in front does not make it another file.
            if !matches!(reader.read_frame().await?, Ok(frame) if frame.code == op::HEADER) {
                return Err(ResyncError::NotMcap { file: reader.name, actual });
            }
            reader.note_damage(|| format!("the file begins with {actual}, which are no magic bytes"));
            reader.mark_lost(0..length);
        }
        Ok(reader)
    }

    /// Leaves out the bytes that are passed over, for a walk of which only the items matter.
    pub fn without_digest(self) -> Self {
        Self { has_digest: false, ..self }
    }

    /// The next item, or None at the end.
    pub async fn next_item(&mut self) -> Result<Option<ResyncItem>, ResyncError> {
        loop {
            if self.end.is_some() {
                return Ok(None);
            }
            if let Some(item) = self.read_record().await? {
                return Ok(Some(item));
            }
        }
    }

    /// Returns the state of the whole file, once [`Self::next_item`] returned None.
    pub async fn finish(mut self) -> Result<FileIntegrity, ResyncError> {
        self.pass_bytes(self.size - self.offset).await?;
        self.mark_lost(self.whole_end..self.size);
        if let Some(data_end) = self.data_end {
            self.lost.retain(|range| range.start < data_end || self.foreign.is_some_and(|from| range.start >= from));
        }
        let is_data_whole = self.lost.is_empty() && self.damage.is_empty();
        self.damage.append(&mut self.summary_damage);
        Ok(FileIntegrity {
            bytes: self.size,
            sha256: hex::encode(self.digest.finalize()),
            closed: self.end == Some(FileEnd::Closed),
            damage: self.damage,
            lost: self.lost,
            is_data_whole,
            has_wrong_crc: self.has_wrong_crc,
        })
    }

    /// Returns the byte at which the next record begins.
    pub fn offset(&self) -> u64 {
        self.offset
    }

    /// The chunk that began at `offset` is damaged. Where bytes of it are missing it reached too far, so the walk
    /// goes on at the next whole record behind its first byte; no chunk comes twice.
    pub async fn look_into(&mut self, offset: u64) -> Result<(), ResyncError> {
        self.end = None;
        let end = self.offset;
        self.lost.retain(|range| range.start < offset);
        self.whole_end = offset;
        match self.rewind_to(offset) {
            true => self.search_record().await,
            false => {
                self.mark_lost(offset..end);
                self.whole_end = end;
                Ok(())
            }
        }
    }

    /// A chunk that the walk came by earlier, once more.
    pub async fn reread_chunk(&mut self, offset: u64, length: u64) -> Result<RawChunk, ResyncError> {
        let start = offset + FRAME;
        // What it becomes is known only once it is read.
        let permit = self.large_record_permit(LARGE_RECORD + 1).await;
        let body = self.file.read_range(start..start + length).await;
        Ok(RawChunk { offset, body: body.map_err(|e| ResyncError::read_failure(&self.name, e))?, permit })
    }

    // One record; None where it is of no interest.
    async fn read_record(&mut self) -> Result<Option<ResyncItem>, ResyncError> {
        let frame = match self.read_frame().await? {
            Ok(frame) => frame,
            Err(what) => {
                let at = self.offset;
                // A search would go on in the other file, whose messages are none of this one's.
                if self.is_other_file().await? {
                    return Ok(None);
                }
                // A recording that was killed between two records ends as it should.
                if at == self.size {
                    self.end = Some(FileEnd::CutOff);
                    return Ok(None);
                }
                self.note_damage(|| format!("the file {what} at byte {at}"));
                self.search_record().await?;
                return Ok(None);
            }
        };
        let offset = self.offset;
        self.doubtful = Some(offset);
        let RecordFrame { code, length } = frame;
        let most = largest_record(code).unwrap_or(u64::MAX);
        let is_one_too_many = code == op::CHUNK && self.chunks.len() == MOST_CHUNKS;
        if length > most || is_one_too_many {
            self.note_damage(|| match is_one_too_many {
                true => format!("the chunk at byte {offset}: the file has more than {MOST_CHUNKS}"),
                false => format!("record of kind {code:#04x} at byte {offset} has {length} bytes, more than {most}"),
            });
            // The lengths inside of it agree with its own: nothing is looked for in it.
            self.doubtful = None;
            return self.pass_bytes(FRAME + length).await;
        }
        self.mark_lost(self.whole_end..offset);
        self.whole_end = self.whole_end.max(offset + FRAME + length);
        match code {
            op::CHUNK | op::ATTACHMENT | op::METADATA | op::SCHEMA | op::CHANNEL => {
                let permit = self.large_record_permit(self.record_memory(frame)).await;
                self.fill_window(FRAME + length).await?;
                let mut record = self.take_bytes(FRAME + length, true);
                let body = record.split_off(FRAME as usize);
                if code == op::CHUNK {
                    self.data_end = None;
                    return Ok(self.chunks.insert(offset).then_some(ResyncItem::Chunk(RawChunk {
                        offset,
                        body,
                        permit,
                    })));
                }
                let item = self.parse_item(code, offset, &body);
                match &item {
                    None => self.look_into(offset).await?,
                    Some(ResyncItem::Metadata(m)) if m.name == topics::RUN_METADATA => {
                        if self.manifest.get_or_insert_with(|| m.metadata.clone()) != &m.metadata {
                            self.end_at(offset, "another run", FileEnd::CutOff);
                            return Ok(None);
                        }
                    }
                    Some(_) => {}
                }
                Ok(item)
            }
            op::DATA_END => self.data_end().await,
            op::FOOTER => self.check_footer().await,
            _ => self.pass_bytes(FRAME + length).await,
        }
    }

    // Whether this file ends here and another one follows, which is then left alone.
    async fn is_other_file(&mut self) -> Result<bool, ResyncError> {
        let left = self.size - self.offset;
        self.fill_window(left.min(FOOTER)).await?;
        if !is_inner_footer(self.bytes_ahead(), left) {
            return Ok(false);
        }
        self.take_bytes(FOOTER, false);
        self.end_at(self.offset, "another file", FileEnd::Closed);
        Ok(true)
    }

    // Ends the walk: what begins at the byte `from` is `what`, and none of this file.
    fn end_at(&mut self, from: u64, what: &str, end: FileEnd) {
        let bytes = self.size - from;
        list_damage(&mut self.damage, || {
            format!(
                "{what} begins at byte {from}, of which {bytes} bytes are not read; hint: store it in a file of its own"
            )
        });
        self.foreign = Some(from);
        self.whole_end = from;
        self.end = Some(end);
    }

    // Behind data that are right nothing is damaged but the summary.
    fn note_damage(&mut self, line: impl FnOnce() -> String) {
        let lines = if self.data_end.is_some() { &mut self.summary_damage } else { &mut self.damage };
        list_damage(lines, line);
    }

    fn mark_lost(&mut self, range: Range<u64>) {
        let is_full = self.lost.len() >= MOST_DAMAGE;
        match self.lost.last_mut() {
            _ if range.is_empty() => {}
            Some(last) if last.end == range.start || is_full => last.end = range.end,
            _ => self.lost.push(range),
        }
    }

    // Bytes that a record takes: a chunk's also decompressed, which is its third number.
    fn record_memory(&self, frame: RecordFrame) -> u64 {
        let at = FRAME as usize + 16;
        let claimed = self.bytes_ahead().get(at..at + 8).filter(|_| frame.code == op::CHUNK);
        let claimed = claimed.map_or(0, |bytes| u64::from_le_bytes(bytes.try_into().unwrap_or_default()));
        frame.length.max(claimed)
    }

    // One reader of a file of this machine is alone; those of stores take turns.
    async fn large_record_permit(&self, bytes: u64) -> Option<LargeRecordPermit> {
        #[cfg(feature = "store")]
        if bytes > LARGE_RECORD && self.file.is_shared() {
            // Nobody closes the semaphore.
            return LARGE_RECORDS.acquire().await.ok();
        }
        let _ = bytes;
        None
    }

    // The frame at `offset`, or in words why no record begins there.
    async fn read_frame(&mut self) -> Result<Result<RecordFrame, String>, ResyncError> {
        let left = self.size - self.offset;
        if left < FRAME {
            return Ok(Err("ends within a record's frame".to_owned()));
        }
        self.fill_window(FRAME).await?;
        let frame = RecordFrame::from_bytes(self.bytes_ahead());
        if frame.length > left - FRAME {
            // A recorder writes a chunk's size when the chunk is full, and until then the largest number.
            return Ok(Err(match frame.code == op::CHUNK && frame.length == u64::MAX {
                true => "has a chunk that was never closed".to_owned(),
                false => format!("ends within a record of kind {:#04x} and {} bytes", frame.code, frame.length),
            }));
        }
        self.fill_window(left.min(FRAME + frame.length.min(PREFIX_BYTES as u64) + MAGIC.len() as u64)).await?;
        let sound = match judge_record(self.bytes_ahead(), left) {
            RecordShape::Sound => true,
            RecordShape::Unknown => self.goes_on(FRAME + frame.length).await?,
            RecordShape::Broken => false,
        };
        Ok(if sound { Ok(frame) } else { Err(format!("has no whole record of kind {:#04x}", frame.code)) })
    }

    // Whether a record can begin `behind` this one's first byte: that speaks for this one, where nothing else does.
    async fn goes_on(&mut self, behind: u64) -> Result<bool, ResyncError> {
        let left = self.size - self.offset - behind;
        if left < FRAME {
            return Ok(false);
        }
        let frame = if behind <= PREFIX_BYTES as u64 {
            self.fill_window(behind + FRAME).await?;
            RecordFrame::from_bytes(&self.bytes_ahead()[behind as usize..])
        } else {
            let start = self.offset + behind;
            let bytes = self.file.read_range(start..start + FRAME).await;
            let bytes = bytes.map_err(|e| ResyncError::read_failure(&self.name, e))?;
            if bytes.len() < FRAME_BYTES {
                return Err(ResyncError::read_failure(&self.name, "it became shorter while it was read"));
            }
            RecordFrame::from_bytes(&bytes)
        };
        Ok(frame.is_possible(left - FRAME))
    }

    // Goes back to where a doubtful record began; false where the walk went back too much already.
    fn rewind_to(&mut self, to: u64) -> bool {
        self.doubtful = None;
        let back = self.offset - to;
        let may = self.rewound + back <= self.size.saturating_mul(REWINDS);
        if may {
            self.rewound += back;
            self.offset = to;
        }
        may
    }

    // Goes on to the next bytes that can be a record. The record before may have swallowed it, where its length or
    // what is missing in it made it reach too far.
    async fn search_record(&mut self) -> Result<(), ResyncError> {
        if let Some(doubtful) = self.doubtful {
            self.rewind_to(doubtful);
        }
        // It is another file's turn to have a large record in memory.
        if self.window.len() as u64 > LARGE_RECORD {
            self.window = Bytes::new();
        }
        if self.offset < self.size {
            self.fill_window(1).await?;
            self.take_bytes(1, true);
        }
        loop {
            let left = self.size - self.offset;
            if left < FRAME {
                self.end = Some(FileEnd::CutOff);
                return Ok(());
            }
            self.fetch_window(left.min(FRAME + PREFIX_BYTES as u64), PASS).await?;
            let ahead = self.bytes_ahead();
            // All frames that can be judged by what is fetched.
            let behind = if ahead.len() as u64 == left { FRAME as usize } else { FRAME as usize + PREFIX_BYTES };
            let count = ahead.len() - behind + 1;
            let mut at = 0;
            // Most bytes are no record's code; a plain loop passes over them fast in every profile.
            while at < count && !(matches!(ahead[at], 1..=op::DATA_END) && can_begin(&ahead[at..], left - at as u64)) {
                at += 1;
            }
            self.take_bytes(at as u64, true);
            if at < count {
                return Ok(());
            }
        }
    }

    fn parse_item(&mut self, code: u8, offset: u64, body: &Bytes) -> Option<ResyncItem> {
        match crate::chunk::parse_record(code, body) {
            Ok(Record::Attachment { header, data, crc }) => {
                // Its CRC was checked, but 0 stands for none: it may be what now stands at its end.
                self.doubtful = (crc == 0).then_some(offset);
                let data = match data {
                    Cow::Borrowed(part) => body.slice_ref(part),
                    Cow::Owned(copy) => copy.into(),
                };
                Some(ResyncItem::Attachment(StoredAttachment {
                    name: header.name,
                    media_type: header.media_type,
                    log_time: header.log_time,
                    create_time: header.create_time,
                    data,
                }))
            }
            Ok(Record::Metadata(metadata)) => Some(ResyncItem::Metadata(metadata)),
            Ok(definition) => Some(ResyncItem::Definition(definition.into_owned())),
            Err(e) => {
                self.note_damage(|| format!("record at byte {offset}: {}", describe_mcap_error(&e)));
                None
            }
        }
    }

    async fn data_end(&mut self) -> Result<Option<ResyncItem>, ResyncError> {
        let sum = self.crc.clone().finalize();
        let at = self.offset;
        let record = self.take_bytes(FRAME + 4, true);
        let stored = u32_at(&record, FRAME as usize);
        if stored == sum {
            self.data_end = Some(self.offset);
        } else if stored != 0 {
            self.has_wrong_crc = true;
            self.note_damage(|| format!("data section up to byte {at}: CRC is {sum:08x}, expected {stored:08x}"));
        }
        self.in_summary = true;
        Ok(None)
    }

    async fn check_footer(&mut self) -> Result<Option<ResyncItem>, ResyncError> {
        let at = self.offset;
        let record = self.take_bytes(FOOTER, false);
        // The summary's CRC covers all of it up to the CRC itself, the footer's frame and offsets included.
        let mut sum = self.summary.clone();
        sum.update(&record[..25]);
        let sum = sum.finalize();
        let stored = u32_at(&record, 25);
        let has_summary = record[9..17] != [0; 8];
        if has_summary && stored != 0 && stored != sum {
            self.note_damage(|| format!("summary before byte {at}: CRC is {sum:08x}, expected {stored:08x}"));
        }
        self.end = Some(FileEnd::Closed);
        self.whole_end = self.size;
        Ok(None)
    }

    // What is fetched of the file from `offset` on.
    fn bytes_ahead(&self) -> &[u8] {
        let from = self.offset.checked_sub(self.window_start).and_then(|from| usize::try_from(from).ok());
        from.and_then(|from| self.window.get(from..)).unwrap_or_default()
    }

    // Fetches, so that the next `count` bytes are there; the file has them.
    async fn fill_window(&mut self, count: u64) -> Result<(), ResyncError> {
        self.fetch_window(count, self.file.readahead_bytes()).await
    }

    // The same; where it must read, it reads `at_least` so much. What was left is fetched once more: that is less than
    // to copy all behind it.
    async fn fetch_window(&mut self, count: u64, at_least: u64) -> Result<(), ResyncError> {
        if (self.bytes_ahead().len() as u64) < count {
            // Let go, so that its memory serves again.
            self.window = Bytes::new();
            let to = (self.offset + count.max(at_least)).min(self.size);
            let fetched = self.file.read_block(self.offset..to).await;
            self.window = fetched.map_err(|e| ResyncError::read_failure(&self.name, e))?;
            self.window_start = self.offset;
        }
        if (self.bytes_ahead().len() as u64) < count {
            return Err(ResyncError::read_failure(&self.name, "it became shorter while it was read"));
        }
        Ok(())
    }

    /// Takes the next `count` bytes, which are fetched.
    fn take_bytes(&mut self, count: u64, counts_in_crc: bool) -> Bytes {
        let from = (self.offset - self.window_start) as usize;
        let passed = self.window.slice(from..from + count as usize);
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

    // Passes over what may be larger than the window should become.
    async fn pass_bytes(&mut self, count: u64) -> Result<Option<ResyncItem>, ResyncError> {
        if !self.has_digest {
            self.offset += count;
            return Ok(None);
        }
        let mut left = count;
        while left > 0 {
            let some = left.min(PASS);
            self.fill_window(some).await?;
            self.take_bytes(some, true);
            left -= some;
        }
        Ok(None)
    }
}

// Whether a search ends at these bytes, as for [`judge_record`].
fn can_begin(bytes: &[u8], left: u64) -> bool {
    judge_record(bytes, left) == RecordShape::Sound || is_inner_footer(bytes, left)
}

// Whether a whole file ends with the footer and the magic bytes that `bytes` begin with, and something follows.
fn is_inner_footer(bytes: &[u8], left: u64) -> bool {
    left > FOOTER
        && RecordFrame::from_bytes(bytes) == RecordFrame { code: op::FOOTER, length: 20 }
        && bytes.get(FRAME_BYTES + 20..FOOTER as usize) == Some(MAGIC)
}

// What can be said of the record that begins with `bytes`, which have its frame, the first [`PREFIX_BYTES`] bytes
// behind it and the file's last ones, where it has them; `left` bytes of the file are left.
fn judge_record(bytes: &[u8], left: u64) -> RecordShape {
    let frame = RecordFrame::from_bytes(bytes);
    if !frame.is_possible(left - FRAME) {
        return RecordShape::Broken;
    }
    let end = FRAME as usize + frame.length.min(PREFIX_BYTES as u64) as usize;
    match frame.judge_shape(&bytes[FRAME as usize..end]) {
        // The magic bytes and nothing else are behind a footer.
        RecordShape::Sound if frame.code == op::FOOTER && (left != FOOTER || !bytes.ends_with(MAGIC)) => {
            RecordShape::Broken
        }
        shape => shape,
    }
}

/// Searches bytes of a file, of which `left` are left from the first on, for a whole chunk, or for the magic bytes with
/// something behind them: for what a reader that ends in front of them would leave out. Returns its position, or the
/// number of positions at which there is none.
///
/// # Errors
/// Nothing was found.
pub fn find_part(bytes: &[u8], left: u64) -> Result<usize, usize> {
    let behind = if bytes.len() as u64 >= left { FRAME_BYTES } else { FRAME_BYTES + PREFIX_BYTES };
    let count = (bytes.len() + 1).saturating_sub(behind);
    let is_part = |at: &usize| match bytes[*at] {
        op::CHUNK => judge_record(&bytes[*at..], left - *at as u64) == RecordShape::Sound,
        _ => bytes[*at..].starts_with(MAGIC) && left - *at as u64 > MAGIC.len() as u64,
    };
    (0..count).find(is_part).ok_or(count)
}

/// Adds a line to what is said of a file's damage, up to a limit.
pub fn list_damage(lines: &mut Vec<String>, line: impl FnOnce() -> String) {
    match lines.len() {
        0..MOST_DAMAGE => lines.push(escape_controls(&line())),
        MOST_DAMAGE => lines.push("more damage is not listed".to_owned()),
        _ => {}
    }
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}
