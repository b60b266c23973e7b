//! Damaged run files, each the same for its seed: every read ends in messages that were written or in a loss that it
//! names, and no chunk is lost that no flipped bit touches.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Cursor;
use std::ops::Range;

use echolake_recording::{
    DecodedChunk, MessageHeader, Record, RecordSplitter, RecordingItem, RecordingReader, RunSummary, opcode,
    prove_file, summary_range, tail_range,
};
use mcap::{Attachment, Compression, WriteOptions};
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

/// Messages: sequence and content.
type Messages = BTreeSet<(u32, Vec<u8>)>;

fn write_file() -> Vec<u8> {
    let options = WriteOptions::new().compression(Some(Compression::Zstd)).chunk_size(Some(500));
    let mut writer = options.create(Cursor::new(Vec::new())).expect("a writer");
    let channel_id = writer.add_channel(0, "/a", "json", &BTreeMap::new()).expect("added");
    let [name, media_type] = ["a", "b"].map(str::to_owned);
    let attachment = Attachment { log_time: 1, create_time: 1, name, media_type, data: b"hello".into() };
    writer.attach(&attachment).expect("written");
    for sequence in 0..40 {
        let header = MessageHeader { channel_id, sequence, log_time: 7, publish_time: 8 };
        let data = format!("message {sequence} {}", "x".repeat(sequence as usize));
        writer.write_to_known_channel(&header, data.as_bytes()).expect("written");
    }
    writer.finish().expect("finished");
    writer.into_inner().into_inner()
}

fn cut_bytes(bytes: &mut Vec<u8>, random: &mut ChaCha8Rng) {
    let [one, other] = [(); 2].map(|()| random.random_range(0..bytes.len()));
    let range = one.min(other)..one.max(other);
    match random.random_range(0..4) {
        0 => bytes.truncate(one),
        1 => drop(bytes.drain(range)),
        2 => drop(bytes.splice(one..one, bytes[range].to_vec())),
        _ => bytes[range].fill(0),
    }
}

fn message_of(record: Record<'_>) -> Option<(u32, Vec<u8>)> {
    let Record::Message { header, data } = record else { return None };
    Some((header.sequence, data.into_owned()))
}

/// Reads past damage: messages by the range of their chunk, and what was lost, in words.
fn read_whole(path: &std::path::Path) -> (Vec<(Range<u64>, Messages)>, Vec<String>) {
    let mut reader = match RecordingReader::open(path) {
        Ok(reader) => reader,
        Err(error) => return (Vec::new(), vec![error.to_string()]),
    };
    let mut chunks = Vec::new();
    while let Some(item) = reader.next_item().expect("the disk reads") {
        let RecordingItem::Chunk(chunk) = item else { continue };
        let messages = chunk.records.into_iter().filter_map(message_of).collect();
        chunks.push((chunk.offset..chunk.offset + chunk.length, messages));
    }
    let found = reader.finish().expect("the disk reads");
    let is_within = |range: &Range<u64>| range.start < range.end && range.end <= found.bytes;
    assert!(found.lost.is_sorted_by(|a, b| a.end < b.start) && found.lost.iter().all(is_within), "{:?}", found.lost);
    (chunks, found.damage.into_iter().chain((!found.closed).then(|| "it is not closed".to_owned())).collect())
}

/// Reads up to the first damage.
fn read_strictly(bytes: &[u8]) -> Messages {
    let mut splitter = RecordSplitter::new(8);
    splitter.push_bytes(bytes.get(8..).unwrap_or_default());
    let mut messages = BTreeSet::new();
    while let Ok(Ok(record)) = splitter.next_record() {
        if let (opcode::CHUNK, Ok(chunk)) = (record.code, DecodedChunk::decode(&record.body)) {
            let mut records = chunk.into_cursor();
            while let Ok(Some(record)) = records.next_record() {
                messages.extend(message_of(record));
            }
        }
    }
    messages
}

#[test]
fn damage_costs_what_it_touches_and_invents_nothing() {
    let (file, folder, mut partly) = (write_file(), tempfile::tempdir().expect("a folder"), 0);
    let path = folder.path().join("run.mcap");
    std::fs::write(&path, &file).expect("written");
    let (chunks, losses) = read_whole(&path);
    let written = read_strictly(&file);
    assert!(chunks.len() > 4 && written.len() == 40 && losses.is_empty() && prove_file(&path).is_ok(), "{losses:?}");
    for round in 0..3_000 {
        let mut random = ChaCha8Rng::seed_from_u64(round);
        let mut bytes = file.clone();
        let flipped: Vec<_> = (0..random.random_range(1..=4)).map(|_| random.random_range(0..bytes.len())).collect();
        flipped.iter().for_each(|place| bytes[*place] ^= 1 << random.random_range(0..8));
        let is_cut = random.random();
        if is_cut {
            cut_bytes(&mut bytes, &mut random);
        }
        std::fs::write(&path, &bytes).expect("written");
        let (found, losses) = read_whole(&path);
        let read: Messages = found.into_iter().flat_map(|(_, messages)| messages).collect();
        // A chunk's CRC of 0 stands for none: whoever turns exactly these bits may say anything.
        assert!(read.is_subset(&written) && read_strictly(&bytes).is_subset(&written), "round {round}");
        let is_named = !losses.is_empty() && prove_file(&path).is_err();
        assert!(read == written || is_named, "round {round}: a silent loss: {losses:?}");
        for (range, messages) in chunks.iter().filter(|_| !is_cut) {
            let is_touched = flipped.iter().any(|place| range.contains(&(*place as u64)));
            assert!(is_touched || messages.is_subset(&read), "round {round}: {range:?} is lost; {losses:?}");
        }
        partly += u64::from(!read.is_empty() && read != written);
        let tail = &bytes[tail_range(bytes.len() as u64).start as usize..];
        let summary =
            summary_range(tail, bytes.len() as u64).map(|range| RunSummary::parse(&bytes[range.start as usize..]));
        let _ = summary.and_then(|summary| summary.ok()?.describe_unaccounted());
    }
    assert!(partly > 300, "only {partly} files were read in part");
}
