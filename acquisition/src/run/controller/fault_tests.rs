//! Faults put into the simulated devices in mid-run: each is named, nothing that was acknowledged is lost, and the run
//! is resumed to its end.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use echolake_panel::material::SurfaceMaterial;
use echolake_panel::relief::PanelRelief;
use echolake_schema::manifest::Origin;
use echolake_schema::messages::{Measurement, Verdict};
use echolake_schema::{Rig, Timestamp, topics};
use prost::Message as _;

use super::*;
use crate::rig::devices::simulated::{RigSimulation, simulated_rig};
use crate::rig::{
    AmbientReading, AmbientSensor, ArmPositions, AudioInterface, AudioTake, Error as RigError, RigDevices, RobotArms,
};
use crate::run::preflight;
use crate::run::recorder::tests::create_flat;
use crate::run::recorder::{Held, Recorder};

/// Pairs of a run, and the one at which its fault begins.
const PAIRS: usize = 12;
const AT: u32 = 6;

/// A fault, as changes to the devices' answers.
#[derive(Clone, Copy)]
struct DeviceFault {
    reading: fn(Result<AmbientReading, RigError>) -> Result<AmbientReading, RigError>,
    take: fn(&mut AudioTake) -> Result<(), RigError>,
    refuse: bool,
}

const NONE: DeviceFault = DeviceFault { reading: |r| r, take: |_| Ok(()), refuse: false };

/// Devices that share the count of takes, and whether the fault is still there.
#[derive(Clone)]
struct SharedFault {
    fault: DeviceFault,
    takes: Arc<AtomicU32>,
    moves: Arc<AtomicU32>,
    mended: Arc<AtomicBool>,
}

impl SharedFault {
    fn is_on(&self, count: &AtomicU32) -> bool {
        count.load(Ordering::Relaxed) >= AT && !self.mended.load(Ordering::Relaxed)
    }
}

struct FaultySensor(Box<dyn AmbientSensor>, SharedFault);
struct FaultyAudio(Box<dyn AudioInterface>, SharedFault);
struct FaultyArms(Box<dyn RobotArms>, SharedFault);

impl AmbientSensor for FaultySensor {
    fn read_ambient(&mut self) -> Result<AmbientReading, RigError> {
        let reading = self.0.read_ambient();
        if self.1.is_on(&self.1.takes) { (self.1.fault.reading)(reading) } else { reading }
    }
}

impl AudioInterface for FaultyAudio {
    fn rate_hz(&self) -> f64 {
        self.0.rate_hz()
    }

    fn play_and_record(&mut self, output: &[f32], take: &mut AudioTake) -> Result<(), RigError> {
        self.0.play_and_record(output, take)?;
        self.1.takes.fetch_add(1, Ordering::Relaxed);
        if self.1.is_on(&self.1.takes) { (self.1.fault.take)(take) } else { Ok(()) }
    }
}

impl RobotArms for FaultyArms {
    fn move_to(&mut self, microphone_mm: [f64; 3], speaker_mm: [f64; 3]) -> Result<ArmPositions, RigError> {
        self.1.moves.fetch_add(1, Ordering::Relaxed);
        if self.1.fault.refuse && self.1.is_on(&self.1.moves) {
            return Err(RigError::Unreachable { microphone_mm, speaker_mm, reason: "joint 4 at its limit" });
        }
        self.0.move_to(microphone_mm, speaker_mm)
    }

    fn switch_drives(&mut self, power: DrivePower) -> Result<(), RigError> {
        self.0.switch_drives(power)
    }
}

fn rig() -> Rig {
    Rig::from_toml("sweep.duration_secs = 0.03").expect("a rig")
}

fn simulated(rig: &Rig, fault: DeviceFault, start: Timestamp, seed: u64) -> (RigDevices, SharedFault) {
    let relief = PanelRelief::Flat.height_field(60);
    let material = SurfaceMaterial::CoatedPrint;
    let inner =
        simulated_rig(&RigSimulation { rig, relief: &relief, material, start, seed, arms: None }).expect("devices");
    let shared = SharedFault { fault, takes: Arc::default(), moves: Arc::default(), mended: Arc::default() };
    let faulty = RigDevices {
        robots: Box::new(FaultyArms(inner.robots, shared.clone())),
        audio: Box::new(FaultyAudio(inner.audio, shared.clone())),
        sensor: Box::new(FaultySensor(inner.sensor, shared.clone())),
        origin: Origin::Simulated,
    };
    (faulty, shared)
}

fn start() -> Timestamp {
    Timestamp(1_767_600_000_000_000_000)
}

fn begun(path: &std::path::Path, rig: &Rig) -> Recorder {
    create_flat(path, rig, start(), Some(BTreeMap::new()))
}

/// Runs into a fault, checks what is said of it, mends it, goes on, and checks the whole file. Returns its verdicts and
/// the lines of its log.
fn check(fault: DeviceFault, expected: &str) -> (Vec<Measurement>, Vec<String>) {
    let rig = rig();
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let mut acknowledged: Vec<Measurement> = Vec::new();
    let (faulty, _) = simulated(&rig, fault, start(), 3);
    let mut controller = RunController::new(&rig, faulty).expect("a controller");
    let pairs = controller.grid.pairs()[..PAIRS].to_vec();
    let options = RunOptions { keep: RecordingMode::Sweeps, checkpoint_every: 1 };
    let control = RunControl::default();
    let mut note = |event: RunEvent<'_>| {
        if let RunEvent::Safe { verdicts, .. } = event {
            acknowledged.extend_from_slice(verdicts);
        }
    };
    let nothing = BTreeMap::new();
    let mut recorder = begun(&path, &rig);
    let broken =
        controller.run(&mut recorder, &RunWorkload { pairs: &pairs, before: &nothing, options }, &control, &mut note);
    let error = broken.expect_err(expected).to_string();
    assert!(error.contains(expected), "{error}");
    drop(recorder);

    let partial = path.with_extension("mcap.partial");
    let held = Held::from_file(&partial).expect("what is held");
    let after = held.last.plus_secs(60.0);
    let (mended, shared) = simulated(&rig, fault, after, 4);
    shared.mended.store(true, Ordering::Relaxed);
    let mut controller = RunController::new(&rig, mended).expect("a controller");
    let (mut recorder, held) = Recorder::resume_recording(&partial).expect("gone on with");
    let work = RunWorkload { pairs: &pairs, before: &held.pairs, options };
    let outcome = controller.run(&mut recorder, &work, &control, &mut note).expect("a whole run");
    assert_eq!((outcome.left, outcome.end.accepted, outcome.end.rejected), (0, PAIRS as u64, 0));
    let path = recorder.finish(&outcome.end).expect("finished");
    echolake_recording::prove_file(&path).expect("a sound file");

    let file = std::fs::read(path).expect("the file");
    let (mut verdicts, mut lines) = (Vec::new(), Vec::new());
    for message in mcap::MessageStream::new(&file).expect("an MCAP file") {
        let message = message.expect("whole");
        match message.channel.topic.as_str() {
            topics::MEASUREMENT => verdicts.push(Measurement::decode(&message.data[..]).expect("a verdict")),
            topics::LOG => lines.push(String::from_utf8_lossy(&message.data).into_owned()),
            _ => {}
        }
    }
    let key = |m: &Measurement| (m.pair_id, m.attempt, m.verdict);
    let (kept, told): (Vec<_>, Vec<_>) = (verdicts.iter().map(key).collect(), acknowledged.iter().map(key).collect());
    assert_eq!(kept, told, "what was acknowledged is in the file, once and in its order");
    let mut accepted: Vec<_> =
        verdicts.iter().filter(|m| m.verdict() == Verdict::Accepted).map(|m| m.pair_id).collect();
    accepted.sort_unstable();
    assert_eq!(accepted, pairs.iter().map(|p| p.id.0).collect::<Vec<_>>(), "every pair once");
    assert!(lines.iter().any(|l| l.contains("broken off") && l.contains(expected)), "{lines:?}");
    (verdicts, lines)
}

#[test]
fn a_sensor_that_is_unplugged_is_named() {
    let gone = |_| Err(RigError::Device { device: "ambient sensor", reason: "the line is gone".into() });
    let (verdicts, _) = check(DeviceFault { reading: gone, ..NONE }, "ambient sensor: the line is gone");
    assert_eq!(verdicts.len(), PAIRS, "the take without a reading was not kept");
}

#[test]
fn a_sensor_that_talks_nonsense_is_named() {
    let nonsense = |r: Result<AmbientReading, RigError>| r.map(|r| AmbientReading { temperature_c: -999.0, ..r });
    let (verdicts, _) = check(DeviceFault { reading: nonsense, ..NONE }, "a temperature of -999 C is not plausible");
    assert!(verdicts.iter().any(|m| m.verdict() == Verdict::Rejected));
    let high = |r: Result<AmbientReading, RigError>| r.map(|r| AmbientReading { pressure_hpa: 1e9, ..r });
    check(DeviceFault { reading: high, ..NONE }, "a pressure of 1000000000 hPa is not plausible");
}

#[test]
fn a_loopback_that_is_missing_is_named() {
    let silent: fn(&mut AudioTake) -> Result<(), RigError> = |take| {
        take.loopback.fill(0);
        Ok(())
    };
    check(DeviceFault { take: silent, ..NONE }, "is the loopback cable in");
    let hum: fn(&mut AudioTake) -> Result<(), RigError> = |take| {
        take.loopback.iter_mut().enumerate().for_each(|(i, x)| *x = (i % 7) as i32 - 3);
        Ok(())
    };
    check(DeviceFault { take: hum, ..NONE }, "loopback does not match the played sweep");
}

#[test]
fn lasting_clipping_is_named() {
    let clipped: fn(&mut AudioTake) -> Result<(), RigError> = |take| {
        take.microphone[100..130].fill((1 << 23) - 1);
        Ok(())
    };
    check(DeviceFault { take: clipped, ..NONE }, "30 samples clipped");
}

#[test]
fn lasting_noise_outside_is_named() {
    let loud = |r: Result<AmbientReading, RigError>| r.map(|r| AmbientReading { outside_level_db: 81.0, ..r });
    check(DeviceFault { reading: loud, ..NONE }, "outside noise 81.0 dB, limit 65.0 dB; hint: wait until it is quiet");
}

#[test]
fn a_robot_that_refuses_is_named() {
    let (verdicts, _) = check(DeviceFault { refuse: true, ..NONE }, "joint 4 at its limit");
    // Of what was refused there is a verdict, and no second attempt in the same session.
    assert_eq!(verdicts.iter().filter(|m| m.verdict() == Verdict::Rejected).count(), 3);
}

#[test]
fn a_clock_that_goes_back_is_named() {
    let back: fn(&mut AudioTake) -> Result<(), RigError> = |take| {
        take.started = take.started.map(|at| at.plus_secs(-3_600.0));
        Ok(())
    };
    let (verdicts, _) = check(DeviceFault { take: back, ..NONE }, "the clock went back by 3587.");
    assert_eq!(verdicts.len(), PAIRS, "the take of the wrong time was not kept");
}

#[test]
fn an_overrun_is_taken_again() {
    let rig = rig();
    let folder = tempfile::tempdir().expect("a folder");
    // Every fourth take is lost.
    struct Lossy(Box<dyn AudioInterface>, u32);
    impl AudioInterface for Lossy {
        fn rate_hz(&self) -> f64 {
            self.0.rate_hz()
        }

        fn play_and_record(&mut self, output: &[f32], take: &mut AudioTake) -> Result<(), RigError> {
            self.0.play_and_record(output, take)?;
            self.1 += 1;
            if self.1.is_multiple_of(4) {
                Err(RigError::Device { device: "audio interface", reason: "overrun".into() })
            } else {
                Ok(())
            }
        }
    }
    let (mut devices, _) = simulated(&rig, NONE, start(), 3);
    devices.audio = Box::new(Lossy(devices.audio, 0));
    let mut controller = RunController::new(&rig, devices).expect("a controller");
    let pairs = controller.grid.pairs()[..PAIRS].to_vec();
    let mut recorder = begun(&folder.path().join("run.mcap"), &rig);
    let options = RunOptions { keep: RecordingMode::Sweeps, checkpoint_every: 5 };
    let work = RunWorkload { pairs: &pairs, before: &BTreeMap::new(), options };
    let outcome = controller.run(&mut recorder, &work, &RunControl::default(), &mut |_| {}).expect("a run");
    assert_eq!(outcome.end.accepted, PAIRS as u64);
    let file = std::fs::read(recorder.finish(&outcome.end).expect("finished")).expect("the file");
    let lost = mcap::MessageStream::new(&file).expect("an MCAP file").map(|m| m.expect("whole")).filter(|m| {
        String::from_utf8_lossy(&m.data).contains("a take was lost, and made again: audio interface: overrun")
    });
    assert_eq!(lost.count() as u64, outcome.end.attempts / 3, "every fourth of them");
}

#[test]
fn room_is_kept_for_one_more_take_as_it_is_recorded() {
    for keep in [RecordingMode::Sweeps, RecordingMode::ResponsesOnly] {
        let (rig, folder) = (rig(), tempfile::tempdir().expect("a folder"));
        let (devices, _) = simulated(&rig, NONE, start(), 3);
        let mut controller = RunController::new(&rig, devices).expect("a controller");
        let pairs = controller.grid.pairs()[..PAIRS].to_vec();
        let mut recorder = begun(&folder.path().join("run.mcap"), &rig);
        let options = RunOptions { keep, checkpoint_every: 1 };
        let (mut attempts, mut recorded) = (0u64, Vec::new());
        let mut observe = |event: RunEvent<'_>| match event {
            RunEvent::Attempt(_) => attempts += 1,
            RunEvent::Safe { cost, .. } => recorded.push((attempts, cost.bytes)),
            _ => {}
        };
        let work = RunWorkload { pairs: &pairs, before: &BTreeMap::new(), options };
        controller.run(&mut recorder, &work, &RunControl::default(), &mut observe).expect("a run");
        assert!(recorder.bytes_to_end() > 1 << 20);
        for two in recorded.windows(2).filter(|two| two[1].0 > two[0].0) {
            let each = (two[1].1 - two[0].1) / (two[1].0 - two[0].0);
            let most = keep.attempt_bytes(&rig);
            assert!((most - 8192..=most).contains(&each), "{each} {most}");
        }
    }
}

#[test]
fn what_is_not_fit_is_told_before_the_run() {
    let rig = rig();
    let told = |fault: DeviceFault| {
        let (devices, shared) = simulated(&rig, fault, start(), 3);
        shared.takes.store(AT, Ordering::Relaxed);
        let mut controller = RunController::new(&rig, devices).expect("a controller");
        let first = controller.grid.pairs()[0];
        preflight::check_devices(&mut controller, first).iter().map(ToString::to_string).collect::<Vec<_>>().join("\n")
    };
    assert_eq!(told(NONE), "");
    let gone = |_| Err(RigError::Device { device: "ambient sensor", reason: "no such port".into() });
    assert!(told(DeviceFault { reading: gone, ..NONE }).contains("no such port; hint: is it plugged in"));
    let nonsense = |r: Result<AmbientReading, RigError>| r.map(|r| AmbientReading { temperature_c: 4_000.0, ..r });
    assert!(told(DeviceFault { reading: nonsense, ..NONE }).contains("a temperature of 4000 C"));
    let clipped: fn(&mut AudioTake) -> Result<(), RigError> = |take| {
        take.microphone[100] = (1 << 23) - 1;
        Ok(())
    };
    assert!(told(DeviceFault { take: clipped, ..NONE }).contains("1 samples clipped; hint: lower the gain"));
    let silent: fn(&mut AudioTake) -> Result<(), RigError> = |take| {
        take.loopback.fill(0);
        Ok(())
    };
    assert!(told(DeviceFault { take: silent, ..NONE }).contains("loopback cable"));
}

#[test]
fn a_run_is_paused_and_continued_and_stopped() {
    let rig = rig();
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let (devices, _) = simulated(&rig, NONE, start(), 3);
    let mut controller = RunController::new(&rig, devices).expect("a controller");
    let pairs = controller.grid.pairs()[..PAIRS].to_vec();
    let mut recorder = begun(&path, &rig);
    let options = RunOptions { keep: RecordingMode::ResponsesOnly, checkpoint_every: 100 };
    let control = Arc::new(RunControl::default());
    let (mut tried, mut heard) = (0, Vec::new());
    let mut observe = |event: RunEvent<'_>| match event {
        RunEvent::Attempt(_) => {
            tried += 1;
            control.pause.store(tried == 3, Ordering::Relaxed);
            control.stop.store(tried == 7, Ordering::Relaxed);
        }
        RunEvent::Paused => {
            heard.push("paused".to_owned());
            let control = control.clone();
            std::thread::spawn(move || control.pause.store(false, Ordering::Relaxed));
        }
        RunEvent::Continued => heard.push("continued".to_owned()),
        RunEvent::Safe { verdicts, .. } => heard.push(format!("{} safe", verdicts.len())),
        RunEvent::Pair(_) => {}
    };
    let work = RunWorkload { pairs: &pairs, before: &BTreeMap::new(), options };
    let outcome = controller.run(&mut recorder, &work, &control, &mut observe).expect("stopped");
    assert_eq!((outcome.left, outcome.end.accepted), (PAIRS - 7, 7));
    assert_eq!(heard, ["3 safe", "paused", "continued", "4 safe"]);
    drop(recorder);
    let held = Held::from_file(&path.with_extension("mcap.partial")).expect("what is held");
    assert_eq!((held.accepted_count(), held.lost, held.damage.len()), (7, Vec::new(), 0));
}
