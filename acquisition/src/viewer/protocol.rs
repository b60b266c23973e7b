//! Messages of Foxglove's WebSocket protocol, as far as a server needs them that only shows data
//! (<https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md>), and playback control, which Foxglove's SDK adds
//! to it (<https://github.com/foxglove/foxglove-sdk>, `rust/foxglove/src/protocol`).

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD as BASE64;
use serde::{Deserialize, Serialize};

use super::{PlaybackControl, ViewerClock};
use crate::run::recorder::Topic;

/// The supported subprotocols; for the messages used here they are the same. The first that a client offers, too, is
/// chosen.
const SUBPROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];
/// Opcode of a message on a subscription.
const MESSAGE_DATA: u8 = 0x01;
/// Opcode of the server's time.
const TIME: u8 = 0x02;
/// Opcode of the state of playback.
const PLAYBACK_STATE: u8 = 0x05;
/// Opcode of a client's playback request.
const PLAYBACK_CONTROL: u8 = 0x03;
const NANOS: u64 = 1_000_000_000;

/// A client's request.
#[derive(Debug, PartialEq)]
pub(super) enum ClientRequest {
    /// Subscriptions and their channels.
    Subscribe(Vec<(u32, u16)>),
    /// Subscriptions.
    Unsubscribe(Vec<u32>),
    /// A playback request.
    Playback(PlaybackRequest),
}

/// A request to control playback.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PlaybackRequest {
    /// True to play, false to pause.
    pub plays: bool,
    /// As a factor of real time.
    pub speed: f32,
    /// The time to go to first, ns since 1970.
    pub seek: Option<u64>,
    /// Identifier that the answer repeats.
    pub id: String,
}

/// Status of a player.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum PlaybackStatus {
    Playing = 0,
    Paused = 1,
    // 2 is buffering, which is not used: messages behind an index are there at once.
    Ended = 3,
}

/// State of playback.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PlaybackState {
    pub status: PlaybackStatus,
    /// ns since 1970.
    pub current_time: u64,
    /// As a factor of real time.
    pub speed: f32,
    /// Time was set: viewers clear their data.
    pub did_seek: bool,
    /// Id of the request that this answers; empty if it answers none.
    pub request_id: String,
}

#[derive(Deserialize)]
#[serde(tag = "op", rename_all = "camelCase")]
enum FromClient {
    Subscribe {
        subscriptions: Vec<Subscription>,
    },
    #[serde(rename_all = "camelCase")]
    Unsubscribe {
        subscription_ids: Vec<u32>,
    },
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Subscription {
    id: u32,
    channel_id: u16,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Advertised<'a> {
    id: u16,
    topic: &'a str,
    encoding: &'a str,
    schema_name: &'a str,
    schema_encoding: &'a str,
    schema: String,
}

/// Returns the subprotocol for a client that offers these headers.
pub(super) fn choose_subprotocol<'a>(offered: impl Iterator<Item = &'a str>) -> Option<&'static str> {
    let offered: Vec<_> = offered.flat_map(|header| header.split(',')).map(str::trim).collect();
    SUBPROTOCOLS.into_iter().find(|p| offered.contains(p))
}

/// Returns the first message to a client.
pub(super) fn server_info(clock: &ViewerClock) -> String {
    let name = concat!("echolake ", env!("CARGO_PKG_VERSION"));
    let capabilities: &[&str] = match clock {
        ViewerClock::Wall => &[],
        ViewerClock::Messages => &["time"],
        ViewerClock::Playback(_) => &["playbackControl", "time"],
    };
    let mut info = serde_json::json!({"op": "serverInfo", "name": name, "capabilities": capabilities});
    if let ViewerClock::Playback(PlaybackControl { range: (from, to), .. }) = clock {
        // In two numbers, because JSON's have 53 bits.
        let time = |nanos: &u64| serde_json::json!({"sec": nanos / NANOS, "nsec": nanos % NANOS});
        info["dataStartTime"] = time(from);
        info["dataEndTime"] = time(to);
    }
    info.to_string()
}

/// Returns the message that advertises the channels.
pub(super) fn advertise_channels(topics: &[Topic]) -> String {
    let channels: Vec<_> = topics
        .iter()
        .map(|t| Advertised {
            id: t.channel,
            topic: &t.topic,
            encoding: &t.encoding,
            schema_name: &t.schema,
            schema_encoding: &t.schema_encoding,
            schema: schema_text(t),
        })
        .collect();
    serde_json::json!({"op": "advertise", "channels": channels}).to_string()
}

/// Returns a message on a subscription.
pub(super) fn message_data(subscription: u32, log_time_nanos: u64, data: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(13 + data.len());
    out.push(MESSAGE_DATA);
    out.extend(subscription.to_le_bytes());
    out.extend(log_time_nanos.to_le_bytes());
    out.extend(data);
    out
}

/// Returns the message that tells the time.
pub(super) fn time_message(nanos: u64) -> Vec<u8> {
    [&[TIME][..], &nanos.to_le_bytes()].concat()
}

impl PlaybackState {
    /// Encodes it: status, time, speed, whether time was set, length and bytes of the request's id.
    pub fn encode(&self) -> Vec<u8> {
        let mut out = vec![PLAYBACK_STATE, self.status as u8];
        out.extend(self.current_time.to_le_bytes());
        out.extend(self.speed.to_le_bytes());
        out.push(u8::from(self.did_seek));
        out.extend((self.request_id.len() as u32).to_le_bytes());
        out.extend(self.request_id.as_bytes());
        out
    }
}

/// Decodes a client's playback request: command, speed, whether it seeks, its target time, length and bytes of its id.
pub(super) fn playback_request(bytes: &[u8]) -> Option<PlaybackRequest> {
    let (opcode, rest) = bytes.split_first()?;
    let (command, rest) = rest.split_first().filter(|_| *opcode == PLAYBACK_CONTROL)?;
    let (speed, rest) = rest.split_first_chunk()?;
    let (seeks, rest) = rest.split_first()?;
    let (seek, rest) = rest.split_first_chunk()?;
    let (length, rest) = rest.split_first_chunk()?;
    let name = rest.get(..u32::from_le_bytes(*length) as usize)?;
    Some(PlaybackRequest {
        plays: match command {
            0 => true,
            1 => false,
            _ => return None,
        },
        speed: f32::from_le_bytes(*speed),
        seek: (*seeks != 0).then(|| u64::from_le_bytes(*seek)),
        id: std::str::from_utf8(name).ok()?.to_owned(),
    })
}

/// Parses a client's request; None if it does not concern a server that only shows data.
pub(super) fn parse_request(text: &str) -> Option<ClientRequest> {
    Some(match serde_json::from_str(text).ok()? {
        FromClient::Subscribe { subscriptions } => {
            ClientRequest::Subscribe(subscriptions.into_iter().map(|s| (s.id, s.channel_id)).collect())
        }
        FromClient::Unsubscribe { subscription_ids } => ClientRequest::Unsubscribe(subscription_ids),
    })
}

// Schemas of a binary encoding are sent in base64, those that are text as they are.
fn schema_text(topic: &Topic) -> String {
    match topic.schema_encoding.as_str() {
        "protobuf" | "flatbuffer" => BASE64.encode(&topic.schema_data),
        _ => String::from_utf8_lossy(&topic.schema_data).into_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn schemas_are_sent_as_their_encoding_wants_it() {
        let topic = |schema_encoding: &str| Topic {
            channel: 1,
            topic: "/a".into(),
            encoding: "cdr".into(),
            schema: "a/B".into(),
            schema_encoding: schema_encoding.into(),
            schema_data: b"string data\n".to_vec(),
        };
        assert_eq!(schema_text(&topic("ros2msg")), "string data\n");
        assert_eq!(schema_text(&topic("protobuf")), "c3RyaW5nIGRhdGEK");
    }

    // The bytes are those that Foxglove's SDK writes.
    #[test]
    fn playback_is_spoken_as_the_sdk_does() {
        let mut bytes = vec![3, 0];
        bytes.extend(1.5f32.to_le_bytes());
        bytes.push(1);
        bytes.extend(100_500_000_000u64.to_le_bytes());
        bytes.extend(7u32.to_le_bytes());
        bytes.extend(b"some-id");
        let request =
            PlaybackRequest { plays: true, speed: 1.5, seek: Some(100_500_000_000), id: "some-id".to_owned() };
        assert_eq!(playback_request(&bytes), Some(request));
        for cut in 0..bytes.len() {
            assert_eq!(playback_request(&bytes[..cut]), None, "{cut} bytes");
        }
        bytes[1] = 2;
        assert_eq!(playback_request(&bytes), None, "an unknown command");
        let state = PlaybackState {
            status: PlaybackStatus::Ended,
            current_time: 12_345,
            speed: 1.0,
            did_seek: true,
            request_id: "i".into(),
        };
        assert_eq!(state.encode(), [5, 3, 0x39, 0x30, 0, 0, 0, 0, 0, 0, 0, 0, 0x80, 0x3f, 1, 1, 0, 0, 0, b'i']);
        assert_eq!(time_message(1), [2, 1, 0, 0, 0, 0, 0, 0, 0]);
        let (commands, _) = std::sync::mpsc::sync_channel(0);
        let playback = PlaybackControl { range: (1_000_000, 2_000_000_005), commands };
        let info = server_info(&ViewerClock::Playback(playback));
        let info: serde_json::Value = serde_json::from_str(&info).expect("JSON");
        assert_eq!(info["dataStartTime"], serde_json::json!({"sec": 0, "nsec": 1_000_000}));
        assert_eq!(info["dataEndTime"], serde_json::json!({"sec": 2, "nsec": 5}));
    }

    #[test]
    fn clients_are_understood_or_ignored() {
        let subscribe = r#"{"op":"subscribe","subscriptions":[{"id":7,"channelId":3}]}"#;
        assert_eq!(parse_request(subscribe), Some(ClientRequest::Subscribe(vec![(7, 3)])));
        assert_eq!(
            parse_request(r#"{"op":"unsubscribe","subscriptionIds":[7]}"#),
            Some(ClientRequest::Unsubscribe(vec![7]))
        );
        for other in ["", "{}", r#"{"op":"getParameters"}"#, r#"{"op":"subscribe","subscriptions":[{"id":-1}]}"#] {
            assert_eq!(parse_request(other), None, "{other}");
        }
        assert_eq!(choose_subprotocol(["foxglove.websocket.v1, foxglove.sdk.v1"].into_iter()), Some("foxglove.sdk.v1"));
        assert_eq!(choose_subprotocol(["foxglove.websocket.v1"].into_iter()), Some("foxglove.websocket.v1"));
        assert_eq!(choose_subprotocol(["chat"].into_iter()), None);
    }
}
