//! Whole runs over the drivers, with something that is not hardware at the other end of each.

use std::collections::BTreeMap;
use std::sync::Arc;

use echolake_schema::devices::RosbridgeParams;
use echolake_schema::manifest::RunManifest;
use echolake_schema::{Rig, RunId, SurfaceRecord, Timestamp, topics};

use super::audio::Aligned;
use super::audio::tests::{Cable, Fault as AudioFault, since};
use super::rosbridge::RosbridgeRobots;
use super::rosbridge::fake::{FakeBridge, Fault};
use super::serial::SerialSensor;
use super::serial::tests::{FakeSensor, GOOD};
use super::*;
use crate::controller::{Control, Error as RunError, Event, Keep, RunController, RunOptions, Work};
use crate::recorder::{Recorder, RunStart};

// A cable is no air: its sound comes at the wrong time for any distance.
const RIG: &str = "sweep.duration_secs = 0.1\nvalidation.attempts = 1\nvalidation.arrival_us = 1e6\n[grid]\nclearance_mm = 0\npoints_mm = \
    [[-62.5, 62.5, 124.0], [62.5, -62.5, 214.0], [0.0, 0.0, 304.0]]";

/// The far ends of the three devices.
struct Room {
    rig: Rig,
    bridge: FakeBridge,
    sensor: FakeSensor,
}

impl Room {
    fn new() -> Self {
        Self {
            rig: Rig::from_toml(RIG).expect("a rig"),
            bridge: FakeBridge::start("127.0.0.1:0").expect("a bridge"),
            sensor: FakeSensor::sending(GOOD),
        }
    }

    fn devices(&self, audio: Aligned<Cable>) -> Devices {
        let params = RosbridgeParams { url: self.bridge.url(), speed: 1.0, timeout_secs: 1.0, ..Default::default() };
        let robots = RosbridgeRobots::connect(&params, Cell::of(&self.rig)).expect("connected");
        Devices {
            robots: Box::new(robots),
            audio: Box::new(audio),
            sensor: Box::new(SerialSensor::open(&self.sensor.params()).expect("open")),
            origin: Origin::Measured,
        }
    }
}

/// How a run ended, and the topics and contents of its file.
struct Ended {
    outcome: Result<u64, RunError>,
    messages: Vec<(String, Vec<u8>)>,
}

impl Ended {
    fn count(&self, topic: &str) -> usize {
        self.messages.iter().filter(|(of, _)| of == topic).count()
    }

    fn log(&self) -> String {
        let lines = self.messages.iter().filter(|(of, _)| of == topics::LOG);
        lines.map(|(_, data)| String::from_utf8_lossy(data).into_owned()).collect()
    }

    // What ended it, and what its log says: a target that is refused ends no run.
    fn said(&self) -> String {
        let ended = self.outcome.as_ref().err().map(ToString::to_string).unwrap_or_default();
        ended + &self.log()
    }
}

// `progress` is called before each pair, and may pull plugs.
fn run(room: &mut Room, devices: Devices, progress: &mut dyn FnMut(&mut Room, usize)) -> Ended {
    let folder = tempfile::tempdir().expect("a folder");
    let (rig, start) = (room.rig.clone(), Timestamp::now());
    let surface = "flat".parse().expect("an id");
    let manifest = RunManifest {
        run_id: RunId::compose(start, &surface, 1).expect("an id"),
        surface_id: surface,
        started: start,
        software: "test".into(),
        rig: rig.name.clone(),
        origin: devices.origin,
    };
    let begin =
        RunStart { manifest: &manifest, rig: &rig, surface: &SurfaceRecord::default(), relief: None, plan: None };
    let path = folder.path().join("run.mcap");
    let mut recorder = Recorder::create(&path, &begin).expect("a recorder");
    recorder.arms(start, Arc::new(Cell::of(&rig)), "rig").expect("recorded");
    let grid = rig.grid().expect("a grid");
    let mut controller = RunController::new(&rig, devices).expect("a plan");
    let options = RunOptions { keep: Keep::Sweeps, checkpoint_every: 1 };
    let work = Work { pairs: grid.pairs(), before: &BTreeMap::new(), options };
    let mut begun = 0;
    let mut observe = |event: Event<'_>| {
        if let Event::Pair(_) = event {
            begun += 1;
            progress(room, begun);
        }
    };
    let outcome = controller.run(&mut recorder, &work, &Control::default(), &mut observe);
    let _ = recorder.checkpoint();
    let file = std::fs::read(recorder.partial()).expect("the file");
    let cut_off = mcap::read::Options::IgnoreEndMagic.into();
    let messages = mcap::MessageStream::new_with_options(&file, cut_off).expect("an MCAP file").map_while(|m| m.ok());
    let messages = messages.map(|m| (m.channel.topic.clone(), m.data.to_vec())).collect();
    Ended { outcome: outcome.map(|outcome| outcome.end.attempts), messages }
}

#[test]
fn a_run_over_all_drivers_holds_what_they_told() {
    let mut room = Room::new();
    let devices = room.devices(since(Timestamp::now(), &[AudioFault::Overrun]));
    let ended = run(&mut room, devices, &mut |_, _| ());
    assert_eq!(ended.outcome.as_ref().ok(), Some(&3), "{:?}", ended.outcome);
    for topic in [topics::TF, topics::MICROPHONE_JOINTS, topics::SPEAKER_JOINTS, topics::SWEEP, topics::MEASUREMENT] {
        assert_eq!(ended.count(topic), 3, "{topic}");
    }
    assert!(ended.log().contains("take repeated: overrun"), "{}", ended.log());
}

#[test]
fn faults_in_mid_run_are_named_and_nothing_is_lost() {
    type Pull = fn(&mut Room);
    let check = |pull: Pull, expected: &str| {
        let mut room = Room::new();
        let devices = room.devices(since(Timestamp::now(), &[]));
        let ended = run(&mut room, devices, &mut |room, done| {
            // Good lines may be waiting yet: only the pair after the next is measured without one.
            if done == 2 {
                pull(room);
            }
        });
        assert!(ended.said().contains(expected), "{expected}: {}", ended.said());
        assert!(ended.count(topics::MEASUREMENT) >= 1, "{expected}: what was measured before is kept");
    };
    check(|room| room.bridge.set_fault(Fault::Refuses), "refuses the target");
    check(|room| room.bridge.set_fault(Fault::NoPower), "the safety chain is open");
    check(|room| room.bridge.set_fault(Fault::HangsUp), "robots: lost `ws://");
    check(|room| room.sensor.unplug(), "ambient sensor: lost `/dev/pts/");
    check(|room| room.sensor.send("~~~\n"), "ambient sensor: nothing but nonsense");
}
