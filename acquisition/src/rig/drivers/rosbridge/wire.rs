//! rosbridge's JSON (protocol v2): the messages that are sent, and the answers as far as the driver needs them.

use echolake_schema::devices::RosbridgeParams;
use serde_json::{Value, json};

use crate::rig::robots::Joints;

/// One of the two arms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ArmRole {
    /// The microphone's.
    Microphone,
    /// The speaker's.
    Speaker,
}

impl ArmRole {
    /// Both, in the order of joints.
    pub const BOTH: [Self; 2] = [Self::Microphone, Self::Speaker];

    /// Its namespace.
    pub fn namespace(self, params: &RosbridgeParams) -> &str {
        match self {
            Self::Microphone => &params.microphone,
            Self::Speaker => &params.speaker,
        }
    }
}

/// A message from the bridge.
#[derive(Debug, Clone, PartialEq)]
pub enum BridgeMessage {
    /// An arm's joints.
    Joints(ArmRole, Joints),
    /// An arm has stopped by itself, with the reason.
    Fault(ArmRole, String),
    /// An arm has no fault.
    Well(ArmRole),
    /// An answer to a call: its id, whether it succeeded, and its text.
    Answer(String, bool, String),
    /// The bridge reports an error.
    Complaint(String),
    /// A message without use here.
    Other,
}

/// Returns the messages that open a session: subscriptions to joints and states, announcement of trajectories.
pub fn opening_messages(params: &RosbridgeParams) -> Vec<Value> {
    let topics = |side: ArmRole| {
        let name = side.namespace(params);
        [
            json!({"op": "subscribe", "topic": format!("{name}/joint_states"), "type": "sensor_msgs/JointState",
                "throttle_rate": 20, "queue_length": 1}),
            json!({"op": "subscribe", "topic": format!("{name}/robot_status"), "type": "industrial_msgs/RobotStatus",
                "throttle_rate": 100, "queue_length": 1}),
            json!({"op": "advertise", "topic": format!("{name}/joint_path_command"),
                "type": "trajectory_msgs/JointTrajectory"}),
        ]
    };
    let warnings = [json!({"op": "set_level", "level": "warning"})];
    warnings.into_iter().chain(ArmRole::BOTH.into_iter().flat_map(topics)).collect()
}

/// Returns a trajectory of one point, from the arm's current joints.
pub fn trajectory_message(params: &RosbridgeParams, side: ArmRole, target: &Joints, secs: f64) -> Value {
    let still: Joints = [0.0; 6];
    let point = json!({
        "positions": target, "velocities": still, "accelerations": [], "effort": [],
        "time_from_start": {"secs": secs.floor(), "nsecs": (secs.fract() * 1e9).floor()},
    });
    json!({"op": "publish", "topic": format!("{}/joint_path_command", side.namespace(params)), "msg": {
        "header": {"seq": 0, "stamp": {"secs": 0, "nsecs": 0}, "frame_id": ""},
        "joint_names": params.joint_names, "points": [point],
    }})
}

/// A call of `std_srvs/Trigger`.
pub fn trigger_call(params: &RosbridgeParams, side: ArmRole, service: &str, id: &str) -> Value {
    json!({"op": "call_service", "id": id, "service": format!("{}/{service}", side.namespace(params)),
        "type": "std_srvs/Trigger", "args": {}})
}

/// Reads a message.
///
/// # Errors
/// A text that names the fault in the message.
pub fn parse_message(text: &str, params: &RosbridgeParams) -> Result<BridgeMessage, String> {
    let value: Value = serde_json::from_str(text).map_err(|e| format!("no JSON: {e}"))?;
    let word = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    match value["op"].as_str() {
        Some("publish") => parse_published(&value["topic"], &value["msg"], params),
        Some("service_response") => {
            let said = &value["values"];
            // The bridge reports whether the call came through, the service whether it succeeded.
            let done = value["result"].as_bool().unwrap_or(true) && said["success"].as_bool().unwrap_or(true);
            let words = if said.is_string() { word(said) } else { word(&said["message"]) };
            Ok(BridgeMessage::Answer(word(&value["id"]), done, words))
        }
        Some("status") => match value["level"].as_str() {
            Some("error" | "warning") => Ok(BridgeMessage::Complaint(word(&value["msg"]))),
            _ => Ok(BridgeMessage::Other),
        },
        Some(_) => Ok(BridgeMessage::Other),
        None => Err("a message without `op`".into()),
    }
}

fn parse_published(topic: &Value, message: &Value, params: &RosbridgeParams) -> Result<BridgeMessage, String> {
    let topic = topic.as_str().unwrap_or_default();
    for side in ArmRole::BOTH {
        match topic.strip_prefix(side.namespace(params)) {
            Some("/joint_states") => {
                return parse_joints(message, params).map(|joints| BridgeMessage::Joints(side, joints));
            }
            Some("/robot_status") => return Ok(parse_status(side, message)),
            _ => {}
        }
    }
    Ok(BridgeMessage::Other)
}

// Joints may come in any order, and among others.
fn parse_joints(message: &Value, params: &RosbridgeParams) -> Result<Joints, String> {
    let empty = Vec::new();
    let list = |name: &str| message[name].as_array().unwrap_or(&empty);
    let mut found = [0.0; 6];
    for (wanted, found) in params.joint_names.iter().zip(&mut found) {
        let at = list("name").iter().position(|name| name.as_str() == Some(wanted));
        let position = at.and_then(|at| list("position").get(at)).and_then(Value::as_f64).filter(|x| x.abs() < 100.0);
        *found = position.ok_or_else(|| format!("joint states without a position of `{wanted}`"))?;
    }
    Ok(found)
}

// industrial_msgs/RobotStatus: three-valued, -1 unknown, 0 no, 1 yes.
fn parse_status(side: ArmRole, message: &Value) -> BridgeMessage {
    let is = |name: &str| message[name]["val"].as_i64() == Some(1);
    match () {
        () if is("e_stopped") => BridgeMessage::Fault(side, "emergency stop".into()),
        () if is("in_error") => BridgeMessage::Fault(side, format!("error {}", message["error_code"])),
        () => BridgeMessage::Well(side),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_read() {
        let params = RosbridgeParams::default();
        let check = |text: &str, expected: Result<BridgeMessage, &str>| match (parse_message(text, &params), expected) {
            (Ok(found), Ok(expected)) => assert_eq!(found, expected, "{text}"),
            (Err(found), Err(expected)) => assert!(found.contains(expected), "{text}: {found}"),
            (found, expected) => panic!("{text}: {found:?}, expected {expected:?}"),
        };
        let states = r#"{"op":"publish","topic":"/speaker/joint_states","msg":{"name":["joint_6","gripper","joint_5",
            "joint_4","joint_3","joint_2","joint_1"],"position":[6,9,5,4,3,2,1.5]}}"#;
        check(states, Ok(BridgeMessage::Joints(ArmRole::Speaker, [1.5, 2.0, 3.0, 4.0, 5.0, 6.0])));
        check(
            r#"{"op":"publish","topic":"/speaker/joint_states","msg":{"name":["joint_1"],"position":["x"]}}"#,
            Err("`joint_1`"),
        );
        let stopped = r#"{"op":"publish","topic":"/microphone/robot_status","msg":{"e_stopped":{"val":1}}}"#;
        check(stopped, Ok(BridgeMessage::Fault(ArmRole::Microphone, "emergency stop".into())));
        let answer =
            r#"{"op":"service_response","id":"7","result":true,"values":{"success":false,"message":"brakes"}}"#;
        check(answer, Ok(BridgeMessage::Answer("7".into(), false, "brakes".into())));
        check(
            r#"{"op":"status","level":"error","msg":"no such topic"}"#,
            Ok(BridgeMessage::Complaint("no such topic".into())),
        );
        check(r#"{"op":"publish","topic":"/speakers/joint_states","msg":3}"#, Ok(BridgeMessage::Other));
        check("{}", Err("without `op`"));
        check("\u{1}", Err("no JSON"));
    }
}
