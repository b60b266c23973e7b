//! A proof that a file is whole, by the MCAP library's own reader.

use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use mcap::records::Record;
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};

use crate::limits::LARGEST_RECORD;

/// Bytes that are read at a time.
const BLOCK_BYTES: usize = 1 << 20;

/// Proves that a file is closed and that all of its checksums are right: chunks, attachments, data and summary.
///
/// # Errors
/// What is wrong with it, in words.
pub fn prove_file(path: &Path) -> Result<(), String> {
    let mut file = File::open(path).map_err(|e| e.to_string())?;
    let options = LinearReaderOptions::default()
        .with_prevalidate_chunk_crcs(true)
        .with_validate_data_section_crc(true)
        .with_validate_summary_section_crc(true)
        .with_check_finishes_after_end_magic(true)
        .with_record_length_limit(LARGEST_RECORD as usize);
    let mut reader = LinearReader::new_with_options(options);
    let mut has_summary = false;
    while let Some(event) = reader.next_event() {
        match event.map_err(|e| e.to_string())? {
            LinearReadEvent::ReadRequest(wanted) => {
                let buffer = reader.insert(wanted.max(BLOCK_BYTES));
                let read = file.read(buffer).map_err(|e| e.to_string())?;
                reader.notify_read(read);
            }
            LinearReadEvent::Record { data, opcode } => {
                // Attachments' sums are compared where they are parsed.
                let record = crate::chunk::parse_record(opcode, data).map_err(|e| e.to_string())?;
                has_summary |= matches!(record, Record::Statistics(_));
            }
        }
    }
    if has_summary { Ok(()) } else { Err("it has no summary".to_owned()) }
}
