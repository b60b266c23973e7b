//! Runs of a small simulated rig.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use echolake_acquisition::run::RunRequest;
use echolake_acquisition::run::controller::RecordingMode;
use echolake_acquisition::run::simulate::run_simulation;
use echolake_panel::PanelSpecimen;
use echolake_panel::relief::PanelRelief;
use echolake_schema::manifest::Origin;
use echolake_schema::{Rig, Timestamp};

/// A rig of ten points, so that a run takes milliseconds.
pub const SMALL_RIG: &str = include_str!("../../tests/fixtures/small_rig.toml");

/// Measures a surface of the small rig into a folder, `number` hours after the first; returns the run's file.
///
/// # Panics
/// There is no such relief, or the folder cannot be written.
pub fn simulate_run(folder: &Path, number: usize, surface: &str, relief: &str, keep: RecordingMode) -> PathBuf {
    simulate_project_run(folder, number, (surface, None), relief, keep)
}

/// The same of a surface that belongs to a project.
///
/// # Panics
/// As [`simulate_run`], or it is no project's name.
pub fn simulate_project_run(
    folder: &Path,
    number: usize,
    (surface, project): (&str, Option<&str>),
    relief: &str,
    keep: RecordingMode,
) -> PathBuf {
    let rig = Rig::from_toml(SMALL_RIG).expect("a rig");
    let specimen = PanelSpecimen::Relief(PanelRelief::by_name(relief).expect("a relief"));
    let run = RunRequest {
        rig: &rig,
        surface: surface.parse().expect("an id"),
        specimen: &specimen,
        flat: None,
        foam: None,
        macro_reference: None,
        material: None,
        role: None,
        project: project.map(|name| name.parse().expect("a project")),
        start: Timestamp(1_767_600_000_000_000_000).plus_secs(number as f64 * 3_600.0),
        seed: number as u64 + 1,
        tag: number as u64 + 1,
        keep,
        folder,
    };
    run_simulation(&run, Origin::Simulated, &AtomicBool::new(false), &mut |_| {}).expect("a run").0
}
