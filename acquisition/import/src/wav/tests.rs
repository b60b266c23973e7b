//! Imports of several surfaces that fail late: what is left of them.

use std::path::PathBuf;

use echolake_dsp::sweep::{SineSweep, SweepShape};
use echolake_schema::messages::SampleFormat;
use echolake_schema::samples::encode_wav;

use super::*;

const SAMPLES: u32 = 4_000;

struct WavFolder(tempfile::TempDir);

impl WavFolder {
    /// Two surfaces; the second one's recording has the sample `last` at its end.
    fn new(last: f32) -> Self {
        let place = Self(tempfile::tempdir().expect("a folder"));
        std::fs::create_dir(place.inbox()).expect("a folder");
        place.wav("good.wav", 0.25);
        place.wav("last.wav", last);
        let rows = "surface,recording,loopback,microphone,speaker,temperature_c\n\
                    a,good.wav,good.wav,0/0/0,0/0/1,20\nb,last.wav,good.wav,0/0/0,0/0/1,20\n";
        std::fs::write(place.manifest(), rows).expect("written");
        place
    }

    fn inbox(&self) -> PathBuf {
        self.0.path().join("inbox")
    }

    fn manifest(&self) -> PathBuf {
        self.0.path().join("manifest.csv")
    }

    fn wav(&self, name: &str, last: f32) {
        let body = (1..SAMPLES).map(|i| ((i * 7_919) % 20_011) as f32 / 40_022.0 - 0.25);
        let bytes: Vec<u8> = body.chain([last]).flat_map(f32::to_le_bytes).collect();
        let file = encode_wav(SampleFormat::F32le, 96_000, &[&bytes]).expect("a file");
        std::fs::write(self.0.path().join(name), file).expect("written");
    }

    fn import(&self, progress: &mut dyn FnMut(usize, usize)) -> Result<Vec<ImportedRun>, Error> {
        self.import_by("sweep.duration_secs = 0.03", progress)
    }

    fn import_by(&self, rig: &str, progress: &mut dyn FnMut(usize, usize)) -> Result<Vec<ImportedRun>, Error> {
        let rig = Rig::from_toml(rig).expect("a rig");
        let inbox = self.inbox();
        let options = ImportOptions { started: Timestamp(1_767_600_000_000_000_000), folder: &inbox, project: None };
        import_wav(&self.manifest(), &rig, options, progress)
    }

    fn left(&self) -> Vec<String> {
        let entries = std::fs::read_dir(self.inbox()).expect("a folder").flatten();
        let mut names: Vec<_> = entries.map(|e| e.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }
}

#[test]
fn runs_get_their_names_together() {
    let place = WavFolder::new(0.5);
    let mut named = 0;
    let runs = place
        .import(&mut |_, _| named += place.left().iter().filter(|n| n.ends_with(".mcap")).count())
        .expect("imported");
    assert_eq!(named, 0, "no run has its name while another is written");
    assert_eq!(place.left(), runs.iter().map(|r| format!("{}.mcap", r.run_id)).collect::<Vec<_>>());
    assert_eq!(runs.iter().map(|r| r.surface.as_str()).collect::<Vec<_>>(), ["a", "b"]);
}

#[test]
fn a_sample_that_is_no_number_leaves_nothing() {
    let place = WavFolder::new(f32::NAN);
    let mut done = 0;
    let error = place.import(&mut |d, _| done = d).expect_err("NaN").to_string();
    assert!(error.contains("line 3") && error.contains("last.wav"), "{error}");
    assert_eq!((done, place.left()), (1, Vec::new()), "it fails after the first surface, and leaves nothing");
}

#[test]
fn somebody_elses_file_under_a_runs_name_is_left_alone() {
    let place = WavFolder::new(0.5);
    let taken = |done: usize| {
        // The second run's name is known from its partial file.
        let last = place.left().pop().filter(|_| done == 2)?;
        let path = place.inbox().join(last.strip_suffix(".partial")?);
        std::fs::write(&path, "someone else's").expect("written");
        Some(path)
    };
    let mut path = None;
    let error = place.import(&mut |done, _| path = taken(done)).expect_err("taken").to_string();
    let path = path.expect("the second run was written");
    assert!(error.contains("is there already"), "{error}");
    assert_eq!(place.left().len(), 1, "{:?}", place.left());
    assert_eq!(std::fs::read(path).expect("the file"), b"someone else's");
}

#[test]
fn messages_are_in_the_order_of_time_however_the_rows_are() {
    let place = WavFolder::new(0.5);
    let rows = "surface,recording,loopback,microphone,speaker,temperature_c,recorded_at\n\
                a,good.wav,good.wav,0/0/0,0/0/1,20,2026-01-05T08:00:30Z\n\
                a,last.wav,good.wav,0/0/0,0/0/2,20,2026-01-05T08:00:10Z\n\
                a,last.wav,good.wav,0/0/0,0/0/3,20,2026-01-05T08:00:20Z\n";
    std::fs::write(place.manifest(), rows).expect("written");
    let runs = place.import(&mut |_, _| {}).expect("imported");
    let file = std::fs::read(&runs[0].path).expect("the run");
    let messages = mcap::MessageStream::new(&file).expect("an MCAP file").map(|m| m.expect("whole"));
    let mut times = std::collections::BTreeMap::<String, Vec<u64>>::new();
    messages.for_each(|m| times.entry(m.channel.topic.clone()).or_default().push(m.log_time));
    assert_eq!(times["/measurement"].len(), 3);
    assert!(times.values().all(|of_topic| of_topic.is_sorted()), "{times:?}");
}

// Levels of a model are compared with those of its Flat in other air. A room is what it is.
#[test]
fn a_room_needs_no_temperature() {
    let place = WavFolder::new(0.5);
    let rows = "surface,recording,loopback,microphone,speaker\na,last.wav,good.wav,0/0/0,0/0/1\n";
    std::fs::write(place.manifest(), rows).expect("written");
    let error = place.import(&mut |_, _| {}).expect_err("a model").to_string();
    assert!(error.contains("line 2, column `temperature_c`: it is empty, and levels of a model"), "{error}");
    let room = "bands.centres_hz = [2500, 5000]\nsweep = { duration_secs = 0.03, high_hz = 20000 }";
    let runs = place.import_by(room, &mut |_, _| {}).expect("imported");
    let said = "no temperature is known of 1 responses: 20 C, the reference's, stands in temperature_c";
    assert!(runs[0].notes.iter().any(|note| note.starts_with(said)), "{:?}", runs[0].notes);
}

/// Samples of a recording whose direct sound is `late` samples later than geometry gives, and its sweep.
fn late_take(late: usize) -> [Vec<f32>; 2] {
    let sweep = SineSweep {
        shape: SweepShape::Linear,
        rate_hz: 96e3,
        duration_secs: 0.03,
        low_hz: 2e3,
        high_hz: 40e3,
        fade_secs: 1e-3,
    };
    let sweep: Vec<f32> = sweep.samples().iter().map(|x| 0.5 * *x as f32).collect();
    let mut recording = vec![0.0; late + expected_arrival()];
    recording.extend(&sweep);
    recording.resize(recording.len() + 4_000, 0.0);
    [recording, sweep]
}

// Of the pair 0/0/0 and 0/0/1 of the paper's rig at 20 C.
fn expected_arrival() -> usize {
    let grid = Rig::paper().build_grid().expect("a grid");
    let [m, s] = ["0/0/0", "0/0/1"].map(|label| grid.parse_point(label).expect("a point").position_mm);
    (direct_mm(m, s) / 1e3 / ReferenceAir::from_response(&Rig::paper().impulse_response).speed_of_sound() * 96e3)
        .round() as usize
}

fn import_take(recording: &[f32], loopback: &[f32]) -> Result<(Vec<String>, ImpulseResponse), Error> {
    let place = WavFolder::new(0.5);
    for (name, samples) in [("take.wav", recording), ("loopback.wav", loopback)] {
        let bytes: Vec<u8> = samples.iter().flat_map(|x| x.to_le_bytes()).collect();
        let file = encode_wav(SampleFormat::F32le, 96_000, &[&bytes]).expect("a file");
        std::fs::write(place.0.path().join(name), file).expect("written");
    }
    let rows = "surface,recording,loopback,microphone,speaker,temperature_c\n\
                a,take.wav,loopback.wav,0/0/0,0/0/1,20\n";
    std::fs::write(place.manifest(), rows).expect("written");
    let runs = place.import(&mut |_, _| {})?;
    let file = std::fs::read(&runs[0].path).expect("the run");
    let mut messages = mcap::MessageStream::new(&file).expect("an MCAP file").map(|m| m.expect("whole"));
    let ir = messages.find(|m| m.channel.topic == echolake_schema::topics::IR).expect("a response");
    Ok((runs[0].warnings.clone(), prost::Message::decode(&ir.data[..]).expect("decoded")))
}

fn peak_of(ir: &ImpulseResponse) -> Option<usize> {
    (0..ir.samples.len()).max_by(|a, b| ir.samples[*a].abs().total_cmp(&ir.samples[*b].abs()))
}

// Latency of an interface without a loopback: behind the response it is refused, within it a warning names it.
#[test]
fn a_late_arrival_is_named_and_silence_is_no_response() {
    let imported = |late: usize| {
        let [recording, mut sweep] = late_take(late);
        sweep.resize(recording.len(), 0.0);
        import_take(&recording, &sweep)
    };
    let error = imported(9_600).expect_err("silence").to_string();
    let expected = "the direct sound arrives 9600 samples (100.0 ms) late: no loopback";
    assert!(error.contains(expected) && error.contains("the response of 384 samples would be silence"), "{error}");
    let (warnings, ir) = imported(200).expect("within the response");
    assert!(warnings[0].contains("the direct sound arrives 200 samples (2.1 ms) late: no loopback"), "{warnings:?}");
    assert_eq!(peak_of(&ir), Some(expected_arrival() + 200));
    assert!(imported(0).expect("in time").0.iter().all(|warning| !warning.contains("arrives")));
}

// ISO 18233: what differs between two takes is no property of a surface.
#[test]
fn attempts_of_one_pair_are_compared() {
    let [recording, mut sweep] = late_take(0);
    sweep.resize(recording.len(), 0.0);
    for (gain, is_said) in [(1.0, false), (0.996, false), (0.97, true)] {
        let place = WavFolder::new(0.5);
        let changed: Vec<f32> = recording.iter().map(|x| gain * x).collect();
        for (name, samples) in [("take.wav", &recording), ("again.wav", &changed), ("loopback.wav", &sweep)] {
            let bytes: Vec<u8> = samples.iter().flat_map(|x| x.to_le_bytes()).collect();
            let file = encode_wav(SampleFormat::F32le, 96_000, &[&bytes]).expect("a file");
            std::fs::write(place.0.path().join(name), file).expect("written");
        }
        let rows = "surface,recording,loopback,microphone,speaker,temperature_c,attempt\n\
                    a,take.wav,loopback.wav,0/0/0,0/0/1,20,1\na,again.wav,loopback.wav,0/0/0,0/0/1,20,2\n";
        std::fs::write(place.manifest(), rows).expect("written");
        let runs = place.import(&mut |_, _| {}).expect("imported");
        let said = runs[0].warnings.iter().any(|warning| warning.starts_with("line 3: two takes differ by -30.5 dB"));
        assert_eq!(said, is_said, "{gain}: {:?}", runs[0].warnings);
        let file = std::fs::read(&runs[0].path).expect("the run");
        let messages = mcap::MessageStream::new(&file).expect("an MCAP file").map(|m| m.expect("whole"));
        let verdicts = messages.filter(|m| m.channel.topic == echolake_schema::topics::MEASUREMENT);
        let found: Vec<_> = verdicts
            .map(|m| <Measurement as prost::Message>::decode(&m.data[..]).expect("decoded").repeat_difference_db)
            .collect();
        let expected_db = 20.0 * (1.0 - f64::from(gain)).log10();
        assert_eq!(found[0], None);
        let is_equal = found[1].map_or(gain == 1.0, |db| (db - expected_db).abs() < 0.1);
        assert!(is_equal, "{gain}: {found:?}, expected {expected_db}");
    }
}

#[test]
fn a_sweeps_own_file_places_the_take_by_geometry() {
    let [recording, sweep] = late_take(30_000);
    let (warnings, ir) = import_take(&recording, &sweep).expect("imported");
    assert!(warnings[0].contains("no loopback: the sweep was found 0.3125 s into the recording"), "{warnings:?}");
    assert_eq!(peak_of(&ir), Some(expected_arrival()));
}
