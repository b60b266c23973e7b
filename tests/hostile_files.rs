//! Hostile and mutated run files in the inbox of `ingest --watch`: all else is taken in, in bounded memory, and no file
//! keeps the next start from its work.

use std::fs::{self, File};
use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use echolake_schema::messages::{ImpulseResponse, Measurement, Message as _};
use echolake_schema::topics;
use echolake_testing::{ChildProcess, SMALL_RIG, run_command};
use prost::Message as _;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::kills::copy_folder;

/// Surfaces whose runs must be taken in.
const GOOD_SURFACES: [&str; 4] = ["flat", "foam", "wood", "brick"];
/// Pairs of the rig.
const PAIRS: usize = 45;
/// Time between two looks at the process and its inbox.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// Starts of `ingest` in one round after which it is given up.
const MOST_STARTS: usize = 20;
const FRAME: usize = 9;
/// A footer and the magic bytes.
const FILE_END_BYTES: u64 = 37;
const FOOTER_FRAME: [u8; FRAME] = [0x02, 20, 0, 0, 0, 0, 0, 0, 0];
pub(crate) const MIB: u64 = 1 << 20;

/// Sizes of the generated files, in bytes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct HostileSizes {
    /// Files of records that only seem to be some.
    pub false_records: usize,
    /// Decompressed size of a chunk that is just small enough to be read.
    pub bomb: u64,
    /// Sparse records that are too large.
    pub sparse: u64,
}

/// Counts of a round.
#[derive(Debug, Default)]
pub(crate) struct HostileOutcome {
    /// Files in the inbox.
    pub files: usize,
    /// Good runs of which everything is in the tables.
    pub good: usize,
    /// Good runs.
    pub good_expected: usize,
    /// Files that were put aside.
    pub quarantined: usize,
    /// Exits of processes that were started again.
    pub deaths: Vec<String>,
    /// The most memory that a process had at a time.
    pub peak_mib: u64,
    pub elapsed: Duration,
}

/// A campaign in a folder of its own.
pub(crate) struct HostileCampaign {
    folder: tempfile::TempDir,
    binary: PathBuf,
    seed: u64,
    /// Names of the good runs.
    good: Vec<String>,
    template: TemplateRun,
}

/// The run of which the hostile ones are made.
struct TemplateRun {
    bytes: Vec<u8>,
    run: String,
    /// All records, frames included.
    records: Vec<Range<usize>>,
    /// End of the first chunk: the run's description and its channels are before it.
    described: usize,
    log: u16,
    ir: u16,
    verdict: u16,
}

/// A file's bytes, of which zeros between the two parts are not stored.
struct HostileFile {
    name: String,
    bytes: Vec<u8>,
    size: u64,
    /// The last bytes of `size`.
    end: Vec<u8>,
}

impl HostileCampaign {
    /// Measures the good runs and the template.
    pub fn new(binary: &Path, seed: u64) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        fs::write(folder.path().join("rig.toml"), SMALL_RIG).expect("written");
        let acquire = |lake: &str, surface: &str| {
            let mut command = command(binary, folder.path(), lake);
            command.args(["acquire", "--surface", surface, "--rig", "rig.toml", "--ir-only"]);
            let output = run_command(command.args(["--checkpoint-every", "5"])).expect("the command starts");
            assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
            PathBuf::from(String::from_utf8(output.stdout).expect("text").trim())
        };
        let stem = |path: &Path| path.file_stem().expect("a name").to_string_lossy().into_owned();
        let good = GOOD_SURFACES.iter().map(|surface| stem(&acquire("start", surface))).collect();
        let template = acquire("template", "prd");
        let bytes = fs::read(folder.path().join(&template)).expect("the run");
        let template = TemplateRun::new(bytes, stem(&template));
        Self { folder, binary: binary.to_owned(), seed, good, template }
    }

    /// Puts good, crafted and mutated files into an inbox and has them taken in.
    ///
    /// # Panics
    /// It takes longer than `limit`, or `ingest` ends again and again.
    pub fn round(&self, crafted: Option<HostileSizes>, mutants: Range<u64>, limit: Duration) -> HostileOutcome {
        let lake = self.folder.path().join("round");
        // The first round finds none.
        let _ = fs::remove_dir_all(&lake);
        copy_folder(&self.folder.path().join("start"), &lake);
        let inbox = lake.join("inbox");
        let crafted = crafted.map(|sizes| self.template.crafted(sizes)).unwrap_or_default();
        let bomb = chunk(64 * MIB, &zeros(64 * MIB));
        let mutated = mutants.map(|number| self.template.mutant(self.seed, number, &bomb));
        for file in crafted.into_iter().chain(mutated) {
            file.write(&inbox).expect("written");
        }
        let mut outcome = HostileOutcome {
            files: run_files(&inbox).len(),
            good_expected: self.good.len(),
            ..HostileOutcome::default()
        };
        let begun = Instant::now();
        while waiting_files(&inbox) > 0 {
            assert!(outcome.deaths.len() < MOST_STARTS, "it ends again and again: {:?}", outcome.deaths);
            self.watch(&inbox, begun + limit, &mut outcome);
        }
        outcome.elapsed = begun.elapsed();
        outcome.quarantined = run_files(&lake.join("quarantine")).len();
        outcome.good = self.good.iter().filter(|run| self.is_taken_in(run)).count();
        outcome
    }

    // Until nothing but files without an end are in the inbox, or the process has ended.
    fn watch(&self, inbox: &Path, end: Instant, outcome: &mut HostileOutcome) {
        let mut command = command(&self.binary, self.folder.path(), "round");
        let mut watch = ChildProcess::start_group(command.args(["ingest", "--watch"])).expect("the command starts");
        while waiting_files(inbox) > 0 {
            let left = waiting_files(inbox);
            assert!(Instant::now() < end, "{left} files are left in the inbox:\n{}", watch.stderr());
            outcome.peak_mib = outcome.peak_mib.max(peak_mib(watch.id()).unwrap_or(0));
            if watch.ends_within(LOOK_EVERY) {
                let output = watch.wait();
                let said = String::from_utf8_lossy(&output.stderr).into_owned();
                outcome.deaths.push(format!("{}: {}", output.status, said.lines().last().unwrap_or_default()));
                return;
            }
        }
        outcome.peak_mib = outcome.peak_mib.max(peak_mib(watch.id()).unwrap_or(0));
        watch.signal("TERM");
        watch.wait();
    }

    fn is_taken_in(&self, run: &str) -> bool {
        let query = format!("select count(*) n from measurements where run_id = '{run}'");
        let mut command = command(&self.binary, self.folder.path(), "round");
        let output = run_command(command.args(["sql", "--format", "csv", &query])).expect("the command starts");
        String::from_utf8_lossy(&output.stdout).trim().ends_with(&format!("\n{PAIRS}"))
    }
}

impl TemplateRun {
    fn new(bytes: Vec<u8>, run: String) -> Self {
        let (mut at, mut records) = (8, Vec::new());
        while at < bytes.len() - 8 {
            let length = u64::from_le_bytes(bytes[at + 1..at + FRAME].try_into().expect("a length"));
            let range = at..at + FRAME + length as usize;
            at = range.end;
            records.push(range);
        }
        let described = records.iter().find(|r| bytes[r.start] == 0x06).expect("a chunk").end;
        let summary = mcap::Summary::read(&bytes).expect("sound").expect("a summary");
        let channel = |topic: &str| summary.channels.values().find(|c| c.topic == topic).expect("a channel").id;
        let (log, ir, verdict) = (channel(topics::LOG), channel(topics::IR), channel(topics::MEASUREMENT));
        Self { bytes, run, records, described, log, ir, verdict }
    }

    // A file whose run has a name of its own, with these bytes behind its description.
    fn with(&self, number: u64, hostile: &[u8]) -> HostileFile {
        let bytes = [&self.bytes[..self.described], hostile, &self.bytes[self.described..]].concat();
        self.renamed(number, bytes)
    }

    // The same; the last record of `hostile` is nothing but zeros from there on, and a file's end is behind it.
    fn sparse(&self, number: u64, hostile: &[u8], zeros: u64) -> HostileFile {
        let mut file = self.renamed(number, [&self.bytes[..self.described], hostile].concat());
        file.end = self.end().to_vec();
        file.size += zeros + FILE_END_BYTES;
        file
    }

    fn end(&self) -> &[u8] {
        &self.bytes[self.bytes.len() - FILE_END_BYTES as usize..]
    }

    // Names end in four hexadecimal digits.
    fn renamed(&self, number: u64, mut bytes: Vec<u8>) -> HostileFile {
        let name = format!("{}{number:04x}", &self.run[..self.run.len() - 4]);
        let places: Vec<_> = (0..bytes.len()).filter(|at| bytes[*at..].starts_with(self.run.as_bytes())).collect();
        places.iter().for_each(|at| bytes[*at..*at + name.len()].copy_from_slice(name.as_bytes()));
        HostileFile { name: format!("{name}.mcap"), size: bytes.len() as u64, bytes, end: Vec::new() }
    }

    fn crafted(&self, sizes: HostileSizes) -> Vec<HostileFile> {
        let HostileSizes { false_records, bomb, sparse } = sizes;
        let zero_bomb = |size: u64| chunk(size, &zeros(size)).repeat(8);
        let message_bomb = |channel: u16, data: &[u8]| {
            let message = message(channel, data);
            let count = bomb / message.len() as u64;
            // Eight that are no copies of each other.
            let one = |count: u64| {
                let packed = zstd(std::iter::repeat_n(message.as_slice(), count as usize));
                chunk(count * message.len() as u64, &packed)
            };
            (0..8).flat_map(|left| one(count - left)).collect::<Vec<_>>()
        };
        let ir = ImpulseResponse { sample_rate_hz: 96e3, temperature_c: 20.0, ..ImpulseResponse::default() };
        let verdict = Measurement { reasons: vec![String::new(); 200], ..Measurement::default() };
        assert_eq!(ImpulseResponse::FULL_NAME, "echolake.v1.ImpulseResponse");
        let attachment = |name: &str, size: u64| {
            let body = [&[0; 16][..], &text(name), &text(""), &size.to_le_bytes()].concat();
            frame(0x09, body.len() as u64 + size + 4, &body)
        };
        let long = |code: u8, body: &[u8], size: u64| frame(code, body.len() as u64 + size, body);
        let large_text = (sparse.min(u64::from(u32::MAX)) as u32).to_le_bytes();
        let large_text_size = u64::from(u32::from_le_bytes(large_text));
        let stored = |size: u64| {
            let body = [&[0; 16][..], &size.to_le_bytes(), &[0; 4], &text(""), &size.to_le_bytes()].concat();
            long(0x06, &body, size)
        };
        let false_record = [&[0x06][..], &30u64.to_le_bytes(), &[1; 3]].concat();
        let false_records = |record: &[u8]| record.repeat(false_records / record.len());
        // Each of these ends at the same offset, where there is no record.
        let nested = |code: u8, head: usize| {
            let count = sizes.false_records / (FRAME + head + 4);
            let one = |number: usize| {
                let left = (count - number) * (FRAME + head + 4) - FRAME;
                let mut body = vec![0; head];
                body.extend(((left - head - 4) as u32).to_le_bytes());
                frame(code, left as u64, &body)
            };
            let mut records: Vec<u8> = (0..count).flat_map(one).collect();
            records.extend([0xFF; 40]);
            records
        };
        let statistics = [&[0; 42][..], &[0; 4]].concat();
        let alternating = [frame(0x0B, 46, &statistics), false_record.clone()].concat();
        let tiny_chunks = |count: usize| {
            let one = |number: usize| {
                let records = frame(0x80, 8, &(number as u64).to_le_bytes());
                let (size, body) = (records.len() as u64, [0; 16]);
                let body = [&body[..], &size.to_le_bytes(), &[0; 4], &text(""), &size.to_le_bytes(), &records].concat();
                frame(0x06, body.len() as u64, &body)
            };
            (0..count).flat_map(one).collect::<Vec<_>>()
        };
        let mut files = vec![
            self.with(1, &zero_bomb(1 << 30)),
            self.with(2, &zero_bomb(bomb)),
            self.with(3, &message_bomb(self.log, &[])),
            self.with(4, &message_bomb(self.ir, &ir.encode_to_vec())),
            self.with(5, &message_bomb(self.verdict, &verdict.encode_to_vec())),
            self.sparse(6, &attachment("a", sparse), sparse + 4),
            self.sparse(
                7,
                &long(0x03, &[&[0; 2][..], &text("a"), &text("b"), &large_text].concat(), large_text_size),
                large_text_size,
            ),
            self.sparse(8, &stored(sparse), sparse),
            self.sparse(9, &long(0x0C, &[&text("a")[..], &large_text].concat(), large_text_size), large_text_size),
            self.sparse(10, &attachment("heights.f32", bomb), bomb + 4),
            self.sparse(11, &attachment("a", bomb), bomb + 4),
            self.sparse(12, &stored(bomb), bomb),
            self.with(13, &false_records(&false_record)),
            self.with(14, &nested(0x0B, 42)),
            self.with(15, &nested(0x0D, 16)),
            self.with(16, &false_records(&alternating)),
            self.with(17, &false_records(&frame(0x80, 0, &[]))),
            self.with(18, &tiny_chunks(sizes.false_records / 70)),
            self.with(19, &[0; 1000]),
        ];
        let other = |name: String, bytes: &[u8]| HostileFile {
            name,
            bytes: bytes.to_vec(),
            size: bytes.len() as u64,
            end: Vec::new(),
        };
        files.push(other("empty.mcap".to_owned(), b""));
        files.push(other("magic.mcap".to_owned(), b"\x89MCAP0\r\n"));
        files.push(other("text.mcap".to_owned(), b"this is no MCAP file"));
        files.push(other(format!("{}.mcap", "n".repeat(240)), b"x"));
        files
    }

    // One of 40,000 mutated files, each the same whatever came before it.
    fn mutant(&self, seed: u64, number: u64, bomb: &[u8]) -> HostileFile {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(number);
        let mut file = self.renamed(0x1000 + number, self.bytes.clone());
        for _ in 0..random.random_range(1..=3) {
            let size = file.bytes.len();
            let mut record = || self.records[random.random_range(0..self.records.len())].clone();
            let (one, other) = (record(), record());
            let fits = one.end <= size && other.end <= size;
            match random.random_range(0..100) {
                0..35 => {
                    for _ in 0..random.random_range(1..=8) {
                        let near = one.start + random.random_range(0..64);
                        let at = if random.random() { near } else { random.random_range(0..size.max(1)) };
                        file.bytes.get_mut(at).map(|byte| *byte ^= 1 << random.random_range(0..8)).unwrap_or_default();
                    }
                }
                35..45 => file.bytes.truncate(random.random_range(0..=size)),
                45..70 if fits => {
                    let length =
                        u64::from_le_bytes(file.bytes[one.start + 1..one.start + FRAME].try_into().expect("8"));
                    let changes =
                        [0, length ^ 1, length + 12, length / 2, size as u64, 1 << 40, u64::MAX, random.random()];
                    let changed = changes[random.random_range(0..changes.len())];
                    file.bytes[one.start + 1..one.start + FRAME].copy_from_slice(&changed.to_le_bytes());
                }
                70..85 if fits => {
                    let (one, other) = if one.start < other.start { (one, other) } else { (other, one) };
                    if one.end <= other.start {
                        let parts = [0..one.start, other.clone(), one.end..other.start, one, other.end..size];
                        file.bytes = parts.map(|part| file.bytes[part].to_vec()).concat();
                    }
                }
                85..95 if fits => {
                    let copy = file.bytes[one.clone()].to_vec();
                    file.bytes.splice(other.end..other.end, copy);
                }
                _ if fits => drop(file.bytes.splice(one.end..one.end, bomb.iter().copied())),
                _ => {}
            }
        }
        // A file without an end is not read: half of those that lost theirs have it again.
        if number.is_multiple_of(2) && !has_file_end(&file.bytes) {
            file.bytes.extend(self.end());
        }
        file.size = file.bytes.len() as u64;
        file
    }
}

impl HostileFile {
    fn write(&self, inbox: &Path) -> io::Result<()> {
        let path = inbox.join(&self.name);
        fs::write(&path, &self.bytes)?;
        let file = File::options().write(true).open(path)?;
        file.set_len(self.size)?;
        file.write_all_at(&self.end, self.size - self.end.len() as u64)
    }
}

fn command(binary: &Path, folder: &Path, lake: &str) -> Command {
    let mut command = Command::new(binary);
    command.args(["--lake", lake]).current_dir(folder).env_remove("ECHOLAKE_LAKE");
    command
}

fn run_files(folder: &Path) -> Vec<PathBuf> {
    let Ok(listed) = fs::read_dir(folder) else { return Vec::new() };
    listed.flatten().map(|entry| entry.path()).filter(|path| path.extension().is_some_and(|e| e == "mcap")).collect()
}

fn has_file_end(bytes: &[u8]) -> bool {
    let footer = bytes.len().checked_sub(FILE_END_BYTES as usize);
    footer.is_some_and(|footer| bytes[footer..].starts_with(&FOOTER_FRAME)) && bytes.ends_with(mcap::MAGIC)
}

// Those that do not stay where they are for lack of an end.
fn waiting_files(inbox: &Path) -> usize {
    run_files(inbox).iter().filter(|path| !is_unfinished(path).unwrap_or(true)).count()
}

fn is_unfinished(path: &Path) -> io::Result<bool> {
    let file = File::open(path)?;
    let size = file.metadata()?.len();
    let mut first = vec![0; size.min(mcap::MAGIC.len() as u64) as usize];
    file.read_exact_at(&mut first, 0)?;
    let length = size.min(FILE_END_BYTES);
    let mut tail = vec![0; length as usize];
    file.read_exact_at(&mut tail, size - length)?;
    let is_begun = mcap::MAGIC.starts_with(&first) || first.iter().all(|byte| *byte == 0);
    Ok(is_begun && !has_file_end(&tail))
}

fn peak_mib(pid: u32) -> Option<u64> {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    Some(line.trim().trim_end_matches("kB").trim().parse::<u64>().ok()? / 1024)
}

fn frame(code: u8, length: u64, body: &[u8]) -> Vec<u8> {
    [&[code][..], &length.to_le_bytes(), body].concat()
}

fn text(text: &str) -> Vec<u8> {
    [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
}

fn message(channel: u16, data: &[u8]) -> Vec<u8> {
    let body = [&channel.to_le_bytes()[..], &[0; 20], data].concat();
    frame(0x05, body.len() as u64, &body)
}

// No CRC vouches for it.
fn chunk(claimed: u64, packed: &[u8]) -> Vec<u8> {
    let head = [&[0; 16][..], &claimed.to_le_bytes(), &[0; 4], &text("zstd"), &(packed.len() as u64).to_le_bytes()];
    let body = [&head.concat()[..], packed].concat();
    frame(0x06, body.len() as u64, &body)
}

fn zeros(size: u64) -> Vec<u8> {
    let block = vec![0; MIB as usize];
    zstd(std::iter::repeat_n(block.as_slice(), (size / MIB) as usize))
}

fn zstd<'a>(parts: impl Iterator<Item = &'a [u8]>) -> Vec<u8> {
    let mut encoder = zstd::Encoder::new(Vec::new(), 1).expect("an encoder");
    parts.for_each(|part| io::Write::write_all(&mut encoder, part).expect("written"));
    encoder.finish().expect("finished")
}
