//! A whole run's file, read and measured: what becomes its rows.

use std::collections::{BTreeMap, HashSet};
use std::sync::Arc;

use echolake_lake::Lake;
use echolake_recording::{DecodedChunk, FileIntegrity, RawChunk, ResyncItem, ResyncReader, list_damage};
use echolake_schema::manifest::{RunEnd, RunManifest};
use echolake_schema::messages::{AmbientSample, Measurement, Verdict};
use echolake_schema::{SurfaceRecord, topics};

use super::measure::{ChunkResults, Event, Measurer, Response};
use super::run_channels::RunDefinitions;
use super::run_envelope::RunEnvelope;
use crate::error::{Error, Result};
use crate::inbox::OpenedRun;
use crate::pipeline::{Cores, PendingComputation};

/// A run, read.
pub(crate) struct RunContent {
    pub manifest: RunManifest,
    pub end: Option<RunEnd>,
    pub surface: SurfaceRecord,
    /// Heights over a square of the panel's size, mm; empty where the run has none.
    pub heights_mm: Vec<f32>,
    /// Accepted measurements by pair.
    pub accepted: Vec<(Measurement, Response)>,
    pub rejected: u64,
    pub attempts: u64,
    pub readings: Vec<(i64, AmbientSample)>,
    pub events: Vec<(i64, Event)>,
    pub last_time_ns: i64,
    pub integrity: FileIntegrity,
    /// `recover` made the file of a recording that had no defect.
    pub recovered_whole: bool,
    /// What could not be read, in words.
    pub damaged: Vec<String>,
}

/// What became of a chunk, or will.
enum ChunkMeasurement {
    Here(ChunkResults),
    Elsewhere(PendingComputation<ChunkResults>),
}

impl RunContent {
    /// Reads a run; its chunks are measured on all cores while the next ones are fetched.
    pub async fn read_from(lake: &Lake, measurer: &Arc<Measurer>, cores: &Cores, opened: &OpenedRun) -> Result<Self> {
        let name = opened.name.as_str();
        let mut reader = ResyncReader::open(opened.store.clone(), opened.path.clone(), name.to_owned()).await?;
        let mut envelope = RunEnvelope::default();
        let mut definitions = RunDefinitions::default();
        let mut whole = ChunkResults { last_time_ns: i64::MIN, ..ChunkResults::default() };
        let mut checked = false;
        let busy = cores.mark_busy();
        let budget = Arc::new(measurer.run_budget());
        let mut measured: Vec<ChunkMeasurement> = Vec::new();
        let mut seen = HashSet::new();
        // Chunks whose channels are not known yet: the chunk that introduces them is damaged, the summary has them too.
        let mut waiting = Vec::new();
        while let Some(item) = reader.next_item().await? {
            match item {
                ResyncItem::Chunk(raw) => {
                    if !checked && envelope.is_complete() {
                        envelope.checked_manifest(lake, name)?;
                        checked = true;
                    }
                    let begin = raw.offset;
                    let length = raw.body.len() as u64;
                    match budget.take_chunk().and_then(|()| decode_chunk(&raw, measurer.take_memory())) {
                        Ok((offset, chunk)) if !seen.insert(chunk.identity()) => {
                            list_damage(&mut whole.damaged, || {
                                format!("the chunk at byte {offset}: a copy of one before it")
                            });
                        }
                        Ok((offset, chunk)) => {
                            let learned = definitions.learn_chunk(&chunk);
                            learned.map_err(|what| {
                                Error::read_failure(name, format!("the chunk at byte {offset}: {what}"))
                            })?;
                            if !definitions.has_channels_of(&chunk) {
                                waiting.push((offset, length));
                                continue;
                            }
                            let measurer = measurer.clone();
                            let channels = definitions.channels.clone();
                            let budget = budget.clone();
                            let permit = raw.permit;
                            let work = move || {
                                let measured = measurer.process_chunk(offset, &chunk, &channels, &budget);
                                measurer.return_memory(chunk.into_memory());
                                drop(permit);
                                measured
                            };
                            // Another core would have to fetch what this one has in its cache, so it gets a chunk only
                            // where it has nothing else to do. That also bounds how many are in memory.
                            measured.push(match cores.is_one_idle() {
                                true => ChunkMeasurement::Elsewhere(cores.begin_on_core(work)),
                                false => ChunkMeasurement::Here(work()),
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
                ResyncItem::Definition(record) => definitions.learn_definition(&record),
            }
        }
        let manifest = envelope.checked_manifest(lake, name)?;
        drop(busy);
        for part in measured {
            whole.append(match part {
                ChunkMeasurement::Here(part) => part,
                ChunkMeasurement::Elsewhere(part) => part.wait_for_result().await,
            });
        }
        for (offset, length) in waiting {
            let raw = reader.reread_chunk(offset, length).await?;
            let (offset, chunk) = decode_chunk(&raw, Vec::new()).map_err(|e| Error::read_failure(name, e))?;
            let measurer = measurer.clone();
            let channels = definitions.channels.clone();
            let budget = budget.clone();
            whole.append(
                cores.compute_on_core(move || measurer.process_chunk(offset, &chunk, &channels, &budget)).await,
            );
        }
        let integrity = reader.finish().await?;
        if !integrity.damage.is_empty() || !integrity.closed {
            check_manifest(&manifest, name)?;
        }
        Self::from_parts(manifest, envelope, whole, integrity, name)
    }

    fn from_parts(
        manifest: RunManifest,
        envelope: RunEnvelope,
        whole: ChunkResults,
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
        let responses = select_responses(whole.responses);
        let rejected = count_given_up(&whole.verdicts);
        let attempts = whole.verdicts.len() as u64;
        let accepted = join_verdicts(whole.verdicts, responses, &mut damaged);
        Ok(Self {
            surface: envelope.parse_surface(name)?,
            heights_mm: envelope.decode_heights(),
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
    pub fn is_whole(&self) -> bool {
        self.integrity.closed && self.end.is_some()
    }

    /// The run was stopped before its end, and `recover` found nothing that was lost.
    pub fn is_stopped(&self) -> bool {
        self.integrity.closed && self.end.is_none() && self.recovered_whole
    }
}

impl ChunkResults {
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
fn check_manifest(manifest: &RunManifest, name: &str) -> Result<()> {
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
fn decode_chunk(raw: &RawChunk, memory: Vec<u8>) -> std::result::Result<(u64, DecodedChunk), String> {
    let chunk = DecodedChunk::decode_into(&raw.body, memory);
    let chunk = chunk.map_err(|reason| format!("the chunk at byte {}: {reason}", raw.offset))?;
    Ok((raw.offset, chunk))
}

// A recording that is there twice, as sweep and as response, counts as sweep.
fn select_responses(responses: Vec<Response>) -> BTreeMap<(u32, u32), Response> {
    let mut best: BTreeMap<(u32, u32), Response> = BTreeMap::new();
    for response in responses {
        let key = (response.pair, response.attempt);
        if best.get(&key).is_none_or(|b| b.source < response.source) {
            best.insert(key, response);
        }
    }
    best
}

// Pairs without an accepted attempt. A resumed run tries those again that it gave up before.
fn count_given_up(verdicts: &[(i64, Measurement)]) -> u64 {
    let of = |verdict: Verdict| -> HashSet<u32> {
        verdicts.iter().filter(|v| v.1.verdict() == verdict).map(|v| v.1.pair_id).collect()
    };
    of(Verdict::Rejected).difference(&of(Verdict::Accepted)).count() as u64
}

// The last accepted attempt at a pair is its measurement.
fn join_verdicts(
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
