//! `echolake upload`: closed runs go to a lake's inbox, and continue after any cut.

mod closed_run;

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;
use echolake_acquisition::recovery::is_partial;
use echolake_lake::{Error as LakeError, Lake, ReferenceSurfaces, RunUpload, UploadOutcome, UploadStep, remote_access};
use echolake_schema::Rig;
use serde::Serialize;

use crate::CommandOutcome;
use crate::error_text::describe_error;
use crate::progress::{CommandProgress, TaskProgress};
use crate::signals::StopRequest;
use closed_run::ClosedRun;

/// Extension of run files.
const EXTENSION: &str = "mcap";
const MEGABYTE: u64 = 1_000_000;

#[derive(Debug, Args)]
pub(crate) struct UploadArgs {
    /// Closed run files, or folders of them; of a folder, recordings in progress are left out.
    #[arg(required = true, value_name = "FILE|FOLDER")]
    pub files: Vec<PathBuf>,
    /// Print what was done as JSON.
    #[arg(long)]
    pub json: bool,
}

/// The results of all files.
#[derive(Debug, Default, Serialize)]
struct UploadSummary {
    runs: Vec<UploadedRun>,
    refused: Vec<RefusedUpload>,
}

/// A run that is in the lake, compared by its SHA-256.
#[derive(Debug, Serialize)]
struct UploadedRun {
    file: String,
    run_id: String,
    surface_id: String,
    /// Path in the lake.
    path: String,
    bytes: u64,
    sha256: String,
    /// False if the lake had it before.
    uploaded: bool,
}

/// A file that was not uploaded.
#[derive(Debug, Serialize)]
struct RefusedUpload {
    file: String,
    reason: String,
}

pub(crate) async fn run_upload(args: &UploadArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let stop = StopRequest::listen("stopping; what was sent is kept")?;
    let progress = CommandProgress::new();
    let files = run_files(&args.files, &progress)?;
    let mut summary = UploadSummary::default();
    let uploaded = tokio::select! {
        uploaded = upload_all(&files, lake_url, &progress, &mut summary) => uploaded,
        () = stop.wait_until_made() => Err(anyhow::anyhow!("stopped; hint: run the same command again to resume")),
    };
    match args.json {
        true => super::print_line(&serde_json::to_string_pretty(&summary)?)?,
        false => summary.runs.iter().try_for_each(|run| super::print_line(&run.path))?,
    }
    uploaded?;
    if files.is_empty() {
        eprintln!("nothing to upload: no closed run there");
    }
    let refused = summary.refused.len();
    anyhow::ensure!(refused == 0, "{refused} of {} files were not uploaded", files.len());
    if summary.runs.iter().any(|run| run.uploaded) {
        eprintln!("next: echolake --lake {lake_url} ingest");
    }
    Ok(CommandOutcome::Whole)
}

/// Uploads one closed run; errors keep it where it is.
pub(super) async fn upload_one(file: &Path, lake_url: &str, progress: &CommandProgress) -> anyhow::Result<()> {
    let run = ClosedRun::from_file(file)?;
    let lake = open_or_make(lake_url, &run.rig).await?;
    upload_file(file, &run, &lake, progress).await.map(drop)
}

/// Checks that runs of a rig can be uploaded to a location. A store that cannot be reached now may be there later.
pub(super) async fn check_location(lake_url: &str, rig: &Rig, progress: &CommandProgress) -> anyhow::Result<()> {
    match Lake::open(lake_url).await {
        Ok(lake) => Ok(lake.check_rig(rig)?),
        Err(LakeError::NoLake { .. }) if remote_access(lake_url).is_some() => Ok(()),
        Err(error @ LakeError::Store { .. }) => {
            progress
                .print_message(format!("warning: {error}; the run is recorded, and its upload is tried at its end"));
            Ok(())
        }
        Err(error) => Err(error.into()),
    }
}

// The closed runs of folders, and files as they are named.
fn run_files(named: &[PathBuf], progress: &CommandProgress) -> anyhow::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for path in named {
        if !path.is_dir() {
            files.push(path.clone());
            continue;
        }
        let listed = || std::fs::read_dir(path)?.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>();
        let listed = listed().with_context(|| format!("cannot list `{}`", path.display()))?;
        let (partial, listed): (Vec<_>, Vec<_>) = listed.into_iter().partition(|file| is_partial(file));
        for unfinished in partial {
            progress.print_message(format!("note: `{}` is unfinished and stays", unfinished.display()));
        }
        let mut runs: Vec<_> = listed.into_iter().filter(|f| f.extension().is_some_and(|e| e == EXTENSION)).collect();
        runs.sort();
        files.extend(runs);
    }
    Ok(files)
}

// What concerns one file alone does not keep the others from going up.
async fn upload_all(
    files: &[PathBuf],
    lake_url: &str,
    progress: &CommandProgress,
    summary: &mut UploadSummary,
) -> anyhow::Result<()> {
    let mut lake = None;
    for file in files {
        let uploaded = async {
            let run = ClosedRun::from_file(file)?;
            let lake = match &lake {
                Some(lake) => lake,
                None => lake.insert(open_or_make(lake_url, &run.rig).await?),
            };
            lake.check_rig(&run.rig)?;
            upload_file(file, &run, lake, progress).await
        };
        match uploaded.await {
            Ok(uploaded) => summary.runs.push(uploaded),
            Err(error) if concerns_lake(&error) => return Err(error),
            Err(error) => {
                let reason = describe_error(&error);
                progress.print_message(format!("error: {reason}"));
                summary.refused.push(RefusedUpload { file: file.display().to_string(), reason });
            }
        }
    }
    Ok(())
}

fn concerns_lake(error: &anyhow::Error) -> bool {
    error.downcast_ref::<LakeError>().is_some_and(|error| {
        matches!(
            error,
            LakeError::Location { .. }
                | LakeError::NoLake { .. }
                | LakeError::Occupied { .. }
                | LakeError::NotExclusive { .. }
                | LakeError::Config { .. }
                | LakeError::Newer { .. }
                | LakeError::Store { .. }
        )
    })
}

// On an object store, the first run makes the lake, as with `ingest`.
async fn open_or_make(lake_url: &str, rig: &Rig) -> anyhow::Result<Lake> {
    match Lake::open(lake_url).await {
        Err(LakeError::NoLake { .. }) if remote_access(lake_url).is_some() => {
            Ok(Lake::open_or_create(lake_url, rig, &ReferenceSurfaces::default()).await?)
        }
        opened => Ok(opened?),
    }
}

async fn upload_file(
    file: &Path,
    run: &ClosedRun,
    lake: &Lake,
    progress: &CommandProgress,
) -> anyhow::Result<UploadedRun> {
    let size = std::fs::metadata(file).with_context(|| format!("cannot read `{}`", file.display()))?.len();
    let path = file.to_owned();
    let mut reading = progress.start_task("read", size / MEGABYTE, "MB");
    let digest = move || {
        let digest = echolake_lake::file_sha256(&path, &mut |bytes| reading.set_done(bytes / MEGABYTE));
        reading.dismiss();
        digest
    };
    let digest = tokio::task::spawn_blocking(digest).await?;
    let (sha256, bytes) = digest.with_context(|| format!("cannot read `{}`", file.display()))?;
    let surface = run.manifest.surface_id.clone();
    let run = run.manifest.run_id.clone();
    let upload = RunUpload { file: file.to_owned(), surface, run, bytes, sha256 };
    let mut bars = UploadBars { progress, total: bytes / MEGABYTE, sending: None, comparing: None };
    let outcome = lake.upload_run(&upload, &mut |step, bytes| bars.show_bytes(step, bytes)).await;
    let RunUpload { surface, run, bytes, sha256, .. } = upload;
    bars.end_bars(outcome.is_ok().then(|| format!("{run}, {}, SHA-256 compared", super::format_size(bytes))));
    let (path, uploaded) = match outcome? {
        UploadOutcome::Uploaded(path) => (path.to_string(), true),
        UploadOutcome::Present(path) => {
            progress.print_message(format!("{run}: is in the lake already, at `{path}`, with the same SHA-256"));
            (path.to_string(), false)
        }
    };
    let run_id = run.to_string();
    let surface_id = surface.to_string();
    Ok(UploadedRun { file: file.display().to_string(), run_id, surface_id, path, bytes, sha256, uploaded })
}

/// The progress of one upload, step by step.
struct UploadBars<'a> {
    progress: &'a CommandProgress,
    /// Megabytes of the file.
    total: u64,
    sending: Option<TaskProgress>,
    comparing: Option<TaskProgress>,
}

impl UploadBars<'_> {
    fn show_bytes(&mut self, step: UploadStep, bytes: u64) {
        let (bar, name) = match step {
            UploadStep::Send => (&mut self.sending, "upload"),
            UploadStep::Compare => (&mut self.comparing, "compare"),
        };
        let begin = || {
            let mut task = self.progress.start_task(name, self.total, "MB");
            task.begin_at(bytes / MEGABYTE);
            task
        };
        bar.get_or_insert_with(begin).set_done(bytes / MEGABYTE);
    }

    fn end_bars(self, done: Option<String>) {
        self.comparing.into_iter().for_each(TaskProgress::dismiss);
        match (self.sending, done) {
            (Some(task), Some(done)) => task.finish_with(done),
            (sending, _) => sending.into_iter().for_each(TaskProgress::dismiss),
        }
    }
}
