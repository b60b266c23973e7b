//! Runs on the simulated rig, whole and with faults put into its devices.

use std::sync::Arc;
use std::sync::atomic::AtomicU32;

use echolake_panel::material::SurfaceMaterial;
use echolake_panel::relief::PanelRelief;
use echolake_schema::messages::{ImpulseResponse, Message as RunMessage, SweepRecording};
use echolake_schema::topics;

use super::*;
use crate::rig::devices::simulated::{RigSimulation, simulated_rig};
use crate::rig::{AmbientReading, AmbientSensor, ArmPositions, AudioInterface, Error as RigError, RobotArms};
use crate::run::recorder::tests::create_flat;

/// An interface with something wrong on its first takes.
struct Faulty {
    inner: Box<dyn AudioInterface>,
    fault: fn(&mut AudioTake),
    takes: u32,
}

impl AudioInterface for Faulty {
    fn rate_hz(&self) -> f64 {
        self.inner.rate_hz()
    }

    fn play_and_record(&mut self, output: &[f32], take: &mut AudioTake) -> Result<(), RigError> {
        self.inner.play_and_record(output, take)?;
        if self.takes > 0 {
            self.takes -= 1;
            (self.fault)(take);
        }
        Ok(())
    }
}

/// An interface that clips in its second take.
struct SecondFaulty(Box<dyn AudioInterface>, u32);

impl AudioInterface for SecondFaulty {
    fn rate_hz(&self) -> f64 {
        self.0.rate_hz()
    }

    fn play_and_record(&mut self, output: &[f32], take: &mut AudioTake) -> Result<(), RigError> {
        self.0.play_and_record(output, take)?;
        self.1 += 1;
        if self.1 == 2 {
            take.microphone[100] = (1 << 23) - 1;
        }
        Ok(())
    }
}

/// An interface at another rate.
struct Slower(Box<dyn AudioInterface>);

impl AudioInterface for Slower {
    fn rate_hz(&self) -> f64 {
        self.0.rate_hz() / 2.0
    }

    fn play_and_record(&mut self, output: &[f32], take: &mut AudioTake) -> Result<(), RigError> {
        self.0.play_and_record(output, take)
    }
}

/// A sensor that does not hear what is outside.
struct Deaf(Box<dyn AmbientSensor>);

impl AmbientSensor for Deaf {
    fn read_ambient(&mut self) -> Result<AmbientReading, RigError> {
        Ok(AmbientReading { outside_level_db: f64::NAN, ..self.0.read_ambient()? })
    }
}

/// Arms that fail at their third move, and count how often they were switched off.
struct Failing {
    inner: Box<dyn RobotArms>,
    moves: u32,
    switched_off: Arc<AtomicU32>,
}

impl RobotArms for Failing {
    fn move_to(&mut self, microphone_mm: [f64; 3], speaker_mm: [f64; 3]) -> Result<ArmPositions, RigError> {
        self.moves += 1;
        match self.moves {
            3 => Err(RigError::Device { device: "left arm", reason: "protective stop".into() }),
            _ => self.inner.move_to(microphone_mm, speaker_mm),
        }
    }

    fn switch_drives(&mut self, power: DrivePower) -> Result<(), RigError> {
        if power == DrivePower::Off {
            self.switched_off.fetch_add(1, Ordering::Relaxed);
        }
        self.inner.switch_drives(power)
    }
}

fn quick() -> Rig {
    Rig::from_toml("sweep.duration_secs = 0.03").expect("a rig")
}

fn start() -> Timestamp {
    Timestamp(1_767_600_000_000_000_000)
}

fn simulated(rig: &Rig, material: SurfaceMaterial, seed: u64) -> RigDevices {
    let relief = PanelRelief::Flat.height_field(60);
    simulated_rig(&RigSimulation { rig, relief: &relief, material, start: start(), seed, arms: None }).expect("devices")
}

fn faulty(rig: &Rig, fault: fn(&mut AudioTake), takes: u32) -> RigDevices {
    let mut devices = simulated(rig, SurfaceMaterial::CoatedPrint, 3);
    devices.audio = Box::new(Faulty { inner: devices.audio, fault, takes });
    devices
}

/// A run's file, and how the run ended.
struct RecordedRun {
    end: Result<RunEnd, Error>,
    file: Vec<u8>,
}

impl RecordedRun {
    fn topics(&self) -> Vec<String> {
        self.raw().map(|m| m.channel.topic.clone()).collect()
    }

    fn all<M: RunMessage>(&self, topic: &str) -> Vec<M> {
        let of_topic = self.raw().filter(|m| m.channel.topic == topic);
        of_topic.map(|m| prost::Message::decode(&m.data[..]).expect("a message of this topic")).collect()
    }

    fn verdicts(&self) -> Vec<Measurement> {
        self.all(topics::MEASUREMENT)
    }

    fn counts(&self) -> (u64, u64, u64) {
        let end = self.end.as_ref().expect("a run");
        (end.accepted, end.rejected, end.attempts)
    }

    // A run that broke off has no end in its file.
    fn raw(&self) -> impl Iterator<Item = mcap::Message<'_>> {
        let cut_off = mcap::read::Options::IgnoreEndMagic.into();
        let messages = mcap::MessageStream::new_with_options(&self.file, cut_off).expect("an MCAP file");
        messages.map_while(|m| m.ok())
    }
}

fn record(rig: &Rig, devices: RigDevices, pairs: usize, keep: RecordingMode, stop_after: usize) -> RecordedRun {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let mut recorder = create_flat(&path, rig, start(), None);
    let mut controller = RunController::new(rig, devices).expect("a controller");
    let pairs: Vec<_> = controller.grid.pairs().iter().step_by(2951 / pairs).copied().take(pairs).collect();
    let (control, nothing) = (RunControl::default(), BTreeMap::new());
    let options = RunOptions { keep, checkpoint_every: 50 };
    let work = RunWorkload { pairs: &pairs, before: &nothing, options };
    let mut tried = 0;
    let mut observe = |event: RunEvent<'_>| {
        if matches!(event, RunEvent::Attempt(m) if m.verdict() != Verdict::Repeated) {
            tried += 1;
            control.stop.store(tried >= stop_after, Ordering::Relaxed);
        }
    };
    let outcome = controller.run(&mut recorder, &work, &control, &mut observe);
    let path = match &outcome {
        Ok(outcome) => recorder.finish(&outcome.end).expect("finished"),
        Err(_) => {
            drop(recorder);
            path.with_extension("mcap.partial")
        }
    };
    RecordedRun { end: outcome.map(|o| o.end), file: std::fs::read(path).expect("the file") }
}

fn run_of(rig: &Rig, devices: RigDevices, pairs: usize) -> RecordedRun {
    record(rig, devices, pairs, RecordingMode::ResponsesOnly, usize::MAX)
}

// Flat and Foam: the direct sound is there even where the surface swallows the rest.
#[test]
fn good_takes_are_accepted_at_once() {
    let rig = quick();
    for material in [SurfaceMaterial::CoatedPrint, SurfaceMaterial::MelamineFoam] {
        let run = run_of(&rig, simulated(&rig, material, 3), 40);
        assert_eq!(run.counts(), (40, 0, 40), "{:?}", run.verdicts());
        for v in run.verdicts() {
            assert!(v.snr_db > 30.0 && v.arrival_error_us.abs() < 12.0, "{v:?}");
        }
        assert_eq!(run.all::<ImpulseResponse>(topics::IR).len(), 40);
    }
}

#[test]
fn two_takes_that_differ_are_repeated() {
    let mut rig = quick();
    rig.sweep.repeat = 2;
    let devices = simulated(&rig, SurfaceMaterial::CoatedPrint, 3);
    let good = record(&rig, devices, 20, RecordingMode::Sweeps, usize::MAX);
    assert_eq!(good.counts(), (20, 0, 20), "{:?}", good.verdicts());
    let [first, second] = [topics::SWEEP, topics::SWEEP_REPEAT].map(|topic| good.all::<SweepRecording>(topic));
    assert_eq!((first.len(), second.len()), (20, 20));
    for (a, b) in first.iter().zip(&second) {
        assert!(a.pair_id == b.pair_id && a.attempt == b.attempt && a.microphone != b.microphone, "{}", a.pair_id);
    }
    // Noise, and air that gets warmer meanwhile.
    for v in good.verdicts() {
        let difference_db = v.repeat_difference_db.expect("two takes");
        assert!((-90.0..-50.0).contains(&difference_db), "{v:?}");
    }
    let gain: fn(&mut AudioTake) = |take| take.microphone.iter_mut().for_each(|x| *x = *x / 20 * 19);
    let run = run_of(&rig, faulty(&rig, gain, 1), 1);
    let verdicts = run.verdicts();
    assert_eq!(run.counts(), (1, 0, 2), "{verdicts:?}");
    // 20 log10 of a twentieth.
    assert!(verdicts[0].reasons[0].starts_with("two takes differ by -2"), "{verdicts:?}");
    assert!((verdicts[0].repeat_difference_db.expect("two takes") + 26.0).abs() < 2.0, "{verdicts:?}");
    // What is wrong with the second take alone counts, too.
    let mut devices = simulated(&rig, SurfaceMaterial::CoatedPrint, 3);
    devices.audio = Box::new(SecondFaulty(devices.audio, 0));
    let run = run_of(&rig, devices, 1);
    assert!(run.verdicts()[0].reasons.contains(&"1 samples clipped".to_owned()), "{:?}", run.verdicts());
}

fn check(fault: fn(&mut AudioTake), takes: u32, expected: &str) {
    let rig = quick();
    let run = run_of(&rig, faulty(&rig, fault, takes), 1);
    let (verdicts, counts) = (run.verdicts(), run.counts());
    let reasons = verdicts[0].reasons.join("; ");
    assert!(reasons.contains(expected), "{reasons}");
    if takes < 3 {
        assert_eq!(counts, (1, 0, u64::from(takes) + 1), "{verdicts:?}");
        assert_eq!(verdicts[0].verdict(), Verdict::Repeated);
    } else {
        assert_eq!(counts, (0, 1, 3));
        assert_eq!(verdicts[2].verdict(), Verdict::Rejected);
    }
}

#[test]
fn a_silent_loopback_is_noticed_and_given_up() {
    check(|take| take.loopback.fill(0), 9, "loopback");
}

#[test]
fn clipping_is_repeated() {
    check(|take| take.microphone[100] = (1 << 23) - 1, 1, "1 samples clipped");
}

#[test]
fn noise_is_repeated() {
    let noisy: fn(&mut AudioTake) = |take| {
        let mut state = 1u32;
        for x in &mut take.microphone {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            *x = (*x + (state >> 12) as i32 - (1 << 19)).clamp(-(1 << 23) + 1, (1 << 23) - 2);
        }
    };
    check(noisy, 2, "signal-to-noise ratio");
}

#[test]
fn a_displaced_microphone_is_noticed() {
    check(|take| take.microphone.rotate_right(4), 9, "direct sound");
}

// 20 samples are 71 mm, less than the grid's pitch: the arm stands at the wrong point.
#[test]
fn a_microphone_at_another_point_is_noticed() {
    check(|take| take.microphone.rotate_right(20), 9, "direct sound");
    check(|take| take.microphone.rotate_left(20), 9, "direct sound");
}

#[test]
fn a_take_of_the_wrong_length_is_given_up() {
    check(|take| take.microphone.truncate(100), 9, "100 samples, expected 3840");
}

#[test]
fn what_cannot_be_deconvolved_has_no_response() {
    let rig = quick();
    // The first pair is good, so that its response is at hand when the second pair's loopback is silent.
    let silent_later: fn(&mut AudioTake) = |take| {
        if take.started.is_some_and(|at| at > start().plus_secs(20.0)) {
            take.loopback.fill(0);
        }
    };
    let run = run_of(&rig, faulty(&rig, silent_later, 9), 2);
    assert_eq!(run.counts(), (1, 1, 4), "{:?}", run.verdicts());
    let pairs: Vec<_> = run.all::<ImpulseResponse>(topics::IR).iter().map(|ir| ir.pair_id).collect();
    assert_eq!(pairs, [run.verdicts()[0].pair_id]);
}

// About four in a thousand are spoiled, so 600 without one are as likely as 9 in 100, and the seed is fixed.
#[test]
fn what_something_outside_spoils_is_measured_again() {
    let rig = quick();
    let run = run_of(&rig, simulated(&rig, SurfaceMaterial::CoatedPrint, 5), 600);
    let (accepted, rejected, attempts) = run.counts();
    assert_eq!((accepted, rejected), (600, 0));
    let verdicts = run.verdicts();
    let spoiled: Vec<_> = verdicts.iter().filter(|v| v.verdict() == Verdict::Repeated).collect();
    assert!(!spoiled.is_empty());
    assert_eq!(attempts, 600 + spoiled.len() as u64);
    for v in spoiled {
        assert!(v.reasons.join("; ").contains("outside noise"), "{v:?}");
        assert!(verdicts.iter().any(|w| w.pair_id == v.pair_id && w.verdict() == Verdict::Accepted), "{v:?}");
    }
}

#[test]
fn a_sensor_that_does_not_know_is_no_reason_to_accept() {
    let rig = quick();
    let mut devices = simulated(&rig, SurfaceMaterial::CoatedPrint, 3);
    devices.sensor = Box::new(Deaf(devices.sensor));
    let run = run_of(&rig, devices, 1);
    assert_eq!(run.counts(), (0, 1, 3));
    assert_eq!(run.verdicts()[0].reasons, ["level outside unknown"]);
}

#[test]
fn an_interface_at_another_rate_is_refused() {
    let rig = quick();
    let mut devices = simulated(&rig, SurfaceMaterial::CoatedPrint, 3);
    devices.audio = Box::new(Slower(devices.audio));
    let error = RunController::new(&rig, devices).err().map(|e| e.to_string()).unwrap_or_default();
    assert!(error.contains("96000") && error.contains("48000"), "{error}");
}

#[test]
fn an_attempt_is_recorded_before_its_verdict() {
    let rig = quick();
    let run = record(&rig, simulated(&rig, SurfaceMaterial::CoatedPrint, 3), 2, RecordingMode::Sweeps, usize::MAX);
    let recorded = run.topics();
    let places =
        |topic: &str| recorded.iter().enumerate().filter(|(_, t)| *t == topic).map(|(i, _)| i).collect::<Vec<_>>();
    for rests_on in [topics::SWEEP, topics::SWEEP_AUDIO, topics::IR, topics::TF, topics::ENVIRONMENT] {
        let (before, verdicts) = (places(rests_on), places(topics::MEASUREMENT));
        assert_eq!(before.len(), 2, "{rests_on}");
        assert!(before.iter().zip(&verdicts).all(|(a, b)| a < b), "{rests_on}: {recorded:?}");
    }
    let rate = rig.sweep.rate_hz.get();
    for sweep in run.all::<SweepRecording>(topics::SWEEP) {
        assert_eq!([sweep.microphone.len(), sweep.loopback.len()], [3 * rig.recording_len(); 2]);
        assert_eq!((sweep.sample_rate_hz, sweep.sample_count as usize), (rate, rig.recording_len()));
    }
}

// Steps of a prime, so that all three bytes take all values over a take.
fn pattern(index: usize) -> i32 {
    (index as i32).wrapping_mul(104_729) << 8 >> 8
}

#[test]
fn samples_are_recorded_bit_by_bit() {
    let rig = quick();
    let fault = |take: &mut AudioTake| {
        take.microphone.iter_mut().enumerate().for_each(|(i, x)| *x = pattern(i));
        take.loopback.iter_mut().enumerate().for_each(|(i, x)| *x = pattern(i + 1));
    };
    let run = record(&rig, faulty(&rig, fault, 1), 1, RecordingMode::Sweeps, usize::MAX);
    let sweep = run.all::<SweepRecording>(topics::SWEEP).swap_remove(0);
    let expected: Vec<i32> = (0..=rig.recording_len()).map(pattern).collect();
    for (bytes, expected) in [(&sweep.microphone, &expected[..]), (&sweep.loopback, &expected[1..])] {
        let mut fractions = vec![0.0; rig.recording_len()];
        echolake_schema::samples::decode_samples(sweep.format(), bytes, &mut fractions).expect("samples");
        assert!(fractions.iter().zip(expected).all(|(y, x)| (y * 8_388_608.0) as i32 == *x));
    }
}

#[test]
fn a_stop_waits_for_its_pair() {
    let rig = quick();
    let run = record(&rig, simulated(&rig, SurfaceMaterial::CoatedPrint, 3), 9, RecordingMode::ResponsesOnly, 4);
    assert_eq!(run.counts(), (4, 0, 4));
    assert_eq!(run.verdicts().len(), 4);
}

#[test]
fn a_failing_device_ends_the_run_and_leaves_what_was_recorded() {
    let rig = quick();
    let (mut devices, switched_off) = (simulated(&rig, SurfaceMaterial::CoatedPrint, 3), Arc::new(AtomicU32::new(0)));
    devices.robots = Box::new(Failing { inner: devices.robots, moves: 0, switched_off: switched_off.clone() });
    let run = run_of(&rig, devices, 9);
    assert!(matches!(&run.end, Err(Error::Device(RigError::Device { device: "left arm", .. }))), "{:?}", run.end);
    assert_eq!(run.verdicts().len(), 2);
    assert_eq!(switched_off.load(Ordering::Relaxed), 3, "after two takes, and when it broke off");
    let log = run.raw().filter(|m| m.channel.topic == topics::LOG).last().expect("a line");
    assert!(String::from_utf8_lossy(&log.data).contains("protective stop"));
}

#[test]
fn the_same_seed_gives_the_same_file() {
    let rig = quick();
    let file = |seed| {
        record(&rig, simulated(&rig, SurfaceMaterial::CoatedPrint, seed), 5, RecordingMode::Sweeps, usize::MAX).file
    };
    assert!(file(1) == file(1));
    assert!(file(1) != file(2));
}
