//! The verified prefix of a run's file: record after record from its first byte, up to the first that cannot be
//! proven whole.

use std::fs::File;
use std::io::{BufReader, Read as _};
use std::path::{Path, PathBuf};

use mcap::records::{Metadata, Record};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{Attachment, MAGIC, parse_record};

use super::Error;

/// Opcode and length in front of every record.
const FRAME: u64 = 9;
/// Opcode of chunks.
const CHUNK: u8 = 0x06;
/// Largest record that is read; the recorder's are a few MiB, or one message.
pub(super) const LARGEST: u64 = 1 << 30;

/// Something that is whole.
pub(crate) enum Item {
    /// The records of a chunk whose CRC is right.
    Chunk(Vec<Record<'static>>),
    /// An attachment whose CRC is right.
    Attachment(Attachment<'static>),
    /// A metadata record.
    Metadata(Metadata),
}

/// A walk over one file.
pub(crate) struct Walk {
    file: BufReader<File>,
    path: PathBuf,
    /// Its size when the walk began, bytes.
    pub(crate) size: u64,
    /// Where the verified prefix ends.
    pub(crate) verified: u64,
    /// Where the last item begins.
    pub(crate) item: u64,
    /// The data are over, as in a file that was closed.
    pub(crate) ended: bool,
    /// What stands behind the verified prefix, in words; nothing where it is the whole file.
    pub(crate) defect: Option<String>,
}

impl Walk {
    /// Opens a file.
    ///
    /// # Errors
    /// [`Error::Read`], or [`Error::Headless`] where it does not begin as an MCAP file.
    pub(crate) fn open(path: &Path) -> Result<Self, Error> {
        let failed = |source| Error::Read { path: path.to_owned(), source };
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
            return Err(walk.headless(format!("it is no MCAP file, or only {size} bytes of one")));
        }
        walk.verified = magic.len() as u64;
        Ok(walk)
    }

    /// The next whole thing; None behind the verified prefix.
    ///
    /// # Errors
    /// [`Error::Read`] where the system refuses; damage is no error but [`Walk::defect`].
    pub(crate) fn next(&mut self) -> Result<Option<Item>, Error> {
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
            let code = frame[0];
            let length = u64::from_le_bytes(frame[1..].try_into().unwrap_or_default());
            if length > left - FRAME || length > LARGEST {
                self.end_with(format!("ends within a record of kind {code:#04x} and {length} bytes"));
                return Ok(None);
            }
            let mut body = vec![0; length as usize];
            self.fill(&mut body)?;
            match whole(code, &body) {
                Ok(found) => {
                    self.item = self.verified;
                    self.verified += FRAME + length;
                    match found {
                        Found::Item(item) => return Ok(Some(item)),
                        Found::End => self.ended = true,
                        Found::Nothing => {}
                    }
                }
                Err(reason) => self.end_with(format!("has a damaged record of kind {code:#04x}: {reason}")),
            }
        }
        Ok(None)
    }

    /// That there is no run in the file.
    pub(crate) fn headless(&self, reason: impl Into<String>) -> Error {
        Error::Headless { path: self.path.clone(), reason: reason.into() }
    }

    fn end_with(&mut self, what: impl AsRef<str>) {
        self.defect = Some(format!("it {} at byte {}", what.as_ref(), self.verified));
    }

    fn fill(&mut self, buffer: &mut [u8]) -> Result<(), Error> {
        self.file.read_exact(buffer).map_err(|source| Error::Read { path: self.path.clone(), source })
    }
}

/// What a record was.
enum Found {
    Item(Item),
    End,
    Nothing,
}

// In words where it cannot be proven whole.
fn whole(code: u8, body: &[u8]) -> Result<Found, String> {
    let failed = |e: mcap::McapError| e.to_string();
    match parse_record(code, body).map_err(failed)? {
        Record::Chunk { header, .. } if header.uncompressed_crc == 0 => Err("a chunk without a CRC".into()),
        Record::Chunk { header, .. } if header.uncompressed_size > LARGEST => {
            Err(format!("a chunk of {} bytes", header.uncompressed_size))
        }
        Record::Chunk { .. } => chunk(body).map(|records| Found::Item(Item::Chunk(records))),
        Record::Attachment { header, data, .. } => Ok(Found::Item(Item::Attachment(Attachment {
            log_time: header.log_time,
            create_time: header.create_time,
            name: header.name,
            media_type: header.media_type,
            data: data.into_owned().into(),
        }))),
        Record::Metadata(metadata) => Ok(Found::Item(Item::Metadata(metadata))),
        Record::DataEnd(_) => Ok(Found::End),
        Record::Unknown { opcode, .. } if opcode < 0x80 => Err("there is no such record".into()),
        _ => Ok(Found::Nothing),
    }
}

/// A chunk's records, once its CRC is known to be right: what is damaged must not say how much memory is asked for.
pub(crate) fn chunk(body: &[u8]) -> Result<Vec<Record<'static>>, String> {
    let failed = |e: mcap::McapError| e.to_string();
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_prevalidate_chunk_crcs(true)
        .with_record_length_limit(LARGEST as usize);
    let mut reader = LinearReader::new_with_options(options);
    let frame: Vec<u8> = [CHUNK].into_iter().chain((body.len() as u64).to_le_bytes()).collect();
    let (whole, mut at, mut records) = ([&frame[..], body].concat(), 0, Vec::new());
    while let Some(event) = reader.next_event() {
        match event.map_err(failed)? {
            LinearReadEvent::ReadRequest(wanted) => {
                let some = &whole[at..(at + wanted).min(whole.len())];
                reader.insert(some.len()).copy_from_slice(some);
                reader.notify_read(some.len());
                at += some.len();
            }
            LinearReadEvent::Record { data, opcode } => {
                records.push(parse_record(opcode, data).map_err(failed)?.into_owned());
            }
        }
    }
    Ok(records)
}
