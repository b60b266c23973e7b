//! `echolake acquire`: one surface measured, with the simulated rig or the devices that the rig file names.

use std::path::Path;

use anyhow::Context as _;
use echolake_acquisition::controller::Keep;
use echolake_acquisition::mesh::Mesh;
use echolake_acquisition::relief::Relief;
use echolake_acquisition::simulate::{SimulatedRun, Specimen};
use echolake_lake::{Lake, References};
use echolake_schema::{Rig, SurfaceId, Timestamp};

use crate::Done;
use crate::cli::AcquireArgs;
use crate::progress::Progress;

pub(crate) async fn run(args: &AcquireArgs, lake_url: &str) -> anyhow::Result<Done> {
    // What is to be measured is checked before a lake is made for it.
    let specimen = match (&args.mesh, &args.parameters) {
        (Some(mesh), _) => Specimen::Mesh(mesh.clone()),
        (None, Some(file)) => {
            let mut relief = relief_of_file(file)?;
            set_all(&mut relief, &args.set)?;
            Specimen::Relief(relief)
        }
        (None, None) => Specimen::Relief(relief(args.panel.as_deref(), &args.surface, &args.set)?),
    };
    let rig = super::rig_or(args.rig.as_deref(), lake_url, Rig::paper).await?;
    if let Specimen::Mesh(path) = &specimen {
        Mesh::read(path)?.check(rig.panel.size_mm, rig.panel.depth_mm, path)?;
    }
    let lake = Lake::open_or_create(lake_url, &rig, &References::default()).await?;
    let folder = super::inbox(&lake)?;
    let stop = super::stop_on_interrupt();
    let (args_surface, seed) = (args.surface.clone(), args.seed);
    let (flat, foam) = (args.flat.clone(), args.foam.clone());
    let keep = if args.ir_only { Keep::ResponsesOnly } else { Keep::Sweeps };
    let progress = Progress::new();
    if rig.devices.are_simulated() {
        progress.say("simulated rig: nothing here is measured");
    }
    let pairs = rig.grid()?.pairs().len();
    let mut task = progress.task(args.surface.to_string(), pairs as u64, "pairs");
    let measured = tokio::task::spawn_blocking(move || {
        let run = SimulatedRun {
            rig: &rig,
            surface: args_surface,
            specimen: &specimen,
            flat,
            foam,
            start: Timestamp::now(),
            seed,
            keep,
            folder: &folder,
        };
        let outcome = run.measure(&stop, &mut |done| task.at(done as u64));
        outcome.map(|(path, end)| {
            task.done(format!("{} pairs accepted, {} given up, {} attempts", end.accepted, end.rejected, end.attempts));
            (path, end)
        })
    });
    let (path, end) = measured.await??;
    super::print(&path.display().to_string())?;
    eprintln!("next: echolake --lake {lake_url} ingest");
    Ok(if end.rejected > 0 { Done::WithLoss } else { Done::Whole })
}

/// The named relief, or the one that the surface's name begins with, with its parameters set.
pub(super) fn relief(name: Option<&str>, surface: &SurfaceId, set: &[String]) -> anyhow::Result<Relief> {
    let guessed = || Relief::guess(surface.as_str());
    let name = name.or_else(guessed).with_context(|| {
        format!(
            "unknown surface `{surface}`: it says nothing of its relief; hint: --panel {} or --mesh FILE",
            Relief::NAMES.join("|")
        )
    })?;
    with_parameters(name, set)
}

/// A relief with its parameters set from `key=value`.
pub(super) fn with_parameters(name: &str, set: &[String]) -> anyhow::Result<Relief> {
    let mut relief = Relief::by_name(name)?;
    set_all(&mut relief, set)?;
    Ok(relief)
}

/// Sets parameters from `key=value`.
pub(super) fn set_all(relief: &mut Relief, set: &[String]) -> anyhow::Result<()> {
    for setting in set {
        let (key, value) =
            setting.split_once('=').with_context(|| format!("`--set {setting}` has no `=`; hint: --set key=value"))?;
        relief.set(key, value)?;
    }
    Ok(())
}

/// The relief of a file of parameters.
pub(super) fn relief_of_file(path: &Path) -> anyhow::Result<Relief> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read parameters `{}`", path.display()))?;
    Relief::from_json(&text).with_context(|| format!("parameters `{}`", path.display()))
}
