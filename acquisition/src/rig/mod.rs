//! Traits of a rig's devices: robots, audio interface, ambient sensor. Every implementation passes the checks of
//! [`conformance`].
//!
//! One clock: take and reading carry the time of the same clock, and it never goes backwards. Every call blocks until
//! it is done; no work that could be noticed continues in the background.

pub mod conformance;
pub mod devices;
pub mod drivers;
pub mod robots;

use std::sync::Arc;

use echolake_schema::manifest::Origin;
use echolake_schema::{ErrorCause, Timestamp};

use crate::rig::robots::Joints;

/// Two arms: one carries the microphone, one the speaker. Positions in mm over the panel.
pub trait RobotArms: Send {
    /// Moves both and waits until they stand still; returns their positions. A position that cannot be reached or is
    /// not finite, two positions too near each other, and any move without power are refused, and then nothing has
    /// moved.
    ///
    /// # Errors
    /// [`Error::Unreachable`] or [`Error::Device`].
    fn move_to(&mut self, microphone_mm: [f64; 3], speaker_mm: [f64; 3]) -> Result<ArmPositions, Error>;

    /// Switches the drives; with them off the arms are silent and hold by their brakes. What is recorded with them
    /// on is a take all the same, with their noise in it.
    ///
    /// # Errors
    /// [`Error::Device`].
    fn switch_drives(&mut self, power: DrivePower) -> Result<(), Error>;

    /// Returns the problems that were handled since the last call, for the run's log.
    fn take_notices(&mut self) -> Vec<String> {
        Vec::new()
    }
}

/// Positions of the arms, mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmPositions {
    /// The microphone.
    pub microphone_mm: [f64; 3],
    /// The speaker.
    pub speaker_mm: [f64; 3],
    /// Joints of the microphone's and the speaker's arm, rad, if they are known.
    pub joints: Option<[Joints; 2]>,
}

/// The drives' power.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DrivePower {
    /// The arms can move.
    On,
    /// The arms are silent.
    Off,
}

/// Plays one channel and records two at the same time, sample by sample.
pub trait AudioInterface: Send {
    /// Sampling rate, Hz.
    fn rate_hz(&self) -> f64;

    /// Plays `output` (1.0 is full scale) and records as many samples of microphone and loopback; blocks until it is
    /// over. A take with a gap or an overrun is an error, never a take. The earlier content of `take` is replaced; its
    /// buffers are reused. `started` is set, and later than that of the take before.
    ///
    /// # Errors
    /// [`Error::Device`].
    fn play_and_record(&mut self, output: &[f32], take: &mut AudioTake) -> Result<(), Error>;

    /// Returns the problems that were handled since the last call, for the run's log.
    fn take_notices(&mut self) -> Vec<String> {
        Vec::new()
    }
}

/// One recording: signed 24-bit samples, full scale 2^23.
#[derive(Debug, Clone, Default)]
pub struct AudioTake {
    /// Time of its first sample.
    pub started: Option<Timestamp>,
    /// The measurement microphone.
    pub microphone: Vec<i32>,
    /// The output, looped back.
    pub loopback: Vec<i32>,
}

/// Measures the air of the room.
pub trait AmbientSensor: Send {
    /// The latest reading; never older than the one before.
    ///
    /// # Errors
    /// [`Error::Device`].
    fn read_ambient(&mut self) -> Result<AmbientReading, Error>;

    /// Returns the problems that were handled since the last call, for the run's log.
    fn take_notices(&mut self) -> Vec<String> {
        Vec::new()
    }
}

/// One reading of the ambient sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AmbientReading {
    /// Time of the reading.
    pub at: Timestamp,
    /// Temperature, C.
    pub temperature_c: f64,
    /// Relative humidity, %.
    pub humidity_pct: f64,
    /// Pressure, hPa.
    pub pressure_hpa: f64,
    /// Highest sound pressure level outside since the last reading, dB re 20 uPa.
    pub outside_level_db: f64,
}

/// A rig's devices.
pub struct RigDevices {
    /// The arms.
    pub robots: Box<dyn RobotArms>,
    /// The audio interface.
    pub audio: Box<dyn AudioInterface>,
    /// The ambient sensor.
    pub sensor: Box<dyn AmbientSensor>,
    /// Origin of their data: measured or simulated.
    pub origin: Origin,
}

impl RigDevices {
    /// Returns the problems that were handled since the last call, each with its device.
    pub fn take_notices(&mut self) -> Vec<(&'static str, String)> {
        let of = |device, notices: Vec<String>| notices.into_iter().map(move |notice| (device, notice));
        let robots = self.robots.take_notices();
        let audio = self.audio.take_notices();
        of("robots", robots).chain(of("audio", audio)).chain(of("sensor", self.sensor.take_notices())).collect()
    }
}

/// A fault of a device in words, and the error behind it if there is one. Two faults are equal if their words are.
#[derive(Debug, Clone)]
pub struct DeviceFault {
    text: String,
    cause: Option<Arc<dyn std::error::Error + Send + Sync>>,
}

impl DeviceFault {
    /// Creates a fault whose words name its cause.
    pub fn with_cause(text: String, cause: impl Into<ErrorCause>) -> Self {
        Self { text, cause: Some(Arc::from(cause.into())) }
    }
}

impl From<String> for DeviceFault {
    fn from(text: String) -> Self {
        Self { text, cause: None }
    }
}

impl From<&str> for DeviceFault {
    fn from(text: &str) -> Self {
        Self::from(text.to_owned())
    }
}

impl PartialEq for DeviceFault {
    fn eq(&self, other: &Self) -> bool {
        self.text == other.text
    }
}

impl std::fmt::Display for DeviceFault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.text)
    }
}

impl std::error::Error for DeviceFault {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        self.cause.as_deref().map(|cause| cause as _)
    }
}

/// A failure of a device.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// The arms cannot go there.
    #[error("the robots cannot reach microphone {microphone_mm:?}, speaker {speaker_mm:?} mm: {reason}")]
    Unreachable {
        /// The microphone's position.
        microphone_mm: [f64; 3],
        /// The speaker's position.
        speaker_mm: [f64; 3],
        /// The reason.
        reason: &'static str,
    },
    /// The device failed.
    #[error("{device}: {reason}")]
    Device {
        /// Name of the device.
        device: &'static str,
        /// The device's error.
        #[source]
        reason: DeviceFault,
    },
}
