//! The devices of a rig: the `[devices]` section of a rig file. Without it the rig is simulated.

use serde::{Deserialize, Serialize};

/// A rig's devices: all of them simulated, or none, because simulated devices have a clock of their own.
///
/// ```
/// use echolake_schema::{Rig, devices::SensorParams};
///
/// let rig = Rig::from_toml("[devices.sensor]\nkind = \"simulated\"")?;
/// assert_eq!(rig.devices.sensor, SensorParams::Simulated);
/// assert!(rig.devices.are_simulated());
/// # Ok::<(), echolake_schema::Error>(())
/// ```
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DeviceParams {
    /// The audio interface.
    pub audio: AudioParams,
    /// The ambient sensor.
    pub sensor: SensorParams,
    /// The arms.
    pub robots: RobotsParams,
}

/// The audio interface.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum AudioParams {
    /// Computed.
    #[default]
    Simulated,
    /// Through ALSA. Needs the feature `alsa`.
    Alsa(AlsaParams),
}

/// The ambient sensor.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum SensorParams {
    /// Computed.
    #[default]
    Simulated,
    /// On a serial line.
    Serial(SerialParams),
}

/// The arms.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum RobotsParams {
    /// Computed.
    #[default]
    Simulated,
    /// Behind a rosbridge.
    Rosbridge(Box<RosbridgeParams>),
}

/// An ALSA device that plays and records at the same time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AlsaParams {
    /// Name of the PCM that plays, as `aplay -L` lists it.
    pub playback: String,
    /// Name of the PCM that records, as `arecord -L` lists it.
    pub capture: String,
    /// Sample format of both PCMs.
    pub format: AudioFormat,
    /// Channels of the PCM that plays.
    pub outputs: u32,
    /// Channels of the PCM that records.
    pub inputs: u32,
    /// Channel that the speaker hangs on, counted from 1. Every other output carries the same, so that any of them
    /// can be looped back.
    pub output: u32,
    /// Channel of the microphone, counted from 1.
    pub microphone: u32,
    /// Channel of the loopback, counted from 1.
    pub loopback: u32,
    /// Frames that are passed at a time.
    pub period_frames: u32,
    /// Most that a recording may begin after the output, s: converters, buffers, and a late start.
    pub latency_secs: f64,
    /// Most repetitions of a take with a gap before it fails.
    pub repeats: u32,
}

impl Default for AlsaParams {
    fn default() -> Self {
        Self {
            playback: "default".into(),
            capture: "default".into(),
            format: AudioFormat::S32,
            outputs: 2,
            inputs: 2,
            output: 1,
            microphone: 1,
            loopback: 2,
            period_frames: 1024,
            latency_secs: 0.25,
            repeats: 3,
        }
    }
}

/// Sample format for exchange with an audio interface, little-endian.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AudioFormat {
    /// 32 bits, of which the upper 24 are kept.
    S32,
    /// 24 bits in the lower bytes of 32.
    S24,
    /// 24 bits in three bytes.
    S24Packed,
}

/// A sensor on a serial line.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SerialParams {
    /// The line's device.
    pub path: String,
    /// Bits per second.
    pub baud: u32,
    /// Longest wait for a reading, s, in which a lost line is reopened repeatedly.
    pub timeout_secs: f64,
}

impl Default for SerialParams {
    fn default() -> Self {
        Self { path: "/dev/ttyACM0".into(), baud: 115_200, timeout_secs: 5.0 }
    }
}

/// Two arms behind a rosbridge.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RosbridgeParams {
    /// Its address.
    pub url: String,
    /// Namespace of the microphone's arm.
    pub microphone: String,
    /// Namespace of the speaker's arm.
    pub speaker: String,
    /// Names of the six joints in messages, foot first.
    pub joint_names: [String; 6],
    /// Share of the data sheet's speeds that moves use.
    pub speed: f64,
    /// Largest difference of a joint from its target, degrees.
    pub tolerance_deg: f64,
    /// Longest wait for an answer, or for an arm to come to rest after its planned time, s.
    pub timeout_secs: f64,
}

impl Default for RosbridgeParams {
    fn default() -> Self {
        Self {
            url: "ws://127.0.0.1:9090".into(),
            microphone: "/microphone".into(),
            speaker: "/speaker".into(),
            joint_names: std::array::from_fn(|i| format!("joint_{}", i + 1)),
            speed: 0.1,
            tolerance_deg: 0.02,
            timeout_secs: 5.0,
        }
    }
}

impl DeviceParams {
    /// Returns whether all devices are simulated, the default that rig files leave out.
    pub fn are_simulated(&self) -> bool {
        *self == Self::default()
    }

    /// Describes the first contradiction among the settings.
    pub(crate) fn find_contradiction(&self) -> Option<String> {
        let simulated = [
            self.audio == AudioParams::Simulated,
            self.sensor == SensorParams::Simulated,
            self.robots == RobotsParams::Simulated,
        ];
        if simulated.contains(&true) && simulated.contains(&false) {
            return Some(
                "has simulated devices beside real ones; hint: audio, sensor and robots all need a `kind`".into(),
            );
        }
        let waits = |secs: f64| secs > 0.0 && secs <= 3600.0;
        match (&self.audio, &self.sensor, &self.robots) {
            (AudioParams::Alsa(a), ..) if !a.channels_exist() => {
                Some("audio: a channel is 0 or beyond `outputs` or `inputs`, or microphone and loopback are one".into())
            }
            (AudioParams::Alsa(a), ..) if !waits(a.latency_secs) || a.period_frames == 0 || a.repeats > 100 => Some(
                "audio: expected period_frames above 0, repeats up to 100, latency_secs above 0, up to 3600".into(),
            ),
            (_, SensorParams::Serial(s), _) if !waits(s.timeout_secs) || s.baud == 0 => {
                Some("sensor: expected baud and timeout_secs above 0".into())
            }
            (.., RobotsParams::Rosbridge(r)) if !r.is_plausible() => {
                Some("robots: expected 0 < speed <= 1, 0 < tolerance_deg <= 5, timeout_secs above 0".into())
            }
            _ => None,
        }
    }
}

impl AlsaParams {
    fn channels_exist(&self) -> bool {
        let input = |channel| (1..=self.inputs).contains(&channel);
        (1..=self.outputs).contains(&self.output)
            && input(self.microphone)
            && input(self.loopback)
            && self.microphone != self.loopback
            && self.inputs.max(self.outputs) <= 256
    }
}

impl RosbridgeParams {
    fn is_plausible(&self) -> bool {
        let within = |x: f64, most: f64| x > 0.0 && x <= most;
        within(self.speed, 1.0) && within(self.tolerance_deg, 5.0) && within(self.timeout_secs, 3600.0)
    }
}
