//! One response as REW exports it: with and without a timing offset, as text and as WAV.

use std::path::PathBuf;

use echolake_schema::messages::SampleFormat;
use echolake_schema::samples::encode_wav;

use super::*;

const RIG: &str = "name = \"room\"\nbands.centres_hz = [1000, 2000]\ngrid.points_mm = [[0, 0, 1000], [2000, 0, 1000]]\n\
                   [sweep]\nrate_hz = 48000\nlow_hz = 20\nhigh_hz = 20000\n[impulse_response]\nlength = 1200\n";
const RATE_HZ: f64 = 48e3;
/// Samples from the emission to the peak: 2 m at 20 C are 279.1 in the reference air.
const ARRIVAL: f64 = 280.37;
/// Sample of the export that is REW's peak.
const PEAK_INDEX: f64 = 4_800.0;

// A pulse that has nothing at half the sampling rate, `at` samples after the first one.
fn pulse(at: f64, len: usize) -> Vec<f64> {
    (0..len).map(|n| 0.5 * (-((n as f64 - at) / 4.0).powi(2) / 2.0).exp()).collect()
}

/// REW's start time of a response with a timing offset.
fn start_secs(offset_ms: f64) -> f64 {
    (ARRIVAL - PEAK_INDEX) / RATE_HZ - offset_ms / 1e3
}

// As version 5.40 writes it.
fn export(offset_ms: f64) -> String {
    let samples: Vec<String> = pulse(PEAK_INDEX, 12_000).iter().map(f64::to_string).collect();
    format!(
        "* Impulse Response data saved by REW V5.40 Beta 132\n* IR is not normalised\n* IR window has not been applied\n\
         * IR is not the min phase version\n* Dated: Jun 15, 2026, 2:47:02 PM\n* Measurement: room\n\
         * Excitation: 512k Log Swept Sine, 1 sweep at -10.0 dBFS using a loopback as a timing reference\n\
         * Response measured over: 20.1 to 19,999.9 Hz\n0.5 // Peak value before normalisation\n\
         4800 // Peak index\n12000 // Response length\n2.0833333333333333E-5 // Sample interval (seconds)\n\
         {} // Start time (seconds)\n* Data start\n{}\n",
        start_secs(offset_ms),
        samples.join("\n")
    )
}

struct RewFolder(tempfile::TempDir);

impl RewFolder {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().expect("a folder"));
        place.write("a.txt", export(0.0).as_bytes());
        place.write("b.txt", export(4.0).as_bytes());
        place
    }

    fn write(&self, name: &str, content: &[u8]) -> PathBuf {
        let path = self.0.path().join(name);
        std::fs::write(&path, content).expect("written");
        path
    }

    /// Reads a manifest of one row, from the column `response` on.
    fn row(&self, response: &str, rest: &str) -> Result<RewRow, Error> {
        let header = "surface,response,microphone,speaker,temperature_c,timing_offset_ms,start_secs";
        let text = format!("{header}\nroom,{response},0/0/0,0/1/0,20,{rest}\n");
        let manifest = self.write("manifest.csv", text.as_bytes());
        let rig = Rig::from_toml(RIG).expect("a rig");
        let mut surfaces = read_rows(&manifest, &rig, &rig.build_grid().expect("a grid"))?;
        Ok(surfaces.pop_first().expect("a surface").1.1.remove(0))
    }

    fn refused(&self, response: &str, rest: &str, expected: &str) {
        let error = self.row(response, rest).map(|row| row.line).expect_err(expected).to_string();
        assert!(error.contains("manifest.csv") && error.contains(expected), "{error}");
    }
}

fn check_arrival(row: &RewRow) {
    for (n, (actual, expected)) in row.response.samples.iter().zip(pulse(ARRIVAL, 1_200)).enumerate() {
        assert!((f64::from(*actual) - expected).abs() < 1e-6, "sample {n}: {actual}, expected {expected}");
    }
    assert_eq!(row.response.samples.len(), 1_200);
}

#[test]
fn a_response_arrives_at_the_same_time_however_it_was_exported() {
    let place = RewFolder::new();
    for (name, rest) in [("a.txt", "0,"), ("b.txt", "4,")] {
        let row = place.row(name, rest).expect("a response");
        check_arrival(&row);
        assert_eq!(row.warnings, [""; 0]);
    }
    // Scaled to its peak, with the decimal comma and the header of 5.19.
    let text =
        export(0.0).replace("IR is not normalised", "IR is normalised").replace("* ", "").replace("0.5 //", "0,5 //");
    place.write("old.txt", text.replace("Data start", "").as_bytes());
    let scaled = place.row("old.txt", "0,").expect("a response");
    assert!((scaled.response.samples[280] - 0.5 * pulse(ARRIVAL, 300)[280] as f32).abs() < 1e-6);
    let bytes: Vec<u8> = pulse(PEAK_INDEX, 12_000).iter().flat_map(|x| (*x as f32).to_le_bytes()).collect();
    place.write("a.wav", &encode_wav(SampleFormat::F32le, 48_000, &[&bytes]).expect("a file"));
    check_arrival(&place.row("a.wav", &format!("0,{}", start_secs(0.0))).expect("a response"));
}

#[test]
fn what_is_not_known_is_asked_for_and_what_is_odd_is_named() {
    let place = RewFolder::new();
    place.refused("a.txt", ",", "column `timing_offset_ms`: it is empty, and no export of REW has it");
    let bytes = [0.5f32, 0.25].map(f32::to_le_bytes).concat();
    place.write("a.wav", &encode_wav(SampleFormat::F32le, 48_000, &[&bytes]).expect("a file"));
    place.refused("a.wav", "0,", "column `start_secs`: it is empty, and `a.wav` does not have the time of its first");
    place.refused("a.wav", "0,-1", "has its peak -48000 samples after the emission, expected within the 1200 samples");
    let warning = &place.row("b.txt", "0,").expect("a response").warnings[0];
    assert!(
        warning.contains("88 samples after the emission, and geometry gives 279: is the timing offset"),
        "{warning}"
    );
    let edited = |from: &str, to: &str, expected: &str| {
        let text = export(0.0);
        assert!(text.contains(from), "{from}");
        place.write("edited.txt", text.replace(from, to).as_bytes());
        place.refused("edited.txt", "0,", expected);
    };
    edited("window has not been", "window has been", "line 3: its window has been applied");
    edited("is not the min phase", "is the min phase", "line 4: it is the minimum phase version");
    edited("12000 // Response", "12001 // Response", "is cut off: its header says 12001 samples, 12000 are there");
    edited("2.0833333333333333E-5", "1.0416666666666666E-5", "is sampled at 96000.0 Hz, expected the rig's 48000 Hz");
    edited(" // Start time", " // Some time", "column `start_secs`: it is empty");
    edited(" // Sample interval", " // Some interval", "has no `// Sample interval (seconds)` in its header");
    edited("* Data start\n", "* Data start\n0\nzero\n", "line 16: `zero`, expected a sample");
    place.write("b.txt", export(0.0).replace("using a loopback", "").as_bytes());
    let warning = &place.row("b.txt", "0,").expect("a response").warnings[0];
    assert!(warning.contains("names no loopback"), "{warning}");
}

/// E26: prose may have `//` in it; no number is passed over that is none or has no row; a device is not read.
#[test]
fn odd_texts_are_prose_or_refused_by_line() {
    let place = RewFolder::new();
    let edit = |from: &str, to: &str| {
        let text = export(0.0);
        assert!(text.contains(from), "{from}");
        place.write("edited.txt", text.replace(from, to).as_bytes());
    };
    let notes = "* Notes: see https://example.org/a\n* 3 // Start time (seconds)\nnotes: C:// room\n";
    edit("* Measurement", &format!("{notes}* Measurement"));
    check_arrival(&place.row("edited.txt", "0,").expect("prose"));
    let refused = |from: &str, to: &str, expected: &str| {
        edit(from, to);
        place.refused("edited.txt", "0,", expected);
    };
    refused("0.5 // Peak", "half // Peak", "line 9: `half`, expected a number");
    refused("0.5 // Peak", "NaN // Peak", "line 9: `NaN`, expected a number");
    let second = "4800 // Peak index\n1 // Sample interval (s)\n";
    refused("4800 // Peak index\n", second, "line 13: a second sample interval, expected that of line 11 alone");
    for (text, line) in [("* Data start\nNaN\n", 15), ("* Data start\n\n-1.#IND\n", 16), ("inf\n* Data start\n", 14)] {
        let expected = format!("line {line}: `{}`, expected a", text.replace("* Data start\n", "").trim());
        refused("* Data start\n", text, &expected);
    }
    refused("* Data start\n", "* Data start\n1e39\n", "line 15: `1e39`, expected a finite f32");
    let normalised = export(0.0).replace("IR is not normalised", "IR is normalised");
    place.write("edited.txt", normalised.replace("0.5 //", "1e300 //").as_bytes());
    place.refused("edited.txt", "0,", "line 9: a peak value of 1e300, expected one of finite f32");
    for device in ["/dev/zero", "/"] {
        place.refused(device, "0,", "it is no plain file");
    }
    std::os::unix::fs::symlink("/dev/zero", place.0.path().join("zero.wav")).expect("linked");
    place.refused("zero.wav", "0,0", "it is no plain file");
}

/// E26: a column that is given twice is refused, and a manifest that never ends.
#[test]
fn a_column_is_given_once() {
    let place = RewFolder::new();
    let rig = Rig::from_toml(RIG).expect("a rig");
    let header = format!("{},surface\n", REW_MANIFEST[..7].join(","));
    let manifest = place.write("manifest.csv", format!("{header}room,a.txt,0/0/0,0/1/0,20,0,,hall\n").as_bytes());
    let error = check_rew(&manifest, &rig).expect_err("two surfaces").to_string();
    assert!(error.contains("manifest.csv`: column `surface` is there twice; hint: the columns are"), "{error}");
    let error = check_rew(Path::new("/dev/zero"), &rig).expect_err("endless").to_string();
    assert!(error.contains("does not end within 67108864 bytes"), "{error}");
}

#[test]
fn a_manifest_becomes_a_run_of_its_origin() {
    let place = RewFolder::new();
    let manifest = place.write(
        "manifest.csv",
        b"surface,response,microphone,speaker,temperature_c,timing_offset_ms\nroom,b.txt,0 0 1000,2000 0 1000,20,0\n",
    );
    let rig = Rig::from_toml(RIG).expect("a rig");
    let options =
        ImportOptions { started: Timestamp(1_767_600_000_000_000_000), folder: place.0.path(), project: None };
    let runs = import_rew(&manifest, &rig, options, &mut |done, total| assert_eq!((done, total), (1, 1)));
    let runs = runs.expect("imported");
    assert!(runs[0].warnings[0].starts_with("line 2: the peak of `b.txt`"), "{:?}", runs[0].warnings);
    let file = std::fs::read(&runs[0].path).expect("the run");
    let mut messages = mcap::MessageStream::new(&file).expect("an MCAP file").map(|m| m.expect("whole"));
    assert!(messages.any(|m| m.channel.topic == echolake_schema::topics::IR));
    assert!(String::from_utf8_lossy(&file).contains("imported_rew"));
}
