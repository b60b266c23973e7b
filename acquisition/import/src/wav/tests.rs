//! Imports of several surfaces that fail late: what is left of them.

use std::path::PathBuf;

use hound::{SampleFormat, WavSpec, WavWriter};

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
        let (sample_rate, sample_format) = (96_000, SampleFormat::Float);
        let spec = WavSpec { channels: 1, sample_rate, bits_per_sample: 32, sample_format };
        let mut writer = WavWriter::create(self.0.path().join(name), spec).expect("a file");
        for i in 1..SAMPLES {
            writer.write_sample(((i * 7_919) % 20_011) as f32 / 40_022.0 - 0.25).expect("written");
        }
        writer.write_sample(last).expect("written");
        writer.finalize().expect("closed");
    }

    fn import(&self, progress: &mut dyn FnMut(usize, usize)) -> Result<Vec<ImportedRun>, Error> {
        let rig = Rig::from_toml("sweep.duration_secs = 0.03").expect("a rig");
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
