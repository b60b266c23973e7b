//! `echolake import`: existing measurements become runs.

use echolake_acquisition::disk::read_text_file;
use echolake_import::{
    Error, GIR_IR_LEN, ImportOptions, ImportedRun, check_hdf5, check_rew, check_sofa, check_wav, import_gir,
    import_hdf5, import_rew, import_sofa, import_wav, sampling_rate_of, scale_of_manifest,
};
use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_schema::interchange::{REW_MANIFEST, WAV_MANIFEST};
use echolake_schema::{AirTreatment, Celsius, ProjectName, Rig, SpectralDivision, Timestamp};

use crate::CommandOutcome;
use crate::progress::{CommandProgress, TaskProgress};
use clap::{Args, Subcommand};
use std::path::PathBuf;

#[derive(Debug, Args)]
pub(crate) struct ImportArgs {
    /// Project that the surfaces belong to; tokens of the query service may be limited to projects.
    #[arg(long, value_name = "NAME", global = true)]
    project: Option<ProjectName>,
    #[command(subcommand)]
    format: ImportCommand,
}

/// Formats of existing measurements.
#[derive(Debug, Subcommand)]
enum ImportCommand {
    /// Recordings and loopbacks, or recordings and their sweep, as WAV files, listed in a CSV manifest.
    Wav {
        /// CSV manifest of the recordings.
        manifest: PathBuf,
        /// Rig of the recordings: sweep range, response length, bands, grid; by default the lake's, or the paper's for
        /// a new lake.
        #[arg(long)]
        rig: Option<PathBuf>,
    },
    /// Responses that Room EQ Wizard (REW) exported as text or WAV, listed in a CSV manifest; see docs/import.md.
    Rew {
        /// CSV manifest of the responses.
        manifest: PathBuf,
        /// The rig; by default the lake's, or the paper's for a new lake.
        #[arg(long)]
        rig: Option<PathBuf>,
    },
    /// A folder of the published GIR data set.
    Gir {
        /// Folder of the data set.
        folder: PathBuf,
        /// The rig; by default the lake's, or the paper's with responses of 400 samples for a new lake.
        #[arg(long)]
        rig: Option<PathBuf>,
    },
    /// Responses as SOFA files, one per surface (SingleRoomSRIR, SingleRoomMIMOSRIR, GeneralFIR, SimpleFreeFieldHRIR,
    /// FreeFieldDirectivityTF).
    Sofa {
        /// SOFA files.
        #[arg(required = true, value_name = "FILE")]
        files: Vec<PathBuf>,
        /// The rig; by default the lake's, or the paper's for a new lake.
        #[arg(long)]
        rig: Option<PathBuf>,
        /// Temperature of the air; overrides what foreign files say.
        #[arg(long, value_name = "C", allow_negative_numbers = true)]
        temperature_c: Option<f64>,
    },
    /// Responses of an HDF5 file, by a mapping of its datasets; see docs/import.md.
    Hdf5 {
        /// Mapping of the datasets, a TOML file.
        mapping: PathBuf,
        /// The rig; by default the lake's, or the paper's for a new lake.
        #[arg(long)]
        rig: Option<PathBuf>,
        /// Temperature of the air; overrides the mapping.
        #[arg(long, value_name = "C", allow_negative_numbers = true)]
        temperature_c: Option<f64>,
    },
}

// A manifest may say the scale that its rig leaves open.
fn with_scale(rig: Rig, said: Option<f64>) -> anyhow::Result<Rig> {
    match (rig.scale, said) {
        (Some(known), Some(said)) if known != said => {
            anyhow::bail!("the manifest's `scale` is {said}, that of rig `{}` is {known}", rig.name)
        }
        (_, None) => Ok(rig),
        (_, scale) => {
            let rig = Rig { scale, ..rig };
            rig.check_consistency()?;
            Ok(rig)
        }
    }
}

pub(crate) async fn run_import(args: &ImportArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let ImportArgs { project, format: args } = args;
    let rig = match args {
        ImportCommand::Wav { manifest, rig } => {
            let rate = sampling_rate_of(manifest)?;
            let mut given = super::rig_or(rig.as_deref(), lake_url, Rig::paper).await?;
            // A rig file that says nothing of the rate takes that of the recordings.
            let says_rate = |text: String| text.contains("rate_hz");
            let silent = rig.as_deref().is_some_and(|f| !read_text_file(f).is_ok_and(says_rate));
            if silent {
                given.sweep.rate_hz = rate;
                given.check_consistency()?;
            }
            given
        }
        ImportCommand::Gir { rig, .. } => super::rig_or(rig.as_deref(), lake_url, gir_rig).await?,
        ImportCommand::Rew { rig, .. } | ImportCommand::Sofa { rig, .. } | ImportCommand::Hdf5 { rig, .. } => {
            super::rig_or(rig.as_deref(), lake_url, Rig::paper).await?
        }
    };
    let rig = match args {
        ImportCommand::Wav { manifest, .. } => with_scale(rig, scale_of_manifest(manifest, &WAV_MANIFEST)?)?,
        ImportCommand::Rew { manifest, .. } => with_scale(rig, scale_of_manifest(manifest, &REW_MANIFEST)?)?,
        _ => rig,
    };
    // All is checked and written beside the lake's tables before a lake is made for it.
    let existing = match Lake::open(lake_url).await {
        Ok(lake) => {
            lake.check_rig(&rig)?;
            Some(lake)
        }
        Err(echolake_lake::Error::NoLake { .. }) => None,
        Err(e) => return Err(e.into()),
    };
    let celsius = match args {
        ImportCommand::Sofa { temperature_c, .. } | ImportCommand::Hdf5 { temperature_c, .. } => {
            temperature_c.map(Celsius::new).transpose()?
        }
        _ => None,
    };
    if existing.is_none() {
        match args {
            ImportCommand::Wav { manifest, .. } => check_wav(manifest, &rig)?,
            ImportCommand::Rew { manifest, .. } => check_rew(manifest, &rig)?,
            ImportCommand::Sofa { files, .. } => check_sofa(files, &rig, celsius)?,
            ImportCommand::Hdf5 { mapping, .. } => check_hdf5(mapping, &rig, celsius)?,
            ImportCommand::Gir { .. } => {}
        }
    }
    let lake = Lake::open_or_create(lake_url, &rig, &ReferenceSurfaces::default()).await?;
    let folder = super::prepare_inbox(&lake)?;
    let progress = CommandProgress::new();
    let mut task = None;
    let options = ImportOptions { started: Timestamp::now(), folder: &folder, project: project.as_ref() };
    let mut step = |unit: &'static str, done: usize, total: usize| {
        task.get_or_insert_with(|| progress.start_task("import", total as u64, unit)).set_done(done as u64);
    };
    let runs: Result<Vec<ImportedRun>, Error> = tokio::task::block_in_place(|| match args {
        ImportCommand::Wav { manifest, .. } => {
            import_wav(manifest, &rig, options, &mut |d, t| step("recordings", d, t))
        }
        ImportCommand::Rew { manifest, .. } => import_rew(manifest, &rig, options, &mut |d, t| step("responses", d, t)),
        ImportCommand::Gir { folder, .. } => import_gir(folder, &rig, options, &mut |d, t| step("surfaces", d, t)),
        ImportCommand::Sofa { files, .. } => {
            import_sofa(files, &rig, celsius, options, &mut |d, t| step("surfaces", d, t))
        }
        ImportCommand::Hdf5 { mapping, .. } => {
            import_hdf5(mapping, &rig, celsius, options, &mut |d, t| step("responses", d, t))
        }
    });
    let runs = runs?;
    finish_task(task, &runs);
    for run in &runs {
        for warning in &run.warnings {
            progress.print_message(format!("{}: warning: {warning}", run.run_id));
        }
        for note in &run.notes {
            progress.print_message(format!("{}: {note}", run.run_id));
        }
        super::print_line(&run.path.display().to_string())?;
    }
    match runs.iter().map(|run| run.measurements).sum::<usize>() {
        0 => eprintln!(
            "no take was accepted, so there is nothing to ingest; hint: mend what is said above, import again"
        ),
        _ => eprintln!("next: echolake --lake {lake_url} ingest"),
    }
    let is_whole = runs.iter().all(|run| run.rejected == 0);
    Ok(if is_whole { CommandOutcome::Whole } else { CommandOutcome::WithLoss })
}

fn finish_task(task: Option<TaskProgress>, runs: &[ImportedRun]) {
    let measurements: usize = runs.iter().map(|r| r.measurements).sum();
    if let Some(task) = task {
        task.finish_with(format!("{} runs, {measurements} measurements", runs.len()));
    }
}

fn gir_rig() -> Rig {
    let mut rig = Rig::paper();
    rig.name = "gir".into();
    rig.impulse_response.length = GIR_IR_LEN;
    // As the data set's responses were made.
    rig.impulse_response.division = SpectralDivision::Literal;
    rig.impulse_response.air = AirTreatment::Paper;
    rig
}
