//! Mutated run files, each the same for its seed: no reader panics, and none gives a message that was not written.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Cursor;
use std::ops::Range;

use bytes::Bytes;
use echolake_recording::{
    DecodedChunk, MessageHeader, Record, RecordSplitter, RecordingItem, RecordingReader, RunSummary, opcode,
    summary_range, tail_range,
};
use mcap::{Attachment, Compression, WriteOptions};
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

const ROUNDS: u64 = 3_000;

/// A message that was written: sequence and content.
type WrittenMessage = (u32, Vec<u8>);

fn written() -> (Vec<u8>, BTreeSet<WrittenMessage>) {
    let mut file = Cursor::new(Vec::new());
    let mut messages = BTreeSet::new();
    let options = WriteOptions::new().compression(Some(Compression::Zstd)).chunk_size(None);
    let mut writer = options.create(&mut file).expect("a writer");
    let schema = writer.add_schema("a.B", "protobuf", b"definition").expect("added");
    let channel = writer.add_channel(schema, "/a", "protobuf", &BTreeMap::new()).expect("added");
    let attachment =
        Attachment { log_time: 1, create_time: 1, name: "a".into(), media_type: "b".into(), data: b"hello".into() };
    writer.attach(&attachment).expect("written");
    for sequence in 0..40 {
        let data = format!("message {sequence} {}", "x".repeat(sequence as usize)).into_bytes();
        let header = MessageHeader { channel_id: channel, sequence, log_time: 7, publish_time: 8 };
        writer.write_to_known_channel(&header, &data).expect("written");
        messages.insert((sequence, data));
        if sequence % 10 == 9 {
            writer.flush().expect("a chunk");
        }
    }
    writer.finish().expect("finished");
    drop(writer);
    (file.into_inner(), messages)
}

fn mutated(file: &[u8], random: &mut ChaCha8Rng) -> Vec<u8> {
    let mut bytes = file.to_vec();
    for _ in 0..random.random_range(1..=4) {
        let place = |random: &mut ChaCha8Rng, size: usize| random.random_range(0..size.max(1));
        let (one, other) = (place(random, bytes.len()), place(random, bytes.len()));
        let range: Range<usize> = one.min(other)..one.max(other);
        match random.random_range(0..10) {
            0 => bytes.truncate(one),
            1 => drop(bytes.drain(range)),
            2 => {
                let copy = bytes[range].to_vec();
                bytes.splice(one..one, copy);
            }
            _ => {
                if let Some(byte) = bytes.get_mut(one) {
                    *byte ^= 1 << random.random_range(0..8);
                }
            }
        }
    }
    bytes
}

fn read_whole(path: &std::path::Path) -> (Vec<WrittenMessage>, bool) {
    let Ok(mut reader) = RecordingReader::open(path) else { return (Vec::new(), true) };
    let mut messages = Vec::new();
    while let Some(item) = reader.next_item().expect("the disk reads") {
        let RecordingItem::Chunk(chunk) = item else { continue };
        messages.extend(chunk.records.into_iter().filter_map(|record| match record {
            Record::Message { header, data } => Some((header.sequence, data.into_owned())),
            _ => None,
        }));
    }
    let found = reader.finish().expect("the disk reads");
    assert!(found.lost.is_sorted_by(|a, b| a.end < b.start), "{:?}", found.lost);
    assert!(found.lost.iter().all(|range| range.start < range.end && range.end <= found.bytes), "{:?}", found.lost);
    (messages, !found.is_data_whole)
}

fn read_strictly(bytes: &[u8]) -> Vec<WrittenMessage> {
    let mut splitter = RecordSplitter::new(8);
    splitter.push(bytes.get(8..).unwrap_or_default());
    let mut messages = Vec::new();
    while let Ok(Ok(record)) = splitter.next_record() {
        if record.code != opcode::CHUNK {
            continue;
        }
        let Ok(chunk) = DecodedChunk::decode(&record.body) else { break };
        let mut records = chunk.into_cursor();
        while let Ok(Some(record)) = records.next_record() {
            if let Record::Message { header, data } = record {
                messages.push((header.sequence, data.into_owned()));
            }
        }
    }
    messages
}

#[test]
fn no_reader_gives_what_was_not_written() {
    let (file, expected) = written();
    assert_eq!(read_strictly(&file).len(), expected.len());
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let mut partly = 0;
    for round in 0..ROUNDS {
        let mut random = ChaCha8Rng::seed_from_u64(round);
        let bytes = mutated(&file, &mut random);
        std::fs::write(&path, &bytes).expect("written");
        let (whole, is_told) = read_whole(&path);
        let is_cut = bytes.len() < file.len();
        assert!(whole.len() >= expected.len() || is_told || is_cut, "round {round}: a silent loss");
        partly += usize::from(!whole.is_empty() && whole.len() < expected.len());
        for message in whole.iter().chain(&read_strictly(&bytes)) {
            // A chunk's CRC of 0 stands for none: whoever turns exactly these bits may say anything.
            assert!(expected.contains(message), "round {round}: {message:?}");
        }
        let size = bytes.len() as u64;
        let tail = &bytes[tail_range(size).start as usize..];
        if let Some(range) = summary_range(tail, size)
            && let Ok(summary) = RunSummary::parse(&bytes[range.start as usize..])
        {
            let _ = (summary.unaccounted(), summary.unlisted_ranges(range.start));
        }
        let cut = random.random_range(0..=bytes.len());
        let _ = DecodedChunk::decode(&Bytes::copy_from_slice(&bytes[cut..]));
    }
    assert!(partly > 100, "only {partly} files were read in part");
}
