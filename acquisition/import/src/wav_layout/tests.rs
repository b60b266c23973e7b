//! Files as other programs write them: each has the numbers that were put into it, or is refused by name.

use echolake_schema::messages::SampleFormat;

use crate::wav_file::WavChannel;

/// Numbers of 24 bits, the loudest of them at full scale.
const NUMBERS: [i32; 6] = [0, 1, -1, 0x12_3456, -0x12_3457, 0x7F_FFFF];

/// A file's chunks, in their order.
#[derive(Clone)]
struct WavBytes {
    form: [u8; 4],
    chunks: Vec<([u8; 4], u32, Vec<u8>)>,
}

fn plain_format(tag: u16, channels: u16, bits: u16, bytes: u16) -> Vec<u8> {
    let [rate, a_second] = [96_000, 96_000 * u32::from(channels * bytes)].map(u32::to_le_bytes);
    let [tag, channels, frame, bits] = [tag, channels, channels * bytes, bits].map(u16::to_le_bytes);
    [&tag[..], &channels, &rate, &a_second, &frame, &bits].concat()
}

fn extensible_format(bits: u16, valid: u16, bytes: u16) -> Vec<u8> {
    let guid = [1, 0, 0, 0, 0, 0, 0x10, 0, 0x80, 0, 0, 0xAA, 0, 0x38, 0x9B, 0x71];
    let extension = [22u16.to_le_bytes(), valid.to_le_bytes(), [4, 0], [0, 0]].concat();
    [plain_format(0xFFFE, 1, bits, bytes), extension, guid.to_vec()].concat()
}

fn packed(numbers: &[i32], bytes: usize, shift: u32) -> Vec<u8> {
    numbers.iter().flat_map(|x| (x << shift).to_le_bytes().into_iter().take(bytes)).collect()
}

impl WavBytes {
    fn new(format: Vec<u8>, data: Vec<u8>) -> Self {
        Self { form: *b"RIFF", chunks: Vec::new() }.with(b"fmt ", format).with(b"data", data)
    }

    /// 24 bits, one channel.
    fn plain() -> Self {
        Self::new(plain_format(1, 1, 24, 3), packed(&NUMBERS, 3, 0))
    }

    fn with(mut self, name: &[u8; 4], content: Vec<u8>) -> Self {
        self.chunks.push((*name, content.len() as u32, content));
        self
    }

    /// Puts a chunk before the samples.
    fn before(mut self, name: &[u8; 4], content: Vec<u8>) -> Self {
        self.chunks.insert(1, (*name, content.len() as u32, content));
        self
    }

    /// Says another length of the samples.
    fn saying(mut self, bytes: u32) -> Self {
        self.chunks.iter_mut().filter(|(name, ..)| name == b"data").for_each(|(_, said, _)| *said = bytes);
        self
    }

    fn bytes(&self, pad: &[u8]) -> Vec<u8> {
        let mut file = [&self.form[..], &0u32.to_le_bytes(), b"WAVE"].concat();
        for (name, said, content) in &self.chunks {
            file.extend([&name[..], &said.to_le_bytes(), content].concat());
            if content.len() % 2 == 1 {
                file.extend(pad);
            }
        }
        file
    }
}

fn open(bytes: &[u8]) -> Result<(WavChannel, tempfile::TempDir), String> {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("a.wav"), bytes).expect("written");
    WavChannel::open(folder.path(), "a.wav").map(|channel| (channel, folder))
}

fn check_bytes(what: &str, bytes: &[u8], expected: &[i32]) -> Vec<String> {
    let (channel, _folder) = open(bytes).unwrap_or_else(|e| panic!("{what}: {e}"));
    assert_eq!(channel.sample_format(), SampleFormat::S24Split, "{what}");
    let read = channel.read_all(SampleFormat::S24Split).expect("samples");
    assert_eq!(read.bytes, echolake_schema::samples::split_24(expected), "{what}");
    let fractions: Vec<f32> = expected.iter().map(|x| *x as f32 / 8_388_608.0).collect();
    assert_eq!(read.fractions, fractions, "{what}");
    assert_eq!(read.clipped, 1, "{what}");
    channel.layout.warnings
}

fn check(what: &str, file: &WavBytes) -> Vec<String> {
    check_bytes(what, &file.bytes(&[0]), &NUMBERS)
}

fn refused(file: &WavBytes, expected: &str) {
    let error = open(&file.bytes(&[0])).map(|(channel, _)| channel).expect_err(expected);
    assert!(error.contains("a.wav") && error.contains(expected), "{error}");
}

#[test]
fn twenty_four_bits_are_the_same_however_they_are_stored() {
    assert!(check("plain", &WavBytes::plain()).is_empty());
    let upper = packed(&NUMBERS, 4, 8);
    let lower = packed(&NUMBERS, 4, 0);
    check("upper bits of 32", &WavBytes::new(extensible_format(32, 24, 4), upper.clone()));
    check("lower bits of 32", &WavBytes::new(extensible_format(32, 24, 4), lower.clone()));
    check("upper bits, not extensible", &WavBytes::new(plain_format(1, 1, 24, 4), upper.clone()));
    check("lower bits, not extensible", &WavBytes::new(plain_format(1, 1, 24, 4), lower.clone()));
    let both = [&lower[..12], &upper[12..]].concat();
    refused(
        &WavBytes::new(extensible_format(32, 24, 4), both),
        "24 of 32 bits of a sample are valid, and uses the others",
    );
    check("no number of valid bits", &WavBytes::new(extensible_format(24, 0, 3), packed(&NUMBERS, 3, 0)));
    let twenty = NUMBERS.map(|x| x >> 4 << 4);
    let file = WavBytes::new(extensible_format(24, 20, 3), packed(&twenty, 3, 0));
    check_bytes("20 of 24 bits", &file.bytes(&[]), &twenty);
    // A plain format in a chunk as long as the extensible one.
    let long = [plain_format(1, 1, 24, 3), vec![0; 24]].concat();
    check("a long format", &WavBytes::new(long, packed(&NUMBERS, 3, 0)));
    let mut wrong_rate = plain_format(1, 1, 24, 3);
    wrong_rate[8..12].copy_from_slice(&25_856u32.to_le_bytes());
    let warnings = check("bytes a second", &WavBytes::new(wrong_rate, packed(&NUMBERS, 3, 0)));
    assert_eq!(warnings, ["its header says 25856 bytes a second, expected 288000: its rate of 96000 Hz counts"]);
}

#[test]
fn doubles_and_bytes_have_the_same_full_scale() {
    let doubles = [0.0, 0.5, -1.0, 0.25 + 1e-12].map(f64::to_le_bytes).concat();
    let bytes = vec![128, 192, 0, 160];
    for (bits, tag, data, format) in [(64, 3, doubles, SampleFormat::F32le), (8, 1, bytes, SampleFormat::S16le)] {
        let file = WavBytes::new(plain_format(tag, 1, bits, bits / 8), data).bytes(&[]);
        let (channel, _folder) = open(&file).unwrap_or_else(|e| panic!("{bits} bits: {e}"));
        assert_eq!(channel.sample_format(), format);
        let read = channel.read_all(format).expect("samples");
        assert_eq!((read.fractions, read.clipped), (vec![0.0, 0.5, -1.0, 0.25], 1), "{bits} bits");
    }
    let large = WavBytes::new(plain_format(3, 1, 64, 8), 1e39f64.to_le_bytes().to_vec()).bytes(&[]);
    let (channel, _folder) = open(&large).expect("a channel");
    assert!(channel.read_all(SampleFormat::F32le).is_err_and(|e| e.contains("has a sample that is inf")));
}

#[test]
fn channels_are_told_apart() {
    let both: Vec<i32> = NUMBERS.iter().flat_map(|x| [*x, -*x]).collect();
    let file = WavBytes::new(plain_format(1, 2, 24, 3), packed(&both, 3, 0)).bytes(&[0]);
    check_bytes("the first", &file, &NUMBERS);
    let (_, folder) = open(&file).expect("two channels");
    let read =
        WavChannel::open(folder.path(), "a.wav#2").and_then(|c| c.read_all(SampleFormat::S24Split)).expect("samples");
    assert_eq!(read.bytes, echolake_schema::samples::split_24(&NUMBERS.map(|x| -x)));
}

#[test]
fn chunks_of_any_length_may_stand_around_the_samples() {
    let odd = WavBytes::plain().before(b"LIST", b"INFOodd".to_vec());
    check("padded", &odd);
    check_bytes("not padded", &odd.bytes(&[]), &NUMBERS);
    check("behind", &WavBytes::plain().with(b"bext", vec![1; 602]).with(b"iXML", vec![b'x'; 31]));
    let odd_samples = WavBytes::new(plain_format(1, 1, 24, 3), packed(&NUMBERS[1..], 3, 0));
    check_bytes("odd, padded", &odd_samples.bytes(&[0]), &NUMBERS[1..]);
    check_bytes("odd, not padded", &odd_samples.bytes(&[]), &NUMBERS[1..]);
}

#[test]
fn long_files_say_their_length_elsewhere() {
    for (form, length) in [(*b"RF64", 28), (*b"BW64", 28), (*b"RF64", 32)] {
        let mut file = WavBytes::plain().saying(u32::MAX);
        let sizes = [0u64, 18, 6].map(u64::to_le_bytes).concat();
        file.chunks.insert(0, (*b"ds64", length, [sizes, vec![0; length as usize - 24]].concat()));
        file.form = form;
        assert!(check("ds64", &file).is_empty());
        assert!(check("a chunk behind it", &file.clone().with(b"LIST", vec![0; 8])).is_empty());
        file.chunks[0].2[8] = 24;
        refused(&file, "is cut off: its header says 24 bytes of samples from byte ");
    }
}

#[test]
fn samples_are_all_taken_or_the_file_is_refused() {
    for unknown in [u32::MAX, 0xFFFF_1000, 0x7FFF_FFFF, 0] {
        let warnings = check("a stream's", &WavBytes::plain().saying(unknown));
        let expected = format!(
            "its header says {unknown} bytes of samples, 18 are there: all of its 6 samples to the file's end are taken"
        );
        assert_eq!(warnings, [expected]);
    }
    refused(&WavBytes::plain().saying(6), "12 bytes behind its samples, from byte 50 on, that are no chunk");
    refused(
        &WavBytes::plain().saying(36),
        "is cut off: its header says 36 bytes of samples from byte 44 on, 18 are there; hint: copy it again",
    );
    refused(&WavBytes::plain().with(b"data", packed(&NUMBERS, 3, 0)), "a second `data` chunk at byte 62");
    refused(
        &WavBytes::new(plain_format(1, 1, 24, 3), vec![0; 20]),
        "ends within a sample: 20 bytes of samples from byte",
    );
    let empty = WavBytes::new(plain_format(1, 1, 24, 3), Vec::new());
    refused(&empty, "has no samples");
    refused(&empty.with(b"LIST", vec![0; 8]), "has no samples");
    // Chance puts names of chunks among samples.
    let named = [packed(&NUMBERS, 3, 0), b"LIST".to_vec(), vec![9; 14]].concat();
    let numbers: Vec<i32> = named.chunks(3).map(|b| i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8).collect();
    check_bytes("named", &WavBytes::new(plain_format(1, 1, 24, 3), named.clone()).bytes(&[]), &numbers);
    let named = [named, vec![9; 2]].concat();
    refused(&WavBytes::new(plain_format(1, 1, 24, 3), named).saying(18), "20 bytes behind its samples, ");
}

#[test]
fn other_codings_are_named() {
    let coded = |tag, bits, bytes| WavBytes::new(plain_format(tag, 1, bits, bytes), vec![0; 48]);
    refused(&coded(3, 16, 2), "has float samples of 16 bits in 2 bytes, expected integers of 8, 16, 24 or 32 bits");
    refused(&coded(1, 32, 3), "has integer samples of 32 bits in 3 bytes");
    refused(&coded(0x55, 16, 2), "is coded by format 0x0055");
    let mut turned = WavBytes::plain();
    turned.form = *b"RIFX";
    refused(&turned, "does not begin with `RIFF` and `WAVE`");
    turned = WavBytes::plain();
    turned.chunks.remove(1);
    refused(&turned, "it has no `data` chunk");
    turned = WavBytes::plain();
    turned.chunks.remove(0);
    refused(&turned, "it has no `fmt ` chunk");
}
