//! Drivers of real devices behind the rig's traits, chosen by the rig file's `[devices]` section. `docs/devices.md`
//! describes the protocol of each.

#[cfg(feature = "alsa")]
mod alsa;
pub mod audio;
pub mod rosbridge;
pub mod serial;
#[cfg(test)]
mod tests;

use echolake_schema::Rig;
use echolake_schema::devices::{AlsaParams, AudioParams, DeviceParams, RobotsParams, SensorParams};
use echolake_schema::manifest::Origin;

use crate::rig::robots::Cell;
use crate::rig::{AudioInterface, Error, RigDevices};

/// Opens a rig's devices; None if all of them are simulated.
///
/// # Errors
/// [`Error::Device`] if one does not answer, is not built in, or is simulated beside real ones.
pub fn open(rig: &Rig) -> Result<Option<RigDevices>, Error> {
    let DeviceParams { audio, sensor, robots } = &rig.devices;
    if rig.devices.are_simulated() {
        return Ok(None);
    }
    // Every kind is named, so that a new one cannot become a simulation.
    Ok(Some(RigDevices {
        audio: match audio {
            AudioParams::Simulated => return Err(simulated_beside_real()),
            AudioParams::Alsa(params) => audio_interface(params, rig.sweep.rate_hz.get())?,
        },
        sensor: match sensor {
            SensorParams::Simulated => return Err(simulated_beside_real()),
            SensorParams::Serial(params) => Box::new(serial::SerialSensor::open(params)?),
        },
        robots: match robots {
            RobotsParams::Simulated => return Err(simulated_beside_real()),
            RobotsParams::Rosbridge(params) => {
                Box::new(rosbridge::RosbridgeRobots::connect(params, Cell::from_rig(rig))?)
            }
        },
        origin: Origin::Measured,
    }))
}

// A rig file that mixes them is refused when it is read.
fn simulated_beside_real() -> Error {
    let reason = "has simulated devices beside real ones; hint: audio, sensor and robots all need a `kind`";
    Error::Device { device: "rig", reason: reason.into() }
}

/// An interface through ALSA.
///
/// # Errors
/// [`Error::Device`] if it is not there, does not support the request, or this build has no ALSA.
#[cfg(feature = "alsa")]
pub fn audio_interface(params: &AlsaParams, rate_hz: f64) -> Result<Box<dyn AudioInterface>, Error> {
    let pcm = alsa::AlsaDuplex::open(params, rate_hz)?;
    Ok(Box::new(audio::AlignedAudio::new(pcm, params.latency_secs, params.repeats)))
}

/// An interface through ALSA, which this build does not have.
///
/// # Errors
/// [`Error::Device`], always: it says what the build needs.
#[cfg(not(feature = "alsa"))]
pub fn audio_interface(params: &AlsaParams, _rate_hz: f64) -> Result<Box<dyn AudioInterface>, Error> {
    let text = format!(
        "cannot open `{}`: this build has no ALSA; hint: install libasound2-dev and pkg-config, then build with \
         `--features alsa`",
        params.capture
    );
    Err(Error::Device { device: audio::DEVICE, reason: text.into() })
}
