//! What is said over the wire: Foxglove's WebSocket protocol, as far as a server needs it that only shows
//! (<https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md>).

use std::fmt::Write as _;

use serde::{Deserialize, Serialize};

use crate::recorder::Topic;

/// The subprotocols that are spoken; for what is used here they are the same. The first that a client offers, too, is
/// taken.
const SUBPROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];
/// Opcode of a message on a subscription.
const MESSAGE_DATA: u8 = 0x01;

/// What a client wants.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Wish {
    /// Subscriptions and their channels.
    Subscribe(Vec<(u32, u16)>),
    /// Subscriptions.
    Unsubscribe(Vec<u32>),
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

/// The subprotocol for a client that offers these headers.
pub(super) fn choose<'a>(offered: impl Iterator<Item = &'a str>) -> Option<&'static str> {
    let offered: Vec<_> = offered.flat_map(|header| header.split(',')).map(str::trim).collect();
    SUBPROTOCOLS.into_iter().find(|p| offered.contains(p))
}

/// The first thing that is said.
pub(super) fn server_info() -> String {
    let name = concat!("echolake ", env!("CARGO_PKG_VERSION"));
    serde_json::json!({"op": "serverInfo", "name": name, "capabilities": []}).to_string()
}

/// What there is to subscribe to.
pub(super) fn advertise(topics: &[Topic]) -> String {
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

/// A message on a subscription.
pub(super) fn message_data(subscription: u32, log_time_nanos: u64, data: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(13 + data.len());
    out.push(MESSAGE_DATA);
    out.extend(subscription.to_le_bytes());
    out.extend(log_time_nanos.to_le_bytes());
    out.extend(data);
    out
}

/// What a client says; nothing where it is of no interest to a server that only shows.
pub(super) fn wish(text: &str) -> Option<Wish> {
    Some(match serde_json::from_str(text).ok()? {
        FromClient::Subscribe { subscriptions } => {
            Wish::Subscribe(subscriptions.into_iter().map(|s| (s.id, s.channel_id)).collect())
        }
        FromClient::Unsubscribe { subscription_ids } => Wish::Unsubscribe(subscription_ids),
    })
}

// Schemas of a binary encoding are sent in base64, those that are text as they are.
fn schema_text(topic: &Topic) -> String {
    match topic.schema_encoding.as_str() {
        "protobuf" | "flatbuffer" => base64(&topic.schema_data),
        _ => String::from_utf8_lossy(&topic.schema_data).into_owned(),
    }
}

// RFC 4648, with padding.
fn base64(bytes: &[u8]) -> String {
    const LETTERS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for three in bytes.chunks(3) {
        let bits = three.iter().enumerate().fold(0u32, |bits, (i, b)| bits | u32::from(*b) << (16 - 8 * i));
        for letter in 0..4 {
            let index = (bits >> (18 - 6 * letter)) as usize & 63;
            let _ = out.write_char(if letter <= three.len() { char::from(LETTERS[index]) } else { '=' });
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    // The vectors of RFC 4648, section 10.
    #[test]
    fn base64_is_that_of_the_rfc() {
        for (plain, expected) in [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foob", "Zm9vYg=="),
            ("fooba", "Zm9vYmE="),
            ("foobar", "Zm9vYmFy"),
        ] {
            assert_eq!(base64(plain.as_bytes()), expected);
        }
        assert_eq!(base64(&[0xFB, 0xFF, 0xBF]), "+/+/");
    }

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

    #[test]
    fn clients_are_understood_or_ignored() {
        let subscribe = r#"{"op":"subscribe","subscriptions":[{"id":7,"channelId":3}]}"#;
        assert_eq!(wish(subscribe), Some(Wish::Subscribe(vec![(7, 3)])));
        assert_eq!(wish(r#"{"op":"unsubscribe","subscriptionIds":[7]}"#), Some(Wish::Unsubscribe(vec![7])));
        for other in ["", "{}", r#"{"op":"getParameters"}"#, r#"{"op":"subscribe","subscriptions":[{"id":-1}]}"#] {
            assert_eq!(wish(other), None, "{other}");
        }
        assert_eq!(choose(["foxglove.websocket.v1, foxglove.sdk.v1"].into_iter()), Some("foxglove.sdk.v1"));
        assert_eq!(choose(["foxglove.websocket.v1"].into_iter()), Some("foxglove.websocket.v1"));
        assert_eq!(choose(["chat"].into_iter()), None);
    }
}
