//! What a sweep's samples cost in each encoding, in bytes and in time, side by side in one run; start it with
//! `cargo run --release --manifest-path acquisition/encodings/Cargo.toml [folder of data]`.

use std::error::Error;
use std::hint::black_box;
use std::io::Write as _;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Instant;

use echolake_acquisition::relief::Relief;
use echolake_acquisition::rig::{Power, Take};
use echolake_acquisition::rigs::simulated::{FACETS, Simulation, devices};
use echolake_dsp::sweep::LinearSweep;
use echolake_schema::messages::SampleFormat;
use echolake_schema::samples::{decode, split_24};
use echolake_schema::{Rig, Timestamp};
use flacenc::component::BitRepr as _;
use flacenc::error::Verify as _;
use zstd::stream::raw::Operation as _;

type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// Rounds in which the encodings take turns, so that a slow moment of the machine meets them all.
const ROUNDS: usize = 9;
/// Decoding is quick, and the faster of the two that matter: so often it is timed in each round.
const DECODINGS: usize = 3;
/// Samples of a recording that are stored as one channel: those of a sweep of 0.5 s at 96 kHz.
const CHANNEL: usize = 48_000;
/// Simulated takes: those of a chunk of 4 MiB. A chunk of 1 MiB has three.
const TAKES: usize = 12;
/// Samples of a FLAC frame: of 512 to 4,096, what chunks become smallest with; a sweep's frequency moves.
const FLAC_BLOCK: usize = 1_024;
const FULL_SCALE: f32 = 8_388_608.0;

/// How the samples of a channel become bytes, before zstd.
#[derive(Clone, Copy)]
enum Layout {
    /// Three bytes a sample, little-endian.
    Packed,
    /// The low bytes, then the middle ones, then the high ones.
    Planes,
    /// The low bytes, then the upper two together as 16 bit: what `/sweep/audio` holds too.
    Split,
    /// The planes of the zigzag of the first differences, modulo 2^24.
    DeltaPlanes,
    /// A FLAC stream of its own, with linear prediction of this order.
    Flac(usize),
}

#[derive(Clone, Copy)]
struct Encoding {
    name: &'static str,
    layout: Layout,
    zstd: Option<i32>,
}

const fn encoding(name: &'static str, layout: Layout, zstd: Option<i32>) -> Encoding {
    Encoding { name, layout, zstd }
}

const ENCODINGS: [Encoding; 16] = [
    encoding("raw", Layout::Packed, None),
    encoding("zstd 1", Layout::Packed, Some(1)),
    encoding("zstd 3", Layout::Packed, Some(3)),
    encoding("zstd 9", Layout::Packed, Some(9)),
    encoding("planes, zstd 1", Layout::Planes, Some(1)),
    encoding("planes, zstd 3", Layout::Planes, Some(3)),
    encoding("planes, zstd 9", Layout::Planes, Some(9)),
    encoding("8 + 16 bit", Layout::Split, None),
    encoding("8 + 16 bit, zstd 1", Layout::Split, Some(1)),
    encoding("8 + 16 bit, zstd 3", Layout::Split, Some(3)),
    encoding("8 + 16 bit, zstd 9", Layout::Split, Some(9)),
    encoding("delta planes, zstd 1", Layout::DeltaPlanes, Some(1)),
    encoding("delta planes, zstd 3", Layout::DeltaPlanes, Some(3)),
    encoding("flac order 4", Layout::Flac(4), Some(3)),
    encoding("flac order 8", Layout::Flac(8), Some(3)),
    encoding("flac order 16", Layout::Flac(16), Some(3)),
];

/// Which of them the others' times are told against: the one that is stored.
const CHOSEN: usize = 9;

/// What is compressed in one go: channels of 24-bit samples, and what a chunk holds besides.
struct Block {
    channels: Vec<Vec<i32>>,
    beside: Beside,
}

/// What stands between the channels.
#[derive(Clone, Copy, PartialEq)]
enum Beside {
    Nothing,
    /// Behind each microphone and its loopback, the microphone's upper 16 bits: `/sweep/audio`.
    Audio,
}

struct Input {
    name: &'static str,
    blocks: Vec<Block>,
}

/// The best of all rounds.
#[derive(Clone, Copy)]
struct Measured {
    bytes: usize,
    encode_secs: f64,
    decode_secs: f64,
}

fn main() -> Result<()> {
    let default = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    let folder = std::env::args_os().nth(1).map_or(default, PathBuf::from).join("recordings");
    let mut out = std::io::stdout().lock();
    let mut inputs = simulated()?;
    let [recording, sweep] = ["room_recording.wav", "room_sweep.wav"].map(|name| folder.join(name));
    match recording.exists() && sweep.exists() {
        true => inputs.extend(recorded(&read_24(&recording)?, &read_24(&sweep)?)),
        false => writeln!(out, "`{}` has no recordings: measured with simulated ones alone", folder.display())?,
    }
    let header = "| input | encoding | of raw 24 bit | encode MB/s | decode MB/s | decode, us for 96,000 samples | time of 8 + 16 bit, zstd 3 |";
    writeln!(out, "{header}\n| --- | --- | --- | --- | --- | --- | --- |")?;
    for input in &inputs {
        let measured = measure(input)?;
        let samples: usize = input.blocks.iter().flat_map(|b| &b.channels).map(Vec::len).sum();
        let raw = (3 * samples) as f64;
        let yardstick = measured[CHOSEN].decode_secs;
        for (encoding, m) in ENCODINGS.iter().zip(measured) {
            let [encode, decode] = [m.encode_secs, m.decode_secs].map(|secs| raw / secs / 1e6);
            let sweep_us = m.decode_secs * 1e6 * (2 * CHANNEL) as f64 / samples as f64;
            writeln!(
                out,
                "| {} | {} | {:.3} | {encode:.0} | {decode:.0} | {sweep_us:.0} | {:.2} |",
                input.name,
                encoding.name,
                m.bytes as f64 / raw,
                m.decode_secs / yardstick
            )?;
        }
    }
    Ok(())
}

// Both channels of takes from all over the grid, each alone and together as a run's file has them.
fn simulated() -> Result<Vec<Input>> {
    let (rig, relief) = (Rig::paper(), Relief::by_name("brick")?);
    let heights = relief.height_field(FACETS);
    let reflection_factor = relief.material().reflection_factor;
    let start = Timestamp(1_767_600_000_000_000_000);
    let simulation = Simulation { rig: &rig, relief: &heights, reflection_factor, start, seed: 1, arms: None };
    let mut devices = devices(&simulation)?;
    let gain = 10f64.powf(rig.sweep.level_dbfs / 20.0);
    let sweep = LinearSweep {
        rate_hz: rig.sweep.rate_hz.get(),
        duration_secs: rig.sweep.duration_secs,
        low_hz: rig.sweep.low_hz,
        high_hz: rig.sweep.high_hz,
        fade_secs: rig.sweep.fade_secs,
    };
    let mut output: Vec<f32> = sweep.samples().into_iter().map(|x| (gain * x) as f32).collect();
    output.resize(rig.recording_len(), 0.0);
    let grid = rig.grid()?;
    let mut takes = Vec::new();
    for pair in grid.pairs().iter().step_by(grid.pairs().len() / TAKES).take(TAKES) {
        let [microphone, speaker] = [pair.microphone, pair.speaker].map(|id| grid.points()[id.index()].position_mm);
        let mut take = Take::default();
        devices.robots.power(Power::On)?;
        devices.robots.move_to(microphone, speaker)?;
        devices.robots.power(Power::Off)?;
        devices.audio.play_and_record(&output, &mut take)?;
        takes.push(take);
    }
    Ok(vec![
        Input { name: "simulated microphone", blocks: alone(&takes, |t| &t.microphone) },
        Input { name: "simulated loopback", blocks: alone(&takes, |t| &t.loopback) },
        Input { name: "simulated, chunk of one take", blocks: takes.chunks(1).map(chunk).collect() },
        Input { name: "simulated, chunk of three", blocks: takes.chunks(3).map(chunk).collect() },
        Input { name: "simulated, chunk of twelve", blocks: takes.chunks(12).map(chunk).collect() },
    ])
}

// A room and the sweep that was played in it, in takes as long as a rig's; the recording has 16 bits in 24.
fn recorded(recording: &[i32], sweep: &[i32]) -> [Input; 3] {
    let takes: Vec<Take> = recording
        .chunks(CHANNEL)
        .zip(sweep.chunks(CHANNEL))
        .map(|(m, l)| Take { started: None, microphone: m.to_vec(), loopback: l.to_vec() })
        .collect();
    [
        Input { name: "room recording", blocks: alone(&takes, |t| &t.microphone) },
        Input { name: "room sweep", blocks: alone(&takes, |t| &t.loopback) },
        Input { name: "room, chunk of one take", blocks: takes.chunks(1).map(chunk).collect() },
    ]
}

// The upper 24 of a file's 32 bits: what an interface of 24 bits would have kept.
fn read_24(path: &Path) -> Result<Vec<i32>> {
    let mut reader = hound::WavReader::open(path)?;
    let shift = u32::from(reader.spec().bits_per_sample).checked_sub(24).ok_or("fewer than 24 bits a sample")?;
    let step = usize::from(reader.spec().channels);
    let samples: std::result::Result<_, _> =
        reader.samples::<i32>().step_by(step).map(|x| x.map(|x| x >> shift)).collect();
    Ok(samples?)
}

fn alone(takes: &[Take], channel: fn(&Take) -> &Vec<i32>) -> Vec<Block> {
    takes.iter().map(|t| Block { channels: vec![channel(t).clone()], beside: Beside::Nothing }).collect()
}

fn chunk(takes: &[Take]) -> Block {
    let channels = takes.iter().flat_map(|t| [t.microphone.clone(), t.loopback.clone()]).collect();
    Block { channels, beside: Beside::Audio }
}

fn measure(input: &Input) -> Result<Vec<Measured>> {
    let unknown = Measured { bytes: 0, encode_secs: f64::INFINITY, decode_secs: f64::INFINITY };
    let mut best = vec![unknown; ENCODINGS.len()];
    for _ in 0..ROUNDS {
        for (encoding, best) in ENCODINGS.iter().zip(&mut best) {
            let mut codec = Codec::new(encoding)?;
            let begun = Instant::now();
            let encoded: Vec<Encoded> = input.blocks.iter().map(|b| codec.encode(b)).collect::<Result<_>>()?;
            best.encode_secs = best.encode_secs.min(begun.elapsed().as_secs_f64());
            best.bytes = encoded.iter().map(|e| e.bytes.len()).sum();
            let mut decoded: Vec<Vec<f32>> =
                input.blocks.iter().flat_map(|b| &b.channels).map(|c| vec![0.0; c.len()]).collect();
            for _ in 0..DECODINGS {
                let begun = Instant::now();
                let mut channels = decoded.iter_mut();
                for block in &encoded {
                    codec.decode(block, &mut channels)?;
                }
                best.decode_secs = best.decode_secs.min(begun.elapsed().as_secs_f64());
                black_box(&decoded);
            }
            let lossless = input.blocks.iter().flat_map(|b| &b.channels).zip(&decoded).all(|(given, got)| {
                given.len() == got.len() && given.iter().zip(got).all(|(x, y)| *x == (*y * FULL_SCALE) as i32)
            });
            if !lossless {
                return Err(format!("{} with {} is not lossless", input.name, encoding.name).into());
            }
        }
    }
    Ok(best)
}

struct Encoded {
    bytes: Vec<u8>,
    plain_len: usize,
    /// Where each channel stands before zstd.
    ranges: Vec<Range<usize>>,
}

struct Codec {
    layout: Layout,
    zstd: Option<(zstd::stream::raw::Encoder<'static>, zstd::bulk::Decompressor<'static>)>,
    plain: Vec<u8>,
    integers: Vec<i32>,
}

impl Codec {
    fn new(encoding: &Encoding) -> Result<Self> {
        let pair =
            |level| std::io::Result::Ok((zstd::stream::raw::Encoder::new(level)?, zstd::bulk::Decompressor::new()?));
        let zstd = encoding.zstd.map(pair).transpose()?;
        Ok(Self { layout: encoding.layout, zstd, plain: Vec::new(), integers: Vec::new() })
    }

    fn encode(&mut self, block: &Block) -> Result<Encoded> {
        let plain = &mut self.plain;
        plain.clear();
        let mut ranges = Vec::new();
        for (index, channel) in block.channels.iter().enumerate() {
            let before = plain.len();
            lay_out(self.layout, channel, plain)?;
            ranges.push(before..plain.len());
            if block.beside == Beside::Audio && index % 2 == 1 {
                let microphone = block.channels[index - 1].iter();
                plain.extend(microphone.flat_map(|x| [(x >> 8) as u8, (x >> 16) as u8]));
            }
        }
        let bytes = match self.zstd.take() {
            Some((mut compressor, decompressor)) => {
                // As a run's file is written: in a stream, whose length zstd does not know when it begins.
                compressor.reinit()?;
                let mut writer = zstd::stream::zio::Writer::new(Vec::new(), compressor);
                writer.write_all(plain)?;
                writer.finish()?;
                let (bytes, compressor) = writer.into_inner();
                self.zstd = Some((compressor, decompressor));
                bytes
            }
            None => plain.clone(),
        };
        Ok(Encoded { bytes, plain_len: plain.len(), ranges })
    }

    fn decode<'a>(&mut self, block: &Encoded, channels: &mut impl Iterator<Item = &'a mut Vec<f32>>) -> Result<()> {
        let plain = match &mut self.zstd {
            Some((_, decompressor)) => {
                self.plain.resize(block.plain_len, 0);
                decompressor.decompress_to_buffer(&block.bytes, &mut self.plain)?;
                &self.plain
            }
            None => &block.bytes,
        };
        for (range, channel) in block.ranges.iter().zip(channels) {
            read_back(self.layout, &plain[range.clone()], channel, &mut self.integers)?;
        }
        Ok(())
    }
}

fn lay_out(layout: Layout, samples: &[i32], out: &mut Vec<u8>) -> Result<()> {
    match layout {
        Layout::Packed => out.extend(samples.iter().flat_map(|x| low_three(*x))),
        Layout::Planes => planes(samples, out),
        Layout::Split => out.extend_from_slice(&split_24(samples)),
        Layout::DeltaPlanes => {
            let mut last = 0;
            let zigzag = |x: &i32| {
                let difference = (x - std::mem::replace(&mut last, *x)) << 8 >> 8;
                (difference << 1) ^ (difference >> 31)
            };
            planes(&samples.iter().map(zigzag).collect::<Vec<_>>(), out);
        }
        Layout::Flac(order) => flac_encode(order, samples, out)?,
    }
    Ok(())
}

fn read_back(layout: Layout, bytes: &[u8], out: &mut [f32], integers: &mut Vec<i32>) -> Result<()> {
    let n = out.len();
    match layout {
        Layout::Packed => decode(SampleFormat::S24le, bytes, out)?,
        Layout::Planes => {
            let (low, rest) = bytes.split_at(n);
            let (middle, high) = rest.split_at(n);
            for (((y, l), m), h) in out.iter_mut().zip(low).zip(middle).zip(high) {
                *y = fraction(joined(*l, *m, *h));
            }
        }
        Layout::Split => decode(SampleFormat::S24Split, bytes, out)?,
        Layout::DeltaPlanes => {
            let (low, rest) = bytes.split_at(n);
            let (middle, high) = rest.split_at(n);
            let mut last = 0i32;
            for (((y, l), m), h) in out.iter_mut().zip(low).zip(middle).zip(high) {
                let zigzag = joined(*l, *m, *h) & 0xFF_FFFF;
                last = last.wrapping_add((zigzag >> 1) ^ -(zigzag & 1)) << 8 >> 8;
                *y = fraction(last);
            }
        }
        Layout::Flac(_) => flac_decode(bytes, out, integers)?,
    }
    Ok(())
}

fn fraction(x: i32) -> f32 {
    x as f32 * (1.0 / FULL_SCALE)
}

fn joined(low: u8, middle: u8, high: u8) -> i32 {
    i32::from(low) | i32::from(middle) << 8 | i32::from(high as i8) << 16
}

fn low_three(x: i32) -> [u8; 3] {
    [x as u8, (x >> 8) as u8, (x >> 16) as u8]
}

fn planes(samples: &[i32], out: &mut Vec<u8>) {
    for shift in [0, 8, 16] {
        out.extend(samples.iter().map(|x| (x >> shift) as u8));
    }
}

fn flac_encode(order: usize, samples: &[i32], out: &mut Vec<u8>) -> Result<()> {
    let mut config = flacenc::config::Encoder::default();
    config.block_size = FLAC_BLOCK;
    config.subframe_coding.qlpc.lpc_order = order;
    let config = config.into_verified().map_err(|(_, e)| e)?;
    let source = flacenc::source::MemSource::from_samples(samples, 1, 24, 96_000);
    let stream = flacenc::encode_with_fixed_block_size(&config, source, FLAC_BLOCK)?;
    let mut sink = flacenc::bitsink::ByteSink::new();
    stream.write(&mut sink)?;
    out.extend_from_slice(sink.as_slice());
    Ok(())
}

fn flac_decode(bytes: &[u8], out: &mut [f32], buffer: &mut Vec<i32>) -> Result<()> {
    let mut reader = claxon::FlacReader::new(bytes)?;
    let mut blocks = reader.blocks();
    let mut rest = out;
    while let Some(block) = blocks.read_next_or_eof(std::mem::take(buffer))? {
        let (now, behind) =
            rest.split_at_mut_checked(block.len() as usize).ok_or("a stream with more samples than were encoded")?;
        now.iter_mut().zip(block.channel(0)).for_each(|(y, x)| *y = fraction(*x));
        (rest, *buffer) = (behind, block.into_buffer());
    }
    if rest.is_empty() { Ok(()) } else { Err("a stream with fewer samples than were encoded".into()) }
}
