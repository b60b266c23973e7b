//! A rosbridge with two fake arms behind it: for tests, and for trying clients out. It speaks protocol v2 over
//! WebSocket: `subscribe`, `advertise`, `publish`, `call_service`.

use std::io::ErrorKind;
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tungstenite::{Message, WebSocket};

use crate::rig::robots::{ArmPose, Joints};

/// Interval between two joint states.
const TICK: Duration = Duration::from_millis(20);
/// Timeout of one wait for a client's message.
const PAUSE: Duration = Duration::from_millis(5);
/// Timeout of a client's handshake and of writes to it.
const CLIENT_LIMIT: Duration = Duration::from_secs(30);
/// Namespaces of the two arms.
const NAMES: [&str; 2] = ["/microphone", "/speaker"];

/// A fault of the fake arms or their bridge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BridgeFault {
    /// Nothing.
    None,
    /// The bridge answers trajectories with an error.
    Refuses,
    /// Arms stop half-way.
    StopsHalfWay,
    /// The emergency stop is pressed.
    EmergencyStop,
    /// Joint states stop.
    Silent,
    /// Motors cannot be switched on.
    NoPower,
    /// The connection is closed at the next message.
    HangsUp,
    /// Messages are not JSON.
    Nonsense,
}

/// A fake rosbridge; it ends when it is dropped.
pub struct FakeBridge {
    address: SocketAddr,
    world: Arc<Mutex<FakeWorld>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

struct FakeWorld {
    arms: [FakeArm; 2],
    fault: BridgeFault,
}

/// An arm on its way from one pose to another.
struct FakeArm {
    from: Joints,
    to: Joints,
    began: Instant,
    secs: f64,
    power: bool,
}

impl FakeArm {
    fn current_joints(&self, fault: BridgeFault) -> Joints {
        let share = if self.secs > 0.0 { (self.began.elapsed().as_secs_f64() / self.secs).min(1.0) } else { 1.0 };
        let share = if fault == BridgeFault::StopsHalfWay { share.min(0.5) } else { share };
        std::array::from_fn(|i| self.from[i] + share * (self.to[i] - self.from[i]))
    }
}

impl FakeBridge {
    /// Listens on an address; port 0 is any.
    ///
    /// # Errors
    /// The system's.
    pub fn start(address: &str) -> std::io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?;
        let home = ArmPose::at_home();
        let arm = |at| FakeArm { from: at, to: at, began: Instant::now(), secs: 0.0, power: false };
        let world = Arc::new(Mutex::new(FakeWorld {
            arms: [arm(home.microphone), arm(home.speaker)],
            fault: BridgeFault::None,
        }));
        let stop = Arc::new(AtomicBool::new(false));
        let theirs = world.clone();
        let stopped = stop.clone();
        let thread = std::thread::spawn(move || accept_clients(&listener, &theirs, &stopped));
        Ok(Self { address, world, stop, thread: Some(thread) })
    }

    /// Its address for clients.
    pub fn url(&self) -> String {
        format!("ws://{}", self.address)
    }

    /// Sets the fault from now on.
    pub fn set_fault(&self, fault: BridgeFault) {
        lock_world(&self.world).fault = fault;
    }

    /// Returns whether both arms' motors are on.
    pub fn has_power(&self) -> bool {
        lock_world(&self.world).arms.iter().all(|arm| arm.power)
    }
}

impl Drop for FakeBridge {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

fn lock_world(world: &Mutex<FakeWorld>) -> MutexGuard<'_, FakeWorld> {
    world.lock().unwrap_or_else(PoisonError::into_inner)
}

fn accept_clients(listener: &TcpListener, world: &Arc<Mutex<FakeWorld>>, stop: &Arc<AtomicBool>) {
    let mut clients = Vec::new();
    while !stop.load(Ordering::Relaxed) {
        match listener.accept() {
            Ok((stream, _)) => {
                let world = world.clone();
                let stop = stop.clone();
                clients.push(std::thread::spawn(move || BridgeClient::serve_client(stream, &world, &stop)));
            }
            Err(_) => std::thread::sleep(PAUSE),
        }
    }
    clients.into_iter().for_each(|client| drop(client.join()));
}

struct BridgeClient {
    socket: WebSocket<TcpStream>,
    topics: Vec<String>,
}

impl BridgeClient {
    fn serve_client(stream: TcpStream, world: &Mutex<FakeWorld>, stop: &AtomicBool) {
        let set = stream
            .set_nonblocking(false)
            .and_then(|()| stream.set_nodelay(true))
            .and_then(|()| stream.set_read_timeout(Some(CLIENT_LIMIT)))
            .and_then(|()| stream.set_write_timeout(Some(CLIENT_LIMIT)));
        let Ok(socket) = set.map_err(drop).and_then(|()| tungstenite::accept(stream).map_err(drop)) else { return };
        if socket.get_ref().set_read_timeout(Some(PAUSE)).is_err() {
            return;
        }
        let mut client = Self { socket, topics: Vec::new() };
        let mut next = Instant::now();
        while !stop.load(Ordering::Relaxed) {
            match client.socket.read() {
                Ok(Message::Text(text)) => {
                    if lock_world(world).fault == BridgeFault::HangsUp {
                        return;
                    }
                    let answer = client.answer_message(text.as_str(), world);
                    if answer.is_some_and(|answer| client.send_text(&answer.to_string()).is_err()) {
                        return;
                    }
                }
                Ok(_) => {}
                Err(tungstenite::Error::Io(e)) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
                Err(_) => return,
            }
            if Instant::now() >= next {
                next = Instant::now() + TICK;
                if client.publish_states(world).is_err() {
                    return;
                }
            }
        }
    }

    fn send_text(&mut self, text: &str) -> Result<(), tungstenite::Error> {
        self.socket.send(Message::text(text))
    }

    fn publish_states(&mut self, world: &Mutex<FakeWorld>) -> Result<(), tungstenite::Error> {
        let (fault, joints) = {
            let world = lock_world(world);
            (world.fault, [0, 1].map(|i| world.arms[i].current_joints(world.fault)))
        };
        let names: Vec<_> = (1..=6).map(|i| format!("joint_{i}")).collect();
        for (name, joints) in NAMES.iter().zip(joints) {
            let header = json!({"seq": 0, "stamp": {"secs": 0, "nsecs": 0}, "frame_id": ""});
            let states = json!({"header": header, "name": names, "position": joints, "velocity": [], "effort": []});
            let stopped = i32::from(fault == BridgeFault::EmergencyStop);
            let status =
                json!({"header": header, "e_stopped": {"val": stopped}, "in_error": {"val": 0}, "error_code": 0});
            for (topic, message) in [("joint_states", states), ("robot_status", status)] {
                let topic = format!("{name}/{topic}");
                if !self.topics.contains(&topic) || (fault == BridgeFault::Silent && topic.ends_with("joint_states")) {
                    continue;
                }
                match fault {
                    BridgeFault::Nonsense => self.send_text("\u{fffd}{\"op\":")?,
                    _ => self.send_text(&json!({"op": "publish", "topic": topic, "msg": message}).to_string())?,
                }
            }
        }
        Ok(())
    }

    fn answer_message(&mut self, text: &str, world: &Mutex<FakeWorld>) -> Option<Value> {
        let complaint = |words: &str| Some(json!({"op": "status", "level": "error", "msg": words}));
        let Ok(message) = serde_json::from_str::<Value>(text) else { return complaint("no JSON") };
        let topic = || message["topic"].as_str().unwrap_or_default().to_owned();
        match message["op"].as_str() {
            Some("subscribe") => {
                self.topics.push(topic());
                None
            }
            Some("unsubscribe") => {
                self.topics.retain(|t| *t != topic());
                None
            }
            Some("publish") => follow_trajectory(&topic(), &message["msg"], &mut lock_world(world)).and_then(complaint),
            Some("call_service") => {
                let (success, words) =
                    switch_motors(message["service"].as_str().unwrap_or_default(), &mut lock_world(world));
                Some(json!({"op": "service_response", "id": message["id"], "service": message["service"],
                    "values": {"success": success, "message": words}, "result": true}))
            }
            Some("advertise" | "unadvertise" | "set_level") => None,
            _ => complaint("unknown op"),
        }
    }
}

// Starts an arm's move; returns a complaint if it is refused.
fn follow_trajectory(topic: &str, message: &Value, world: &mut FakeWorld) -> Option<&'static str> {
    let Some(i) = NAMES.iter().position(|n| topic.strip_prefix(n) == Some("/joint_path_command")) else {
        return Some("nobody listens to this topic");
    };
    let fault = world.fault;
    let arm = &mut world.arms[i];
    if fault == BridgeFault::Refuses {
        return Some("the target is outside of the joints' ranges");
    }
    if !arm.power {
        return Some("the motors are off");
    }
    let point = &message["points"][0];
    let positions: Vec<f64> = point["positions"].as_array().into_iter().flatten().filter_map(Value::as_f64).collect();
    let Ok(target) = <Joints>::try_from(positions) else { return Some("expected six positions") };
    let time = &point["time_from_start"];
    let part = |name: &str| time[name].as_f64().unwrap_or(0.0);
    (arm.from, arm.to, arm.began) = (arm.current_joints(fault), target, Instant::now());
    arm.secs = part("secs") + part("nsecs") / 1e9;
    None
}

fn switch_motors(service: &str, world: &mut FakeWorld) -> (bool, &'static str) {
    let Some((i, verb)) = NAMES.iter().enumerate().find_map(|(i, n)| Some((i, service.strip_prefix(n)?))) else {
        return (false, "no such service");
    };
    match verb {
        "/robot_enable" if world.fault == BridgeFault::NoPower => (false, "the safety chain is open"),
        "/robot_enable" | "/robot_disable" => {
            world.arms[i].power = verb == "/robot_enable";
            (true, "")
        }
        _ => (false, "no such service"),
    }
}
