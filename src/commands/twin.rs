//! `echolake twin`: a surface's run beside the one that the simulated rig computes for the heights that the run holds.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::Context as _;
use clap::Args;
use echolake_acquisition::run::RunRequest;
use echolake_acquisition::run::controller::RecordingMode;
use echolake_acquisition::run::simulate::run_simulation;
use echolake_ingest::{LakeIngest, RemovedFile, find_removals, pending_runs};
use echolake_lake::Lake;
use echolake_panel::PanelSpecimen;
use echolake_panel::material::SurfaceMaterial;
use echolake_panel::mesh::{BACK_MM, Mesh, MeshFormat, PanelSide};
use echolake_panel::relief::{HeightField, PanelRelief};
use echolake_query::Session;
use echolake_recording::{RecordingItem, RecordingReader};
use echolake_schema::manifest::Origin;
use echolake_schema::simulation::TRUSTED_PHASE;
use echolake_schema::{ProjectName, Rig, RunId, SurfaceId, SurfaceRecord, Timestamp, topics};
use serde::{Deserialize, Serialize};
use tempfile::TempDir;

use crate::CommandOutcome;
use crate::progress::CommandProgress;

#[derive(Debug, Args)]
pub(crate) struct TwinArgs {
    /// The measured surface.
    pub surface: SurfaceId,
    /// Number of listed pairs, those with the largest differences.
    #[arg(long, value_name = "N", default_value_t = 10)]
    pub pairs: usize,
    /// Print the differences as JSON.
    #[arg(long)]
    pub json: bool,
}

/// Begin of the names of computed surfaces.
const TWIN: &str = "twin_";
const FLAT: &str = "twin_flat";
const FOAM: &str = "twin_foam";
/// Revision of the computed runs: those of another one are computed again. A test fails if their numbers change and it
/// does not. Revision 1 had coarser meshes.
const TWIN_REVISION: u32 = 2;
/// Time that the runs' names have: a computed run has no time of its own.
const COMPUTED_AT: Timestamp = revision_time(TWIN_REVISION);

// An hour per revision from 2026-01-05 07:00 UTC.
const fn revision_time(revision: u32) -> Timestamp {
    Timestamp(1_767_596_400_000_000_000 + revision as i64 * 3_600_000_000_000)
}

/// Differences of a band over the pairs, the surface less its twin.
#[derive(Debug, Serialize, Deserialize)]
struct BandDifference {
    band: String,
    pairs: i64,
    surface_db: Option<f64>,
    twin_db: Option<f64>,
    mean_db: Option<f64>,
    rms_db: Option<f64>,
    p5_db: Option<f64>,
    p95_db: Option<f64>,
    /// Phase of the relief's details, rad.
    detail_phase: Option<f64>,
}

/// Difference of a pair in one band, the surface less its twin.
#[derive(Debug, Serialize, Deserialize)]
struct PairDifference {
    pair_id: i64,
    microphone: i64,
    speaker: i64,
    band: String,
    surface_db: f64,
    twin_db: f64,
    difference_db: f64,
}

#[derive(Deserialize)]
struct SurfaceOrigin {
    origin: Option<String>,
}

/// All differences of a surface from its twin.
#[derive(Debug, Serialize)]
struct TwinDifferences {
    surface_id: SurfaceId,
    /// Origin of the surface's signals, as `measured` or `simulated`.
    origin: String,
    twin_id: SurfaceId,
    /// `computed`: the twin is no measurement.
    twin_origin: &'static str,
    bands: Vec<BandDifference>,
    pairs: Vec<PairDifference>,
}

pub(crate) async fn run_twin(args: &TwinArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let surface = &args.surface;
    anyhow::ensure!(
        !surface.as_str().starts_with(TWIN),
        "surface `{surface}` is computed itself; hint: name the measured one"
    );
    let stop = super::stop_request()?;
    let lake = Lake::open(lake_url).await?;
    lake.ensure_tables().await?;
    let progress = CommandProgress::new();
    progress.print_message("simulated rig: the twin is computed, not measured");
    let path = super::replay::run_file(&lake, surface.as_str()).await?;
    let computing = TwinComputation::new(&lake, surface, &path).await?;
    let runs = computing.compared.clone();
    let flag = stop.clone();
    tokio::task::spawn_blocking(move || computing.compute_missing(flag.flag(), &progress)).await??;
    anyhow::ensure!(!stop.is_made(), "stopped; hint: run the same command again to resume");
    super::ingest::ingest_runs(&lake, pending_runs(&lake).await?, stop.flag(), &CommandProgress::new()).await?;
    anyhow::ensure!(!stop.is_made(), "stopped; hint: run the same command again to resume");
    remove_superseded_runs(&lake, stop.flag()).await?;
    let differences = TwinDifferences::read_from_lake(&lake, surface, &runs, args.pairs).await?;
    match args.json {
        true => super::print_line(&serde_json::to_string_pretty(&differences)?)?,
        false => differences.print_differences()?,
    }
    Ok(CommandOutcome::Whole)
}

/// Removes the computed runs of earlier revisions, whichever surface they are twins of. References would be means over
/// both revisions, and the remaining twins of the earlier one would be over references of the later one.
async fn remove_superseded_runs(lake: &Lake, stop: &Arc<AtomicBool>) -> anyhow::Result<()> {
    let snapshot = lake.snapshot().await?;
    let superseded = snapshot.runs().map(|visible| &visible.run).filter(|run| is_superseded(run));
    let names: Vec<_> = superseded.map(ToString::to_string).collect();
    if names.is_empty() {
        return Ok(());
    }
    let told = format!("computed runs of an earlier revision of the simulation are removed: {}", names.join(", "));
    CommandProgress::new().print_message(&told);
    let mut removals = find_removals(lake, &names).await?;
    let ingest = LakeIngest::new(lake, stop.clone());
    let removed = async {
        ingest.remove_runs(&mut removals, RemovedFile::Deleted, "echolake twin").await?;
        ingest.complete_runs(&mut |_, _| {}).await
    };
    let removed = removed.await;
    ingest.release_claims().await;
    removed?;
    Ok(())
}

fn is_superseded(run: &RunId) -> bool {
    let is_of = |revision| run.as_str().starts_with(&format!("{}-", revision_time(revision).compact_text()));
    run.surface_name().starts_with(TWIN) && (1..TWIN_REVISION).any(is_of)
}

/// The runs that are to be computed.
struct TwinComputation {
    rig: Rig,
    folder: PathBuf,
    /// The mesh, as long as runs are computed for it.
    _mesh: TempDir,
    runs: Vec<ComputedRun>,
    compared: ComparedRuns,
}

/// The surface's newest run, and the one that is computed for its heights.
#[derive(Clone)]
struct ComparedRuns {
    measured: RunId,
    twin: RunId,
}

/// A run that is to be computed.
struct ComputedRun {
    surface: SurfaceId,
    /// That of the measured surface.
    project: Option<ProjectName>,
    specimen: PanelSpecimen,
    tag: u64,
}

impl TwinComputation {
    /// Plans the runs that the lake lacks: the references', and that of the heights in the measured run's file.
    async fn new(lake: &Lake, surface: &SurfaceId, path: &Path) -> anyhow::Result<Self> {
        let mesh = tempfile::tempdir().context("cannot make a temporary folder")?;
        let measured = path.to_owned();
        let taken = tokio::task::spawn_blocking(move || take_heights(&measured)).await??;
        let heights = HeightField::from_rows(lake.rig().panel.size_mm, taken.heights_mm)
            .with_context(|| format!("`{}`: {} is no square of numbers", path.display(), topics::HEIGHTS_ATTACHMENT))?;
        let file = write_mesh(mesh.path(), &heights)?;
        // The tag of the measured run tells whose twin it is.
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        let tag = name.rsplit_once('-').and_then(|(_, tag)| u64::from_str_radix(tag, 16).ok());
        let tag = tag.with_context(|| format!("`{}` is not named as a run", path.display()))?;
        let measured = name.parse()?;
        let mut runs = ComputedRun::list_references()?;
        let twin = format!("{TWIN}{surface}").parse()?;
        if runs.iter().all(|run| run.surface != twin) {
            let specimen = PanelSpecimen::Mesh(file, PanelSide::Front);
            runs.push(ComputedRun { surface: twin.clone(), project: taken.project, specimen, tag });
        }
        let own = runs.iter().find(|run| run.surface == twin).with_context(|| format!("`{twin}` has no run"))?;
        let compared = ComparedRuns { measured, twin: own.id()? };
        let snapshot = lake.whole_snapshot().await?;
        let known: HashSet<RunId> = snapshot.runs().map(|run| run.run.clone()).collect();
        runs.retain(|run| run.id().is_ok_and(|id| !known.contains(&id)));
        Ok(Self { rig: quiet_rig(lake.rig()), folder: super::prepare_inbox(lake)?, _mesh: mesh, runs, compared })
    }

    fn compute_missing(&self, stop: &AtomicBool, progress: &CommandProgress) -> anyhow::Result<()> {
        std::thread::scope(|scope| {
            let computing: Vec<_> =
                self.runs.iter().map(|run| scope.spawn(|| self.compute_run(run, stop, progress))).collect();
            computing
                .into_iter()
                .try_for_each(|thread| thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
        })
    }

    fn compute_run(&self, run: &ComputedRun, stop: &AtomicBool, progress: &CommandProgress) -> anyhow::Result<()> {
        let request = RunRequest {
            rig: &self.rig,
            surface: run.surface.clone(),
            specimen: &run.specimen,
            flat: Some(FLAT.parse()?),
            foam: Some(FOAM.parse()?),
            macro_reference: None,
            material: None,
            role: None,
            project: run.project.clone(),
            start: COMPUTED_AT,
            seed: 0,
            tag: run.tag,
            keep: RecordingMode::ResponsesOnly,
            folder: &self.folder,
        };
        // What a computation that was stopped left behind.
        let partial = self.folder.join(format!("{}.mcap.partial", run.id()?));
        if partial.exists() {
            std::fs::remove_file(&partial).with_context(|| format!("cannot remove `{}`", partial.display()))?;
        }
        if self.folder.join(format!("{}.mcap", run.id()?)).exists() {
            return Ok(());
        }
        let mut task =
            progress.start_task(run.surface.to_string(), self.rig.build_grid()?.pairs().len() as u64, "pairs");
        let made = run_simulation(&request, Origin::Computed, stop, &mut |done| task.set_done(done as u64));
        let (_, end) = made.with_context(|| format!("surface {}", run.surface))?;
        task.finish_with(format!("{} pairs computed", end.accepted));
        Ok(())
    }
}

/// The rig without the chances of a measurement: what a model computes of a panel.
fn quiet_rig(rig: &Rig) -> Rig {
    let mut rig = rig.clone();
    rig.simulation.noise_and_drift = false;
    rig.simulation.repeatability_mm = 0.0;
    rig.simulation.calibration_mm = 0.0;
    rig
}

fn write_mesh(folder: &Path, heights: &HeightField) -> anyhow::Result<PathBuf> {
    let file = folder.join(topics::MESH_ATTACHMENT);
    let bytes = Mesh::from_height_field(heights, BACK_MM).to_bytes(MeshFormat::Glb);
    std::fs::write(&file, bytes).with_context(|| format!("cannot write `{}`", file.display()))?;
    Ok(file)
}

impl ComputedRun {
    fn list_references() -> anyhow::Result<Vec<Self>> {
        let references = [(FLAT, PanelRelief::Flat), (FOAM, PanelRelief::Foam)];
        let reference = |(name, relief): (&str, PanelRelief)| {
            let specimen = PanelSpecimen::Relief(relief);
            anyhow::Ok(Self { surface: name.parse()?, project: None, specimen, tag: 0 })
        };
        references.into_iter().map(reference).collect()
    }

    fn id(&self) -> anyhow::Result<RunId> {
        Ok(RunId::compose(COMPUTED_AT, &self.surface, self.tag)?)
    }
}

/// What a twin needs of the run file.
struct MeasuredPanel {
    heights_mm: Vec<f32>,
    project: Option<ProjectName>,
}

// Heights and record are in the run's file before its measurements.
fn take_heights(run: &Path) -> anyhow::Result<MeasuredPanel> {
    let mut reader = RecordingReader::open(run)?;
    let mut heights = None;
    let mut record = None;
    while let (false, Some(item)) = (heights.is_some() && record.is_some(), reader.next_item()?) {
        let RecordingItem::Attachment(attachment) = item else { continue };
        match attachment.name.as_str() {
            topics::HEIGHTS_ATTACHMENT => heights = Some(attachment.data),
            topics::SURFACE_ATTACHMENT => record = Some(attachment.data),
            _ => {}
        }
    }
    let lacks = |name| format!("run file `{}` has no whole attachment `{name}`", run.display());
    let heights = heights
        .with_context(|| format!("{}; hint: only runs with heights have a twin", lacks(topics::HEIGHTS_ATTACHMENT)))?;
    let record = record.with_context(|| lacks(topics::SURFACE_ATTACHMENT))?;
    let record: SurfaceRecord = serde_json::from_slice(&record)
        .with_context(|| format!("`{}`: {}", run.display(), topics::SURFACE_ATTACHMENT))?;
    let expected = SurfaceMaterial::CoatedPrint.name();
    if let Some(material) = record.material.filter(|material| material != expected) {
        anyhow::bail!("the panel is of `{material}`; hint: twins are computed of `{expected}` alone");
    }
    let heights_mm = heights.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    Ok(MeasuredPanel { heights_mm, project: record.project })
}

impl TwinDifferences {
    async fn read_from_lake(
        lake: &Lake,
        surface: &SurfaceId,
        runs: &ComparedRuns,
        pairs: usize,
    ) -> anyhow::Result<Self> {
        let session = Session::new(lake)?;
        let ComparedRuns { measured: measured_run, twin: twin_run } = runs;
        let twin = format!("{TWIN}{surface}");
        let bands = lake.rig().band_names();
        let sql = format!("select max(origin) as origin from surfaces where surface_id = '{surface}'");
        let origin = super::sql::query_rows::<SurfaceOrigin>(&session, &sql).await?.pop().and_then(|row| row.origin);
        let mut found = Self {
            surface_id: surface.clone(),
            origin: origin.unwrap_or_default(),
            twin_id: twin.parse()?,
            twin_origin: Origin::Computed.label(),
            bands: Vec::new(),
            pairs: Vec::new(),
        };
        let mut every = Vec::new();
        for band in bands.iter().map(String::as_str).chain(["total"]) {
            let column = if band == "total" { "tnce_total".to_owned() } else { format!("tnce_band_{band}") };
            let levels = |alias: &str| format!("10 * log10({alias}.{column})");
            let joined = format!(
                "select m.pair_id, m.microphone, m.speaker, '{band}' as band, {} as surface_db, {} as twin_db, \
                 {} - {} as difference_db from tnce m join tnce c on c.pair_id = m.pair_id \
                 where m.surface_id = '{surface}' and c.surface_id = '{twin}' \
                 and m.run_id = '{measured_run}' and c.run_id = '{twin_run}' and not is_rejected(m.run_id, m.pair_id) \
                 and m.{column} > 0 and c.{column} > 0",
                levels("m"),
                levels("c"),
                levels("m"),
                levels("c"),
            );
            let phase = if band == "total" { "null".to_owned() } else { format!("detail_phase_{band}") };
            let summary = format!(
                "select '{band}' as band, count(*) as pairs, avg(surface_db) as surface_db, \
                 avg(twin_db) as twin_db, avg(difference_db) as mean_db, \
                 sqrt(avg(difference_db * difference_db)) as rms_db, \
                 percentile_cont(0.05) within group (order by difference_db) as p5_db, \
                 percentile_cont(0.95) within group (order by difference_db) as p95_db, \
                 cast((select max({phase}) from surfaces where surface_id = '{surface}') as double) as detail_phase \
                 from ({joined})"
            );
            found.bands.extend(super::sql::query_rows::<BandDifference>(&session, &summary).await?);
            every.push(joined);
        }
        let farthest = format!(
            "select * from ({}) order by abs(difference_db) desc, pair_id, band limit {pairs}",
            every.join(" union all ")
        );
        found.pairs = super::sql::query_rows(&session, &farthest).await?;
        anyhow::ensure!(
            found.bands.iter().any(|band| band.pairs > 0),
            "surface `{surface}` has no levels to compare; hint: `echolake doctor` says which references are missing"
        );
        Ok(found)
    }

    fn print_differences(&self) -> anyhow::Result<()> {
        let level = |value: Option<f64>| value.map_or_else(String::new, |value| format!("{value:.2}"));
        super::print_line(&format!(
            "{} ({}) less {} (computed), dB re Flat, same band; the total: dB re Flat total\n\n\
             {:>6} {:>6} {:>9} {:>9} {:>6} {:>6} {:>6} {:>6}",
            self.surface_id, self.origin, self.twin_id, "band", "pairs", "surface", "twin", "mean", "rms", "P5", "P95",
        ))?;
        for band in &self.bands {
            // The same simulation on both sides is off by the same.
            let doubted = self.origin != Origin::Simulated.label()
                && band.detail_phase.is_some_and(|phase| phase > TRUSTED_PHASE);
            super::print_line(&format!(
                "{:>6} {:>6} {:>9} {:>9} {:>6} {:>6} {:>6} {:>6}{}",
                band.band,
                band.pairs,
                level(band.surface_db),
                level(band.twin_db),
                level(band.mean_db),
                level(band.rms_db),
                level(band.p5_db),
                level(band.p95_db),
                if doubted { "  single pairs of the simulation are off by 1 dB here" } else { "" },
            ))?;
        }
        super::print_line(&format!(
            "\n{:>6} {:>5} {:>5} {:>6} {:>9} {:>9} {:>10}",
            "pair", "mic", "spk", "band", "surface", "twin", "difference"
        ))?;
        for pair in &self.pairs {
            super::print_line(&format!(
                "{:>6} {:>5} {:>5} {:>6} {:>9.2} {:>9.2} {:>10.2}",
                pair.pair_id,
                pair.microphone,
                pair.speaker,
                pair.band,
                pair.surface_db,
                pair.twin_db,
                pair.difference_db
            ))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use echolake_dsp::filter_bank::FilterBankPlan;
    use echolake_dsp::level::power_to_db;
    use echolake_panel::mesh::FACETS;
    use echolake_schema::messages::ImpulseResponse;
    use echolake_testing::{NumberLine, RevisionFixture, SMALL_RIG, read_messages};

    use super::*;

    /// Difference of a level, dB, that is no change.
    const LEVEL_TOLERANCE_DB: f64 = 2e-3;

    // Levels of a run's responses over 1, band by band, in the order of the pairs.
    fn level_lines(rig: &Rig, surface: &str, file: &Path) -> Vec<NumberLine> {
        let mut responses: Vec<ImpulseResponse> = read_messages(file, topics::IR);
        responses.sort_by_key(|response| response.pair_id);
        let length = responses.first().expect("a response").samples.len();
        let bank = FilterBankPlan::<f64>::new(length, rig.sweep.rate_hz.get(), &rig.bands.centres_hz).expect("a plan");
        let mut scratch = bank.make_scratch();
        let mut levels_db = vec![Vec::new(); bank.band_count()];
        for response in &responses {
            let samples: Vec<f64> = response.samples.iter().map(|sample| f64::from(*sample)).collect();
            let mut energies = vec![0.0; bank.band_count()];
            bank.compute_energies(&samples, &mut energies, &mut scratch).expect("energies");
            levels_db.iter_mut().zip(energies).for_each(|(band, energy)| band.push(power_to_db(energy)));
        }
        let line = |(band, levels): (String, Vec<f64>)| {
            NumberLine::from_values(format!("{surface}.level_{band}"), levels, LEVEL_TOLERANCE_DB)
        };
        rig.band_names().into_iter().zip(levels_db).map(line).collect()
    }

    /// E33: a lake computes its twins again only if the revision is raised.
    #[test]
    fn changed_twins_need_a_raised_revision() {
        let rig = Rig::from_toml(&SMALL_RIG.replace("points_per_side = 3", "points_per_side = 2")).expect("a rig");
        let folder = tempfile::tempdir().expect("a folder");
        let mesh = tempfile::tempdir().expect("a folder");
        let relief = PanelRelief::by_name("stretcher_bond").expect("a relief");
        let file = write_mesh(mesh.path(), &relief.height_field(FACETS)).expect("written");
        let surface: SurfaceId = format!("{TWIN}relief").parse().expect("a name");
        let specimen = PanelSpecimen::Mesh(file, PanelSide::Front);
        let mut runs = ComputedRun::list_references().expect("references");
        runs.push(ComputedRun { surface, project: None, specimen, tag: 1 });
        let ids: Vec<RunId> = runs.iter().map(|run| run.id().expect("a name")).collect();
        let compared = ComparedRuns { measured: ids[2].clone(), twin: ids[2].clone() };
        let inbox = folder.path().to_owned();
        let computation = TwinComputation { rig: quiet_rig(&rig), folder: inbox, _mesh: mesh, runs, compared };
        computation.compute_missing(&AtomicBool::new(false), &CommandProgress::new()).expect("computed");
        let lines = |id: &RunId| level_lines(&rig, id.surface_name(), &folder.path().join(format!("{id}.mcap")));
        let fixture = RevisionFixture {
            path: "tests/fixtures/twins.txt",
            constant: "TWIN_REVISION",
            revision: TWIN_REVISION,
            test: "changed_twins_need_a_raised_revision",
        };
        fixture.check_numbers(&ids.iter().flat_map(lines).collect::<Vec<_>>());
    }

    /// E33: revisions have times of their own, and lakes of earlier programs have the times of revisions 1 and 2.
    #[test]
    fn a_raised_revision_makes_other_runs() {
        let times = [1, 2, 3].map(|revision| revision_time(revision).compact_text());
        assert_eq!(times, ["20260105T080000Z", "20260105T090000Z", "20260105T100000Z"]);
        let twin_of = |revision| {
            let surface = FLAT.parse().expect("a name");
            RunId::compose(revision_time(revision), &surface, 0).expect("a name")
        };
        assert!(is_superseded(&twin_of(TWIN_REVISION - 1)) && !is_superseded(&twin_of(TWIN_REVISION)));
        let measured = RunId::compose(revision_time(1), &"flat".parse().expect("a name"), 0).expect("a name");
        assert!(!is_superseded(&measured));
    }
}
