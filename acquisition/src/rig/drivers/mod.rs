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
    // Every kind is named, so that a new one cannot become a simulation.
    let audio = match audio {
        AudioParams::Simulated => None,
        AudioParams::Alsa(params) => Some(params),
    };
    let sensor = match sensor {
        SensorParams::Simulated => None,
        SensorParams::Serial(params) => Some(params),
    };
    let robots = match robots {
        RobotsParams::Simulated => None,
        RobotsParams::Rosbridge(params) => Some(params),
    };
    let (audio, sensor, robots) = match (audio, sensor, robots) {
        (None, None, None) => return Ok(None),
        (Some(audio), Some(sensor), Some(robots)) => (audio, sensor, robots),
        _ => {
            let reason = "has simulated devices beside real ones; hint: audio, sensor and robots all need a `kind`";
            return Err(Error::Device { device: "rig", reason: reason.to_owned() });
        }
    };
    Ok(Some(RigDevices {
        audio: audio_interface(audio, rig.sweep.rate_hz.get())?,
        sensor: Box::new(serial::SerialSensor::open(sensor)?),
        robots: Box::new(rosbridge::RosbridgeRobots::connect(robots, Cell::of(rig))?),
        origin: Origin::Measured,
    }))
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
    let reason = format!(
        "cannot open `{}`: this build has no ALSA; hint: install libasound2-dev and pkg-config, then build with \
         `--features alsa`",
        params.capture
    );
    Err(Error::Device { device: audio::DEVICE, reason })
}
