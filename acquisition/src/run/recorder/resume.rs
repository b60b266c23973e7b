//! A recording that is gone on with: what is safe in it, and a recorder that writes behind that.

use std::collections::{BTreeMap, HashSet};
use std::fs::OpenOptions;
use std::path::{Path, PathBuf};

use echolake_recording::{ChunkLane, ChunkWriter, MessageHeader, PrefixItem, PrefixReader, Record, system_cause};
use echolake_schema::manifest::RunManifest;
use echolake_schema::messages::{Measurement, Verdict};
use echolake_schema::{ErrorCause, Rig, Timestamp, topics};
use prost::Message as _;

use super::Recorder;
use super::channels::Channels;
use crate::disk::{folder_of, sync};
use crate::recovery::{Copy, Error, is_end, lock};

/// What the name of a recording ends in until it is whole.
const PARTIAL: &str = "partial";

/// What a recording that was broken off holds: its verified prefix.
#[derive(Debug, Clone)]
pub struct Held {
    /// The run.
    pub manifest: RunManifest,
    /// The rig that measures it.
    pub rig: Rig,
    /// What it takes to go on.
    pub plan: BTreeMap<String, String>,
    /// The pairs that have a verdict.
    pub pairs: BTreeMap<u32, Tried>,
    /// Attempts with a verdict.
    pub attempts: u64,
    /// Time of the last message.
    pub last: Timestamp,
    /// Size of the verified prefix, bytes, and of the file.
    pub bytes: [u64; 2],
    /// Times of the verdicts; sweeps and responses of other times are of attempts that nobody acknowledged.
    times: HashSet<u64>,
}

/// What is known of a pair.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tried {
    /// The highest number of an attempt; where it goes on, numbers do, too.
    pub attempts: u32,
    /// Whether one was accepted.
    pub accepted: bool,
}

impl Held {
    /// Reads what a recording holds; nothing is written.
    ///
    /// # Errors
    /// [`Error::Headless`] where it was broken off before its first checkpoint, [`Error::NoPlan`] where it was not
    /// begun as a run that can be gone on with.
    pub fn read(partial: &Path) -> Result<Self, Error> {
        let mut walk = PrefixReader::open(partial)?;
        let mut seen = Seen::default();
        while let Some(item) = walk.next_item()? {
            match item {
                PrefixItem::Chunk(records) => records.iter().for_each(|record| seen.learn(record)),
                PrefixItem::Metadata(m) => drop(seen.metadata.insert(m.name, m.metadata)),
                PrefixItem::Attachment(a) if a.name == topics::RIG_ATTACHMENT => seen.rig = Some(a.data.into_owned()),
                PrefixItem::Attachment(_) => {}
            }
        }
        let headless = |source: ErrorCause| Error::Headless { path: partial.to_owned(), source };
        let begins = |what: &str| headless(format!("it has no {what}").into());
        let record = seen.metadata.get(topics::RUN_METADATA).ok_or_else(|| begins("manifest"))?;
        let manifest = RunManifest::from_metadata(record).map_err(|e| headless(e.into()))?;
        let rig = seen.rig.and_then(|bytes| String::from_utf8(bytes).ok()).ok_or_else(|| begins("rig"))?;
        let rig = Rig::from_toml(&rig).map_err(|e| headless(e.into()))?;
        if !seen.channels.values().any(|topic| topic == topics::MEASUREMENT) {
            return Err(begins("chunk that is whole"));
        }
        let no_plan = || Error::NoPlan { path: partial.to_owned(), source: "it does not say what was planned".into() };
        Ok(Self {
            plan: seen.metadata.remove(topics::RUN_PLAN_METADATA).ok_or_else(no_plan)?,
            last: Timestamp(seen.last.max(manifest.started.0)),
            manifest,
            rig,
            pairs: seen.pairs,
            attempts: seen.attempts,
            // A recorder that ends in order writes a summary behind its data; it is made anew.
            bytes: [if walk.ended { walk.size } else { walk.verified }, walk.size],
            times: seen.times,
        })
    }

    /// Pairs with an accepted measurement: they are safe and are not measured again.
    pub fn accepted(&self) -> usize {
        self.pairs.values().filter(|pair| pair.accepted).count()
    }
}

/// What the walk has come by.
#[derive(Default)]
struct Seen {
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    rig: Option<Vec<u8>>,
    channels: BTreeMap<u16, String>,
    pairs: BTreeMap<u32, Tried>,
    attempts: u64,
    times: HashSet<u64>,
    last: i64,
}

impl Seen {
    fn learn(&mut self, record: &Record<'_>) {
        match record {
            Record::Channel(channel) => drop(self.channels.insert(channel.id, channel.topic.clone())),
            Record::Message { header, data } => {
                self.last = self.last.max(i64::try_from(header.log_time).unwrap_or(i64::MAX));
                let is_verdict = self.channels.get(&header.channel_id).is_some_and(|t| t == topics::MEASUREMENT);
                if let (true, Ok(m)) = (is_verdict, Measurement::decode(&data[..])) {
                    self.times.insert(header.log_time);
                    self.attempts += 1;
                    let tried = self.pairs.entry(m.pair_id).or_insert(Tried { attempts: 0, accepted: false });
                    tried.attempts = tried.attempts.max(m.attempt);
                    tried.accepted |= m.verdict() == Verdict::Accepted;
                }
            }
            _ => {}
        }
    }
}

impl Recorder {
    /// Goes on with a recording, behind all that is safe in it. What follows its verified prefix, and what stands in
    /// it of attempts without a verdict, is left behind. The file is replaced by a copy that is on the disk; until
    /// then it is as it was, whatever happens.
    ///
    /// # Errors
    /// As [`Held::read`]; [`Error::Busy`] where somebody records it, [`Error::Finished`] where the run is whole already,
    /// [`Error::Write`] where there is no room for the copy.
    pub fn resume(partial: &Path) -> Result<(Self, Held), Error> {
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
        let held = Held::read(partial)?;
        let copy = path.with_extension("mcap.resuming");
        match Self::behind(&held, partial, &path, &copy) {
            Ok(recorder) => Ok((recorder, held)),
            Err(error) => {
                // Whatever stands there is half a copy of what is whole elsewhere.
                let _ = std::fs::remove_file(&copy);
                Err(error)
            }
        }
    }

    fn behind(held: &Held, partial: &Path, path: &Path, copy: &Path) -> Result<Self, Error> {
        let failed = |source: ErrorCause| Error::Write { path: copy.to_owned(), source };
        let file = OpenOptions::new().write(true).create(true).truncate(true).open(copy);
        let file = file.map_err(|e| failed(e.into()))?;
        // As in Recorder::create.
        let _ = file.try_lock();
        let mut writer = ChunkWriter::new(file).map_err(|e| failed(system_cause(e)))?;
        let mut walk = PrefixReader::open(partial)?;
        let mut taken = Copy::new(&mut writer);
        let acknowledged =
            |part: ChunkLane, header: &MessageHeader| part == ChunkLane::Light || held.times.contains(&header.log_time);
        while let Some(item) = walk.next_item()? {
            if !is_end(&item) {
                taken.take(item, &acknowledged).map_err(|e| failed(system_cause(e)))?;
            }
        }
        let sequence = taken.sequence;
        let channels = Channels::register(&mut writer.mcap).map_err(|e| failed(system_cause(e)))?;
        writer.sync().map_err(|e| failed(system_cause(e)))?;
        std::fs::rename(copy, partial).map_err(|e| failed(e.into()))?;
        sync(folder_of(partial)).map_err(|e| failed(e.into()))?;
        Ok(Self::with(writer, path.to_owned(), PathBuf::from(partial), channels, sequence))
    }
}
