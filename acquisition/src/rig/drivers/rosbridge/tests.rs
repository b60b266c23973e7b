//! The driver against the fake bridge, well and with everything that can go wrong.

use echolake_schema::Rig;

use super::fake::{BridgeFault, FakeBridge};
use super::*;
use crate::rig::conformance;

/// For answers that come: a busy machine needs some of it.
const PATIENT_SECS: f64 = 60.0;
/// For answers that never come, which is what the test is about.
const IMPATIENT_SECS: f64 = 1.0;
const NEAR: [[f64; 3]; 2] = [[-62.5, 62.5, 124.0], [62.5, -62.5, 214.0]];

fn bridge() -> FakeBridge {
    FakeBridge::start("127.0.0.1:0").expect("a bridge")
}

fn connected(bridge: &FakeBridge) -> RosbridgeRobots {
    let params =
        RosbridgeParams { url: bridge.url(), speed: 1.0, timeout_secs: PATIENT_SECS, ..RosbridgeParams::default() };
    RosbridgeRobots::connect(&params, Cell::from_rig(&Rig::paper())).expect("connected")
}

#[test]
fn it_conforms() {
    let bridge = bridge();
    let mut robots = connected(&bridge);
    conformance::check_robots(&mut robots, NEAR, [NEAR[0], [0.0, 0.0, 5_000.0]]);
    conformance::check_robots(&mut robots, NEAR, [NEAR[0], NEAR[0]]);
    assert!(bridge.has_power());
    robots.switch_drives(DrivePower::Off).expect("a switch");
    assert!(!bridge.has_power());
}

#[test]
fn joints_are_those_that_the_arms_told() {
    let bridge = bridge();
    let mut robots = connected(&bridge);
    robots.switch_drives(DrivePower::On).expect("a switch");
    let reached = robots.move_to(NEAR[0], NEAR[1]).expect("reached");
    let joints = reached.joints.expect("joints");
    let wanted = Cell::from_rig(&Rig::paper()).reach_positions(NEAR[0], NEAR[1]).expect("within reach");
    for (is, wanted) in joints.iter().flatten().zip(wanted.microphone.iter().chain(&wanted.speaker)) {
        assert!((is - wanted).abs().to_degrees() < 0.02, "{is} {wanted}");
    }
}

#[test]
fn motors_that_stay_off_are_named() {
    let bridge = bridge();
    let mut robots = connected(&bridge);
    bridge.set_fault(BridgeFault::NoPower);
    let error = robots.switch_drives(DrivePower::On).expect_err("refused").to_string();
    assert!(error.contains("`/microphone/robot_enable` refuses: the safety chain is open"), "{error}");
    let error = robots.move_to(NEAR[0], NEAR[1]).expect_err("no power").to_string();
    assert!(error.contains("the drives are off"), "{error}");
}

#[test]
fn a_bridge_that_is_not_there_is_named() {
    let params = RosbridgeParams { url: "ws://127.0.0.1:1".into(), ..RosbridgeParams::default() };
    let error = RosbridgeRobots::connect(&params, Cell::from_rig(&Rig::paper())).err().expect("nobody").to_string();
    assert!(error.contains("cannot reach `ws://127.0.0.1:1`") && error.contains("is rosbridge running"), "{error}");
}

mod slow {
    use super::*;

    #[test]
    fn faults_are_named() {
        let check = |fault, expected: &str| {
            let bridge = bridge();
            let mut robots = connected(&bridge);
            robots.switch_drives(DrivePower::On).expect("a switch");
            bridge.set_fault(fault);
            robots.params.timeout_secs = IMPATIENT_SECS;
            let error = robots.move_to(NEAR[0], NEAR[1]).expect_err(expected).to_string();
            robots.params.timeout_secs = PATIENT_SECS;
            assert!(error.starts_with("robots: ") && error.contains(expected), "{fault:?}: {error}");
            // Back to normal, the next try does; after a lost connection the motors have to be switched on again.
            bridge.set_fault(BridgeFault::None);
            robots.switch_drives(DrivePower::On).expect("a switch");
            robots.move_to(NEAR[0], NEAR[1]).unwrap_or_else(|e| panic!("{fault:?}: {e}"));
        };
        check(BridgeFault::Refuses, "the bridge refuses the target: the target is outside of the joints' ranges");
        check(BridgeFault::StopsHalfWay, "degrees off; hint: are the motors on");
        check(BridgeFault::EmergencyStop, "refuses to move: emergency stop");
        check(BridgeFault::Silent, "no joint states on `/microphone/joint_states`");
        check(BridgeFault::HangsUp, "is the controller still on");
        check(BridgeFault::Nonsense, "no joint states on");
    }

    #[test]
    fn nonsense_is_told_of() {
        let bridge = bridge();
        let mut robots = connected(&bridge);
        bridge.set_fault(BridgeFault::Nonsense);
        robots.params.timeout_secs = IMPATIENT_SECS;
        let _ = robots.current();
        assert!(robots.take_notices().iter().any(|n| n.contains("no JSON")));
    }
}
