//! `echolake replay`: replays runs to Foxglove, with speed and position under its user's control.

use std::path::{Path, PathBuf};
use std::time::Duration;

#[cfg(feature = "lake")]
use anyhow::Context as _;
use echolake_acquisition::replay::{Recording, ReplayOptions, ReplayServer, ReplayState};
use echolake_lake::Lake;
#[cfg(feature = "lake")]
use echolake_schema::{RunId, SurfaceId};

use crate::CommandOutcome;
use crate::progress::{CommandProgress, TaskProgress};
use clap::Args;
use echolake_acquisition::ViewerAccess;
use echolake_acquisition::replay::SPEEDS;

#[derive(Debug, Args)]
pub(crate) struct ReplayArgs {
    /// Names of runs or surfaces (the newest run of each), or .mcap files; they are played one after the other.
    #[arg(required = true, value_name = "RUN")]
    pub runs: Vec<String>,
    /// Address to listen on.
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8765")]
    pub listen: std::net::SocketAddr,
    #[command(flatten)]
    pub viewers: ViewerArgs,
    /// Initial speed, as a factor of real time.
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = parse_speed)]
    pub speed: f32,
    /// Start paused, until a viewer presses play; by default playback begins with the first viewer.
    #[arg(long)]
    pub paused: bool,
}

/// Access of viewers.
#[derive(Debug, Args)]
pub(crate) struct ViewerArgs {
    /// Allow a viewer that is a web page of another origin, such as `https://app.foxglove.dev`; repeatable.
    #[arg(long = "allow-origin", value_name = "URL", value_parser = parse_origin)]
    pub allowed_origins: Vec<String>,
    /// Allow other machines without the token that is part of the printed address.
    #[arg(long)]
    pub open: bool,
}

impl ViewerArgs {
    pub fn viewer_access(&self) -> ViewerAccess {
        ViewerAccess { allowed_origins: self.allowed_origins.clone(), is_open: self.open }
    }
}

// As browsers spell it.
fn parse_origin(text: &str) -> Result<String, String> {
    let origin = text.trim_end_matches('/').to_ascii_lowercase();
    let is_origin = origin.split_once("://").is_some_and(|(scheme, host)| {
        !scheme.is_empty() && !host.is_empty() && !host.contains(['/', '?', '#', '@', ' '])
    });
    if is_origin { Ok(origin) } else { Err("expected scheme and host, as https://viewer.example:8080".to_owned()) }
}

fn parse_speed(text: &str) -> Result<f32, String> {
    let speed = text.parse().ok().filter(|x| SPEEDS.contains(x));
    speed.ok_or_else(|| format!("expected a number from {} to {}", SPEEDS.start(), SPEEDS.end()))
}

/// Time between two looks at the state of the replay.
const LOOK_EVERY: Duration = Duration::from_millis(200);
/// Names that an error lists.
#[cfg(feature = "lake")]
const LISTED: usize = 20;

pub(crate) async fn run_replay(args: &ReplayArgs, lake_url: &str) -> anyhow::Result<CommandOutcome> {
    let stop = super::stop_request()?;
    let paths = find_recordings(&args.runs, lake_url).await?;
    let progress = CommandProgress::new();
    let (recordings, lost) = tokio::task::block_in_place(|| open_recordings(&paths, &progress));
    anyhow::ensure!(!recordings.is_empty(), "none of the recordings can be replayed");
    let count = recordings.len();
    let options = ReplayOptions { speed: args.speed, paused: args.paused };
    let server = ReplayServer::start(args.listen, args.viewers.viewer_access(), recordings, options)?;
    progress.print_message(format!("replay: open {} in Foxglove or Lichtblick; Ctrl-C ends it", server.url()));
    super::tell_access(&args.viewers, server.address(), &progress);
    let mut task = progress.start_task("replay", server.length_secs().ceil() as u64, "s");
    let mut shown = ShownState::default();
    while !stop.is_made() {
        // The time that runs out is the usual end of this wait.
        let _ = tokio::time::timeout(LOOK_EVERY, stop.wait_until_made()).await;
        let standing = server.standing();
        shown.show_state(&mut task, &standing);
    }
    let standing = server.standing();
    shown.show_state(&mut task, &standing);
    tokio::task::block_in_place(|| drop(server));
    task.finish_with(format!("{count} recordings, {:.0} s shown last", standing.shown_secs));
    Ok(if lost || !standing.damages.is_empty() { CommandOutcome::WithLoss } else { CommandOutcome::Whole })
}

// Opens recordings, sorted by time; returns also whether one is damaged.
fn open_recordings(paths: &[PathBuf], progress: &CommandProgress) -> (Vec<Recording>, bool) {
    let mut recordings = Vec::new();
    let mut lost = false;
    for opened in paths.iter().map(|path| Recording::open(path)) {
        match opened {
            Ok(recording) => {
                if let Some(defect) = recording.defect() {
                    lost = true;
                    let path = recording.path().display();
                    progress.print_message(format!(
                        "warning: `{path}` is not whole: {defect}; what is whole of it is shown"
                    ));
                }
                recordings.push(recording);
            }
            Err(error) => {
                lost = true;
                progress.print_message(format!("error: {:#}", anyhow::Error::from(error)));
            }
        }
    }
    recordings.sort_by_key(|recording| recording.time_range().0);
    for pair in recordings.windows(2).filter(|pair| pair[1].time_range().0 <= pair[0].time_range().1) {
        let [earlier, later] = [&pair[0], &pair[1]].map(|recording| recording.path().display());
        progress
            .print_message(format!("warning: `{later}` begins before `{earlier}` ends; time goes back between them"));
    }
    (recordings, lost)
}

/// The part of a replay's state that its user has seen.
#[derive(Default)]
struct ShownState {
    damages: usize,
    notes: usize,
    /// Position and remark.
    progress: Option<(u64, String)>,
}

impl ShownState {
    // A journal gets no lines while nobody looks on.
    fn show_state(&mut self, task: &mut TaskProgress, standing: &ReplayState) {
        for damage in &standing.damages[self.damages..] {
            task.print_message(&format!("warning: {damage}"));
        }
        self.damages = standing.damages.len();
        for note in &standing.notes[self.notes..] {
            task.print_message(&format!("note: {note}"));
        }
        self.notes = standing.notes.len();
        let now = (standing.shown_secs as u64, describe_state(standing));
        if task.is_due() && self.progress.as_ref() != Some(&now) {
            task.set_note(now.1.clone());
            task.set_done(now.0);
            self.progress = Some(now);
        }
    }
}

fn describe_state(standing: &ReplayState) -> String {
    let state = if standing.is_playing { "" } else { ", stands" };
    let lost = if standing.lost == 0 { String::new() } else { format!(", {} lost", standing.lost) };
    let name = standing.recording.file_stem().unwrap_or_default().to_string_lossy();
    format!("{name}, speed {}{state}, viewers {}{lost}", standing.speed, standing.viewers)
}

// Files by their paths, runs and surfaces by the lake's tables.
async fn find_recordings(names: &[String], lake_url: &str) -> anyhow::Result<Vec<PathBuf>> {
    let mut paths = Vec::new();
    let mut lake = None;
    for name in names {
        let path = Path::new(name);
        if name.ends_with(".mcap") || name.ends_with(".mcap.partial") || path.is_file() {
            paths.push(path.to_owned());
            continue;
        }
        if lake.is_none() {
            lake = Some(Lake::open(lake_url).await?);
        }
        if let Some(lake) = &lake {
            paths.push(run_file(lake, name).await?);
        }
    }
    Ok(paths)
}

// The file of a run, or of a surface's newest run.
#[cfg(feature = "lake")]
pub(in crate::commands) async fn run_file(lake: &Lake, name: &str) -> anyhow::Result<PathBuf> {
    let folder =
        lake.folder().context("a replay needs a lake in a folder; hint: --lake FOLDER, or name .mcap files")?;
    let snapshot = lake.whole_snapshot().await?;
    let run = name.parse::<RunId>().ok();
    let surface = name.parse::<SurfaceId>().ok();
    let of_run = run.and_then(|run| snapshot.run(&run).cloned());
    let found = of_run.or_else(|| snapshot.newest_run(surface.as_ref()?).cloned());
    let found = found.with_context(|| {
        let mut known: Vec<_> = snapshot.runs().map(|run| run.surface.to_string()).collect();
        known.dedup();
        let more = if known.len() > LISTED { ", ..." } else { "" };
        known.truncate(LISTED);
        format!("there is no run, surface or file `{name}`; hint: there are surfaces {}{more}", known.join(", "))
    })?;
    Ok(folder.join(Lake::run_path(&found.surface, &found.run).as_ref()))
}

// Only the tables tell which file is a surface's newest run.
#[cfg(not(feature = "lake"))]
#[expect(clippy::unused_async, reason = "the other build's function waits")]
async fn run_file(_: &Lake, name: &str) -> anyhow::Result<PathBuf> {
    anyhow::bail!("there is no file `{name}`; hint: this program has no tables to look it up in, name .mcap files")
}
