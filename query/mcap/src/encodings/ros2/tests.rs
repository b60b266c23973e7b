//! ROS 2 as columns: messages, events of services, and messages that are not what their definition says.

use crate::tests::{TestChannel, check, file_of, lake, put, refused};

/// Encodes a ROS 2 message: values aligned to their size behind a header of four bytes.
#[derive(Default)]
struct Cdr(Vec<u8>);

impl Cdr {
    fn put<const N: usize>(mut self, bytes: [u8; N]) -> Self {
        self.0.resize(self.0.len().next_multiple_of(N), 0);
        self.0.extend_from_slice(&bytes);
        self
    }

    fn text(self, text: &str) -> Self {
        let mut cdr = self.put((text.len() as u32 + 1).to_le_bytes());
        cdr.0.extend_from_slice(text.as_bytes());
        cdr.0.push(0);
        cdr
    }

    fn message(self) -> Vec<u8> {
        [&[0, 1, 0, 0], self.0.as_slice()].concat()
    }
}

const STATE: &str = "
# A state.
int8 KIND=3
std_msgs/Header header
float64[] position
geometry_msgs/Point[2] corners
uint8[] image
string<=10 name \"none\"
bool ok
Extra extra
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: geometry_msgs/Point
float32 x
float32 y
================================================================================
MSG: test_msgs/Extra
int16 a
uint64 b
";

fn state(n: u32) -> Vec<u8> {
    let cdr = Cdr::default().put(n.to_le_bytes()).put(5u32.to_le_bytes()).text("panel");
    let cdr = cdr.put(3u32.to_le_bytes()).put(1.5f64.to_le_bytes()).put(2.5f64.to_le_bytes());
    let cdr = cdr.put(f64::from(n).to_le_bytes());
    let cdr = [1f32, 2.0, 3.0, 4.0].into_iter().fold(cdr, |cdr, v| cdr.put(v.to_le_bytes()));
    let cdr = cdr.put(3u32.to_le_bytes()).put([7]).put([8]).put([9]).text("x").put([1]);
    cdr.put((-2i16).to_le_bytes()).put(99u64.to_le_bytes()).message()
}

fn state_file(messages: &[&[u8]]) -> Vec<u8> {
    let schema = ("test_msgs/msg/State", "ros2msg", STATE.as_bytes());
    file_of(&[TestChannel { topic: "/state", encoding: "cdr", schema, messages }])
}

#[tokio::test]
async fn ros_messages_are_columns() {
    let lake = lake().await;
    put(&lake, "inbox/r.mcap", state_file(&[&state(1), &state(2)])).await;
    check(
        &lake,
        "select header, position, corners, encode(image, 'hex'), name, ok, extra \
         from mcap('inbox/r.mcap', '/state') order by sequence",
        &[
            "{stamp: 1970-01-01T00:00:01.000000005Z, frame_id: panel} | [1.5, 2.5, 1.0] | \
              [{x: 1.0, y: 2.0}, {x: 3.0, y: 4.0}] | 070809 | x | true | {a: -2, b: 99}",
            "{stamp: 1970-01-01T00:00:02.000000005Z, frame_id: panel} | [1.5, 2.5, 2.0] | \
              [{x: 1.0, y: 2.0}, {x: 3.0, y: 4.0}] | 070809 | x | true | {a: -2, b: 99}",
        ],
    )
    .await;
    check(&lake, "select name from mcap('inbox/r.mcap', '/state') where sequence = 1", &["x"]).await;
}

#[tokio::test]
async fn messages_that_do_not_fit_their_schema_are_named() {
    let lake = lake().await;
    let whole = state(1);
    for length in 0..whole.len() {
        put(&lake, "inbox/r.mcap", state_file(&[&state(0), &whole[..length]])).await;
        refused(&lake, "select * from mcap('inbox/r.mcap', '/state')", &["message 1 of topic `/state`"]).await;
    }
    let mut lies = state(1);
    // The count of `position`, behind the header.
    lies[24..28].copy_from_slice(&u32::MAX.to_le_bytes());
    put(&lake, "inbox/r.mcap", state_file(&[&lies])).await;
    refused(&lake, "select * from mcap('inbox/r.mcap', '/state')", &["ends within a value"]).await;
}

// The definition of a service is what recorders store for its events.
#[tokio::test]
async fn service_events_are_columns() {
    let raw = "================================================================================\n\
               SRV: example_interfaces/srv/AddTwoInts\nint64 a\nint64 b\n---\nint64 sum\n";
    let event = |kind: u8, has_request: bool| {
        let cdr = Cdr::default().put([kind]).put(1u32.to_le_bytes()).put(2u32.to_le_bytes());
        let cdr = (0..16).fold(cdr, |cdr, i| cdr.put([i]));
        let cdr = cdr.put(3i64.to_le_bytes()).put(u32::from(has_request).to_le_bytes());
        let cdr = if has_request { cdr.put(4i64.to_le_bytes()).put(5i64.to_le_bytes()) } else { cdr };
        let cdr = cdr.put(u32::from(!has_request).to_le_bytes());
        (if has_request { cdr } else { cdr.put(9i64.to_le_bytes()) }).message()
    };
    let (request, response) = (event(0, true), event(3, false));
    let lake = lake().await;
    let schema = ("example_interfaces/srv/AddTwoInts_Event", "ros2msg", raw.as_bytes());
    let messages: [&[u8]; 2] = [&request, &response];
    let channel = TestChannel { topic: "/add/_service_event", encoding: "cdr", schema, messages: &messages };
    put(&lake, "inbox/s.mcap", file_of(&[channel])).await;
    check(
        &lake,
        "select info['event_type'], info['stamp'], info['sequence_number'], request, response \
         from mcap('inbox/s.mcap', '/add/_service_event') order by sequence",
        &[
            "0 | 1970-01-01T00:00:01.000000002Z | 3 | [{a: 4, b: 5}] | []",
            "3 | 1970-01-01T00:00:01.000000002Z | 3 | [] | [{sum: 9}]",
        ],
    )
    .await;
}
