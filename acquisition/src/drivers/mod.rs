//! Drivers of real devices behind the rig's traits, chosen by the rig file's `[devices]` section. `docs/devices.md`
//! says what each of them speaks.

#[cfg(feature = "alsa")]
mod alsa;
pub mod audio;
pub mod rosbridge;
pub mod serial;
#[cfg(test)]
mod tests;

use echolake_schema::Rig;
use echolake_schema::devices::{AlsaParams, AudioParams, RobotsParams, SensorParams};
use echolake_schema::manifest::Origin;

use crate::rig::{AudioInterface, Devices, Error};
use crate::robots::Cell;

/// A rig's devices; none where they are simulated.
///
/// # Errors
/// [`Error::Device`] where one does not answer, or is not built in.
pub fn open(rig: &Rig) -> Result<Option<Devices>, Error> {
    let devices = &rig.devices;
    let (AudioParams::Alsa(audio), SensorParams::Serial(sensor), RobotsParams::Rosbridge(robots)) =
        (&devices.audio, &devices.sensor, &devices.robots)
    else {
        return Ok(None);
    };
    Ok(Some(Devices {
        audio: audio_interface(audio, rig.sweep.rate_hz.get())?,
        sensor: Box::new(serial::SerialSensor::open(sensor)?),
        robots: Box::new(rosbridge::RosbridgeRobots::connect(robots, Cell::of(rig))?),
        origin: Origin::Measured,
    }))
}

/// An interface through ALSA.
///
/// # Errors
/// [`Error::Device`] where it is not there, cannot do what it is asked to, or this build has no ALSA.
#[cfg(feature = "alsa")]
pub fn audio_interface(params: &AlsaParams, rate_hz: f64) -> Result<Box<dyn AudioInterface>, Error> {
    let pcm = alsa::AlsaDuplex::open(params, rate_hz)?;
    Ok(Box::new(audio::Aligned::new(pcm, params.latency_secs, params.repeats)))
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
