//! A whole run's file, read and measured: what becomes its rows.

use std::collections::{BTreeMap, HashSet};
use std::sync::Arc;

use bytes::Bytes;
use echolake_lake::Lake;
use echolake_recording::{DecodedChunk, FileIntegrity, Metadata, RawChunk, ResyncItem, ResyncReader, list_damage};
use echolake_schema::manifest::{Origin, RunEnd, RunManifest};
use echolake_schema::messages::{AmbientSample, Measurement, Verdict};
use echolake_schema::{ErrorCause, Rig, SurfaceId, SurfaceRecord, topics};

use crate::error::{Error, Result};
use crate::files::Opened;
use crate::measure::{Event, Measurer, Response, Yield};
use crate::pipeline::{Begun, Cores};
use crate::run_channels::RunDefinitions;

/// A run, read.
pub(crate) struct RunContent {
    pub(crate) manifest: RunManifest,
    pub(crate) end: Option<RunEnd>,
    pub(crate) surface: SurfaceRecord,
    /// Heights over a square of the panel's size, mm; empty where the run has none.
    pub(crate) heights_mm: Vec<f32>,
    /// Accepted measurements by pair.
    pub(crate) accepted: Vec<(Measurement, Response)>,
    pub(crate) rejected: u64,
    pub(crate) attempts: u64,
    pub(crate) readings: Vec<(i64, AmbientSample)>,
    pub(crate) events: Vec<(i64, Event)>,
    pub(crate) last_time_ns: i64,
    pub(crate) integrity: FileIntegrity,
    /// `recover` made the file of a recording that had no defect.
    pub(crate) recovered_whole: bool,
    /// What could not be read, in words.
    pub(crate) damaged: Vec<String>,
}

/// What became of a chunk, or will.
enum Measured {
    Here(Yield),
    Elsewhere(Begun<Yield>),
}

/// What stands outside of chunks, as far as ingest needs it: a file may have any number of others.
#[derive(Default)]
struct Envelope {
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    attachments: BTreeMap<String, Bytes>,
}

const NEEDED_METADATA: [&str; 4] =
    [topics::RUN_METADATA, topics::RUN_PLAN_METADATA, topics::RUN_END_METADATA, topics::RECOVERY_METADATA];
const NEEDED_ATTACHMENTS: [&str; 3] = [topics::RIG_ATTACHMENT, topics::SURFACE_ATTACHMENT, topics::HEIGHTS_ATTACHMENT];
/// Largest heights that are kept: those of 2048 by 2048 points.
const LARGEST_HEIGHTS: usize = 16 << 20;
/// Largest text that is kept; what it is parsed to is a multiple of it.
const LARGEST_TEXT: usize = 1 << 20;

/// What a run says of itself before its first measurement.
#[derive(Debug)]
pub(crate) struct Head {
    pub(crate) surface: SurfaceId,
    pub(crate) references: Vec<SurfaceId>,
    pub(crate) origin: Origin,
    /// It says how the run is gone on with.
    pub(crate) has_plan: bool,
    pub(crate) rig: Option<Rig>,
}

impl Head {
    /// None where the file does not begin as a run of ours does.
    pub(crate) async fn read(opened: &Opened) -> Option<Self> {
        let (store, path) = (opened.store.clone(), opened.path.clone());
        let mut reader = ResyncReader::open(store, path, opened.name.clone()).await.ok()?.without_digest();
        let mut envelope = Envelope::default();
        while let Ok(Some(item)) = reader.next_item().await {
            match item {
                ResyncItem::Attachment(found) => envelope.keep_attachment(found.name, found.data),
                ResyncItem::Metadata(record) => envelope.keep_metadata(record),
                ResyncItem::Definition(_) => {}
                ResyncItem::Chunk(_) => break,
            }
        }
        let manifest = RunManifest::from_metadata(envelope.metadata.get(topics::RUN_METADATA)?).ok()?;
        let surface = envelope.surface(&opened.name).ok()?;
        let references = [surface.flat_reference, surface.foam_reference].into_iter().flatten().collect();
        let has_plan = envelope.metadata.contains_key(topics::RUN_PLAN_METADATA);
        let rig = envelope.rig(&opened.name).ok();
        Some(Self { surface: manifest.surface_id, references, origin: manifest.origin, has_plan, rig })
    }
}

impl RunContent {
    /// Reads a run; its chunks are measured on all cores while the next ones are fetched.
    pub(crate) async fn read(lake: &Lake, measurer: &Arc<Measurer>, cores: &Cores, opened: &Opened) -> Result<Self> {
        let name = opened.name.as_str();
        let mut reader = ResyncReader::open(opened.store.clone(), opened.path.clone(), name.to_owned()).await?;
        let mut envelope = Envelope::default();
        let mut definitions = RunDefinitions::default();
        let mut whole = Yield { last_time_ns: i64::MIN, ..Yield::default() };
        let mut checked = false;
        let busy = cores.busy();
        let budget = Arc::new(measurer.run_budget());
        let mut measured: Vec<Measured> = Vec::new();
        let mut seen = HashSet::new();
        // Chunks whose channels are not known yet: the chunk that introduces them is damaged, the summary has them too.
        let mut waiting = Vec::new();
        while let Some(item) = reader.next_item().await? {
            match item {
                ResyncItem::Chunk(raw) => {
                    if !checked && envelope.is_complete() {
                        envelope.check(lake, name)?;
                        checked = true;
                    }
                    let (begin, length) = (raw.offset, raw.body.len() as u64);
                    match budget.take_chunk().and_then(|()| decode(&raw)) {
                        Ok((offset, chunk)) if !seen.insert(chunk.identity()) => {
                            list_damage(&mut whole.damaged, || {
                                format!("the chunk at byte {offset}: a copy of one before it")
                            });
                        }
                        Ok((offset, chunk)) => {
                            let learned = definitions.learn_chunk(&chunk);
                            learned.map_err(|what| Error::read(name, format!("the chunk at byte {offset}: {what}")))?;
                            if !definitions.knows(&chunk) {
                                waiting.push((offset, length));
                                continue;
                            }
                            let (measurer, channels) = (measurer.clone(), definitions.channels.clone());
                            let (budget, permit) = (budget.clone(), raw.permit);
                            let work = move || {
                                let measured = measurer.process(offset, &chunk, &channels, &budget);
                                drop((chunk, permit));
                                measured
                            };
                            // Another core would have to fetch what this one has in its cache, so it gets a chunk only
                            // where it has nothing else to do. That also bounds how many are in memory.
                            measured.push(match cores.is_one_idle() {
                                true => Measured::Elsewhere(cores.begin(work)),
                                false => Measured::Here(work()),
                            });
                            tokio::task::yield_now().await;
                        }
                        Err(reason) => {
                            list_damage(&mut whole.damaged, || reason);
                            reader.look_into(begin).await?;
                        }
                    }
                }
                ResyncItem::Attachment(found) => envelope.keep_attachment(found.name, found.data),
                ResyncItem::Metadata(record) => envelope.keep_metadata(record),
                ResyncItem::Definition(record) => definitions.learn(&record),
            }
        }
        let manifest = envelope.check(lake, name)?;
        drop(busy);
        for part in measured {
            whole.append(match part {
                Measured::Here(part) => part,
                Measured::Elsewhere(part) => part.done().await,
            });
        }
        for (offset, length) in waiting {
            let raw = reader.again(offset, length).await?;
            let (offset, chunk) = decode(&raw).map_err(|e| Error::read(name, e))?;
            let (measurer, channels, budget) = (measurer.clone(), definitions.channels.clone(), budget.clone());
            whole.append(cores.compute(move || measurer.process(offset, &chunk, &channels, &budget)).await);
        }
        let integrity = reader.finish().await?;
        if !integrity.damage.is_empty() || !integrity.closed {
            vouch(&manifest, name)?;
        }
        Self::assemble(manifest, envelope, whole, integrity, name)
    }

    fn assemble(
        manifest: RunManifest,
        envelope: Envelope,
        whole: Yield,
        integrity: FileIntegrity,
        name: &str,
    ) -> Result<Self> {
        let mut damaged = integrity.damage.clone();
        for line in whole.damaged {
            list_damage(&mut damaged, || line);
        }
        // How a run ended is no reason to refuse what it measured.
        let end = envelope.metadata.get(topics::RUN_END_METADATA).map(RunEnd::from_metadata);
        let end = end.and_then(|end| end.map_err(|cause| damaged.push(cause.to_string())).ok());
        let recovery = envelope.metadata.get(topics::RECOVERY_METADATA);
        let recovered_whole = recovery.is_some_and(|record| record.get("defect").is_some_and(String::is_empty));
        let responses = best_responses(whole.responses);
        let rejected = given_up(&whole.verdicts);
        let attempts = whole.verdicts.len() as u64;
        let accepted = join(whole.verdicts, responses, &mut damaged);
        Ok(Self {
            surface: envelope.surface(name)?,
            heights_mm: envelope.heights(),
            manifest,
            end,
            accepted,
            rejected,
            attempts,
            readings: whole.readings,
            events: whole.events,
            last_time_ns: whole.last_time_ns,
            integrity,
            recovered_whole,
            damaged,
        })
    }

    /// The file was closed and says how the run ended.
    pub(crate) fn is_whole(&self) -> bool {
        self.integrity.closed && self.end.is_some()
    }

    /// The run was stopped before its end, and `recover` found nothing that was lost.
    pub(crate) fn is_stopped(&self) -> bool {
        self.integrity.closed && self.end.is_none() && self.recovered_whole
    }
}

impl Envelope {
    // The first of a name counts.
    fn keep_attachment(&mut self, name: String, data: Bytes) {
        let most = if name == topics::HEIGHTS_ATTACHMENT { LARGEST_HEIGHTS } else { LARGEST_TEXT };
        if NEEDED_ATTACHMENTS.contains(&name.as_str()) && data.len() <= most {
            // A copy: the bytes are part of whatever was fetched with them.
            self.attachments.entry(name).or_insert_with(|| Bytes::copy_from_slice(&data));
        }
    }

    fn keep_metadata(&mut self, record: Metadata) {
        if NEEDED_METADATA.contains(&record.name.as_str()) {
            self.metadata.entry(record.name).or_insert(record.metadata);
        }
    }

    // Other writers may put what the run is behind its first chunks.
    fn is_complete(&self) -> bool {
        self.metadata.contains_key(topics::RUN_METADATA) && self.attachments.contains_key(topics::RIG_ATTACHMENT)
    }

    // Checked before chunks are measured where that can be, so that a wrong file costs nothing.
    fn check(&self, lake: &Lake, name: &str) -> Result<RunManifest> {
        let Some(record) = self.metadata.get(topics::RUN_METADATA) else {
            return Err(Error::Foreign { file: name.to_owned() });
        };
        let manifest =
            RunManifest::from_metadata(record).map_err(|cause| Error::Manifest { file: name.to_owned(), cause })?;
        lake.fits(&self.rig(name)?)?;
        Ok(manifest)
    }

    fn rig(&self, name: &str) -> Result<Rig> {
        let wrong = |source: ErrorCause| Error::Attachment {
            file: name.to_owned(),
            attachment: topics::RIG_ATTACHMENT,
            source,
        };
        let bytes = self.attachments.get(topics::RIG_ATTACHMENT).ok_or_else(|| wrong("is missing".into()))?;
        let text = std::str::from_utf8(bytes).map_err(|e| wrong(format!("is no text: {e}").into()))?;
        Rig::from_toml(text).map_err(|e| wrong(e.into()))
    }

    fn surface(&self, name: &str) -> Result<SurfaceRecord> {
        let wrong = |source: ErrorCause| Error::Attachment {
            file: name.to_owned(),
            attachment: topics::SURFACE_ATTACHMENT,
            source,
        };
        let bytes = self.attachments.get(topics::SURFACE_ATTACHMENT).ok_or_else(|| wrong("is missing".into()))?;
        serde_json::from_slice(bytes).map_err(|e| wrong(e.into()))
    }

    fn heights(&self) -> Vec<f32> {
        let bytes = self.attachments.get(topics::HEIGHTS_ATTACHMENT).map_or(&[][..], |b| &b[..]);
        bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
    }
}

impl Yield {
    fn append(&mut self, mut other: Self) {
        self.responses.append(&mut other.responses);
        self.verdicts.append(&mut other.verdicts);
        self.readings.append(&mut other.readings);
        self.events.append(&mut other.events);
        for line in other.damaged {
            list_damage(&mut self.damaged, || line);
        }
        self.last_time_ns = self.last_time_ns.max(other.last_time_ns);
    }
}

// Where something outside of chunks is damaged, the manifest may be, too.
fn vouch(manifest: &RunManifest, name: &str) -> Result<()> {
    if manifest.fits_file_name(name) {
        return Ok(());
    }
    let file = name.rsplit(['/', '\\']).next().unwrap_or_default();
    let reason = format!(
        "it is damaged, and its manifest may be: it says run `{}` of `{}`, begun {}, in a file named `{file}`; \
         hint: if it is right, name the file after the run",
        manifest.run_id, manifest.surface_id, manifest.started
    );
    Err(Error::Doubtful { file: name.to_owned(), reason })
}

// Where the walk is: it takes less than the digest of the same bytes, and to hand it to another thread as much again.
fn decode(raw: &RawChunk) -> std::result::Result<(u64, DecodedChunk), String> {
    let chunk = DecodedChunk::decode(&raw.body);
    let chunk = chunk.map_err(|reason| format!("the chunk at byte {}: {reason}", raw.offset))?;
    Ok((raw.offset, chunk))
}

// A recording that is there twice, as sweep and as response, counts as sweep.
fn best_responses(responses: Vec<Response>) -> BTreeMap<(u32, u32), Response> {
    let mut best: BTreeMap<(u32, u32), Response> = BTreeMap::new();
    for response in responses {
        let key = (response.pair, response.attempt);
        if best.get(&key).is_none_or(|b| b.source < response.source) {
            best.insert(key, response);
        }
    }
    best
}

// Pairs without an accepted attempt. A run that is gone on with tries those again that it gave up before.
fn given_up(verdicts: &[(i64, Measurement)]) -> u64 {
    let of = |verdict: Verdict| -> HashSet<u32> {
        verdicts.iter().filter(|v| v.1.verdict() == verdict).map(|v| v.1.pair_id).collect()
    };
    of(Verdict::Rejected).difference(&of(Verdict::Accepted)).count() as u64
}

// The last accepted attempt at a pair is its measurement.
fn join(
    verdicts: Vec<(i64, Measurement)>,
    mut responses: BTreeMap<(u32, u32), Response>,
    damaged: &mut Vec<String>,
) -> Vec<(Measurement, Response)> {
    let mut last: BTreeMap<u32, Measurement> = BTreeMap::new();
    for (_, verdict) in verdicts {
        if verdict.verdict() == Verdict::Accepted
            && last.get(&verdict.pair_id).is_none_or(|v| v.attempt <= verdict.attempt)
        {
            last.insert(verdict.pair_id, verdict);
        }
    }
    let mut accepted = Vec::with_capacity(last.len());
    for (pair, verdict) in last {
        match responses.remove(&(pair, verdict.attempt)) {
            Some(response) => accepted.push((verdict, response)),
            None => list_damage(damaged, || {
                format!("pair {pair}, attempt {}: its response cannot be read", verdict.attempt)
            }),
        }
    }
    accepted
}
