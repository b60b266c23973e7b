//! Whole runs over the drivers, with something that is not hardware at the other end of each.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use echolake_panel::PanelSpecimen;
use echolake_panel::PreparedPanel;
use echolake_schema::devices::RosbridgeParams;
use echolake_schema::manifest::RunEnd;
use echolake_schema::messages::Measurement;
use echolake_schema::{Rig, Timestamp, topics};
use prost::Message as _;

use super::audio::AlignedAudio;
use super::audio::tests::{CableFault, LoopbackCable, since};
use super::rosbridge::RosbridgeRobots;
use super::rosbridge::fake::{BridgeFault, FakeBridge};
use super::serial::SerialSensor;
use super::serial::tests::{FakeSensor, GOOD, IMPATIENT_SECS, PATIENT_SECS};
use super::*;
use crate::rig::devices::{DeviceRequest, simulated_devices};
use crate::run::RunRequest;
use crate::run::controller::{
    Error as RunError, RecordingMode, RunControl, RunController, RunEvent, RunOptions, RunWorkload,
};
use crate::run::recorder::tests::create_flat;
use crate::run::recorder::{PairAttempts, Recorder};
use crate::run::session::{PreflightMode, RunSession, TakePace};

// A cable is no air: its sound comes at the wrong time for any distance.
const RIG: &str = "sweep.duration_secs = 0.1\nvalidation.attempts = 1\nvalidation.arrival_us = 1e6\n\
    [grid]\nclearance_mm = 0\npoints_mm = [[-62.5, 62.5, 124.0], [62.5, -62.5, 214.0], [0.0, 0.0, 304.0]]";

/// The far ends of the three devices.
struct FakeDevices {
    rig: Rig,
    bridge: FakeBridge,
    sensor: FakeSensor,
}

impl FakeDevices {
    fn new() -> Self {
        Self::of(RIG)
    }

    fn of(rig: &str) -> Self {
        Self {
            rig: Rig::from_toml(rig).expect("a rig"),
            bridge: FakeBridge::start("127.0.0.1:0").expect("a bridge"),
            sensor: FakeSensor::sending(GOOD),
        }
    }

    fn devices(&self, audio: AlignedAudio<LoopbackCable>) -> RigDevices {
        self.devices_with_sensor_timeout(audio, PATIENT_SECS)
    }

    fn devices_with_sensor_timeout(&self, audio: AlignedAudio<LoopbackCable>, sensor_secs: f64) -> RigDevices {
        let params =
            RosbridgeParams { url: self.bridge.url(), speed: 1.0, timeout_secs: PATIENT_SECS, ..Default::default() };
        let robots = RosbridgeRobots::connect(&params, Cell::from_rig(&self.rig)).expect("connected");
        RigDevices {
            robots: Box::new(robots),
            audio: Box::new(audio),
            sensor: Box::new(SerialSensor::open(&self.sensor.params(sensor_secs)).expect("open")),
            origin: Origin::Measured,
        }
    }
}

/// Result of a run, and the topics and contents of its file.
struct FinishedRun {
    outcome: Result<u64, RunError>,
    messages: Vec<(String, Vec<u8>)>,
}

impl FinishedRun {
    fn count(&self, topic: &str) -> usize {
        self.messages.iter().filter(|(of, _)| of == topic).count()
    }

    fn log(&self) -> String {
        let lines = self.messages.iter().filter(|(of, _)| of == topics::LOG);
        lines.map(|(_, data)| String::from_utf8_lossy(data).into_owned()).collect()
    }

    // The error that ended it, and the text of its log: a target that is refused ends no run.
    fn said(&self) -> String {
        let ended = self.outcome.as_ref().err().map(ToString::to_string).unwrap_or_default();
        ended + &self.log()
    }
}

fn begun(room: &FakeDevices, folder: &Path) -> Recorder {
    let (rig, start) = (&room.rig, Timestamp::now());
    let mut recorder = create_flat(&folder.join("run.mcap"), rig, start, Some(BTreeMap::new()));
    recorder.record_arms(start, Arc::new(Cell::from_rig(rig)), "rig").expect("recorded");
    recorder
}

// `progress` is called before each pair, and may pull plugs.
fn measure(
    room: &mut FakeDevices,
    devices: RigDevices,
    recorder: &mut Recorder,
    before: &BTreeMap<u32, PairAttempts>,
    progress: &mut dyn FnMut(&mut FakeDevices, usize),
) -> Result<RunEnd, RunError> {
    let rig = room.rig.clone();
    let grid = rig.build_grid().expect("a grid");
    let mut controller = RunController::new(&rig, devices).expect("a plan");
    let options = RunOptions { keep: RecordingMode::Sweeps, checkpoint_every: 1 };
    let mut begun = 0;
    let mut observe = |event: RunEvent<'_>| {
        if let RunEvent::Pair(_) = event {
            begun += 1;
            progress(room, begun);
        }
    };
    let work = RunWorkload { pairs: grid.pairs(), before, options };
    let outcome = controller.run(recorder, &work, &RunControl::default(), &mut observe);
    let _ = recorder.checkpoint();
    outcome.map(|outcome| outcome.end)
}

fn messages(path: &Path) -> Vec<(String, Vec<u8>)> {
    let file = std::fs::read(path).expect("the file");
    let cut_off = mcap::read::Options::IgnoreEndMagic.into();
    let messages = mcap::MessageStream::new_with_options(&file, cut_off).expect("an MCAP file").map_while(|m| m.ok());
    messages.map(|m| (m.channel.topic.clone(), m.data.to_vec())).collect()
}

fn run(room: &mut FakeDevices, devices: RigDevices, progress: &mut dyn FnMut(&mut FakeDevices, usize)) -> FinishedRun {
    let folder = tempfile::tempdir().expect("a folder");
    let mut recorder = begun(room, folder.path());
    let outcome = measure(room, devices, &mut recorder, &BTreeMap::new(), progress);
    FinishedRun { outcome: outcome.map(|end| end.attempts), messages: messages(recorder.partial()) }
}

#[test]
fn a_run_over_all_drivers_holds_what_they_told() {
    let mut room = FakeDevices::new();
    let devices = room.devices(since(Timestamp::now(), &[CableFault::Overrun]));
    let ended = run(&mut room, devices, &mut |_, _| ());
    assert_eq!(ended.outcome.as_ref().ok(), Some(&3), "{:?}", ended.outcome);
    for topic in [topics::TF, topics::MICROPHONE_JOINTS, topics::SPEAKER_JOINTS, topics::SWEEP, topics::MEASUREMENT] {
        assert_eq!(ended.count(topic), 3, "{topic}");
    }
    assert!(ended.log().contains("take repeated: overrun"), "{}", ended.log());
}

#[test]
fn a_real_panel_is_recorded_without_a_geometry_that_nobody_gave() {
    let room = FakeDevices::new();
    let (folder, rig) = (tempfile::tempdir().expect("a folder"), &room.rig);
    let surface = "flat".parse().expect("an id");
    let request = RunRequest::new(rig, surface, &PanelSpecimen::NoGeometry, Timestamp::now(), folder.path());
    let panel = PreparedPanel::new(request.specimen, rig).expect("a panel");
    let simulated = DeviceRequest { rig, panel: &panel, start: request.start, seed: 1, arms: None };
    let refused = simulated_devices(&simulated, TakePace::Fast).err().expect("no geometry").to_string();
    assert!(refused.contains("needs the panel's geometry"), "{refused}");
    let session = RunSession {
        control: &RunControl::default(),
        observe: &mut |_| {},
        tap: None,
        preflight: PreflightMode::Skip,
        checkpoint_every: None,
        pace: TakePace::Fast,
    };
    let devices = room.devices(since(request.start, &[]));
    let measured = request.measure_with(devices, &panel, None, session, Some(BTreeMap::new())).expect("a run");
    assert_eq!((measured.outcome.left, measured.outcome.end.accepted), (0, 3));
    let file = std::fs::read(&measured.path).expect("the run");
    let summary = mcap::Summary::read(&file).expect("sound").expect("a summary");
    let attached: Vec<_> = summary.attachment_indexes.iter().map(|attachment| attachment.name.as_str()).collect();
    assert_eq!(attached, [topics::RIG_ATTACHMENT, topics::SURFACE_ATTACHMENT]);
    let shown = messages(&measured.path).into_iter().filter(|(topic, _)| topic.starts_with("/panel"));
    assert_eq!(shown.count(), 0);
}

mod slow {
    use super::*;

    #[test]
    fn faults_in_mid_run_are_named_and_nothing_is_lost() {
        type Pull = fn(&mut FakeDevices);
        let check = |pull: Pull, expected: &str| {
            let mut room =
                FakeDevices::of(&RIG.replace("[0.0, 0.0, 304.0]", "[0.0, 0.0, 304.0], [-62.5, -62.5, 214.0]"));
            let devices = room.devices_with_sensor_timeout(since(Timestamp::now(), &[]), IMPATIENT_SECS);
            let ended = run(&mut room, devices, &mut |room, done| {
                // Good lines may be waiting yet: only the pair after this one is measured without any.
                if done == 3 {
                    pull(room);
                }
            });
            assert!(ended.said().contains(expected), "{expected}: {}", ended.said());
            assert!(ended.count(topics::MEASUREMENT) >= 2, "{expected}: what was measured before is kept");
        };
        check(|room| room.bridge.set_fault(BridgeFault::Refuses), "refuses the target");
        check(|room| room.bridge.set_fault(BridgeFault::NoPower), "the safety chain is open");
        check(|room| room.bridge.set_fault(BridgeFault::HangsUp), "robots: lost `ws://");
        check(|room| room.sensor.unplug(), "ambient sensor: lost `");
        check(|room| room.sensor.send("~~~\n"), "ambient sensor: nothing but nonsense");
    }

    #[test]
    fn a_run_that_lost_a_driver_is_gone_on_with() {
        let mut room = FakeDevices::new();
        let folder = tempfile::tempdir().expect("a folder");
        let mut recorder = begun(&room, folder.path());
        let devices = room.devices(since(Timestamp::now(), &[]));
        let broken = measure(&mut room, devices, &mut recorder, &BTreeMap::new(), &mut |room, done| {
            if done == 2 {
                room.bridge.set_fault(BridgeFault::HangsUp);
            }
        });
        assert!(broken.is_err_and(|e| e.to_string().contains("robots: lost `ws://")));
        let partial = recorder.partial().to_owned();
        drop(recorder);

        let mut room = FakeDevices::new();
        let (mut recorder, held) = Recorder::resume_recording(&partial).expect("gone on with");
        assert!((1..3).contains(&held.pairs.len()), "{:?}", held.pairs);
        let devices = room.devices(since(Timestamp::now(), &[]));
        let end = measure(&mut room, devices, &mut recorder, &held.pairs, &mut |_, _| ()).expect("a whole run");
        assert_eq!((end.accepted, end.rejected, end.attempts), (3, 0, 3));
        let path = recorder.finish(&end).expect("finished");
        echolake_recording::prove_file(&path).expect("a sound file");
        let verdicts = messages(&path).into_iter().filter(|(topic, _)| topic == topics::MEASUREMENT);
        let mut pairs: Vec<_> =
            verdicts.map(|(_, data)| Measurement::decode(data.as_slice()).expect("a verdict").pair_id).collect();
        pairs.sort_unstable();
        assert_eq!(pairs, [0, 1, 2], "every pair once");
    }
}
