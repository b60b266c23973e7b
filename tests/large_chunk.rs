//! A run file with a chunk that is larger than any that is read: whoever reads it says so in the same words.

use super::{TestFolder, stderr};

/// Bytes of the chunk before compression.
const CHUNK_BYTES: u64 = 300 << 20;
const WORDS: &str = "it claims 314572800 bytes, with those that are stored more than 268435456";

fn record(code: u8, body: &[u8]) -> Vec<u8> {
    [&[code][..], &(body.len() as u64).to_le_bytes(), body].concat()
}

fn text(text: &str) -> Vec<u8> {
    [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
}

// The file with one more chunk behind its data, which its index names; the chunk's times are those of the whole run.
fn with_large_chunk(file: &[u8]) -> Vec<u8> {
    let zeros = vec![0; 1 << 20];
    let mut encoder = zstd::Encoder::new(Vec::new(), 1).expect("an encoder");
    for _ in 0..CHUNK_BYTES >> 20 {
        std::io::Write::write_all(&mut encoder, &zeros).expect("written");
    }
    let packed = encoder.finish().expect("finished");
    let summary = mcap::Summary::read(file).expect("sound").expect("a summary");
    let times = summary.chunk_indexes.iter().map(|c| (c.message_start_time, c.message_end_time));
    let (start, end) = times.fold((u64::MAX, 0), |all, one| (all.0.min(one.0), all.1.max(one.1)));
    let times = [start.to_le_bytes(), end.to_le_bytes()].concat();
    let compressed = packed.len() as u64;
    let head = [&times[..], &CHUNK_BYTES.to_le_bytes(), &[0; 4], &text("zstd"), &compressed.to_le_bytes()].concat();
    let chunk = record(0x06, &[&head[..], &packed].concat());

    let (mut data, mut index) = (file[..8].to_vec(), Vec::new());
    let mut rest = &file[8..file.len() - 8];
    let mut is_data = true;
    while !rest.is_empty() {
        let length = u64::from_le_bytes(rest[1..9].try_into().expect("8 bytes")) as usize;
        let (one, behind) = rest.split_at(9 + length);
        rest = behind;
        is_data &= one[0] != 0x0F;
        match one[0] {
            _ if is_data => data.extend_from_slice(one),
            0x0B => {
                // Statistics count the chunks.
                let mut body = one[9..].to_vec();
                body[22..26].copy_from_slice(&(summary.chunk_indexes.len() as u32 + 1).to_le_bytes());
                index.extend(record(0x0B, &body));
            }
            // The data's end and the footer are written anew; offsets within the summary may be left out.
            0x02 | 0x0E | 0x0F => {}
            _ => index.extend_from_slice(one),
        }
    }
    let place = [(data.len() as u64).to_le_bytes(), (chunk.len() as u64).to_le_bytes()].concat();
    let sizes = [compressed.to_le_bytes(), CHUNK_BYTES.to_le_bytes()].concat();
    // It has messages of every topic, as the index tells it.
    let channels: Vec<_> = summary.channels.keys().flat_map(|id| [&id.to_le_bytes()[..], &[0; 8]].concat()).collect();
    let channels = [&(channels.len() as u32).to_le_bytes()[..], &channels].concat();
    index.extend(record(0x08, &[&times[..], &place, &channels, &[0; 8], &text("zstd"), &sizes].concat()));
    data.extend(chunk);
    data.extend(record(0x0F, &[0; 4]));
    let summary_start = (data.len() as u64).to_le_bytes();
    let footer = record(0x02, &[&summary_start[..], &[0; 12]].concat());
    [data, index, footer, file[..8].to_vec()].concat()
}

#[test]
fn all_readers_refuse_a_chunk_of_300_mib_in_the_same_words() {
    let place = TestFolder::new();
    let path = place.acquire("flat", &["--seed", "1"]);
    let file = std::fs::read(&path).expect("the run");
    std::fs::write(&path, with_large_chunk(&file)).expect("written");

    let ingest = place.run(&["ingest"]);
    let told = format!("{}{}", String::from_utf8_lossy(&ingest.stdout), stderr(&ingest));
    assert_eq!(ingest.status.code(), Some(3), "{told}");
    assert!(told.contains(WORDS), "{told}");
    assert_eq!(place.number("select count(*) from measurements"), 45.0, "what is whole is taken in");
    let run = place.sql("select run_id from runs")[0]["run_id"].as_str().expect("a name").to_owned();

    place.fails(1, &["sql", &format!("select count(*) from mcap_messages('{run}')")], WORDS);
    place.fails(1, &["export", "mcap", "--where", "pair_id >= 0", "-o", "slice.mcap"], WORDS);
    assert!(!place.path("slice.mcap").exists());
    let doctor = place.run(&["doctor"]);
    let found = String::from_utf8_lossy(&doctor.stdout);
    assert!(doctor.status.code() == Some(3) && found.contains(WORDS), "{found}");
}
