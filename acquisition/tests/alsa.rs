//! The ALSA driver through the real libasound, without a sound card: ALSA's `file` PCM over its `null` PCM. What is
//! played ends in a file, what is recorded comes from another; the test is the cable between them.
//!
//! libasound finds its configuration by the environment, so the program starts itself once more with that set.
#![allow(clippy::print_stderr, reason = "it has no harness that would say what was tried")]

use std::path::{Path, PathBuf};
use std::process::Command;

use echolake_acquisition::rig::conformance;
use echolake_acquisition::rig::drivers::audio_interface;
use echolake_acquisition::rig::{AudioInterface, AudioTake, Error};
use echolake_schema::Timestamp;
use echolake_schema::devices::{AlsaParams, AudioFormat};
use echolake_testing::run_command;

const FOLDER: &str = "ECHOLAKE_ALSA_TEST";
const RATE_HZ: f64 = 96_000.0;
/// Frames that the loopback comes behind the output.
const DELAY: usize = 1_234;

fn main() {
    match std::env::var_os(FOLDER) {
        Some(folder) => checks(Path::new(&folder)),
        None => {
            let folder = tempfile::tempdir().expect("a folder");
            std::fs::write(folder.path().join("asound.conf"), configuration(folder.path())).expect("written");
            let mut command = Command::new(std::env::current_exe().expect("this program"));
            command.env(FOLDER, folder.path()).env("ALSA_CONFIG_PATH", folder.path().join("asound.conf"));
            let output = run_command(&mut command).expect("started");
            let said = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success(), "the checks failed: {said}");
            eprint!("{said}");
        }
    }
}

fn configuration(folder: &Path) -> String {
    let at = folder.display();
    format!(
        "pcm.null {{ type null }}\n\
         pcm.out {{ type file slave.pcm null file \"{at}/out.raw\" format raw }}\n\
         pcm.in {{ type file slave.pcm null file /dev/null infile \"{at}/in.raw\" format raw }}\n"
    )
}

/// The cable: the output is written to the file that is going to be recorded, later and softer.
struct Rewired {
    inner: Box<dyn AudioInterface>,
    folder: PathBuf,
    format: AudioFormat,
    cable: CableState,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum CableState {
    Plugged,
    Missing,
    /// A sample is lost in the middle.
    Leaking,
}

impl Rewired {
    fn new(folder: &Path, format: AudioFormat, cable: CableState) -> Self {
        let params = params(format);
        // The file has to be there when the device is opened.
        std::fs::write(folder.join("in.raw"), vec![0; 1 << 16]).expect("written");
        let inner = audio_interface(&params, RATE_HZ).unwrap_or_else(|e| panic!("{e}"));
        Self { inner, folder: folder.to_owned(), format, cable }
    }

    fn file(&self, output: &[f32]) -> Vec<u8> {
        let total = output.len() + 40_000;
        let played = |n: usize| n.checked_sub(DELAY).and_then(|n| output.get(n)).copied().unwrap_or(0.0);
        let frames = (0..total).flat_map(|n| {
            let lost = usize::from(self.cable == CableState::Leaking && n > DELAY + output.len() / 2);
            let loopback = if self.cable == CableState::Missing { 0.0 } else { 0.5 * played(n + lost) };
            [0.125 * played(n), loopback]
        });
        frames.flat_map(|x| sample(x, self.format)).collect()
    }
}

impl AudioInterface for Rewired {
    fn rate_hz(&self) -> f64 {
        self.inner.rate_hz()
    }

    fn play_and_record(&mut self, output: &[f32], take: &mut AudioTake) -> Result<(), Error> {
        std::fs::write(self.folder.join("in.raw"), self.file(output)).expect("written");
        self.inner.play_and_record(output, take)
    }

    fn take_notices(&mut self) -> Vec<String> {
        self.inner.take_notices()
    }
}

fn params(format: AudioFormat) -> AlsaParams {
    AlsaParams { playback: "out".into(), capture: "in".into(), format, repeats: 1, ..AlsaParams::default() }
}

fn value(x: f32) -> i32 {
    (f64::from(x) * 8_388_608.0).round().clamp(-8_388_608.0, 8_388_607.0) as i32
}

fn sample(x: f32, format: AudioFormat) -> Vec<u8> {
    match format {
        AudioFormat::S32 => (value(x) << 8).to_le_bytes().to_vec(),
        AudioFormat::S24 => value(x).to_le_bytes().to_vec(),
        AudioFormat::S24Packed => value(x).to_le_bytes()[..3].to_vec(),
    }
}

fn sweep() -> Vec<f32> {
    (0..48_000).map(|n| n as f32).map(|n| 0.7 * (n * (0.13 + n * 2.5e-5)).sin()).collect()
}

fn checks(folder: &Path) {
    for format in [AudioFormat::S32, AudioFormat::S24, AudioFormat::S24Packed] {
        conformance::check_audio(&mut Rewired::new(folder, format, CableState::Plugged));
        takes_are_exact_to_the_sample(folder, format);
    }
    faults_are_named(folder);
    eprintln!("ALSA: 3 formats conform, takes are exact to the sample, 4 faults are named");
}

fn takes_are_exact_to_the_sample(folder: &Path, format: AudioFormat) {
    let (mut audio, mut take, output) =
        (Rewired::new(folder, format, CableState::Plugged), AudioTake::default(), sweep());
    let before = Timestamp::now();
    audio.play_and_record(&output, &mut take).unwrap_or_else(|e| panic!("{e}"));
    let gained = |gain: f32| output.iter().map(|x| value(gain * x)).collect::<Vec<_>>();
    assert_eq!(take.loopback, gained(0.5), "{format:?}: the loopback, bit by bit");
    assert_eq!(take.microphone, gained(0.125), "{format:?}: the microphone, bit by bit");
    assert!(take.started.expect("a time") > before);
    // What was played went out on every channel, bit by bit, and silence behind it.
    let expected: Vec<u8> = output.iter().flat_map(|x| sample(*x, format).repeat(2)).collect();
    let played = std::fs::read(folder.join("out.raw")).expect("what was played");
    assert_eq!(&played[..expected.len()], expected, "{format:?}");
    assert!(played[expected.len()..].iter().all(|byte| *byte == 0));
    assert!(audio.take_notices().is_empty());
}

fn faults_are_named(folder: &Path) {
    let check = |audio: &mut Rewired, expected: &str| {
        let error = audio.play_and_record(&sweep(), &mut AudioTake::default()).expect_err(expected).to_string();
        assert!(error.contains(expected), "{error}");
    };
    check(&mut Rewired::new(folder, AudioFormat::S32, CableState::Missing), "is its cable plugged in");
    let mut leaking = Rewired::new(folder, AudioFormat::S32, CableState::Leaking);
    check(&mut leaking, "2 takes in a row have gaps, the last: 1 samples went missing or came twice");
    assert_eq!(leaking.take_notices().len(), 1);

    let refused = |params: AlsaParams, rate_hz: f64, expected: &str| {
        let error = audio_interface(&params, rate_hz).err().expect(expected).to_string();
        assert!(error.starts_with("audio interface: ") && error.contains(expected), "{error}");
    };
    let absent = AlsaParams { capture: "hw:Scarlett".into(), ..params(AudioFormat::S32) };
    refused(absent, RATE_HZ, "cannot open `hw:Scarlett`");
    refused(params(AudioFormat::S32), 96_000.5, "no whole rate");
}
