//! Damages run files in many ways and checks what ingest makes of them.

mod damage;
mod specimen;

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Once};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use echolake_acquisition::run::controller::RecordingMode;
use echolake_ingest::{InspectedMeasurement, RunInspection, inspect};
use echolake_lake::{Lake, ReferenceSurfaces};
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _};
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use damage::{DamageKind, DamagedFile};
use specimen::FlipSpecimen;

/// A round that takes longer hangs: they take milliseconds, and more on a busy machine.
const HANGS: Duration = Duration::from_secs(120);
/// File name that errors must contain. A run's file has the run's name.
const NAME: &str = "runs/0015_0/20260105T080000Z-0015_0-0000000000007c1e.mcap";

static PANICS: AtomicUsize = AtomicUsize::new(0);

/// Rounds and seed of a campaign.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FlipSettings {
    /// Rounds.
    pub(crate) count: u64,
    /// Seed of all rounds.
    pub(crate) seed: u64,
    /// The first round; each is the same whatever came before it.
    pub(crate) first: u64,
}

/// Outcomes of the rounds of one kind.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct OutcomeTally {
    pub(crate) rounds: u64,
    /// Files of which every measurement was kept.
    pub(crate) complete: u64,
    /// Files that lost some, and said so.
    pub(crate) partial: u64,
    /// Files that were refused.
    pub(crate) refused: u64,
    /// Measurements that were returned, of files that were not refused.
    pub(crate) kept: u64,
    /// Measurements that were not, of files that were not refused.
    pub(crate) lost: u64,
    /// Files whose channels nothing introduces any more: chunk and summary are both damaged.
    pub(crate) undefined: u64,
    /// Measurements in whole chunks of those.
    pub(crate) unnamed: u64,
    /// Damaged files in which nothing was found to be damaged.
    pub(crate) unnoticed: u64,
}

/// Outcomes of all rounds.
#[derive(Debug)]
pub(crate) struct FlipSummary {
    pub(crate) by_kind: Vec<(&'static str, OutcomeTally)>,
    /// Descriptions of the violations, with the round.
    pub(crate) failures: Vec<String>,
    pub(crate) slowest: Duration,
    /// Name, bytes, chunks and measurements of each specimen.
    pub(crate) specimens: Vec<(&'static str, usize, usize, usize)>,
}

/// A specimen and what ingest makes of it undamaged.
struct TestSubject {
    specimen: FlipSpecimen,
    whole: RunInspection,
    /// Results of ingest from the recorded responses: they are taken if their sweeps cannot be read.
    from_responses: Vec<InspectedMeasurement>,
}

/// Runs the campaign; `progress` is called after each round.
///
/// # Errors
/// If the specimens cannot be made; what the rounds find is in the summary.
pub(crate) async fn run(settings: FlipSettings, progress: &mut dyn FnMut(u64)) -> Result<FlipSummary> {
    count_panics();
    let rig = specimen::rig();
    let lake = Lake::open_or_create("memory://", &rig, &ReferenceSurfaces::default()).await?;
    let mut subjects = Vec::new();
    for (name, keep) in [("sweeps", RecordingMode::Sweeps), ("responses", RecordingMode::ResponsesOnly)] {
        let specimen = FlipSpecimen::simulate(name, &rig, keep)?;
        let whole = read(&lake, specimen.bytes.clone()).await?.context("an undamaged file is refused")?;
        ensure!(NAME == format!("runs/{}/{}.mcap", whole.surface, whole.run), "it is run {}", whole.run);
        ensure!(whole.whole && whole.damaged.is_empty(), "undamaged, but {:?}", whole.damaged);
        ensure!(whole.measurements.len() > specimen.chunks.len(), "too few measurements: {}", whole.measurements.len());
        subjects.push(TestSubject { specimen, whole, from_responses: Vec::new() });
    }
    // The same seed: the second specimen is the first one without its sweeps.
    if let [sweeps, responses] = &mut subjects[..] {
        sweeps.from_responses.clone_from(&responses.whole.measurements);
    }
    let mut summary = FlipSummary {
        by_kind: DamageKind::ALL.map(|k| (k.label(), OutcomeTally::default())).to_vec(),
        failures: Vec::new(),
        slowest: Duration::ZERO,
        specimens: subjects.iter().map(TestSubject::facts).collect(),
    };
    for round in settings.first..settings.first + settings.count {
        let mut rng = ChaCha8Rng::seed_from_u64(settings.seed);
        rng.set_stream(round);
        let number = rng.random_range(0..DamageKind::ALL.len());
        let subject = &subjects[rng.random_range(0..subjects.len())];
        let damaged = DamagedFile::new(&subject.specimen, DamageKind::ALL[number], &mut rng)?;
        let begun = Instant::now();
        let outcome = subject.round(&lake, DamageKind::ALL[number], &damaged, &mut summary.by_kind[number].1).await;
        summary.slowest = summary.slowest.max(begun.elapsed());
        if let Err(reason) = outcome {
            let (kind, name) = (DamageKind::ALL[number].label(), subject.specimen.name);
            summary.failures.push(format!("--seed {} --first {round} ({kind}, {name}): {reason:#}", settings.seed));
        }
        progress(round);
    }
    Ok(summary)
}

/// Reads a file as ingest does. The outer error is a hang or a panic, the inner one a refusal.
async fn read(lake: &Lake, bytes: bytes::Bytes) -> Result<echolake_ingest::Result<RunInspection>> {
    let panics = PANICS.load(Ordering::Relaxed);
    let lake = lake.clone();
    let task = tokio::spawn(async move {
        let (store, path): (Arc<dyn ObjectStore>, _) = (Arc::new(InMemory::new()), Path::from(NAME));
        store.put(&path, bytes.into()).await?;
        anyhow::Ok(inspect(&lake, store, &path, NAME).await)
    });
    let read = tokio::time::timeout(HANGS, task).await.context("it hangs")?.context("it panicked")??;
    ensure!(PANICS.load(Ordering::Relaxed) == panics, "something panicked");
    Ok(read)
}

fn count_panics() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            PANICS.fetch_add(1, Ordering::Relaxed);
            before(info);
        }));
    });
}

impl TestSubject {
    fn facts(&self) -> (&'static str, usize, usize, usize) {
        let Self { specimen, whole, .. } = self;
        (specimen.name, specimen.bytes.len(), specimen.chunks.len(), whole.measurements.len())
    }

    async fn round(
        &self,
        lake: &Lake,
        kind: DamageKind,
        damaged: &DamagedFile,
        tally: &mut OutcomeTally,
    ) -> Result<()> {
        tally.rounds += 1;
        let bytes = damaged.bytes(&self.specimen);
        let differs = bytes != self.specimen.bytes;
        let inspection = match read(lake, bytes).await? {
            Ok(inspection) => inspection,
            Err(error) => {
                tally.refused += 1;
                ensure!(error.to_string().contains(NAME), "refused without its name: {error}");
                let reason = self.specimen.envelope.iter().find(|part| !damaged.keeps(part));
                return reason.map(drop).with_context(|| format!("refused, though what it is was whole: {error}"));
            }
        };
        let lost = self.whole.measurements.len().saturating_sub(inspection.measurements.len());
        tally.kept += inspection.measurements.len() as u64;
        tally.lost += lost as u64;
        if lost == 0 {
            tally.complete += 1
        } else {
            tally.partial += 1
        }
        if differs && inspection.damaged.is_empty() {
            tally.unnoticed += 1;
        }
        ensure!(lost == 0 || !inspection.damaged.is_empty(), "{lost} measurements are lost and nothing says so");
        if kind == DamageKind::Sealed {
            return plausible(&inspection);
        }
        let (run, surface) = (&inspection.run, &inspection.surface);
        ensure!((run, surface) == (&self.whole.run, &self.whole.surface), "it became run {run} of {surface}");
        self.unaltered(&inspection)?;
        self.untouched(damaged, &inspection, tally)
    }

    /// Checks that all returned measurements and readings are the measured ones, bit for bit and once.
    fn unaltered(&self, inspection: &RunInspection) -> Result<()> {
        let mut pairs = BTreeSet::new();
        for measured in &inspection.measurements {
            let same = |m: &&InspectedMeasurement| m.pair == measured.pair && m.attempt == measured.attempt;
            ensure!(self.whole.measurements.iter().any(|m| same(&m)), "pair {} is new", measured.pair);
            let bits = |m: &InspectedMeasurement| m.ir.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
            let mut made = self.whole.measurements.iter().chain(&self.from_responses).filter(same);
            ensure!(made.any(|m| bits(m) == bits(measured)), "pair {} is another than was measured", measured.pair);
            ensure!(pairs.insert(measured.pair), "pair {} is there twice", measured.pair);
        }
        let (all, mut readings) = (BTreeSet::from_iter(&self.whole.readings_ns), BTreeSet::new());
        for reading in &inspection.readings_ns {
            ensure!(all.contains(reading), "the reading at {reading} ns is new");
            ensure!(readings.insert(reading), "the reading at {reading} ns is there twice");
        }
        Ok(())
    }

    /// Checks that measurements in chunks without damage, verdict and sweep or response, are returned.
    fn untouched(&self, damaged: &DamagedFile, inspection: &RunInspection, tally: &mut OutcomeTally) -> Result<()> {
        let whole = || self.specimen.chunks.iter().filter(|c| damaged.keeps(&c.range));
        let returned: BTreeSet<_> = inspection.measurements.iter().map(|m| (m.pair, m.attempt)).collect();
        let expected = |m: &&InspectedMeasurement| {
            let key = (m.pair, m.attempt);
            whole().any(|c| c.verdicts.contains(&key)) && whole().any(|c| c.responses.contains(&key))
        };
        let missing = self.whole.measurements.iter().filter(expected);
        let missing: Vec<_> = missing.map(|m| (m.pair, m.attempt)).filter(|m| !returned.contains(m)).collect();
        // Messages carry a channel's number only, and its definition is in two places.
        if !whole().any(|c| c.defines) && !self.specimen.definitions.iter().all(|d| damaged.keeps(d)) {
            tally.undefined += u64::from(!missing.is_empty());
            tally.unnamed += missing.len() as u64;
            return Ok(());
        }
        ensure!(
            missing.is_empty(),
            "in whole chunks, but not returned: {missing:?}; reported: {:?}",
            inspection.damaged
        );
        Ok(())
    }
}

/// Makes the checks that are left if the CRC vouches for damaged bytes.
fn plausible(inspection: &RunInspection) -> Result<()> {
    let length = specimen::rig().impulse_response.length;
    for m in &inspection.measurements {
        ensure!(m.ir.len() == length, "pair {} has {} samples", m.pair, m.ir.len());
        ensure!(m.ir.iter().all(|x| x.is_finite()), "pair {} is not finite", m.pair);
    }
    Ok(())
}
