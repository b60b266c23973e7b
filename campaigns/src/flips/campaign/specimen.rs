//! The run files that are damaged, and the positions of their parts.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::Path;

use anyhow::{Context as _, Result, ensure};
use bytes::Bytes;
use echolake_acquisition::panel::material::SurfaceMaterial;
use echolake_acquisition::panel::mesh::Mesh;
use echolake_acquisition::panel::relief::HeightField;
use echolake_acquisition::rig::devices::simulated::{RigSimulation, devices};
use echolake_acquisition::run::controller::{RecordingMode, RunControl, RunController, RunOptions, RunWorkload};
use echolake_acquisition::run::recorder::{Recorder, Relief, RunStart};
use echolake_schema::grid::Layer;
use echolake_schema::manifest::RunManifest;
use echolake_schema::messages::{ImpulseResponse, Measurement, SweepRecording};
use echolake_schema::{Rig, RunId, SurfaceRecord, Timestamp, topics};
use mcap::records::Record;
use prost::Message as _;

/// Opcode and length in front of every record.
pub(crate) const FRAME: usize = 9;
const MAGIC: usize = 8;
/// 2026-01-05, 08:00.
const START: Timestamp = Timestamp(1_767_600_000_000_000_000);
/// Small, so that there are many chunks and a round takes milliseconds.
const PAIRS_A_CHUNK: usize = 5;

/// A run's file and its parts.
pub(crate) struct FlipSpecimen {
    pub(crate) name: &'static str,
    pub(crate) bytes: Bytes,
    /// All records, frames included.
    pub(crate) records: Vec<Range<usize>>,
    pub(crate) chunks: Vec<ChunkFacts>,
    /// Parts without which ingest refuses a file: magic bytes, manifest, rig, surface.
    pub(crate) envelope: Vec<Range<usize>>,
    /// The summary's schemas and channels.
    pub(crate) definitions: Vec<Range<usize>>,
}

/// A chunk's record and what is in it.
pub(crate) struct ChunkFacts {
    pub(crate) range: Range<usize>,
    /// Pair and attempt of each verdict.
    pub(crate) verdicts: BTreeSet<(u32, u32)>,
    /// Pair and attempt of each sweep and response.
    pub(crate) responses: BTreeSet<(u32, u32)>,
    /// True if it holds schemas and channels.
    pub(crate) defines: bool,
}

/// The rig of the campaign: ten points, 45 pairs, a sweep of 20 ms, responses of 128 samples.
pub(crate) fn rig() -> Rig {
    let mut rig = Rig::paper();
    rig.name = "flips".into();
    rig.sweep.duration_secs = 0.02;
    rig.impulse_response.length = 128;
    let layer = |points_per_side, pitch_mm, height_mm| Layer { points_per_side, pitch_mm, height_mm };
    rig.grid.layers = vec![layer(3, 150.0, 124.0), layer(1, 0.0, 304.0)];
    rig
}

impl FlipSpecimen {
    /// Measures a run with the simulated rig.
    pub(crate) fn simulate(name: &'static str, rig: &Rig, keep: RecordingMode) -> Result<Self> {
        let folder = tempfile::tempdir()?;
        let relief = HeightField::from_fn(rig.panel.size_mm, 40, |x, y| 10.0 * (x / 50.0).sin() + y / 100.0);
        let mesh = Mesh::from_height_field(&HeightField::from_fn(rig.panel.size_mm, 9, |x, _| x / 50.0), -30.0);
        let surface = "0015_0".parse()?;
        let material = SurfaceMaterial::CoatedPrint;
        let simulation = RigSimulation { rig, relief: &relief, material, start: START, seed: 1, arms: None };
        let devices = devices(&simulation)?;
        let manifest = RunManifest {
            run_id: RunId::compose(START, &surface, 0x7c1e)?,
            surface_id: surface,
            started: START,
            software: "echolake flips".into(),
            rig: rig.name.clone(),
            origin: devices.origin,
        };
        let record = SurfaceRecord { typology: "wavy".into(), ..SurfaceRecord::default() };
        let path = folder.path().join("run.mcap");
        let shape = Relief { heights: &relief, mesh: &mesh, original: None };
        let start = RunStart { manifest: &manifest, rig, surface: &record, relief: Some(shape), plan: None };
        let mut recorder = Recorder::create(&path, &start)?;
        let options = RunOptions { keep, checkpoint_every: PAIRS_A_CHUNK };
        let grid = rig.grid()?;
        let nothing = BTreeMap::new();
        let work = RunWorkload { pairs: grid.pairs(), before: &nothing, options };
        let outcome =
            RunController::new(rig, devices)?.run(&mut recorder, &work, &RunControl::default(), &mut |_| {})?;
        Self::map(name, &recorder.finish(&outcome.end)?)
    }

    fn map(name: &'static str, path: &Path) -> Result<Self> {
        let bytes = Bytes::from(std::fs::read(path)?);
        let mut specimen = Self {
            name,
            bytes: bytes.clone(),
            records: Vec::new(),
            chunks: Vec::new(),
            envelope: std::iter::once(0..MAGIC).collect(),
            definitions: Vec::new(),
        };
        let mut at = MAGIC;
        while at < bytes.len() - MAGIC {
            let length = u64::from_le_bytes(bytes[at + 1..at + FRAME].try_into()?);
            let range = at..at + FRAME + usize::try_from(length)?;
            at = range.end;
            specimen.note(range.clone())?;
            specimen.records.push(range);
        }
        ensure!(at == bytes.len() - MAGIC, "the specimen's records do not fill it");
        specimen.fill_chunks()?;
        Ok(specimen)
    }

    fn note(&mut self, range: Range<usize>) -> Result<()> {
        let body = &self.bytes[range.start + FRAME..range.end];
        match mcap::parse_record(self.bytes[range.start], body)? {
            Record::Metadata(m) if m.name == topics::RUN_METADATA => self.envelope.push(range),
            Record::Attachment { header, .. }
                if [topics::RIG_ATTACHMENT, topics::SURFACE_ATTACHMENT].contains(&header.name.as_str()) =>
            {
                self.envelope.push(range);
            }
            Record::Schema { .. } | Record::Channel(_) => self.definitions.push(range),
            _ => {}
        }
        Ok(())
    }

    fn fill_chunks(&mut self) -> Result<()> {
        let summary = mcap::Summary::read(&self.bytes)?.context("the specimen has no summary")?;
        let mut indexes = summary.chunk_indexes.clone();
        indexes.sort_by_key(|i| i.chunk_start_offset);
        for index in indexes {
            let start = usize::try_from(index.chunk_start_offset)?;
            let range = start..start + usize::try_from(index.chunk_length)?;
            let (mut verdicts, mut responses) = (BTreeSet::new(), BTreeSet::new());
            for message in summary.stream_chunk(&self.bytes, &index)? {
                let message = message?;
                match message.channel.topic.as_str() {
                    topics::MEASUREMENT => {
                        let verdict = Measurement::decode(&message.data[..])?;
                        verdicts.insert((verdict.pair_id, verdict.attempt));
                    }
                    topics::SWEEP => {
                        let sweep = SweepRecording::decode(&message.data[..])?;
                        responses.insert((sweep.pair_id, sweep.attempt));
                    }
                    topics::IR => {
                        let ir = ImpulseResponse::decode(&message.data[..])?;
                        responses.insert((ir.pair_id, ir.attempt));
                    }
                    _ => {}
                }
            }
            self.chunks.push(ChunkFacts { range, verdicts, responses, defines: self.chunks.is_empty() });
        }
        Ok(())
    }
}
