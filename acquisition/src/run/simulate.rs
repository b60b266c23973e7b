//! Whole runs of the simulated rig, whatever devices a rig file names: for demos, twins of measured panels, benchmarks
//! and tests.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use echolake_panel::PreparedPanel;
use echolake_schema::manifest::{Origin, RunEnd};
use echolake_schema::messages::Verdict;

use crate::rig::devices::{DeviceRequest, simulated_devices};
use crate::rig::robots::Choreography;
use crate::run::controller::{self, RunControl, RunEvent};
use crate::run::session::{PreflightMode, RunSession, TakePace};
use crate::run::{Error, RunRequest};

/// Simulates all pairs, without a preflight check; returns the run's file and how it ended. Once `stop` is true it ends
/// with the pairs that it has. The origin is that of the signals: [`Origin::Simulated`] or [`Origin::Computed`].
///
/// # Errors
/// [`Error`]; a run that was begun leaves its `.partial` file.
pub fn run_simulation(
    request: &RunRequest<'_>,
    origin: Origin,
    stop: &AtomicBool,
    progress: &mut dyn FnMut(usize),
) -> Result<(PathBuf, RunEnd), Error> {
    let control = RunControl::default();
    let mut done = 0;
    let mut observe = |event: RunEvent<'_>| match event {
        RunEvent::Pair(_) => control.stop.store(stop.load(Ordering::Relaxed), Ordering::Relaxed),
        RunEvent::Attempt(m) if m.verdict() != Verdict::Repeated => {
            done += 1;
            progress(done);
        }
        _ => {}
    };
    let session = RunSession {
        control: &control,
        observe: &mut observe,
        tap: None,
        preflight: PreflightMode::Skip,
        checkpoint_every: None,
        pace: TakePace::Fast,
    };
    let RunRequest { rig, start, seed, .. } = *request;
    let panel = PreparedPanel::new(request.specimen, rig)?;
    let arms = Choreography::for_rig(rig)?;
    let devices = DeviceRequest { rig, panel: &panel, start, seed, arms: arms.clone() };
    let mut devices = simulated_devices(&devices, session.pace).map_err(controller::Error::from)?;
    devices.origin = origin;
    let measured = request.measure_with(devices, &panel, arms, session, None)?;
    Ok((measured.path, measured.outcome.end))
}
