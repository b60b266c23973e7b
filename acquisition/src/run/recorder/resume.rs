//! A recording that is resumed: what is safe in it, and a recorder that writes behind that.

use std::collections::{BTreeMap, HashSet};
use std::fs::OpenOptions;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use echolake_recording::{
    Channel, ChunkLane, ChunkWriter, MessageHeader, Record, RecordingItem, RecordingReader, system_cause,
};
use echolake_schema::manifest::RunManifest;
use echolake_schema::messages::{Measurement, Verdict};
use echolake_schema::{ErrorCause, Rig, Timestamp, topics};
use prost::Message as _;

use super::Recorder;
use super::channels::Channels;
use crate::disk::{folder_of, sync_to_disk};
use crate::recovery::{Error, RecordingCopy, RecordingSurvey, is_end, lock};

/// What the name of a recording ends in until it is whole.
const PARTIAL: &str = "partial";

/// What a recording that was broken off holds: all of it that is whole.
#[derive(Debug, Clone)]
pub struct Held {
    /// The run.
    pub manifest: RunManifest,
    /// The rig that measures it.
    pub rig: Rig,
    /// What it takes to go on.
    pub plan: BTreeMap<String, String>,
    /// The pairs that have a verdict.
    pub pairs: BTreeMap<u32, PairAttempts>,
    /// Attempts with a verdict.
    pub attempts: u64,
    /// Time of the last message.
    pub last: Timestamp,
    /// Size of the file, bytes.
    pub bytes: u64,
    /// What is damaged, each with its place, in words.
    pub damage: Vec<String>,
    /// Bytes that are lost.
    pub lost: Vec<Range<u64>>,
    channels: BTreeMap<u16, Arc<Channel<'static>>>,
    /// Times of the verdicts; sweeps and responses of other times are of attempts that nobody acknowledged.
    times: HashSet<u64>,
}

/// What is known of a pair.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PairAttempts {
    /// The highest number of an attempt; where it goes on, numbers do, too.
    pub attempts: u32,
    /// Whether one was accepted.
    pub accepted: bool,
}

impl Held {
    /// Reads what a recording holds; nothing is written.
    ///
    /// # Errors
    /// [`Error::Headless`] if it was broken off before its first checkpoint, [`Error::Unusable`] if its manifest cannot
    /// be read, [`Error::NoPlan`] if it was not begun as a run that can be resumed, or its plan or rig cannot be read.
    pub fn from_file(partial: &Path) -> Result<Self, Error> {
        let mut survey = RecordingSurvey::from_file(partial)?;
        let manifest = survey.run_manifest(partial)?;
        let no_plan = |source: ErrorCause| Error::NoPlan { path: partial.to_owned(), source };
        let rig = survey.rig.take().ok_or_else(|| no_plan("its rig is missing or damaged".into()))?;
        let rig = Rig::from_toml(&rig).map_err(|e| no_plan(e.into()))?;
        let plan = survey.metadata.remove(topics::RUN_PLAN_METADATA);
        let plan = plan.ok_or_else(|| no_plan("it does not say what was planned".into()))?;
        let mut seen = Seen::default();
        let mut walk = RecordingReader::open(partial)?;
        while let Some(item) = walk.next_item()? {
            if let RecordingItem::Chunk(chunk) = item {
                chunk.records.iter().for_each(|record| seen.learn_record(record, &survey.channels));
            }
        }
        let (lost, bytes) = survey.loss_and_size();
        Ok(Self {
            plan,
            last: Timestamp(seen.last.max(manifest.started.0)),
            manifest,
            rig,
            attempts: seen.verdicts.len() as u64,
            times: seen.verdicts.iter().map(|(time, _)| *time).collect(),
            pairs: seen.pair_attempts(),
            bytes,
            damage: survey.damage().to_vec(),
            lost: lost.to_vec(),
            channels: survey.channels,
        })
    }

    /// Returns whether more than its end is damaged, which may be what was being written.
    pub fn is_damaged(&self) -> bool {
        self.lost.iter().any(|range| range.end < self.bytes)
    }

    /// Pairs with an accepted measurement: they are safe and are not measured again.
    pub fn accepted_count(&self) -> usize {
        self.pairs.values().filter(|pair| pair.accepted).count()
    }
}

/// What the walk has come by.
#[derive(Default)]
struct Seen {
    /// Verdicts with their times.
    verdicts: Vec<(u64, Measurement)>,
    /// Times of sweeps and responses.
    recorded: HashSet<u64>,
    last: i64,
}

impl Seen {
    fn learn_record(&mut self, record: &Record<'_>, channels: &BTreeMap<u16, Arc<Channel<'static>>>) {
        let Record::Message { header, data } = record else { return };
        self.last = self.last.max(i64::try_from(header.log_time).unwrap_or(i64::MAX));
        match channels.get(&header.channel_id).map(|channel| channel.topic.as_str()) {
            Some(topics::SWEEP | topics::IR) => drop(self.recorded.insert(header.log_time)),
            Some(topics::MEASUREMENT) => {
                self.verdicts.extend(Measurement::decode(&data[..]).ok().map(|m| (header.log_time, m)));
            }
            _ => {}
        }
    }

    // A verdict whose sweep and response are lost accepts nothing: the pair is measured again.
    fn pair_attempts(&self) -> BTreeMap<u32, PairAttempts> {
        let mut pairs = BTreeMap::new();
        for (time, verdict) in &self.verdicts {
            let tried = pairs.entry(verdict.pair_id).or_insert(PairAttempts { attempts: 0, accepted: false });
            tried.attempts = tried.attempts.max(verdict.attempt);
            tried.accepted |= verdict.verdict() == Verdict::Accepted && self.recorded.contains(time);
        }
        pairs
    }
}

impl Recorder {
    /// Resumes a recording behind all that is safe in it. What is damaged, and what stands in it of attempts without a
    /// verdict, is left behind. The file is replaced by a copy that is on the disk; until then it is as it was,
    /// whatever happens.
    ///
    /// # Errors
    /// As [`Held::from_file`]; [`Error::Busy`] where somebody records it, [`Error::Finished`] where the run is whole
    /// already, [`Error::Write`] where there is no room for the copy.
    pub fn resume_recording(partial: &Path) -> Result<(Self, Held), Error> {
        let path = partial.with_extension("");
        if partial.extension().is_none_or(|e| e != PARTIAL) {
            let source = "its name does not end in `.partial`: it is whole, or somebody else's".into();
            return Err(Error::NoPlan { path: partial.to_owned(), source });
        }
        if path.exists() {
            return Err(Error::Finished { path });
        }
        // Held until the copy stands in its place.
        let _lock = lock(partial)?;
        let held = Held::from_file(partial)?;
        let copy = path.with_extension("mcap.resuming");
        match Self::resume_behind(&held, partial, &path, &copy) {
            Ok(recorder) => Ok((recorder, held)),
            Err(error) => {
                // Whatever stands there is half a copy of what is whole elsewhere.
                let _ = std::fs::remove_file(&copy);
                Err(error)
            }
        }
    }

    fn resume_behind(held: &Held, partial: &Path, path: &Path, copy: &Path) -> Result<Self, Error> {
        let failed = |source: ErrorCause| Error::Write { path: copy.to_owned(), source };
        let file = OpenOptions::new().write(true).create(true).truncate(true).open(copy);
        let file = file.map_err(|e| failed(e.into()))?;
        // As in Recorder::create.
        let _ = file.try_lock();
        let mut writer = ChunkWriter::new(file).map_err(|e| failed(system_cause(e)))?;
        let mut walk = RecordingReader::open(partial)?;
        let mut taken = RecordingCopy::new(&mut writer, &held.channels);
        let acknowledged =
            |part: ChunkLane, header: &MessageHeader| part == ChunkLane::Light || held.times.contains(&header.log_time);
        while let Some(item) = walk.next_item()? {
            if !is_end(&item) {
                taken.copy_item(item, &acknowledged).map_err(|e| failed(system_cause(e)))?;
            }
        }
        let sequence = taken.sequence;
        let channels = Channels::register_topics(&mut writer.mcap).map_err(|e| failed(system_cause(e)))?;
        writer.sync_chunks().map_err(|e| failed(system_cause(e)))?;
        std::fs::rename(copy, partial).map_err(|e| failed(e.into()))?;
        sync_to_disk(folder_of(partial)).map_err(|e| failed(e.into()))?;
        Ok(Self::with(writer, path.to_owned(), PathBuf::from(partial), channels, sequence))
    }
}
