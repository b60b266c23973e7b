//! `echolake acquire`: measures one surface, with progress, pause, stop and resume.

mod acknowledge;
mod specimen;
pub(super) mod watch;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context as _;
use echolake_acquisition::run::controller::{RecordingMode, RunControl, RunEvent};
use echolake_acquisition::run::live::{LiveClock, LiveServer};
use echolake_acquisition::run::metrics::{MetricsServer, RunMetrics};
use echolake_acquisition::run::recorder::{Held, partial_of, random_tag};
use echolake_acquisition::run::recording_lock::RecordingLock;
use echolake_acquisition::run::session::{MeasuredRun, PreflightMode, RunSession, TakePace};
use echolake_acquisition::run::{self, RunRequest};
use echolake_lake::{Error as LakeError, Lake, ReferenceSurfaces};
use echolake_panel::PanelSpecimen;
use echolake_schema::{ProjectName, Rig, SurfaceId, SurfaceRole, Timestamp};

use crate::CommandOutcome;
use crate::commands::replay::ViewerArgs;
#[cfg(feature = "upload")]
use crate::error_text::describe_error;
use crate::progress::CommandProgress;
#[cfg(feature = "upload")]
use crate::signals::StopRequest;
use acknowledge::AcknowledgementWriter;
use clap::Args;
use echolake_panel::mesh::PanelSide;
pub(super) use specimen::{check_mesh, relief_of_file, set_all};
use watch::RunWatcher;

#[derive(Debug, Args)]
pub(crate) struct AcquireArgs {
    /// Name of the measured surface, as 0015_0.
    #[arg(long, required_unless_present = "resume")]
    pub surface: Option<SurfaceId>,
    /// Resume a run that was stopped or cut off: its `.mcap.partial`. Measurements that are safe in it are not
    /// repeated.
    #[arg(long, value_name = "FILE", conflicts_with_all = [
        "surface", "panel", "parameters", "set", "mesh", "side", "no_geometry", "rig", "flat", "foam",
        "macro_reference", "material", "role", "project", "seed", "ir_only",
    ])]
    pub resume: Option<PathBuf>,
    /// Relief by a name of `echolake panel --list`; by default, on the simulated rig, the one that the surface's name
    /// begins with.
    #[arg(long, value_name = "NAME", conflicts_with = "mesh")]
    pub panel: Option<String>,
    /// A JSON file of parameters, as `echolake panel` writes them, in place of a name.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["mesh", "panel"])]
    pub parameters: Option<PathBuf>,
    /// Set a parameter of the relief; repeatable.
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Measure a mesh instead of a relief: a GLB or STL file.
    #[arg(long)]
    pub mesh: Option<PathBuf>,
    /// The side of the mesh that is measured: the back is seen when the panel is turned over about its y axis.
    #[arg(long, value_name = "front|back", value_parser = parse_side, requires = "mesh")]
    pub side: Option<PanelSide>,
    /// Record a real panel without its geometry.
    #[arg(long, conflicts_with_all = ["mesh", "panel", "parameters", "set"])]
    pub no_geometry: bool,
    /// Rig file; by default the lake's rig, or the paper's for a new lake.
    #[arg(long)]
    pub rig: Option<PathBuf>,
    /// Reference surface to normalise by; by default the lake's.
    #[arg(long)]
    pub flat: Option<SurfaceId>,
    /// Reference surface whose direct sound is subtracted; by default the lake's.
    #[arg(long)]
    pub foam: Option<SurfaceId>,
    /// Surface that has the large shape of this one and nothing on it; by default known for the paper's panels.
    #[arg(long, value_name = "NAME")]
    pub macro_reference: Option<SurfaceId>,
    /// Material of the panel, for its absorption; a simulated rig knows it.
    #[arg(long, value_name = "NAME")]
    pub material: Option<String>,
    /// Purpose of a level surface: hard (the absorption of others is measured beside it), or sample.
    #[arg(long, value_name = "hard|sample")]
    pub role: Option<SurfaceRole>,
    /// Project that the surface belongs to; tokens of the query service may be limited to projects.
    #[arg(long, value_name = "NAME")]
    pub project: Option<ProjectName>,
    /// Seed of the simulation.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Record no sweeps, only impulse responses.
    #[arg(long)]
    pub ir_only: bool,
    /// Pairs between two checkpoints: the most that a power cut costs, and how long until a pair is reported as safe.
    /// By default 1 on a real rig, 200 on the simulated one.
    #[arg(long, value_name = "PAIRS", value_parser = clap::value_parser!(u32).range(1..))]
    pub checkpoint_every: Option<u32>,
    /// Minimum duration of a simulated take in seconds; a real rig needs 12.3.
    #[arg(long, value_name = "SECS", default_value_t = 0.0)]
    pub pace: f64,
    /// Start even if the disk, sensor, level or loopback check fails.
    #[arg(long)]
    pub skip_checks: bool,
    /// Start even if another run is recorded into the lake, or with the same devices.
    #[arg(long)]
    pub force: bool,
    /// Append one line to this file for every attempt that is safe on the disk: pair, attempt, verdict, SNR in dB. `-`
    /// is stdout.
    #[arg(long, value_name = "FILE")]
    pub acknowledge: Option<PathBuf>,
    /// Serve a live view of the run to Foxglove and Lichtblick at ws://ADDR.
    #[arg(long, value_name = "ADDR")]
    pub live: Option<std::net::SocketAddr>,
    #[command(flatten)]
    pub viewers: ViewerArgs,
    /// Serve metrics for Prometheus under http://ADDR/metrics.
    #[arg(long, value_name = "ADDR")]
    pub metrics: Option<std::net::SocketAddr>,
    /// Upload the run, once it is closed, to the lake at this location, as s3://bucket/prefix. The recording stays
    /// here.
    #[cfg(feature = "upload")]
    #[arg(long, value_name = "URL")]
    pub upload: Option<String>,
    #[cfg(feature = "upload")]
    #[command(flatten)]
    pub notify: super::notify::NotifyArgs,
}

impl AcquireArgs {
    #[cfg(feature = "upload")]
    fn upload_location(&self) -> Option<&str> {
        self.upload.as_deref()
    }

    #[cfg(not(feature = "upload"))]
    fn upload_location(&self) -> Option<&str> {
        None
    }
}

fn parse_side(text: &str) -> Result<PanelSide, String> {
    PanelSide::parse(text).ok_or_else(|| "expected front or back".to_owned())
}

/// A run to begin or to resume.
enum AcquireJob {
    Fresh(Box<NewRun>),
    Resumed { partial: PathBuf, held: Box<Held> },
}

/// A run that is about to begin.
struct NewRun {
    rig: Rig,
    surface: SurfaceId,
    specimen: PanelSpecimen,
    folder: PathBuf,
    flat: Option<SurfaceId>,
    foam: Option<SurfaceId>,
    macro_reference: Option<SurfaceId>,
    material: Option<String>,
    role: Option<SurfaceRole>,
    project: Option<ProjectName>,
    start: Timestamp,
    seed: u64,
    tag: u64,
    keep: RecordingMode,
}

pub(crate) async fn run_acquire(args: &AcquireArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let is_new = args.resume.is_none() && matches!(Lake::open(lake_url).await, Err(LakeError::NoLake { .. }));
    let has_folder = Path::new(lake_url).exists();
    let outcome = acquire_run(args, lake_url).await;
    if outcome.is_err() && is_new {
        // The refusal matters more than what is left of an empty lake.
        let _ = remove_new_lake(lake_url, has_folder).await;
    }
    outcome
}

async fn acquire_run(args: &AcquireArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let pace = if args.pace > 0.0 { TakePace::Secs(args.pace) } else { TakePace::Fast };
    let control = Arc::new(RunControl::default());
    #[cfg_attr(not(feature = "upload"), expect(unused_variables, reason = "it ends uploads"))]
    let stop = watch::obey_signals(&control)?;
    let progress = CommandProgress::new();
    let job = match &args.resume {
        Some(partial) => {
            let held = Box::new(Held::from_file(partial)?);
            check_not_ingested(partial, &held)?;
            for line in &held.damage {
                progress.print_message(format!("damage: {line}; what was lost with it is measured again"));
            }
            AcquireJob::Resumed { partial: partial.clone(), held }
        }
        None => prepare_new_run(args, lake_url, &progress).await?,
    };
    // Until the run has ended.
    let _lock = match RecordingLock::acquire(&job.folder(), job.rig()) {
        Err(_) if args.force => None,
        locked => Some(locked?),
    };
    #[cfg(feature = "upload")]
    if let Some(location) = args.upload_location() {
        super::upload::check_location(location, job.rig(), &progress).await?;
    }
    let clock = if job.rig().devices.are_simulated() { LiveClock::Simulated } else { LiveClock::Wall };
    if clock == LiveClock::Simulated {
        progress.print_message("simulated rig: nothing here is measured");
    }
    let (surface, planned, accepted) = job.surface_and_pairs()?;
    let mut acknowledgements = args.acknowledge.as_deref().map(AcknowledgementWriter::open).transpose()?;
    let metrics = RunMetrics::new(&surface, planned, accepted);
    let live = args.live.map(|address| LiveServer::start(address, args.viewers.viewer_access(), clock)).transpose()?;
    if let Some(live) = &live {
        progress.print_message(format!("live: open {} in Foxglove or Lichtblick", live.url()));
        super::tell_access(&args.viewers, live.address(), &progress);
    }
    let served = args.metrics.map(|address| MetricsServer::start(address, metrics.clone()));
    let unserved = || format!("cannot serve metrics at {}", args.metrics.map_or_else(String::new, |a| a.to_string()));
    let served = served.transpose().with_context(unserved)?;
    if let Some(served) = &served {
        progress.print_message(format!("metrics: http://{}/metrics", served.address()));
    }
    let is_damaged = matches!(&job, AcquireJob::Resumed { held, .. } if held.is_damaged());
    let mut watcher = RunWatcher::new(&progress, &surface, planned, accepted, metrics.clone(), job.folder());
    let preflight = if args.skip_checks { PreflightMode::Skip } else { PreflightMode::Check };
    let (checkpoint_every, tap) = (args.checkpoint_every.map(|n| n as usize), live.as_ref().map(LiveServer::tap));
    let partial = job.partial_path()?;
    let measured = tokio::task::spawn_blocking(move || {
        let mut observe = |event: RunEvent<'_>| {
            if let Some(acknowledgements) = &mut acknowledgements {
                acknowledgements.observe_event(&event);
            }
            watcher.observe_event(&event);
        };
        let session = RunSession { control: &control, observe: &mut observe, tap, preflight, checkpoint_every, pace };
        let measured = job.measure_run(session);
        if measured.is_err() {
            metrics.broke_off();
        }
        watcher.report_end(measured.as_ref().ok().map(|m| m.outcome.end));
        measured
    });
    let measured = measured.await?;
    // Viewers are disconnected before the command ends.
    drop((served, live));
    match measured {
        Ok(measured) => {
            let outcome = tell_outcome(&measured, lake_url)?;
            let outcome = if is_damaged { CommandOutcome::WithLoss } else { outcome };
            if measured.outcome.left > 0 {
                return Ok(outcome);
            }
            #[cfg(feature = "upload")]
            if let Some(location) = args.upload_location() {
                upload_run(&measured.path, location, &stop, &progress).await?;
            }
            eprintln!("next: echolake --lake {} ingest", args.upload_location().unwrap_or(lake_url));
            Ok(outcome)
        }
        Err(error) => {
            let error = anyhow::Error::from(error);
            if partial.exists() {
                tell_resume(&partial, lake_url);
                #[cfg(feature = "upload")]
                args.notify
                    .post_notice(&serde_json::json!({
                        "event": "run_broken_off",
                        "surface": surface,
                        "simulated": clock == LiveClock::Simulated,
                        "file": partial,
                        "pairs": planned,
                        "accepted": Held::from_file(&partial).ok().map(|held| held.accepted_count()),
                        "error": describe_error(&error),
                    }))
                    .await;
            }
            Err(error)
        }
    }
}

// Whatever fails, the run's file stays where it is.
#[cfg(feature = "upload")]
async fn upload_run(path: &Path, location: &str, stop: &StopRequest, progress: &CommandProgress) -> anyhow::Result<()> {
    let uploaded = tokio::select! {
        uploaded = super::upload::upload_one(path, location, progress) => uploaded,
        () = stop.wait_until_made() => Err(anyhow::anyhow!("stopped")),
    };
    uploaded.map_err(|cause| {
        let path = path.display();
        let cause = describe_error(&cause);
        anyhow::anyhow!(
            "the run stays in `{path}` and was not uploaded to `{location}`: {cause}; hint: `echolake --lake \
             {location} upload {path}` continues"
        )
    })
}

// Reports the path of the run's file, or how to resume it.
fn tell_outcome(measured: &MeasuredRun, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let MeasuredRun { path, outcome } = measured;
    if outcome.left > 0 {
        eprintln!("stopped with {} pairs left; nothing that was measured is lost", outcome.left);
        tell_resume(path, lake_url);
        return Ok(CommandOutcome::Whole);
    }
    super::print_line(&path.display().to_string())?;
    Ok(if outcome.end.rejected > 0 { CommandOutcome::WithLoss } else { CommandOutcome::Whole })
}

// A lake that was made for a refused run would bind the next one to its rig.
async fn remove_new_lake(lake_url: &str, has_folder: bool) -> anyhow::Result<()> {
    let lake = Lake::open(lake_url).await?;
    let folder = lake.folder().map(Path::to_owned);
    if lake.remove_unused().await?
        && let Some(folder) = folder.filter(|_| !has_folder)
    {
        std::fs::remove_dir(folder)?;
    }
    Ok(())
}

// A run that was recovered from the recording and ingested stays as it is: a resumed one of its name would be refused.
fn check_not_ingested(partial: &Path, held: &Held) -> anyhow::Result<()> {
    let manifest = &held.manifest;
    let runs = partial.canonicalize()?.parent().and_then(Path::parent).map(|lake| lake.join("runs"));
    let run = runs.map(|runs| runs.join(manifest.surface_id.as_str()).join(format!("{}.mcap", manifest.run_id)));
    if let Some(run) = run.filter(|run| run.exists()) {
        anyhow::bail!(
            "`{}` was recovered, and its run is in the lake: `{}`; hint: measure the surface anew by `echolake acquire \
             --surface {}`, since a run never changes once it is in the lake",
            partial.display(),
            run.display(),
            manifest.surface_id
        );
    }
    Ok(())
}

fn tell_resume(partial: &Path, lake_url: &str) {
    eprintln!("to resume: echolake --lake {lake_url} acquire --resume {}", partial.display());
}

async fn prepare_new_run(args: &AcquireArgs, lake_url: &str, progress: &CommandProgress) -> anyhow::Result<AcquireJob> {
    let rig = super::rig_or(args.rig.as_deref(), lake_url, Rig::paper).await?;
    let specimen = specimen::choose_specimen(args, &rig)?;
    check_mesh(&specimen, &rig)?;
    let lake = Lake::open_or_create(lake_url, &rig, &ReferenceSurfaces::default()).await?;
    let folder = super::prepare_inbox(&lake)?;
    let surface = args.surface.clone().context("no surface is named; hint: --surface NAME")?;
    #[cfg(feature = "lake")]
    warn_of_missing_references(args, &lake, &surface, progress).await?;
    for unfinished in unfinished_recordings(&folder, surface.as_str()) {
        progress.print_message(format!(
            "note: `{}` is unfinished; hint: `echolake acquire --resume` resumes it",
            unfinished.display()
        ));
    }
    Ok(AcquireJob::Fresh(Box::new(NewRun {
        macro_reference: specimen::macro_reference(args, &rig)?,
        material: args.material.clone(),
        role: args.role,
        rig,
        surface,
        specimen,
        folder,
        flat: args.flat.clone(),
        foam: args.foam.clone(),
        project: args.project.clone(),
        start: Timestamp::now(),
        seed: args.seed,
        tag: random_tag(),
        keep: if args.ir_only { RecordingMode::ResponsesOnly } else { RecordingMode::Sweeps },
    })))
}

// References may be measured later: the rows wait for them. This warns users who forgot them.
#[cfg(feature = "lake")]
async fn warn_of_missing_references(
    args: &AcquireArgs,
    lake: &Lake,
    surface: &SurfaceId,
    progress: &CommandProgress,
) -> anyhow::Result<()> {
    let snapshot = lake.snapshot().await?;
    for named in [&args.flat, &args.foam].into_iter().flatten() {
        if named != surface && !snapshot.runs().any(|run| run.surface == *named) {
            progress.print_message(format!(
                "warning: reference `{named}` is not measured yet; rows of `{surface}` wait for it"
            ));
        }
    }
    Ok(())
}

// Unfinished recordings of the surface: names of runs have the surface behind their time.
pub(super) fn unfinished_recordings(folder: &Path, surface: &str) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let is_of = |path: &PathBuf| {
        let name = path.file_name().and_then(|n| n.to_str()).and_then(|n| n.strip_suffix(".mcap.partial"));
        name.is_some_and(|n| n.rsplit_once('-').is_some_and(|(rest, _)| rest.ends_with(&format!("Z-{surface}"))))
    };
    entries.flatten().map(|entry| entry.path()).filter(is_of).collect()
}

impl AcquireJob {
    fn folder(&self) -> PathBuf {
        match self {
            Self::Fresh(fresh) => fresh.folder.clone(),
            Self::Resumed { partial, .. } => match partial.parent() {
                Some(folder) if !folder.as_os_str().is_empty() => folder.to_owned(),
                _ => PathBuf::from("."),
            },
        }
    }

    fn rig(&self) -> &Rig {
        match self {
            Self::Fresh(fresh) => &fresh.rig,
            Self::Resumed { held, .. } => &held.rig,
        }
    }

    // The surface, its pairs, and how many of them are measured already.
    fn surface_and_pairs(&self) -> anyhow::Result<(String, u64, u64)> {
        let (surface, accepted) = match self {
            Self::Fresh(fresh) => (&fresh.surface, 0),
            Self::Resumed { held, .. } => (&held.manifest.surface_id, held.accepted_count() as u64),
        };
        Ok((surface.to_string(), self.rig().build_grid()?.pairs().len() as u64, accepted))
    }

    // The path of the recording until it is complete.
    fn partial_path(&self) -> anyhow::Result<PathBuf> {
        match self {
            Self::Fresh(fresh) => Ok(partial_of(&fresh.run_request().path()?)),
            Self::Resumed { partial, .. } => Ok(partial.clone()),
        }
    }

    fn measure_run(&self, session: RunSession<'_>) -> Result<MeasuredRun, run::Error> {
        match self {
            Self::Fresh(fresh) => fresh.run_request().measure_run(session),
            Self::Resumed { partial, .. } => run::resume_run(partial, session),
        }
    }
}

impl NewRun {
    fn run_request(&self) -> RunRequest<'_> {
        RunRequest {
            rig: &self.rig,
            surface: self.surface.clone(),
            specimen: &self.specimen,
            flat: self.flat.clone(),
            foam: self.foam.clone(),
            macro_reference: self.macro_reference.clone(),
            material: self.material.clone(),
            role: self.role,
            project: self.project.clone(),
            start: self.start,
            seed: self.seed,
            tag: self.tag,
            keep: self.keep,
            folder: &self.folder,
        }
    }
}
