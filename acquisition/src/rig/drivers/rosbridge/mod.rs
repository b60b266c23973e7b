//! Both arms behind a rosbridge (WebSocket, JSON): trajectories out, joint states in, motors on and off. The joints for
//! a pair, and the way there without touching, are computed here, by [`crate::rig::robots`].

pub mod fake;
#[cfg(test)]
mod tests;
pub mod wire;

use std::net::TcpStream;
use std::time::{Duration, Instant};

use echolake_schema::ErrorCause;
use echolake_schema::devices::RosbridgeParams;
use tungstenite::stream::MaybeTlsStream;
use tungstenite::{Message, WebSocket};

use crate::rig::robots::{ArmPose, Cell, Joints, SpeakerAim, plan_motion};
use crate::rig::{ArmPositions, DeviceFault, DrivePower, Error, RobotArms};
use wire::{ArmRole, BridgeMessage};

const DEVICE: &str = "robots";
/// Timeout of one wait for a message.
const PAUSE: Duration = Duration::from_millis(2);
/// Longest time in which pending messages are discarded.
const CLEARING: Duration = Duration::from_millis(500);
/// Least duration of a move, s: an arm does not start at once.
const LEAST_SECS: f64 = 0.05;
/// Joint states in a row that have to be near the target before it counts as reached.
const STANDS: usize = 3;

type BridgeSocket = WebSocket<MaybeTlsStream<TcpStream>>;

/// Two arms behind a rosbridge.
pub struct RosbridgeRobots {
    params: RosbridgeParams,
    cell: Cell,
    socket: Option<BridgeSocket>,
    power: DrivePower,
    calls: u32,
    joints: [Option<Joints>; 2],
    faults: [Option<String>; 2],
    notices: Vec<String>,
}

impl RosbridgeRobots {
    /// Connects, and waits until both arms have sent their joints. The motors stay as they are.
    ///
    /// # Errors
    /// [`Error::Device`] if the bridge or an arm does not answer.
    pub fn connect(params: &RosbridgeParams, cell: Cell) -> Result<Self, Error> {
        let mut robots = Self {
            params: params.clone(),
            cell,
            socket: None,
            power: DrivePower::Off,
            calls: 0,
            joints: [None; 2],
            faults: [None, None],
            notices: Vec::new(),
        };
        robots.current()?;
        Ok(robots)
    }

    fn connected(&mut self) -> Result<&mut BridgeSocket, Error> {
        if self.socket.is_none() {
            let url = &self.params.url;
            let failed = |cause: ErrorCause| {
                let text = format!("cannot reach `{url}`: {cause}; hint: is rosbridge running?");
                failure(DeviceFault::with_cause(text, cause))
            };
            let (socket, _) = tungstenite::connect(url).map_err(|e| failed(e.into()))?;
            match socket.get_ref() {
                MaybeTlsStream::Plain(stream) => stream.set_read_timeout(Some(PAUSE)).map_err(|e| failed(e.into()))?,
                _ => return Err(failed("only plain ws:// is spoken".into())),
            }
            self.socket = Some(socket);
            for message in wire::opening_messages(&self.params) {
                self.send(&message)?;
            }
        }
        self.socket.as_mut().ok_or_else(|| failure("no connection"))
    }

    fn send(&mut self, message: &serde_json::Value) -> Result<(), Error> {
        let text = message.to_string();
        let sent = self.connected()?.send(Message::text(text));
        sent.map_err(|e| self.lost(e))
    }

    // The next message, or nothing within a pause.
    fn receive(&mut self) -> Result<Option<BridgeMessage>, Error> {
        match self.connected()?.read() {
            Ok(Message::Text(text)) => match wire::parse_message(text.as_str(), &self.params) {
                Ok(incoming) => {
                    match &incoming {
                        BridgeMessage::Joints(side, joints) => self.joints[*side as usize] = Some(*joints),
                        BridgeMessage::Fault(side, why) => self.faults[*side as usize] = Some(why.clone()),
                        BridgeMessage::Well(side) => self.faults[*side as usize] = None,
                        _ => {}
                    }
                    Ok(Some(incoming))
                }
                Err(nonsense) => {
                    self.notices.push(format!("nonsense from `{}`: {nonsense}", self.params.url));
                    Ok(Some(BridgeMessage::Other))
                }
            },
            Ok(_) => Ok(None),
            Err(tungstenite::Error::Io(e))
                if matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut) =>
            {
                Ok(None)
            }
            Err(e) => Err(self.lost(e)),
        }
    }

    // The next call connects anew; until then the state of the motors is unknown.
    fn lost(&mut self, cause: tungstenite::Error) -> Error {
        self.socket = None;
        self.power = DrivePower::Off;
        let url = &self.params.url;
        let text = format!("lost `{url}`: {cause}; hint: is the controller still on, the cable plugged in?");
        failure(DeviceFault::with_cause(text, cause))
    }

    // Pending messages are old; each arm's next joint states are waited for.
    fn current(&mut self) -> Result<[Joints; 2], Error> {
        let cleared = Instant::now() + CLEARING;
        while self.receive()?.is_some() && Instant::now() < cleared {}
        self.joints = [None; 2];
        let end = self.deadline(0.0);
        loop {
            if let [Some(microphone), Some(speaker)] = self.joints {
                return Ok([microphone, speaker]);
            }
            if Instant::now() >= end {
                let silent = ArmRole::BOTH.into_iter().find(|side| self.joints[*side as usize].is_none());
                let name = silent.map_or("", |side| side.namespace(&self.params));
                let secs = self.params.timeout_secs;
                return Err(failure(format!(
                    "no joint states on `{name}/joint_states` for {secs} s; hint: is its driver up?"
                )));
            }
            self.receive()?;
        }
    }

    fn deadline(&self, secs: f64) -> Instant {
        Instant::now() + Duration::from_secs_f64(secs + self.params.timeout_secs)
    }

    // Brings both arms to these joints at the same time.
    fn drive(&mut self, target: &[Joints; 2]) -> Result<[Joints; 2], Error> {
        let from = self.current()?;
        let way = |i: usize| crate::rig::robots::arm::travel_secs(&from[i], &target[i]);
        let secs = (way(0).max(way(1)) / self.params.speed).max(LEAST_SECS);
        for side in ArmRole::BOTH {
            if way(side as usize) > 0.0 {
                self.send(&wire::trajectory_message(&self.params, side, &target[side as usize], secs))?;
            }
        }
        let (end, mut stands) = (self.deadline(secs), 0);
        while stands < STANDS {
            match self.receive()? {
                Some(BridgeMessage::Complaint(why)) => {
                    return Err(failure(format!("the bridge refuses the target: {why}")));
                }
                Some(BridgeMessage::Joints(..)) => stands = if self.farthest(target).1 { stands + 1 } else { 0 },
                _ => {}
            }
            if let Some((side, why)) =
                ArmRole::BOTH.into_iter().find_map(|s| Some((s, self.faults[s as usize].clone()?)))
            {
                return Err(failure(format!("`{}` refuses to move: {why}", side.namespace(&self.params))));
            }
            if Instant::now() >= end {
                let (words, _) = self.farthest(target);
                return Err(failure(format!(
                    "the target was refused or not reached in time: {words}; hint: are the motors on, is the cell free?"
                )));
            }
        }
        Ok([0, 1].map(|i| self.joints[i].unwrap_or(target[i])))
    }

    // The joint that is farthest from its target, in words, and whether all are near enough.
    fn farthest(&self, target: &[Joints; 2]) -> (String, bool) {
        let mut worst = (0.0, String::new());
        for side in ArmRole::BOTH {
            let Some(joints) = self.joints[side as usize] else { continue };
            for (i, (is, wanted)) in joints.iter().zip(target[side as usize]).enumerate() {
                let off = (is - wanted).abs().to_degrees();
                if off >= worst.0 {
                    let (name, joint) = (side.namespace(&self.params), &self.params.joint_names[i]);
                    worst = (off, format!("{joint} of `{name}` is {off:.2} degrees off"));
                }
            }
        }
        (worst.1, worst.0 <= self.params.tolerance_deg)
    }

    fn call(&mut self, side: ArmRole, service: &str) -> Result<(), Error> {
        self.calls += 1;
        let id = format!("echolake-{}", self.calls);
        self.send(&wire::trigger_call(&self.params, side, service, &id))?;
        let name = format!("{}/{service}", side.namespace(&self.params));
        let end = self.deadline(0.0);
        while Instant::now() < end {
            match self.receive()? {
                Some(BridgeMessage::Answer(of, true, _)) if of == id => return Ok(()),
                Some(BridgeMessage::Answer(of, false, why)) if of == id => {
                    return Err(failure(format!("`{name}` refuses: {why}")));
                }
                _ => {}
            }
        }
        Err(failure(format!("no answer from `{name}` for {} s", self.params.timeout_secs)))
    }
}

impl RobotArms for RosbridgeRobots {
    fn move_to(&mut self, microphone_mm: [f64; 3], speaker_mm: [f64; 3]) -> Result<ArmPositions, Error> {
        let refuse = |reason| Error::Unreachable { microphone_mm, speaker_mm, reason };
        if self.power == DrivePower::Off {
            return Err(refuse("the drives are off"));
        }
        let target = self.cell.reach_positions(microphone_mm, speaker_mm).map_err(|why| refuse(why.reason_text()))?;
        let [microphone, speaker] = self.current()?;
        let from = ArmPose { microphone, speaker, aim: SpeakerAim::Down };
        let motion =
            plan_motion(&self.cell, &from, &target).ok_or_else(|| refuse("no way there without touching is known"))?;
        let mut joints = [microphone, speaker];
        for stop in &motion.stops {
            joints = self.drive(stop)?;
        }
        let [microphone_mm, speaker_mm] = self.cell.positions_mm(&joints[0], &joints[1]);
        Ok(ArmPositions { microphone_mm, speaker_mm, joints: Some(joints) })
    }

    fn switch_drives(&mut self, power: DrivePower) -> Result<(), Error> {
        let service = match power {
            DrivePower::On => "robot_enable",
            DrivePower::Off => "robot_disable",
        };
        for side in ArmRole::BOTH {
            self.call(side, service)?;
        }
        self.power = power;
        Ok(())
    }

    fn take_notices(&mut self) -> Vec<String> {
        std::mem::take(&mut self.notices)
    }
}

fn failure(reason: impl Into<DeviceFault>) -> Error {
    Error::Device { device: DEVICE, reason: reason.into() }
}
