//! The topics of a run's file and their schemas.

use std::collections::BTreeMap;
use std::io::{Cursor, Seek, Write};
use std::sync::Arc;

use echolake_recording::{Channel, ChunkLane, McapResult, RunSummary, Writer, summary_range};
use echolake_schema::messages::{
    AmbientSample, FILE_DESCRIPTOR_SET, ImpulseResponse, Measurement, Message as RunMessage, SweepRecording,
};
use echolake_schema::topics;
use foxglove::Encode;

use super::Topic;

/// Channels of the topics, in the order of their registration.
#[derive(Default)]
pub(super) struct Channels {
    pub tf: u16,
    pub scene: u16,
    pub points: u16,
    pub microphone: u16,
    pub speaker: u16,
    pub sweep: u16,
    pub audio: u16,
    pub ir: u16,
    pub environment: u16,
    pub measurement: u16,
    pub log: u16,
    /// Of second takes, once there is one.
    pub repeat: Option<u16>,
}

impl Channels {
    /// Which chunks a channel's messages go to.
    pub fn chunk_lane(&self, channel: u16) -> ChunkLane {
        match channel {
            c if c == self.sweep || c == self.audio || Some(c) == self.repeat => ChunkLane::Sweeps,
            c if c == self.ir => ChunkLane::Responses,
            _ => ChunkLane::Light,
        }
    }

    /// All of them, as readers need them.
    pub fn topics(&self) -> Vec<Topic> {
        use foxglove::messages as fg;
        vec![
            foxglove_topic::<fg::FrameTransforms>(self.tf, topics::TF),
            foxglove_topic::<fg::SceneUpdate>(self.scene, topics::PANEL_SCENE),
            foxglove_topic::<fg::PointCloud>(self.points, topics::PANEL_POINTS),
            foxglove_topic::<fg::PoseInFrame>(self.microphone, topics::MICROPHONE_POSE),
            foxglove_topic::<fg::PoseInFrame>(self.speaker, topics::SPEAKER_POSE),
            own_topic::<SweepRecording>(self.sweep, topics::SWEEP),
            foxglove_topic::<fg::RawAudio>(self.audio, topics::SWEEP_AUDIO),
            own_topic::<ImpulseResponse>(self.ir, topics::IR),
            own_topic::<AmbientSample>(self.environment, topics::ENVIRONMENT),
            own_topic::<Measurement>(self.measurement, topics::MEASUREMENT),
            foxglove_topic::<fg::Log>(self.log, topics::LOG),
        ]
    }

    /// Declares every topic, so that a reader knows all of them whatever the run holds.
    pub fn register_topics(writer: &mut Writer<impl Write + Seek>) -> McapResult<Self> {
        use foxglove::messages as fg;
        Ok(Self {
            tf: foxglove_channel::<fg::FrameTransforms>(writer, topics::TF)?,
            scene: foxglove_channel::<fg::SceneUpdate>(writer, topics::PANEL_SCENE)?,
            points: foxglove_channel::<fg::PointCloud>(writer, topics::PANEL_POINTS)?,
            microphone: foxglove_channel::<fg::PoseInFrame>(writer, topics::MICROPHONE_POSE)?,
            speaker: foxglove_channel::<fg::PoseInFrame>(writer, topics::SPEAKER_POSE)?,
            sweep: own_channel::<SweepRecording>(writer, topics::SWEEP)?,
            audio: foxglove_channel::<fg::RawAudio>(writer, topics::SWEEP_AUDIO)?,
            ir: own_channel::<ImpulseResponse>(writer, topics::IR)?,
            environment: own_channel::<AmbientSample>(writer, topics::ENVIRONMENT)?,
            measurement: own_channel::<Measurement>(writer, topics::MEASUREMENT)?,
            log: foxglove_channel::<fg::Log>(writer, topics::LOG)?,
            repeat: None,
        })
    }
}

/// Declares the topic of second takes, which few runs have.
pub(super) fn register_repeats(writer: &mut Writer<impl Write + Seek>) -> McapResult<u16> {
    own_channel::<SweepRecording>(writer, topics::SWEEP_REPEAT)
}

/// Returns the channels that every run of this version has, by the ids that they have in each.
pub(crate) fn own_channels() -> BTreeMap<u16, Arc<Channel<'static>>> {
    let mut file = Cursor::new(Vec::new());
    let written = Writer::new(&mut file).and_then(|mut writer| {
        Channels::register_topics(&mut writer)?;
        writer.finish()
    });
    // Memory is written without fail.
    let file = written.map(|_| file.into_inner()).unwrap_or_default();
    let range = summary_range(&file, file.len() as u64);
    let summary = range.and_then(|range| RunSummary::parse(&file[range.start as usize..]).ok());
    summary.unwrap_or_default().channels
}

pub(super) fn foxglove_channel<M: Encode>(writer: &mut Writer<impl Write + Seek>, topic: &str) -> McapResult<u16> {
    let schema = match M::get_schema() {
        Some(schema) => writer.add_schema(&schema.name, &schema.encoding, &schema.data)?,
        None => 0,
    };
    writer.add_channel(schema, topic, &M::get_message_encoding(), &Default::default())
}

fn own_channel<M: RunMessage>(writer: &mut Writer<impl Write + Seek>, topic: &str) -> McapResult<u16> {
    let schema = writer.add_schema(M::FULL_NAME, "protobuf", FILE_DESCRIPTOR_SET)?;
    writer.add_channel(schema, topic, "protobuf", &Default::default())
}

pub(super) fn foxglove_topic<M: Encode>(channel: u16, topic: &str) -> Topic {
    let schema = M::get_schema();
    let (name, encoding, data) = schema.map(|s| (s.name, s.encoding, s.data.into_owned())).unwrap_or_default();
    Topic {
        channel,
        topic: topic.into(),
        encoding: M::get_message_encoding(),
        schema: name,
        schema_encoding: encoding,
        schema_data: data,
    }
}

fn own_topic<M: RunMessage>(channel: u16, topic: &str) -> Topic {
    Topic {
        channel,
        topic: topic.into(),
        encoding: "protobuf".into(),
        schema: M::FULL_NAME.into(),
        schema_encoding: "protobuf".into(),
        schema_data: FILE_DESCRIPTOR_SET.to_vec(),
    }
}
