//! Writes a run's MCAP file, crash-safe: what a checkpoint has passed survives a power cut, and the file stands
//! under its name only when it is whole.

mod arms;
mod channels;
mod error;
mod resume;
mod scene;
mod sealed;
#[cfg(test)]
pub(crate) mod tests;
mod tidy;

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use echolake_panel::OriginalFile;
use echolake_panel::mesh::{Mesh, MeshFormat};
use echolake_panel::relief::HeightField;
use echolake_recording::{Attachment, ChunkLane, ChunkWriter, MessageHeader, Metadata, system_cause};
use echolake_schema::manifest::{RunEnd, RunManifest};
use echolake_schema::messages::{
    AmbientSample, ImpulseResponse, Measurement, Message as RunMessage, SampleFormat, SweepRecording,
};
use echolake_schema::{ErrorCause, Rig, SurfaceRecord, Timestamp, samples, topics};
use foxglove::Encode;

use crate::disk::{folder_of, sync_to_disk};
use channels::Channels;
pub(crate) use channels::own_channels;
pub use error::Error;
pub use resume::{Held, PairAttempts};
pub use sealed::Sealed;

/// The program that records, as manifests name it.
pub(crate) const SOFTWARE: &str = concat!("echolake ", env!("CARGO_PKG_VERSION"));

/// `/sweep/audio` is played this many times slower: at a scale of 1:10, 2-40 kHz become 200 Hz to 4 kHz.
const SLOWER: f64 = 10.0;

/// A run with more of them has chunks of a pair each, which cost every reader a request each.
const MANY_CHECKPOINTS: u64 = 64;

/// Bytes of a chunk in the summary, at most: its index has an entry for each of its topics.
const CHUNK_INDEX_BYTES: u64 = 256;
/// Bytes at which the writer ends a chunk.
const CHUNK_BYTES: u64 = 1 << 20;
/// Bytes that the end of a recording takes beside chunks and their indexes: log, schemas, metadata.
const END_BYTES: u64 = 1 << 20;

/// A panel as viewers show it.
#[derive(Clone, Copy)]
pub(crate) struct Shape<'a> {
    pub heights: &'a HeightField,
    pub mesh: &'a Mesh,
}

/// What is known when a run starts.
pub struct RunStart<'a> {
    /// The run.
    pub manifest: &'a RunManifest,
    /// The rig.
    pub rig: &'a Rig,
    /// The surface.
    pub surface: &'a SurfaceRecord,
    /// Its shape, where it is known.
    pub relief: Option<Relief<'a>>,
    /// What it takes to go on with the run, where it can be; becomes metadata `echolake.run.plan`.
    pub plan: Option<BTreeMap<String, String>>,
}

/// A surface's shape.
pub struct Relief<'a> {
    /// Heights over the panel.
    pub heights: &'a HeightField,
    /// The panel as a solid.
    pub mesh: &'a Mesh,
    /// The producer's own file.
    pub original: Option<OriginalFile<'a>>,
}

/// How much a line of the log matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LogLevel {
    /// For whoever debugs.
    Debug,
    /// The usual course.
    Info,
    /// Something was not right, and was dealt with.
    Warning,
    /// Something failed.
    Error,
}

/// Hears every message as it is recorded, before it is on the disk: for live views.
pub trait Tap: Send {
    /// The topics that may come, before the first message.
    fn topics(&mut self, topics: Vec<Topic>);

    /// A message; it must not wait for anybody.
    fn message(&mut self, channel: u16, log_time_nanos: u64, data: &[u8]);
}

/// A topic, as readers of its messages need it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topic {
    /// Its channel in the file.
    pub channel: u16,
    /// Its name.
    pub topic: String,
    /// How messages are encoded.
    pub encoding: String,
    /// The schema's name.
    pub schema: String,
    /// How the schema is encoded.
    pub schema_encoding: String,
    /// The schema.
    pub schema_data: Vec<u8>,
}

/// What recording has cost so far.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Cost {
    /// Messages taken.
    pub messages: u64,
    /// Their bytes, before compression.
    pub bytes: u64,
    /// Checkpoints.
    pub checkpoints: u64,
    /// Time spent in taking, compressing and writing.
    pub busy: Duration,
    /// Time spent waiting for the disk at checkpoints, which `busy` has, too.
    pub waited: Duration,
}

/// A run being recorded. Dropped before [`Recorder::finish`], it leaves `<path>.partial`.
pub struct Recorder {
    writer: ChunkWriter,
    path: PathBuf,
    partial: PathBuf,
    channels: Channels,
    sequence: u32,
    encoded: Vec<u8>,
    tap: Option<Box<dyn Tap>>,
    cost: Cost,
    /// The run is resumed: the file has already what it has once.
    is_resumed: bool,
    /// The arms, where their joints are known.
    arms: Option<arms::Arms>,
}

/// A tag for a new run's name: a page of elsewhere that knows the name may read the run, so nobody may guess it.
pub fn random_tag() -> u64 {
    rand::random()
}

/// The name of a recording until it is whole.
pub fn partial_of(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".partial");
    name.into()
}

impl Recorder {
    /// Starts a recording that will stand at `path`.
    ///
    /// # Errors
    /// [`Error::Exists`], or [`Error::Create`] where the folder cannot be written; nothing is left behind.
    pub fn create(path: &Path, start: &RunStart<'_>) -> Result<Self, Error> {
        Self::begin(path, |recorder| recorder.head(start))
    }

    // Opens the file and writes its head; where that fails nothing is recorded yet, so there is nothing to keep.
    fn begin(path: &Path, head: impl FnOnce(&mut Self) -> Result<(), Error>) -> Result<Self, Error> {
        let partial = partial_of(path);
        if path.exists() {
            return Err(Error::Exists { path: path.to_owned() });
        }
        let failed = |source: ErrorCause| Error::Create { path: path.to_owned(), source };
        let file = OpenOptions::new().write(true).create_new(true).open(&partial).map_err(|e| match e.kind() {
            std::io::ErrorKind::AlreadyExists => Error::Exists { path: partial.clone() },
            _ => failed(e.into()),
        })?;
        // Held until the file is closed: whoever finds it unlocked knows that its recorder is dead. Where the file
        // system has no locks, it is never found so.
        let _ = file.try_lock();
        let begun = Self::over(file, path, &partial).and_then(|mut recorder| head(&mut recorder).map(|()| recorder));
        begun.map_err(|e| {
            // What cannot be removed either has a cause that the error tells already.
            let _ = std::fs::remove_file(&partial);
            match e {
                Error::Write { source, .. } => failed(source),
                other => other,
            }
        })
    }

    fn over(file: File, path: &Path, partial: &Path) -> Result<Self, Error> {
        let (path, partial) = (path.to_owned(), partial.to_owned());
        match ChunkWriter::new(file) {
            Ok(writer) => Ok(Self::with(writer, path, partial, Channels::default(), 0)),
            Err(e) => Err(Error::Create { path, source: system_cause(e) }),
        }
    }

    fn with(writer: ChunkWriter, path: PathBuf, partial: PathBuf, channels: Channels, sequence: u32) -> Self {
        let is_resumed = sequence > 0;
        let (encoded, tap, cost, arms) = (Vec::new(), None, Cost::default(), None);
        Self { writer, path, partial, channels, sequence, encoded, tap, cost, is_resumed, arms }
    }

    // What the run is stands first, so that a reader knows it before the first chunk.
    fn head(&mut self, start: &RunStart<'_>) -> Result<(), Error> {
        let at = start.manifest.started;
        self.metadata(topics::RUN_METADATA, start.manifest.to_metadata())?;
        if let Some(plan) = &start.plan {
            self.metadata(topics::RUN_PLAN_METADATA, plan.clone())?;
        }
        let surface = serde_json::to_vec_pretty(start.surface).map_err(|source| Error::Surface { source })?;
        self.attach(at, topics::RIG_ATTACHMENT, "application/toml", start.rig.to_toml().as_bytes())?;
        self.attach(at, topics::SURFACE_ATTACHMENT, "application/json", &surface)?;
        let glb = start.relief.as_ref().map(|r| r.mesh.to_bytes(MeshFormat::Glb));
        if let (Some(relief), Some(glb)) = (&start.relief, &glb) {
            let heights: Vec<u8> = relief.heights.heights_mm().iter().flat_map(|h| h.to_le_bytes()).collect();
            self.attach(at, topics::MESH_ATTACHMENT, "model/gltf-binary", glb)?;
            self.attach(at, topics::HEIGHTS_ATTACHMENT, "application/octet-stream", &heights)?;
            if let Some(file) = &relief.original {
                self.attach(at, &own_name(file.name), file.media_type, file.bytes)?;
            }
        }
        self.channels = Channels::register_topics(&mut self.writer.mcap).map_err(|e| self.failed(system_cause(e)))?;
        if let (Some(relief), Some(glb)) = (&start.relief, glb) {
            self.foxglove(self.channels.scene, at, &scene::panel_scene(at, glb))?;
            self.foxglove(self.channels.points, at, &scene::panel_points(at, relief.heights))?;
        }
        self.checkpoint()?;
        // The file's name, too, survives a power cut from here on.
        sync_to_disk(folder_of(&self.partial)).map_err(|e| self.failed(e.into()))
    }

    /// Lets `tap` hear every message from now on, and shows it the panel, which is in the file since its head.
    pub(crate) fn listen(&mut self, mut tap: Box<dyn Tap>, at: Timestamp, shape: Option<Shape<'_>>) {
        let arms = self.arms.as_ref();
        tap.topics([self.channels.topics(), arms.map(arms::Arms::topics).unwrap_or_default()].concat());
        if let Some((channel, description)) = arms.map(arms::Arms::description) {
            tap.message(channel, u64::try_from(at.0).unwrap_or(0), description);
        }
        if let Some(Shape { heights, mesh }) = shape {
            let time = u64::try_from(at.0).unwrap_or(0);
            let mut encoded = Vec::new();
            // A Vec grows, so encoding into it cannot fail.
            let _ = scene::panel_scene(at, mesh.to_bytes(MeshFormat::Glb)).encode(&mut encoded);
            tap.message(self.channels.scene, time, &encoded);
            encoded.clear();
            let _ = scene::panel_points(at, heights).encode(&mut encoded);
            tap.message(self.channels.points, time, &encoded);
        }
        self.tap = Some(tap);
    }

    /// What recording has cost so far.
    pub fn cost(&self) -> Cost {
        self.cost
    }

    /// Returns the bytes that it takes, at most, to end the recording with all that was recorded: open chunks and the
    /// summary.
    pub(crate) fn bytes_to_end(&self) -> u64 {
        let chunks = 3 * self.cost.checkpoints + self.cost.bytes / CHUNK_BYTES;
        self.writer.pending_bytes() as u64 + chunks * CHUNK_INDEX_BYTES + END_BYTES
    }

    /// Records where microphone and speaker stand, mm: `/tf` and both poses.
    ///
    /// # Errors
    /// [`Error::Write`]; so do all methods below.
    pub fn poses(&mut self, at: Timestamp, microphone_mm: [f64; 3], speaker_mm: [f64; 3]) -> Result<(), Error> {
        if self.arms.is_none() {
            self.foxglove(self.channels.tf, at, &scene::tool_frames(at, microphone_mm, speaker_mm))?;
        }
        self.foxglove(self.channels.microphone, at, &scene::pose_over_panel(at, microphone_mm))?;
        self.foxglove(self.channels.speaker, at, &scene::pose_over_panel(at, speaker_mm))
    }

    /// Records a reading of the ambient sensor.
    pub fn environment(&mut self, at: Timestamp, sample: &AmbientSample) -> Result<(), Error> {
        self.own(self.channels.environment, at, sample)
    }

    /// Records a sweep, and its microphone channel for ears.
    pub fn sweep(&mut self, at: Timestamp, recording: &SweepRecording) -> Result<(), Error> {
        self.own(self.channels.sweep, at, recording)?;
        let rate = (recording.sample_rate_hz / SLOWER).round() as u32;
        self.foxglove(self.channels.audio, at, &scene::sweep_audio(at, top_16_bits(recording), rate))?;
        self.end_large(ChunkLane::Sweeps)
    }

    /// Records the second take of a sweep.
    pub fn record_repeat(&mut self, at: Timestamp, recording: &SweepRecording) -> Result<(), Error> {
        let channel = match self.channels.repeat {
            Some(channel) => channel,
            None => channels::register_repeats(&mut self.writer.mcap).map_err(|e| self.failed(system_cause(e)))?,
        };
        self.channels.repeat = Some(channel);
        self.own(channel, at, recording)?;
        self.end_large(ChunkLane::Sweeps)
    }

    /// Records an impulse response.
    pub fn ir(&mut self, at: Timestamp, ir: &ImpulseResponse) -> Result<(), Error> {
        self.own(self.channels.ir, at, ir)?;
        self.end_large(ChunkLane::Responses)
    }

    /// Records what became of an attempt.
    pub fn measurement(&mut self, at: Timestamp, measurement: &Measurement) -> Result<(), Error> {
        self.own(self.channels.measurement, at, measurement)?;
        self.end_large(ChunkLane::Light)
    }

    /// Records a line of the run's log. The process's own log has it for debugging alone: commands tell their user.
    pub fn log(&mut self, at: Timestamp, level: LogLevel, name: &str, message: &str) -> Result<(), Error> {
        tracing::debug!(source = name, run_level = ?level, "{message}");
        self.foxglove(self.channels.log, at, &scene::log_message(at, level, name, message))
    }

    /// Ends the chunks and waits until they are on the disk: what was recorded survives a power cut, and may be
    /// acknowledged.
    ///
    /// # Errors
    /// [`Error::Write`]: nothing that was recorded since the checkpoint before may be acknowledged.
    pub fn checkpoint(&mut self) -> Result<(), Error> {
        let begun = Instant::now();
        self.writer.end_all().map_err(|e| self.failed(system_cause(e)))?;
        let written = Instant::now();
        self.writer.sync_chunks().map_err(|e| self.failed(system_cause(e)))?;
        self.cost.checkpoints += 1;
        self.cost.waited += written.elapsed();
        self.cost.busy += begun.elapsed();
        Ok(())
    }

    /// Ends the recording and gives it its name; returns its path.
    ///
    /// # Errors
    /// [`Error::Exists`] where the name was taken meanwhile, or [`Error::Write`].
    pub fn finish(self, end: &RunEnd) -> Result<PathBuf, Error> {
        self.seal(end)?.publish()
    }

    /// Ends the recording, whole and on the disk, but not yet under its name: runs that belong together are all
    /// sealed before the first is published.
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn seal(mut self, end: &RunEnd) -> Result<Sealed, Error> {
        self.metadata(topics::RUN_END_METADATA, end.to_metadata())?;
        // The writer's own drop would swallow what goes wrong here.
        self.writer.finish().map_err(|e| self.failed(system_cause(e)))?;
        if self.cost.checkpoints >= MANY_CHECKPOINTS {
            // What is on the disk is whole: where there is no room to make it better it stays as it is.
            let _ = tidy::with_larger_chunks(&self.partial, &self.path);
        }
        Ok(Sealed::new(self.path.clone(), self.partial.clone()))
    }

    /// Where the recording stands until it is published.
    pub fn partial(&self) -> &Path {
        &self.partial
    }

    fn own<M: RunMessage>(&mut self, channel: u16, at: Timestamp, message: &M) -> Result<(), Error> {
        let mut encoded = std::mem::take(&mut self.encoded);
        encoded.clear();
        // A Vec grows, so encoding into it cannot fail.
        let _ = prost::Message::encode(message, &mut encoded);
        let written = self.write(channel, at, &encoded);
        self.encoded = encoded;
        written
    }

    fn foxglove<M: Encode>(&mut self, channel: u16, at: Timestamp, message: &M) -> Result<(), Error> {
        let mut encoded = std::mem::take(&mut self.encoded);
        encoded.clear();
        let _ = message.encode(&mut encoded);
        let written = self.write(channel, at, &encoded);
        self.encoded = encoded;
        written
    }

    fn write(&mut self, channel_id: u16, at: Timestamp, data: &[u8]) -> Result<(), Error> {
        let begun = Instant::now();
        let log_time = u64::try_from(at.0).unwrap_or(0);
        self.sequence += 1;
        let header = MessageHeader { channel_id, sequence: self.sequence, log_time, publish_time: log_time };
        self.writer.push_message(self.channels.chunk_lane(channel_id), header, data);
        self.cost.messages += 1;
        self.cost.bytes += data.len() as u64;
        self.cost.busy += begun.elapsed();
        if let Some(tap) = &mut self.tap {
            tap.message(channel_id, log_time, data);
        }
        Ok(())
    }

    fn end_large(&mut self, part: ChunkLane) -> Result<(), Error> {
        let begun = Instant::now();
        let ended = self.writer.end_large(part).map_err(|e| self.failed(system_cause(e)));
        self.cost.busy += begun.elapsed();
        ended
    }

    fn attach(&mut self, at: Timestamp, name: &str, media_type: &str, data: &[u8]) -> Result<(), Error> {
        let time = u64::try_from(at.0).unwrap_or(0);
        let attachment = Attachment {
            log_time: time,
            create_time: time,
            name: name.to_owned(),
            media_type: media_type.to_owned(),
            data: data.into(),
        };
        self.writer.mcap.attach(&attachment).map_err(|e| self.failed(system_cause(e)))
    }

    fn metadata(&mut self, name: &str, metadata: BTreeMap<String, String>) -> Result<(), Error> {
        let record = Metadata { name: name.to_owned(), metadata };
        // Behind all that came before it: a run's end is the last of it.
        let written = self.writer.end_all().and_then(|()| self.writer.mcap.write_metadata(&record));
        written.map_err(|e| self.failed(system_cause(e)))
    }

    fn failed(&self, source: ErrorCause) -> Error {
        Error::Write { path: self.path.clone(), partial: self.partial.clone(), source }
    }
}

// The producer's file keeps its name, unless it is one of ours: two attachments of one name hide each other.
fn own_name(name: &str) -> String {
    let ours =
        [topics::RIG_ATTACHMENT, topics::SURFACE_ATTACHMENT, topics::MESH_ATTACHMENT, topics::HEIGHTS_ATTACHMENT];
    if ours.contains(&name) { format!("original-{name}") } else { name.to_owned() }
}

// The microphone's samples as little-endian 16 bit: the upper bits of integers, the nearest of floats.
fn top_16_bits(recording: &SweepRecording) -> Vec<u8> {
    let bytes = &recording.microphone;
    match recording.format() {
        SampleFormat::S16le => bytes.to_vec(),
        SampleFormat::S24le => bytes.chunks_exact(3).flat_map(|b| [b[1], b[2]]).collect(),
        SampleFormat::S24Split => samples::upper_16(bytes).to_vec(),
        SampleFormat::S32le => bytes.chunks_exact(4).flat_map(|b| [b[2], b[3]]).collect(),
        SampleFormat::F32le => bytes
            .chunks_exact(4)
            .flat_map(|b| ((f32::from_le_bytes([b[0], b[1], b[2], b[3]]) * 32_767.0).round() as i16).to_le_bytes())
            .collect(),
        SampleFormat::Unspecified => Vec::new(),
    }
}
