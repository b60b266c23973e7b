//! A rig's devices: those that its file names, or simulated ones.

pub(crate) mod paced;
pub mod simulated;
mod transducers;

use std::sync::Arc;

use echolake_panel::PreparedPanel;
use echolake_schema::{Rig, Timestamp};

use crate::rig::drivers;
use crate::rig::robots::Choreography;
use crate::rig::{Error, RigDevices};
use crate::run::session::TakePace;
use paced::paced_devices;
use simulated::{RigSimulation, simulated_rig};

/// Inputs for opening a rig's devices.
pub(crate) struct DeviceRequest<'a> {
    pub rig: &'a Rig,
    /// Panel that simulated devices measure; `start` and `seed` are of their clock and noise.
    pub panel: &'a PreparedPanel,
    pub start: Timestamp,
    pub seed: u64,
    /// Joints of the arms at each pair, if a model of them is known.
    pub arms: Option<Arc<Choreography>>,
}

/// Opens the devices that the rig file names; simulated ones only if it says so for all of them.
///
/// # Errors
/// [`Error::Device`] if one does not answer, or is not built in.
pub(crate) fn open_devices(request: &DeviceRequest<'_>, pace: TakePace) -> Result<RigDevices, Error> {
    match drivers::open(request.rig)? {
        Some(real) => Ok(real),
        None => simulated_devices(request, pace),
    }
}

/// Makes simulated devices.
///
/// # Errors
/// [`Error::Device`] if the rig's grid has no points, or the panel's geometry is not known.
pub(crate) fn simulated_devices(request: &DeviceRequest<'_>, pace: TakePace) -> Result<RigDevices, Error> {
    let Some(geometry) = &request.panel.geometry else {
        return Err(Error::Device { device: "simulated rig", reason: "it needs the panel's geometry".into() });
    };
    let devices = simulated_rig(&RigSimulation {
        rig: request.rig,
        relief: &geometry.heights,
        material: geometry.material,
        start: request.start,
        seed: request.seed,
        arms: request.arms.clone(),
    })?;
    Ok(match pace {
        TakePace::Fast => devices,
        TakePace::Secs(secs) => paced_devices(devices, secs),
    })
}
