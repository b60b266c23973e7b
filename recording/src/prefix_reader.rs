//! The verified prefix of a run's file: record after record from its first byte, up to the first that cannot be
//! proven whole.

use std::fs::File;
use std::io::{self, BufReader, Read as _};
use std::path::{Path, PathBuf};

use bytes::Bytes;
use mcap::records::{Metadata, Record};
use mcap::{Attachment, MAGIC};

use crate::chunk::{DecodedChunk, describe, parse_record};
use crate::limits::LARGEST_RECORD;
use crate::record_frame::{FRAME_BYTES, RecordFrame};

/// Why a file's prefix cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum PrefixError {
    /// The system refused to read it.
    #[error("cannot read `{}`", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// It does not begin as an MCAP file.
    #[error("`{}` is no MCAP file, or only {bytes} bytes of one", path.display())]
    Headless {
        /// The file.
        path: PathBuf,
        /// Its size.
        bytes: u64,
    },
}

const FRAME: u64 = FRAME_BYTES as u64;

/// A record that is proven whole.
pub enum PrefixItem {
    /// The records of a chunk whose CRC is right.
    Chunk(Vec<Record<'static>>),
    /// An attachment whose CRC is right.
    Attachment(Attachment<'static>),
    /// A metadata record.
    Metadata(Metadata),
}

/// Reads one file up to the first record that is not proven whole.
pub struct PrefixReader {
    file: BufReader<File>,
    path: PathBuf,
    /// Its size when the walk began, bytes.
    pub size: u64,
    /// End of the verified prefix, bytes.
    pub verified: u64,
    /// Byte at which the last item begins.
    pub item: u64,
    /// True behind the end of the data section, as in a file that was closed.
    pub ended: bool,
    /// The reason why the verified prefix ends; None if it is the whole file.
    pub defect: Option<String>,
}

impl PrefixReader {
    /// Opens a file.
    ///
    /// # Errors
    /// [`PrefixError::Read`], or [`PrefixError::Headless`] where it does not begin as an MCAP file.
    pub fn open(path: &Path) -> Result<Self, PrefixError> {
        let failed = |source| PrefixError::Read { path: path.to_owned(), source };
        let file = File::open(path).map_err(failed)?;
        let size = file.metadata().map_err(failed)?.len();
        let mut walk = Self {
            file: BufReader::new(file),
            path: path.to_owned(),
            size,
            verified: 0,
            item: 0,
            ended: false,
            defect: None,
        };
        let mut magic = [0; MAGIC.len()];
        if size < magic.len() as u64 || walk.fill(&mut magic).is_err() || magic != MAGIC {
            return Err(PrefixError::Headless { path: walk.path, bytes: size });
        }
        walk.verified = magic.len() as u64;
        Ok(walk)
    }

    /// The next whole thing; None behind the verified prefix.
    ///
    /// # Errors
    /// [`PrefixError::Read`] where the system refuses; damage is no error but [`PrefixReader::defect`].
    pub fn next_item(&mut self) -> Result<Option<PrefixItem>, PrefixError> {
        while !self.ended && self.defect.is_none() {
            let left = self.size - self.verified;
            if left == 0 {
                return Ok(None);
            }
            if left < FRAME {
                self.end_with("ends within a record's frame");
                return Ok(None);
            }
            let mut frame = [0; FRAME as usize];
            self.fill(&mut frame)?;
            let RecordFrame { code, length } = RecordFrame::read(&frame);
            if length > left - FRAME || length > LARGEST_RECORD {
                self.end_with(format!("ends within a record of kind {code:#04x} and {length} bytes"));
                return Ok(None);
            }
            let mut body = vec![0; length as usize];
            self.fill(&mut body)?;
            match whole(code, body.into()) {
                Ok(found) => {
                    self.item = self.verified;
                    self.verified += FRAME + length;
                    match found {
                        RecordOutcome::Item(item) => return Ok(Some(item)),
                        RecordOutcome::End => self.ended = true,
                        RecordOutcome::Nothing => {}
                    }
                }
                Err(reason) => self.end_with(format!("has a damaged record of kind {code:#04x}: {reason}")),
            }
        }
        Ok(None)
    }

    fn end_with(&mut self, what: impl AsRef<str>) {
        self.defect = Some(format!("it {} at byte {}", what.as_ref(), self.verified));
    }

    fn fill(&mut self, buffer: &mut [u8]) -> Result<(), PrefixError> {
        self.file.read_exact(buffer).map_err(|source| PrefixError::Read { path: self.path.clone(), source })
    }
}

/// The meaning of a record for the reader.
enum RecordOutcome {
    Item(PrefixItem),
    End,
    Nothing,
}

// Proves a record, or says what speaks against it.
fn whole(code: u8, body: Bytes) -> Result<RecordOutcome, String> {
    match parse_record(code, &body).map_err(|e| describe(&e))? {
        Record::Chunk { header, .. } if header.uncompressed_crc == 0 => Err("a chunk without a CRC".into()),
        Record::Chunk { .. } => chunk_records(&body).map(|records| RecordOutcome::Item(PrefixItem::Chunk(records))),
        Record::Attachment { header, data, .. } => Ok(RecordOutcome::Item(PrefixItem::Attachment(Attachment {
            log_time: header.log_time,
            create_time: header.create_time,
            name: header.name,
            media_type: header.media_type,
            data: data.into_owned().into(),
        }))),
        Record::Metadata(metadata) => Ok(RecordOutcome::Item(PrefixItem::Metadata(metadata))),
        Record::DataEnd(_) => Ok(RecordOutcome::End),
        Record::Unknown { opcode, .. } if opcode < 0x80 => Err("there is no such record".into()),
        _ => Ok(RecordOutcome::Nothing),
    }
}

fn chunk_records(body: &Bytes) -> Result<Vec<Record<'static>>, String> {
    let mut cursor = DecodedChunk::decode(body).map_err(|e| e.to_string())?.into_cursor();
    let mut records = Vec::new();
    while let Some(record) = cursor.next_record().map_err(|e| e.to_string())? {
        records.push(record.into_owned());
    }
    Ok(records)
}
