//! A client of another make than the server looks at recordings of the simulated rig, and controls how they are shown.

use std::net::TcpStream;
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use echolake_panel::PanelSpecimen;
use echolake_panel::relief::PanelRelief;
use echolake_schema::manifest::Origin;
use echolake_schema::{Rig, Timestamp, topics};
use serde_json::{Value, json};
use tungstenite::Message;
use tungstenite::client::IntoClientRequest as _;

use super::*;
use crate::run::RunRequest;
use crate::run::simulate::run_simulation;

const SMALL_RIG: &str = include_str!("../../../tests/fixtures/small_rig.toml");
const START: i64 = 1_767_600_000_000_000_000;
/// Fast enough for a test; a run of the small rig lasts minutes.
const FAST: ReplayOptions = ReplayOptions { speed: 1e6, paused: false };
/// Timeout of the other side; a busy machine needs some of it.
const ANSWER_LIMIT: Duration = Duration::from_secs(120);
const ONCE: [&str; 3] = [topics::PANEL_SCENE, topics::PANEL_POINTS, topics::ROBOT_DESCRIPTION];

/// Measures a surface, `hours` after the first.
fn run(folder: &Path, surface: &str, hours: f64) -> PathBuf {
    let rig = Rig::from_toml(SMALL_RIG).expect("a rig");
    let specimen = PanelSpecimen::Relief(PanelRelief::by_name("flat").expect("a relief"));
    let start = Timestamp(START).plus_secs(hours * 3_600.0);
    let run = RunRequest::new(&rig, surface.parse().expect("an id"), &specimen, start, folder);
    run_simulation(&run, Origin::Simulated, &AtomicBool::new(false), &mut |_| {}).expect("a run").0
}

/// Topic, time and content.
type SeenMessage = (String, u64, Vec<u8>);

/// All messages of a file by time.
fn messages(path: &Path) -> Vec<SeenMessage> {
    let file = std::fs::read(path).expect("the run");
    let stream = mcap::MessageStream::new(&file).expect("an MCAP file").map(|m| m.expect("whole"));
    let mut all: Vec<SeenMessage> = stream.map(|m| (m.channel.topic.clone(), m.log_time, m.data.to_vec())).collect();
    all.sort_by_key(|(_, time, _)| *time);
    all
}

fn replay(paths: &[&Path], options: ReplayOptions) -> ReplayServer {
    let recordings = paths.iter().map(|path| Recording::open(path).expect("a recording")).collect();
    ReplayServer::start(([127, 0, 0, 1], 0).into(), ViewerAccess::default(), recordings, options).expect("a server")
}

/// A message or event at a client.
#[derive(Debug, PartialEq)]
enum Heard {
    Message(SeenMessage),
    Time(u64),
    /// Status, time, whether it was set, the request.
    State(u8, u64, bool, String),
}

struct ReplayClient {
    socket: tungstenite::WebSocket<tungstenite::stream::MaybeTlsStream<TcpStream>>,
    info: Value,
    channels: Vec<(u64, String)>,
}

impl ReplayClient {
    fn connect(server: &ReplayServer) -> Self {
        let address = server.address();
        let mut request = format!("ws://{address}").into_client_request().expect("a request");
        request.headers_mut().insert("Sec-WebSocket-Protocol", "foxglove.sdk.v1".parse().expect("a header"));
        let stream = TcpStream::connect(address).expect("connected");
        stream.set_read_timeout(Some(ANSWER_LIMIT)).expect("set");
        let stream = tungstenite::stream::MaybeTlsStream::Plain(stream);
        let (mut socket, _) = tungstenite::client(request, stream).expect("a handshake");
        let mut json = || match socket.read().expect("a message") {
            Message::Text(text) => serde_json::from_str::<Value>(&text).expect("JSON"),
            other => panic!("{other:?}"),
        };
        let (info, advertised) = (json(), json());
        let channels = advertised["channels"].as_array().expect("channels").iter();
        let channels =
            channels.map(|c| (c["id"].as_u64().expect("an id"), c["topic"].as_str().expect("a topic").into()));
        Self { channels: channels.collect(), info, socket }
    }

    /// Subscribes to topics, of none to all; subscriptions are the channels' numbers and a thousand.
    fn subscribe(&mut self, topics: &[&str]) {
        let wanted = self.channels.iter().filter(|(_, topic)| topics.is_empty() || topics.contains(&topic.as_str()));
        let wishes: Vec<_> = wanted.map(|(id, _)| json!({"id": id + 1_000, "channelId": id})).collect();
        assert!(!wishes.is_empty());
        let text = json!({"op": "subscribe", "subscriptions": wishes}).to_string();
        self.socket.send(Message::text(text)).expect("sent");
    }

    fn control(&mut self, plays: bool, speed: f32, seek: Option<u64>, id: &str) {
        let mut bytes = vec![3, u8::from(!plays)];
        bytes.extend(speed.to_le_bytes());
        bytes.push(u8::from(seek.is_some()));
        bytes.extend(seek.unwrap_or(0).to_le_bytes());
        bytes.extend((id.len() as u32).to_le_bytes());
        bytes.extend(id.as_bytes());
        self.socket.send(Message::binary(bytes)).expect("sent");
    }

    fn hear(&mut self) -> Heard {
        let Message::Binary(bytes) = self.socket.read().expect("a message") else { panic!("no binary message") };
        let number = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight"));
        match bytes[0] {
            1 => Heard::Message(self.seen(&bytes)),
            2 => Heard::Time(number(1)),
            5 => {
                let id = String::from_utf8(bytes[19..].to_vec()).expect("text");
                Heard::State(bytes[1], number(2), bytes[14] != 0, id)
            }
            other => panic!("opcode {other}"),
        }
    }

    fn seen(&self, bytes: &[u8]) -> SeenMessage {
        let subscription = u32::from_le_bytes(bytes[1..5].try_into().expect("four"));
        let is_its = |(id, _): &&(u64, String)| id + 1_000 == u64::from(subscription);
        let (_, topic) = self.channels.iter().find(is_its).expect("a subscription");
        let time = u64::from_le_bytes(bytes[5..13].try_into().expect("eight"));
        (topic.clone(), time, bytes[13..].to_vec())
    }

    /// Messages until as many are there.
    fn collect(&mut self, count: usize) -> Vec<SeenMessage> {
        let mut all = Vec::new();
        while all.len() < count {
            match self.socket.read() {
                Ok(Message::Binary(bytes)) if bytes[0] != 1 => {}
                Ok(Message::Binary(bytes)) => all.push(self.seen(&bytes)),
                other => {
                    let mut last = std::collections::BTreeMap::<&str, (usize, u64)>::new();
                    for (topic, time, _) in &all {
                        let known = last.entry(topic).or_default();
                        *known = (known.0 + 1, *time);
                    }
                    panic!("{other:?} after {} of {count} messages: {last:?}", all.len());
                }
            }
        }
        all
    }

    /// Waits for the answer to a request; returns it, and the messages before it.
    fn answer(&mut self, id: &str) -> (Heard, Vec<SeenMessage>) {
        let mut before = Vec::new();
        loop {
            match self.hear() {
                Heard::Message(seen) => before.push(seen),
                Heard::State(status, time, seeked, of) if of == id => {
                    return (Heard::State(status, time, seeked, of), before);
                }
                _ => {}
            }
        }
    }
}

fn by_content(mut all: Vec<SeenMessage>) -> Vec<SeenMessage> {
    all.sort_by(|a, b| (a.1, &a.0, &a.2).cmp(&(b.1, &b.0, &b.2)));
    all
}

#[test]
fn every_message_of_several_runs_comes_once_and_in_order() {
    let home = tempfile::tempdir().expect("a folder");
    let (first, second) = (run(home.path(), "a", 0.0), run(home.path(), "b", 11.0));
    let expected = [messages(&first), messages(&second)].concat();
    // They are named in the other order.
    let server = replay(&[&second, &first], FAST);
    let mut client = ReplayClient::connect(&server);
    assert_eq!(client.info["capabilities"], json!(["playbackControl", "time"]));
    let time = |t: u64| json!({"sec": t / 1_000_000_000, "nsec": t % 1_000_000_000});
    assert_eq!(client.info["dataStartTime"], time(expected[0].1));
    assert_eq!(client.info["dataEndTime"], time(expected[expected.len() - 1].1));
    client.subscribe(&[]);
    let seen = client.collect(expected.len());
    assert!(seen.windows(2).all(|pair| pair[0].1 <= pair[1].1), "in the order of time");
    assert!(by_content(seen) == by_content(expected.clone()), "all of it, and nothing twice");
    let standing = server.standing();
    assert_eq!((standing.lost, standing.damages), (0, Vec::new()));
    assert!(server.length_secs() < 3_600.0, "what lies between is left out: {}", server.length_secs());
}

#[test]
fn playback_is_paused_put_elsewhere_and_ended() {
    let home = tempfile::tempdir().expect("a folder");
    let path = run(home.path(), "a", 0.0);
    let expected = messages(&path);
    let (start, end) = (expected[0].1, expected[expected.len() - 1].1);
    let server = replay(&[&path], ReplayOptions { speed: 1.0, paused: true });
    let mut client = ReplayClient::connect(&server);
    client.subscribe(&[]);
    // Messages that are in the file once are sent before anything plays.
    let at_start: Vec<_> = expected.iter().filter(|(_, time, _)| *time == start).cloned().collect();
    assert!(ONCE[..2].iter().all(|topic| at_start.iter().any(|(t, ..)| t == topic)));
    assert!(by_content(client.collect(at_start.len())) == by_content(at_start));
    client.control(true, 2.0, None, "play");
    assert!(matches!(client.answer("play").0, Heard::State(0, _, false, _)));
    client.control(false, 2.0, None, "pause");
    let (Heard::State(1, paused, false, _), _) = client.answer("pause") else { panic!("it pauses") };
    // After a seek: of every topic the last messages up to there, and none of later.
    let verdicts: Vec<u64> = expected.iter().filter(|m| m.0 == topics::MEASUREMENT).map(|m| m.1).collect();
    let middle = verdicts[verdicts.len() / 2];
    assert!(paused < middle);
    client.control(false, 2.0, Some(middle), "seek");
    let (Heard::State(1, time, true, _), _) = client.answer("seek") else { panic!("it seeks") };
    assert_eq!(time, middle);
    let mut last: std::collections::BTreeMap<&str, u64> = std::collections::BTreeMap::new();
    last.extend(expected.iter().filter(|m| m.1 <= middle).map(|m| (m.0.as_str(), m.1)));
    let known: Vec<_> = expected.iter().filter(|m| last.get(m.0.as_str()) == Some(&m.1)).cloned().collect();
    let shown = client.collect(known.len());
    assert!(shown.windows(2).all(|pair| pair[0].1 <= pair[1].1));
    assert!(by_content(shown) == by_content(known));
    // On to the end, then nothing plays before a seek.
    client.control(true, 1e6, None, "on");
    let later: Vec<_> = expected.iter().filter(|m| m.1 > middle).cloned().collect();
    let (answer, mut rest) = client.answer("on");
    assert!(matches!(answer, Heard::State(0, ..)));
    rest.extend(client.collect(later.len() - rest.len()));
    assert!(by_content(rest) == by_content(later));
    let (Heard::State(3, time, false, _), _) = client.answer("") else { panic!("it ends") };
    assert_eq!(time, end);
    client.control(true, 1.0, None, "again");
    assert!(matches!(client.answer("again").0, Heard::State(3, ..)));
    client.control(true, f32::NAN, Some(0), "back");
    assert_eq!(client.answer("back").0, Heard::State(0, start, true, "back".into()));
}

#[test]
fn damage_is_named_and_left_out() {
    let home = tempfile::tempdir().expect("a folder");
    let path = run(home.path(), "a", 0.0);
    let whole = std::fs::read(&path).expect("the run");
    let expected = messages(&path);
    let summary = mcap::Summary::read(&whole).expect("sound").expect("a summary");
    let hit = summary.chunk_indexes.iter().max_by_key(|c| c.chunk_length).expect("a chunk");
    let mut damaged = whole.clone();
    damaged[(hit.chunk_start_offset + hit.chunk_length / 2) as usize] ^= 0x55;
    std::fs::write(&path, &damaged).expect("written");
    let lost: usize = expected
        .iter()
        .filter(|m| hit.message_index_offsets.keys().any(|id| summary.channels[id].topic == m.0))
        .filter(|m| (hit.message_start_time..=hit.message_end_time).contains(&m.1))
        .count();
    let server = replay(&[&path], FAST);
    let mut client = ReplayClient::connect(&server);
    client.subscribe(&[]);
    client.collect(expected.len() - lost);
    let damages = server.standing().damages;
    assert_eq!(damages.len(), 1, "{damages:?}");
    assert!(
        damages[0].contains(&format!("byte {}", hit.chunk_start_offset)) && damages[0].contains("a-"),
        "{damages:?}"
    );
    drop(server);
    // One that was cut off has no index; what is whole of it is shown.
    let last = summary.chunk_indexes.iter().max_by_key(|c| c.chunk_start_offset).expect("a chunk");
    let cut_at = (last.chunk_start_offset + last.chunk_length / 2) as usize;
    std::fs::write(&path, &whole[..cut_at]).expect("written");
    let cut = Recording::open(&path).expect("most of it is there");
    assert!(cut.defect().is_some_and(|d| d.contains("ends within")), "{:?}", cut.defect());
    let server =
        ReplayServer::start(([127, 0, 0, 1], 0).into(), ViewerAccess::default(), vec![cut], FAST).expect("a server");
    let mut client = ReplayClient::connect(&server);
    client.subscribe(&[topics::PANEL_POINTS]);
    assert_eq!(client.collect(1)[0].0, topics::PANEL_POINTS);
    for (content, expected) in [(&b"no MCAP at all"[..], "it is no MCAP file"), (&whole[..40], "ends within")] {
        std::fs::write(&path, content).expect("written");
        let error = Recording::open(&path).map(drop).expect_err(expected).to_string();
        assert!(error.contains(expected) && error.contains("a-"), "{error}");
    }
}

#[test]
fn recordings_of_the_same_time_are_shown_one_after_the_other() {
    let home = tempfile::tempdir().expect("a folder");
    let path = run(home.path(), "a", 0.0);
    let expected = messages(&path);
    let server = replay(&[&path, &path], FAST);
    let mut client = ReplayClient::connect(&server);
    client.subscribe(&[]);
    let mut seen = client.collect(2 * expected.len());
    let second = seen.split_off(expected.len());
    let expected = by_content(expected);
    assert!(by_content(seen) == expected && by_content(second) == expected);
}

/// Writes a file of messages: topic and time, ms.
fn write_times(path: &Path, times: &[(&str, u64)]) {
    let mut writer = mcap::Writer::new(std::fs::File::create(path).expect("created")).expect("a writer");
    for (topic, millis) in times {
        let channel_id = writer.add_channel(0, topic, "json", &std::collections::BTreeMap::new()).expect("a channel");
        let log_time = millis * 1_000_000;
        let header = mcap::records::MessageHeader { channel_id, sequence: 0, log_time, publish_time: log_time };
        writer.write_to_known_channel(&header, b"{}").expect("written");
    }
    writer.finish().expect("finished");
}

/// E29: a gap of all topics is passed over and named; a topic of few messages is not a gap.
#[test]
fn gaps_are_passed_over_and_named() {
    let home = tempfile::tempdir().expect("a folder");
    let path = home.path().join("gap.mcap");
    write_times(&path, &[("/a", 0), ("/b", 20), ("/a", 1_700_000_000_000), ("/b", 1_700_000_000_020)]);
    for topics in [&[][..], &["/b"]] {
        let server = replay(&[&path], ReplayOptions { speed: 1.0, paused: false });
        let mut client = ReplayClient::connect(&server);
        client.subscribe(topics);
        let mut last = 0;
        while last < 1_700_000_000_020_000_000 {
            let (_, time, _) = client.collect(1).remove(0);
            assert!(time >= last || time <= 20_000_000, "{time} after {last}");
            last = time;
        }
        let notes = server.standing().notes;
        assert!(notes.len() == 1 && notes[0].contains("gap.mcap` has no message for 1699999999 s, from 1970-01-01T"));
    }
    let path = home.path().join("sparse.mcap");
    let dense = (1..20).map(|n| ("/dense", 300_000 * n));
    write_times(&path, &[("/sparse", 0)].into_iter().chain(dense).chain([("/sparse", 6_000_000)]).collect::<Vec<_>>());
    let server = replay(&[&path], FAST);
    let mut client = ReplayClient::connect(&server);
    client.subscribe(&["/sparse"]);
    assert_eq!(client.collect(2)[1].1, 6_000_000_000_000);
    assert_eq!(server.standing().notes, Vec::<String>::new());
}

#[test]
fn what_cannot_be_shown_is_refused() {
    let home = tempfile::tempdir().expect("a folder");
    let path = run(home.path(), "a", 0.0);
    let any = ([127, 0, 0, 1], 0).into();
    let none =
        ReplayServer::start(any, ViewerAccess::default(), Vec::new(), FAST).map(drop).expect_err("none").to_string();
    assert!(none.contains("nothing to replay"), "{none}");
    let server = replay(&[&path], FAST);
    let open = vec![Recording::open(&path).expect("a recording")];
    let taken = ReplayServer::start(server.address(), ViewerAccess::default(), open, FAST);
    assert!(taken.map(drop).expect_err("taken").to_string().contains("taken?"));
}

mod slow {
    use super::*;

    #[test]
    fn who_sleeps_stops_nobody_and_loses_no_order() {
        let home = tempfile::tempdir().expect("a folder");
        let paths: Vec<_> = (0..12).map(|i| run(home.path(), &format!("s{i}"), f64::from(i))).collect();
        let paths: Vec<&Path> = paths.iter().map(PathBuf::as_path).collect();
        let expected: usize = paths.iter().map(|path| messages(path).len()).sum();
        let server = replay(&paths, FAST);
        let mut sleeper = ReplayClient::connect(&server);
        let mut awake = ReplayClient::connect(&server);
        // The sleeper waits for its first message, so that it is known to be served.
        sleeper.subscribe(&[]);
        sleeper.collect(1);
        awake.subscribe(&[]);
        let begun = Instant::now();
        let mut last = 0;
        loop {
            match awake.hear() {
                Heard::Message((_, time, _)) => {
                    assert!(time >= last);
                    last = time;
                }
                Heard::Time(time) if last > 0 && time >= server.range().1 => break,
                _ => {}
            }
            assert!(begun.elapsed() < ANSWER_LIMIT, "it ends");
        }
        let mut heard = 0;
        last = 0;
        while let Ok(Message::Binary(bytes)) = sleeper.socket.read() {
            if bytes[0] == 1 {
                let time = u64::from_le_bytes(bytes[5..13].try_into().expect("eight"));
                assert!(time >= last, "no order is lost");
                (last, heard) = (time, heard + 1);
            }
            if bytes[0] == 2 && u64::from_le_bytes(bytes[1..9].try_into().expect("eight")) >= server.range().1 {
                break;
            }
        }
        assert!(heard <= expected, "{heard} of {expected}");
    }
}
